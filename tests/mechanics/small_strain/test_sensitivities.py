"""Derivatives of motions against finite differences, in every phase of a push, and a modulus found again from a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain.dynamics import simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import CellRheology, elastic, maxwell, three_element, voigt
from naibu.mechanics.small_strain.sensitivities import NAMES, MaterialChange, simulate_motion_with_derivatives
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.primitives import box
from naibu.meshing.structured_2d import rectangle

MATERIALS = {
    "elastic": elastic(10.0, 0.3),
    "voigt": voigt(10.0, 2.0, 0.3),
    "maxwell": maxwell(10.0, 6.0, 0.3),
    "three": three_element(10.0, 2.0, 6.0, 0.3, voigt_poisson_ratio=0.2, series_poisson_ratio=0.45),
}
PUSH = PrescribedMotion.through([0.0, 0.3, 0.6], [(0.0, 0.0), (0.0, -0.1), (0.05, -0.1)])


def set_up() -> tuple[LinearBody, list[Support], np.ndarray]:
    mesh = rectangle((2.0, 1.0), (2, 2))
    floor = Support("floor", np.flatnonzero(mesh.points[:, 1] == 0.0))
    plate = Support("plate", np.flatnonzero(mesh.points[:, 1] == 1.0)[:2], motion=PUSH, end_s=0.7)
    return LinearBody.of(mesh), [floor, plate], mesh.points[mesh.cells][:, :, 1].mean(axis=1) > 0.5


def changed(law: CellRheology, change: MaterialChange, amount: float) -> CellRheology:
    return CellRheology(law.elastic + amount * change.elastic, law.voigt + amount * change.voigt, law.series + amount * change.series)


@pytest.mark.parametrize("inertia", ["lumped", "consistent", "none"])
@pytest.mark.parametrize("name", MATERIALS)
def test_derivatives_are_those_of_finite_differences(name: str, inertia: str) -> None:
    """Of displacement and reaction, while pushed, at rest and released, of E, C1 and C2 in the upper half."""
    body, supports, upper = set_up()
    law = CellRheology.of(body.simplices.n_cells, MATERIALS[name])
    load = np.zeros(body.points.shape)
    load[-1] = [0.1, 0.0]
    directions = [MaterialChange.relative(law, parameter, upper) for parameter in NAMES]
    density, mass = (None, "lumped") if inertia == "none" else (0.5, inertia)
    times = np.linspace(0.0, 1.2, 13)
    series, found = simulate_motion_with_derivatives(body, law, density, supports, times, directions, step=0.04, mass=mass, load=load)
    same = simulate_motion(body, law, density, supports, times, step=0.04, mass=mass, load=load)
    assert series.displacement == pytest.approx(same.displacement, abs=1e-14)
    eps = 1e-4
    for i, direction in enumerate(directions):
        ends = [
            simulate_motion(body, changed(law, direction, sign * eps), density, supports, times, step=0.04, mass=mass, load=load)
            for sign in (1, -1)
        ]
        for field in ("displacement", "reaction"):
            expected = (getattr(ends[0], field) - getattr(ends[1], field)) / (2.0 * eps)
            assert getattr(found, field)[i] == pytest.approx(expected, abs=2e-6 * max(np.abs(getattr(series, field)).max(), 1.0)), field
    assert np.abs(found.displacement[0]).max() > 1e-3


def test_three_dimensions_and_forces() -> None:
    mesh = box((2.0, 2.0, 2.0), (2, 2, 2), cell_type="tetra")
    body, z = LinearBody.of(mesh), mesh.points[:, 2]
    plate = Support("plate", np.flatnonzero(z > 1.9), motion=PrescribedMotion.through([0.0, 1.0], [np.zeros(3), [0.0, 0.0, -0.2]]))
    supports = [Support("floor", np.flatnonzero(z < 0.1)), plate]
    law = CellRheology.of(mesh.n_cells, three_element(10.0, 2.0, 6.0, 0.4))
    directions = [MaterialChange.relative(law, parameter) for parameter in NAMES]
    series, found = simulate_motion_with_derivatives(body, law, None, supports, [0.0, 0.5, 1.0, 3.0], directions, step=0.1)
    total = found.force(plate).sum(axis=0)
    assert total[1:] == pytest.approx(series.force("plate")[1:], rel=1e-6)  # forces are of first degree in E, C1 and C2 together
    assert np.abs(found.displacement).max() < 1e-7  # and prescribed shapes of none


def test_any_parameter_by_differences_of_tables() -> None:
    """A Poisson ratio: its derivative is the difference of two motions."""
    body, supports, upper = set_up()

    def law_of(nu: float) -> CellRheology:
        return CellRheology.from_arrays(body.simplices.n_cells, 10.0, 2.0, np.where(upper, 6.0, np.inf), np.where(upper, nu, 0.3))

    direction = MaterialChange.between(law_of(0.4 - 1e-6), law_of(0.4 + 1e-6), 2e-6)
    times = np.linspace(0.0, 1.2, 7)
    _, found = simulate_motion_with_derivatives(body, law_of(0.4), 0.5, supports, times, [direction], step=0.04)
    ends = [simulate_motion(body, law_of(0.4 + e), 0.5, supports, times, step=0.04).displacement for e in (-1e-4, 1e-4)]
    assert found.displacement[0] == pytest.approx((ends[1] - ends[0]) / 2e-4, abs=1e-6)
    with pytest.raises(InputError, match="infinite in both tables"):
        MaterialChange.between(law_of(0.4), CellRheology.of(8, MATERIALS["three"]), 1.0)
    with pytest.raises(InputError, match="the same cells and a width"):
        MaterialChange.between(law_of(0.4), law_of(0.4), 0.0)


def test_a_modulus_is_found_again() -> None:
    """Gauss-Newton on a displacement history of another step finds E, C1 and C2 of the upper half."""
    body, supports, upper = set_up()
    truth = np.log([14.0, 1.5, 9.0])

    def law_of(parameters: np.ndarray) -> CellRheology:
        e, first, second = (np.where(upper, value, known) for value, known in zip(np.exp(parameters), (10.0, 2.0, 6.0), strict=True))
        return CellRheology.from_arrays(body.simplices.n_cells, e, first, second, 0.3)

    times = np.linspace(0.0, 2.0, 41)
    seen = simulate_motion(body, law_of(truth), 0.5, supports, times, step=0.005).displacement
    guess = np.log([10.0, 2.0, 6.0])
    for _ in range(8):
        law = law_of(guess)
        directions = [MaterialChange.relative(law, parameter, upper) for parameter in NAMES]
        series, slopes = simulate_motion_with_derivatives(body, law, 0.5, supports, times, directions, step=0.01)
        jacobian = slopes.displacement.reshape(3, -1).T
        guess = guess - np.linalg.lstsq(jacobian, (series.displacement - seen).ravel(), rcond=None)[0]
    assert guess == pytest.approx(truth, abs=0.01)


def test_bad_input_is_named() -> None:
    body, supports, upper = set_up()
    law = CellRheology.of(body.simplices.n_cells, MATERIALS["three"])
    with pytest.raises(InputError, match="not 'density'"):
        MaterialChange.relative(law, "density")
    with pytest.raises(InputError, match="mask of cells"):
        MaterialChange.relative(law, "young_modulus", upper[1:])
    with pytest.raises(InputError, match="one or more directions"):
        simulate_motion_with_derivatives(body, law, None, supports, [0.0, 1.0], [])
    moving = [supports[0], replace(supports[1], relative=True)]
    with pytest.raises(InputError, match="displacements from the reference configuration"):
        simulate_motion_with_derivatives(body, law, None, moving, [0.0, 1.0], [MaterialChange.relative(law, "young_modulus")])
