"""Regularization of zone moduli: total variation (:cite:p:`rudin1992`), for few jumps, or Laplacian, for slow variation.

Both act on theta = (ln mu, ln(kappa / mu)) of all zones, coupled, so that both jump at the same interface. Faces between cells have the
weight of their area, so that the penalty does not depend on the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.meshing.quality import signed_volumes
from naibu.meshing.surface import CELL_FACES

RegularizationName = Literal["total_variation", "laplacian"]
ROUNDING = 0.02  # jumps of a logarithm below this count quadratically in total variation
BULK_WEIGHT = 1.0  # weight of ln(kappa / mu) beside ln mu


@dataclass(frozen=True, slots=True, eq=False)
class ZoneGraph:
    """Unknown zones and the faces between them.

    Attributes
    ----------
    pairs : ndarray, shape (e, 2), int64
        Zones that touch, each pair once.
    area : ndarray, shape (e,)
        Area of their common faces, mm^2 (length in the plane, mm).
    distance : ndarray, shape (e,)
        Between their centroids, mm.
    volume : ndarray, shape (count,)
        Of the zones, mm^3.
    """

    pairs: IntArray
    area: FloatArray
    distance: FloatArray
    volume: FloatArray

    @classmethod
    def of(cls, mesh: Mesh, zones: Zones) -> ZoneGraph:
        """Find the faces between cells of different unknown zones."""
        inner, area = inner_faces(mesh)
        volume = cell_volumes(mesh)
        unknown = zones.of_cell != KNOWN
        of_zone = np.bincount(zones.of_cell[unknown], volume[unknown], minlength=zones.count)
        centres = mesh.points[mesh.cells].mean(axis=1)
        moments = [np.bincount(zones.of_cell[unknown], (volume * x)[unknown], minlength=zones.count) for x in centres.T]
        middle = np.stack(moments, axis=1) / np.maximum(of_zone, 1e-300)[:, None]
        between = np.sort(zones.of_cell[inner], axis=1)
        kept = (between[:, 0] != between[:, 1]) & (between[:, 0] != KNOWN)
        pairs, index = np.unique(between[kept], axis=0, return_inverse=True)
        pairs = pairs.reshape(-1, 2)
        areas = np.bincount(index.ravel(), area[kept], minlength=len(pairs))
        distance = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1)
        return cls(pairs.astype(np.int64), areas.astype(float), distance, of_zone.astype(float))

    @property
    def count(self) -> int:
        """Number of zones."""
        return len(self.volume)

    def difference(self) -> sp.csr_matrix:
        """Return the matrix (e, count) that takes the values of zones to their jumps."""
        e = len(self.pairs)
        values = np.concatenate([np.ones(e), -np.ones(e)])
        index = np.concatenate([np.arange(e)] * 2), np.concatenate([self.pairs[:, 0], self.pairs[:, 1]])
        return sp.csr_matrix((values, index), shape=(e, self.count))


def cell_volumes(mesh: Mesh) -> FloatArray:
    """Return the volume (area, length) of every cell (m,), mm^d."""
    if mesh.cell_type == "hexahedron":
        return signed_volumes(mesh)
    corners = mesh.points[mesh.cells]
    d = mesh.dimension
    return np.asarray(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / float(np.prod(np.arange(1, d + 1))))


def inner_faces(mesh: Mesh) -> tuple[IntArray, FloatArray]:
    """Return the two cells (f, 2) at every face inside a mesh, and its area (f,), mm^2 (length in the plane, 1 on a line)."""
    d = mesh.dimension
    if mesh.cell_type == "hexahedron":
        corners = CELL_FACES["hexahedron"]
    else:
        corners = np.array([[a for a in range(d + 1) if a != opposite] for opposite in range(d + 1)])
    around = mesh.cells[:, corners].reshape(-1, corners.shape[1])
    faces = np.sort(around, axis=1)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    first, second = order[:-1][same], order[1:][same]
    points = mesh.points[around[first]]
    edges = points[:, 2:] - points[:, :2] if mesh.cell_type == "hexahedron" else points[:, 1:] - points[:, :1]  # diagonals, or edges
    gram = np.einsum("fia,fja->fij", edges, edges)
    area = np.sqrt(np.linalg.det(gram)) / max(d - 1, 1) if d > 1 else np.ones(len(first))
    return np.stack([first, second], axis=1) // len(corners), area


class Regularization(Protocol):
    """A penalty on theta = (ln mu of all zones, ln(kappa / mu) of all zones)."""

    @property
    def name(self) -> str:
        """Of the penalty, for reports."""
        ...

    def value(self, theta: FloatArray) -> float:
        """Return the penalty."""
        ...

    def gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient (2 count,)."""
        ...

    def hessian(self, theta: FloatArray) -> sp.csr_matrix:
        """Return a positive semidefinite matrix (2 count, 2 count) that majorises its curvature at theta."""
        ...


