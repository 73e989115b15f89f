"""Cubic crystals: closed forms and published moduli of directions, symmetry, and finite elements against homogeneous solutions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.small_strain.anisotropic_body import AnisotropicBody
from naibu.mechanics.small_strain.cubic_elasticity import CubicCrystal, crystal_frame, miller_indices, silicon
from naibu.meshing.element_conversion import to_quadratic
from naibu.meshing.primitives import box

GPA = 1e6  # kPa
# Hopcroft, Nix and Kenny (2010), table II and text, after Wortman and Evans (1965)
PUBLISHED = {(1, 0, 0): 130.0, (1, 1, 0): 169.0, (1, 1, 1): 188.0}


@pytest.mark.parametrize(("direction", "modulus"), PUBLISHED.items())
def test_youngs_modulus_of_silicon_is_the_published_one(direction: tuple[int, int, int], modulus: float) -> None:
    assert silicon().young_modulus(direction) / GPA == pytest.approx(modulus, abs=0.6)


def test_shear_moduli_and_poissons_ratios_of_silicon_are_the_published_ones() -> None:
    si = silicon()
    assert si.shear_modulus((1, 1, 0), (1, -1, 0)) / GPA == pytest.approx(50.9, abs=0.05)
    assert si.shear_modulus((1, 1, 0), (0, 0, 1)) / GPA == pytest.approx(79.6, abs=0.05)
    assert si.poisson_ratio((1, 0, 0), (0, 1, 0)) == pytest.approx(0.28, abs=0.003)
    assert si.poisson_ratio((1, 1, 0), (0, 0, 1)) == pytest.approx(0.36, abs=0.003)
    assert si.poisson_ratio((1, 1, 0), (1, -1, 0)) == pytest.approx(0.064, abs=0.003)
    assert si.anisotropy == pytest.approx(1.57, abs=0.01)


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.integers(-5, 5)] * 3).filter(any))
def test_youngs_modulus_is_the_closed_form_of_nye(direction: tuple[int, int, int]) -> None:
    """1/E = s11 - 2 (s11 - s12 - s44/2)(l1^2 l2^2 + l2^2 l3^2 + l3^2 l1^2), with s from the inverse of the 6 x 6 matrix."""
    si = silicon()
    matrix = np.diag([si.c44] * 6)
    matrix[:3, :3] = si.c12 + (si.c11 - si.c12) * np.eye(3)
    s = np.linalg.inv(matrix)
    a, b, c = (np.array(direction) / np.linalg.norm(direction)) ** 2
    expected = s[0, 0] - 2.0 * (s[0, 0] - s[0, 1] - 0.5 * s[3, 3]) * (a * b + b * c + c * a)
    assert 1.0 / si.young_modulus(direction) == pytest.approx(expected, rel=1e-12)


def test_rotated_tensors_keep_their_symmetries_and_are_inverses() -> None:
    axes = crystal_frame((1, 2, 0), (0, 0, 1))
    c, s = silicon().stiffness_tensor(axes), silicon().compliance_tensor(axes)
    for other in (c.transpose(1, 0, 2, 3), c.transpose(0, 1, 3, 2), c.transpose(2, 3, 0, 1)):
        assert c == pytest.approx(other, abs=1e-6 * GPA)
    d = np.eye(3)
    identity = 0.5 * (np.einsum("ik,jl->ijkl", d, d) + np.einsum("il,jk->ijkl", d, d))
    assert np.einsum("ijmn,mnkl->ijkl", c, s) == pytest.approx(identity, abs=1e-12)
    # a rotation of the basis, component by component
    assert c == pytest.approx(np.einsum("ia,jb,kc,ld,abcd->ijkl", axes, axes, axes, axes, silicon().stiffness_tensor()), abs=1e-3)


def test_isotropic_crystals_are_alike_in_every_direction() -> None:
    steel = CubicCrystal.isotropic(200.0 * GPA, 0.3)
    assert steel.anisotropy == pytest.approx(1.0)
    assert steel.young_modulus((1, 2, 3)) == pytest.approx(200.0 * GPA)
    assert steel.poisson_ratio((1, 1, 0), (1, -1, 1)) == pytest.approx(0.3)
    lame, shear = lame_parameters(200.0 * GPA, 0.3)
    assert (steel.c12, steel.c44) == pytest.approx((lame, shear))


@pytest.mark.parametrize(
    ("text", "indices"), [("110", (1, 1, 0)), ("<100>", (1, 0, 0)), ("[1 -1 0]", (1, -1, 0)), ("(0, 0, 1)", (0, 0, 1))]
)
def test_directions_are_read(text: str, indices: tuple[int, int, int]) -> None:
    assert miller_indices(text) == indices


@pytest.mark.parametrize("text", ["000", "11", "north", "1100", "", "[1 1 x]"])
def test_unknown_directions_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="crystal direction"):
        miller_indices(text)


def test_impossible_crystals_and_frames_are_refused() -> None:
    with pytest.raises(InputError, match="stable crystal"):
        CubicCrystal(50.0, 60.0, 10.0)
    with pytest.raises(InputError, match="finite"):
        CubicCrystal(np.nan, 60.0, 10.0)
    with pytest.raises(InputError, match="not perpendicular"):
        crystal_frame((1, 1, 0), (1, 1, 1))
    with pytest.raises(InputError, match="no crystal direction"):
        crystal_frame((0, 0, 0), (0, 0, 1))
    with pytest.raises(InputError, match="right-handed"):
        silicon().stiffness_tensor(2.0 * np.eye(3))


@pytest.fixture(scope="module")
def bar() -> AnisotropicBody:
    mesh = box((1.0, 0.6, 0.4), (3, 2, 2), centred=False, cell_type="tetra")
    return AnisotropicBody.of(to_quadratic(mesh))


def stretched(body: AnisotropicBody, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Response to a pull of 1 % along x, with symmetry planes at x = y = z = 0."""
    points = body.mesh.points
    constrained = points == 0.0
    end = points[:, 0] == points[:, 0].max()
    constrained[end, 0] = True
    values = np.zeros((1, *points.shape))
    values[0, end, 0] = 0.01
    displacement, force = body.response(silicon().stiffness_tensor(axes)[None], constrained, values)
    return displacement[0], force[0]


