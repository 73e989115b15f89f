"""Cut surfaces: area, Euler characteristic, distance from the tool's path, pieces, and what is mended or refused."""

from __future__ import annotations

from copy import deepcopy
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.tri import LinearTriInterpolator, Triangulation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from naibu.core.errors import InputError
from naibu.meshing import SurfaceCut, SurfaceCutter, boundary_faces, box, cut_surface, groove

SIZE = 100.0
D = 4.0


def plate(n: int = 10, seed: int = 0):
    """Return a square of irregular triangles."""
    g = np.linspace(0.0, SIZE, n + 1)
    x, y = np.meshgrid(g, g, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    inner = ((points[:, :2] > 0.0) & (points[:, :2] < SIZE)).all(axis=1)
    points[inner, :2] += np.random.default_rng(seed).uniform(-0.25, 0.25, (inner.sum(), 2)) * SIZE / n
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def skin():
    """Return the closed surface of a box."""
    mesh = box((40.0, 30.0, 20.0), (6, 5, 4), cell_type="tetra")
    return mesh.points, boundary_faces(mesh).faces


def euler(triangles) -> int:
    edges = np.unique(np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1), axis=0)
    return len(np.unique(triangles)) - len(edges) + len(triangles)


def area(points, triangles) -> float:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def distance_to_polyline(q, line) -> float:
    a, e = line[:-1], np.diff(line, axis=0)
    f = np.clip(((q - a) * e).sum(axis=1) / (e * e).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(q - a - f[:, None] * e, axis=1).min())


def require_sound(cut: SurfaceCut, before: float) -> None:
    """What holds for every cut: area, distance, quality, each edge of two triangles at most, run through in both directions."""
    assert cut.areas_mm2.sum() == pytest.approx(before, rel=1e-12)
    assert cut.deviation_mm <= 0.5 * D
    assert cut.missed_mm == 0.0 and not len(cut.bridges)
    a, b, c = cut.points[cut.triangles].transpose(1, 0, 2)
    heights = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.max([np.linalg.norm(x, axis=1) for x in (a - b, b - c, c - a)], axis=0)
    assert heights.min() > 1e-3 * D
    half = np.concatenate([cut.triangles[:, [0, 1]], cut.triangles[:, [1, 2]], cut.triangles[:, [2, 0]]])
    assert len(np.unique(half, axis=0)) == len(half)


angle = np.linspace(0.0, 2.0 * np.pi, 41)
CIRCLE = np.stack([50 + 30 * np.cos(angle), 50 + 25 * np.sin(angle), 0 * angle], axis=1)
TRIANGLE = 0.5 * 60.0 * 30.0  # enclosed by the crossing path
PATHS = {
    "begins and ends inside": ([[20, 30, 0], [70, 60, 0]], 0, [1e4]),
    "from edge to edge": ([[-10, 30, 0], [110, 60, 0]], 2, [5500.0, 4500.0]),
    "leaves over an edge": ([[50, 50, 0], [50.5, 130, 0]], 1, [1e4]),
    "begins on an edge": ([[50, 0, 0], [50.5, 60, 0]], 1, [1e4]),
    "closes a loop": (CIRCLE, 1, [1e4 - np.pi * 750, np.pi * 750]),
    "crosses an earlier cut": ([[-10, 48, 0], [110, 53, 0], [110, 130, 0], [50, 130, 0], [45, -20, 0]], 4, [2746, 2517, 2418, 2318]),
    "crosses itself": ([[20, 20, 0], [80, 80, 0], [80, 20, 0], [20, 80, 0]], 1, [1e4 - TRIANGLE, TRIANGLE]),
    "turns sharply": ([[20, 20, 0], [80, 80, 0], [81, 20, 0]], 0, [1e4]),
}


@pytest.mark.parametrize("name", PATHS)
def test_cuts_of_a_plate(name):
    path, characteristic, areas = PATHS[name]
    points, triangles = plate()
    cut = cut_surface(points, triangles, path, D)
    require_sound(cut, SIZE**2)
    assert euler(cut.triangles) == characteristic  # one for every piece, less one for every hole; a cut inside is a hole
    assert len(cut.areas_mm2) == len(areas)
    np.testing.assert_allclose(cut.areas_mm2, areas, atol=0.5 * D * cut.length_mm)
    line = np.array(path, dtype=float)
    far = [distance_to_polyline(q, line) for edge in cut.cut_edges for q in np.linspace(edge[0], edge[1], 7)]
    assert max(far) <= 0.5 * D + 1e-9
    inside = [q for a, b in pairwise(line) for q in np.linspace(a, b, 60) if (q >= 0).all() and (q[:2] <= SIZE).all()]
    covered = max(min(distance_to_polyline(q, edge) for edge in cut.cut_edges) for q in inside)
    assert covered <= D


