"""Cut a scanned surface along the path of a tool's tip, let tension open the cut, and write series, page and numbers."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from naibu._version import __version__
from naibu.core.arrays import FloatArray, IntArray, require_lengths, require_within
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import sha256
from naibu.io.meshes import SURFACE_READERS, Surface, read_surface
from naibu.io.tables.blade_table import read_tip_path
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu
from naibu.meshing.cutting.surfaces.surface_cut import cut_surface as cut_along
from naibu.meshing.cutting.surfaces.surface_result import SurfaceCut, groove, triangle_areas
from naibu.simulation.surfaces.opening import LARGEST_TENSION, opening
from naibu.viewer.cards import Card
from naibu.viewer.motion_page import ColourField, MotionPage, RigidShape, motion_html
from naibu.viewer.notebook import WrittenResult
from naibu.viewer.tables import Table, quantity_of
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

FILES = ("cut.html", "cut.vtu", "cut.vtkhdf", "cut.json")
FRAMES, LARGE_FRAMES = 24, 8
LARGE_POINTS = 30_000  # surfaces of more have fewer frames
FRAME_S = 0.1
PAGE_BYTES = 24_000_000
PAGE_TRIANGLES = 60_000  # those nearest to the cut are shown
TOLD_PLACES = 3
INSIDE = 0.5  # of the distance: tips deeper than this below the surface cut a groove


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceCutRun(WrittenResult):
    """A cut surface and what was written of it.

    Attributes
    ----------
    files : tuple of Path
        The page first.
    cut : SurfaceCut
        The surface behind the cut.
    numbers : dict
        What ``cut.json`` holds.
    displacement : ndarray, shape (s, n, 3)
        Of the points of the surface while the tool passes and at the end, mm.
    """

    files: tuple[Path, ...]
    cut: SurfaceCut
    numbers: dict[str, Any]
    displacement: FloatArray

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a number: quantity, and value."""
        return tuple({"quantity": name, "value": value} for name, value in self.numbers.items())


def is_surface(source: str | os.PathLike[str]) -> bool:
    """Whether the ending of a file's name is one of triangulated surfaces."""
    return Path(source).suffix.lower() in SURFACE_READERS


@no_empty_folders()
def cut_surface_file(
    source: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    distance_mm: float | None = None,
    tension_percent: float = 5.0,
    groove_depth_mm: float | None = None,
    reach_mm: float | None = None,
    refine: bool = True,
    unit_mm: float = 1.0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SurfaceCutRun:
    """Cut a scanned surface along the path of a tool's tip, and let its tension open the cut.

    Parameters
    ----------
    source : path-like
        Surface (``.stl``, ``.ply``, ``.obj``, ``.wrl``, ``.vrml``), which may be open.
    path : path-like
        Table of the tips; see `naibu.io.tables.blade_table.read_tip_path`.
    out : path-like
        Folder for ``cut.html``, ``cut.vtu`` (the cut surface with its pieces), ``cut.vtkhdf`` (the cut opens behind the tool) and
        ``cut.json``.
    distance_mm : float, optional
        Triangles at the cut are refined until their longest edge is shorter, and the cut stays within half of it of the path; half of
        the mean edge of the surface by default, mm.
    tension_percent : float
        Strain that the surface is under, %; 0 leaves the cut closed.
    groove_depth_mm : float, optional
        Depth of a groove below the surface, mm; 0 for none. By default the floor lies at the tips
        if these are deeper than half the distance somewhere.
    reach_mm : float, optional
        How far from the surface the tip still cuts, mm; by default two distances.
    refine : bool
        Without it the cut follows the edges that there are, and may stray from the path.
    unit_mm : float
        Length of the surface file's unit, mm; the path is in mm.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` after every state of the opening.

    Raises
    ------
    InputError
        A surface that cannot be cut, a path that cannot be used or misses it, or a folder that cannot be written or holds results.
    ConvergenceError
        The opening cannot be computed.
    """
    require_within("tension_percent", tension_percent, 0.0, 100.0 * LARGEST_TENSION)
    require_lengths(distance_mm=distance_mm, groove_depth_mm=groove_depth_mm or None, reach_mm=reach_mm)
    surface, tips = read_surface(source, unit_mm=unit_mm), read_tip_path(path)
    folder = output_folder(out, FILES, overwrite=overwrite)
    distance = 0.5 * mean_edge_mm(surface) if distance_mm is None else distance_mm
    try:
        found = cut_along(surface.points, surface.triangles, tips, distance, reach_mm=reach_mm, refined=refine)
    except InputError as error:
        raise InputError(f"{path}: {error}" if "the tip stays" in str(error) else str(error)) from error
    if not len(found.cut_edges):
        raise InputError(
            f"{path}: is too short to cut anything at a distance of {distance:.3g} mm; give a longer path or a smaller distance_mm"
        )
    points, walls, wall_area = _grooved(found, groove_depth_mm, distance)
    frames = 1 if not tension_percent else FRAMES if len(found.points) <= LARGE_POINTS else LARGE_FRAMES
    moved = np.zeros((frames + 1, len(points), 3))
    for k, displacement in enumerate(opening(found, 0.01 * tension_percent, frames=frames)):
        moved[k, : len(found.points)] = displacement
        report_progress(progress, "open the cut", done=k + 1, total=frames + 1)
    copies = np.flatnonzero(found.source != np.arange(len(found.points)))
    gaps = np.linalg.norm(moved[-1, copies] - moved[-1, found.roots[copies]], axis=1)
    numbers = _numbers(surface, found, distance, wall_area, float(gaps.max(initial=0.0))) | {
        "tension_percent": tension_percent, "refined": refine, "repairs": list(found.repairs), "source": str(source),
        "naibu": __version__,
        "inputs_sha256": {Path(name).name: sha256(name) for name in (source, path)},
    }  # fmt: skip
    files = _written(folder, found, points, walls, numbers, moved)
    return SurfaceCutRun(files, found, numbers, moved[:, : len(found.points)])


def length_text(length_mm: float) -> str:
    """Return a length as text, mm; rounding errors are no length."""
    return f"{round(length_mm, 6):.2g} mm"


def areas_text(found: SurfaceCut) -> str:
    """Return the areas of the largest pieces, mm2, as text."""
    return ", ".join(f"{v:.4g}" if v < 1e4 else f"{v:.0f}" for v in found.areas_mm2[:6])


def incomplete_text(found: SurfaceCut, refined: bool) -> str:
    """Return a sentence on what of the path was not cut, empty where nothing of it hangs together."""
    said = [f"No cut was found for {found.missed_mm:.3g} mm of the path."] if found.missed_mm else []
    if len(found.bridges):
        remedy = "a smaller distance" if refined else "refinement"
        said.append(f"The cut is not complete: at {places_text(found.bridges)} its two sides still hang together; {remedy} helps.")
    return " ".join(said)


def places_text(places: FloatArray) -> str:
    """Return how many places (k, 3), mm, there are, and where the first ones are, as text."""
    count = "one place" if len(places) == 1 else f"{len(places)} places"
    where = "; ".join(", ".join(f"{round(v, 6) + 0.0:.4g}" for v in place) for place in places[:TOLD_PLACES])  # rounding is no place
    return f"{count} (near {where}{', ...' if len(places) > TOLD_PLACES else ''} mm)"


def mean_edge_mm(surface: Surface) -> float:
    """Return the mean length of the edges of the triangles, mm."""
    corners = surface.points[surface.triangles]
    return float(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).mean())


