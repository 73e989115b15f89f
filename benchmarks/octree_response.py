"""How an octree lattice answers beside the classic one: forces, shape, frequencies, and a push that is kept and released.

Each line compares an octree with the classic lattice of the same voxels. Static loads (small strain, the floor held) move a part of the
surface by a tenth of the height: the whole top down (push; slip: free to slide), aside (shear), turned (twist), tilted (bend), or a spot
of it (spot), or a spot of a side (side). `force` is the force of the part along its motion, `surface` and `inner` the root mean square of
the difference of displacements over that of the displacements, over all masses of the octree on the surface or below it; `corners` over
those on the surface that are corners of all their cubes. None of these loads takes part in the rule that `Lattice.scale` comes from.

Run: ``MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/octree_response.py [--bodies cube8,cube16,ellipsoid,L,cube32]
[--scalings response,energy,edge] [--ratios]``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.compliance_correction import lengthening
from naibu.mechanics.lattices.model.octrees.energy_scaling import OctreeGrid
from naibu.mechanics.lattices.model.octrees.octree import octree_cubes, octree_lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.linear_algebra.direct import direct_solver
from naibu.mechanics.linear_algebra.protocols import Factorization

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
SIDE_MM, MASS_KG = 80.0, 0.63
K, C1, C2 = 2.0, 1.0, 3.0  # of the classic lattice, for each mm of the spacing: mN/mm, mN s/mm
STEP_S, SPEED, PHASES = 2e-3, 16.0, (250, 250, 250)  # mm/s; pushed, kept, released


def ellipsoid(shape: tuple[int, int, int]) -> Flags:
    grid = [(np.arange(n) + 0.5 - n / 2) / (n / 2) for n in shape]
    x, y, z = np.meshgrid(*grid, indexing="ij")
    return np.asarray(x**2 + y**2 + z**2 < 1.0)


def angle(n: int) -> Flags:
    mask = box_mask((n, n, n))
    mask[n // 2 :, :, n // 2 :] = False
    return mask


BODIES = {
    "cube8": box_mask((8, 8, 8)),
    "cube16": box_mask((16, 16, 16)),
    "cube32": box_mask((32, 32, 32)),
    "box": box_mask((18, 13, 11)),
    "ellipsoid": ellipsoid((20, 17, 14)),
    "L": angle(14),
}


def stiffness(lattice: Lattice, k: Array) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Return the stiffness (3 n, 3 n) at rest, and the map to the lengthening of elements."""
    longer = lengthening(np.rint((lattice.points - lattice.points.min(axis=0)) / lattice.spacing_mm).astype(np.int64), lattice.elements)
    return (longer.multiply(k[:, None]).tocsr().T @ longer).tocsr(), longer


def factorized(matrix: sp.csr_matrix) -> Factorization:
    blocks = matrix.tobsr((1, 1))
    return direct_solver(blocks, symmetric=True).factorize(blocks)


def loads(lattice: Lattice) -> Iterator[tuple[str, Flags, Array]]:
    """Yield a name, which components (n, 3) are prescribed, and displacements (n, 3)."""
    low, high = lattice.points.min(axis=0), lattice.points.max(axis=0)
    x, y, z = ((lattice.points - low) / (high - low)).T
    surface, height = lattice.surface_node, float(high[2] - low[2])
    flat = surface & (z > 1.0 - 1e-9)
    depth = 1e-9 if np.ptp(x[flat]) > 0.45 else 0.15  # a round body has no flat top: a cap of it
    top, floor, spot = surface & (z > 1.0 - depth), surface & (z < depth), (x > 0.24) & (x < 0.76) & (y > 0.24) & (y < 0.76)
    middle = 0.5 * (x[top].min() + x[top].max())
    down = np.array([0.0, 0.0, -0.1 * height])
    turn = 0.1 * height * np.column_stack([0.5 - y, x - 0.5, np.zeros_like(x)])
    tilt = 0.1 * height * np.column_stack([np.zeros_like(x), np.zeros_like(x), x - middle])
    end = z[x > 1.0 - 1e-9].max()  # height of the end that is pushed from the side
    side = surface & (x > 1.0 - depth) & (z > 0.2 * end) & (z < 0.8 * end) & (y > 0.24) & (y < 0.76)
    for name, part, motion, axes in (
        ("push", top, down, (0, 1, 2)),
        ("slip", top, down, (2,)),
        ("shear", top, np.array([0.1 * height, 0.0, 0.0]), (0, 1, 2)),
        ("twist", top, turn, (0, 1, 2)),
        ("bend", top, tilt, (0, 1, 2)),
        ("spot", top & spot & (np.abs(x - middle) < 0.26), down, (0, 1, 2)),
        ("side", side & ~floor, np.array([-0.1 * height, 0.0, 0.0]), (0, 1, 2)),
    ):
        constrained = np.repeat(floor[:, None], 3, axis=1)
        for axis in axes:
            constrained[part, axis] = True
        yield name, constrained, np.where(part[:, None] & constrained & ~floor[:, None], np.broadcast_to(motion, lattice.points.shape), 0.0)


