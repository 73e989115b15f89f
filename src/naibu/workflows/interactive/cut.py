"""Cut a body along the path of a blade, pull the cut open, and write mesh, motion, page and numbers."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray, IntArray, require_lengths
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import sha256
from naibu.io.tables.blade_table import read_blade_path
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu
from naibu.mechanics.finite_strain.lip_assembly import with_friction
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicEngine
from naibu.mechanics.lattices.model.hexahedra import lattice_mesh
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.meshing.cutting.swept_blade import SweptBlade, swept_blade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.meshing.quality import mean_edge_length, signed_volumes
from naibu.simulation.cuts.cut_sides import caution_of_cuts
from naibu.simulation.cuts.lattice_cut import LatticeCut
from naibu.simulation.interactive_bodies import AnySession, FiniteElementBody, InteractiveBody, LatticeBody
from naibu.viewer.cards import Card
from naibu.viewer.motion_page import ColourField, MotionPage, motion_html
from naibu.viewer.notebook import WrittenResult
from naibu.viewer.tables import Table, quantity_of
from naibu.workflows.interactive.cut_surface import length_text, places_text
from naibu.workflows.interactive.touchable_models import MeshMaterial, TouchableModel, touchable
from naibu.workflows.markers.experiments import Source
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

FILES = ("cut.html", "cut.vtu", "cut-surface.vtu", "cut.vtkhdf", "cut.json")
FRAME_S = 1.0 / 60.0
PULL_FRAMES, REST_FRAMES = 30, 30
PAGE_BYTES = 8_000_000
LARGEST_PULL = 50.0  # %
END = 1e-3  # of the extent: nodes this near to an end are pulled


@dataclass(frozen=True, slots=True, eq=False)
class CutRun(WrittenResult):
    """A cut body and what was written of it.

    Attributes
    ----------
    files : tuple of Path
        The page first.
    cut : VolumeCut or LatticeCut
        The mesh or lattice behind the cut.
    volumes_mm3 : ndarray, shape (p,)
        Volumes of the pieces, the largest first.
    opening_mm : float
        How far nodes of the two sides of the cut, which were one before, are apart at most at the end.
    """

    files: tuple[Path, ...]
    cut: VolumeCut | LatticeCut
    volumes_mm3: FloatArray
    opening_mm: float

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a piece: its number from 1, the largest first, and its volume, mm^3."""
        return tuple({"piece": k + 1, "volume_mm3": float(v)} for k, v in enumerate(self.volumes_mm3))


