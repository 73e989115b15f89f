"""Laws on simplices against the finite elements of the package, finite differences of the energy, closed forms and rigid motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import from_moduli, law_named
from naibu.mechanics.finite_elements.linear_simplices import Simplices, simplices
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw, cell_tangents, energies, unit_forces
from naibu.meshing.primitives import box

LAWS: tuple[SimplexLaw, ...] = ("linear", "neo_hookean", "saint_venant_kirchhoff")
LAME, SHEAR = 3.0, 2.0


def one_cell(dimension: int, seed: int) -> Simplices:
    rng = np.random.default_rng(seed)
    points = np.vstack([np.zeros(dimension), np.eye(dimension)]) + 0.1 * rng.standard_normal((dimension + 1, dimension))
    return simplices(Mesh.from_arrays(points, [range(dimension + 1)], {1: "line", 2: "triangle", 3: "tetra"}[dimension]))


def forces(body: Simplices, u: np.ndarray, law: SimplexLaw) -> np.ndarray:
    lame, shear = unit_forces(body, u, law)
    return LAME * lame + SHEAR * shear


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dimension", [1, 2, 3])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_forces_are_the_derivative_of_the_energy_and_tangents_that_of_forces(law: SimplexLaw, dimension: int, seed: int) -> None:
    body, rng = one_cell(dimension, seed % 30), np.random.default_rng(seed)
    u, h = 0.1 * rng.standard_normal((dimension + 1, dimension)), 1e-5
    tangent = cell_tangents(body, u, LAME, SHEAR, law)[0]
    for k, a in np.ndindex(*u.shape):
        step = np.zeros_like(u)
        step[k, a] = h
        slope = (energies(body, u + step, LAME, SHEAR, law) - energies(body, u - step, LAME, SHEAR, law)) / (2 * h)
        assert forces(body, u, law)[0, k, a] == pytest.approx(slope[0], rel=1e-6, abs=1e-8)
        change = (forces(body, u + step, law) - forces(body, u - step, law))[0] / (2 * h)
        assert tangent[:, :, k, a] == pytest.approx(change, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(("law", "name"), [("linear", "linear_elastic"), *((name, name) for name in LAWS[1:])])
def test_forces_and_tangents_equal_those_of_the_finite_elements(law: SimplexLaw, name: str) -> None:
    mesh = box((10.0, 12.0, 8.0), (2, 3, 2), cell_type="tetra")
    body, rng = simplices(mesh), np.random.default_rng(5)
    u = 0.1 * mesh.points @ rng.standard_normal((3, 3)) + 0.2 * rng.standard_normal(mesh.points.shape)
    assembler = Assembler.from_materials(
        elements(mesh, "standard"), mesh.regions, [from_moduli(law_named(name), SHEAR, LAME + 2 / 3 * SHEAR)]
    )
    energy, expected, blocks, _ = assembler.evaluate(u)
    assert body.scattered(forces(body, u, law)) == pytest.approx(expected, rel=1e-11, abs=1e-11 * np.abs(expected).max())
    assert energies(body, u, LAME, SHEAR, law).sum() == pytest.approx(energy, rel=1e-12)
    direction = rng.standard_normal(u.shape)
    product = np.einsum("mkalc,mlc->mka", cell_tangents(body, u, LAME, SHEAR, law), direction[mesh.cells])
    expected = (assembler.pattern.matrix(blocks) @ direction.ravel()).reshape(u.shape)
    assert body.scattered(product) == pytest.approx(expected, rel=1e-11, abs=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("law", LAWS[1:])
@pytest.mark.parametrize("dimension", [2, 3])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_rotation_makes_no_force_and_turns_those_of_a_strain(law: SimplexLaw, dimension: int, seed: int) -> None:
    body, rng = one_cell(dimension, seed % 30), np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    corners = np.vstack([np.zeros(dimension), np.linalg.inv(body.gradients[0, 1:]).T])
    assert np.abs(forces(body, corners @ turn.T - corners, law)).max() < 1e-12
    moved = corners + 0.1 * rng.standard_normal(corners.shape)
    plain = forces(body, moved - corners, law)[0]
    assert forces(body, moved @ turn.T - corners, law)[0] == pytest.approx(plain @ turn.T, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_small_strains_obey_linear_elasticity(law: SimplexLaw) -> None:
    body = one_cell(3, 2)
    u = 1e-6 * np.random.default_rng(1).standard_normal((4, 3))
    assert forces(body, u, law) == pytest.approx(forces(body, u, "linear"), rel=1e-4, abs=1e-11)


def test_plane_strain_is_the_cube_between_rigid_walls() -> None:
    """A triangle of unit thickness and a prism of tetrahedra of unit height store the same energy when nothing moves along z."""
    flat = Mesh.from_arrays([[0, 0], [2, 0], [0, 1.0]], [[0, 1, 2]], "triangle")
    high = np.vstack([np.column_stack([flat.points, np.zeros(3)]), np.column_stack([flat.points, np.ones(3)])])
    prism = Mesh.from_arrays(high, [[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]], "tetra")
    u = np.array([[0.0, 0.1], [0.3, -0.1], [-0.2, 0.2]])
    tall = np.column_stack([np.tile(u, (2, 1)), np.zeros(6)])
    for law in LAWS:
        assert energies(simplices(prism), tall, LAME, SHEAR, law).sum() == pytest.approx(
            energies(simplices(flat), u, LAME, SHEAR, law).sum(), rel=1e-12
        )


def test_bad_input_is_named() -> None:
    body = one_cell(2, 0)
    inverted = np.zeros((3, 2))
    inverted[1, 0] = -3.0
    with pytest.raises(InputError, match="inverts the cell of nodes 0, 1, 2"):
        unit_forces(body, inverted, "neo_hookean")
    with pytest.raises(InputError, match="'rubber' is not known"):
        unit_forces(body, inverted, "rubber")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="'rubber' is not known"):
        cell_tangents(body, inverted, 1.0, 1.0, "rubber")  # type: ignore[arg-type]
