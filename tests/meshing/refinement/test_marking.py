"""Criteria of refinement: what they mark under known deformations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.meshing.primitives import box
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.refinement.marking import AnyOf, EdgeStretch, NearContact, SurfaceBending, doerfler_marks
from naibu.meshing.structured_2d import rectangle

FOREST = BisectionForest.of(box((10, 10, 10), (5, 5, 5), cell_type="tetra", centred=False))
LEAF = FOREST.leaf_mesh()
POINTS = LEAF.mesh.points


def test_uniform_stretch_marks_all_cells_above_and_none_below_the_threshold():
    for factor, refine, coarsen in ((1.051, True, False), (1.03, False, False), (1.01, False, True)):
        marks = EdgeStretch(1.05, 1.02).marks(FOREST, LEAF, (factor - 1) * POINTS * [1, 0, 0])
        assert (marks.refine == refine).all() and (marks.coarsen == coarsen).all()
    shortened = EdgeStretch(1.05, 1.02, compression=True).marks(FOREST, LEAF, -0.06 * POINTS)
    assert shortened.refine.all()
    assert not EdgeStretch(1.05, 1.02).marks(FOREST, LEAF, -0.06 * POINTS).refine.any()


def test_local_stretch_marks_the_cells_that_hold_it():
    displacement = np.where(POINTS[:, :1] > 7.9, 0.3 * (POINTS[:, :1] - 8.0), 0.0) * [1, 0, 0]
    marks = EdgeStretch().marks(FOREST, LEAF, displacement)
    assert np.array_equal(marks.refine, POINTS[LEAF.mesh.cells][:, :, 0].min(axis=1) > 7.9)
    surface = EdgeStretch(surface_only=True).marks(FOREST, LEAF, displacement)
    faces, _ = FOREST.boundary_faces()
    assert np.array_equal(surface.refine, marks.refine & np.isin(LEAF.cells, faces[:, 0]))


def test_cells_near_a_body_are_marked():
    def distance(x):
        return np.linalg.norm(x - [5, 5, 13], axis=1) - 2.0

    criterion = NearContact(distance, 0.5, 3.0)
    marks = criterion.marks(FOREST, LEAF, np.zeros_like(POINTS))
    nearest = distance(POINTS)[LEAF.mesh.cells].min(axis=1)
    assert not marks.refine.any() or nearest[marks.refine].max() < 5.0
    pressed = criterion.marks(FOREST, LEAF, np.tile([0, 0, 1.0], (len(POINTS), 1)))
    assert pressed.refine.sum() > marks.refine.sum()
    assert not (pressed.refine & pressed.coarsen).any()
    both = AnyOf((criterion, EdgeStretch())).marks(FOREST, LEAF, 0.06 * POINTS)
    assert both.refine.all() and not both.coarsen.any()


@pytest.mark.parametrize("dimension", [2, 3])
def test_bending_marks_the_fold_and_no_rigid_motion(dimension):
    mesh = rectangle((10, 10), (5, 5)) if dimension == 2 else LEAF.mesh
    forest = BisectionForest.of(mesh)
    leaf = forest.leaf_mesh()
    x = leaf.mesh.points - leaf.mesh.points.min(axis=0)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(dimension, dimension)))[0]
    if np.linalg.det(turn) < 0:
        turn[0] *= -1
    criterion = SurfaceBending(0.2, 0.05)
    assert criterion.marks(forest, leaf, x @ turn.T - x).coarsen.all()
    fold = np.zeros_like(x)
    fold[:, -1] = np.tan(0.3) * np.maximum(x[:, 0] - 6.0, 0.0)  # the top and the bottom fold at x = 6 by 0.3 rad
    marks = criterion.marks(forest, leaf, fold)
    centre = x[leaf.mesh.cells]
    marked = centre[marks.refine]
    assert marks.refine.any() and (marked[:, :, 0].min(axis=1) <= 6.01).any() and (marked[:, :, 0].max(axis=1) >= 5.99).all()


@given(st.lists(st.floats(0, 1e3), min_size=1, max_size=30), st.floats(0.01, 1.0))
def test_doerfler_marks_are_the_smallest_set_that_holds_the_fraction(indicators, fraction):
    eta = np.array(indicators)
    marked = doerfler_marks(eta, fraction)
    total = (eta**2).sum()
    assert (eta[marked] ** 2).sum() >= fraction * total * (1 - 1e-9)
    if marked.any():
        weakest = np.flatnonzero(marked)[eta[marked].argmin()]
        assert (eta[marked] ** 2).sum() - eta[weakest] ** 2 < fraction * total * (1 + 1e-9)
        assert eta[marked].min() >= eta[~marked].max(initial=0.0)


def test_thresholds_without_hysteresis_are_refused():
    for make in (lambda: EdgeStretch(1.02, 1.05), lambda: NearContact(len, 2.0, 1.0), lambda: SurfaceBending(0.1, 0.1)):
        with pytest.raises(InputError, match="below"):
            make()
    for wrong in (0.0, 1.5):
        with pytest.raises(InputError, match="fraction"):
            doerfler_marks([1.0], wrong)
    with pytest.raises(InputError, match="not negative"):
        doerfler_marks([1.0, -1.0])
