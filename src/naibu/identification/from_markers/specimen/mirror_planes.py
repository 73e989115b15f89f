"""Mirror planes of an object: between two side plates a quarter of it is modelled, which the planes complete to the whole.

The object, its horizontal layers, the table, the plates and the weight are the same on both sides of the vertical planes x = 0 and y = 0,
and so is the deformation. On a plane nothing moves across it, and nothing pulls along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.meshing.surface import Boundary, boundary_faces

ON_PLANE = 1e-6  # of the object's extent, within which a node lies on a plane
MIRRORED_CELL = (1, 0, 3, 2, 5, 4, 7, 6)  # the nodes of a hexahedron in the order that a mirrored one needs


@dataclass(frozen=True, slots=True, eq=False)
class WholeBody:
    """The whole object that a modelled part stands for.

    Attributes
    ----------
    mesh : Mesh
        Of the whole object.
    node : ndarray, shape (n,), int64
        The modelled node that every node is, or is the image of.
    sign : ndarray, shape (n, 3)
        -1 for components that the image has reversed.
    """

    mesh: Mesh
    node: IntArray
    sign: FloatArray

    def field(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (n, 3) at all nodes from those (m, 3) at the modelled ones."""
        return np.asarray(vectors[self.node] * self.sign)


@dataclass(frozen=True, slots=True)
class MirrorPlanes:
    """Vertical planes through the origin in which an object, its load and its supports are mirrored.

    Attributes
    ----------
    axes : tuple of int
        Their normals; none for an object that is modelled whole.
    """

    axes: tuple[int, ...] = ()

    @classmethod
    def of(cls, experiment: Experiment) -> MirrorPlanes:
        """Return the planes of an experiment: plates and bars above an object may tilt, turn and lie off its middle, side plates do not."""
        return cls((0, 1)) if experiment.loading.kind == "side_plates" else cls()

    def part(self, mesh: Mesh) -> Mesh:
        """Return the cells on the positive side of all planes.

        Raises
        ------
        InputError
            A plane cuts through cells.
        """
        if not self.axes:
            return mesh
        keep = (mesh.points[mesh.cells].mean(axis=1)[:, list(self.axes)] > 0.0).all(axis=1)
        nodes, cells = np.unique(mesh.cells[keep], return_inverse=True)
        points = mesh.points[nodes]
        points[self.nodes(points)] = 0.0
        if keep.sum() * len(self._images) != mesh.n_cells or (points[:, list(self.axes)] < 0.0).any():
            raise InputError("a mirror plane cuts through cells; use an even number of cells along x and y")
        return Mesh(points, cells.reshape(-1, mesh.cells.shape[1]), mesh.cell_type, mesh.regions[keep], mesh.region_names)

    def nodes(self, points: FloatArray) -> BoolArray:
        """Return which coordinates of points (n, 3) are those of a plane on which they lie (n, 3)."""
        near = np.abs(points) < ON_PLANE * np.ptp(points, axis=0).max()
        return np.asarray(near & np.isin(np.arange(3), self.axes))

    def outer_faces(self, mesh: Mesh) -> Boundary:
        """Return the boundary faces of the modelled part that are on the outside of the object rather than on a plane."""
        found = boundary_faces(mesh)
        on_plane: BoolArray = np.all(self.nodes(mesh.points)[found.faces], axis=1)
        outside = on_plane.sum(axis=1) == 0
        return Boundary(found.faces[outside], found.cells[outside])

    def signs(self, points: FloatArray) -> FloatArray:
        """Return -1 for the components (k, 3) that are reversed where points (k, 3) are images of points in the modelled part."""
        return np.where((points < 0.0) & np.isin(np.arange(3), self.axes), -1.0, 1.0)

    def held(self, points: FloatArray) -> PrescribedDisplacement:
        """Return that nothing moves across the planes."""
        return PrescribedDisplacement(self.nodes(points), np.zeros(points.shape))

    def whole(self, mesh: Mesh) -> WholeBody:
        """Return the whole object from the modelled part."""
        points, cells, regions = mesh.points, mesh.cells, mesh.regions
        node, sign = np.arange(len(points)), np.ones((len(points), 3))
        for axis in self.axes:
            on = self.nodes(points)[:, axis]
            image = np.where(on, np.arange(len(points)), len(points) + np.cumsum(~on) - 1)
            flip = np.where(np.arange(3) == axis, -1.0, 1.0)
            points, sign = np.concatenate([points, points[~on] * flip]), np.concatenate([sign, sign[~on] * flip])
            node = np.concatenate([node, node[~on]])
            cells = np.concatenate([cells, image[cells][:, MIRRORED_CELL]])
            regions = np.concatenate([regions, regions])
        return WholeBody(Mesh(points, cells, mesh.cell_type, regions, mesh.region_names), node, sign)

    def reactions(self, forces: Sequence[tuple[str, FloatArray, FloatArray]]) -> dict[str, FloatArray]:
        """Return the forces (3,), mN, on the whole object, by name, from names, normals (3,) and forces (3,) of what touches the part.

        An image of one indenter is another one, or itself; those of the table and of joints are the same table and joints.
        """
        out = {}
        flips = [np.array([s.get(i, 1.0) for i in range(3)]) for s in (dict(zip(self.axes, f, strict=True)) for f in self._images)]
        for name, normal, _ in forces:
            alike = [(n, f) for other, n, f in forces if other == name or {other[:8], name[:8]} == {"indenter"}]
            total = [flip * f for flip in flips for n, f in alike if np.allclose(flip * n, normal)]
            out[name] = np.sum(total, axis=0)
        return out

    @property
    def _images(self) -> list[tuple[float, ...]]:
        return list(product((1.0, -1.0), repeat=len(self.axes)))
