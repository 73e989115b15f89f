"""Octree lattices respond as the classic lattice does: energies, forces, shape of the surface, frequencies."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.compliance_correction import EquilibriumPolynomials, lengthening
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes

EQUAL = np.ones(3)


def ellipsoid(shape):
    x, y, z = np.meshgrid(*((np.arange(n) + 0.5 - n / 2) / (n / 2) for n in shape), indexing="ij")
    return x**2 + y**2 + z**2 < 1.0


def angle(n):
    mask = box_mask((n, n, n))
    mask[n // 2 :, :, n // 2 :] = False
    return mask


def pair(mask, kind, **options):
    return classic_lattice(mask, 1.0, density=1e-6), octree_lattice(mask, 1.0, kind, density=1e-6, **options)


@cache
def cubes(n, kind, scaling="response"):
    return pair(box_mask((n, n, n)), kind, scaling=scaling)


def stiffness(lattice: Lattice, k) -> sp.csr_matrix:
    longer = lengthening(np.rint(lattice.points).astype(np.int64), lattice.elements)
    return (longer.multiply(np.asarray(k)[:, None]).tocsr().T @ longer).tocsr()


def numbers_in(classic, octree):
    at = {tuple(p): i for i, p in enumerate(np.rint(classic.points).astype(int))}
    return np.array([at[tuple(p)] for p in np.rint(octree.points).astype(int)])


def top_moves(motion: Callable) -> Callable:
    """Hold the floor, and move the nodes of the top (x, y in half edges from its middle)."""

    def load(lattice):
        low, high = lattice.points.min(axis=0), lattice.points.max(axis=0)
        x, y, z = ((lattice.points - low) / (high - low)).T
        constrained, u = np.repeat((z == 0.0)[:, None], 3, axis=1), np.zeros_like(lattice.points)
        part, direction = motion(2.0 * x - 1.0, 2.0 * y - 1.0)
        chosen = (z == 1.0) & part
        constrained[chosen], u[chosen] = (
            True,
            0.05 * (high - low).max() * np.broadcast_to(np.stack(np.broadcast_arrays(*direction), axis=-1), u.shape)[chosen],
        )
        return constrained, u

    return load


LOADS = {
    "push": top_moves(lambda x, y: (True, (0.0, 0.0, -1.0))),
    "shear": top_moves(lambda x, y: (True, (1.0, 0.0, 0.0))),
    "twist": top_moves(lambda x, y: (True, (-y, x, 0.0 * x))),
    "bend": top_moves(lambda x, y: (True, (0.0 * x, 0.0 * x, x))),
    "spot": top_moves(lambda x, y: ((np.abs(x) < 0.51) & (np.abs(y) < 0.51), (0.0, 0.0, -1.0))),
}


def answer(lattice, k, load):
    constrained, u = load(lattice)
    matrix, free, u = stiffness(lattice, k), ~constrained.ravel(), u.ravel()
    u[free] = spla.spsolve(matrix[free][:, free].tocsc(), -(matrix[free][:, ~free] @ u[~free]), permc_spec="MMD_AT_PLUS_A")
    return float(u @ (matrix @ u)), u.reshape(-1, 3)


def surface_error(octree, u, known):
    return np.sqrt(((u - known)[octree.surface_node] ** 2).sum() / (known[octree.surface_node] ** 2).sum())


@settings(max_examples=15, deadline=None)
@given(shape=st.tuples(*[st.integers(4, 9)] * 3), kind=st.integers(0, 2), seed=st.integers(0, 99), cut=st.booleans())
def test_the_rule_of_energy_keeps_the_energy_of_any_uniform_strain(shape, kind, seed, cut):
    mask = box_mask(shape)
    if cut and kind < 2:  # coarse cubes of type 2 may have a part of a face on the surface of a notched body
        mask[shape[0] // 2 :, :, shape[2] // 2 :] = False
    classic, octree = pair(mask, kind, scaling="energy")
    gradient, ratio = np.random.default_rng(seed).normal(size=(3, 3)), np.array([1.0, 2.0, 0.5])
    energies = []
    for lattice in (classic, octree):
        u = (lattice.points @ gradient.T).ravel()
        energies.append(u @ stiffness(lattice, lattice.scale * ratio[lattice.element_class]) @ u)
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)


@pytest.mark.parametrize("stiff", [EQUAL, np.array([3.0, 1.0, 0.5])])
def test_the_polynomials_need_no_force_inside_and_have_unit_energies(stiff):
    mask = angle(6)
    lattice = classic_lattice(mask, 1.0, density=1e-6)
    motions = EquilibriumPolynomials.of(mask, stiff).at(lattice.points).reshape(3 * lattice.n_nodes, -1)
    force = stiffness(lattice, stiff[lattice.element_class]) @ motions
    inside = np.repeat(~lattice.surface_node, 3)
    assert np.abs(force[inside]).max() < 1e-12 * np.abs(force).max() * 1e2
    np.testing.assert_allclose(motions.T @ force, np.eye(motions.shape[1]), atol=1e-7)
    assert motions.shape[1] == 6 + 15 + 21 + 27  # 3 (n + 1) (n + 2) / 2 of degree n, less one each for div sigma = 0 of degree n - 2


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("kind", [0, 1])
def test_a_cube_with_a_fine_surface_answers_as_the_classic_one(kind, load):
    classic, octree = cubes(8, kind)
    works, shapes = zip(*(answer(lattice, lattice.scale, LOADS[load]) for lattice in (classic, octree)), strict=True)
    assert works[1] == pytest.approx(works[0], rel=0.01)
    assert surface_error(octree, shapes[1], shapes[0][numbers_in(classic, octree)]) < 0.005


@pytest.mark.parametrize("load", LOADS)
def test_a_cube_with_coarse_corners_answers_with_the_forces_of_the_classic_one(load):
    """The corners are eight cubes of a quarter of the edge: nodes that hang there move by some strain times a voxel."""
    classic, octree = cubes(8, 2)
    works, shapes = zip(*(answer(lattice, lattice.scale, LOADS[load]) for lattice in (classic, octree)), strict=True)
    assert works[1] == pytest.approx(works[0], rel=0.045)
    _, edge = cubes(8, 2, "edge")
    at = numbers_in(classic, octree)
    before = answer(edge, edge.scale, LOADS[load])[1]
    if load != "twist":
        assert surface_error(octree, shapes[1], shapes[0][at]) < surface_error(edge, before, shapes[0][at])


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize(("kind", "shape_limit"), [(0, 0.007), (1, 0.007), (2, 0.04)])
def test_a_cube_of_17_masses_an_edge(kind, shape_limit, load):
    classic, octree = cubes(16, kind)
    works, shapes = zip(*(answer(lattice, lattice.scale, LOADS[load]) for lattice in (classic, octree)), strict=True)
    assert works[1] == pytest.approx(works[0], rel=0.02)
    assert surface_error(octree, shapes[1], shapes[0][numbers_in(classic, octree)]) < shape_limit


@pytest.mark.parametrize(("mask", "shape_limit"), [(ellipsoid((14, 12, 10)), 0.04), (angle(10), 0.02)], ids=["ellipsoid", "L"])
def test_other_bodies_answer_as_the_classic_lattice(mask, shape_limit):
    """A motion of the ends of the surface that took no part in the rule: constrained below, moved askew above."""
    classic, octree = pair(mask, 0)

    def load(lattice):
        z = lattice.points[:, 2] / lattice.points[:, 2].max()
        low, up = lattice.surface_node & (z < 0.21), lattice.surface_node & (z > 0.79)
        u = np.zeros_like(lattice.points)
        u[up] = np.array([0.3, 0.1, -0.5]) + 0.03 * np.cross(lattice.points[up], [0.2, 1.0, 0.5])
        return np.repeat((low | up)[:, None], 3, axis=1), u

    works, shapes = zip(*(answer(lattice, lattice.scale, load) for lattice in (classic, octree)), strict=True)
    edge = octree_lattice(mask, 1.0, 0, density=1e-6, scaling="edge")
    assert works[1] == pytest.approx(works[0], rel=0.02)
    assert abs(works[1] / works[0] - 1.0) < 0.25 * abs(answer(edge, edge.scale, load)[0] / works[0] - 1.0)
    assert surface_error(octree, shapes[1], shapes[0][numbers_in(classic, octree)]) < shape_limit


@pytest.mark.parametrize("kind", [0, 1])
def test_the_lowest_frequencies_are_kept(kind):
    tones = []
    for lattice in cubes(8, kind):
        free = np.repeat(lattice.points[:, 2] > 0.0, 3)
        mass = sp.diags_array(np.repeat(lattice.node_mass, 3)[free])
        values = spla.eigsh(stiffness(lattice, lattice.scale)[free][:, free], 4, M=mass, sigma=0.0, return_eigenvectors=False)
        tones.append(np.sqrt(np.sort(values)))
    np.testing.assert_allclose(tones[1], tones[0], rtol=0.01)


def test_a_push_kept_and_released_gives_the_force_and_shape_of_the_classic_lattice():
    """Three-element elements at 2 ms: force history within 1 %, shape of the surface within 1/2 %, kept and after release."""
    forces, shapes = [], []
    classic, octree = cubes(8, 0)
    for lattice in (classic, octree):
        engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 0.02, 0.01, 0.03), step=2e-3)
        floor, top = (ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 2] == z), body=b) for b, z in enumerate((0.0, 8.0)))
        velocity = np.zeros((200, 2, 3))
        velocity[:100, 1, 2] = -4.0
        kept = engine.run(engine.rest(), 200, floor + top, velocity)
        free = engine.run(kept.state, 100, floor)
        forces.append(kept.reaction[:, 1, 2])
        shapes.append([s.position - lattice.points for s in (kept.state, free.state)])
    assert np.linalg.norm(forces[1] - forces[0]) < 0.01 * np.linalg.norm(forces[0])
    at = numbers_in(classic, octree)
    for ours, known in zip(shapes[1], shapes[0], strict=True):
        assert surface_error(octree, ours, known[at]) < 0.005


def test_k_of_the_classes_three_times_apart_may_be_told():
    ratio, load = np.array([1.0, 3.0, 1.0]), LOADS["push"]
    works = []
    for lattice in (*cubes(8, 0), octree_lattice(box_mask((8, 8, 8)), 1.0, 0, density=1e-6, class_stiffness=ratio)):
        works.append(answer(lattice, ratio[lattice.element_class] * lattice.scale, load)[0])
    assert abs(works[2] / works[0] - 1.0) < 0.01
    assert abs(works[1] / works[0] - 1.0) < 0.05


def test_factors_are_positive_the_same_each_time_and_one_without_coarse_cubes():
    first, second = cubes(8, 0)[1], octree_lattice(box_mask((8, 8, 8)), 1.0, 0, density=1e-6)
    np.testing.assert_array_equal(first.scale, second.scale)
    assert first.scale.min() > 0.0
    np.testing.assert_array_equal(octree_lattice(box_mask((3, 2, 2)), 1.0, 0, density=1e-6).scale, 1.0)


def test_symmetric_bodies_have_symmetric_factors():
    _, octree = cubes(8, 0)
    known = {frozenset(map(tuple, np.rint(octree.points[e]).astype(int))): s for e, s in zip(octree.elements, octree.scale, strict=True)}
    for order, flip in (((1, 0, 2), (0, 0, 0)), ((2, 1, 0), (0, 0, 0)), ((0, 1, 2), (1, 0, 1))):
        for ends, factor in known.items():
            moved = frozenset(tuple(8 - p[a] if f else p[a] for a, f in zip(order, flip, strict=True)) for p in ends)
            assert known[moved] == factor


def test_unknown_rules_and_ratios_are_refused():
    with pytest.raises(InputError, match="'response', 'energy' or 'edge'"):
        octree_lattice(box_mask((4, 4, 4)), 1.0, 0, density=1.0, scaling="mean")
    with pytest.raises(InputError, match="three positive numbers"):
        octree_lattice(box_mask((4, 4, 4)), 1.0, 0, density=1.0, class_stiffness=(1.0, 0.0, 1.0))


def test_parts_that_hinge_on_an_edge_and_thin_plates_get_factors_too():
    hinged = np.zeros((16, 8, 16), dtype=bool)
    hinged[:8, :, :8] = hinged[8:, :, 8:] = True
    for mask in (hinged, box_mask((8, 8, 1)), box_mask((16, 3, 2))):
        factors = octree_lattice(mask, 1.0, 0, density=1e-6).scale
        assert np.isfinite(factors).all()
        assert factors.min() > 0.0


def test_without_the_fast_solver_the_factors_are_the_same(monkeypatch):
    known = cubes(8, 1)[1].scale
    for module in ("lattices.model.octrees.compliance_correction", "linear_algebra.direct", "linear_algebra.solver_selection"):
        monkeypatch.setattr(f"naibu.mechanics.{module}.pardiso_library", lambda: None)
    np.testing.assert_allclose(octree_lattice(box_mask((8, 8, 8)), 1.0, 1, density=1e-6).scale, known, rtol=1e-4)
