"""What other assumptions would do to moduli, where data leave Poisson's ratio open."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.identification.from_fields.assumptions.other_assumptions import Assumption, holds
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson


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
