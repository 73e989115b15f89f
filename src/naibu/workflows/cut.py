"""Cut a body along the path of a blade, pull the cut open, and write mesh, motion, page and numbers."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.io.blade_table import read_blade_path
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import sha256
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu
from naibu.meshing.cutting.swept_blade import SweptBlade, swept_blade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.meshing.quality import mean_edge_length, signed_volumes
from naibu.meshing.surface import boundary_faces
from naibu.simulation.interactive_bodies import FiniteElementBody
from naibu.viewer.motion_page import ColourField, MotionPage, motion_html
from naibu.viewer.tables import Table
from naibu.workflows.experiments import Source
from naibu.workflows.output_folder import output_folder
from naibu.workflows.touchable_models import MeshMaterial, TouchableModel, touchable

FILES = ("cut.html", "cut.vtu", "cut.vtkhdf", "cut.json")
PULL_STEPS, REST_STEPS = 30, 30  # of 1/60 s
PAGE_BYTES = 8_000_000
LARGEST_PULL = 50.0  # %
END = 1e-3  # of the extent: nodes this near to an end are pulled


@dataclass(frozen=True, slots=True, eq=False)
class CutRun:
    """A cut body and what was written of it.

    Attributes
    ----------
    files : tuple of Path
        The page first.
    cut : VolumeCut
        The mesh behind the cut.
    volumes_mm3 : ndarray, shape (p,)
        Volumes of the pieces, the largest first.
    opening_mm : float
        How far two sides of the cut, which met before, are apart at most at the end.
    """

    files: tuple[Path, ...]
    cut: VolumeCut
    volumes_mm3: FloatArray
    opening_mm: float


def cut(
    source: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    distance_mm: float | None = None,
    pull_percent: float = 5.0,
    experiment: Source | None = None,
    material: MeshMaterial | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> CutRun:
    """Cut a body along the path of a blade, and pull it apart so that the cut opens.

    Parameters
    ----------
    source : str or path-like
        ``model.json`` of an identification, or a mesh; see `naibu.workflows.touchable`.
    path : path-like
        Table of the blade's edge; see `naibu.io.blade_table.read_blade_path`.
    out : path-like
        Folder for ``cut.html``, ``cut.vtu`` (mesh with pieces), ``cut.vtkhdf`` (motion) and ``cut.json``.
    distance_mm : float, optional
        Twice the largest distance of the cut from the blade, mm; half of the mean edge of the mesh by default.
    pull_percent : float
        How far the two ends of the body along the axis that the cut crosses most are pulled apart, % of their distance; 0 leaves the cut
        closed.
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
    blade = swept_blade(read_blade_path(path))
    folder = output_folder(out, FILES, overwrite=overwrite)
    model = touchable(source, experiment=experiment, material=material)
    if not isinstance(model.body, FiniteElementBody):
        raise InputError(f"{source}: is a lattice, which is not cut; name a mesh or an identified model")
    before = model.body
    distance = 0.5 * mean_edge_length(before.mesh) if distance_mm is None else distance_mm
    after, _, found = before.cut(before.engine.rest(), blade, distance)
    if not len(found.faces):
        raise InputError(
            f"{path}: the blade passes beside the body, which reaches {_reach(before.points)}; check the path and its unit (mm)"
        )
    axis = int(np.abs(_vector_area(found)).argmax())
    times, moved = _pulled(after, axis, pull_percent, progress)
    volumes = np.bincount(found.piece, signed_volumes(found.mesh)).astype(np.float64)
    opening = _opening(found, moved[-1])
    numbers = _numbers(before, found, blade, distance, volumes, opening) | {
        "source": str(source), "naibu": __version__, "pull_percent": pull_percent,
        "pulled_along": "xyz"[axis], "inputs_sha256": {Path(path).name: sha256(path)},
    }  # fmt: skip
    files = _written(folder, model, found, numbers, times, moved)
    return CutRun(files, found, volumes, opening)


def _pulled(body: FiniteElementBody, axis: int, pull_percent: float, progress: Progress | None) -> tuple[FloatArray, FloatArray]:
    """Pull the ends along an axis apart, and let the body come to rest; returns times (s,) and displacements (s, n, 3)."""
    at = body.points[:, axis]
    extent = float(np.ptp(at))
    ends = [np.flatnonzero(np.abs(at - end) <= END * extent).astype(np.int64) for end in (at.min(), at.max())]
    steps = PULL_STEPS + REST_STEPS if pull_percent else 0
    way = np.eye(3)[axis] * 0.5 * 0.01 * pull_percent * extent / (PULL_STEPS * body.step_s)
    moved = [np.zeros_like(body.points)]
    with body.engine.session(constrained=ends) as session:
        for k in range(steps):
            session.step(np.stack([-way, way]) if k < PULL_STEPS else np.zeros((2, 3)))
            moved.append(session.positions() - body.points)
            report_progress(progress, "open the cut", done=k + 1, total=steps)
    return np.asarray(body.step_s * np.arange(len(moved)), dtype=np.float64), np.array(moved)


