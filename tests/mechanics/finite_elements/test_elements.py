"""Elements: volumes, patch tests, rigid motions, balances, and derivatives against finite differences."""

import numpy as np
import pytest
from builders import GEL, KINDS, as_kind, assembler, distorted, of, relative
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.elements import TETRAHEDRA_PER_PATCH, elements
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, material
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.primitives import box
from naibu.meshing.quality import signed_volumes
from naibu.meshing.surface import boundary_nodes
from naibu.validation.analytic.finite_strain import first_piola, principal_energy

FORMULATIONS = ("mean_dilatation", "standard")
CASES = [(kind, formulation) for kind in KINDS for formulation in FORMULATIONS]
SEED = st.integers(0, 2**32 - 1)


def shaken(points: np.ndarray, seed: int, amount: float) -> np.ndarray:
    """A smooth and a rough part: every element deforms differently."""
    rng = np.random.default_rng(seed)
    return (points - points.mean(axis=0)) @ rng.uniform(-0.15, 0.15, (3, 3)) + rng.uniform(-amount, amount, points.shape)


@pytest.mark.parametrize(("kind", "formulation"), CASES)
def test_volume_is_that_of_the_body(kind, formulation):
    assert elements(as_kind(box((6, 5, 4), (3, 2, 2)), kind), formulation).volume == pytest.approx(120)
    inside = distorted("hexahedron", amount=0.3)
    corners = boundary_nodes(inside)
    inside.points[corners] = box((10, 10, 10), (3, 3, 3)).points[corners]
    assert elements(as_kind(inside, kind), formulation).volume == pytest.approx(1000)


@pytest.mark.parametrize("kind", KINDS)
def test_cells_keep_their_volumes_in_their_groups(kind):
    mesh = distorted(kind)
    table = elements(mesh)
    volume = np.bincount(table.cell_of_point.ravel(), table.weights.ravel(), minlength=mesh.n_cells)
    if kind != "hexahedron":
        np.testing.assert_allclose(volume, signed_volumes(mesh), rtol=1e-10)
    assert (volume > 0).all()


@pytest.mark.parametrize(("kind", "formulation"), CASES)
@pytest.mark.parametrize("law", LAWS)
def test_patch_uniform_deformation_gives_uniform_stress(law, kind, formulation):
    mesh, m = distorted(kind), of(law, 0.49)
    f = np.eye(3) + np.array([[0.15, 0.2, -0.1], [0.05, -0.2, 0.1], [-0.1, 0.1, 0.1]])
    body = assembler(mesh, m, formulation=formulation)
    u = mesh.points @ (f - np.eye(3)).T
    energy, force, _, smallest = body.evaluate(u)
    stress = first_piola(m, f)
    interior = np.setdiff1d(np.arange(mesh.n_points), boundary_nodes(mesh))
    size = np.abs(force).max()
    assert len(interior) > 0
    assert np.abs(force[interior]).max() < 1e-11 * size
    np.testing.assert_allclose(
        force.T @ mesh.points, body.elements.volume * stress, atol=1e-11 * body.elements.volume * np.abs(stress).max()
    )
    assert smallest == pytest.approx(np.linalg.det(f))
    if law != "linear_elastic":
        assert energy == pytest.approx(float(principal_energy(m, np.linalg.svd(f)[1])) * body.elements.volume)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", ["neo_hookean_isochoric", "yeoh"])
def test_laws_that_coincide_are_assembled_alike(law, kind):
    """A Mooney-Rivlin solid without its second part is neo-Hookean, and so is Yeoh's with one; different kernels compute them."""
    mesh, moduli = distorted(kind), {"young_modulus": 20.0, "poisson_ratio": 0.49}
    u = shaken(mesh.points, 3, 0.1)
    energy, force, blocks, smallest = assembler(mesh, material(law, **moduli)).evaluate(u)
    others = assembler(mesh, material("mooney_rivlin", **moduli)).evaluate(u)
    assert (energy, smallest) == (pytest.approx(others[0]), pytest.approx(others[3]))
    np.testing.assert_allclose(force, others[1], rtol=0, atol=1e-11 * np.abs(others[1]).max())
    np.testing.assert_allclose(blocks, others[2], rtol=0, atol=1e-11 * np.abs(others[2]).max())


@pytest.mark.parametrize(("kind", "formulation"), CASES)
@pytest.mark.parametrize("law", [name for name in LAWS if name != "linear_elastic"])
def test_rigid_motion_gives_no_force(law, kind, formulation):
    mesh = distorted(kind)
    turn = Rotation.from_rotvec([0.3, 1.2, -0.8]).as_matrix()
    energy, force, _ = assembler(mesh, of(law), formulation=formulation).forces(mesh.points @ (turn - np.eye(3)).T + [1, 2, 3])
    assert energy == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(force, 0, atol=1e-10)


@pytest.mark.parametrize(("kind", "formulation"), CASES)
@given(seed=SEED, law=st.sampled_from(sorted(LAWS)))
@settings(max_examples=15, deadline=None)
def test_forces_balance_and_turn_with_the_body(kind, formulation, seed, law):
    mesh = distorted(kind, divisions=2)
    body = assembler(mesh, of(law), formulation=formulation)
    u = shaken(mesh.points, seed, 0.25)
    energy, force, smallest = body.forces(u)
    assert smallest > 0
    size = np.abs(force).sum()
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12 * size)
    if law == "linear_elastic":
        return  # not objective: moments balance about the reference configuration only
    np.testing.assert_allclose(np.cross(mesh.points + u, force).sum(axis=0), 0, atol=1e-11 * size)
    turn = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    turned_energy, turned, _ = body.forces((mesh.points + u) @ turn.T - mesh.points)
    assert turned_energy == pytest.approx(energy, rel=1e-9)
    np.testing.assert_allclose(turned, force @ turn.T, atol=1e-10 * size)


