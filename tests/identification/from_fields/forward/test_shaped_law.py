"""The law with free shapes against the strain energies of the laws in closed form, and its tangent and unit forces against differences."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.field_laws import field_law
from naibu.identification.from_fields.forward.shaped_law import C01, C20, C30, ISOCHORIC, N_SHAPES, ShapedLaw
from naibu.meshing.primitives import box

LAME, SHEAR = np.array([40.0, 70.0]), np.array([10.0, 20.0])
SHAPES = np.array([[0.0, 0.4], [0.3, 0.8], [0.0, 0.6], [0.2, 0.7]])
MESH = box((10.0, 10.0, 20.0), (1, 1, 2), centred=False)
STRETCHES = np.array([0.9, 1.05, 1.2])


def energy(stretches: FloatArray, shapes: FloatArray, lame: float, shear: float) -> float:
    """Stored energy of a cube of 10 mm, mN mm, by the laws of Bonet and Wood, Mooney and Rivlin, and Yeoh."""
    j = float(np.prod(stretches))
    first, second = float((stretches**2).sum()), float((j / stretches) ** 2 @ np.ones(3))
    i1, i2, kappa = first * j ** (-2.0 / 3.0) - 3.0, second * j ** (-4.0 / 3.0) - 3.0, lame + 2.0 / 3.0 * shear
    coupled = 0.5 * shear * (first - 3.0) - shear * np.log(j) + 0.5 * lame * np.log(j) ** 2
    isochoric = 0.5 * shear * i1 + 0.25 * kappa * (j**2 - 1.0 - 2.0 * np.log(j))
    more = 0.5 * shear * (shapes[C01] * (i2 - i1) + shapes[C20] * i1**2 + shapes[C30] * i1**3)
    return float(1000.0 * ((1.0 - shapes[ISOCHORIC]) * coupled + shapes[ISOCHORIC] * isochoric + more))


def test_forces_do_the_work_of_the_stored_energy() -> None:
    law, u = ShapedLaw(MESH, SHAPES, averaged=True), MESH.points * (STRETCHES - 1.0)
    force = law.forces(LAME, SHEAR, u)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        ends = [sum(energy(STRETCHES + s, SHAPES[:, c], LAME[c], SHEAR[c]) for c in range(2)) for s in (step, -step)]
        assert (force * MESH.points)[:, axis].sum() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6)


@pytest.mark.parametrize(("cell_type", "averaged"), [("hexahedron", True), ("hexahedron", False), ("tetra", False)])
def test_tangent_unit_forces_and_slopes_by_shapes_are_those_of_forces(cell_type: str, averaged: bool) -> None:
    mesh = box((10.0, 10.0, 20.0), (1, 1, 2), centred=False, cell_type=cell_type)
    upper = (mesh.points[mesh.cells].mean(axis=1)[:, 2] > 10.0).astype(int)
    law, rng, lame, shear = ShapedLaw(mesh, SHAPES[:, upper], averaged=averaged), np.random.default_rng(0), LAME[upper], SHEAR[upper]
    u = mesh.points * (STRETCHES - 1.0) + rng.normal(0.0, 0.2, mesh.points.shape)
    d = rng.normal(0.0, 1.0, u.shape)
    change = (law.forces(lame, shear, u + 1e-5 * d) - law.forces(lame, shear, u - 1e-5 * d)) / 2e-5
    np.testing.assert_allclose(law.stiffness(lame, shear, u) @ d.ravel(), change.ravel(), rtol=1e-5, atol=1e-4 * np.abs(change).max())
    of_lame, of_shear = law.unit_forces(u)
    summed = np.zeros_like(u)
    np.add.at(summed, law.cells, lame[:, None, None] * of_lame + shear[:, None, None] * of_shear)
    np.testing.assert_allclose(summed, law.forces(lame, shear, u), atol=1e-9 * np.abs(summed).max())
    ahead, behind = (law.unit_forces(u + side * 1e-5 * d) for side in (1.0, -1.0))
    works = law.unit_works(u, d.reshape(-1, 1), u.reshape(-1, 1))
    for work, plus, minus in zip(works, ahead, behind, strict=True):
        expected = ((plus - minus) / 2e-5 * u[law.cells]).sum(axis=(1, 2))
        np.testing.assert_allclose(work, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    along = rng.normal(0.0, 1.0, (N_SHAPES, mesh.n_cells))
    there, here = law.with_shapes(SHAPES[:, upper] + along).forces(lame, shear, u), law.forces(lame, shear, u)
    np.testing.assert_allclose(law.forces_of_shape(lame, shear, u, along), there - here, atol=1e-9 * np.abs(here).max())


def test_without_shapes_it_is_the_neo_hookean_law() -> None:
    law, plain = ShapedLaw(MESH, np.zeros((N_SHAPES, 2)), averaged=True), field_law(MESH, "neo_hookean", averaged=True)
    u = MESH.points * (STRETCHES - 1.0)
    assert law.forces(LAME, SHEAR, u) == pytest.approx(plain.forces(LAME, SHEAR, u), rel=1e-12, abs=1e-9)
    assert not np.isfinite(law.forces(LAME, SHEAR, -1.5 * MESH.points)).any()
