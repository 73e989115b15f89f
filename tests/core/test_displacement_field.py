"""Displacement fields at points, on grids and on meshes."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.identification.equilibrium_gap.equations import nodal_field
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase

SHAPE = (3, 4, 5)


def turned_grid() -> Volume:
    turn = rotation_matrix(np.array([0.3, -0.2, 0.7]))
    return Volume.from_array(np.ones(SHAPE), spacing_mm=(1.0, 2.0, 3.0), origin_mm=(5.0, 6.0, 7.0), direction=turn)


def affine(x: np.ndarray) -> np.ndarray:
    return x @ np.array([[0.1, 0.0, 0.2], [0.0, -0.1, 0.0], [0.3, 0.0, 0.0]]) + 1.0


def test_a_field_on_a_grid_is_listed_with_its_positions_and_covariances() -> None:
    grid, rng = turned_grid(), np.random.default_rng(0)
    root = rng.standard_normal((*SHAPE, 3, 3))
    covariance = root @ np.swapaxes(root, -1, -2)
    valid = rng.uniform(size=SHAPE) < 0.7
    field = DisplacementField.on_grid(grid, affine(grid.positions()), covariance=covariance, valid=valid, quality=rng.uniform(size=SHAPE))
    for step in (1, 2):
        listed = field.at_points(step=step)
        some = (slice(None, None, step),) * 3
        assert len(listed.points) == valid[some].sum()
        np.testing.assert_allclose(listed.vectors, affine(listed.points), atol=1e-12)
        np.testing.assert_array_equal(listed.covariance, covariance[some][valid[some]])
        assert listed.valid.all()
    np.testing.assert_allclose(field.points.reshape(*SHAPE, 3), grid.positions())


def test_a_grid_stores_neither_positions_nor_the_image() -> None:
    grid = Volume.from_array(np.ones((40, 50, 60)), spacing_mm=(1.0, 1.0, 1.0))
    vectors = np.zeros((40, 50, 60, 3))
    tracemalloc.start()
    field = DisplacementField.on_grid(grid, vectors)
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < 2 * field.valid.nbytes
    assert field.vectors is vectors
    assert field.grid.values.strides == (0, 0, 0)
    assert field.grid.same_grid(grid)


def test_the_least_certain_direction_is_the_largest_principal_axis() -> None:
    turn = rotation_matrix(np.array([0.4, 0.1, -0.6]))
    blocks = np.stack([turn @ np.diag([0.01, 0.04, 0.25]) @ turn.T, np.full((3, 3), np.nan)])
    field = DisplacementField(np.zeros((2, 3)), np.zeros((2, 3)), blocks, np.array([True, False]))
    assert field.largest_sd_mm is not None
    assert field.largest_sd_mm[0] == pytest.approx(0.5)
    assert np.isnan(field.largest_sd_mm[1])
    # also where two or all principal values are equal, or all but one vanish
    factors = np.random.default_rng(0).standard_normal((50, 3, 3)) * np.array([1.0, 0.1, 1e-4])
    some = np.concatenate([factors @ np.swapaxes(factors, 1, 2), [0.04 * np.eye(3), np.diag([0.0, 0.0, 0.09]), np.diag([0.25, 0.25, 0.0])]])
    known = DisplacementField(np.zeros((len(some), 3)), np.zeros((len(some), 3)), some, np.ones(len(some), dtype=bool))
    assert known.largest_sd_mm == pytest.approx(np.sqrt(np.linalg.eigvalsh(some)[:, -1]), rel=1e-7)


def test_a_field_without_covariance_is_not_an_exact_one() -> None:
    points = np.eye(3)
    assert DisplacementField.from_arrays(points, points).covariance is None
    assert DisplacementField.from_arrays(points, points).standard_deviation is None
    exact = DisplacementField.from_arrays(points, points, sd_mm=0.0)
    np.testing.assert_array_equal(exact.covariance, np.zeros((3, 3, 3)))
    some = DisplacementField.from_arrays(points, points, sd_mm=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(some.standard_deviation, np.tile([0.1, 0.2, 0.3], (3, 1)))


def test_nodes_without_data_stay_in_a_field_on_a_mesh() -> None:
    mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]], "tetra")
    vectors = affine(mesh.points)
    vectors[2] = np.nan
    field = DisplacementField.on_mesh(mesh, vectors, sd_mm=0.1)
    listed = field.at_points()
    np.testing.assert_array_equal(listed.points, mesh.points)
    np.testing.assert_array_equal(listed.valid, [True, True, False, True])
    assert listed.at_points() is listed


def test_what_does_not_fit_is_refused() -> None:
    grid = turned_grid()
    with pytest.raises(InputError, match=r"vectors must have shape \(3, 4, 5, 3\)"):
        DisplacementField.on_grid(grid, np.zeros((5, 4, 3, 3)))
    unknown = np.zeros((*SHAPE, 3))
    unknown[1, 2, 3] = np.nan
    with pytest.raises(InputError, match=r"vector \(1, 2, 3\) of the field"):
        DisplacementField.on_grid(grid, unknown, valid=np.ones(SHAPE, dtype=bool))
    with pytest.raises(InputError, match=r"covariance must have shape \(3, 4, 5, 3, 3\)"):
        DisplacementField.on_grid(grid, unknown, covariance=np.zeros((*SHAPE, 3)))
    with pytest.raises(InputError, match="has no grid"):
        _ = DisplacementField.from_arrays(np.eye(3), np.eye(3)).grid
    with pytest.raises(InputError, match="step must be"):
        DisplacementField.on_grid(grid, unknown).at_points(step=0)
    unknown_sd = np.where(np.arange(3)[:, None, None] == 1, np.nan, np.eye(3))
    with pytest.raises(InputError, match="not finite at 1 of 3 points, first at index 1; give it"):
        DisplacementField.from_arrays(np.eye(3), np.eye(3), covariance=unknown_sd)
    with pytest.raises(InputError, match="not positive semidefinite"):
        DisplacementField.from_arrays(np.eye(3), np.eye(3), covariance=np.tile(np.diag([1.0, -1.0, 1.0]), (3, 1, 1)))


def test_identification_takes_a_field_on_a_grid() -> None:
    mesh = Mesh.from_arrays([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]], [[0, 1, 2, 3]], "tetra")
    grid = Volume.from_array(np.zeros((3, 3, 3)), spacing_mm=(1.0, 1.0, 1.0))
    valid = np.ones((3, 3, 3), dtype=bool)
    valid[0, 0, 1] = False
    case = FieldLoadCase.of(
        "push", DisplacementField.on_grid(grid, affine(grid.positions()), valid=valid), mesh, loaded=[True, False, False, False]
    )
    assert len(case.field.points) == 26
    np.testing.assert_allclose(case.field.vectors, affine(case.field.points), atol=1e-12)
    nodal = nodal_field(DisplacementField.on_grid(grid, affine(grid.positions())), mesh)
    np.testing.assert_allclose(nodal.displacement[0], affine(mesh.points[0]), atol=1e-12)