def _grooved(found: SurfaceCut, depth_mm: float | None, distance: float) -> tuple[FloatArray, IntArray, float]:
    """Return the points of the surface and of the floor of a groove, its walls and their area, without any where there is none."""
    if depth_mm is None and _deepest(found) < INSIDE * distance:
        depth_mm = 0.0
    if depth_mm == 0.0:
        return found.points, np.zeros((0, 3), dtype=np.int64), 0.0
    made = groove(found, depth_mm)
    return made.points, made.triangles, made.area_mm2


def _deepest(found: SurfaceCut) -> float:
    """How deep the tips lie below the surface at most, mm, where the outward normals of its triangles tell what is below."""
    nodes = np.unique(found.lips)
    normals, deepest = found.normals[nodes], 0.0
    for points, tips, over in found.paths:
        gaps = found.points[nodes][None] - points[over][::8][:, None]
        nearest = (gaps**2).sum(axis=2).argmin(axis=1)
        deepest = max(deepest, float(-((tips[over][::8] - points[over][::8]) * normals[nearest]).sum(axis=1).min(initial=0.0)))
    return deepest


def _numbers(surface: Surface, found: SurfaceCut, distance: float, wall_area: float, opening_mm: float) -> dict[str, Any]:
    before = float(triangle_areas(surface.points, surface.triangles).sum())
    return {
        "units": "mm",
        "pieces": found.n_pieces,
        "areas_mm2": found.areas_mm2.tolist(),
        "area_before_mm2": before,
        "relative_change_of_area": abs(float(found.areas_mm2.sum()) - before) / before,
        "triangles_before": len(surface.triangles),
        "triangles": len(found.triangles),
        "length_of_the_cut_mm": found.length_mm,
        "largest_distance_from_the_path_mm": found.deviation_mm,
        "mean_distance_from_the_path_mm": found.mean_deviation_mm,
        "allowed_distance_mm": 0.5 * distance,
        "length_of_the_path_without_cut_mm": found.missed_mm,
        "places_where_the_sides_hang_together_mm": found.bridges.tolist(),
        "area_of_the_groove_mm2": wall_area,
        "largest_opening_mm": opening_mm,
    }


