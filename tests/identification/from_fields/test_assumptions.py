"""What other assumptions would do to moduli, where data leave Poisson's ratio open."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.assumptions import Assumption, hangs_on_law, holds
from naibu.identification.from_fields.forward.field_laws import Stiffening, field_law
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.meshing.primitives import box


def test_near_incompressibility_a_change_is_one_of_the_compressibility() -> None:
    """A step of -45 in ln(kappa / mu), about 46 times the compressibility, made a modulus of 32 kPa one of 1e-19 and Poisson's ratio -1."""
    shear, ratio = 10.75, 1000.0
    theta = np.log([shear, ratio])
    young, poisson = young_and_poisson(Assumption("other", np.array([0.0, -45.0]), 0.0).applied(theta))
    bulk = shear * ratio / 46.0
    assert young[0] == pytest.approx(9.0 * bulk * shear / (3.0 * bulk + shear))
    assert poisson[0] == pytest.approx((3.0 * bulk - 2.0 * shear) / (6.0 * bulk + 2.0 * shear))


def test_what_would_be_less_compressible_than_nothing_is_incompressible() -> None:
    young, poisson = young_and_poisson(Assumption("other", np.array([np.log(1.1), 3.0]), 0.0).applied(np.log([2.0, 50.0])))
    assert young[0] == pytest.approx(3.0 * 2.2, rel=1e-6) and poisson[0] == pytest.approx(0.5, abs=1e-6)


def test_small_changes_are_those_of_the_logarithms() -> None:
    theta, change = np.log([3.0, 8.0]), np.array([1e-4, -2e-4])
    assert Assumption("other", change, 0.0).applied(theta) == pytest.approx(theta + change, abs=1e-7)


def test_rounding_does_not_take_a_unit_out_of_its_interval() -> None:
    assert holds(1.0, 1.0, 1.0 + 1e-15) and holds(1.0, 1.0, 1.0 - 1e-15)
    assert not holds(1.0, 2.0, 2.001) and not holds(1.0, 2.0, 0.999)


def test_a_law_that_stiffens_stores_the_energy_of_its_second_term() -> None:
    """Half of a stretched bar of two gels stiffens: its mean stress by the closed form, and the tangent by finite differences."""
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), centred=False)
    lame, shear, ratio = np.array([40.0, 70.0]), np.array([10.0, 20.0]), np.array([0.0, 0.8])
    law = Stiffening(mesh, averaged=True, ratio=ratio)
    plain = field_law(mesh, "neo_hookean", averaged=True)
    stretches = np.array([0.9, 1.05, 1.2])

    def energy(stretch: FloatArray) -> float:
        j = float(np.prod(stretch))
        return float(1000.0 * 0.5 * 0.8 * 20.0 * (float((stretch**2).sum()) * j ** (-2.0 / 3.0) - 3.0) ** 2)  # of the upper half

    u = mesh.points * (stretches - 1.0)
    more = law.forces(lame, shear, u) - plain.forces(lame, shear, u)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (energy(stretches + step) - energy(stretches - step)) / 2e-6
        assert (more * mesh.points)[:, axis].sum() == pytest.approx(slope, rel=1e-6)  # the work of a change of this stretch
    rng = np.random.default_rng(0)
    u, d = u + rng.normal(0.0, 0.2, u.shape), rng.normal(0.0, 1.0, u.shape)
    change = (law.forces(lame, shear, u + 1e-5 * d) - law.forces(lame, shear, u - 1e-5 * d)) / 2e-5
    np.testing.assert_allclose(law.stiffness(lame, shear, u) @ d.ravel(), change.ravel(), rtol=1e-5, atol=1e-4 * np.abs(change).max())


def test_moduli_that_stiffening_takes_out_of_their_intervals_hang_on_the_law() -> None:
    theta, within = np.log([3.0, 8.0]), np.array([[6.0, 10.0]])
    young = young_and_poisson(theta)[0][0]
    assert within[0, 0] < young < within[0, 1]
    for change, of_law, told in ((0.6, True, True), (0.6, False, False), (0.01, True, False)):
        one = Assumption("other", np.array([change, 0.0]), 0.0, of_law=of_law)
        assert bool(hangs_on_law((one,), theta, within)) == told
