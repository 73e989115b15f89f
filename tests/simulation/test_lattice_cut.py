"""Cutting of lattices: conservation, distance from the blade, pieces, fronts, crossing cuts, sessions in contact, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics import (
    ConstrainedNodes,
    Lattice,
    LatticeEngine,
    LatticeParameters,
    LatticeState,
    box_mask,
    classic_lattice,
    general_lattice,
    lattice_parameters,
    octree_lattice,
    plane_indenter,
    spherical_indenter,
)
from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.lattices.model.surface import surface_of, surface_triangles
from naibu.meshing import SweptBlade, swept_blade
from naibu.simulation import LatticeCut, cut_lattice, cut_session

N, EDGE = 8, 2.0
SIZE = N * EDGE
KINDS = ("classic", "octree 0", "octree 1", "octree 2")


def made(kind: str = "classic", *, elastic: bool = False) -> tuple[Lattice, LatticeParameters]:
    mask = box_mask((N, N, N))
    lattice = classic_lattice(mask, EDGE, density=1e-6) if kind == "classic" else octree_lattice(mask, EDGE, int(kind[-1]), density=1e-6)
    return lattice, lattice_parameters(lattice, 10.0, 0.0 if elastic else 0.1, np.inf if elastic else 5.0)


def upright(x: float, until_y: float = 60.0) -> SweptBlade:
    return swept_blade([[[x, y, -40.0], [x, y, 60.0]] for y in (-40.0, until_y)])


def level(z: float) -> SweptBlade:
    return swept_blade([[[-40.0, y, z], [60.0, y, z]] for y in (-40.0, 60.0)])


def random_plane(seed: int) -> SweptBlade:
    rng = np.random.default_rng(seed)
    u, v, _ = 60.0 * np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    return swept_blade(rng.uniform(2.0, SIZE - 2.0, 3) + np.array([[-u - v, v - u], [u - v, u + v]]))


def moving(lattice: Lattice, seed: int = 0) -> LatticeState:
    rng = np.random.default_rng(seed)
    position = lattice.points @ (np.eye(3) + rng.normal(scale=0.03, size=(3, 3)))
    velocity = rng.normal(scale=20.0, size=position.shape) + 10.0
    return LatticeState(position, velocity, rng.normal(scale=0.05, size=lattice.n_elements))


def surface_volume(cut: LatticeCut) -> float:
    a, b, c = cut.lattice.points[surface_of(cut.lattice).triangles].transpose(1, 0, 2)
    return float((a * np.cross(b - a, c - a)).sum() / 6.0)


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("kind", KINDS)
def test_a_plane_leaves_two_pieces_and_everything_that_there_was(kind: str, seed: int) -> None:
    lattice, parameters = made(kind)
    cut = cut_lattice(lattice, parameters, plane := random_plane(seed))
    assert lattice.cells is not None and cut.lattice.cells is not None
    sizes = np.bincount(cut.piece, np.ptp(lattice.points[lattice.cells], axis=1).prod(axis=1))
    largest = np.ptp(lattice.points[lattice.cells][..., 0], axis=1).max()
    if kind == "octree 2":  # whose cubes on the surface are large: parts beside the blade may come loose, and a corner may hold no centre
        a, b, c = plane.points[plane.triangles[0]]
        normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        height = (lattice.points[lattice.cells].mean(axis=1) - a) @ normal
        assert len(sizes) >= (2 if height.min() < 0.0 < height.max() else 1)
        assert np.abs(height[cut.piece > 1]).max(initial=0.0) < largest
        assert sizes[2:].sum() < 0.1 * SIZE**3
    else:
        assert len(sizes) == 2
    assert cut.lattice.total_mass == pytest.approx(lattice.total_mass, rel=1e-12)
    assert surface_volume(cut) == pytest.approx(SIZE**3, rel=1e-12)  # closed, and outwards
    for name in ("stiffness", "voigt_damping", "series_damping"):
        parts = np.bincount(cut.element_source, getattr(cut.parameters, name), minlength=lattice.n_elements)
        np.testing.assert_allclose(parts, getattr(parameters, name), rtol=1e-12)
    np.testing.assert_allclose(np.bincount(cut.source, cut.share), 1.0, rtol=1e-12)
    assert cut.deviation_mm <= (np.sqrt(0.75) * EDGE if kind == "classic" else 1.1 * largest)
    of_node = np.full(cut.lattice.n_nodes, -1)
    of_node[cut.lattice.cells] = cut.piece[:, None]
    np.testing.assert_array_equal(of_node[cut.lattice.cells], np.repeat(cut.piece[:, None], 8, axis=1))  # pieces share no node
    np.testing.assert_array_equal(*of_node[cut.lattice.elements].T)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_a_blade_that_goes_on_in_small_steps_cuts_as_in_one_go(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    edge, way, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    centre, places = rng.uniform(5.0, SIZE - 5.0, 3), np.linspace(-20.0, 20.0, 80)  # a quarter of a cube a step
    poses = centre + places[:, None, None] * way + np.array([-40.0, 40.0])[:, None] * edge
    lattice, parameters = before = made(kind)
    area = 0.0
    for k in range(len(poses) - 1):
        cut = cut_lattice(lattice, parameters, swept_blade(poses[k : k + 2]))
        lattice, parameters, area = cut.lattice, cut.parameters, area + _area(lattice, cut)
    whole = cut_lattice(*before, swept_blade(poses[[0, -1]]))
    np.testing.assert_array_equal(np.bincount(cut.piece), np.bincount(whole.piece))
    assert cut.n_pieces >= 2 and lattice.n_nodes == whole.lattice.n_nodes
    assert area == pytest.approx(_area(before[0], whole), rel=1e-12)
    assert lattice.total_mass == pytest.approx(before[0].total_mass, rel=1e-12)


def _area(before: Lattice, cut: LatticeCut) -> float:
    """Area of the new surface; it is what was added to the surface."""
    added, old, new = (
        _areas(at.points, t) for at, t in ((cut.lattice, cut.faces), *((x, surface_triangles(x)) for x in (before, cut.lattice)))
    )
    assert new - old == pytest.approx(added, abs=1e-9)
    return added


def _areas(points: FloatArray, triangles: IntArray) -> float:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_a_blade_that_parts_two_cubes_inside_opens_nothing_until_it_goes_on() -> None:
    lattice, parameters = made()
    small = swept_blade([[[8.0, 6.4, z], [8.0, 7.6, z]] for z in (6.4, 7.6)])  # through one face, whose nodes other cubes hold together
    cut = cut_lattice(lattice, parameters, small)
    assert not len(cut.faces) and cut.lattice.n_nodes == lattice.n_nodes
    np.testing.assert_array_equal(surface_triangles(cut.lattice), surface_triangles(lattice))
    behind = cut_lattice(cut.lattice, cut.parameters, swept_blade([[[8.0, y, z] for y in (7.6, 60.0)] for z in (-40.0, 60.0)]))
    ahead = cut_lattice(behind.lattice, behind.parameters, swept_blade([[[8.0, y, z] for y in (-40.0, 6.4)] for z in (-40.0, 60.0)]))
    slit = [swept_blade([[[8.0, 6.4, z], [8.0, 7.6, z]] for z in ends]) for ends in ((-40.0, 6.4), (7.6, 60.0))]
    for blade in slit:
        ahead = cut_lattice(ahead.lattice, ahead.parameters, blade)
    assert ahead.n_pieces == 2
    assert _areas(ahead.lattice.points, surface_triangles(ahead.lattice)) == pytest.approx(8 * SIZE**2, rel=1e-12)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(2.0, 14.0))
def test_cubes_hold_together_by_faces_only(seed: int, until_y: float) -> None:
    first = cut_lattice(*made(), upright(7.3, until_y))
    cut = cut_lattice(first.lattice, first.parameters, random_plane(seed))
    cells = cut.lattice.cells
    assert cells is not None
    cube, node = np.repeat(np.arange(len(cells)), 8), cells.ravel()
    order = np.argsort(node, kind="stable")
    for around in np.split(cube[order], np.unique(node[order], return_index=True)[1][1:]):
        joined, left = {int(around[0])}, {int(c) for c in around[1:]}
        while near := {c for c in left if any(len(set(cells[c]) & set(cells[d])) == 4 for d in joined)}:
            joined, left = joined | near, left - near
        assert not left


def test_two_cubes_become_two_lattices_of_one_cube() -> None:
    lattice = classic_lattice(box_mask((2, 1, 1)), 1.0, density=8.0)
    cut = cut_lattice(lattice, lattice_parameters(lattice, 10.0, 1.0, 4.0), upright(1.0))
    assert (cut.lattice.n_nodes, cut.lattice.n_elements, cut.n_pieces) == (16, 56, 2)
    np.testing.assert_allclose(cut.lattice.node_mass, 1.0)
    middle = np.abs(cut.lattice.points[cut.lattice.elements][..., 0] - 1.0).max(axis=1) < 1e-9  # the face that was shared
    np.testing.assert_allclose(cut.parameters.stiffness, np.where(middle, 5.0, 10.0))
    assert middle.sum() == 12


@pytest.mark.parametrize("kind", KINDS)
def test_momentum_energy_and_forces_are_those_before_the_cut(kind: str) -> None:
    lattice, parameters = made(kind)
    state = moving(lattice)
    engine = LatticeEngine.of(lattice, parameters, step=1e-7, method="symplectic_euler")
    cut = cut_lattice(lattice, parameters, upright(7.0, 9.0), positions=state.position)
    behind = LatticeEngine.of(cut.lattice, cut.parameters, step=1e-7, method="symplectic_euler")
    assert len(cut.source) > lattice.n_nodes
    assert behind.energy(cut.state(state)) == pytest.approx(engine.energy(state), rel=1e-12)
    ends = [e.run(s, 1).state.velocity for e, s in ((engine, state), (behind, cut.state(state)))]
    impulse = cut.lattice.node_mass[:, None] * (ends[1] - state.velocity[cut.source])
    whole = np.stack([np.bincount(cut.source, impulse[:, k]) for k in range(3)], axis=1)
    expected = lattice.node_mass[:, None] * (ends[0] - state.velocity)
    np.testing.assert_allclose(whole, expected, atol=1e-9 * np.abs(expected).max())


def test_energy_and_momentum_stay_as_they_are_while_the_cut_opens() -> None:
    lattice, parameters = made(elastic=True)
    rest = np.zeros(lattice.n_elements)
    state = LatticeState(lattice.points, 30.0 * (lattice.points - SIZE / 2) @ np.diag([1.0, -0.3, -0.3]) + 5.0, rest)
    cut = cut_lattice(lattice, parameters, upright(7.0, 9.0), positions=state.position)
    engine = LatticeEngine.of(cut.lattice, cut.parameters, step=2e-5, method="symplectic_euler")
    energy, momentum = engine.energy(cut.state(state)), (lattice.node_mass[:, None] * state.velocity).sum(axis=0)
    after = engine.run(cut.state(state), 1000).state
    assert engine.energy(after) == pytest.approx(energy, rel=0.01)  # of symplectic Euler steps
    np.testing.assert_allclose((cut.lattice.node_mass[:, None] * after.velocity).sum(axis=0), momentum, rtol=1e-9)
    gap = [np.ptp(after.position[cut.source == v], axis=0).max() for v in np.flatnonzero(np.bincount(cut.source) > 1)]
    assert max(gap) > 0.05


@pytest.mark.parametrize("kind", ["classic", "octree 1"])
def test_a_partial_cut_leaves_one_piece_whose_front_holds(kind: str) -> None:
    lattice, parameters = made(kind)
    cut = cut_lattice(lattice, parameters, upright(8.0, 7.0))
    assert cut.n_pieces == 1
    doubled = np.bincount(cut.source)[cut.source] > 1
    assert doubled.any() and cut.lattice.points[doubled][:, 1].max() < 9.0
    front = np.setdiff1d(np.unique(cut.faces), np.flatnonzero(doubled))
    assert len(front)
    assert cut.lattice.surface_node[cut.faces].all()


def test_crossing_cuts_and_a_blade_that_goes_back() -> None:
    lattice, parameters = made()
    first = cut_lattice(lattice, parameters, upright(8.0))
    again = cut_lattice(first.lattice, first.parameters, upright(8.0))
    assert again.n_pieces == 2 and not len(again.faces) and again.lattice.n_nodes == first.lattice.n_nodes
    second = cut_lattice(first.lattice, first.parameters, level(8.0))
    assert second.n_pieces == 4
    np.testing.assert_array_equal(np.bincount(second.piece), [N**3 // 4] * 4)
    there = [[[8.0, y, -40.0], [8.0, y, 60.0]] for y in (-40.0, 60.0)]
    assert cut_lattice(lattice, parameters, swept_blade(there + there[::-1])).n_pieces == 2


def test_a_loose_piece_falls_and_the_other_stays() -> None:
    lattice, parameters = made()
    weight = lattice.node_mass[:, None] * np.array([0.0, 0.0, -9800.0])
    held = ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 0] < 1e-9))
    session = LatticeEngine.of(lattice, parameters, step=1e-3, tolerance=1e-8).session(None, held, weight)
    session, cut = cut_session(session, level(9.0))
    old = np.flatnonzero(np.isin(cut.source, held.node))  # copies are held too
    assert len(old) > len(np.unique(held.node))
    np.testing.assert_array_equal(np.unique(session.constrained.node), old)
    session, cut = cut_session(session, upright(7.0))
    session.step(np.zeros((1, 3)), steps=30)
    moved, loose = session.positions() - cut.lattice.points, cut.lattice.points[:, 0] > 8.5
    fall = -0.5 * 9800.0 * 0.03 * 0.031  # of implicit Euler steps
    np.testing.assert_allclose(moved[loose], np.tile([0.0, 0.0, fall], (int(loose.sum()), 1)), atol=1e-5 * abs(fall))
    assert np.abs(moved[cut.lattice.points[:, 0] < 1e-9]).max() < 1e-12
    session.close()


def test_a_session_is_cut_in_contact_and_the_new_surface_is_touched() -> None:
    lattice, parameters = made()
    floor = plane_indenter((0.0, 0.0, 0.0), static_friction=0.5, kinetic_friction=0.5)
    ball = spherical_indenter((SIZE / 2, SIZE / 2, SIZE + 4.0), 4.0, static_friction=0.5, kinetic_friction=0.5)
    engine = LatticeEngine.of(lattice, parameters, step=1e-3)
    session = engine.session(indenters=(floor, ball))
    still, down = IndenterVelocity(), IndenterVelocity(np.array([0.0, 0.0, -20.0]))
    session.step(motions=[still, down], steps=100)
    before = session.step(motions=[still, still], steps=1).indenters[-1]
    made_session, cut = cut_session(session, upright(SIZE / 2))
    after = made_session.step(motions=[still, still], steps=1).indenters[-1]
    assert cut.n_pieces == 2
    assert before[1, 2] < -1.0
    np.testing.assert_allclose(after, before, atol=0.1 * np.abs(before).max())  # one step later
    made_session.close()


def test_a_cut_under_an_indenter_gives_no_impulse() -> None:
    """New faces that an indenter overlaps began with a pressure that grew as steps grew shorter, and threw the sides apart."""
    lattice, parameters = made()
    floor, ball = plane_indenter((0.0, 0.0, 0.0)), spherical_indenter((SIZE / 2, SIZE / 2, SIZE + 4.0), 4.0)
    session = LatticeEngine.of(lattice, parameters, step=1e-4).session(indenters=(floor, ball))
    still, down = IndenterVelocity(), IndenterVelocity(np.array([0.0, 0.0, -20.0]))
    session.step(motions=[still, down], steps=1000)
    before = session.step(motions=[still, still], steps=300).indenters[-1]
    made_session, _ = cut_session(session, upright(SIZE / 2))
    after = made_session.step(motions=[still, still], steps=1).indenters[-1]
    np.testing.assert_allclose(after, before, atol=0.03 * np.abs(before).max())
    made_session.close()


def test_the_new_surface_is_touched() -> None:
    lattice, parameters = made()
    session = LatticeEngine.of(lattice, parameters, step=1e-3).session()
    session, cut = cut_session(session, upright(SIZE / 2))
    right = np.unique(cut.lattice.cells[cut.piece == cut.piece[-1]])
    left = np.setdiff1d(np.arange(cut.lattice.n_nodes), right)
    held = [nodes[np.abs(cut.lattice.points[nodes, 0] - end) < 1e-9] for nodes, end in ((left, 0.0), (right, SIZE))]
    session.constrain(ConstrainedNodes.of(held[0], 0) + ConstrainedNodes.of(held[1], 1))
    session.step([[0.0, 0, 0], [100.0, 0, 0]], steps=100)  # apart by 10 mm
    session.step([[0.0, 0, 0], [0.0, 0, 0]], steps=300)
    ball = spherical_indenter((SIZE / 2 + 5.0, SIZE / 2, SIZE / 2), 4.0)
    session.press([ball])
    force = session.step(0.0, [IndenterVelocity(np.array([-20.0, 0.0, 0.0]))], steps=100).indenters[-1, 0]  # 2 mm towards the left one
    assert force[0] < -1.0 and np.abs(force[1:]).max() < 0.05 * -force[0]
    session.close()


def test_what_cannot_be_cut_is_refused() -> None:
    lattice, parameters = made()
    springs = general_lattice([[0.0, 0, 0], [1.0, 0, 0]], [[0, 1]], [1.0, 1.0])
    with pytest.raises(InputError, match="has no cubes"):
        cut_lattice(springs, lattice_parameters(springs, 1.0, 1.0, 1.0), upright(0.5))
    with pytest.raises(InputError, match="parameters"):
        cut_lattice(lattice, LatticeParameters(*(np.ones(3) for _ in range(4))), upright(8.0))
    with pytest.raises(InputError, match="positions"):
        cut_lattice(lattice, parameters, upright(8.0), positions=np.zeros((3, 3)))
    lost: FloatArray = np.where(np.arange(lattice.n_nodes)[:, None] == 4, np.nan, lattice.points)
    with pytest.raises(InputError, match="1 of 729 nodes are not finite"):
        cut_lattice(lattice, parameters, upright(8.0), positions=lost)
    beside = cut_lattice(lattice, parameters, upright(80.0))
    assert not len(beside.faces) and beside.lattice.n_nodes == lattice.n_nodes and beside.n_pieces == 1
    np.testing.assert_array_equal(beside.lattice.elements, lattice.elements)
