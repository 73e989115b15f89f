"""The closed forms themselves: against textbook formulas, finite differences of energies, and equilibrium."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, Material, material
from naibu.validation.analytic.finite_strain import (
    ThickShell,
    confined,
    critical_pull,
    critical_slope,
    equibiaxial,
    first_piola,
    plate_penetration,
    principal_energy,
    principal_stress,
    self_weight_settlement,
    simple_shear,
    uniaxial,
)

SHAPES = {"mooney_rivlin": (0.3,), "yeoh": (0.2, 0.05)}
STRETCH = st.floats(0.5, 2.0)


def of(law: str, nu: float = 0.45) -> Material:
    return material(law, young_modulus=30.0, poisson_ratio=nu, shape=SHAPES.get(law, ()))


@pytest.mark.parametrize("law", LAWS)
@given(a=STRETCH, b=STRETCH, c=STRETCH)
@settings(max_examples=30, deadline=None)
def test_stress_is_the_derivative_of_energy(law, a, b, c):
    m, s, h = of(law), np.array([a, b, c]), 1e-5
    slope = [(principal_energy(m, s + h * e) - principal_energy(m, s - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(principal_stress(m, s), slope, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("stretch", [0.55, 0.9, 1.4])
@pytest.mark.parametrize("law", ["neo_hookean", "neo_hookean_isochoric", "mooney_rivlin", "yeoh"])
def test_incompressible_limits(law, stretch):
    """Treloar's formulas, to which all laws tend as nu -> 1/2."""
    m = of(law, 0.4999995)
    mu = m.small_strain_shear_modulus
    c10, c01 = (m.parameters[:2]) if law == "mooney_rivlin" else (0.5 * mu, 0.0)
    c20, c30 = m.parameters[1:3] if law == "yeoh" else (0.0, 0.0)

    def slope(i1):
        return c10 + 2 * c20 * (i1 - 3) + 3 * c30 * (i1 - 3) ** 2

    one = uniaxial(m, stretch)
    by_hand = 2 * (stretch - stretch**-2) * (slope(stretch**2 + 2 / stretch) + c01 / stretch)
    assert one.nominal_stress[2] == pytest.approx(by_hand, rel=2e-5)
    assert one.volume_ratio == pytest.approx(1, abs=1e-5)
    two = equibiaxial(m, stretch)
    by_hand = 2 * (stretch - stretch**-5) * (slope(2 * stretch**2 + stretch**-4) + c01 * stretch**2)
    assert two.nominal_stress[0] == pytest.approx(by_hand, rel=1e-3)
    shear = simple_shear(m, stretch)
    assert shear[0, 2] == pytest.approx(2 * stretch * (slope(3 + stretch**2) + c01), rel=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_small_strain_limits(law):
    m, e = of(law, 0.4), 1e-6
    one = uniaxial(m, 1 + e)
    assert one.nominal_stress[2] / e == pytest.approx(30.0, rel=1e-5)
    assert (1 - one.stretches[0]) / e == pytest.approx(0.4, rel=1e-5)
    assert one.nominal_stress[:2] == pytest.approx([0, 0], abs=1e-12)
    assert equibiaxial(m, 1 + e).nominal_stress[0] / e == pytest.approx(30 / 0.6, rel=1e-5)
    assert confined(m, 1 - e).nominal_stress[2] / -e == pytest.approx(30 * 0.6 / (1.4 * 0.2), rel=1e-5)
    assert simple_shear(m, e)[0, 2] / e == pytest.approx(30 / 2.8, rel=1e-5)


def test_saint_venant_kirchhoff_and_linear_by_hand():
    svk = uniaxial(of("saint_venant_kirchhoff", 0.3), 0.8)
    green = 0.5 * (0.64 - 1)
    assert svk.nominal_stress[2] == pytest.approx(0.8 * 30 * green)
    assert svk.stretches[0] == pytest.approx(np.sqrt(1 - 2 * 0.3 * green))
    linear = uniaxial(of("linear_elastic", 0.3), 0.8)
    assert linear.nominal_stress[2] == pytest.approx(-6.0)
    assert linear.stretches[0] == pytest.approx(1.06)


def test_true_stress_is_force_over_deformed_area():
    state = uniaxial(of("neo_hookean"), 0.7)
    assert state.true_stress[2] == pytest.approx(state.nominal_stress[2] / state.stretches[0] ** 2)


def test_first_piola_takes_stacks():
    m = of("yeoh")
    f = np.eye(3) + 0.2 * np.random.default_rng(0).normal(size=(4, 2, 3, 3))
    np.testing.assert_allclose(first_piola(m, f)[3, 1], first_piola(m, f[3, 1]), rtol=1e-12)


def test_states_that_do_not_exist_are_refused():
    with pytest.raises(InputError, match="positive"):
        confined(of("neo_hookean"), -0.1)
    with pytest.raises(InputError, match="no stress-free stretch"):
        uniaxial(of("saint_venant_kirchhoff", 0.49), 3.0)


@pytest.mark.parametrize(("kind", "dimension"), [("sphere", 3), ("cylinder", 2)])
def test_thick_shells_are_in_equilibrium_and_compatible(kind, dimension):
    shell = ThickShell(10, 25, 3, 0.5, 40, 0.4, kind)
    assert shell.radial_stress([10, 25]) == pytest.approx([-3, -0.5])
    r, h = np.linspace(11, 24, 7), 1e-4
    gradient = (shell.radial_stress(r + h) - shell.radial_stress(r - h)) / (2 * h)
    np.testing.assert_allclose(gradient + (dimension - 1) * (shell.radial_stress(r) - shell.hoop_stress(r)) / r, 0, atol=1e-7)
    radial = (shell.displacement(r + h) - shell.displacement(r - h)) / (2 * h)
    hoop = shell.displacement(r) / r
    lam, mu = 40 * 0.4 / (1.4 * 0.2), 40 / 2.8
    trace = radial + (dimension - 1) * hoop
    np.testing.assert_allclose(lam * trace + 2 * mu * radial, shell.radial_stress(r), atol=1e-6)
    np.testing.assert_allclose(lam * trace + 2 * mu * hoop, shell.hoop_stress(r), atol=1e-6)


def test_thick_shell_refuses_nonsense():
    with pytest.raises(InputError, match="inner radius"):
        ThickShell(10, 5, 1, 0, 40, 0.4)
    with pytest.raises(InputError, match="cube"):
        ThickShell(5, 10, 1, 0, 40, 0.4, "cube")


def test_column_settles_under_the_weight_above():
    column = {"column_mm": 50, "density": 1e-6, "gravity": 9810, "young_modulus": 10, "poisson_ratio": 0.3}
    z, h = np.array([0.0, 20.0, 50.0]), 1e-3
    modulus = 10 * 0.7 / (1.3 * 0.4)
    strain = (self_weight_settlement(z + h, **column) - self_weight_settlement(z - h, **column)) / (2 * h)
    np.testing.assert_allclose(modulus * strain, -1e-6 * 9810 * (50 - z), atol=1e-9)
    assert self_weight_settlement(0, **column) == 0


def test_coulomb_block():
    angle = critical_slope(0.4)
    assert np.sin(angle) == pytest.approx(critical_pull(np.cos(angle), 0.4))
    assert critical_pull(-1.0, 0.4) == 0


@pytest.mark.parametrize("pressure", [0.0, 3.0, 50.0, 100.0, 1000.0])
def test_penetration_inverts_the_contact_law(pressure):
    k, ramp = 2e4, 0.01
    g = plate_penetration(pressure, k, ramp)
    assert (0.5 * k * g * g / ramp if g < ramp else k * (g - 0.5 * ramp)) == pytest.approx(pressure)
