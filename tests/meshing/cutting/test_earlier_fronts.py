"""Cuts of meshes that were cut before, of which nothing but the mesh is known: they go on, or it is said where they do not."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.meshing import BisectionForest, SweptBlade, VolumeCut, box, cut_volume, signed_volumes, swept_blade
from naibu.meshing.cutting.earlier_fronts import front_edges

SIZE = 20.0


def cubes(seed: int) -> Mesh:
    """Kuhn's cells, or, of an even seed, Delaunay's of random points."""
    if seed % 2:
        return box((SIZE, SIZE, SIZE), (4, 4, 4), cell_type="tetra")
    rng, grid = np.random.default_rng(seed), box((SIZE, SIZE, SIZE), (3, 3, 3), cell_type="tetra").points
    inside = np.abs(grid - [0.0, 0.0, 10.0]) < 9.9
    moved = grid + np.where(inside, rng.uniform(-2.0, 2.0, grid.shape), 0.0)
    points = np.concatenate([moved, rng.uniform([-9.0, -9.0, 1.0], [9.0, 9.0, 19.0], (20, 3))])
    cells = Delaunay(points).simplices
    volumes = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])
    cells[volumes < 0.0] = cells[volumes < 0.0][:, [0, 1, 3, 2]]
    return Mesh.from_arrays(points, cells[np.abs(volumes) > 1e-6], "tetra")


class Path:
    """A blade across the whole cube that moves on a plane, or on a wave, from 24 mm before its middle to 24 mm behind."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(1000 + seed)
        self.edge, self.way, self.bulge = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
        self.centre = np.array([0.0, 0.0, 10.0]) + rng.uniform(-3.0, 3.0, 3)
        self.height, self.distance, self.pause = rng.choice([0.0, 2.0]), float(rng.choice([2.0, 3.0, 5.0])), rng.uniform(-5.0, 5.0)

    def swept(self, first: float, last: float) -> SweptBlade:
        s = np.linspace(first, last, 9)[:, None]
        line = self.centre + s * self.way + self.height * np.sin(0.15 * s) * self.bulge
        return swept_blade(line[:, None] + np.array([[-40.0], [40.0]]) * self.edge)


def sizes(cut: VolumeCut) -> FloatArray:
    return np.bincount(cut.piece, signed_volumes(cut.mesh)).astype(float)


