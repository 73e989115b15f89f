"""Mechanical model of a pressed breast: symmetry, volume, weight, and a breast pressed by other elements and another law."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.mammography.breast_from_projections import breast_in_projections
from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline
from naibu.applications.mammography.breast_shape import half_ellipsoid_shape
from naibu.applications.mammography.mechanical_model import MechanicalParameters, mechanically_compressed
from naibu.applications.mammography.pair_construction import mammographic_pair, pair_of_shape
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.meshing.quality import signed_volumes
from naibu.meshing.surface import boundary_faces, level_extents
from naibu.validation.specimens.half_ball_mesh import unstructured_half_ball
from naibu.validation.specimens.virtual_breasts import PressedBreast, VirtualBreast, breast_points, press_breast, random_breast

SHAPE = half_ellipsoid_shape((120.0, 120.0, 80.0))
POINTS = np.array([[20.0, 10.0, 30.0], [-15.0, 25.0, 20.0], [5.0, -20.0, 50.0]])


def test_without_weight_the_map_is_symmetric_invertible_and_keeps_the_volume_nearly() -> None:
    state = mechanically_compressed(SHAPE, 0.0, 60.0, MechanicalParameters(density=0.0, poisson_ratio=0.49))
    pressed = state.compress(POINTS)
    np.testing.assert_allclose(state.compress(POINTS * [-1, 1, 1]), pressed * [-1, 1, 1], atol=0.3)
    np.testing.assert_allclose(state.compress(POINTS * [1, -1, 1]), pressed * [1, -1, 1], atol=0.3)
    np.testing.assert_allclose(state.uncompress(pressed), POINTS, atol=1e-6)
    assert np.abs(state.compress(state.mesh.points)[:, 1]).max() < 30.5
    deformed = state.mesh.moved(state.displacement)
    assert signed_volumes(deformed).sum() == pytest.approx(signed_volumes(state.mesh).sum(), rel=0.03)


def test_the_weight_of_a_breast_between_distant_plates_lowers_it() -> None:
    light, heavy = (mechanically_compressed(SHAPE, 90.0, 105.0, MechanicalParameters(density=d)) for d in (0.0, 1e-6))
    # in a lateral view upwards is along the chest wall
    lower = heavy.compress(POINTS)[:, 0] - light.compress(POINTS)[:, 0]
    assert np.all(lower < -1.0)


def outlines(pressed: PressedBreast) -> tuple[BreastOutline, BreastOutline]:
    return breast_outline(pressed.outlines[0]), breast_outline(pressed.outlines[1])


@pytest.fixture(scope="module")
def virtual() -> tuple[VirtualBreast, PressedBreast]:
    breast = random_breast(1)
    return breast, press_breast(breast, count=14, cell=0.25)


@pytest.mark.parametrize("model", ["geometric", "mechanical"])
def test_points_of_a_virtual_breast_lie_near_their_curves(virtual: tuple[VirtualBreast, PressedBreast], model: str) -> None:
    breast, pressed = virtual
    both = outlines(pressed)
    pair = mammographic_pair(*both, breast.stated_thickness_mm, breast.stated_angle_deg, model=model, draws=20)  # type: ignore[arg-type]
    distances: list[float] = []
    errors: list[FloatArray] = []
    for truth, cc, mlo in zip(pressed.points, *pressed.places, strict=True):
        if min(cc[0], mlo[0]) < 0.0:
            continue
        places = both[0].from_image(cc), both[1].from_image(mlo)
        distances.append(pair.epipolar_curve(places[0]).distance(places[1]))
        errors.append(pair.lesion(*places).position - truth)
    assert len(distances) > 9
    assert np.mean(distances) < 2.2
    assert np.linalg.norm(errors, axis=1).mean() < 8.0


def test_points_of_a_scan_lie_near_their_true_places_with_and_without_the_outlines(virtual: tuple[VirtualBreast, PressedBreast]) -> None:
    # the shape is that of two projections of the unloaded breast, which sags away from its own nipple when it is pressed
    breast, pressed = virtual
    unit = unstructured_half_ball(0.15)
    points, faces = breast_points(breast, unit.points), boundary_faces(unit).faces
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    depths = breast.depth_mm * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, 60))
    projections = []
    for axis in (0, 1):
        low, high = level_extents(points[edges[:, 0]][:, [2, axis]], points[edges[:, 1]][:, [2, axis]], depths)
        projections.append(breast_outline(np.vstack([np.column_stack([depths, low]), np.column_stack([depths, high])[::-1]])))
    shape, both = breast_in_projections(projections[0], projections[1]).shape, outlines(pressed)
    seen = np.all(pressed.places[:, :, 0] > 0.0, axis=0)
    errors = []
    for constrained in (False, True):
        pair = pair_of_shape(
            shape, breast.stated_thickness_mm, breast.stated_angle_deg, outlines=both, constrain_outlines=constrained, model="mechanical",
            draws=20,
        )  # fmt: skip
        found = np.array([pair.project(point).places for point in pressed.points[seen]])
        truth = np.stack([both[k].from_image(pressed.places[k, seen]) for k in (0, 1)], axis=1)
        errors.append(np.linalg.norm(found - truth, axis=2).mean(axis=0))
    assert np.all(np.array(errors) < 3.5)


@pytest.mark.parametrize(
    ("values", "told"), [({"tissue_kpa": 0.0}, "tissue_kpa"), ({"poisson_ratio": 0.5}, "poisson_ratio"), ({"friction": -1.0}, "friction")]
)
def test_parameters_that_cannot_be_are_refused(values: dict[str, float], told: str) -> None:
    with pytest.raises(InputError, match=told):
        MechanicalParameters(**values)


def test_plates_that_do_not_press_are_refused() -> None:
    with pytest.raises(InputError, match="thickness_mm is 200"):
        mechanically_compressed(SHAPE, 0.0, 200.0)