@pytest.mark.parametrize("seed", range(12))
def test_random_paths_stay_near_and_lose_nothing(seed):
    rng = np.random.default_rng(seed)
    points, triangles = plate(8, seed)
    path = np.zeros((6, 3))
    path[:, :2] = rng.uniform(-10.0, 110.0, (6, 2))
    cut = cut_surface(points, triangles, path, D)
    require_sound(cut, SIZE**2)
    again = cut_surface(points, triangles, path, D)
    np.testing.assert_array_equal(again.triangles, cut.triangles)


def test_a_closed_surface_is_cut_into_two_around_its_waist():
    points, triangles = skin()
    assert euler(triangles) == 2
    ring = np.array([[3, -15, 0], [3, -15, 10], [1, 0, 10], [2, 15, 10], [3, 15, -10], [2, 0, -10], [3, -15, -10], [3, -15, 0.0]])
    ring[:, 2] += 10.0
    cut = cut_surface(points, triangles, ring, D, reach_mm=5.0)
    require_sound(cut, area(points, triangles))
    assert cut.n_pieces == 2 and euler(cut.triangles) == 2  # two discs
    halves = [2 * (30 + 20) * (20 + s * 2.3) + 30 * 20 for s in (1, -1)]
    np.testing.assert_allclose(cut.areas_mm2, halves, rtol=0.08)


def test_refinement_is_local_and_between_half_and_whole_distance():
    points, triangles = plate(4)
    cut = cut_surface(points, triangles, [[30, 50, 0], [60, 50, 0]], D)
    assert len(cut.triangles) < 32 + 600
    length = np.linalg.norm(cut.cut_edges[:, 1] - cut.cut_edges[:, 0], axis=1)
    assert length.max() < D
    corners = cut.points[cut.triangles]
    size = np.max([np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in ((0, 1), (1, 2), (2, 0))], axis=0)
    near = np.abs(corners - [45.0, 50.0, 0.0]).max(axis=(1, 2)) < 4.0
    assert near.any() and np.median(size[near]) > 0.5 * D
    halved = cut.ends[:, 0] >= 0
    np.testing.assert_allclose(cut.points[halved], cut.points[cut.ends[halved]].mean(axis=1), atol=1e-12)


def smallest_angle(points, triangles) -> float:
    out = []
    for k in range(3):
        a, b, c = (points[triangles[:, (k + j) % 3]] for j in range(3))
        cosine = ((b - a) * (c - a)).sum(axis=1) / (np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1))
        out.append(np.arccos(np.clip(cosine, -1.0, 1.0)).min())
    return float(np.degrees(min(out)))


@pytest.mark.parametrize("seed", range(3))
def test_bisection_along_longest_edges_keeps_half_of_the_smallest_angle(seed):
    # Rosenberg and Stenger's bound for bisection of the longest edge; the wave leaves no two triangles in a plane, so that none is swapped
    points, triangles = plate(6, seed)
    points[:, 2] = 5.0 * np.sin(0.07 * points[:, 0]) * np.cos(0.05 * points[:, 1] + seed)
    x = np.linspace(5.0, 95.0, 60)
    path = np.stack([x, 30 + 0.4 * x, 5.0 * np.sin(0.07 * x) * np.cos(0.05 * (30 + 0.4 * x) + seed)], axis=1)
    cut = cut_surface(points, triangles, path, D)
    require_sound(cut, area(points, triangles))
    assert len(cut.triangles) > 3 * len(triangles)
    assert smallest_angle(cut.points, cut.triangles) >= 0.5 * smallest_angle(points, triangles) - 1e-9


QUADRILATERAL = np.array([[0, 0, 0], [10, 0, 0], [10, 8, 0], [0, 8, 0.0]])