class _OnJumps:
    """Common part: jumps of ln mu and of `bulk_weight` ln(kappa / mu) across faces."""

    def __init__(self, graph: ZoneGraph, bulk_weight: float) -> None:
        if not bulk_weight >= 0.0:
            raise InputError(f"the weight of ln(kappa / mu) must not be negative, not {bulk_weight:g}")
        self.graph = graph
        jump = graph.difference()
        self._shear = sp.hstack([jump, sp.csr_matrix(jump.shape)], format="csr")
        self._ratio = sp.hstack([sp.csr_matrix(jump.shape), bulk_weight * jump], format="csr")

    def jumps_squared(self, theta: FloatArray) -> FloatArray:
        """Return the squared jump of the two logarithms across every face (e,)."""
        return np.asarray((self._shear @ theta) ** 2 + (self._ratio @ theta) ** 2)

    def weighted(self, weight: FloatArray) -> sp.csr_matrix:
        """Return the Hessian of half the weighted sum of squared jumps."""
        diagonal = sp.diags(weight)
        return sp.csr_matrix(self._shear.T @ diagonal @ self._shear + self._ratio.T @ diagonal @ self._ratio)


class TotalVariation(_OnJumps):
    """Sum over faces of area times ``sqrt(jump^2 + rounding^2) - rounding``, jumps of both logarithms under one root.

    Its Hessian is that of lagged diffusivity (:cite:p:`vogel1996`), which majorises: steps that lower the quadratic lower the penalty
    itself.
    """

    name = "total_variation"

    def __init__(self, graph: ZoneGraph, *, rounding: float = ROUNDING, bulk_weight: float = BULK_WEIGHT) -> None:
        super().__init__(graph, bulk_weight)
        if not rounding > 0.0:
            raise InputError(f"the rounding of total variation must be positive, not {rounding:g}")
        self.rounding = rounding

    def value(self, theta: FloatArray) -> float:
        """Return the penalty, mm^2."""
        return float(np.sum(self.graph.area * (np.sqrt(self.jumps_squared(theta) + self.rounding**2) - self.rounding)))

    def gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient (2 count,)."""
        return np.asarray(self.hessian(theta) @ theta)

    def hessian(self, theta: FloatArray) -> sp.csr_matrix:
        """Return the matrix of lagged diffusivity (2 count, 2 count)."""
        return self.weighted(self.graph.area / np.sqrt(self.jumps_squared(theta) + self.rounding**2))


class Laplacian(_OnJumps):
    """Half the sum over faces of area over distance times the squared jump: half the integral of the squared gradient."""

    name = "laplacian"

    def __init__(self, graph: ZoneGraph, *, bulk_weight: float = BULK_WEIGHT) -> None:
        super().__init__(graph, bulk_weight)
        self._matrix = self.weighted(graph.area / np.maximum(graph.distance, 1e-300))

    def value(self, theta: FloatArray) -> float:
        """Return the penalty, mm."""
        return float(0.5 * theta @ (self._matrix @ theta))

    def gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient (2 count,)."""
        return np.asarray(self._matrix @ theta)

    def hessian(self, theta: FloatArray) -> sp.csr_matrix:
        """Return its Hessian (2 count, 2 count)."""
        return self._matrix


def regularization(name: RegularizationName, graph: ZoneGraph) -> Regularization:
    """Return the penalty of that name on the zones of a graph.

    Raises
    ------
    InputError
        An unknown name.
    """
    if name == "total_variation":
        return TotalVariation(graph)
    if name == "laplacian":
        return Laplacian(graph)
    raise InputError(f"regularization {name!r} is not known; use 'total_variation', 'laplacian' or None")
