"""What holds and presses a body: prescribed nodes, rigid bodies in contact, interfaces between blocks, weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK, Contact

QUADRATURE_ORDER = 3  # Gauss points a side of a quadrilateral face: contact edges cross faces, so more than elasticity needs


@dataclass(frozen=True, slots=True)
class Friction:
    """How a surface rubs on another.

    Attributes
    ----------
    coefficient : float
        Coulomb's coefficient; `STICK` or more never slips, 0 slips freely.
    stiffness : float
        Tangential stiffness before slip, kPa/mm; a soft one makes tangential springs.
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
    """Let boundary faces touch a rigid body.

    Parameters
    ----------
    name : str
        Name of the body, under which its reaction is returned.
    points : ndarray, shape (n, 3)
        Nodes of the mesh in the free state, mm.
    faces : ndarray, shape (f, 3) or (f, 4), int64
        Boundary faces that may touch.
    surface : IndenterGeometry
        Shape of the body.
    start, stop : array_like, shape (3,)
        Path of the body's reference point, mm.
    friction : Friction or list of Friction
        One for all faces or one for each face.
    normal_stiffness : float
        Penalty, kPa/mm: a pressure p lets the surface penetrate by p / normal_stiffness.
    tied : bool
        Whether the body sticks to the faces for good (tie): no lift-off, no slip.
    rotation : ndarray, shape (3, 3), optional
        Constant orientation of the body.

    Raises
    ------
    InputError
        No faces, or a penalty that is not positive.
    """
    if len(faces) == 0:
        raise InputError(f"{name}: no faces to touch; check the selection of the surface")
    if not normal_stiffness > 0.0:
        raise InputError(f"{name}: the normal stiffness must be positive, not {normal_stiffness:g} kPa/mm")
    shape, area = face_quadrature(points, faces)
    n_q = shape.shape[0]
    nodes = np.repeat(faces, n_q, axis=0)
    coefficients = np.tile(shape, (len(faces), 1))
    pairs = [friction] * len(faces) if isinstance(friction, Friction) else friction
    return Contact(
        name, nodes, coefficients, np.einsum("pk,pki->pi", coefficients, points[nodes]), area.ravel(), surface,
        np.asarray(start, dtype=float), np.asarray(stop, dtype=float), np.eye(3) if rotation is None else rotation, normal_stiffness,
        np.repeat([f.stiffness for f in pairs], n_q), np.repeat([f.coefficient for f in pairs], n_q), tied,
    )  # fmt: skip


def interface(
    name: str, points: FloatArray, pairs: IntArray, area: FloatArray, *, friction: Friction, normal_stiffness: float, tied: bool = False
) -> Contact:
    """Lay one block on another: pairs (k, 2) of a lower and an upper node at the same place, each standing for `area` (k,) mm2.

    The blocks may separate and slide (``bonded=False``); the normal is vertical in the free state and kept, which suits interfaces that
    stay near horizontal.

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
        normal_stiffness, np.full(k, friction.stiffness), np.full(k, friction.coefficient), tied,
    )  # fmt: skip


def face_quadrature(points: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return shape values (q, k) of the quadrature points of faces, and the areas (f, q), mm2, that they stand for."""
    corners = points[faces]
    if faces.shape[1] == 3:
        shape = np.full((3, 3), 1.0 / 6.0) + 0.5 * np.eye(3)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return shape, np.repeat(np.linalg.norm(normal, axis=1)[:, None] / 6.0, 3, axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_ORDER)
    xi, eta = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
    weight = np.outer(weights, weights).ravel()
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    along, across = 1 + xi[:, None] * signs[:, 0], 1 + eta[:, None] * signs[:, 1]
    tangents = [np.einsum("qk,fki->fqi", d, corners) for d in (0.25 * signs[:, 0] * across, 0.25 * along * signs[:, 1])]
    return 0.25 * along * across, weight * np.linalg.norm(np.cross(*tangents), axis=2)