@no_empty_folders()
def cut(
    source: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    distance_mm: float | None = None,
    pull_percent: float = 5.0,
    lips_friction: float = 0.0,
    experiment: Source | None = None,
    material: MeshMaterial | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> CutRun:
    """Cut a body along the path of a blade, and pull it apart so that the cut opens.

    Parameters
    ----------
    source : str or path-like
        ``model.json`` of an identification, a mesh, or a lattice study; see `naibu.workflows.touchable`.
    path : path-like
        Table of the blade's edge, in the frame of the mesh or the scan; see `naibu.io.tables.blade_table.read_blade_path`.
    out : path-like
        Folder for ``cut.html``, ``cut.vtu`` (mesh with pieces), ``cut-surface.vtu`` (faces of the cut), ``cut.vtkhdf`` (motion) and
        ``cut.json``.
    distance_mm : float, optional
        Twice the largest distance of the cut from the blade, mm; by default half of the mean edge of a mesh. Lattices are not refined: a
        cut of theirs farther away is refused.
    pull_percent : float
        How far the two ends of the body along the axis that the cut crosses most are pulled apart, % of their distance; 0 leaves the cut
        closed.
    lips_friction : float
        Coulomb's coefficient between the two sides of the cut, of finite elements; steps are then taken by Newton's method, which takes
        longer.
    experiment : path, str or Experiment, optional
        Whose body an identified model is made for.
    material : MeshMaterial, optional
        Of a mesh.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` after every step of the motion.

    Raises
    ------
    InputError
        A body that cannot be cut, a path that cannot be used or misses the body, or a folder that cannot be written or holds results.
    ConvergenceError
        The motion of the pulled body cannot be computed.
    """
    if not 0.0 <= pull_percent <= LARGEST_PULL:
        raise InputError(f"pull_percent must lie between 0 and {LARGEST_PULL:g} %, not {pull_percent:g}")
    if not (np.isfinite(lips_friction) and lips_friction >= 0.0):
        raise InputError(f"lips_friction must be a finite number that is not negative, not {lips_friction:g}; 0 is frictionless")
    require_lengths(distance_mm=distance_mm)
    blade = _blade(path)
    folder = output_folder(out, FILES, overwrite=overwrite)
    model = touchable(source, experiment=experiment, material=material)
    if lips_friction > 0.0 and isinstance(model.body, LatticeBody):
        raise InputError(f"lips_friction must be 0, not {lips_friction:g}: the sides of the cut of a lattice do not touch each other")
    before, after, found, distance = _cut(model.body, blade, distance_mm)
    if not len(found.faces):
        faces = ", whose cuts follow the faces of its cubes" if isinstance(after, LatticeBody) else ""
        raise InputError(
            f"{path}: the blade passes beside the body, which reaches {_reach(before.points)}, or only grazes it{faces}; check the "
            "path and its unit (mm)"
        )
    a, b, c = after.points[found.faces].transpose(1, 0, 2)
    areas = 0.5 * np.cross(b - a, c - a)
    axis = int(np.abs(areas).sum(axis=0).argmax())
    turn = after.engine.lattice.frame.rotation if isinstance(after, LatticeBody) else np.eye(3)
    times, moved = _pulled(_rubbing(after, lips_friction), axis, pull_percent, progress)
    moved = moved @ turn.T
    volumes = np.bincount(found.piece, signed_volumes(found.mesh)).astype(np.float64)
    opening = _opening(found, moved[-1])
    numbers = _numbers(before, found, volumes) | {
        "area_of_the_cut_mm2": 0.5 * float(np.linalg.norm(areas, axis=1).sum()),
        "area_of_the_blade_path_mm2": blade.area_mm2, "largest_distance_from_the_blade_mm": found.deviation_mm,
        **({} if distance is None else {"allowed_distance_mm": 0.5 * distance}), "largest_opening_mm": opening,
        "source": str(source), "naibu": __version__, "pull_percent": pull_percent,
        **({"lips_friction": lips_friction} if lips_friction else {}),
        **({"doubt": model.doubt} if model.doubt else {}), **({"caution": caution} if (caution := _caution(after)) else {}),
        "pulled_along": "xyz"[int(np.abs(turn[:, axis]).argmax())], "inputs_sha256": {Path(path).name: sha256(path)},
    }  # fmt: skip
    files = _written(folder, model, after.faces, found, numbers, times, moved)
    return CutRun(files, found, volumes, opening)


def _blade(path: str | os.PathLike[str]) -> SweptBlade:
    """Surface that the blade of a file sweeps."""
    poses = read_blade_path(path)
    try:
        return swept_blade(poses)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _cut(
    body: InteractiveBody, blade: SweptBlade, distance_mm: float | None
) -> tuple[Mesh, InteractiveBody, VolumeCut | LatticeCut, float | None]:
    """Cut a body at rest; returns its mesh before, the body behind the cut, the cut, and the distance that was asked for."""
    if isinstance(body, LatticeBody):
        lattice = body.engine.lattice
        there = lattice.frame.inverse()  # the blade is given in the frame of the scan
        placed = SweptBlade(there.applied(blade.points), blade.triangles)
        after, _, found = body.cut(body.engine.rest(), placed, distance_mm)
        return lattice_mesh(lattice), after, found, distance_mm
    assert isinstance(body, FiniteElementBody)
    distance = 0.5 * mean_edge_length(body.mesh) if distance_mm is None else distance_mm
    behind, _, cut_mesh = body.cut(body.engine.rest(), blade, distance)
    return body.mesh, behind, cut_mesh, distance


def _caution(body: InteractiveBody) -> str:
    """What is to be said of forces on the body behind the cut; empty where nothing is."""
    return caution_of_cuts(body.engine.assembler, "a force on the body") if isinstance(body, FiniteElementBody) else ""


def _rubbing(body: InteractiveBody, friction: float) -> InteractiveBody:
    """Return the body whose sides of the cut rub on each other, stepped by Newton's method; the same where there is no friction."""
    if friction == 0.0:
        return body
    assert isinstance(body, FiniteElementBody)
    e = body.engine
    made = with_friction(e.assembler, friction)
    return replace(body, engine=DynamicEngine(e.points, made, e.mass, e.faces, e.step, e.normal_stiffness, e.tangential_stiffness))


def _pulled(body: InteractiveBody, axis: int, pull_percent: float, progress: Progress | None) -> tuple[FloatArray, FloatArray]:
    """Pull the ends along an axis apart, and let the body come to rest; returns times (s,) and displacements (s, n, 3)."""
    at = body.points[:, axis]
    extent = float(np.ptp(at))
    ends = [np.flatnonzero(np.abs(at - end) <= END * extent).astype(np.int64) for end in (at.min(), at.max())]
    frames = PULL_FRAMES + REST_FRAMES if pull_percent else 0
    steps = max(1, round(FRAME_S / body.step_s))
    way = np.eye(3)[axis] * 0.5 * 0.01 * pull_percent * extent / (PULL_FRAMES * steps * body.step_s)
    moved = [np.zeros_like(body.points)]
    with _held(body, ends) as session:
        for k in range(frames):
            session.step(np.stack([-way, way]) if k < PULL_FRAMES else np.zeros((2, 3)), steps=steps)
            moved.append(session.positions() - body.points)
            report_progress(progress, "open the cut", done=k + 1, total=frames)
    return np.asarray(steps * body.step_s * np.arange(len(moved)), dtype=np.float64), np.array(moved)


def _held(body: InteractiveBody, ends: list[IntArray]) -> AnySession:
    """A session in which two bodies move the two ends, and nothing else acts."""
    if isinstance(body, LatticeBody):
        return body.engine.session(constrained=ConstrainedNodes.of(ends[0], 0) + ConstrainedNodes.of(ends[1], 1))
    assert isinstance(body, FiniteElementBody)
    return body.engine.session(constrained=ends)


def _opening(found: VolumeCut | LatticeCut, moved: FloatArray) -> float:
    """Largest distance at the end of two nodes that were one before."""
    order = np.argsort(found.source, kind="stable")
    source, at, widest = found.source[order], (found.mesh.points + moved)[order], 0.0
    for apart in range(1, int(np.bincount(source).max())):
        same = source[apart:] == source[:-apart]
        widest = max(widest, float(np.linalg.norm(at[apart:][same] - at[:-apart][same], axis=1).max(initial=0.0)))
    return widest


def _numbers(mesh: Mesh, found: VolumeCut | LatticeCut, volumes: FloatArray) -> dict[str, Any]:
    before = float(signed_volumes(mesh).sum())
    numbers = {
        "units": "mm, degrees",
        "pieces": found.n_pieces,
        "volumes_mm3": volumes.tolist(),
        "volume_before_mm3": before,
        "relative_change_of_volume": abs(float(volumes.sum()) - before) / before,
        "cells_before": mesh.n_cells,
        "cells": found.mesh.n_cells,
    }
    if isinstance(found, LatticeCut):
        return numbers | {"nodes_before": mesh.n_points, "nodes": len(found.source), "elements": found.lattice.n_elements}
    return numbers | {
        "smallest_dihedral_angle_of_new_cells_deg": found.smallest_angle_deg,
        "length_of_earlier_cuts_that_it_goes_on_from_mm": found.joined_mm,
        "places_where_the_sides_hang_together_mm": found.bridges.tolist(),
    }


def joined_text(found: VolumeCut | LatticeCut) -> str:
    """Return sentences on earlier cuts that end near the blade, empty where none does."""
    if isinstance(found, LatticeCut):
        return ""
    said = [f"It goes on from earlier cuts, over {found.joined_mm:.3g} mm of their ends."] if found.joined_mm else []
    if len(found.bridges):
        said.append(
            f"At {places_text(found.bridges)} an earlier cut ends without meeting this one, and the body hangs together between them; let "
            "the blade begin within the earlier cut."
        )
    return " ".join(said)


def _reach(points: FloatArray) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    return ", ".join(f"{axis} from {a:.4g} to {b:.4g} mm" for axis, a, b in zip("xyz", low, high, strict=True))


def _written(
    folder: Path,
    model: TouchableModel,
    faces: IntArray,
    found: VolumeCut | LatticeCut,
    numbers: Mapping[str, Any],
    times: FloatArray,
    moved: FloatArray,
) -> tuple[Path, ...]:
    on_cut = np.zeros(found.mesh.n_points)
    on_cut[found.faces.ravel()] = 1.0
    write_vtu(folder / "cut.vtu", found.mesh, {"cut": on_cut, "displacement": moved[-1]}, {"piece": found.piece, "parent": found.parents})
    nodes, triangles = np.unique(found.faces, return_inverse=True)
    none = np.zeros(len(found.faces), dtype=np.int64)  # the only region
    surface = Mesh(found.mesh.points[nodes], triangles.reshape(-1, 3), "triangle", none, ("cut",))
    of_node = np.zeros(found.mesh.n_points, dtype=np.int64)
    of_node[found.mesh.cells] = found.piece[:, None]
    write_vtu(folder / "cut-surface.vtu", surface, {"displacement": moved[-1][nodes]}, {"piece": of_node[found.faces[:, 0]]})
    write_vtkhdf_series(folder / "cut.vtkhdf", found.mesh, times, {"displacement": moved})
    write_atomically(folder / "cut.json", json.dumps(dict(numbers), indent=1) + "\n")
    text = motion_html(_page(model, faces, found, numbers, times, moved), PAGE_BYTES)
    return (write_atomically(folder / "cut.html", text), *(folder / name for name in FILES[1:]))


def _cards(numbers: Mapping[str, Any]) -> tuple[Card, ...]:
    volumes = [f"{1e-3 * v:.3g}" for v in numbers["volumes_mm3"]]
    return (
        Card("Pieces", str(numbers["pieces"]), f"{', '.join(volumes[:4])}{', ...' if len(volumes) > 4 else ''} cm³"),
        Card("Area of the cut", f"{1e-2 * numbers['area_of_the_cut_mm2']:.3g} cm²", "of its facets, rougher than the blade"),
        Card("Largest distance from the blade", length_text(numbers["largest_distance_from_the_blade_mm"])),
        Card("Largest opening", f"{numbers['largest_opening_mm']:.3g} mm", f"ends pulled apart by {numbers['pull_percent']:g} %"),
    )


def _page(
    model: TouchableModel, shown: IntArray, found: VolumeCut | LatticeCut, numbers: Mapping[str, Any], times: FloatArray, moved: FloatArray
) -> MotionPage:
    nodes, faces = np.unique(shown, return_inverse=True)
    sizes = ", ".join(f"{1e-3 * v:.4g}" for v in numbers["volumes_mm3"][:6])
    friction = numbers.get("lips_friction")
    said = (
        f"The cut leaves {found.n_pieces} {'piece' if found.n_pieces == 1 else 'pieces'} of {sizes} cm³. It deviates from the blade by "
        f"{length_text(found.deviation_mm)} at most and opens by {numbers['largest_opening_mm']:.3g} mm where its ends along "
        f"{numbers['pulled_along']} are pulled apart by {numbers['pull_percent']:g} %.",
        *([earlier] if (earlier := joined_text(found)) else []),
        model.sentences[0],
        *([f"Its sides rub on each other with a friction coefficient of {friction:g}."] if friction else []),
        *([caution] if (caution := numbers.get("caution")) else []),
        *([model.doubt] if model.doubt else []),
    )
    rows = [(quantity_of(name), value) for name, value in numbers.items() if isinstance(value, int | float)]
    piece = np.zeros(found.mesh.n_points)
    piece[found.mesh.cells] = found.piece[:, None]
    fields = [ColourField("displacement, mm", np.linalg.norm(moved[:, nodes], axis=2))]
    if found.n_pieces > 1:
        fields.append(ColourField("piece, 0 the largest", np.tile(piece[nodes], (len(times), 1))))
    title = f"{model.title.removesuffix(', touched')}, cut"
    provenance = {"source": numbers["source"], "naibu": numbers["naibu"], "SHA-256": numbers["inputs_sha256"]}
    none = np.zeros((0, 0, 3))  # there is no indenter
    return MotionPage(
        title, said, times, faces.reshape(-1, 3), found.mesh.points[nodes], moved[:, nodes], fields, [], np.zeros((len(times), 0, 3)),
        np.zeros(0), none, [Table("Numbers", ("quantity", "value"), tuple(rows))], provenance,
        _cards(numbers),
    )  # fmt: skip
