"""Contact surfaces: boundary faces against rigid indenters, and interfaces between blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, require_positive
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK, Contact

QUADRATURE_ORDER = 3  # Gauss points per side of a quadrilateral face; more than for elasticity, as the edge of contact crosses faces


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction between two surfaces, with an elastic stiffness before slip.

    Attributes
    ----------
    coefficient : float
        Friction coefficient; `STICK` or more never slips, 0 is frictionless.
    stiffness : float
        Tangential stiffness before slip, kPa/mm; a low one makes tangential springs.

    Raises
    ------
    InputError
        A negative coefficient, or a stiffness that is not positive.
    """

    coefficient: float = STICK
    stiffness: float = 200.0

    def __post_init__(self) -> None:
        if not self.coefficient >= 0.0 or not self.stiffness > 0.0:
            raise InputError(
                f"friction needs a coefficient >= 0 and a stiffness > 0 kPa/mm, not {self.coefficient:g} and {self.stiffness:g}"
            )


def rigid_contact(
    name: str, points: FloatArray, faces: IntArray, surface: IndenterGeometry, *, start: ArrayLike, stop: ArrayLike,
    friction: Friction | list[Friction], normal_stiffness: float, tied: bool = False, rotation: FloatArray | None = None,
) -> Contact:  # fmt: skip
    """Return the contact of boundary faces with a rigid body.

    Parameters
    ----------
    name : str
        Name of the body, under which its reaction is returned.
    points : ndarray, shape (n, 3)
        Nodes of the mesh in the reference configuration, mm.
    faces : ndarray, shape (f, 3) or (f, 4), int64
        Boundary faces that may come into contact.
    surface : IndenterGeometry
        Shape of the body.
    start, stop : array_like, shape (3,)
        Position of the body's reference point at the beginning and at the end of loading, mm; it moves in a straight line.
    friction : Friction or list of Friction
        One for all faces or one for each face.
    normal_stiffness : float
        Penalty, kPa/mm: a pressure p lets the surface penetrate by p / normal_stiffness.
    tied : bool
        Whether the body is tied to the faces: neither separation nor slip.
    rotation : ndarray, shape (3, 3), optional
        Constant orientation of the body.

    Raises
    ------
    InputError
        No faces, or a penalty that is not positive.
    """
    if len(faces) == 0:
        raise InputError(f"{name}: faces is empty; check the selection of the surface")
    require_positive(f"{name}: normal_stiffness", normal_stiffness, "kPa/mm")
    shape, area = face_quadrature(points, faces)
    n_q = shape.shape[0]
    nodes = np.repeat(faces, n_q, axis=0)
    coefficients = np.tile(shape, (len(faces), 1))
    pairs = [friction] * len(faces) if isinstance(friction, Friction) else friction
    return Contact(
        name, nodes, coefficients, np.einsum("pk,pki->pi", coefficients, points[nodes]), area.ravel(), surface,
        np.asarray(start, dtype=float), np.asarray(stop, dtype=float), np.eye(3) if rotation is None else rotation,
        np.full(len(nodes), normal_stiffness), np.repeat([f.stiffness for f in pairs], n_q),
        np.repeat([f.coefficient for f in pairs], n_q), np.repeat(np.sqrt(area.sum(axis=1)), n_q), tied,
    )  # fmt: skip


def interface(
    name: str, points: FloatArray, pairs: IntArray, area: FloatArray, *, friction: Friction, normal_stiffness: float, tied: bool = False
) -> Contact:
    """Return the contact between two stacked blocks at pairs of coinciding nodes.

    The normal is vertical and constant, which suits interfaces that remain nearly horizontal.

    Parameters
    ----------
    name : str
        Name of the interface, under which its force is returned.
    points : ndarray, shape (n, 3)
        Nodes of the mesh in the reference configuration, mm.
    pairs : ndarray, shape (k, 2), int64
        Lower and upper node of every pair; see `naibu.meshing.split_at_plane`.
    area : ndarray, shape (k,)
        Tributary area of every pair, mm2.
    friction : Friction
        Friction of the interface.
    normal_stiffness : float
        Penalty, kPa/mm.
    tied : bool
        Whether the blocks are tied; otherwise they may separate and slide.

    Raises
    ------
    InputError
        The nodes of a pair do not coincide.
    """
    distance = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    if len(pairs) == 0 or distance.max() > 1e-6:
        raise InputError(f"{name}: an interface needs pairs of coinciding nodes; split the mesh with split_at_plane")
    k = len(pairs)
    return Contact(
        name, pairs, np.tile([-1.0, 1.0], (k, 1)), np.zeros((k, 3)), area, plane_geometry(), np.zeros(3), np.zeros(3), np.eye(3),
        np.full(k, normal_stiffness), np.full(k, friction.stiffness), np.full(k, friction.coefficient), np.sqrt(area), tied,
    )  # fmt: skip


def face_quadrature(points: FloatArray, faces: IntArray, order: int = QUADRATURE_ORDER) -> tuple[FloatArray, FloatArray]:
    """Return shape functions (q, k) at the quadrature points of faces, and their weights (f, q), mm2.

    Quadrilaterals have `order` Gauss points a side; triangles three points in each of ``(order // 2)^2`` parts, at least one.
    """
    corners = points[faces]
    if faces.shape[1] == 3:
        shape = _triangle_points(max(order // 2, 1))
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(normal, axis=1)
        return shape, np.repeat(area[:, None] / len(shape), len(shape), axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(order)
    xi, eta = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
    weight = np.outer(weights, weights).ravel()
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    along, across = 1 + xi[:, None] * signs[:, 0], 1 + eta[:, None] * signs[:, 1]
    tangents = [np.einsum("qk,fki->fqi", d, corners) for d in (0.25 * signs[:, 0] * across, 0.25 * along * signs[:, 1])]
    return 0.25 * along * across, weight * np.linalg.norm(np.cross(*tangents), axis=2)


def _triangle_points(parts: int) -> FloatArray:
    """Return barycentric coordinates (3 parts^2, 3): the three points of degree two in every part of a divided triangle."""
    rule = np.full((3, 3), 1.0 / 6.0) + 0.5 * np.eye(3)
    corners = []
    for i in range(parts):
        for j in range(parts - i):
            corners.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < parts - 1:
                corners.append([(i + 1, j + 1), (i, j + 1), (i + 1, j)])
    at = np.array(corners, dtype=float) / parts
    barycentric = np.concatenate([1.0 - at.sum(axis=2, keepdims=True), at], axis=2)
    return np.asarray(np.einsum("qk,tkc->tqc", rule, barycentric).reshape(-1, 3))
