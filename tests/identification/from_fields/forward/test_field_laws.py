"""Elements of field identification: forces against stiffness and energy, refined meshes and the load cases carried over to them."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import FieldLaw, computed_mesh, field_law
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.refinement import Refinement
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.meshing.primitives import box
from naibu.meshing.quality import signed_volumes
from naibu.validation.specimens.quadratic_body import QuadraticBody

CELLS = ("tetra", "hexahedron")
SHEAR, LAME = 3.0, 20.0


def wavy(cell_type: str, divisions: int = 2) -> Mesh:
    """A box whose nodes inside were moved, so that no cell is a copy of another."""
    mesh = box((8.0, 9.0, 10.0), (divisions,) * 3, cell_type=cell_type)
    x = mesh.points
    return mesh.moved(0.2 * np.sin(x[:, [1, 2, 0]]))


def law_on(mesh: Mesh, name: str) -> tuple[FieldLaw, Mesh]:
    computed, averaged = computed_mesh(mesh, "accurate")
    return field_law(computed, name, averaged=averaged), computed  # type: ignore[arg-type]


def moduli(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return LAME * rng.uniform(0.5, 2.0, mesh.n_cells), SHEAR * rng.uniform(0.5, 2.0, mesh.n_cells)


@pytest.mark.parametrize("cell_type", CELLS)
@pytest.mark.parametrize("name", ["linear", "neo_hookean"])
def test_forces_are_those_of_unit_moduli_and_their_slope_is_the_stiffness(cell_type: str, name: str) -> None:
    law, mesh = law_on(wavy(cell_type), name)
    lame, shear = moduli(mesh)
    rng = np.random.default_rng(1)
    u, direction, h = 0.1 * rng.standard_normal(mesh.points.shape), rng.standard_normal(mesh.points.shape), 1e-5
    of_lame, of_shear = law.unit_forces(u)
    of_cells, summed = lame[:, None, None] * of_lame + shear[:, None, None] * of_shear, np.zeros_like(u)
    np.add.at(summed, law.cells, of_cells)
    assert summed == pytest.approx(law.forces(lame, shear, u), abs=1e-9 * np.abs(summed).max())
    slope = (law.forces(lame, shear, u + h * direction) - law.forces(lame, shear, u - h * direction)) / (2.0 * h)
    product = (law.stiffness(lame, shear, u) @ direction.ravel()).reshape(-1, 3)
    assert product == pytest.approx(slope, abs=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("cell_type", CELLS)
def test_a_uniform_strain_has_the_energy_of_its_closed_form(cell_type: str) -> None:
    law, mesh = law_on(wavy(cell_type), "linear")
    gradient = np.array([[0.02, 0.01, 0.0], [-0.03, 0.01, 0.02], [0.0, 0.01, -0.05]])
    u = mesh.points @ gradient.T
    lame, shear = np.full(mesh.n_cells, LAME), np.full(mesh.n_cells, SHEAR)
    strain = 0.5 * (gradient + gradient.T)
    density = 0.5 * LAME * np.trace(strain) ** 2 + SHEAR * float((strain**2).sum())
    volume = float(signed_volumes(wavy(cell_type)).sum())
    assert 0.5 * float((law.forces(lame, shear, u) * u).sum()) == pytest.approx(density * volume, rel=1e-9)


def test_small_strain_is_the_limit_of_finite_strain() -> None:
    mesh = wavy("hexahedron")
    lame, shear = moduli(mesh)
    u = 1e-6 * np.random.default_rng(2).standard_normal(mesh.points.shape)
    small, finite = (law_on(mesh, name)[0].forces(lame, shear, u) for name in ("linear", "neo_hookean"))
    assert finite == pytest.approx(small, abs=1e-4 * np.abs(small).max())


@pytest.mark.parametrize("cell_type", CELLS)
def test_refinement_fills_every_cell_with_eight(cell_type: str) -> None:
    mesh = wavy(cell_type)
    finer = Refinement.of(mesh)
    volumes = signed_volumes(finer.mesh).reshape(-1, 8)
    assert (volumes > 0.0).all() and volumes.sum(axis=1) == pytest.approx(signed_volumes(mesh), rel=1e-9)
    assert (finer.mesh.points[: mesh.n_points] == mesh.points).all()
    assert len(np.unique(np.round(finer.mesh.points, 9), axis=0)) == finer.mesh.n_points
    affine = mesh.points @ np.diag([0.1, 0.2, 0.3]) + 1.0
    assert finer.displacement(affine) == pytest.approx(finer.mesh.points @ np.diag([0.1, 0.2, 0.3]) + 1.0, abs=1e-9)


@pytest.mark.parametrize("cell_type", CELLS)
def test_load_cases_are_carried_over(cell_type: str) -> None:
    """Floor and top, but nothing between them; a force keeps its sum and stays on the top."""
    mesh = box((8.0, 8.0, 2.0), (4, 4, 2), cell_type=cell_type)
    z = mesh.points[:, 2]
    force = np.where(z[:, None] > 1.0, [0.0, 0.0, -1.0], 0.0)
    field = DisplacementField.from_arrays([[0.0, 0.0, 1.0]], [[0.0, 0.0, -0.1]], sd_mm=0.1)
    finer = Refinement.of(mesh)
    fine = finer.load_case(FieldLoadCase.of("press", field, mesh, loaded=(z == 0.0) | (z == 2.0), external_force=force))
    height = finer.mesh.points[:, 2]
    assert (fine.loaded.all(axis=1) == ((height == 0.0) | (height == 2.0))).all()
    assert fine.external_force.sum(axis=0) == pytest.approx(force.sum(axis=0), rel=1e-12)
    assert not fine.external_force[height < 2.0].any()


def test_quadratic_elements_follow_an_independent_solution() -> None:
    """The state under the true moduli and the true motion of floor and plate, against 27-node elements; linear ones err twice as much."""
    body = QuadraticBody("tapered")
    points, exact = body.solved((3.0, 0.0, -2.0), divisions=4).at(np.random.default_rng(0).uniform(0.05, 0.95, (200, 3)))
    mesh, loaded = body.model(4, "tetra")
    zones, errors = Zones.of(mesh, known={"known": body.known}), []
    for elements in ("accurate", "as_given"):
        case = FieldLoadCase.of("push", DisplacementField.from_arrays(points, exact, sd_mm=1.0), mesh, loaded=loaded)
        model = FieldModel(mesh, [case], zones, elements=elements)  # type: ignore[arg-type]
        nu = body.unknown[1]
        theta = np.log([body.unknown[0] / (2.0 * (1.0 + nu)), 2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu))])
        guess = np.where(model.points[:, 2:] > 20.0, [3.0, 0.0, -2.0], 0.0)
        errors.append(np.sqrt(model.evaluate(theta, [guess]).misfit / points.size))
    assert errors[0] < 0.02 and errors[1] > 2.0 * errors[0], errors


def test_cells_and_options_that_do_not_fit_are_told() -> None:
    mesh = box((2.0, 2.0, 2.0), (1, 1, 1), cell_type="tetra")
    with pytest.raises(InputError, match="use 'accurate' or 'as_given'"):
        computed_mesh(mesh, "exact")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="mid-edge nodes are added"):
        computed_mesh(Mesh.from_arrays(np.random.default_rng(0).random((10, 3)), [np.arange(10)], "tetra10"), "accurate")
