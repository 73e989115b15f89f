"""Lattices against closed forms, conservation laws and counts."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.lattices.cpu import engine as engine_module
from naibu.mechanics.lattices.cpu.element_blocks import Blocks
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.coefficients import implicit_coefficients
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, general_lattice, lattice_parameters, voxel_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, explicit_step_limit
from naibu.mechanics.lattices.model.tetrahedral_springs import volumetric_lattice
from naibu.meshing.primitives import box

METHODS = ("implicit", "euler", "symplectic_euler")


def single(mass=1e-9, length=10.0):
    return general_lattice([[0.0, 0.0, 0.0], [0.0, 0.0, length]], [[0, 1]], [mass, mass])


def l_shape():
    mask = box_mask((3, 2, 3))
    mask[1:, :, 1:] = False
    return mask


def momenta(lattice, state):
    linear = lattice.node_mass[:, None] * state.velocity
    return linear.sum(axis=0), np.cross(state.position, linear).sum(axis=0)


@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 3, 5), (8, 8, 8)])
def test_a_box_has_the_counts_of_its_grid(shape):
    lattice = classic_lattice(box_mask(shape), 2.0, density=1e-6)
    a, b, c = shape
    assert lattice.n_nodes == (a + 1) * (b + 1) * (c + 1)
    edges = a * (b + 1) * (c + 1) + (a + 1) * b * (c + 1) + (a + 1) * (b + 1) * c
    faces = 2 * (a * b * (c + 1) + a * (b + 1) * c + (a + 1) * b * c)
    np.testing.assert_array_equal(np.bincount(lattice.element_class, minlength=3), [edges, faces, 4 * a * b * c])
    np.testing.assert_allclose(lattice.lengths, 2.0 * np.sqrt(lattice.element_class + 1.0))
    assert lattice.total_mass == pytest.approx(1e-6 * 8.0 * a * b * c)


def test_blocks_hold_every_element_once():
    lattice = classic_lattice(l_shape(), 1.0, density=1e-6)
    blocks = Blocks.of(lattice)
    assert len(np.unique(blocks.lane)) == lattice.n_elements
    k = blocks.lane % 8
    np.testing.assert_array_equal(
        np.stack([blocks.first[blocks.lane // 8] + k, blocks.second[blocks.lane // 8] + k], axis=1), lattice.elements
    )


def test_masses_lump_by_volume_or_equally():
    lattice = classic_lattice(box_mask((1, 1, 2)), 1.0, total_mass_kg=0.8)
    np.testing.assert_allclose(np.unique(lattice.node_mass), [0.05, 0.1])
    np.testing.assert_allclose(classic_lattice(box_mask((8, 8, 8)), 10.0, total_mass_kg=0.63, lumping="equal").node_mass, 0.63 / 729)


def test_parameters_by_class_and_zone():
    lattice = classic_lattice(box_mask((4, 4, 4)), 1.0, density=1e-6)
    given_k = {"core": 1.0, "surface": {"short": 2.0, "normal": 3.0, "long": 4.0}}
    k = lattice_parameters(lattice, given_k, 1.0, 1.0).stiffness
    surface = lattice.surface_node[lattice.elements].any(axis=1)
    np.testing.assert_array_equal(k, np.where(surface, 2.0 + lattice.element_class, 1.0))


def test_parameters_by_voxel_are_means_over_the_voxels_at_an_element():
    mask = l_shape()
    lattice = classic_lattice(mask, 2.0, density=1e-6, origin=(1.0, 2.0, 3.0))
    values = np.random.default_rng(0).uniform(1.0, 2.0, mask.shape)
    got = voxel_parameters(lattice, mask, values, (1.0, 2.0, 3.0))
    grid = np.rint((lattice.points - (1.0, 2.0, 3.0)) / 2.0)
    cells = np.argwhere(mask)
    for e, (i, j) in enumerate(lattice.elements):
        holds = [(np.abs(grid[[i, j]] - c - 0.5) < 0.75).all() for c in cells]
        assert got[e] == pytest.approx(values[tuple(cells[holds].T)].mean())


@pytest.mark.parametrize(
    ("k", "c1", "c2"), [(0.0, 0.3, 2.0), (5.0, 0.0, 2.0), (5.0, 0.3, np.inf), (0.0, 0.3, np.inf), (5e9, 0.3, 2.0), (1e-9, 2.0, 3.0)]
)
def test_the_coefficients_of_the_step_have_their_limits(k, c1, c2):
    lattice = single()
    h = 2e-3
    a, b, decay, g = (float(x[0]) for x in implicit_coefficients(lattice_parameters(lattice, k, c1, c2), h))
    assert min(a, b, decay, g) >= 0.0
    if k == 0.0:
        assert a * h == pytest.approx(c1 if np.isinf(c2) else c1 * c2 / (c1 + c2))
    elif np.isinf(c2):
        assert (a, b, decay, g) == pytest.approx((c1 / h + k / 2, k, 1.0, 1.0))
    elif k == 5e9:  # the spring is rigid: only the series dashpot is left
        assert a * h == pytest.approx(c2, rel=1e-5)


def test_relaxation_of_one_element_is_exact():
    """Stretched evenly in one step and constrained: y decays exponentially and the mean tension of a step is C2 times its fall."""
    k, c1, c2, h, stretch, length = 3.0, 0.4, 0.9, 2e-3, 0.05, 10.0
    lattice = single()
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, k, c1, c2), step=h)
    path = np.zeros((200, 2, 3))
    path[0, 1, 2] = stretch / h
    constrained = ConstrainedNodes.of([0], 0) + ConstrainedNodes.of([1], 1)
    motion = engine.run(engine.rest(), 200, constrained, path)
    tau = (c1 + c2) / k
    y1 = c2 / k * (1.0 - np.exp(-h / tau)) * stretch / h
    t = h * np.arange(1, 200)
    y = y1 * np.exp(-t / tau)
    assert motion.state.extension[0] == pytest.approx(y[-1], rel=1e-9)
    np.testing.assert_allclose(motion.reaction[2:, 1, 2], c2 * (y[:-1] - y[1:]) / h, rtol=1e-9)  # the node stops in the second step
    np.testing.assert_allclose(motion.reaction[2:, 0], -motion.reaction[2:, 1], atol=1e-12)
    assert length + stretch == pytest.approx(motion.state.position[1, 2])


def creep(method, h, t_press=0.4, t_rest=2.0):
    k, c1, c2, force = 3.0, 0.4, 9.0, 1.2
    lattice = single(1e-3)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, k, c1, c2), step=h, method=method, tolerance=1e-10)
    constrained = ConstrainedNodes.of([0])
    pressed = engine.run(engine.rest(), round(t_press / h), constrained, external_force=[[0, 0, 0], [0, 0, force]])
    rested = engine.run(pressed.state, round(t_rest / h), constrained)
    exact = force / k * (1.0 - np.exp(-k * t_press / c1)) + force * t_press / c2
    return pressed.state.position[1, 2] - 10.0, exact, rested.state.position[1, 2] - 10.0, force * t_press / c2


@pytest.mark.parametrize("method", METHODS)
def test_creep_and_residual_of_one_element_converge(method):
    """Creep F/K (1 - exp(-K t / C1)) + F t / C2; what stays after release is the integral of F / C2, so that a larger C2 leaves less."""
    steps = np.array([4e-4, 2e-4, 1e-4])
    errors, leftovers = [], []
    for h in steps:
        at_press, exact, at_rest, residual = creep(method, h)
        errors.append(at_press - exact)
        leftovers.append(at_rest - residual)
        assert at_rest == pytest.approx(residual, rel=3e-3)
        assert at_press == pytest.approx(exact, rel=5e-3)
    assert creep("implicit", 2e-3)[0] == pytest.approx(exact, rel=0.02)


def test_the_implicit_method_converges_at_first_order_to_the_explicit_one():
    lattice = classic_lattice(box_mask((2, 2, 3)), 10.0, total_mass_kg=0.02)
    parameters = lattice_parameters(lattice, 5.0, 0.02, 0.3)
    base, top = np.flatnonzero(lattice.points[:, 2] < 1.0), np.flatnonzero(lattice.points[:, 2] > 29.0)
    constrained = ConstrainedNodes.of(base, 0) + ConstrainedNodes.of(top, 1)

    def press(method, h):
        engine = LatticeEngine.of(lattice, parameters, step=h, method=method, tolerance=1e-9)
        return engine.run(engine.rest(), round(0.1 / h), constrained, [[0, 0, 0], [10.0, 0, -40.0]]).state.position

    reference = 2.0 * press("symplectic_euler", 5e-6) - press("symplectic_euler", 1e-5)
    error = [np.abs(press("implicit", h) - reference).max() for h in (2e-3, 1e-3, 5e-4)]
    rates = np.log2(np.array(error[:-1]) / error[1:])
    assert (rates > 0.8).all()
    assert (rates < 1.3).all()


def spinning(lattice, seed=0, speed=30.0):
    rng = np.random.default_rng(seed)
    velocity = speed * rng.normal(size=lattice.points.shape) + np.cross([0.5, -2.0, 3.0], lattice.points)
    return LatticeState(lattice.points, velocity, 0.3 * rng.normal(size=lattice.n_elements))


@pytest.mark.parametrize("tolerance", [0.3, 1e-2])
def test_a_free_body_keeps_both_momenta(tolerance):
    lattice = classic_lattice(l_shape(), 10.0, total_mass_kg=0.1)
    parameters = lattice_parameters(lattice, {"short": 9.0, "normal": 30.0, "long": 1.0}, 0.05, 0.4)
    engine = LatticeEngine.of(lattice, parameters, tolerance=tolerance)
    start = spinning(lattice)
    end = engine.run(start, 300).state
    for before, after in zip(momenta(lattice, start), momenta(lattice, end), strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-10, atol=1e-10 * np.abs(before).max())
    assert np.abs(end.velocity - start.velocity).max() > 10.0


def test_symplectic_steps_keep_both_momenta():
    lattice = classic_lattice(l_shape(), 10.0, total_mass_kg=0.1)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 5.0, 0.01, 0.3), step=1e-4, method="symplectic_euler")
    start = spinning(lattice)
    for before, after in zip(momenta(lattice, start), momenta(lattice, engine.run(start, 300).state), strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-10, atol=1e-10 * np.abs(before).max())


def test_a_rotated_body_moves_as_the_other_did():
    """Objectivity: rotate the start, and everything after it is rotated."""
    lattice = classic_lattice(l_shape(), 10.0, total_mass_kg=0.1)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 9.0, 0.05, 0.4), tolerance=1e-6)
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    start = spinning(lattice)
    turned = LatticeState(start.position @ turn.T, start.velocity @ turn.T, start.extension)
    one, two = engine.run(start, 50).state, engine.run(turned, 50).state
    np.testing.assert_allclose(two.position, one.position @ turn.T, atol=1e-4)


def test_finite_rotations_do_not_strain_and_do_not_drift():
    """A body without residual extension (C2 infinite) turned ten times by a handle comes back to its shape."""
    lattice = classic_lattice(box_mask((2, 1, 1)), 10.0, total_mass_kg=0.02)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 50.0, 1.0, np.inf))
    rate, n = 2.0 * np.pi, 5000
    angle = rate * engine.step * np.arange(n + 1)
    radius = 5.0
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    ends = [int(np.argmin(lattice.points @ [s, 1.0, 1.0])) for s in (1.0, -1.0)]
    middle = lattice.points[ends].mean(axis=0)
    arm = lattice.points[ends] - middle
    path = np.zeros((n, 2, 3))
    for k, a in enumerate(arm):
        size = a[0] / radius
        path[:, k] = size * np.diff(ring, axis=0) / engine.step
    constrained = ConstrainedNodes.of([ends[0]], 0) + ConstrainedNodes.of([ends[1]], 1)
    end = engine.run(engine.rest(), n, constrained, path)
    still = engine.run(LatticeState(end.state.position, 0.0 * end.state.velocity, end.state.extension), 2000, constrained).state
    lengths = np.linalg.norm(still.position[lattice.elements[:, 1]] - still.position[lattice.elements[:, 0]], axis=1)
    np.testing.assert_allclose(still.extension, lengths - lattice.lengths, atol=2e-3)
    np.testing.assert_allclose(lengths, lattice.lengths, atol=4e-3)


def energies(lattice, parameters, step, tolerance, start, constrained, steps):
    engine = LatticeEngine.of(lattice, parameters, step=step, tolerance=tolerance)
    state, found = start, [engine.energy(start)]
    for _ in range(steps):
        state = engine.run(state, 1, constrained).state
        found.append(engine.energy(state))
    return np.array(found)


def random_energy(lattice, seed):
    """Return energies of a lattice with parameters drawn over a hundred times the printed ranges, in g/s^2 and in kg/s^2."""
    rng = np.random.default_rng(seed)
    unit = 10.0 ** rng.choice([-3.0, 0.0])
    draw = [
        unit * np.exp(rng.uniform(np.log(low / 100.0), np.log(100.0 * high), lattice.n_elements))
        for low, high in ((500, 3e4), (100, 2e4), (500, 3e4))
    ]
    if rng.random() < 0.5:  # alike in all elements of a class
        draw = [values[rng.integers(len(values), size=3)][lattice.element_class] for values in draw]
    if rng.random() < 0.2:
        draw[rng.integers(2)][:] = 0.0
    if rng.random() < 0.1:
        draw[2][:] = np.inf
    start = spinning(lattice, seed, speed=10.0 ** rng.uniform(-2, 3))
    constrained = ConstrainedNodes.of([0, 1, 2]) if rng.random() < 0.5 else None
    if constrained is not None:
        start.velocity[:3] = 0.0
    return energies(lattice, lattice_parameters(lattice, *draw), 2e-3, 10.0 ** rng.uniform(-6, -0.05), start, constrained, 20)


def grows(found, rounding=1e-9):
    return np.diff(found).max() > rounding * found[0]


@pytest.mark.parametrize("block", range(4))
def test_energy_never_grows(block):
    lattice = classic_lattice(l_shape() if block % 2 else box_mask((2, 2, 2)), 10.0, total_mass_kg=10.0 ** (block - 3))
    bad = [seed for seed in range(50 * block, 50 * block + 50) if grows(random_energy(lattice, seed))]
    assert bad == []


@pytest.mark.slow
def test_energy_never_grows_in_ten_thousand_draws():
    lattices = [
        classic_lattice(mask, 10.0, total_mass_kg=mass)
        for mask in (l_shape(), box_mask((2, 2, 2)), box_mask((1, 1, 1)))
        for mass in (1e-3, 0.05)
    ]
    assert [seed for seed in range(10_000) if grows(random_energy(lattices[seed % 6], seed))] == []


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.floats(0.0, 1e7), st.floats(0.0, 1e7), st.floats(1e-6, 1e7), st.floats(1e-5, 1.0), st.floats(1e-8, 0.99), st.floats(-1e3, 1e3))
def test_energy_never_grows_for_any_step(k, c1, c2, step, tolerance, spin):
    lattice = classic_lattice(box_mask((1, 1, 2)), 10.0, total_mass_kg=0.05)
    start = LatticeState(lattice.points, np.cross([0.0, spin, 1.0], lattice.points - 10.0), np.zeros(lattice.n_elements))
    parameters = lattice_parameters(lattice, k, c1, c2)
    rounding = 1e-9 + 1e-14 * step**2 * implicit_coefficients(parameters, step)[0].max() / lattice.node_mass.min()
    assert not grows(energies(lattice, parameters, step, tolerance, start, None, 15), rounding)


def test_reactions_balance_momentum():
    lattice = classic_lattice(box_mask((3, 2, 2)), 10.0, total_mass_kg=0.2)
    top = np.flatnonzero(lattice.points[:, 2] > 19.0)
    constrained = ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 2] < 1.0), 0, axes=(2,)) + ConstrainedNodes.of(top, 1)
    for method in METHODS:
        engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 9.0, 0.05, 0.4), step=1e-4, method=method, tolerance=1e-8)
        motion = engine.run(engine.rest(), 200, constrained, [[0, 0, 0], [3.0, 1.0, -20.0]], external_force=[0.0, 0.1, -0.2])
        impulse = engine.step * (motion.reaction.sum(axis=(0, 1)) + 200 * lattice.n_nodes * np.array([0.0, 0.1, -0.2]))
        np.testing.assert_allclose(momenta(lattice, motion.state)[0], impulse, rtol=1e-7, atol=1e-8)


def test_threads_and_precision_change_nothing_but_the_last_digits():
    lattice = classic_lattice(box_mask((9, 7, 10)), 5.0, total_mass_kg=0.6)
    parameters = lattice_parameters(lattice, 10.0, 0.01, 0.02)
    z = lattice.points[:, 2]
    constrained = ConstrainedNodes.of(np.flatnonzero(z < 1), 0) + ConstrainedNodes.of(np.flatnonzero(z > 49), 1, axes=(2, 0))
    runs = []
    for options in ({"threads": 1}, {"threads": 2}, {"threads": 3}, {"precision": "single"}):
        engine = LatticeEngine.of(lattice, parameters, step=1e-4, method="euler", **options)
        runs.append(engine.run(engine.rest(), 60, constrained, [[0, 0, 0], [5.0, 0, -30.0]], external_force=[0.0, 0.0, -1e-3]))
    for other, digits in zip(runs[1:], (1e-12, 1e-12, 3e-5), strict=True):
        np.testing.assert_allclose(other.state.position, runs[0].state.position, atol=digits * 10.0)
        np.testing.assert_allclose(other.reaction, runs[0].reaction, atol=digits * np.abs(runs[0].reaction).max() * 10.0)


def test_a_large_lattice_takes_some_of_many_cores_and_a_small_one_takes_one(monkeypatch):
    monkeypatch.setattr(engine_module.numba, "get_num_threads", lambda: 16)
    for cells, expected in ((15, engine_module.MOST_THREADS), (3, 1)):
        lattice = classic_lattice(box_mask((cells,) * 3), 5.0, total_mass_kg=0.6)
        parameters = lattice_parameters(lattice, 10.0, 0.01, 0.02)
        assert LatticeEngine.of(lattice, parameters, step=1e-4).threads == expected
        assert LatticeEngine.of(lattice, parameters, step=1e-4, threads=9).threads == 9


def test_explicit_steps_blow_up_beyond_their_limit_and_say_so():
    lattice = classic_lattice(box_mask((3, 3, 3)), 10.0, total_mass_kg=0.1)
    parameters = lattice_parameters(lattice, 30.0, 0.01, 5.0)
    limit = explicit_step_limit(lattice, parameters)
    start = spinning(lattice, speed=1.0)
    LatticeEngine.of(lattice, parameters, step=0.9 * limit, method="symplectic_euler").run(start, 2000)
    with pytest.raises(ConvergenceError, match="implicit"):
        LatticeEngine.of(lattice, parameters, step=8.0 * limit, method="symplectic_euler").run(start, 2000)


def test_volumetric_springs_have_mass_and_uniaxial_stiffness():
    mesh = box((20.0, 10.0, 10.0), (4, 2, 2), cell_type="tetra")
    lattice, parameters = volumetric_lattice(mesh, density=1e-6, young_modulus=5.0)
    assert lattice.total_mass == pytest.approx(2e-3)
    # an affine stretch of the edges stores sum K (L e.S.e)^2 / 2 = E sum_e sum_V V (e.S.e)^2 / 2, whatever the mesh
    tetra = mesh.points[mesh.cells]
    i, j = np.triu_indices(4, 1)
    along = (tetra[:, j] - tetra[:, i]) / np.linalg.norm(tetra[:, j] - tetra[:, i], axis=2, keepdims=True)
    volumes = np.abs(np.linalg.det(tetra[:, 1:] - tetra[:, :1])) / 6.0
    stretch = np.diag([0.02, -0.01, 0.03])
    edge = lattice.points[lattice.elements[:, 1]] - lattice.points[lattice.elements[:, 0]]
    stored = 0.5 * (parameters.stiffness * (np.einsum("ma,ab,mb->m", edge, stretch, edge) / lattice.lengths) ** 2).sum()
    assert stored == pytest.approx(0.5 * 5.0 * (volumes[:, None] * np.einsum("tka,ab,tkb->tk", along, stretch, along) ** 2).sum())
    printed = volumetric_lattice(mesh, density=1e-6, young_modulus=5.0, damping="printed")[1]
    np.testing.assert_allclose(printed.voigt_damping * lattice.lengths, parameters.voigt_damping)
    engine = LatticeEngine.of(lattice, parameters)
    start = spinning(lattice, speed=1.0)
    end = engine.run(start, 20).state
    np.testing.assert_allclose(momenta(lattice, end)[1], momenta(lattice, start)[1], rtol=1e-9, atol=1e-9)
    assert engine.energy(end) < engine.energy(start)


BOX = classic_lattice(box_mask((2, 2, 2)), 1.0, density=1e-6)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: classic_lattice(np.zeros((2, 2, 2), bool), 1.0, density=1.0), "no voxel"),
        (lambda: classic_lattice(np.ones((2, 2), bool), 1.0, density=1.0), "three axes"),
        (lambda: classic_lattice(np.array([1, 0, 1], bool).reshape(3, 1, 1), 1.0, density=1.0), "2 pieces"),
        (lambda: classic_lattice(np.full((2, 2, 2), np.nan), 1.0, density=1.0), "8 NaN"),
        (lambda: classic_lattice(box_mask((1, 1, 1)), 0.0, density=1.0), "spacing"),
        (lambda: classic_lattice(box_mask((1, 1, 1)), 1.0, density=-1.0), "density"),
        (lambda: classic_lattice(box_mask((1, 1, 1)), 1.0), "one of the two"),
        (lambda: classic_lattice(box_mask((1, 1, 1)), 1.0, density=1.0, lumping="x"), "'x'"),
        (lambda: lattice_parameters(BOX, -1.0, 1.0, 1.0), "K of element 0 is -1"),
        (lambda: lattice_parameters(BOX, 1.0, np.nan, 1.0), "C1 of element 0 is nan"),
        (lambda: lattice_parameters(BOX, 1.0, 1.0, 0.0), "C2"),
        (lambda: lattice_parameters(BOX, 1.0, 1.0, 1.0, 1.0), "between 0 and 1"),
        (lambda: lattice_parameters(BOX, {"short": 1.0}, 1.0, 1.0), "normal, long"),
        (lambda: lattice_parameters(BOX, {"thick": 1.0}, 1.0, 1.0), "thick"),
        (lambda: lattice_parameters(BOX, np.ones(3), 1.0, 1.0), "(3,)"),
        (lambda: engine().run(LatticeState(np.full((27, 3), np.nan), np.zeros((27, 3)), np.zeros(BOX.n_elements)), 1), "NaN"),
        (lambda: engine().run(engine().rest(), 1, ConstrainedNodes.of([27])), "0 to 26"),
        (lambda: engine().run(engine().rest(), 1, ConstrainedNodes.of([2]) + ConstrainedNodes.of([2], 1)), "node 2 is constrained twice"),
        (lambda: engine().run(engine().rest(), 1, ConstrainedNodes.of([2]), np.zeros((2, 1, 3))), "(2, 1, 3)"),
        (lambda: engine(step=0.0), "the step"),
        (lambda: engine(method="heun"), "heun"),
    ],
)
def test_bad_input_is_named(call, said):
    with pytest.raises(InputError) as caught:
        call()
    assert said in str(caught.value)


def engine(**options):
    return LatticeEngine.of(BOX, lattice_parameters(BOX, 1.0, 1.0, 1.0), **options)


def irregular_masks():
    rng = np.random.default_rng(5)
    yield box_mask((1, 1, 1))
    yield box_mask((4, 3, 5))
    yield l_shape()
    for _ in range(4):
        mask = rng.random(rng.integers(3, 8, 3)) < 0.6
        mask[1] = True  # keeps most of it together
        pieces, _ = label(mask, np.ones((3, 3, 3)))
        yield pieces == pieces[1, 0, 0]
    corner = np.zeros((2, 2, 2), dtype=bool)  # two voxels that share one corner
    corner[0, 0, 0] = corner[1, 1, 1] = True
    yield corner


@pytest.mark.parametrize("mask", list(irregular_masks()))
def test_nodes_and_elements_are_those_of_every_voxel_by_itself(mask):
    lattice = classic_lattice(mask, 0.5, density=1e-6)
    corners = [[tuple(at + step) for step in np.ndindex(2, 2, 2)] for at in np.argwhere(mask)]
    nodes = sorted({c for own in corners for c in own}, key=lambda c: c[::-1])
    number = {c: k for k, c in enumerate(nodes)}
    around = Counter(c for own in corners for c in own)
    surface = np.array([around[c] < 8 for c in nodes])
    pairs = sorted({tuple(sorted((number[a], number[b]))) for own in corners for a, b in combinations(own, 2)})
    np.testing.assert_array_equal(lattice.points, 0.5 * np.array(nodes))
    np.testing.assert_array_equal(lattice.elements, pairs)
    np.testing.assert_array_equal(lattice.surface_node, surface)
    np.testing.assert_array_equal(lattice.element_zone, surface[lattice.elements].any(axis=1))
    np.testing.assert_array_equal(
        lattice.element_class + 1, np.count_nonzero(np.diff(lattice.points[lattice.elements], axis=1)[:, 0], axis=1)
    )
    np.testing.assert_allclose(lattice.node_mass, [around[c] * 0.5**3 / 8 * 1e-6 for c in nodes])
    for at, cell in zip(np.argwhere(mask), lattice.cells, strict=True):
        np.testing.assert_array_equal(lattice.points[cell[[0, 6]]], 0.5 * np.array([at, at + 1]))
        np.testing.assert_array_equal(lattice.points[cell[[1, 3, 4]]], 0.5 * (at + np.eye(3)))
