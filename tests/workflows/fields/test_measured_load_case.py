"""Fields that cannot tell moduli are refused in words that say what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.io import write_volume
from naibu.workflows.fields.block_mesh import block_mesh
from naibu.workflows.fields.identify_fields import identify_fields
from naibu.workflows.fields.measured_load_case import (
    beyond_object,
    beyond_rim,
    doubts_of_field,
    measured_load_case,
    placed_on_scan,
    without_copies,
)

SIDE_MM = 40.0
INSIDE = Volume.from_array(np.ones((20, 20, 20), np.uint8), spacing_mm=(2.0,) * 3, origin_mm=(1.0,) * 3)
POINTS = np.random.default_rng(0).uniform(1.0, SIDE_MM - 1.0, (300, 3))


def case(points: FloatArray, vectors: FloatArray | None = None) -> FieldLoadCase:
    """Return the load case of points that are sheared, if nothing else is given, in a cube of 5 x 5 x 5 cells."""
    moved = 0.05 * points[:, [2, 0, 1]] if vectors is None else vectors
    mesh, cells = block_mesh(INSIDE, np.ones(INSIDE.shape, np.int64), {1: "gel"}, 8.0)
    return measured_load_case(mesh, cells, INSIDE, DisplacementField.from_arrays(points, moved), "push")


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("thickness", [0.0, 0.01])
def test_points_in_a_plane_are_refused(turned: bool, thickness: float) -> None:
    u, v = POINTS[:, 0] - 20.0, POINTS[:, 1] - 20.0
    across = np.array([0.0, 0.6, 0.8]) if turned else np.array([0.0, 0.0, 1.0])
    other = np.cross(across, [1.0, 0.0, 0.0])
    flat = 20.0 + 0.6 * (u[:, None] * [1.0, 0.0, 0.0] + v[:, None] * other) + thickness * POINTS[:, 2:] * across
    with pytest.raises(InputError, match=r"span only .* three dimensions"):
        case(flat)


@pytest.mark.parametrize("points", [np.full((300, 3), 7.0), 20.0 + (POINTS - 20.0) * [1.0, 0.0, 0.0], 0.001 * POINTS + 1.0])
def test_points_at_a_place_and_lengths_in_metres_are_refused(points: FloatArray) -> None:
    with pytest.raises(InputError, match=r"are they in mm\?"):
        case(points)


def test_where_field_and_object_are_is_told() -> None:
    with pytest.raises(InputError, match=r"0 measurements.*20 are needed.*x 1007 to 3.881e\+04.*x 0 to 40.*one reference scan"):
        case(1000.0 * POINTS)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (1000.0 * POINTS, r"100 % of the points would lie in it if they were in um; give `unit` um\."),
        (POINTS * [-1.0, -1.0, 1.0], "in RAS; change the signs of x, y, ux and uy"),
        (POINTS[:, [0, 2, 1]] * [1.0, 1.0, -1.0], "with y upwards; take x, -z, y and ux, -uz, uy"),
        (POINTS + 500.0, r"reference scan\?$"),
    ],
)
def test_the_unit_or_frame_in_which_a_field_would_lie_in_the_object_is_named(points: FloatArray, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        case(points)


def test_of_few_points_in_the_object_no_other_frame_is_named() -> None:
    with pytest.raises(InputError, match=r"19 measurements of the field lie in the object, 20 are needed.*one reference scan\?$"):
        case(POINTS[:19])


def test_voxels_are_counted_in_the_scan_that_labels_lie_on() -> None:
    axes = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # voxels along x go to posterior, along y to the right
    scan = Volume.from_array(INSIDE.values, spacing_mm=(2.0, 3.0, 4.0), origin_mm=(-100.0, 50.0, -300.0), direction=axes)
    size = np.array([2.0, 3.0, 4.0])
    field = DisplacementField.from_arrays([[5.0, 6.0, 7.0]] * size, [[1.0, 0.0, 0.5]] * size, sd_mm=[[0.1, 0.2, 0.3]])
    placed = placed_on_scan(field, size.tolist(), scan)
    np.testing.assert_allclose(placed.points, [[-118.0, 60.0, -272.0]])
    np.testing.assert_allclose(placed.vectors, [[0.0, 2.0, 2.0]])
    np.testing.assert_allclose(placed.standard_deviation, [[0.2, 0.1, 0.3]])
    assert placed_on_scan(field, (2.0, 3.0, 3.9), scan) is field  # labels on other voxels say nothing of those of the field


def test_a_field_without_displacements_is_refused_as_such() -> None:
    field = DisplacementField.from_arrays(POINTS, np.full_like(POINTS, np.nan))
    mesh, cells = block_mesh(INSIDE, np.ones(INSIDE.shape, np.int64), {1: "gel"}, 8.0)
    with pytest.raises(InputError, match="none of its 300 points has a displacement"):
        measured_load_case(mesh, cells, INSIDE, field, "push")


@pytest.mark.parametrize(("kept", "told"), [(1.0, ""), (0.9, ""), (0.7, "30 % of its points lie outside of the object")])
def test_a_mask_that_shows_a_part_of_what_was_measured_is_told(kept: float, told: str) -> None:
    x = np.repeat(np.linspace(1.0, SIDE_MM - 1.0, 20), 10)
    points = np.column_stack([x, *np.random.default_rng(1).uniform(1.0, SIDE_MM - 1.0, (2, 200))])
    cropped = Volume.from_array(np.ones((20, 20, round(20 * kept)), np.uint8), spacing_mm=(2.0,) * 3, origin_mm=(1.0,) * 3)
    words = " ".join(beyond_object("push", DisplacementField.from_arrays(points, 0.1 * points), cropped))
    assert (told in words) if told else not words


def test_copies_of_a_measurement_count_once() -> None:
    points, again = np.concatenate([POINTS, POINTS[:100]]), 0.05 * np.concatenate([POINTS, POINTS[:100]])
    otherwise = np.concatenate([0.05 * POINTS, 0.06 * POINTS[:100]])
    given = ((POINTS, 0.05 * POINTS), (points, again), (points, otherwise))
    once, twice, contradicting = (without_copies(DisplacementField.from_arrays(p, u, sd_mm=0.1)) for p, u in given)
    assert once.covariance is not None and twice.covariance is not None
    assert np.array_equal(once.points, twice.points) and np.array_equal(once.vectors, twice.vectors)
    assert np.array_equal(once.covariance, twice.covariance) and len(contradicting.points) == 400


def test_copies_of_measurements_do_not_make_cells_smaller(tmp_path: Path) -> None:
    """A file with every particle ten times gets the cells, and the moduli, of one with every particle once."""
    labels = np.repeat([1, 2], 8000).reshape(40, 20, 20).astype(np.uint8)
    write_volume(tmp_path / "labels.mha", Volume.from_array(labels, spacing_mm=(1.0,) * 3))
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.4, 19.4, (300, 3)) * [1.0, 1.0, 2.0]
    vectors = 0.02 * points * [0.4, 0.4, -1.0] + 0.01 * rng.standard_normal(points.shape)
    cells = []
    for name, times in (("once", 1), ("often", 10)):
        table = np.tile(np.column_stack([points, vectors, np.full_like(points, 0.01)]), (times, 1))
        columns = "x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,sd_x_mm,sd_y_mm,sd_z_mm"
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header=columns, comments="")
        scanned = identify_fields(tmp_path / f"{name}.csv", zones=tmp_path / "labels.mha", known=["label 1=5 kPa, 0.4"], law="linear")
        cells.append((scanned.estimate.mesh.n_cells, *scanned.estimate.theta))
    assert cells[0] == cells[1]


@pytest.mark.parametrize(("strain", "told"), [(0.05, False), (2e-3, False), (5e-5, True)])
def test_displacements_in_metres_are_doubted_but_small_strain_is_identified(strain: float, told: bool) -> None:
    """A shear of 5 % whose vectors are in metres is one of 5e-5 in mm, which waves in tissue may have as well: it is no error."""
    some = case(POINTS, strain * POINTS[:, [2, 0, 1]])
    assert [("in metres?" in line) for line in doubts_of_field(some.name, some.field)] == [True] * told


def test_a_deformation_below_its_stated_noise_is_doubted() -> None:
    """Standard deviations of .1 mm beside a shear of up to 2 mm, and beside the same in metres."""
    for factor, told in ((1.0, False), (1e-3, True)):
        field = DisplacementField.from_arrays(POINTS, factor * 0.05 * POINTS[:, [2, 0, 1]], sd_mm=0.1)
        assert any("less than the stated standard deviation" in line for line in doubts_of_field("push", field)) == told


@pytest.mark.parametrize(("zeros", "told"), [(4, False), (40, True)])
def test_points_that_were_not_measured_are_doubted_where_they_are_zero(zeros: int, told: bool) -> None:
    vectors = 0.05 * POINTS[:, [2, 0, 1]] + 0.01
    vectors[:zeros] = 0.0
    lines = doubts_of_field("push", DisplacementField.from_arrays(POINTS, vectors))
    assert any(f"displacement of {zeros} of 300 points in the object is exactly zero" in line for line in lines) == told


@pytest.mark.parametrize("size_mm", [(1.0, 1.0, 1.0), (1.0, 1.0, 2.0)])
def test_a_mask_smaller_than_the_object_is_told_by_the_points_around_it(size_mm: tuple[float, float, float]) -> None:
    """Points that fill a ball, and masks of balls: the right one, and some that leave out a shell."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-20.0, 20.0, (20_000, 3))
    points = points[np.linalg.norm(points, axis=1) < 20.0]
    field = DisplacementField.from_arrays(points, 0.1 * points)
    axes = [np.arange(-24.0, 24.1, step) for step in size_mm]
    radius = np.sqrt(axes[2][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[0] ** 2)
    told = [
        beyond_rim("push", field, Volume.from_array((radius < r).astype(np.uint8), spacing_mm=size_mm, origin_mm=(-24.0,) * 3))
        for r in (20.5, 20.0, 18.9, 10.0)
    ]
    assert told[0] == told[1] == () and told[3] == ()  # far outside of the last one, another sentence is told
    thickness = float(told[2][0].split("a rim of ")[1].split(" mm")[0])
    assert 0.6 < thickness < 1.2  # faces of voxels are half as large again as a ball, and a shell is larger than its inner side