def answers(lattice: Lattice, k: Array) -> dict[str, tuple[float, Array]]:
    """Return the work of every load, and the displacements (n, 3)."""
    matrix, _ = stiffness(lattice, k)
    found = {}
    for name, constrained, motion in loads(lattice):
        free, u = ~constrained.ravel(), motion.ravel().copy()
        u[free] = factorized(matrix[free][:, free]).solve(-(matrix[free][:, ~free] @ u[~free]))
        found[name] = (float(u @ (matrix @ u)), u.reshape(-1, 3))
    return found


def frequencies(lattice: Lattice, k: Array, count: int = 4) -> Array:
    """Return the lowest frequencies of small vibrations, the floor held, Hz."""
    matrix, _ = stiffness(lattice, k)
    free = np.flatnonzero(np.repeat(lattice.points[:, 2] > lattice.points[:, 2].min(), 3))
    root = np.sqrt(np.repeat(lattice.node_mass, 3)[free])
    factor = factorized(matrix[free][:, free])
    inverse = spla.LinearOperator((len(free),) * 2, matvec=lambda v: root * factor.solve(np.ravel(root * np.ravel(v))), dtype=np.float64)
    values = spla.eigsh(inverse, count, which="LM", return_eigenvectors=False, v0=root)
    return np.asarray(np.sort(1.0 / np.sqrt(values)) / (2.0 * np.pi))


def pushed(lattice: Lattice, numbers: tuple[float, float, float]) -> tuple[Array, list[Array]]:
    """Return the force of the top (steps,), mN, and displacements (n, 3) when it is released and at the end, mm."""
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, *numbers), step=STEP_S)
    z = lattice.points[:, 2]
    floor, top = (ConstrainedNodes.of(np.flatnonzero(z == at), body=b) for b, at in enumerate((z.min(), z.max())))
    velocity = np.zeros((PHASES[0] + PHASES[1], 2, 3))
    velocity[: PHASES[0], 1, 2] = -SPEED
    kept = engine.run(engine.rest(), len(velocity), floor + top, velocity)
    free = engine.run(kept.state, PHASES[2], floor)
    return kept.reaction[:, 1, 2], [s.position - lattice.points for s in (kept.state, free.state)]


def places(classic: Lattice, octree: Lattice) -> NDArray[np.int64]:
    """Return the numbers in the classic lattice of the masses of the octree."""
    at = {tuple(p): i for i, p in enumerate(np.rint(classic.points / classic.spacing_mm).astype(int))}
    return np.array([at[tuple(p)] for p in np.rint(octree.points / classic.spacing_mm).astype(int)])


def difference(a: Array, b: Array, which: Flags) -> float:
    """Return the root mean square of a - b over that of b, %."""
    return 100.0 * float(np.sqrt(((a - b)[which] ** 2).sum() / (b[which] ** 2).sum())) if which.any() else float("nan")


def corner_masses(mask: Flags, kind: int, octree: Lattice) -> Flags:
    """Return which masses are corners of all cubes that they touch."""
    grid = OctreeGrid(mask, *octree_cubes(mask, kind), np.rint(octree.points / octree.spacing_mm).astype(np.int64), octree.elements)
    return grid.hanging(grid.around_masses()) == 0


