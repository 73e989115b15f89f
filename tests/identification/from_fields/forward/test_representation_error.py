"""Representation error: what no interpolated displacement can follow, and nothing that it can, however large the noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.representation_error import with_noise_of_neighbours, with_representation_error
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.primitives import box

EDGE_MM, CELLS, SD_MM = 4.0, (12, 6, 6), 0.01
SIZE_MM = tuple(EDGE_MM * n for n in CELLS)


def measured(
    vectors_at: Callable[[Mesh, FloatArray], FloatArray], *, sd_mm: float = SD_MM, stated_mm: float | None = SD_MM, seed: int = 0
) -> tuple[Mesh, FieldLoadCase]:
    """Return cubes of 4 mm and the measurement of a displacement at random points in them."""
    mesh = box(SIZE_MM, CELLS, centred=False)
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, SIZE_MM, (5000, 3))
    vectors = vectors_at(mesh, points) + sd_mm * rng.standard_normal(points.shape)
    field = DisplacementField.from_arrays(points, vectors, sd_mm=stated_mm)
    return mesh, FieldLoadCase.of("case", field, mesh, loaded=np.zeros(mesh.n_points, dtype=bool))


def smooth(mesh: Mesh, points: FloatArray) -> FloatArray:
    return np.asarray(
        interpolation_operator(mesh, points) @ (0.1 * np.sin(0.2 * mesh.points @ np.array([[1, 2, 0], [0, 1, 2], [2, 0, 1]])))
    )


def kinked(mesh: Mesh, points: FloatArray) -> FloatArray:
    """A strain that changes its sign in the middle of the cells from 8 to 12 mm along x."""
    return np.outer(0.3 * np.abs(points[:, 0] - 10.0), (1.0, 0.0, 0.0)) + smooth(mesh, points)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("times", [1.0, 3.0])
def test_noise_is_no_representation_error_even_where_it_is_understated(seed: int, times: float) -> None:
    mesh, load_case = measured(smooth, sd_mm=times * SD_MM, seed=seed)
    same, part = with_representation_error(mesh, load_case)
    assert part == 0.0 and same is load_case


def test_points_that_cells_cannot_follow_get_the_variance_of_what_is_left() -> None:
    """A kink in the middle of an interval leaves, by the best straight line in it, a standard deviation of slope h / sqrt(48) = 0.29 mm."""
    mesh, load_case = measured(kinked)
    more, part = with_representation_error(mesh, load_case)
    assert more.field.covariance is not None
    added = np.sqrt(np.maximum(more.field.covariance[:, 0, 0] - SD_MM**2, 0.0))
    away = np.abs(load_case.field.points[:, 0] - 10.0)
    assert 0.2 < part < 0.7 and added[away > 5.5 * EDGE_MM].max() == 0.0
    line = 0.3 * EDGE_MM / np.sqrt(48.0) / np.sqrt(3.0)  # a component of three, one of which has the kink
    inside = added[away < 0.5 * EDGE_MM]
    assert inside.min() > 0.3 * line and inside.max() < 2.0 * line
    np.testing.assert_array_equal(more.field.vectors, load_case.field.vectors)


def test_nothing_is_added_where_no_accuracy_is_stated() -> None:
    mesh, load_case = measured(kinked, stated_mm=None)
    same, part = with_representation_error(mesh, load_case)
    assert same is load_case and part == 0.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("times", [1.5, 3.0])
def test_noise_that_is_stated_too_small_is_raised_to_what_neighbours_show(seed: int, times: float) -> None:
    mesh, load_case = measured(smooth, sd_mm=times * SD_MM, seed=seed)
    more, factor = with_noise_of_neighbours(mesh, load_case)
    assert factor == pytest.approx(times, rel=0.08)
    assert more.field.covariance is not None
    np.testing.assert_allclose(more.field.covariance[:, 0, 0], (factor * SD_MM) ** 2)
    np.testing.assert_array_equal(more.field.vectors, load_case.field.vectors)


@pytest.mark.parametrize("times", [1.0, 0.7])
def test_noise_that_is_stated_right_or_too_large_stays(times: float) -> None:
    mesh, load_case = measured(smooth, sd_mm=times * SD_MM)
    same, factor = with_noise_of_neighbours(mesh, load_case)
    assert same is load_case and factor == 1.0


def test_noise_that_is_not_stated_is_that_of_neighbours() -> None:
    found, factor = with_noise_of_neighbours(*measured(smooth, sd_mm=2.0 * SD_MM, stated_mm=None))
    assert found.field.covariance is not None and np.isnan(factor)
    assert np.sqrt(found.field.covariance[:, 0, 0]) == pytest.approx(2.0 * SD_MM, rel=0.08)


def test_a_few_points_that_cells_cannot_follow_are_no_noise_of_all() -> None:
    """The kink takes a third of the cells and their neighbours; the median does not see it."""
    mesh, load_case = measured(kinked)
    assert with_noise_of_neighbours(mesh, load_case)[1] < 1.1
