"""Presses of a fingertip against equilibrium, similarity, symmetry and theories of soft contact."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.fingertip.contact_theories import hertz_force, hertz_radius, parallel_springs_force, power_law
from naibu.applications.fingertip.fingertip import GEL, PACKAGE, Fingertip, FingertipResolution, fingertip_mesh
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing, estimated_depth, rotated_loads
from naibu.core.errors import InputError
from naibu.meshing.quality import signed_volumes

COARSE = FingertipResolution(2, 2, 8)


def test_the_mesh_has_the_volumes_of_half_a_hemisphere_and_of_the_package() -> None:
    tip = Fingertip(package_diameter_mm=1.0, package_height_mm=0.4)
    mesh = fingertip_mesh(tip, FingertipResolution(6, 5, 16))
    volume = signed_volumes(mesh)
    package = np.pi / 3.0 * 0.5 * 0.5 * 0.4
    assert volume[mesh.regions == PACKAGE].sum() == pytest.approx(package, rel=0.05)
    assert volume[mesh.regions == GEL].sum() == pytest.approx(np.pi / 3.0 * 1000.0 - package, rel=0.02)


def test_without_friction_the_force_is_along_the_rod_and_balances_the_base(tilted: Pressing) -> None:
    force, axis = tilted.force_mn[-1], tilted.press.axis
    assert tilted.along_rod_mn[-1] == pytest.approx(tilted.press.force_mn, rel=0.01)
    assert np.linalg.norm(force + tilted.along_rod_mn[-1] * axis) < 1e-3 * tilted.along_rod_mn[-1]


def test_the_chip_is_pressed_down_and_turned_by_the_lateral_force(tilted: Pressing) -> None:
    assert tilted.chip_mn[-1, 2] > 0.0 and tilted.chip_mn[-1, 0] < 0.0 and tilted.chip_mn_mm[-1, 1] < 0.0
    assert (tilted.chip_mn[:, 1] == 0.0).all() and (tilted.chip_mn_mm[:, [0, 2]] == 0.0).all()
    # a small share of the load: that of its area, within a small factor
    share = tilted.chip_mn[-1, 2] / -tilted.force_mn[-1, 2]
    assert 1.0 < share / (0.45 / 10.0) ** 2 < 5.0


def test_forces_are_in_proportion_to_the_modulus(coarse: FingertipModel, tilted: Pressing) -> None:
    softer = FingertipModel.of(Fingertip(young_modulus_kpa=176.0), COARSE).pressed(Press(20.0, 1600.0, friction=0.0))
    scaled = tilted.for_modulus(176.0)
    assert scaled.along_rod_mn[-1] == pytest.approx(0.8 * tilted.along_rod_mn[-1])
    at = np.array([400.0, 1500.0])
    assert scaled.at_force(at) == pytest.approx(softer.at_force(at), rel=3e-3, abs=1e-3)


def test_small_presses_approach_hertz_and_large_ones_are_stiffer() -> None:
    tip = Fingertip()
    pressing = FingertipModel.of(tip, FingertipResolution(4, 2, 10)).pressed(Press(0.0, 2500.0, friction=0.0))
    depth, force = pressing.depth_mm, pressing.along_rod_mn
    early = int(np.argmin(np.abs(depth - 0.6)))
    assert force[early] == pytest.approx(hertz_force(tip, depth[early : early + 1])[0], rel=0.15)
    assert force[-1] > 1.2 * hertz_force(tip, depth[-1:])[0] > parallel_springs_force(tip, depth[-1:])[0]
    loaded = force > 300.0
    _, gamma = power_law(force[loaded], pressing.contact_radius_mm[loaded])
    assert 0.25 < gamma < 0.40
    assert pressing.contact_radius_mm[-1] == pytest.approx(hertz_radius(tip, force[-1:])[0], rel=0.1)


def test_the_estimated_depth_is_hertz_for_small_forces() -> None:
    tip = Fingertip()
    assert hertz_force(tip, np.array([estimated_depth(tip, 0.5)]))[0] == pytest.approx(0.5, rel=0.02)


def test_parallel_springs_are_the_sum_of_their_springs() -> None:
    # independent columns of the hemisphere, each compressed by what the plane takes off it, over its length
    tip, depth = Fingertip(), 1.5
    radius = np.linspace(0.0, np.sqrt(10.0**2 - 8.5**2), 20_001)
    column = np.sqrt(10.0**2 - radius**2)
    wanted = np.trapezoid(220.0 * (column - 8.5) / column * 2.0 * np.pi * radius, radius)
    assert parallel_springs_force(tip, np.array([depth]))[0] == pytest.approx(wanted, rel=1e-5)


def test_a_turned_finger_reads_turned_loads() -> None:
    loads = np.array([[-3.0, 0.0, 5.0, 0.0, -2.0, 0.0]])
    assert rotated_loads(loads, 90.0)[0] == pytest.approx([0.0, -3.0, 5.0, 2.0, 0.0, 0.0])
    assert rotated_loads(rotated_loads(loads, 50.0), -50.0)[0] == pytest.approx(loads[0])


def test_force_over_depth_of_a_power_law_is_found() -> None:
    force = np.array([100.0, 500.0, 2000.0])
    c, gamma = power_law(force, 0.7 * force**0.28)
    assert (c, gamma) == pytest.approx((0.7, 0.28))
    with pytest.raises(InputError, match="at least two positive forces"):
        power_law(force[:1], force[:1])


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ({"diameter_mm": -1.0}, "diameter_mm"),
        ({"diameter_mm": 20_000.0}, "no fingertip is larger than 1000 mm"),
        ({"package_height_mm": 9.0}, "package_height_mm is 9, too much for a fingertip of diameter_mm = 20"),
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"law": "hooke"}, "law 'hooke' is not known"),
        ({"young_modulus_kpa": 1e5}, "less than 20 times that of the gel"),
    ],
)
def test_impossible_fingertips_are_refused(arguments: dict[str, float], what: str) -> None:
    with pytest.raises(InputError, match=what):
        Fingertip(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(("arguments", "what"), [((50.0, 1.0), "tilt_deg"), ((0.0, -1.0), "force_mn"), ((0.0, 1.0, -0.1), "friction")])
def test_impossible_presses_are_refused(arguments: tuple[float, ...], what: str) -> None:
    with pytest.raises(InputError, match=what):
        Press(*arguments)


def test_a_force_beyond_the_fingertip_is_refused() -> None:
    with pytest.raises(InputError, match="45 % of the radius, the rod has reached"):
        FingertipModel.of(Fingertip(), FingertipResolution(2, 1, 4)).pressed(Press(0.0, 1e6))
