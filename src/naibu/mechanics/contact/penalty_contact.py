"""Penalty contact with rigid bodies and between stacked blocks, unilateral or tied, with Coulomb friction :cite:p:`wriggers2006`.

Contact is evaluated at points, each a fixed combination of nodes: quadrature points of boundary faces against a rigid body, or pairs
of nodes on an interface between blocks. Per unit of reference area the pressure is ``p = k_n <-g>`` (a C1 ramp; or ``-k_n g`` where tied),
and the tangential traction t follows by a return mapping of the elastic predictor ``t = k_t P (y - a)`` to ``|t| <= mu p``; `a` is the
anchor of the point, a history variable. Large k_t and mu stick; finite k_t with mu = inf are tangential springs; mu = 0 is frictionless.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics.contact._geometry_kernels import distance_with_derivatives, mesh_of, signed_distance
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry, packed_geometry
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern

RAMP_MM = 0.01  # penetration over which the contact pressure rises smoothly
STICK = 1e3  # a friction coefficient that never slips in practice


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Contact points against one rigid body that moves on a straight path.

    Attributes
    ----------
    name : str
        Name of the body, under which its reaction is returned.
    nodes : ndarray, shape (p, k), int64
        Nodes of every contact point.
    shape : ndarray, shape (p, k)
        Coefficients of the nodes: the point is at ``sum_a shape[a] x[nodes[a]]``.
    rest : ndarray, shape (p, 3)
        Position of the point in the reference configuration, mm (for a pair of nodes: their difference).
    area : ndarray, shape (p,)
        Reference area of every point, mm2.
    surface : IndenterGeometry
        The body's surface.
    start, stop : ndarray, shape (3,)
        Position of the body's reference point at the beginning and at the end of loading, mm.
    rotation : ndarray, shape (3, 3)
        Orientation of the body at the beginning.
    normal_stiffness : ndarray, shape (p,)
        Penalty, kPa/mm.
    tangential_stiffness, friction_coefficient : ndarray, shape (p,)
        Stiffness before slip, kPa/mm, and Coulomb's coefficient.
    element_size : ndarray, shape (p,)
        Edge of the element face to which the point belongs, mm: the square root of its area.
    tied : bool
        Whether points can neither separate nor slip.
    tilt : ndarray, shape (3,), optional
        Rotation vector, rad, of the body about its reference point at full load; it grows in proportion to the load. A plate that tilts
        during loading touches flat at first; one that is tilted from the beginning would touch at an edge.
    """

    name: str
    nodes: IntArray
    shape: FloatArray
    rest: FloatArray
    area: FloatArray
    surface: IndenterGeometry
    start: FloatArray
    stop: FloatArray
    rotation: FloatArray
    normal_stiffness: FloatArray
    tangential_stiffness: FloatArray
    friction_coefficient: FloatArray
    element_size: FloatArray
    tied: bool = False
    tilt: FloatArray | None = None

    def orientation(self, load: float) -> FloatArray:
        """Return the body's orientation (3, 3) at the fraction `load` of the path."""
        return self.rotation if self.tilt is None else rotation_matrix(load * self.tilt) @ self.rotation

    def position(self, load: float) -> FloatArray:
        """Return the position (3,) of the body's reference point at the fraction `load` of the path, mm."""
        return np.asarray(self.start + load * (self.stop - self.start))

    def with_path(self, start: FloatArray, stop: FloatArray) -> Contact:
        """Return the contact with another path of the body."""
        return replace(self, start=np.asarray(start, dtype=float), stop=np.asarray(stop, dtype=float))

    def positions(self, displacement: FloatArray) -> FloatArray:
        """Return positions (p, 3) of the points, mm (for a pair of nodes: their difference)."""
        return np.asarray(self.rest + np.einsum("pk,pki->pi", self.shape, displacement[self.nodes]))

    def local(self, displacement: FloatArray, load: float) -> FloatArray:
        """Return positions (p, 3) of the points in the body's frame, at the fraction `load` of the path."""
        return np.asarray((self.positions(displacement) - self.position(load)) @ self.orientation(load))

    def gap(self, displacement: FloatArray, load: float) -> FloatArray:
        """Return the distances (p,) of the points from the body, mm, negative inside."""
        return self.surface.distance(self.local(displacement, load))

    def anchors_at_rest(self) -> FloatArray:
        """Return anchors (p, 3) for the beginning of loading, in the body's frame."""
        return (self.rest - self.start) @ self.rotation

    def evaluate(self, displacement: FloatArray, anchors: FloatArray, load: float, *, curvature: bool = True) -> ContactResponse:
        """Return gaps, tractions and their derivatives at every point.

        Parameters
        ----------
        displacement : ndarray, shape (n, 3)
            Displacement of the nodes, mm.
        anchors : ndarray, shape (p, 3)
            Frictional anchors in the body's frame, mm.
        load : float
            Fraction of the body's path.
        curvature : bool
            Whether the stiffness includes the curvature of the body's surface.

        Notes
        -----
        Without the `curvature` of the body the stiffness lacks the geometric term by which a point slips off an edge: it is not the
        derivative of the force then, but prevents equilibrium iterations from cycling there.
        """
        y = self.local(displacement, load)
        n = len(y)
        vectors, matrices = np.zeros((3, n, 3)), np.zeros((3, n, 3, 3))
        response = ContactResponse(self.orientation(load), y, np.empty(n), *vectors, *matrices)
        _tractions(
            packed_geometry(self.surface), self.surface.axes, y, anchors, self.area, self.normal_stiffness, self.tangential_stiffness,
            self.friction_coefficient, self.tied, float(curvature), response.gap, response.force, response.tangential,
            response.slip_direction, response.stiffness, response.tangential_stiffness, response.anchor_stiffness,
        )  # fmt: skip
        return response

    def scattered(self, force: FloatArray, n_points: int, orientation: FloatArray) -> FloatArray:
        """Return the nodal forces (n, 3), mN, of point forces (p, 3), mN, given in the frame of a body of this `orientation` (3, 3)."""
        out = np.zeros((n_points, 3))
        _scatter_forces(self.nodes, self.shape, np.ascontiguousarray(force), np.ascontiguousarray(orientation), out)
        return out

    def add_stiffness(self, response: ContactResponse, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add the negative derivative of the contact forces to the tangent `blocks`; `positions` from ``pattern.positions(nodes)``."""
        touching = np.flatnonzero(response.stiffness.any(axis=(1, 2)))  # few of all points
        world = response.orientation @ response.stiffness[touching] @ response.orientation.T
        _scatter_blocks(touching, positions, self.shape, world, blocks)

    def next_anchors(self, response: ContactResponse) -> FloatArray:
        """Return the anchors (p, 3) with which the next load step starts: where the elastic slip is that of the present traction."""
        return response.local - response.tangential / self.tangential_stiffness[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class ContactResponse:
    """Gaps, tractions and their derivatives at all contact points, in the body's frame.

    Attributes
    ----------
    orientation : ndarray, shape (3, 3)
        Orientation of the body.
    local : ndarray, shape (p, 3)
        Positions, mm.
    gap : ndarray, shape (p,)
        Distance to the body, mm; negative where the penalty lets the point penetrate.
    force : ndarray, shape (p, 3)
        Force on the deformable body, mN.
    tangential : ndarray, shape (p, 3)
        Friction traction t, kPa (the force has the part ``-t`` times the area).
    slip_direction : ndarray, shape (p, 3)
        Derivative of the force with respect to the friction coefficient, mN; zero where the point sticks.
    stiffness : ndarray, shape (p, 3, 3)
        Minus the derivative of the force with respect to the position, mN/mm.
    tangential_stiffness : ndarray, shape (p, 3, 3)
        Derivative of the friction traction with respect to the position, kPa/mm.
    anchor_stiffness : ndarray, shape (p, 3, 3)
        Derivative of the force with respect to the anchor, mN/mm.
    """

    orientation: FloatArray
    local: FloatArray
    gap: FloatArray
    force: FloatArray
    tangential: FloatArray
    slip_direction: FloatArray
    stiffness: FloatArray
    tangential_stiffness: FloatArray
    anchor_stiffness: FloatArray


@njit(cache=True, inline="always")
def normal_pressure(g, k_n, tied):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the pressure of a point with the gap g and its derivative by the gap, both zero where the point does not touch."""
    if tied:
        return -k_n * g, -k_n
    if g >= 0.0:
        return 0.0, 0.0
    if g > -RAMP_MM:
        return 0.5 * k_n * g * g / RAMP_MM, k_n * g / RAMP_MM
    return -k_n * (g + 0.5 * RAMP_MM), -k_n


@njit(cache=True, **UNCOUNTED)
def trial_friction(y, anchor, n, h, k_t, e, d_trial):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the size of the friction traction of a point that sticks; set the traction e (3,) and its derivative d_trial (3, 3)."""
    along, size = 0.0, 0.0
    for i in range(3):
        along += n[i] * (y[i] - anchor[i])
    for i in range(3):
        e[i] = k_t * (y[i] - anchor[i] - along * n[i])
        size += e[i] * e[i]
    # derivative of the trial traction: k_t (P - along H - n (H (y - a))^T)
    for j in range(3):
        hd = 0.0
        for m in range(3):
            hd += h[j, m] * (y[m] - anchor[m])
        for i in range(3):
            d_trial[i, j] = k_t * ((1.0 if i == j else 0.0) - n[i] * n[j] - along * h[i, j] - n[i] * hd)
    return np.sqrt(size)


@njit(cache=True, **UNCOUNTED)
def friction_derivative(e, size, n, d_trial, limit, rise, sliding, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set out (3, 3) to the derivative of a friction traction that may slide at a limit, which changes by `rise` with the gap."""
    for i in range(3):
        for j in range(3):
            out[i, j] = d_trial[i, j]
            if sliding:
                projected = d_trial[i, j]
                for m in range(3):
                    projected -= e[i] * e[m] / (size * size) * d_trial[m, j]
                out[i, j] = limit / size * projected + rise * n[j] * e[i] / size


@njit(cache=True, nogil=True)
def _tractions(  # type: ignore[no-untyped-def]  # pragma: no cover
    geometry, axes, y, anchors, area, k_n, k_t, mu, tied, curvature,
    gap, force, friction, slip, stiffness, friction_stiffness, anchor_stiffness,
):  # fmt: skip
    """Forces and tractions of all points and their derivatives; see the module's text for the law."""
    n, e, turned = np.empty(3), np.empty(3), np.empty(3)
    h, d_trial, none = np.empty((3, 3)), np.empty((3, 3)), np.empty((0, 0))
    mesh = mesh_of(geometry, 0)
    for q in range(len(y)):
        for i in range(3):
            turned[i] = y[q, 0] * axes[i, 0] + y[q, 1] * axes[i, 1] + y[q, 2] * axes[i, 2]
        gap[q] = signed_distance(geometry[0][0], geometry[1][0], mesh, turned, n, none)
        p, dp = normal_pressure(gap[q], k_n[q], tied)
        if dp == 0.0:
            continue
        distance_with_derivatives(geometry, axes, y[q], n, h)
        size = trial_friction(y[q], anchors[q], n, h, k_t[q], e, d_trial)
        sliding = not tied and size > mu[q] * p
        ratio = mu[q] * p / size if sliding else 1.0
        for i in range(3):
            friction[q, i] = ratio * e[i]
            force[q, i] = area[q] * (p * n[i] - ratio * e[i])
        friction_derivative(e, size, n, d_trial, mu[q] * p, mu[q] * dp, sliding, friction_stiffness[q])
        for i in range(3):
            for j in range(3):
                da = k_t[q] * ((1.0 if i == j else 0.0) - n[i] * n[j])
                if sliding:
                    projected_a = da
                    for m in range(3):
                        projected_a -= e[i] * e[m] / (size * size) * k_t[q] * ((1.0 if m == j else 0.0) - n[m] * n[j])
                    da = ratio * projected_a
                stiffness[q, i, j] = area[q] * (friction_stiffness[q, i, j] - dp * n[i] * n[j] - curvature * p * h[i, j])
                anchor_stiffness[q, i, j] = area[q] * da
            if sliding:
                slip[q, i] = -area[q] * p * e[i] / size


@njit(cache=True, nogil=True)
def _scatter_forces(nodes, shape, force, orientation, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the forces of points, in the frame of a body, to those of their nodes."""
    for q in range(len(nodes)):
        if force[q, 0] == 0.0 and force[q, 1] == 0.0 and force[q, 2] == 0.0:
            continue
        for i in range(3):
            world = orientation[i, 0] * force[q, 0] + orientation[i, 1] * force[q, 1] + orientation[i, 2] * force[q, 2]
            for a in range(nodes.shape[1]):
                out[nodes[q, a], i] += shape[q, a] * world


@njit(cache=True, nogil=True)
def _scatter_blocks(points, positions, shape, stiffness, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the stiffnesses (m, 3, 3) of the `points` (m,) to the blocks of their nodes."""
    k = shape.shape[1]
    for row in range(len(points)):
        q = points[row]
        for a in range(k):
            for b in range(k):
                w = shape[q, a] * shape[q, b]
                block = blocks[positions[q, a, b]]
                for i in range(3):
                    for j in range(3):
                        block[i, j] += w * stiffness[row, i, j]