def test_the_next_vertex_may_lie_across_a_shared_longest_edge_which_is_swapped_then():
    across = [[0.0, 8.0, 0.0], [10.0, 0.0, 0.0]]
    cut = cut_surface(QUADRILATERAL, [[0, 1, 2], [0, 2, 3]], across, 4.0, refined=False)
    np.testing.assert_allclose(cut.areas_mm2, [40.0, 40.0])
    np.testing.assert_allclose(np.sort(cut.cut_edges[0], axis=0), [[0, 0, 0], [10, 8, 0]])
    assert len(cut.triangles) == 2 and len(cut.points) == 6
    bent = QUADRILATERAL.copy()
    bent[2, 2] = 3.0
    same = cut_surface(bent, [[0, 1, 2], [0, 2, 3]], across, 4.0, refined=False)
    assert same.n_pieces == 1 and not len(same.cut_edges)  # a swap would change the shape
    np.testing.assert_allclose(same.areas_mm2, area(bent, np.array([[0, 1, 2], [0, 2, 3]])))


def test_a_tool_that_comes_back_far_away_cuts_again():
    points, triangles = plate()
    there = [[-10, 20, 0], [110, 22, 0], [200, 22, 0], [200, 300, 0], [-150, 300, 0], [-150, 80, 0], [110, 78, 0]]
    cut = cut_surface(points, triangles, there, D)
    require_sound(cut, SIZE**2)
    np.testing.assert_allclose(np.sort(cut.areas_mm2), [2100, 2100, 5800], rtol=0.03)
    high = cut_surface(points, triangles, [[-10, 50, 40], [20, 50, 40], [20, 50, 0], [60, 52, 0], [60, 52, 40], [90, 52, 40]], D)
    assert high.n_pieces == 1 and high.length_mm == pytest.approx(40.0, rel=0.15)


def test_a_vertex_of_very_many_triangles_is_refused():
    n = 600
    turn = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    points = np.concatenate([[[0, 0, 0]], np.stack([50 * np.cos(turn), 50 * np.sin(turn), 0 * turn], axis=1)])
    fan = np.stack([np.zeros(n, dtype=int), 1 + np.arange(n), 1 + (np.arange(n) + 1) % n], axis=1)
    for refined in (True, False):
        with pytest.raises(InputError, match="more than 512 triangles"):
            cut_surface(points, fan, [[-20, 0.1, 0], [20, -0.1, 0]], 10.0, refined=refined)


def test_without_refinement_the_cut_strays_along_the_edges_that_there_are():
    points, triangles = plate()
    path = [[-10, 33, 0], [110, 57, 0]]
    rough = cut_surface(points, triangles, path, D, refined=False)
    assert len(rough.triangles) == len(triangles)
    assert rough.deviation_mm > 0.5 * D > cut_surface(points, triangles, path, D).deviation_mm
    assert rough.areas_mm2.sum() == pytest.approx(SIZE**2)


def test_the_walls_of_a_groove_reach_from_both_lips_to_the_tips_of_the_tool():
    points, triangles = plate()
    depth, path = 3.0, np.array([[-10, 50.2, -3.0], [110, 50.2, -3.0]])
    cut = cut_surface(points, triangles, path, D)
    walls = groove(cut)
    floor = walls.points[len(cut.points) :]
    np.testing.assert_allclose(floor[:, 2], -depth, atol=1e-9)
    assert max(distance_to_polyline(q, path) for q in floor) < 1e-9
    assert 2 * depth * SIZE <= walls.area_mm2 <= 2 * depth * cut.length_mm * 1.2
    ends = np.bincount(walls.triangles.ravel(), minlength=len(walls.points))
    assert (ends[len(cut.points) :] > 0).all()
    inside = groove(cut_surface(points, triangles, [[20, 50.2, -3.0], [70, 50.2, -3.0]], D))
    assert inside.triangles.min() >= 0 and inside.area_mm2 == pytest.approx(2 * depth * 50.0, rel=0.25)


def test_a_copy_in_the_middle_of_a_cut_goes_on_as_the_cut_itself_would_and_leaves_it_alone():
    points, triangles = plate()
    cutter = SurfaceCutter(points, triangles, D)
    cutter.move([10.0, 50.0, 0.0])
    cutter.move([30.0, 50.0, 0.0])
    before, copy = cutter.n_steps, deepcopy(cutter)
    copy.move([60.0, 60.0, 0.0])
    assert copy.n_steps > before == cutter.n_steps
    cutter.move([60.0, 60.0, 0.0])
    np.testing.assert_array_equal(cutter.result().points, copy.result().points)


