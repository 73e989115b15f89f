"""Bodies of quadratic hexahedra with inclusions, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.validation.specimens.quadratic_body import SIDE_MM, UNKNOWN, Inclusion, QuadraticBody, Solved

MIDDLE = 0.5 * SIDE_MM


def strain_in_the_middle(solved: Solved) -> FloatArray:
    """Return the strains xx, yy, zz between points 2 mm apart."""
    step = np.concatenate([np.eye(3), -np.eye(3)])
    points, u = solved.at((MIDDLE + step) / SIDE_MM)
    np.testing.assert_allclose(points, MIDDLE + step, atol=1e-9)
    return np.asarray(np.diag(u[:3] - u[3:]) / 2.0)


@pytest.mark.parametrize("contrast", [0.3, 4.0])
def test_the_strain_in_a_sphere_is_that_of_eshelby(contrast: float) -> None:
    """In a sphere of other moduli the strain is uniform (Eshelby 1957); plates are three of its radii away."""
    young, nu = UNKNOWN
    plain = strain_in_the_middle(QuadraticBody("cube", known=UNKNOWN).solved((0.0, 0.0, -1.0), divisions=8))
    sphere = Inclusion((MIDDLE, MIDDLE, MIDDLE), 6.5, contrast * young, nu)
    found = strain_in_the_middle(QuadraticBody("cube", known=UNKNOWN, inclusions=(sphere,)).solved((0.0, 0.0, -1.0), divisions=8))
    of_volume, of_shape = (1.0 + nu) / (3.0 * (1.0 - nu)), 2.0 * (4.0 - 5.0 * nu) / (15.0 * (1.0 - nu))
    mean = plain.mean()
    expected = mean / (1.0 + of_volume * (contrast - 1.0)) + (plain - mean) / (1.0 + of_shape * (contrast - 1.0))
    np.testing.assert_allclose(found, expected, rtol=0.12)
    assert abs(found[2] / plain[2] - 1.0) > 0.3
