"""Coarse levels of the implicit solver on a device of Warp: they change the number of iterations, which hardly grows, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, eigsh

from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.gpu import coarse_levels
from naibu.mechanics.lattices.gpu.engine import WarpLatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes

STIFF = (10.0, 5.0, 10.0)


@pytest.fixture(scope="module", params=["cpu", "cuda:0"])
def device(request):
    warp = pytest.importorskip("warp")
    if request.param.startswith("cuda") and not warp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


@pytest.fixture
def small(monkeypatch):
    """Use coarse levels on small lattices too."""
    monkeypatch.setattr(coarse_levels, "_FEW", 0)
    monkeypatch.setattr(coarse_levels, "_WORTH", np.inf)


def porous(n, seed):
    """Return a mask with holes whose columns hang on a full layer below."""
    mask = np.random.default_rng(seed).random((n, n, n)) < 0.9
    mask[:, :, 0] = True
    return np.logical_and.accumulate(mask, axis=2)


LATTICES = {
    "classic": lambda: classic_lattice(box_mask((9, 8, 10)), 5.0, total_mass_kg=0.3),
    "holes": lambda: classic_lattice(porous(10, 1), 5.0, total_mass_kg=0.3),
    "octree": lambda: octree_lattice(box_mask((16, 16, 16)), 5.0, 1, total_mass_kg=0.6),
    "bar": lambda: classic_lattice(box_mask((40, 4, 5)), 3.0, total_mass_kg=0.05),
}


def pushed(lattice):
    z = lattice.points[:, 2]
    floor = ConstrainedNodes.of(np.flatnonzero(z < z.min() + 1e-6), 0)
    return floor + ConstrainedNodes.of(np.flatnonzero(z > z.max() - 1e-6), 1, axes=(2, 0)), [[0.0, 0.0, 0.0], [4.0, 0.0, -20.0]]


@pytest.mark.parametrize("kind", LATTICES)
def test_the_motion_is_that_of_the_processor_with_fewer_iterations(device, small, kind):
    lattice = LATTICES[kind]()
    parameters = lattice_parameters(lattice, *STIFF)
    constrained, velocity = pushed(lattice)
    engine = WarpLatticeEngine.of(lattice, parameters, tolerance=1e-8, device=device)
    helped, plain = (e.run(e.rest(), 8, constrained, velocity) for e in (engine, dataclasses.replace(engine, coarse=None)))
    reference = LatticeEngine.of(lattice, parameters, tolerance=1e-8)
    expected = reference.run(reference.rest(), 8, constrained, velocity)
    for other in (expected, plain):
        np.testing.assert_allclose(helped.state.position, other.state.position, rtol=0, atol=1e-6)
        np.testing.assert_allclose(helped.reaction, other.reaction, rtol=0, atol=1e-5 * np.abs(other.reaction).max())
    assert helped.iterations < 0.8 * plain.iterations


def test_iterations_do_not_grow_with_the_number_of_nodes(device, small):
    counts = []
    for n in (8, 16, 24):
        lattice = classic_lattice(box_mask((n,) * 3), 80.0 / n, total_mass_kg=0.63)
        engine = WarpLatticeEngine.of(lattice, lattice_parameters(lattice, *STIFF), device=device)
        counts.append(engine.run(engine.rest(), 4, *pushed(lattice)).iterations)
    assert counts[-1] < 1.3 * counts[0] + 2.0


def test_the_coarsest_matrix_has_the_energy_of_the_lattice_in_uniform_strain_and_none_in_rigid_motion(small):
    """Hat functions hold linear displacements exactly, so that the energy is that of the elements, sum of s (n . e d)^2."""
    pytest.importorskip("warp")
    lattice = LATTICES["classic"]()
    stiff = np.random.default_rng(3).uniform(0.5, 2.0, lattice.n_elements)
    cells = np.array([5, 4, 5])  # of two spacings
    number = np.arange(np.prod(cells + 1))
    place = (lattice.points - lattice.points.min(axis=0)) / 10.0
    tensors = np.zeros((*cells, len(coarse_levels._QUARTICS)))
    coarse_levels._gather_tensors(lattice.elements, place, stiff, tensors)
    nodes = coarse_levels._grid(number, cells)
    matrix = coarse_levels._matrix(tensors, number, np.zeros(len(number)))
    i, j = lattice.elements.T
    d = place[j] - place[i]
    n = d / np.linalg.norm(d, axis=1)[:, None]
    for gradient in (*np.random.default_rng(4).normal(size=(3, 3, 3)), np.cross(np.eye(3), [1.0, -2.0, 0.5])):
        u = (nodes @ gradient.T).ravel()
        expected = float((stiff * np.einsum("ea,ab,eb->e", n, gradient, d) ** 2).sum())
        np.testing.assert_allclose(u @ matrix @ u, expected, rtol=1e-10, atol=1e-9)
    coarser = coarse_levels._matrix(coarse_levels._coarsened(tensors, -(-cells // 2)), np.arange(4 * 3 * 4), np.zeros(48))
    u = (coarse_levels._grid(np.arange(48), np.array([3, 2, 3])) @ gradient.T).ravel()
    np.testing.assert_allclose(u @ coarser @ u, 0.0, atol=1e-9)  # the rotation again


def test_the_correction_is_symmetric_and_positive(device, small):
    """As conjugate gradients need it, also with constrained components."""
    import warp as wp

    lattice = classic_lattice(porous(6, 2), 5.0, total_mass_kg=0.1)
    engine = WarpLatticeEngine.of(lattice, lattice_parameters(lattice, *STIFF), device=device)
    coarse = engine.session(None, pushed(lattice)[0]).implicit.coarse
    n = lattice.n_nodes

    def answer(r):
        smoothed = wp.array(r.reshape(-1, 3) / engine.diagonal[:, None], dtype=wp.vec3d, device=device)
        z = wp.zeros_like(smoothed)
        coarse.apply(smoothed, z)
        return z.numpy().ravel()

    a, b = np.random.default_rng(1).normal(size=(2, 3 * n))
    np.testing.assert_allclose(a @ answer(b), b @ answer(a), rtol=1e-7)
    least = eigsh(LinearOperator((3 * n, 3 * n), matvec=answer, dtype=float), k=1, which="SA", return_eigenvectors=False, tol=1e-4)
    assert least[0] > 0.0


def test_a_session_follows_its_constraints(device, small):
    """Other constraints give the steps, and the iterations, of a session that begins with them."""
    lattice = LATTICES["classic"]()
    engine = WarpLatticeEngine.of(lattice, lattice_parameters(lattice, *STIFF), device=device)
    constrained, velocity = pushed(lattice)
    session = engine.session()
    session.constrain(constrained)
    session.step(velocity, steps=4)
    expected = engine.run(engine.rest(), 4, constrained, velocity)
    np.testing.assert_array_equal(session.positions(), expected.state.position)
    assert session.iterations == 4 * expected.iterations
