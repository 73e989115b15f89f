"""The surface of a lattice that indenters touch: its faces, their quadrature points, and the material behind them.

Between its nodes a face of a lattice is rigid, and the solid that it stands for is not. Each quadrature point therefore stands on an
elastic foundation of three-element elements like those behind its face. A foundation yields to a small indenter as a half-space does if
its thickness is in proportion to the radius of the area that is pressed :cite:p:`johnson1985` (chapter 4.3), and what the nodes yield
must not be counted twice: of the pressure they carry the fraction `SHARED` past it. The thickness, in lengths of the elements, is the
root of the sum of the squares of `THINNEST`, and of `PER_RADIUS` times the radius of the covered area around the face over its edge. With
`SHARED` and `PER_RADIUS` a lattice yields to a given (Hertz's) pressure as one twice as fine does, wherever it acts: by itself it yields
17 to 36 % less if the radius of the pressure is 0.6 edges of a face, 12 to 17 % at 1.2 and 1 edges, and then to 2.3 % as much, 6 % at 0.4
edges (``benchmarks/contact_steps.py --given``; no contact was computed to find them). `THINNEST` keeps the first touch of a single point
soft, at the expense of smaller indenters.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.mechanics.contact.contact_surfaces import face_quadrature
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients, implicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.surface import surface_faces

SHARED, PER_RADIUS, THINNEST = 0.7, 1.48, 0.35
FLAT = 0.48  # thickness under flat indenters, whose contact comes and goes at once
SINGLE = 0.15  # thickness where nodes touch for themselves: they stand on nothing that is coarser than themselves
FLAT_ORDER = 2  # Gauss points per side of a face under a plane, exact for the product of two shape functions
LEAST_ORDER, MOST_ORDER = 3, 8
RESOLVED = 0.95  # radius of an indenter over the edge of a face from which forces are within 3 % of those of a mesh twice as fine
SWIFT = 10.0  # ratio of the stiffness of foundations to m / h^2 of nodes from which the latter follow at once
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
    _rules: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict, init=False, repr=False)

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
        if order not in self._rules:
            shape, weight = face_quadrature(self.points, self.faces, order)
            self._rules[order] = np.pad(shape, ((0, 0), (0, 4 - shape.shape[1]))), weight
        return self._rules[order]

    def thickness(self, geometry: IndenterGeometry) -> FloatArray:
        """Return the thickness of the foundations (f,) before an indenter presses them, in lengths of the elements."""
        single = self.faces.shape[1] == 1
        return np.full(len(self.faces), SINGLE if single else THINNEST if geometry.curvature > 0.0 else FLAT)

    def foundation(self, step: float) -> FloatArray:
        """Return the coefficients (f, 4) of steps of a length, s.

        While a foundation one element thick is compressed by dw in a step, its pressure at the end is ``a dw + b y0`` and its extension
        ``y1 = e y0 + g dw``: a, b (kPa/mm), e and g.
        """
        tension, spring, _, _ = explicit_coefficients(self.parameters)
        _, _, decay, growth = implicit_coefficients(self.parameters, step)
        return np.ascontiguousarray(np.stack([tension / step + spring * growth, spring * decay, decay, growth], axis=1))

    def resists_at_once(self, step: float, mass: AnyFloatArray) -> bool:
        """Return whether foundations are so stiff beside the masses (n,), kg, that their pressure is settled in a step, s.

        If so, the pressure of the nodes may follow from step to step; the ratio is that of the stiffness to ``m / h^2`` at a typical node.
        """
        share = (self.foundation(step)[:, 0] * self.area / self.faces.shape[1]).repeat(self.faces.shape[1])
        stiffness = np.bincount(self.faces.ravel(), share, minlength=len(self.points))
        nodes = np.unique(self.faces)
        return bool(step**2 * np.median(stiffness[nodes] / mass[nodes]) >= SWIFT)


def radius_over_face(lattice: Lattice, geometry: IndenterGeometry) -> float:
    """Return the radius of an indenter over the edge of the faces that it may touch; infinite where it is flat or nodes touch alone."""
    faces = contact_faces(lattice)
    if geometry.curvature == 0.0 or faces.shape[1] == 1:
        return float("inf")
    edges = np.linalg.norm(lattice.points[faces] - lattice.points[np.roll(faces, -1, axis=1)], axis=2)
    return 1.0 / (geometry.curvature * float(np.median(edges)))


def unresolved(lattice: Lattice, geometry: IndenterGeometry, name: str) -> str:
    """Return what is to be said of an indenter that is smaller than what the surface resolves; empty where it is not.

    The figures are those of ``benchmarks/contact_steps.py --curves``.
    """
    ratio = radius_over_face(lattice, geometry)
    if ratio >= RESOLVED:
        return ""
    return (
        f"The radius of {name} is {ratio:.2g} of the edge of the faces, which do not resolve what it touches: its force may be wrong by 5 %"
        " at 0.7 and by 10 % at 0.5 edges (3 % at 1); use smaller cubes, or an octree."
    )


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