def _written(
    folder: Path, found: SurfaceCut, points: FloatArray, walls: IntArray, numbers: Mapping[str, Any], moved: FloatArray
) -> tuple[Path, ...]:
    triangles = np.concatenate([found.triangles, walls])
    regions = np.repeat([0, 1], [len(found.triangles), len(walls)])
    mesh = Mesh(points, triangles, "triangle", regions, ("surface", "groove"))
    lips = np.zeros(len(points))
    lips[found.lips.ravel()] = 1.0
    none = np.full(len(walls), -1)
    cells = {"piece": np.concatenate([found.piece, none]), "parent": np.concatenate([found.parents, none])}
    write_vtu(folder / "cut.vtu", mesh, {"cut": lips, "displacement_mm": moved[-1]}, cells)
    times = np.asarray(FRAME_S * np.arange(len(moved)), dtype=np.float64)
    write_vtkhdf_series(folder / "cut.vtkhdf", mesh, times, {"displacement_mm": moved})
    write_atomically(folder / "cut.json", json.dumps(dict(numbers), indent=1) + "\n")
    text = motion_html(_page(found, points, _shown(found, points, triangles), numbers, times, moved), PAGE_BYTES)
    return (write_atomically(folder / "cut.html", text), *(folder / name for name in FILES[1:]))


def _shown(found: SurfaceCut, points: FloatArray, triangles: IntArray) -> IntArray:
    """Return the triangles that the page shows: all, or those nearest to the cut."""
    if len(triangles) <= PAGE_TRIANGLES:
        return triangles
    away = cKDTree(found.cut_edges.mean(axis=1)).query(points[triangles].mean(axis=1))[0]
    return triangles[np.sort(np.argsort(away, kind="stable")[:PAGE_TRIANGLES])]


def _cards(found: SurfaceCut, numbers: Mapping[str, Any]) -> tuple[Card, ...]:
    return (
        Card("Pieces", str(found.n_pieces), f"{areas_text(found)} mm²"),
        Card("Length of the cut", f"{found.length_mm:.3g} mm"),
        Card("Largest distance from the path", length_text(found.deviation_mm), f"{numbers['allowed_distance_mm']:.2g} mm are allowed"),
        Card("Largest opening", f"{numbers['largest_opening_mm']:.3g} mm", f"under a tension of {numbers['tension_percent']:g} %"),
    )


def _page(
    found: SurfaceCut, points: FloatArray, triangles: IntArray, numbers: Mapping[str, Any], times: FloatArray, moved: FloatArray
) -> MotionPage:
    sizes = areas_text(found)
    said = [
        f"The cut leaves {found.n_pieces} {'piece' if found.n_pieces == 1 else 'pieces'} of {sizes} mm². It deviates from the path of the "
        f"tool by {length_text(found.deviation_mm)} at most, {length_text(found.mean_deviation_mm)} on average, where "
        f"{numbers['allowed_distance_mm']:.2g} mm are allowed{'' if numbers['refined'] else ' with refinement'}.",
        f"Under a tension of {numbers['tension_percent']:g} % it opens by {numbers['largest_opening_mm']:.3g} mm. The points of this "
        "mass-spring model slide on what is beneath; those farther from the cut than it is long, and the rim, stay.",
    ]
    if incomplete := incomplete_text(found, numbers["refined"]):
        said.insert(0, incomplete)
    if found.repairs:
        said.append(f"Before the cut: {'; '.join(found.repairs)}.")
    if len(triangles) < numbers["triangles"]:
        said.append(f"The page shows the {len(triangles)} triangles nearest to the cut; cut.vtkhdf has all of them.")
    nodes, faces = np.unique(triangles, return_inverse=True)
    moved = moved[:, nodes]
    rows = [(quantity_of(name), v) for name, v in numbers.items() if isinstance(v, int | float) and not isinstance(v, bool)]
    fields = [ColourField("displacement, mm", np.linalg.norm(moved, axis=2))]
    if found.n_pieces > 1:
        piece = np.zeros(len(points))
        piece[found.triangles] = found.piece[:, None]
        fields.append(ColourField("piece, 0 the largest", np.tile(piece[nodes], (len(times), 1))))
    way = np.concatenate([tips for _, tips, _ in found.paths])
    at = way[np.rint(np.linspace(0.0, len(way) - 1, len(times))).astype(int)][:, None]
    radius = 0.01 * float(np.ptp(points, axis=0).max())
    tool = RigidShape("tip of the tool", "sphere", np.full(3, radius), np.eye(3))
    provenance = {"source": numbers["source"], "naibu": numbers["naibu"], "SHA-256": numbers["inputs_sha256"]}
    return MotionPage(
        f"{Path(numbers['source']).name}, cut", said, times, faces.reshape(-1, 3), points[nodes], moved, fields, [tool], at, np.zeros(0),
        np.zeros((0, 1, 3)), [Table("Numbers", ("quantity", "value"), tuple(rows))], provenance,
        _cards(found, numbers),
    )  # fmt: skip