def _opening(found: VolumeCut, moved: FloatArray) -> float:
    """Largest distance at the end of two nodes of the new surface that met before."""
    first, second = np.split(found.mesh.points[found.faces] + moved[found.faces], 2)
    start = np.split(found.mesh.points[found.faces], 2)
    order = [np.lexsort(np.round(side, 6).transpose(2, 0, 1).reshape(3, -1)) for side in start]
    gaps = first.reshape(-1, 3)[order[0]] - second.reshape(-1, 3)[order[1]]
    return float(np.linalg.norm(gaps, axis=1).max())


def _numbers(
    body: FiniteElementBody, found: VolumeCut, blade: SweptBlade, distance: float, volumes: FloatArray, opening: float
) -> dict[str, Any]:
    before = float(signed_volumes(body.mesh).sum())
    return {
        "units": "mm, degrees",
        "pieces": found.n_pieces,
        "volumes_mm3": volumes.tolist(),
        "volume_before_mm3": before,
        "relative_change_of_volume": abs(float(volumes.sum()) - before) / before,
        "cells_before": body.mesh.n_cells,
        "cells": found.mesh.n_cells,
        "area_of_the_cut_mm2": float(np.linalg.norm(_area_vectors(found), axis=1).sum()),
        "area_of_the_blade_path_mm2": blade.area_mm2,
        "largest_distance_from_the_blade_mm": found.deviation_mm,
        "allowed_distance_mm": 0.5 * distance,
        "smallest_dihedral_angle_of_new_cells_deg": found.smallest_angle_deg,
        "largest_opening_mm": opening,
    }


def _area_vectors(found: VolumeCut) -> FloatArray:
    """Area vectors (f, 3) of one side of the cut, mm2."""
    a, b, c = found.mesh.points[np.split(found.faces, 2)[0]].transpose(1, 0, 2)
    return np.asarray(0.5 * np.cross(b - a, c - a))


def _vector_area(found: VolumeCut) -> FloatArray:
    return np.asarray(_area_vectors(found).sum(axis=0))


def _reach(points: FloatArray) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    return ", ".join(f"{axis} from {a:.4g} to {b:.4g} mm" for axis, a, b in zip("xyz", low, high, strict=True))


def _written(
    folder: Path, model: TouchableModel, found: VolumeCut, numbers: Mapping[str, Any], times: FloatArray, moved: FloatArray
) -> tuple[Path, ...]:
    on_cut = np.zeros(found.mesh.n_points)
    on_cut[found.faces.ravel()] = 1.0
    write_vtu(folder / "cut.vtu", found.mesh, {"cut": on_cut, "displacement": moved[-1]}, {"piece": found.piece, "parent": found.parents})
    write_vtkhdf_series(folder / "cut.vtkhdf", found.mesh, times, {"displacement": moved})
    write_atomically(folder / "cut.json", json.dumps(dict(numbers), indent=1) + "\n")
    text = motion_html(_page(model, found, numbers, times, moved), PAGE_BYTES)
    return (write_atomically(folder / "cut.html", text), *(folder / name for name in FILES[1:]))


def _page(model: TouchableModel, found: VolumeCut, numbers: Mapping[str, Any], times: FloatArray, moved: FloatArray) -> MotionPage:
    nodes, faces = np.unique(boundary_faces(found.mesh).faces, return_inverse=True)
    sizes = ", ".join(f"{v:.4g}" for v in numbers["volumes_mm3"][:6])
    said = (
        f"The cut leaves {found.n_pieces} {'piece' if found.n_pieces == 1 else 'pieces'} of {sizes} mm³. It deviates from the blade by "
        f"{found.deviation_mm:.2g} mm at most and opens by {numbers['largest_opening_mm']:.3g} mm where its ends along "
        f"{numbers['pulled_along']} are pulled apart by {numbers['pull_percent']:g} %.",
        model.sentences[0],
    )
    rows = [(name.replace("_", " "), value) for name, value in numbers.items() if isinstance(value, int | float)]
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
    )  # fmt: skip
