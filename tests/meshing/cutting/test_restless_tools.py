"""Whatever hands do with the tool of a surface cutter, nothing breaks: invariants, and a flood fill of the plane beside the pieces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from restless_tools import RestlessTool
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import Delaunay

from naibu.core.arrays import FloatArray, IntArray
from naibu.meshing import SurfaceCut, SurfaceCutter, boundary_faces, box, groove

SIZE, PIXEL, RIM = 100.0, 0.2, 10.0  # mm
Surface = tuple[FloatArray, IntArray]


def plate(seed: int) -> Surface:
    """Return a flat square of random triangles whose border is straight, slivers among them."""
    g = np.linspace(0.0, SIZE, 9)[:-1]
    rim = np.concatenate([np.stack(side, axis=1) for side in ((g, 0 * g), (SIZE + 0 * g, g), (SIZE - g, SIZE + 0 * g), (0 * g, SIZE - g))])
    flat = np.concatenate([rim, np.random.default_rng(seed).uniform(1.0, SIZE - 1.0, (90, 2))])
    triangles = Delaunay(flat).simplices.astype(np.int64)
    a, b, c = flat[triangles].transpose(1, 2, 0)
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    triangles[area < 0.0] = triangles[area < 0.0][:, ::-1]
    return np.column_stack([flat, np.zeros(len(flat))]), triangles[np.abs(area) > 1e-6]


def sheet(seed: int) -> Surface:
    """Return a wavy sheet."""
    points, triangles = plate(seed)
    points[:, 2] = 6.0 * np.sin(points[:, 0] / 15.0) * np.cos(points[:, 1] / 20.0)
    return points, triangles


def skin(seed: int) -> Surface:
    """Return the closed surface of a box, with its edges."""
    mesh = box((80.0, 60.0, 40.0), (6, 5, 4), cell_type="tetra")
    return mesh.points, boundary_faces(mesh).faces


SURFACES: dict[str, Callable[[int], Surface]] = {"plate": plate, "sheet": sheet, "skin": skin}


def cut_by(kind: str, seed: int, habits: int) -> tuple[SurfaceCut, float, float, bool]:
    """Return what a seed leaves of a surface, its area before, mm2, the distance, mm, and whether it was refined."""
    points, triangles = SURFACES[kind](seed)
    rng = np.random.default_rng(seed)
    distance, refined = float(rng.choice([2.0, 4.0, 7.0])), kind == "plate" or bool(rng.random() < 0.8)
    tool = RestlessTool(SurfaceCutter(points, triangles, distance, refined=refined), points, triangles, rng)
    tool.use(habits)
    return tool.cutter.result(), float(areas(points, triangles).sum()), distance, refined


def areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def require_whole(cut: SurfaceCut, area: float, distance: float, refined: bool) -> None:
    """No area is lost, no triangle flat, no edge run through twice in one direction, and a refined cut is near its path."""
    assert np.isfinite(cut.points).all() and areas(cut.points, cut.triangles).min() > 0.0
    assert cut.areas_mm2.sum() == pytest.approx(area, rel=1e-9)
    half = np.concatenate([cut.triangles[:, [0, 1]], cut.triangles[:, [1, 2]], cut.triangles[:, [2, 0]]])
    assert len(np.unique(half, axis=0)) == len(half)
    if refined:
        assert cut.deviation_mm <= 0.5 * distance * (1.0 + 1e-9)
    if len(cut.lips):
        walls = groove(cut, 1.0)
        assert np.isfinite(walls.points).all() and walls.area_mm2 > 0.0


def gaps_from(cut: SurfaceCut, beside: bool) -> FloatArray:
    """Return the distance of every pixel of the square from the paths of the tool over it, or `beside` it as well, mm."""
    n, rim = round(SIZE / PIXEL), round(RIM / PIXEL)
    free = np.ones((n + 2 * rim, n + 2 * rim), dtype=bool)
    for way, _, over in cut.paths:
        for i in np.flatnonzero((over[1:] & over[:-1]) | beside):
            steps = max(2, int(np.linalg.norm(way[i + 1] - way[i]) / (0.4 * PIXEL)))
            places = way[i] + np.linspace(0.0, 1.0, steps)[:, None] * (way[i + 1] - way[i])
            x, y = np.clip((places[:, :2] / PIXEL + rim).astype(np.int64), 0, len(free) - 1).T
            free[x, y] = False
    return np.asarray(distance_transform_edt(free)[rim:-rim, rim:-rim] * PIXEL)


def require_pieces_of_the_plane(cut: SurfaceCut, distance: float) -> None:
    """What no path comes between is one piece; what paths enclose is a piece, unless it is told that the sides hang together."""
    over, all_paths = gaps_from(cut, False), gaps_from(cut, True)  # a tool that passes just beside the border may chip it
    x, y, _ = np.clip((cut.points[cut.triangles].mean(axis=1) / PIXEL).astype(np.int64), 0, len(over) - 1).T
    far = all_paths[x, y] > distance
    beside, parted = (label(gap > wall)[0][x, y][far] for gap, wall in ((all_paths, 0.5 * distance + 2.0 * PIXEL), (over, PIXEL)))
    piece = cut.piece[far]
    assert all(len(np.unique(piece[beside == place])) == 1 for place in np.unique(beside))
    if not len(cut.bridges) and cut.missed_mm == 0.0:
        assert all(len(np.unique(parted[piece == own])) == 1 for own in np.unique(piece))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", SURFACES)
def test_restless_hands_leave_a_surface_whole_but_for_its_cuts(kind: str, seed: int) -> None:
    require_whole(*cut_by(kind, seed, 10))


@pytest.mark.parametrize(("kind", "seed"), [("plate", 145), ("sheet", 171), ("sheet", 219), ("sheet", 247)])
def test_a_cut_keeps_near_its_path_between_the_places_where_it_is_looked_at(kind: str, seed: int) -> None:
    require_whole(*cut_by(kind, seed, 14))


@pytest.mark.parametrize("seed", range(6))
def test_pieces_are_those_of_the_plane_without_the_paths(seed: int) -> None:
    cut, area, distance, refined = cut_by("plate", seed, 4)
    require_whole(cut, area, distance, refined)
    require_pieces_of_the_plane(cut, distance)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1100))
@pytest.mark.parametrize("kind", SURFACES)
def test_restless_hands_for_long(kind: str, seed: int) -> None:
    cut, area, distance, refined = cut_by(kind, seed, 14)
    require_whole(cut, area, distance, refined)
    if kind == "plate":
        require_pieces_of_the_plane(cut, distance)
