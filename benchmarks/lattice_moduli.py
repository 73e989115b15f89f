"""A lattice from moduli beside the elastic solid: force and displacement of a pressed block with a stiff lump, ``lattice_moduli.py``.

    python benchmarks/lattice_moduli.py cube             # 60 mm a side, a ball of 15 mm radius in its middle
    python benchmarks/lattice_moduli.py slab column      # 60 x 60 x 30 mm and 30 x 30 x 60 mm, a ball of 10 mm radius off their middles

A block (12 kPa) with a ball (36 kPa) sticks to a floor and to a plate that goes down or aside by 1 % of 60 mm; `cells` are those
along 60 mm. Springs come from `elastic_stiffness`; the solid is solved with linear tetrahedra (12 and 24 along 60 mm, forces
extrapolated) at Poisson's ratio 1/4, which is that of the lattice, and at 0.4, which it cannot have. `force` is that of the plate,
lattice over solid less one; `points` the root mean square difference of displacements at the nodes inside, over that of the solid's
displacements. `uniform` is the force where K is 16/30, 8/30 and 3/30 E h for all elements, at the surface as inside, and `kuhn` that of
springs on the edges of Kuhn's tetrahedra by volumes. Small strain.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.lattices.model.elastic_springs import elastic_stiffness
from naibu.mechanics.lattices.model.lattice import Lattice, box_mask, classic_lattice
from naibu.mechanics.lattices.model.tetrahedral_springs import volumetric_lattice
from naibu.mechanics.linear_algebra.direct import direct_solver
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box

Array = NDArray[np.float64]
LENGTH, SOFT, STIFF = 60.0, 12.0, 36.0
SOLID_CELLS = (12, 24)
POISSON_RATIOS = (0.25, 0.4)
LOADS = {"down": np.array([0.0, 0.0, -0.6]), "aside": np.array([0.6, 0.0, 0.0])}


class Block(NamedTuple):
    """Edge lengths, middle and radius of the ball, mm; it begins at the origin."""

    size: tuple[float, float, float]
    middle: tuple[float, float, float]
    radius: float

    def modulus(self, points: Array) -> Array:
        """Young's modulus, kPa, at points (3, ...)."""
        return np.where(sum((x - m) ** 2 for x, m in zip(points, self.middle, strict=True)) < self.radius**2, STIFF, SOFT)

    def divided(self, cells: int) -> tuple[int, int, int]:
        """Number of cells along x, y and z, where there are `cells` along `LENGTH`."""
        x, y, z = (round(cells * length / LENGTH) for length in self.size)
        return x, y, z

    def meshed(self, cells: int) -> Mesh:
        """Return tetrahedra."""
        mesh = to_tetra(box(self.size, self.divided(cells)))
        return replace(mesh, points=mesh.points - mesh.points.min(axis=0))


BLOCKS = {
    "cube": Block((60.0, 60.0, 60.0), (30.0, 30.0, 30.0), 15.0),
    "slab": Block((60.0, 60.0, 30.0), (22.5, 35.0, 15.0), 10.0),
    "column": Block((30.0, 30.0, 60.0), (16.0, 13.0, 37.5), 10.0),
}


def solved(matrix: sp.spmatrix, fixed: Array, given: Array) -> Array:
    """Solve with prescribed components."""
    free = np.flatnonzero(~fixed)
    blocks = sp.csr_matrix(matrix)[free][:, free].tobsr((1, 1))
    found = given.copy()
    found[free] = direct_solver(blocks, symmetric=True).factorize(blocks).solve(-(matrix @ given)[free])
    return found


