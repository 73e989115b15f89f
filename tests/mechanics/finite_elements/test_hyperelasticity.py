"""Laws: against energies in principal stretches, finite differences, objectivity, isotropy and the linear limit."""

import numpy as np
import pytest
from builders import of, relative
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import (
    LAWS,
    Material,
    from_moduli,
    inverse_transpose,
    lame_parameters,
    law_named,
    material,
    parameter_table,
    parameter_vector,
    stress_and_tangent,
)
from naibu.validation.analytic.finite_strain import first_piola, principal_energy

NONLINEAR = [name for name in LAWS if name != "linear_elastic"]
SEED = st.integers(0, 2**32 - 1)
RATIO = st.sampled_from([-0.4, 0.0, 0.3, 0.45, 0.49, 0.4999])


def evaluate(m: Material, f: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Energy density, P (3, 3) and dP/dF (9, 9) of the compiled kernel."""
    g, stress, tangent = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 9))
    p = np.array([*m.parameters, 0.0, 0.0])[:4]
    j = inverse_transpose(f, g)
    energy = stress_and_tangent(m.law.code, p, f, g, j, np.empty(9), np.empty((3, 3)), stress, tangent, True)
    return energy, stress, tangent


def gradient(seed: int, *, isochoric: bool = False) -> np.ndarray:
    """A random deformation gradient with stretches within about [.4, 1.8], of volume ratio near 1 where `isochoric`."""
    rng = np.random.default_rng(seed)
    f = np.eye(3) + rng.uniform(-0.35, 0.35, (3, 3))
    f = Rotation.random(random_state=rng).as_matrix() @ f
    j = np.linalg.det(f)
    assume(j > 0.2)
    return f * ((1 + 1e-3 * rng.normal()) / j) ** (1 / 3) if isochoric else f


@pytest.mark.parametrize("law", LAWS)
@given(seed=SEED, nu=RATIO, isochoric=st.booleans())
@settings(max_examples=40, deadline=None)
def test_stress_and_energy_agree_with_principal_stretches(law, seed, nu, isochoric):
    m, f = of(law, nu), gradient(seed, isochoric=isochoric)
    energy, stress, _ = evaluate(m, f)
    scale = m.small_strain_bulk_modulus + m.small_strain_shear_modulus
    np.testing.assert_allclose(stress, first_piola(m, f), atol=1e-11 * scale * np.linalg.norm(f) ** 5, rtol=1e-10)
    if law != "linear_elastic":
        assert energy == pytest.approx(principal_energy(m, np.linalg.svd(f)[1]), rel=1e-9, abs=1e-11 * scale)


@pytest.mark.parametrize("law", LAWS)
@given(seed=SEED, nu=RATIO, isochoric=st.booleans())
@settings(max_examples=40, deadline=None)
def test_stress_is_derivative_of_energy_and_tangent_of_stress(law, seed, nu, isochoric):
    m, f, h = of(law, nu), gradient(seed, isochoric=isochoric), 1e-5
    _, stress, tangent = evaluate(m, f)
    slope, slopes = np.empty(9), np.empty((9, 9))
    for k in range(9):
        step = h * np.eye(9)[k].reshape(3, 3)
        (up, p_up, _), (down, p_down, _) = evaluate(m, f + step), evaluate(m, f - step)
        slope[k], slopes[:, k] = (up - down) / (2 * h), ((p_up - p_down) / (2 * h)).ravel()
    scale = np.abs(tangent).max()
    np.testing.assert_allclose(stress.ravel(), slope, atol=1e-7 * scale)
    np.testing.assert_allclose(tangent, slopes, atol=1e-7 * scale)
    np.testing.assert_allclose(tangent, tangent.T, atol=1e-12 * scale)


@pytest.mark.parametrize("law", NONLINEAR)
@given(seed=SEED)
@settings(max_examples=25, deadline=None)
def test_energy_is_objective_and_isotropic(law, seed):
    m, f = of(law), gradient(seed)
    turn = Rotation.random(random_state=np.random.default_rng(seed + 1)).as_matrix()
    energy, stress, _ = evaluate(m, f)
    for turned, expected in ((turn @ f, turn @ stress), (f @ turn, stress @ turn)):
        turned_energy, turned_stress, _ = evaluate(m, np.ascontiguousarray(turned))
        assert turned_energy == pytest.approx(energy, rel=1e-10)
        np.testing.assert_allclose(turned_stress, expected, atol=1e-10 * np.abs(stress).max())


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("nu", [-0.2, 0.3, 0.49, 0.4999])
def test_tangent_of_the_free_state_is_hookes_law(law, nu):
    energy, stress, tangent = evaluate(of(law, nu), np.eye(3))
    assert energy == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(stress, 0, atol=1e-12)
    young, one, delta = 20.0, np.eye(3), np.eye(9)
    swap = delta.reshape(3, 3, 3, 3).transpose(1, 0, 2, 3).reshape(9, 9)
    lam, mu = young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))
    assert relative(tangent, lam * np.outer(one.ravel(), one.ravel()) + mu * (delta + swap)) < 1e-12


@pytest.mark.parametrize("law", LAWS)
@given(mu=st.floats(1e-3, 1e4), ratio=st.floats(0.2, 1e4))
@settings(max_examples=25, deadline=None)
def test_moduli_survive_the_round_trip(law, mu, ratio):
    m = from_moduli(LAWS[law], mu, ratio * mu, (0.3, 0.05))
    assert m.small_strain_shear_modulus == pytest.approx(mu)
    assert m.small_strain_bulk_modulus == pytest.approx(ratio * mu)
    again = material(law, young_modulus=m.young_modulus, poisson_ratio=m.poisson_ratio, shape=(0.3, 0.05))
    assert again.parameters == pytest.approx(m.parameters, rel=1e-8, abs=1e-12 * ratio * mu)


@pytest.mark.parametrize("law", LAWS)
def test_stress_is_linear_in_the_parameters(law):
    f = np.array([[1.1, 0.2, -0.1], [0.0, 0.8, 0.3], [0.1, -0.2, 1.2]])
    one, two = of(law, 0.3, 10.0), of(law, 0.49, 35.0)
    both = Material(one.law, tuple(a + 2 * b for a, b in zip(one.parameters, two.parameters, strict=True)))
    np.testing.assert_allclose(evaluate(both, f)[1], evaluate(one, f)[1] + 2 * evaluate(two, f)[1], rtol=1e-10)


@pytest.mark.parametrize("law", LAWS)
def test_parameter_vector_is_linear_in_the_moduli(law):
    vectors = [np.array(parameter_vector(LAWS[law], *moduli, (0.3, 0.05))) for moduli in ((2, 9), (1, -4), (3, 5))]
    np.testing.assert_allclose(vectors[0] + vectors[1], vectors[2])


def test_lame_parameters_by_hand():
    assert lame_parameters(2.5, 0.25) == pytest.approx((1.0, 1.0))
    assert lame_parameters(5.0e3, 0.43) == pytest.approx((1.07e4, 1.75e3), rel=5e-3)  # Hirai et al. (2008), chapter 3


@pytest.mark.parametrize(
    ("young", "nu", "words"),
    [(0, 0.3, "positive"), (-1, 0.3, "positive"), (np.nan, 0.3, "positive"), (1, 0.5, "0.499"), (1, -1, "0.499"), (1, np.nan, "0.499")],
)
def test_bad_moduli_are_refused(young, nu, words):
    with pytest.raises(InputError, match=words):
        lame_parameters(young, nu)


@pytest.mark.parametrize(
    ("law", "parameters", "words"),
    [
        ("neo_hookean", (1.0,), "got 1 values"),
        ("yeoh", (1.0, 0.0, 0.0, np.nan), "finite"),
        ("mooney_rivlin", (-1.0, 0.5, 10.0), "shear modulus .* -1 kPa"),
        ("neo_hookean", (3.0, -2.0), "bulk modulus .* 0 kPa"),
    ],
)
def test_bad_parameters_are_refused(law, parameters, words):
    with pytest.raises(InputError, match=words):
        Material(LAWS[law], parameters)


def test_unknown_law_and_missing_material_are_named():
    with pytest.raises(InputError, match=r"'ogden'.*neo_hookean"):
        law_named("ogden")
    with pytest.raises(InputError, match="0 to 1, but 1 materials"):
        parameter_table([of("yeoh")], np.array([0, 1]))


def test_parameter_table_follows_the_regions():
    codes, values = parameter_table([of("yeoh"), of("neo_hookean")], np.array([1, 0, 1]))
    assert codes.tolist() == [LAWS["neo_hookean"].code, LAWS["yeoh"].code, LAWS["neo_hookean"].code]
    np.testing.assert_array_equal(values[1], of("yeoh").parameters)
    np.testing.assert_array_equal(values[2], [*of("neo_hookean").parameters, 0, 0])