@pytest.mark.parametrize(("kind", "formulation"), CASES)
@given(seed=SEED, law=st.sampled_from(sorted(LAWS)), nu=st.sampled_from([0.3, 0.49, 0.4999]))
@settings(max_examples=12, deadline=None)
def test_forces_are_derivatives_of_energy_and_tangent_of_forces(kind, formulation, seed, law, nu):
    mesh, h = distorted(kind, divisions=2), 1e-5
    body = assembler(mesh, of(law, nu), formulation=formulation)
    u = shaken(mesh.points, seed, 0.25)
    _, force, blocks, smallest = body.evaluate(u)
    assert smallest > 0
    matrix = body.pattern.matrix(blocks)
    for k in range(2):
        direction = np.random.default_rng(seed + k).normal(size=u.shape)
        (up, f_up, _), (down, f_down, _) = body.forces(u + h * direction), body.forces(u - h * direction)
        size = np.abs(force * direction).sum()
        assert (up - down) / (2 * h) == pytest.approx(np.vdot(force, direction), rel=1e-6, abs=1e-6 * size)
        assert relative((f_up - f_down).ravel() / (2 * h), matrix @ direction.ravel()) < 1e-6
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()


def test_derivative_with_respect_to_parameters():
    mesh = distorted("hexahedron")
    body = assembler(mesh, of("yeoh"))
    rng = np.random.default_rng(0)
    u, direction = shaken(mesh.points, 1, 0.3), rng.uniform(0, 1, body.parameters.shape)
    up, down = (body.with_parameters(body.parameters + s * 1e-3 * direction).forces(u)[1] for s in (1, -1))
    assert relative(body.forces_of_parameter(u, direction), (up - down) / 2e-3) < 1e-9


def test_inversion_is_reported():
    mesh = box((1, 1, 1), (1, 1, 1))
    assert assembler(mesh).forces(mesh.points * [0, 0, -1.2])[2] == pytest.approx(-0.2)


def test_patches_are_connected_and_of_one_region():
    mesh = box((10, 10, 10), (4, 4, 4), layers=[("a", 5), ("b", 5)], cell_type="tetra")
    table = elements(mesh)
    used = table.weights > 0
    assert np.sort(table.cell_of_point[used]).tolist() == list(range(mesh.n_cells))
    counts = used.sum(axis=1)
    assert counts.max() < 2 * TETRAHEDRA_PER_PATCH
    assert counts.mean() > 0.6 * TETRAHEDRA_PER_PATCH
    for cells, inside in zip(table.cell_of_point, used, strict=True):
        assert len(set(mesh.regions[cells[inside]])) == 1


def test_two_materials_feel_their_own_law():
    layers = [("a", 4.0), ("b", 6.0)]
    mesh = box((10, 10, 10), (3, 3, 5), layers=layers)
    one, two = of("neo_hookean"), of("mooney_rivlin", 0.3, 50.0)
    f = np.diag([1.1, 0.95, 0.8])
    energy = assembler(mesh, one, two).forces(mesh.points @ (f - np.eye(3)))[0]
    density = [float(principal_energy(m, np.diag(f))) for m in (one, two)]
    assert energy == pytest.approx(400 * density[0] + 600 * density[1])


@pytest.mark.parametrize("kind", KINDS)
def test_weight_is_that_of_the_body_and_acts_at_its_centre(kind):
    mesh = as_kind(box((10, 5, 8), (3, 2, 4), layers=[("a", 4), ("b", 4)]), kind)
    weight = body_force(elements(mesh), np.where(mesh.regions == 0, 1e-6, 3e-6), np.array([0.0, 0.0, -9810.0]))
    np.testing.assert_allclose(weight.sum(axis=0), [0, 0, -9810 * 200 * 4e-6], rtol=1e-12)
    np.testing.assert_allclose(weight[:, 2] @ mesh.points, [0, 0, -9810 * 200 * (1e-6 * 2 + 3e-6 * 6)], rtol=1e-12, atol=1e-10)


def test_bad_input_is_refused():
    mesh = box((1, 1, 1), (2, 1, 1))
    with pytest.raises(InputError, match="'reduced'"):
        elements(mesh, "reduced")
    cells = mesh.cells.copy()
    cells[1] = cells[1][[4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(InputError, match="cell 1 of the mesh is inverted"):
        elements(Mesh(mesh.points, cells, "hexahedron", mesh.regions, mesh.region_names))


def test_a_wider_pattern_changes_nothing():
    mesh = distorted("tetra")
    table = elements(mesh)
    wide = block_pattern(mesh.n_points, table.connectivity, np.array([[0, mesh.n_points - 1]]))
    narrow, body = assembler(mesh), Assembler.from_materials(table, mesh.regions, [GEL], wide)
    u = shaken(mesh.points, 0, 0.2)
    assert wide.n_blocks == narrow.pattern.n_blocks + 2
    difference = wide.matrix(body.evaluate(u)[2]) - narrow.pattern.matrix(narrow.evaluate(u)[2])
    assert abs(difference).max() == 0