@pytest.mark.parametrize(("x", "y"), [((1, 0, 0), (0, 1, 0)), ((1, 1, 0), (-1, 1, 0))])
def test_a_pulled_bar_shows_the_modulus_and_the_ratios_of_its_direction(
    bar: AnisotropicBody, x: tuple[int, int, int], y: tuple[int, int, int]
) -> None:
    si, points = silicon(), bar.mesh.points
    displacement, force = stretched(bar, crystal_frame(x, (0, 0, 1)))
    end = points[:, 0] == points[:, 0].max()
    assert force[end, 0].sum() == pytest.approx(0.01 * si.young_modulus(x) * 0.24, rel=1e-9)
    assert force.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-6 * force[end, 0].sum())
    strain = bar.nodal_strain(displacement)
    expected = 0.01 * np.diag([1.0, -si.poisson_ratio(x, y), -si.poisson_ratio(x, (0, 0, 1))])
    assert strain == pytest.approx(np.broadcast_to(expected, strain.shape), abs=1e-11)


def test_nodal_strain_is_exact_for_quadratic_displacement(bar: AnisotropicBody) -> None:
    x, y, z = bar.mesh.points.T
    displacement = np.stack([x * x + y * z, x * y, z * z - x * z], axis=1)
    strain = bar.nodal_strain(displacement)
    assert strain[:, 0, 0] == pytest.approx(2.0 * x, abs=1e-12)
    assert strain[:, 0, 1] == pytest.approx(0.5 * (z + y), abs=1e-12)
    assert strain[:, 0, 2] == pytest.approx(0.5 * (y - z), abs=1e-12)


def test_mass_is_that_of_the_volume_and_of_quadratic_motion(bar: AnisotropicBody) -> None:
    mass = bar.mass_matrix(np.array([2.0]))
    x = bar.mesh.points[:, 0]
    assert mass.sum() == pytest.approx(2.0 * 0.24)
    assert x @ (mass @ x) == pytest.approx(2.0 * 0.24 / 3.0)  # integral of x^2
    assert x**2 @ (mass @ x**2) == pytest.approx(2.0 * 0.24 / 5.0)


def test_the_stiffness_is_symmetric_and_rigid_motion_is_free(bar: AnisotropicBody) -> None:
    stiffness = bar.stiffness(silicon().stiffness_tensor(crystal_frame((1, 2, 0), (0, 0, 1)))[None])
    assert abs(stiffness - stiffness.T).max() < 1e-9 * abs(stiffness).max()
    turn = np.array([1.0, 2.0, 3.0]) + np.cross([0.3, -0.2, 0.5], bar.mesh.points)
    assert stiffness @ turn.ravel() == pytest.approx(np.zeros(turn.size), abs=1e-7 * abs(stiffness).max())


def test_what_cannot_be_solved_is_refused(bar: AnisotropicBody) -> None:
    tensor, n = silicon().stiffness_tensor()[None], bar.mesh.n_points
    with pytest.raises(InputError, match="rigid-body motions"):
        bar.response(tensor, np.zeros((n, 3), dtype=bool), np.zeros((1, n, 3)))
    with pytest.raises(InputError, match="tensors must have shape"):
        bar.stiffness(np.concatenate([tensor, tensor]))
    with pytest.raises(InputError, match="to_quadratic"):
        AnisotropicBody.of(box((1, 1, 1), (1, 1, 1), cell_type="tetra"))
