"""Coarse functions in the implicit solver: what they are, that they help, and that they change nothing but the number of iterations."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import box_indenter, plane_indenter
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.implicit import coarse_space
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import _from_nodes, _to_nodes, add_contacts, gather, turn_with
from naibu.mechanics.lattices.cpu.implicit._pcg_kernels import multiply
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState
from naibu.mechanics.lattices.model.tetrahedral_springs import volumetric_lattice
from naibu.meshing.primitives import box

STIFF = (10.0, 5.0, 10.0)


def porous(n: int, seed: int) -> np.ndarray:
    """Return a mask with holes, whose layers along x hold together."""
    mask = np.random.default_rng(seed).random((n, n, n)) > 0.3
    mask[n // 2] = True
    mask[:, n // 2, n // 2] = True
    kept = np.zeros_like(mask)
    kept[n // 2] = True
    for _ in range(3 * n):  # what hangs on the middle layer by faces
        near = kept.copy()
        for axis in range(3):
            for way in (1, -1):
                moved = np.roll(kept, way, axis)
                edge: list[slice | int] = [slice(None)] * 3
                edge[axis] = 0 if way == 1 else -1
                moved[tuple(edge)] = False
                near |= moved
        kept = near & mask
    return kept


SPECIMENS: dict[str, Callable[[], Lattice]] = {
    "classic": lambda: classic_lattice(box_mask((9, 8, 10)), 5.0, total_mass_kg=0.3),
    "holes": lambda: classic_lattice(porous(10, 1), 5.0, total_mass_kg=0.3),
    "octree": lambda: octree_lattice(box_mask((16, 16, 16)), 5.0, 1, total_mass_kg=0.6),
    "bar": lambda: classic_lattice(box_mask((40, 4, 5)), 3.0, total_mass_kg=0.05),
}
NAMES = ["tetrahedra", *SPECIMENS]


@cache
def specimen(name: str) -> tuple[Lattice, LatticeParameters]:
    if name == "tetrahedra":
        mesh = box((30.0, 20.0, 40.0), (6, 4, 8), cell_type="tetra")
        return volumetric_lattice(mesh, density=1e-6, young_modulus=300.0)
    lattice = SPECIMENS[name]()
    return lattice, lattice_parameters(lattice, *STIFF)


def pushed(engine: LatticeEngine, steps: int = 8):
    z = engine.lattice.points[:, 2]
    constrained = ConstrainedNodes.of(np.flatnonzero(z < z.min() + 1e-6), 0) + ConstrainedNodes.of(
        np.flatnonzero(z > z.max() - 1e-6), 1, axes=(2, 0)
    )
    return engine.run(engine.rest(), steps, constrained, [[0.0, 0.0, 0.0], [4.0, 0.0, -20.0]])


def helped(monkeypatch: pytest.MonkeyPatch, between: bool = False) -> None:
    """Use coarse functions on small lattices too, and two grids of them if asked for."""
    monkeypatch.setattr(coarse_space, "_FEW", 0)
    monkeypatch.setattr(coarse_space, "_WORTH", np.inf)
    monkeypatch.setattr(coarse_space, "_FAR", 3.9 if between else np.inf)
    if between:
        monkeypatch.setattr(coarse_space, "_LEAST", 4.9)
        monkeypatch.setattr(coarse_space, "_BETWEEN", 2.5)


@pytest.mark.parametrize("between", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_the_solution_is_the_same_with_fewer_iterations(name, between, monkeypatch):
    lattice, parameters = specimen(name)
    monkeypatch.setattr(coarse_space, "_FEW", np.inf)
    plain = pushed(LatticeEngine.of(lattice, parameters, tolerance=1e-8))
    helped(monkeypatch, between)
    engine = LatticeEngine.of(lattice, parameters, tolerance=1e-8)
    assert (engine.scratch.coarse[3][1].shape[1] > 0) == between
    ours = pushed(engine)
    moved = np.abs(plain.state.position - lattice.points).max()
    np.testing.assert_allclose(ours.state.position, plain.state.position, atol=1e-6 * moved)
    np.testing.assert_allclose(ours.reaction, plain.reaction, atol=1e-5 * np.abs(plain.reaction).max())
    assert ours.iterations < 0.75 * plain.iterations


@pytest.mark.parametrize("between", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_coarse_functions_reproduce_linear_fields(name, between, monkeypatch):
    """Hat functions add up to any linear field where the nodes are; and what goes down is the transpose of what comes up."""
    helped(monkeypatch, between)
    lattice, parameters = specimen(name)
    engine = LatticeEngine.of(lattice, parameters)
    steps, vectors, (further, less), _, weights, _ = engine.scratch.coarse
    rng = np.random.default_rng(2)
    pad, n = len(engine.mass), lattice.n_nodes
    slope = rng.normal(size=(3, 3))
    fine = (weights[2], weights[3])
    count = int(fine[0].max()) + 1
    nodes = np.zeros((count, 3))  # where the coarse nodes are: the places whose interpolation gives the nodes of the lattice
    fraction = np.zeros((n, count))
    np.add.at(fraction, (np.arange(n)[:, None], fine[0]), fine[1])
    np.testing.assert_allclose(fraction.sum(axis=1), 1.0, atol=1e-12)
    nodes = np.linalg.lstsq(fraction, lattice.points, rcond=None)[0]
    vectors[4][:, :count] = slope @ nodes.T
    _from_nodes(steps, vectors)
    zero, p = np.zeros((3, pad), np.float32), np.zeros((3, pad), np.float32)
    turn_with(steps[0], vectors[1], p, zero, np.zeros(pad, np.float32), np.float32(0.0), 0, pad - 8)
    np.testing.assert_allclose(p[:, :n], slope @ lattice.points.T, atol=2e-5 * np.abs(lattice.points).max())
    r = rng.normal(size=(3, pad)).astype(np.float32)
    r[:, n:] = 0.0
    c = rng.normal(size=(3, count))
    vectors[4][:, :count] = c
    _from_nodes(steps, vectors)
    turn_with(steps[0], vectors[1], p, zero, np.zeros(pad, np.float32), np.float32(0.0), 0, pad - 8)
    gather(steps[0], vectors[0][0], r, 0, pad - 8)
    _to_nodes(steps, vectors)
    assert float((vectors[3][:, :count] * c).sum()) == pytest.approx(float((p * r).sum(dtype=float)), rel=1e-4, abs=1e-3)
    np.testing.assert_allclose(vectors[3][:, :count].T, fraction.T @ r[:, :n].T, atol=1e-3)
    if between:  # from the finer grid to the coarser one
        values = rng.normal(size=vectors[3].shape).astype(np.float32)
        values[:, count:] = 0.0
        coarse = np.zeros((n, int(weights[0].max()) + 1))
        np.add.at(coarse, (np.arange(n)[:, None], weights[0]), weights[1])
        gather(further[0], less[0][0], values, 0, values.shape[1])
        _to_nodes(further, less)
        nested = np.linalg.lstsq(fraction, coarse, rcond=None)[0]
        if np.linalg.matrix_rank(fraction) == count:
            np.testing.assert_allclose(less[3][:, : coarse.shape[1]].T, nested.T @ values[:, :count].T, atol=1e-4)


@pytest.mark.parametrize("name", ["classic", "octree", "tetrahedra"])
def test_the_coarse_matrix_is_the_lattices_own(name, monkeypatch):
    """c . B c = (P c) . (A + s D) P c at rest, with the matrix A of the step and the share s of its diagonal that is added."""
    helped(monkeypatch)
    lattice, parameters = specimen(name)
    engine = LatticeEngine.of(lattice, parameters)
    engine.run(engine.rest(), 1)  # stores the directions at rest
    blocks, _ = engine.kernel
    with engine.scratch() as (_, inner):  # that of the run
        pass
    base, weights, smoother = inner[8][3][0], inner[8][4], inner[3]
    pad, n = len(engine.mass), lattice.n_nodes
    c = np.zeros(base.shape[:2])
    c[:, : int(weights[0].max()) + 1] = np.random.default_rng(3).normal(size=(3, int(weights[0].max()) + 1))
    p, q = np.zeros(3 * pad, np.float32), np.zeros(3 * pad, np.float32)
    p.reshape(3, pad)[:, :n] = (c[:, weights[0]] * weights[1]).sum(axis=2)
    energy = multiply(blocks, inner[0], inner[1], inner[2], p, q)
    shift = 1e-5 * (p.reshape(3, pad)[:, :n] ** 2 / smoother[:n]).sum()
    assert np.einsum("ai,aibj,bj", c, base, c) == pytest.approx(energy + shift, rel=1e-5)


@pytest.mark.parametrize("name", ["classic", "octree", "tetrahedra"])
def test_what_contact_adds_to_the_coarse_matrix_is_the_product_of_its_own_with_coarse_functions(name, monkeypatch):
    helped(monkeypatch)
    lattice, parameters = specimen(name)
    corner, weight = LatticeEngine.of(lattice, parameters).scratch.coarse[4][:2]
    rng, count = np.random.default_rng(4), int(corner.max()) + 1
    touched = rng.choice(lattice.n_nodes, 20, replace=False)
    places = rng.permuted(np.tile(np.arange(20), (7, 1)), axis=1)[:, :4]
    places[6, 3] = places[6, 2]  # a triangle
    halves = rng.normal(size=(7, 12, 12))
    blocks = np.zeros((9, 12, 16))
    blocks[:7, :, :12] = halves @ halves.transpose(0, 2, 1)
    full = np.zeros((3, 20, 3, 20))
    for face, block in zip(places, blocks, strict=False):
        for c, i in enumerate(face):
            for e, j in enumerate(face):
                full[:, i, :, j] += block[3 * c : 3 * c + 3, 3 * e : 3 * e + 3]
    fraction = np.zeros((20, count))
    np.add.at(fraction, (np.arange(20)[:, None], corner[touched]), weight[touched])
    expected = np.einsum("ik,aibj,jl->akbl", fraction, full, fraction, optimize=True)
    faces = touched[places]
    dense, diagonal = np.zeros((3, count, 3, count)), np.zeros((3, count))
    add_contacts((faces, blocks, len(faces)), corner, weight, dense, diagonal)
    np.testing.assert_allclose(dense, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(diagonal, np.einsum("akak->ak", expected), atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize(("name", "between", "share"), [("classic", False, 0.52), ("classic", True, 0.5), ("octree", False, 0.5)])
def test_a_body_on_a_floor_that_a_plate_drags_needs_fewer_iterations(name, between, share, monkeypatch):
    """Contact is all that holds the body: coarse functions that did not know of it would not help. Results are those without them."""
    lattice = specimen(name)[0]
    parameters = lattice_parameters(lattice, 40.0, 18.0, 1000.0)
    low, high = lattice.points.min(axis=0), lattice.points.max(axis=0)
    middle, wide = 0.5 * (low + high), 4.0 * float((high - low).max())
    plate = box_indenter((middle[0], middle[1], high[2] + 2.0), (wide, wide, 4.0), static_friction=0.6, kinetic_friction=0.5)
    bodies = (plane_indenter(low, (0.0, 0.0, 1.0), static_friction=0.6, kinetic_friction=0.5), plate)
    path = np.zeros((12, 2, 3))
    path[:, 1, 2], path[6:, 1, 0] = -20.0, 40.0
    weight = np.outer(lattice.node_mass, (0.0, 0.0, -9810.0))

    def moved():
        engine = LatticeEngine.of(lattice, parameters, step=0.01, tolerance=1e-5)
        session = engine.session(external_force=weight, indenters=bodies)
        forces = [session.step(motions=[IndenterVelocity(tuple(v)) for v in velocity]).indenters[0] for velocity in path]
        return session.positions(), np.array(forces), session.iterations

    monkeypatch.setattr(coarse_space, "_FEW", np.inf)
    position, force, plain = moved()
    helped(monkeypatch, between)
    ours, found, iterations = moved()
    np.testing.assert_allclose(found, force, atol=2e-3 * np.abs(force).max())
    np.testing.assert_allclose(ours, position, atol=2e-4 * np.abs(position - lattice.points).max())
    assert iterations < share * plain


@pytest.mark.parametrize("seed", range(30))
def test_energy_never_grows_with_coarse_functions(seed, monkeypatch):
    helped(monkeypatch, bool(seed % 2))
    rng = np.random.default_rng(seed)
    lattice = classic_lattice(porous(5, seed) if seed % 3 else box_mask((5, 5, 11)), 10.0, total_mass_kg=10.0 ** rng.uniform(-3, 0))
    unit = 10.0 ** rng.choice([-3.0, 0.0])
    ranges = ((500, 3e4), (100, 2e4), (500, 3e4))
    draw = [unit * np.exp(rng.uniform(np.log(low / 100), np.log(100 * high), lattice.n_elements)) for low, high in ranges]
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, *draw), tolerance=10.0 ** rng.uniform(-6, -0.05))
    assert len(engine.scratch.coarse[5][2])
    velocity = 10.0 ** rng.uniform(-2, 3) * (rng.normal(size=lattice.points.shape) + np.cross([0.1, -0.2, 0.3], lattice.points))
    constrained = ConstrainedNodes.of([0, 1, 2, 7]) if rng.random() < 0.5 else None
    if constrained is not None:
        velocity[[0, 1, 2, 7]] = 0.0
    state = LatticeState(lattice.points, velocity, 0.3 * rng.normal(size=lattice.n_elements))
    energies = [engine.energy(state)]
    for _ in range(15):
        state = engine.run(state, 1, constrained).state
        energies.append(engine.energy(state))
    assert np.diff(energies).max() <= 1e-9 * energies[0]


def test_a_run_does_not_depend_on_those_before_it(monkeypatch):
    helped(monkeypatch)
    lattice, parameters = specimen("classic")
    engine = LatticeEngine.of(lattice, parameters)
    once = pushed(engine)
    engine.run(engine.rest(), 3, ConstrainedNodes.of([5, 9]), [1.0, 2.0, 3.0])
    engine.run(engine.rest(), 3)
    again = pushed(engine)
    np.testing.assert_array_equal(again.state.position, once.state.position)
    np.testing.assert_array_equal(again.reaction, once.reaction)


def test_a_lattice_that_has_turned_is_solved_as_well(monkeypatch):
    """The coarse matrix is that of the lattice at rest; a lattice that has turned costs iterations, not accuracy."""
    helped(monkeypatch)
    lattice, parameters = specimen("classic")
    engine = LatticeEngine.of(lattice, parameters, tolerance=1e-6)
    z = lattice.points[:, 2]
    constrained = ConstrainedNodes.of(np.flatnonzero(z < 1.0), 0) + ConstrainedNodes.of(np.flatnonzero(z > 49.0), 1)
    upright = engine.run(engine.rest(), 5, constrained, [[0.0, 0.0, 0.0], [0.0, 0.0, -20.0]]).state
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    start = LatticeState(lattice.points @ turn.T, np.zeros_like(lattice.points), np.zeros(lattice.n_elements))
    lying = engine.run(start, 5, constrained, [[0.0, 0.0, 0.0], [-20.0, 0.0, 0.0]]).state
    np.testing.assert_allclose(lying.position, upright.position @ turn.T, atol=2e-7)
