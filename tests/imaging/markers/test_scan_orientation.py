"""The vertical of an object is found in tilted scans: of measured gels, which lay flat in the scanner, and of exact deformations."""

from __future__ import annotations

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.imaging.markers.scan_orientation import found_orientation, stated_orientation, turned_to_fit

TILTS = ((0.0, 0.0, 0.0), (0.35, -0.2, 0.1), (-0.1, 0.7, -0.3))
CUBES = ("ct_cube_plate", "ct_two_material_1", "ct_two_material_3")


def between_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(min(1.0, abs(float(a @ b))))))


@pytest.mark.parametrize("name", CUBES)
@pytest.mark.parametrize("tilt", TILTS)
def test_measured_gels_stand_upright_again(name: str, tilt: tuple[float, float, float]) -> None:
    gel, turn = datasets.load(name), rotation_matrix(np.array(tilt))
    free = gel.initial.aligned(gel.initial.ids)
    loaded = [s.markers.aligned(gel.initial.ids) for s in gel.loaded_states if s.markers is not None]
    up = turn @ [0.0, 0.0, 1.0]  # the gels lay flat in the scanner
    lattice = found_orientation(free @ turn.T, [state @ turn.T for state in loaded], gel.nominal_spacing_mm)
    pressed = found_orientation(free @ turn.T, [state @ turn.T for state in loaded])
    assert lattice.source == "marker lattice" and between_deg(lattice.vertical, up) < 1.0
    assert pressed.source == "direction of compression" and between_deg(pressed.vertical, up) < 1.5
    for found in (lattice, pressed):
        assert np.allclose(found.rotation @ found.rotation.T, np.eye(3)) and np.linalg.det(found.rotation) > 0.0
        assert between_deg(found.vertical, up) < 3.0 * found.sd_deg + 0.2


def test_the_direction_of_an_exact_compression_is_exact_whatever_the_motion_of_the_scan() -> None:
    points = np.random.default_rng(3).uniform(-30, 30, (60, 3))
    turn, other = rotation_matrix(np.array([0.4, 0.5, 0.2])), rotation_matrix(np.array([1.0, -2.0, 0.3]))
    pressed = points * [1.1, 1.05, 0.8]
    found = found_orientation(points @ turn.T, [pressed @ (other @ turn).T + [5.0, -80.0, 3.0]])
    assert between_deg(found.vertical, turn[:, 2]) < 1e-5 and found.sd_deg < 1e-5
    assert found.tilt_deg == pytest.approx(np.degrees(np.arccos(turn[2, 2])))


def test_what_cannot_be_known_is_refused() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-30, 30, (60, 3))
    with pytest.raises(InputError, match="standard error"):  # moved by noise alone
        found_orientation(points, [points + rng.normal(0.0, 0.3, points.shape)])
    with pytest.raises(InputError, match="too few markers"):
        found_orientation(points[:7], [points[:7] * [1.0, 1.0, 0.8]])
    with pytest.raises(InputError, match="either end may be up"):
        found_orientation(points, [points * [1.1, 0.8, 1.1]])
    for nothing in ((0.0, 0.0, 0.0), (1.0, 2.0), (np.nan, 0.0, 1.0)):
        with pytest.raises(InputError, match="three numbers"):
            stated_orientation(nothing)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -2.0), (1.0, 0.0, 0.0), (0.1, -0.4, 0.9)])
def test_a_stated_direction_becomes_the_vertical_by_the_smallest_rotation(up: tuple[float, float, float]) -> None:
    found, unit = stated_orientation(up), np.array(up) / np.linalg.norm(up)
    assert np.allclose(found.rotation @ unit, [0.0, 0.0, 1.0]) and np.linalg.det(found.rotation) == pytest.approx(1.0)
    angle = np.arccos(np.clip((np.trace(found.rotation) - 1.0) / 2.0, -1.0, 1.0))
    assert angle == pytest.approx(np.arccos(unit[2]))  # Rodrigues: no turn about the vertical is added


def test_an_object_is_turned_about_its_vertical_until_it_fits() -> None:
    corners = np.array([[x, y, z] for x in (-30, 30) for y in (-10, 10) for z in (0, 20)], dtype=float)
    turn = rotation_matrix(np.array([0.0, 0.0, np.radians(25.0)]))
    upright = stated_orientation((0.0, 0.0, 1.0))
    found = turned_to_fit(upright, corners @ turn.T, (60.0, 20.0, 20.0))
    assert np.ptp(corners @ turn.T @ found.rotation.T, axis=0) == pytest.approx([60.0, 20.0, 20.0], rel=0.012)
    assert "about the vertical" in found.source
    assert turned_to_fit(upright, corners @ turn.T, (70.0, 50.0, 20.0)).rotation == pytest.approx(np.eye(3))
    assert turned_to_fit(upright, corners, (40.0, 20.0, 20.0)).rotation == pytest.approx(np.eye(3))  # nothing fits: left as it is