def test_the_tool_cuts_while_it_moves_and_two_contacts_are_two_cuts():
    points, triangles = plate()
    cutter = SurfaceCutter(points, triangles, D)
    for x in np.linspace(10.0, 40.0, 16):
        cutter.move([x, 50.0, 0.0])
    reached = cutter.arrays.position[: cutter.arrays.n[0]]
    assert cutter.n_steps > 3 and len(reached) > len(points)
    cutter.lift()
    cutter.move([60.0, 50.0, 0.0])
    cutter.move([90.0, 50.0, 0.0])
    cut = cutter.result()
    require_sound(cut, SIZE**2)
    assert euler(cut.triangles) == -1  # two holes
    assert len(cut.paths) == 2


def test_what_is_not_linked_is_mended_and_said():
    points, triangles = plate(3)
    soup = points[triangles.ravel()]
    turned = np.arange(len(soup)).reshape(-1, 3)
    turned[::3] = turned[::3, ::-1]
    flat = np.array([[0, 0, 1], [0, 1, 2]])
    cut = cut_surface(soup, np.concatenate([turned, flat[:1], turned[:1]]), [[20, 50, 0], [80, 52, 0]], D)
    said = " ".join(cut.repairs)
    assert "merged" in said and "turned" in said and "without area" in said and "twice" in said
    require_sound(cut, SIZE**2)
    fin = np.concatenate([points, [[50.0, 50.0, 30.0]]])
    third = cut_surface(fin, np.concatenate([triangles, [[5, 6, len(points)]]]), [[20, 20, 0], [80, 22, 0]], D)
    assert "more than two triangles share" in " ".join(third.repairs)
    bowtie = np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [-9, 0, 0], [-9, -9, 0.0]])
    twice = cut_surface(bowtie, [[0, 1, 2], [0, 3, 4]], [[8, -1, 0], [8, 10, 0]], 2.0)
    assert "only touches itself" in " ".join(twice.repairs) and twice.n_pieces == 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"distance_mm": 0.0}, "distance_mm"),
        ({"distance_mm": 200.0}, "larger than the surface"),
        ({"distance_mm": np.nan}, "distance_mm"),
        ({"path": [[0, 0, np.nan], [1, 1, 1]]}, "path"),
        ({"path": [[5, 5, 0], [5, 5, 0]]}, "no length"),
        ({"path": [[5, 5, 500], [50, 5, 500]]}, "away from the surface"),
        ({"triangles": [[0, 1, 999]]}, "999"),
        ({"triangles": [[0, 0, 1]]}, "no triangle with an area"),
        ({"reach_mm": -1.0}, "reach_mm"),
    ],
)
def test_what_cannot_be_cut_is_refused(change, said):
    points, triangles = plate(3)
    given = {"points": points, "triangles": triangles, "path": [[10, 10, 0], [50, 50, 0]], "distance_mm": D} | change
    with pytest.raises(InputError, match=said):
        cut_surface(**given)


def sheet(seed: int, height: float = 0.0):
    """Return Delaunay's triangles of random points in a square, as a wave: those on its sides are flat where a point lies near a side."""
    rng = np.random.default_rng(seed)
    flat = np.concatenate([rng.uniform(0.0, 100.0, (150, 2)), [[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]]])
    begin, end = np.random.default_rng(1000 + seed).uniform(10.0, 90.0, 2)
    wave = height * np.sin(0.06 * flat[:, 0]) * np.cos(0.05 * flat[:, 1] + seed)
    return np.column_stack([flat, wave]), Delaunay(flat).simplices, begin, end


def crossing(seed: int, begin: float, end: float):
    path = np.array([[-5.0, begin, 0.0], [105.0, end, 0.0]])
    return path[:, [1, 0, 2]] if seed % 2 else path


def hangs_together(cut: SurfaceCut, path) -> bool:
    """Whether triangles far on both sides of a straight path from edge to edge hang together."""
    n = len(cut.points)
    ends = np.concatenate([cut.triangles[:, :2], cut.triangles[:, 1:]])
    _, part = connected_components(coo_array((np.ones(len(ends)), ends.T), shape=(n, n)), directed=False)
    along = path[1, :2] - path[0, :2]
    side = (cut.points[:, :2] - path[0, :2]) @ [-along[1], along[0]] / np.linalg.norm(along)
    used = np.isin(np.arange(n), cut.triangles)
    return bool(set(part[used & (side > D)]) & set(part[used & (side < -D)]))