def lattice_answer(lattice: Lattice, k: Array, load: Array) -> tuple[float, Array]:
    """Return the force of the plate along its motion, mN, and displacements (n, 3)."""
    i, j = lattice.elements.T
    along = (lattice.points[j] - lattice.points[i]) / lattice.lengths[:, None]
    rows = np.repeat(np.arange(lattice.n_elements), 6)
    columns = np.concatenate([3 * i[:, None] + np.arange(3), 3 * j[:, None] + np.arange(3)], axis=1)
    longer = sp.csr_matrix(
        (np.concatenate([-along, along], axis=1).ravel(), (rows, columns.ravel())), shape=(lattice.n_elements, 3 * lattice.n_nodes)
    )
    matrix = longer.T @ sp.diags(k) @ longer
    z = lattice.points[:, 2]
    top, floor = z > z.max() - 1e-6, z < z.min() + 1e-6
    given = np.where(top[:, None], load, 0.0).ravel()
    found = solved(matrix, np.repeat(top | floor, 3), given)
    return float((matrix @ found).reshape(-1, 3)[top].sum(axis=0) @ load / np.linalg.norm(load)), found.reshape(-1, 3)


def solid_answer(block: Block, poisson: float, load: Array) -> tuple[float, Array, Array]:
    """Return the force, extrapolated from two meshes, and nodes and displacements of the finer one."""
    forces = []
    for cells in SOLID_CELLS:
        mesh = block.meshed(cells)
        corners = mesh.points[mesh.cells]
        weights = np.random.default_rng(0).dirichlet(np.ones(4), 64)
        young = block.modulus(np.einsum("qc,tcd->dqt", weights, corners)).mean(axis=0)
        body = LinearBody.of(mesh)
        lame, shear = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
        top, floor = mesh.points[:, 2] > block.size[2] - 1e-6, mesh.points[:, 2] < 1e-6
        constrained = np.repeat((top | floor)[:, None], 3, axis=1)
        found = body.solve(lame, shear, PrescribedDisplacement(constrained, np.where(top[:, None], load, 0.0)))
        forces.append(float(body.forces(lame, shear, found)[top].sum(axis=0) @ load / np.linalg.norm(load)))
    ratio = (SOLID_CELLS[1] / SOLID_CELLS[0]) ** 2
    return (ratio * forces[1] - forces[0]) / (ratio - 1.0), mesh.points, found


def table_of(name: str, block: Block) -> None:
    """Print the rows of a block."""
    solids = {(nu, way): solid_answer(block, nu, load) for nu in POISSON_RATIOS for way, load in LOADS.items()}
    for way, load in LOADS.items():
        for cells in (4, 6, 8, 12):
            h = LENGTH / cells
            lattice = classic_lattice(box_mask(block.divided(cells)), h, density=1e-6)
            assert lattice.cells is not None
            inside = lattice.points[lattice.cells].min(axis=1)[:, :, None] + h * (np.indices((6, 6, 6)).reshape(3, -1) + 0.5) / 6
            young = block.modulus(inside.transpose(1, 0, 2)).mean(axis=1)
            force, moved = lattice_answer(lattice, elastic_stiffness(lattice, young), load)
            middle = lattice.points[lattice.elements].mean(axis=1).T
            same = block.modulus(middle) * h * np.array([16.0, 8.0, 3.0])[lattice.element_class] / 30.0
            uniform, _ = lattice_answer(lattice, same, load)
            kuhn, springs = volumetric_lattice(block.meshed(cells), density=1e-6, young_modulus=1.0)
            tied, _ = lattice_answer(kuhn, springs.stiffness * block.modulus(kuhn.points[kuhn.elements].mean(axis=1).T), load)
            core = ~lattice.surface_node
            for nu in POISSON_RATIOS:
                of_solid, nodes, found = solids[nu, way]
                far, number = cKDTree(nodes).query(lattice.points[core])
                assert far.max() < 1e-6
                there = found[number]
                error = np.sqrt(((moved[core] - there) ** 2).sum() / (there**2).sum())
                print(
                    f"{name:8s}{way:7s} {cells:4d}  {nu:12.2f} {100 * (force / of_solid - 1):+12.1f} % {100 * error:8.1f} % "
                    f"{100 * (uniform / of_solid - 1):+8.1f} % {100 * (tied / of_solid - 1):+8.1f} %",
                    flush=True,
                )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("blocks", nargs="*", choices=[[], *BLOCKS], help="cube, slab, column; all by default")
    print("block   load    cells  Poisson's ratio   force      points    uniform    kuhn")
    for name in parser.parse_args().blocks or BLOCKS:
        table_of(name, BLOCKS[name])


if __name__ == "__main__":
    main()