@pytest.mark.parametrize("overlap", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("kept", [False, True])
def test_a_blade_goes_on_where_it_ended_or_it_is_said_that_it_does_not(overlap: float, kept: bool) -> None:
    """Of the cut before, the mesh is known, or its forest, too; both pieces are as large as those of one cut."""
    parted = 0
    for seed in range(12):
        path, mesh = Path(seed), cubes(seed)
        once = cut_volume(mesh, path.swept(-24.0, path.pause), path.distance)
        blade = path.swept(path.pause - overlap * path.distance, 24.0)
        twice = cut_volume(once.mesh, blade, path.distance, forest=once.forest if kept else None)
        assert twice.deviation_mm <= 0.5 * path.distance
        assert signed_volumes(twice.mesh).sum() == pytest.approx(SIZE**3, rel=1e-12)
        if twice.n_pieces == 1:
            assert len(twice.bridges) > 0
            continue
        parted += 1
        assert not len(twice.bridges)
        whole = sizes(cut_volume(mesh, path.swept(-24.0, 24.0), path.distance))
        np.testing.assert_allclose(sizes(twice)[:2], whole[:2], atol=0.02 * SIZE**3)
    assert parted >= (12 if overlap == 1.0 else 11)


def test_what_is_left_between_two_cuts_holds_and_is_not_spoken_of() -> None:
    mesh = cubes(1)
    once = cut_volume(mesh, _upright(0.3, -15.0, -6.0), 2.0)
    twice = cut_volume(once.mesh, _upright(0.3, 6.0, 15.0), 2.0)
    assert twice.n_pieces == 1 and twice.joined_mm == 0.0 and not len(twice.bridges)
    alone = cut_volume(mesh, _upright(0.3, 6.0, 15.0), 2.0)
    assert len(twice.faces) == len(alone.faces)


def test_a_cut_along_the_end_of_another_meets_it() -> None:
    """Three pieces, as if the first cut had been a little longer."""
    once = cut_volume(cubes(1), _upright(0.3, -15.0, 1.0), 2.0)
    twice = cut_volume(once.mesh, swept_blade([[[x, 1.0, -5.0], [x, 1.0, SIZE + 5.0]] for x in (-15.0, 0.0, 15.0)]), 2.0)
    assert twice.joined_mm == pytest.approx(SIZE, rel=0.5)
    expected = [9.0 * SIZE**2, 11.0 * 10.3 * SIZE, 11.0 * 9.7 * SIZE]
    np.testing.assert_allclose(sizes(twice)[:3], expected, atol=1.01 * SIZE**2)  # half of the distance over a section


def test_a_cut_across_the_very_end_of_another_meets_it_or_it_is_said_that_it_does_not() -> None:
    """In any direction the two part what lies beside and before them, or the place where it hangs together is told."""
    met = 0
    for seed in range(24):
        rng = np.random.default_rng(3000 + seed)
        along, across, way = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
        centre, distance = np.array([0.0, 0.0, 10.0]) + rng.uniform(-2.0, 2.0, 3), float(rng.choice([2.0, 3.0]))
        end, through = (
            swept_blade([[centre - 40.0 * along + s * to, centre + 40.0 * along + s * to] for s in np.linspace(-40.0, last, 4)])
            for to, last in ((way, 0.0), (across, 40.0))
        )
        once = cut_volume(cubes(seed), end, distance)
        twice = cut_volume(once.mesh, through, distance)
        assert twice.deviation_mm <= 0.5 * distance
        assert signed_volumes(twice.mesh).sum() == pytest.approx(SIZE**3, rel=1e-12)
        middle = twice.mesh.points[twice.mesh.cells].mean(axis=1) - centre
        beside = np.abs(middle @ across) > distance
        behind, over = middle @ way < -distance, middle @ across > 0.0
        above, below = (set(twice.piece[beside & behind & half]) for half in (over, ~over))
        parted = not above & below
        assert parted != (len(twice.bridges) > 0), seed
        met += parted
    assert met >= 23


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("turn", [0.5 * np.pi, 1.0, 0.6])
def test_cuts_that_cross_and_end_at_one_depth_meet(seed: int, turn: float) -> None:
    """A blade that is deeper, but ends short of the first cut, does not meet it."""

    def down(x: float, depth: float, turn: float, last: float) -> SweptBlade:
        way, aside = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        return swept_blade([[[*(t * way + x * aside), z] for t in (-15.0, last)] for z in np.linspace(SIZE + 5.0, depth, 5)])

    once = cut_volume(cubes(seed), down(0.3, 9.0, 0.0, 15.0), 2.0)
    across = cut_volume(once.mesh, down(-0.4, 9.0, turn, 15.0), 2.0)
    assert not len(across.bridges)
    assert len(cut_volume(once.mesh, down(-0.4, 6.0, turn, -0.3), 2.0).bridges) > 0
    middle = across.mesh.points[across.mesh.cells].mean(axis=1)
    deep = middle[:, 2] > 13.0  # a layer in which four pieces are parted
    first, second = middle[:, 1] > 0.3, middle[:, :2] @ [-np.sin(turn), np.cos(turn)] > -0.4
    label = _pieces_of(across.mesh.cells[deep])
    beside = (np.abs(middle[:, 1] - 0.3) > 3.0) & (np.abs(middle[:, :2] @ [-np.sin(turn), np.cos(turn)] + 0.4) > 3.0)
    sets = [set(label[(beside & (first == a) & (second == b))[deep]]) for a in (False, True) for b in (False, True)]
    assert not any(one & two for k, one in enumerate(sets) for two in sets[k + 1 :])


def test_fronts_are_the_edges_at_which_a_cut_ends() -> None:
    assert not len(front_edges(BisectionForest.of(cubes(1)))[0])
    cut = cut_volume(box((SIZE, SIZE, SIZE), (4, 4, 4), cell_type="tetra"), _upright(0.0, -15.0, 0.1), 10.0)  # along faces of the mesh
    edges = front_edges(BisectionForest.of(cut.mesh))[0]
    ends = cut.mesh.points[edges]
    np.testing.assert_allclose(ends[..., 0], 0.0, atol=1e-12)
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() >= SIZE  # from the lower to the upper face
    whole = cut_volume(cut.mesh, _upright(0.0, -15.0, 15.0), 10.0)
    assert not len(front_edges(whole.forest)[0])


def _pieces_of(cells: IntArray) -> IntArray:
    """Which cells hang together over faces."""
    faces = np.sort(np.stack([np.delete(cells, k, axis=1) for k in range(4)], axis=1), axis=2).reshape(-1, 3)
    number = np.unique(faces, axis=0, return_inverse=True)[1].ravel()
    incidence = sp.coo_matrix((np.ones(len(faces)), (np.repeat(np.arange(len(cells)), 4), number))).tocsr()
    return np.asarray(connected_components(incidence @ incidence.T, directed=False)[1])


def _upright(x: float, first: float, last: float) -> SweptBlade:
    return swept_blade([[[x, y, -5.0], [x, y, SIZE + 5.0]] for y in np.linspace(first, last, 5)])