def compare(
    name: str, scalings: list[str], ratios: tuple[float, float, float] = (1.0, 1.0, 1.0), zones: float = 1.0, told: bool = False
) -> None:
    """Print how the three octrees of a body answer; K of the classes in given ratios, that of the surface times `zones`."""
    mask = BODIES[name]
    spacing = SIDE_MM / max(mask.shape)
    classic = classic_lattice(mask, spacing, total_mass_kg=MASS_KG)

    def k_of(lattice: Lattice) -> Array:
        return np.asarray(
            K * spacing * np.array(ratios)[lattice.element_class] * np.where(lattice.element_zone == 1, zones, 1.0) * lattice.scale
        )

    reference, tones = answers(classic, k_of(classic)), frequencies(classic, k_of(classic))
    dynamic = (
        pushed(classic, (K * spacing, C1 * spacing, C2 * spacing)) if ratios == (1.0, 1.0, 1.0) and zones == 1.0 and mask.all() else None
    )
    print(f"{name}: classic {classic.n_nodes} masses, {classic.n_elements} elements; K of the classes {ratios}, of the surface {zones:g}")
    for kind in (0, 1, 2):
        for scaling in scalings:
            began = time.process_time()
            given = ratios if told else (1.0, 1.0, 1.0)
            octree = octree_lattice(mask, spacing, kind, total_mass_kg=MASS_KG, scaling=scaling, class_stiffness=given)
            took = time.process_time() - began
            one_by_one(mask, kind, octree, places(classic, octree), answers(octree, k_of(octree)), reference, f"{scaling} ({took:.1f} s)")
            ratio = frequencies(octree, k_of(octree)) / tones
            print("      lowest frequencies, of classic: " + " ".join(f"{r:.4f}" for r in ratio), flush=True)
            if dynamic is not None:
                in_time(octree, places(classic, octree), spacing, dynamic)


def one_by_one(
    mask: Flags,
    kind: int,
    octree: Lattice,
    at: NDArray[np.int64],
    found: dict[str, tuple[float, Array]],
    reference: dict[str, tuple[float, Array]],
    label: str,
) -> None:
    """Print the static loads."""
    surface, corner = octree.surface_node, corner_masses(mask, kind, octree)
    print(f"   type {kind}, {octree.n_nodes} masses, {octree.n_elements} elements, {label}")
    for load, (work, u) in found.items():
        known = reference[load][1][at]
        off = [f"{difference(u, known, which):5.2f} %" for which in (surface & corner, surface, ~surface)]
        print(f"      {load:6s} force {work / reference[load][0]:.4f}   corners {off[0]}   surface {off[1]}   inner {off[2]}", flush=True)


def in_time(octree: Lattice, at: NDArray[np.int64], spacing: float, dynamic: tuple[Array, list[Array]]) -> None:
    """Print the push that is kept and released."""
    force, shapes = pushed(octree, (K * spacing, C1 * spacing, C2 * spacing))
    off = 100.0 * float(np.sqrt(((force - dynamic[0]) ** 2).sum() / (dynamic[0] ** 2).sum()))
    kept, free = (difference(u, v[at], octree.surface_node) for u, v in zip(shapes, dynamic[1], strict=True))
    print(
        f"      pushed by a tenth in .5 s, kept .5 s, released: force {off:.2f} %, surface {kept:.2f} % kept, {free:.2f} % .5 s later",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", default="cube8,cube16,box,ellipsoid,L")
    parser.add_argument("--scalings", default="response,edge")
    parser.add_argument("--ratios", action="store_true", help="also with K of the classes, and of surface and core, three times apart")
    chosen = parser.parse_args()
    for name in chosen.bodies.split(","):
        compare(name, chosen.scalings.split(","))
        if chosen.ratios:
            for ratios in ((3.0, 1.0, 1.0), (1.0, 3.0, 1.0), (1.0, 1.0, 3.0)):
                for told in (False, True):
                    print("   class_stiffness told" if told else "   class_stiffness not told")
                    compare(name, ["response"], ratios, told=told)
            for zones in (3.0, 1.0 / 3.0):
                compare(name, ["response"], zones=zones)


if __name__ == "__main__":
    main()
