"""The surface of a lattice that indenters touch: its faces, their quadrature points, and the material behind them.

Between its nodes a face of a lattice is rigid, and the solid that it stands for is not. Each quadrature point therefore stands on an
elastic foundation :cite:p:`johnson1985` (chapter 4.3) of three-element elements like those behind its face. Its thickness, in lengths of
these elements, is `AT_NODE` at a node and grows by `BETWEEN` times what the nodes yield less elsewhere, one minus the sum of the squares
of the shape functions. With these two numbers a sphere, as large as a face or twice as large, on a lattice and on one twice as fine meets
forces that differ least, wherever it stands (``benchmarks/contact_steps.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact.contact_surfaces import face_quadrature
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients, implicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.surface import surface_faces

AT_NODE, BETWEEN = 0.15, 0.6
FLAT_ORDER = 2  # Gauss points per side of a face under a plane, exact for the product of two shape functions
LEAST_ORDER, MOST_ORDER = 3, 8
FINENESS = 1.2  # quadrature points along the volume of an indenter over its area; 3.6 along the radius of a sphere


@dataclass(frozen=True, slots=True, eq=False)
class ContactSurface:
    """Faces of a lattice that may come into contact.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes at rest, mm.
    faces : ndarray, shape (f, 3) or (f, 4), int64
        Nodes of the faces; of lattices without a surface (f, 1), and every node touches for itself.
    area : ndarray, shape (f,)
        At rest, mm2; of single nodes the square of the spacing.
    spread : ndarray, shape (f, 4)
        Inverse of the area (1/mm2) over which a force on a node of a face spreads, seen along the normal of the face; zero where a face
        has fewer nodes.
    parameters : LatticeParameters
        Of the elements behind the faces, per unit of area: kPa/mm, kPa s/mm.
    """

    points: FloatArray
    faces: IntArray
    area: FloatArray
    spread: FloatArray
    parameters: LatticeParameters

    @classmethod
    def of(cls, lattice: Lattice, parameters: LatticeParameters) -> ContactSurface:
        """Return the surface of a lattice."""
        faces = contact_faces(lattice)
        if faces.shape[1] == 1:
            area, normal = np.full(len(faces), lattice.spacing_mm**2), np.zeros((len(faces), 3))
            spread = np.zeros((len(faces), 4))
            spread[:, 0] = 1.0 / area
        else:
            corners = lattice.points[faces]
            vector = 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
            area = np.linalg.norm(vector, axis=1)
            normal = vector / area[:, None]
            k = faces.shape[1]
            around = np.zeros((lattice.n_nodes, 3))
            np.add.at(around, faces.ravel(), np.repeat(vector / k, k, axis=0))
            seen = np.maximum(np.einsum("fki,fi->fk", around[faces], normal), area[:, None] / k)
            spread = np.zeros((len(faces), 4))
            spread[:, :k] = 1.0 / seen
        return cls(lattice.points, faces, area, spread, _foundation(lattice, parameters, faces, normal, spread))

    @property
    def nodes(self) -> IntArray:
        """Nodes of the faces (f, 4); the last one again where there are fewer."""
        return self.faces[:, np.minimum(np.arange(4), self.faces.shape[1] - 1)]

    def order(self, geometry: IndenterGeometry) -> int:
        """Return the quadrature order for an indenter: finer where it is small beside a face."""
        if self.faces.shape[1] == 1 or geometry.flat:
            return FLAT_ORDER
        edge = float(np.sqrt(np.median(self.area)))
        return int(np.clip(np.ceil(FINENESS * edge / geometry.volume_per_area) + 1, LEAST_ORDER, MOST_ORDER))

    def quadrature(self, order: int) -> tuple[FloatArray, FloatArray]:
        """Return shape functions (q, 4) and weights (f, q), mm2."""
        if self.faces.shape[1] == 1:
            return np.array([[1.0, 0.0, 0.0, 0.0]]), self.area[:, None].copy()
        shape, weight = face_quadrature(self.points, self.faces, order)
        return np.pad(shape, ((0, 0), (0, 4 - shape.shape[1]))), weight

    @staticmethod
    def compliance(shape: FloatArray) -> FloatArray:
        """Return the thickness of the foundation (q,), in lengths of the elements, at points with shape functions (q, 4)."""
        return np.asarray(AT_NODE + BETWEEN * (1.0 - (shape**2).sum(axis=1)))

    def foundation(self, step: float) -> FloatArray:
        """Return the coefficients (f, 4) of steps of a length, s.

        While a foundation one element thick is compressed by dw in a step, its pressure at the end is ``a dw + b y0`` and its extension
        ``y1 = e y0 + g dw``: a, b (kPa/mm), e and g.
        """
        tension, spring, _, _ = explicit_coefficients(self.parameters)
        _, _, decay, growth = implicit_coefficients(self.parameters, step)
        return np.ascontiguousarray(np.stack([tension / step + spring * growth, spring * decay, decay, growth], axis=1))


def contact_faces(lattice: Lattice) -> IntArray:
    """Return the faces (f, 3) or (f, 4) of a lattice that may come into contact, or its nodes (f, 1) where it has none."""
    if lattice.faces is not None:
        return lattice.faces
    return surface_faces(lattice) if lattice.cells is not None else np.arange(lattice.n_nodes)[:, None]


def _foundation(
    lattice: Lattice, parameters: LatticeParameters, faces: IntArray, normal: FloatArray, spread: FloatArray
) -> LatticeParameters:
    """Return the stiffness and damping of the elements behind every face, along its normal, per unit of area."""
    lengths = lattice.lengths
    i, j = lattice.elements.T
    outer = ((lattice.points[j] - lattice.points[i]) / lengths[:, None])[:, :, None]
    outer = outer * outer.transpose(0, 2, 1)
    values = []
    for along in (parameters.stiffness, parameters.voigt_damping, parameters.stiffness**2 / parameters.series_damping):
        at_node = np.zeros((lattice.n_nodes, 3, 3))
        for ends in (i, j):
            np.add.at(at_node, ends, along[:, None, None] * outer)
        along_normal = np.einsum("fi,fkij,fj->fk", normal, at_node[faces], normal)
        if not normal.any():
            along_normal = np.trace(at_node[faces], axis1=2, axis2=3) / 3.0
        values.append((along_normal * spread[:, : faces.shape[1]]).mean(axis=1))
    stiffness, damping, flow = (np.maximum(v, 0.0) for v in values)
    least = 1e-9 * max(float(np.max(stiffness + damping)), 1e-300)
    return LatticeParameters(np.maximum(stiffness, least), damping, _series(stiffness, flow), np.full(len(faces), 0.5))


def _series(stiffness: FloatArray, flow: FloatArray) -> FloatArray:
    """Return C2 from K and the sum of K^2 / C2, infinite where nothing flows."""
    return np.where(flow > 0.0, stiffness**2 / np.where(flow > 0.0, np.maximum(flow, 1e-300), 1.0), np.inf)
