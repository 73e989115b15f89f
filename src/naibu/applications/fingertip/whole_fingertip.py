"""The whole of a fingertip, for bodies that are touched anywhere: the load on the chip at positions of its nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.fingertip.fingertip import GEL, PACKAGE, Fingertip, FingertipResolution, fingertip_mesh
from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements


@dataclass(frozen=True, slots=True, eq=False)
class WholeFingertip:
    """A fingertip whose base and package are held: the package is thousands of times stiffer than the gel.

    Attributes
    ----------
    fingertip : Fingertip
        Dimensions and materials.
    mesh : Mesh
        Of all of it.
    assembler : Assembler
        Its elements and materials.
    held : ndarray, shape (k,), int64
        Nodes of the base and of the package.
    around : Assembler
        Elements of the gel that touch the package.
    nodes : ndarray, shape (a,), int64
        Their nodes.
    package : ndarray, shape (p,), int64
        Places among `nodes` of those of the package that do not lie on the base.
    """

    fingertip: Fingertip
    mesh: Mesh
    assembler: Assembler
    held: IntArray
    around: Assembler
    nodes: IntArray
    package: IntArray

    @classmethod
    def of(cls, fingertip: Fingertip, resolution: FingertipResolution | None = None) -> WholeFingertip:
        """Mesh a fingertip."""
        mesh = fingertip_mesh(fingertip, resolution, whole=True)
        gel = fingertip.materials[GEL]
        assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, list(fingertip.materials))
        of_package = np.unique(mesh.cells[mesh.regions == PACKAGE])
        loaded = of_package[mesh.points[of_package, 2] > 0.0]
        near = mesh.cells[(mesh.regions == GEL) & np.isin(mesh.cells, loaded).any(axis=1)]
        nodes, cells = np.unique(near, return_inverse=True)
        part = Mesh.from_arrays(mesh.points[nodes], cells.reshape(near.shape), mesh.cell_type)
        around = Assembler.from_materials(elements(part, "mean_dilatation"), part.regions, [gel])
        held = np.union1d(np.flatnonzero(mesh.points[:, 2] == 0.0), of_package).astype(np.int64)
        return cls(fingertip, mesh, assembler, held, around, nodes, np.flatnonzero(np.isin(nodes, loaded)))

    def chip_loads(self, positions: FloatArray) -> FloatArray:
        """Return F_x, F_y, F_z, M_x, M_y, M_z on the chip (6,), mN and mN mm, at positions (n, 3) of the nodes, mm.

        They are what the gel exerts on the package, about the centre of the base; F_z is positive where it presses the chip down.
        """
        moved = positions[self.nodes]
        pulled = -self.around.forces(moved - self.mesh.points[self.nodes])[1][self.package]
        force = pulled.sum(axis=0) * [1.0, 1.0, -1.0]
        return np.concatenate([force, np.cross(moved[self.package], pulled).sum(axis=0)])
