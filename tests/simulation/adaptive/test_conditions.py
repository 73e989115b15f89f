"""Supports along one axis, in all models."""

import numpy as np
import pytest

from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.small_strain.rheology import voigt
from naibu.meshing.primitives import box
from naibu.simulation.adaptive.body import AdaptiveBody
from naibu.simulation.adaptive.conditions import Conditions, weight
from naibu.simulation.adaptive.hyperelastic_dynamics import HyperelasticDynamics
from naibu.simulation.adaptive.lattice import AdaptiveLattice, SpringMaterial
from naibu.simulation.adaptive.linear_dynamics import LinearDynamics

GRAVITY = (weight((0.0, 0.0, -9810.0)),)


def bar(n):
    return box((10.0 * n, 10, 10), (n, 1, 1), cell_type="tetra", centred=False)


def moved(name, points):
    """Return the displacement under its weight of a bar that is fixed below and stands on rollers at x = 0."""
    conditions = Conditions(lambda p: p[:, 2] < 1e-9, loads=GRAVITY, rollers=((lambda p: p[:, 0] < 1e-9, 0),))
    if name == "lattice":
        lattice = AdaptiveLattice.of(bar(2), SpringMaterial(5.0, 1e-6), conditions, None, step=1e-3)
        lattice.step(steps=30)
        return lattice.positions() - bar(2).points
    law = (material("linear_elastic", young_modulus=5.0, poisson_ratio=0.3),)
    dynamics = (
        LinearDynamics(voigt(5.0, 0.05, 0.3), 1e-6, 1e-3) if name == "linear" else HyperelasticDynamics(law, 1e-6, 1e-3, retardation_s=0.01)
    )
    return AdaptiveBody.of(bar(2), dynamics, conditions, None).step(30).displacement


@pytest.mark.parametrize("name", ["lattice", "linear", "hyperelastic"])
def test_rollers_hold_one_axis_only(name):
    points = bar(2).points
    u = moved(name, points)
    roller = (points[:, 0] < 1e-9) & (points[:, 2] > 1e-9)
    assert np.abs(u[roller, 0]).max() < 1e-9
    assert np.abs(u[roller, 2]).min() > 1e-4
    assert np.abs(u[(points[:, 0] > 19.0) & (points[:, 2] > 1e-9), 0]).max() > 1e-5
    assert np.abs(u[points[:, 2] < 1e-9]).max() < 1e-9
