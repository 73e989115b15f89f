"""Bricks with an averaged dilatation against closed forms: patch tests, Lame's cylinder, incompressible bending."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse.linalg as spla
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.small_strain.averaged_dilatation import BrickGrid, Kinematics

PLANES = {
    "plane_strain": (np.array([0.0, 0.7, 1.0, 2.0]), np.array([0.0, 0.4, 1.0])),
    "axisymmetric": (np.array([0.0, 0.7, 1.0, 2.0]), np.array([0.0, 0.4, 1.0])),
    "three_dimensional": (np.array([0.0, 0.7, 1.0]), np.array([0.0, 0.4, 1.0]), np.array([0.0, 0.3, 1.0])),
}


def solved(grid: BrickGrid, young: float, nu: float, force: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    lame, shear = lame_parameters(young, nu)
    matrix = grid.stiffness(np.full(len(grid.cells), lame), np.full(len(grid.cells), shear))
    free = ~fixed.ravel()
    u = np.zeros(fixed.size)
    u[free] = spla.spsolve(matrix[free][:, free].tocsc(), force.ravel()[free])
    return u.reshape(fixed.shape)


@pytest.mark.parametrize("kinematics", PLANES)
def test_uniform_strain_is_in_equilibrium_inside(kinematics: Kinematics) -> None:
    grid = BrickGrid.of(PLANES[kinematics], kinematics)
    d = grid.points.shape[1]
    # a radial field u_r = a r keeps the strain uniform; other gradients only where the coordinates are Cartesian
    gradient = np.diag([0.02, -0.01]) if kinematics == "axisymmetric" else 0.01 * np.random.default_rng(0).standard_normal((d, d))
    u = grid.points @ gradient.T
    m = len(grid.cells)
    force = (grid.stiffness(np.full(m, 5.0), np.full(m, 2.0)) @ u.ravel()).reshape(-1, d)
    low, high = grid.points.min(axis=0), grid.points.max(axis=0)
    inside = ((grid.points > low) & (grid.points < high)).all(axis=1)
    assert inside.any()
    assert_allclose(force[inside], 0.0, atol=1e-13)
    divergence = np.trace(gradient) + (gradient[0, 0] if kinematics == "axisymmetric" else 0.0)
    assert_allclose(grid.mean_divergence() @ u.ravel(), divergence, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("nu", [0.3, 0.4999])
def test_a_thick_cylinder_under_pressure_is_lames(nu: float) -> None:
    a, b, young, height = 1.0, 2.0, 10.0, 0.5
    errors = []
    for n in (8, 16):
        grid = BrickGrid.of((np.linspace(a, b, n + 1), np.linspace(0.0, height, 3)), "axisymmetric")
        inner = np.flatnonzero(grid.points[:, 0] == a)
        force = np.zeros(grid.points.shape)
        force[inner, 0] = 2.0 * np.pi * a * np.array([0.25, 0.5, 0.25]) * height
        fixed = np.zeros(grid.points.shape, dtype=bool)
        fixed[(grid.points[:, 1] == 0.0) | (grid.points[:, 1] == height), 1] = True
        u = solved(grid, young, nu, force, fixed)[inner, 0].mean()
        exact = (1.0 + nu) / young * a * a / (b * b - a * a) * ((1.0 - 2.0 * nu) * a + b * b / a)
        errors.append(abs(u / exact - 1.0))
    assert errors[0] < 2e-3 and errors[1] < 0.3 * errors[0]


def test_nearly_incompressible_bodies_do_not_lock() -> None:
    # a strip between rough plates, sheared and squeezed: the answer of a fine grid
    found = []
    for n in (6, 24):
        grid = BrickGrid.of((np.linspace(-2.0, 2.0, 4 * n + 1), np.linspace(0.0, 1.0, n + 1)), "plane_strain")
        top = np.flatnonzero(grid.points[:, 1] == 1.0)
        force = np.zeros(grid.points.shape)
        loaded = np.abs(grid.points[top, 0]) < 0.5 + 1e-9
        share = np.where(np.abs(np.abs(grid.points[top, 0]) - 0.5) < 1e-9, 0.5, 1.0) * loaded
        force[top, 1] = -share / share.sum()
        fixed = np.zeros(grid.points.shape, dtype=bool)
        fixed[grid.points[:, 1] == 0.0] = True
        found.append(solved(grid, 10.0, 0.4999, force, fixed)[top].min())
    assert found[0] == pytest.approx(found[1], rel=0.02)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_rigid_motion_makes_no_force_and_mass_is_conserved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    planes = tuple(np.cumsum(rng.uniform(0.1, 1.0, 3)) for _ in range(3))
    grid = BrickGrid.of(planes, "three_dimensional")
    spin = rng.standard_normal((3, 3))
    u = grid.points @ (spin - spin.T) + rng.standard_normal(3)
    m = len(grid.cells)
    assert_allclose(grid.stiffness(np.full(m, 5.0), np.full(m, 2.0)) @ u.ravel(), 0.0, atol=1e-11)
    volume = np.prod([p[-1] - p[0] for p in planes])
    assert grid.lumped_mass(np.full(m, 2.0)).sum() == pytest.approx(2.0 * volume)


@pytest.mark.parametrize(
    ("planes", "kinematics", "what"),
    [
        ((np.array([0.0, 1.0]),), "plane_strain", "along 2 axes"),
        ((np.array([0.0, 1.0]), np.array([1.0, 0.0])), "plane_strain", "axis 1 must be two or more numbers"),
        ((np.array([0.0, np.nan]), np.array([0.0, 1.0])), "plane_strain", "axis 0"),
        ((np.array([-1.0, 1.0]), np.array([0.0, 1.0])), "axisymmetric", "radius must not be negative; the first is -1 mm"),
    ],
)
def test_bad_planes_are_named(planes: tuple[np.ndarray, ...], kinematics: Kinematics, what: str) -> None:
    with pytest.raises(InputError, match=what):
        BrickGrid.of(planes, kinematics)
