"""Pressures of their own: the same forces where they agree with the dilatation, and derivatives by finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.mechanics import Assembler, elements, material
from naibu.mechanics.finite_elements.pressure_elements import PressureElements
from naibu.meshing import box
from naibu.meshing.element_conversion import to_tetra


@pytest.fixture(params=["hexahedron", "tetra", "quadratic law"])
def made(request: pytest.FixtureRequest) -> PressureElements:
    mesh = box((10.0, 12.0, 14.0), (2, 2, 3))
    if request.param == "tetra":
        mesh = to_tetra(mesh)
    law = "mooney_rivlin" if request.param == "quadratic law" else "neo_hookean"
    stuff = material(law, young_modulus=50.0, poisson_ratio=0.499)
    return PressureElements.of(Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [stuff]))


def test_forces_are_those_of_the_displacement_where_pressure_and_dilatation_agree(made: PressureElements) -> None:
    u = 0.2 * np.random.default_rng(3).standard_normal((made.assembler.elements.n_points, 3))
    log_theta, _ = made.dilatation(u)
    force, mismatch, smallest = made.forces(u, made.bulk * log_theta)
    _, expected, det = made.assembler.forces(u)
    np.testing.assert_allclose(force, expected, atol=1e-10 * np.abs(expected).max())
    assert np.abs(mismatch).max() < 1e-9
    assert smallest == pytest.approx(det)


def test_forces_are_linear_in_the_pressures_with_the_derivatives_of_the_dilatation(made: PressureElements) -> None:
    random = np.random.default_rng(4)
    u = 0.2 * random.standard_normal((made.assembler.elements.n_points, 3))
    pressure, more = random.standard_normal((2, len(made.bulk)))
    _, derivative = made.dilatation(u)
    expected = made.forces(u, pressure)[0]
    made.add_pressures(derivative, more, expected)
    np.testing.assert_allclose(made.forces(u, pressure + more)[0], expected, atol=1e-9 * np.abs(expected).max())
    direction = random.standard_normal(u.shape)
    h = 1e-5
    change = made.bulk * (made.dilatation(u + h * direction)[0] - made.dilatation(u - h * direction)[0]) / (2.0 * h)
    np.testing.assert_allclose(made.pressure_change(derivative, direction, np.zeros_like(pressure)), change, rtol=1e-5, atol=1e-2)
