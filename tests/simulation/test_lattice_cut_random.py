"""Random blades through lattices of boxes and of irregular masks: what is conserved, and pieces as code that is not ours finds them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.ndimage import gaussian_filter, label
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics import Lattice, LatticeEngine, LatticeParameters, LatticeState, classic_lattice, lattice_parameters, octree_lattice
from naibu.meshing import SweptBlade, swept_blade
from naibu.simulation import LatticeCut, cut_lattice

N, EDGE = 8, 2.0
SIZE = N * EDGE
KINDS = ("box", "mask", "octree 0", "octree 1", "octree 2", "octree mask")


def made(kind: str, rng: np.random.Generator) -> tuple[Lattice, LatticeParameters]:
    """An elastic lattice; masks are the largest part of a smoothed random field."""
    mask = np.ones((N, N, N), dtype=bool)
    if kind.endswith("mask"):
        parts = label(gaussian_filter(rng.normal(size=(N, N, N)), 1.0) > -0.05)[0]
        mask = parts == np.bincount(parts[parts > 0]).argmax()
    if kind.startswith("octree"):
        lattice = octree_lattice(mask, EDGE, int(kind[-1]) if kind[-1].isdigit() else 1, density=1e-6)
    else:
        lattice = classic_lattice(mask, EDGE, density=1e-6)
    return lattice, lattice_parameters(lattice, 10.0, 0.0, np.inf)


def random_blade(rng: np.random.Generator) -> SweptBlade:
    """A straight edge that moves and turns at random in two to six poses, through the body or not."""
    poses = int(rng.integers(2, 7))
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    edge = np.cross(way, rng.normal(size=3))
    centres = rng.uniform(0.0, SIZE, 3) + np.cumsum(rng.uniform(1.0, 12.0, poses))[:, None] * way - rng.uniform(0.0, 30.0) * way
    edges = edge / np.linalg.norm(edge) + np.arange(poses)[:, None] * rng.normal(scale=0.2, size=(poses, 3))
    return swept_blade(centres[:, None] + rng.uniform(2.0, 25.0) * np.array([-1.0, 1.0])[:, None] * edges[:, None])


def components(pairs: IntArray, count: int) -> tuple[int, IntArray]:
    return connected_components(sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count)), directed=False)


def same_parts(one: IntArray, two: IntArray) -> bool:
    """Whether two numberings divide things alike."""
    return len(np.unique(np.stack([one, two]), axis=1).T) == len(np.unique(one)) == len(np.unique(two))


def check_pieces(cut: LatticeCut, size: bool) -> None:
    """Pieces are the parts of the graphs of elements between nodes, and of cubes with the same four nodes (`size`: all cubes are alike)."""
    cells = cut.lattice.cells
    assert cells is not None
    of_node = np.full(cut.lattice.n_nodes, -1)
    of_node[cells] = cut.piece[:, None]
    np.testing.assert_array_equal(of_node[cells], np.repeat(cut.piece[:, None], 8, axis=1))
    assert same_parts(components(cut.lattice.elements, cut.lattice.n_nodes)[1], of_node)
    if size:
        corners = np.array([[a, b, c, d] for axis in range(3) for a, b, c, d in _sides(axis)])
        faces = np.sort(cells[:, corners].reshape(-1, 4), axis=1)
        owner = np.repeat(np.arange(len(cells)), 6)
        order = np.lexsort(faces.T)
        twin = (faces[order][1:] == faces[order][:-1]).all(axis=1)
        assert same_parts(components(np.stack([owner[order][1:][twin], owner[order][:-1][twin]], axis=1), len(cells))[1], cut.piece)


def _sides(axis: int) -> list[list[int]]:
    """Corners of the two faces of a hexahedron, in VTK's order, that an axis is normal to."""
    corner = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    return [[k for k, at in enumerate(corner) if at[axis] == side] for side in (0, 1)]


def check_conserved(before: Lattice, parameters: LatticeParameters, cut: LatticeCut, rng: np.random.Generator) -> None:
    """Mass, stiffness, energy and momentum, and the force of every node; rigid motion is without force."""
    np.testing.assert_allclose(np.bincount(cut.source, cut.lattice.node_mass), before.node_mass, rtol=1e-12)
    kept = np.bincount(cut.element_source, cut.parameters.stiffness, minlength=before.n_elements)
    np.testing.assert_allclose(kept, parameters.stiffness, rtol=1e-12)  # no element is lost
    position = before.points @ (np.eye(3) + rng.normal(scale=0.03, size=(3, 3)))
    state = LatticeState(position, rng.normal(scale=20.0, size=position.shape), np.zeros(before.n_elements))
    pairs = ((before, parameters), (cut.lattice, cut.parameters))
    engines = [LatticeEngine.of(*pair, step=1e-7, method="symplectic_euler") for pair in pairs]
    assert engines[1].energy(cut.state(state)) == pytest.approx(engines[0].energy(state), rel=1e-12)
    impulse = [_impulse(engine, s) for engine, s in zip(engines, (state, cut.state(state)), strict=True)]
    whole = np.stack([np.bincount(cut.source, impulse[1][:, k]) for k in range(3)], axis=1)
    np.testing.assert_allclose(whole, impulse[0], atol=1e-8 * np.abs(impulse[0]).max())
    turned = cut.lattice.points @ rotation_matrix(rng.normal(size=3)).T + rng.normal(size=3)
    rigid = _impulse(engines[1], LatticeState(turned, np.zeros_like(turned), np.zeros(cut.lattice.n_elements)))
    assert np.abs(rigid).max() < 1e-9 * np.abs(impulse[0]).max()


def _impulse(engine: LatticeEngine, state: LatticeState) -> FloatArray:
    after = engine.run(state, 1).state
    return np.asarray(engine.lattice.node_mass[:, None] * (after.velocity - state.velocity))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_random_blades_leave_everything_that_there_was_and_pieces_that_hold(kind: str, seed: int) -> None:
    """Two cuts after one another, of which the second may cross the first."""
    rng = np.random.default_rng(100 * KINDS.index(kind) + seed)
    lattice, parameters = made(kind, rng)
    alike = not kind.startswith("octree")
    for _ in range(2):
        cut = cut_lattice(lattice, parameters, random_blade(rng))
        check_pieces(cut, alike)
        check_conserved(lattice, parameters, cut, rng)
        lattice, parameters = cut.lattice, cut.parameters


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.endswith("mask")])
def test_a_blade_that_ends_inside_parts_nothing(kind: str, seed: int) -> None:
    """More than the largest cube before it would leave the body, in any direction."""
    rng = np.random.default_rng(1000 + seed)
    lattice, parameters = made(kind, rng)
    assert lattice.cells is not None
    largest = np.ptp(lattice.points[lattice.cells], axis=1).max()
    edge, way, normal = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    centre = 0.5 * SIZE + rng.uniform(-2.0, 2.0) * normal
    reach = ((lattice.points - centre) @ way).max()  # of the body beyond the centre
    blade = swept_blade([centre + s * way + np.array([[-40.0], [40.0]]) * edge for s in (-40.0, reach - 2.0 * np.sqrt(3.0) * largest)])
    assert cut_lattice(lattice, parameters, blade).n_pieces == 1