SLIVERS = [(4.0, seed) for seed in (0, 4, 5, 8, 13, 14, 15, 21, 28, 34, 44, 45, 102, 135, 340)]
SLIVERS += [(2.0, 113), (2.0, 166), (10.0, 101), (10.0, 125), (10.0, 197)]


@pytest.mark.parametrize(("distance", "seed"), SLIVERS)
def test_a_cut_across_a_sheet_parts_it_also_through_flat_triangles_on_its_border(distance: float, seed: int) -> None:
    points, triangles, begin, end = sheet(seed)
    path = crossing(seed, begin, end)
    cut = cut_surface(points, triangles, path, distance)
    corners = cut.points[cut.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    parts = np.sort(np.bincount(cut.piece, area))[::-1]
    mean = 0.5 * (begin + end) * 100.0  # on one side of the straight path
    expected = np.sort([mean, 1e4 - mean])[::-1]
    np.testing.assert_allclose(parts[:2], expected, atol=0.5 * distance * 110.0)
    assert parts.sum() == pytest.approx(1e4, rel=1e-12) and cut.deviation_mm <= 0.5 * distance
    assert not len(cut.bridges)
    divides = cut.ends[:, 0] >= 0
    share, ends = cut.share[divides, None], cut.points[cut.ends[divides]]
    np.testing.assert_allclose(cut.points[divides], (1.0 - share) * ends[:, 0] + share * ends[:, 1], atol=1e-12)


def wave(seed: int, height: float) -> tuple[SurfaceCut, bool, float]:
    """Cut a wave whose border is a curtain of long flat triangles; whether its sides hang together, and its area before."""
    points, triangles, begin, end = sheet(seed, height)
    flat = crossing(seed, begin, end)
    way = flat[0] + np.linspace(0.0, 1.0, 200)[:, None] * (flat[1] - flat[0])
    surface = Triangulation(points[:, 0], points[:, 1], triangles)
    heights = LinearTriInterpolator(surface, points[:, 2])(*np.clip(way[:, :2], 1e-6, 100.0 - 1e-6).T)
    cut = cut_surface(points, triangles, np.column_stack([way[:, :2], heights.filled(0.0)]), D)
    return cut, hangs_together(cut, flat), area(points, triangles)


@pytest.mark.parametrize("seed", range(60))
def test_a_cut_goes_over_the_steep_folds_of_a_border(seed: int) -> None:
    """The tool jumps from one side of a fold to the other, which the cut has to follow over the surface."""
    cut, hangs, before = wave(seed, 12.0)
    assert not hangs and not len(cut.bridges) and cut.missed_mm == 0.0
    assert cut.n_pieces >= 2 and cut.deviation_mm <= 0.5 * D
    assert cut.areas_mm2.sum() == pytest.approx(before, rel=1e-12)


def test_a_path_has_a_point_on_the_edge_where_the_surface_is_folded() -> None:
    """The tool passes over a ditch 2 mm wide and 4 deep: its path goes down one side and up the other, 8.5 mm, and so does the cut."""
    x = np.array([0.0, 49.0, 50.0, 51.0, 100.0])
    points = np.array([[a, b, -4.0 if a == 50.0 else 0.0] for a in x for b in (0.0, 100.0)])
    triangles = np.add.outer(np.arange(0, 8, 2), np.array([[0, 2, 3], [0, 3, 1]])).reshape(-1, 3)
    cut = cut_surface(points, triangles, [[-10.0, 40.0, 0.0], [110.0, 43.0, 0.0]], D)
    way, _, over = cut.paths[0]
    assert np.linalg.norm(np.diff(way[over], axis=0), axis=1).sum() == pytest.approx(98.0 + 2.0 * np.sqrt(17.0), rel=2e-3)
    assert way[over][:, 2].min() == pytest.approx(-4.0, abs=1e-9)
    assert cut.n_pieces == 2 and not len(cut.bridges) and cut.deviation_mm <= 0.5 * D


TOLD = [62, 75, 77, 150, 153, 160, 193]


@pytest.mark.parametrize("seed", [*TOLD, *range(61, 72)])
def test_it_is_told_where_the_two_sides_of_a_cut_still_hang_together(seed: int) -> None:
    cut, hangs, _ = wave(seed, 12.0)
    assert hangs == (len(cut.bridges) > 0) == (seed in TOLD)
