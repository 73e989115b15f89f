"""Where a tool is: a copy of it at another place, where it waits, the next point on its way after a hand, and how deep it presses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray, IntArray, length_of
from naibu.mechanics.contact.rigid_indenters import RigidIndenter

THROUGH = 0.5  # of the thinnest half extent of a tool
MOST_RAISED = 40  # steps
ARRIVED_MM = 1e-4
TURNING = 3.0  # rad/s that a tool turns at most
LEAST_TURN = 1e-6  # rad


@dataclass(slots=True, eq=False)
class FollowedHand:
    """What follows a hand that is seen now and then, with a velocity that does not leap: two first-order low-pass filters in series.

    Otherwise it would rush to each place where the hand was seen, and wait there for the next: viscous bodies feel the velocity.
    """

    _between: FloatArray | None = field(init=False, default=None)  # what the first filter has come to

    def next_place(self, at: FloatArray, hand: FloatArray, duration_s: float, delay_s: float) -> FloatArray:
        """Return where it comes to from where it is (3,), mm; each filter delays by half of `delay_s`; 0 follows at once."""
        between = at if self._between is None else self._between
        if delay_s == 0.0 or max(np.abs(hand - at).max(), np.abs(hand - between).max()) < ARRIVED_MM:
            self._between = None
            return hand
        rest = float(np.exp(-2.0 * duration_s / delay_s))
        self._between = hand + rest * (between - hand)
        return np.asarray(self._between + rest * (at - self._between))

    def stop(self) -> None:
        """Begin anew, at rest."""
        self._between = None


def placed(tool: RigidIndenter, centre: FloatArray, rotation: FloatArray | None = None) -> RigidIndenter:
    """Return a tool at another place (3,), mm, rotated (3, 3) since it was made."""
    turned = tool.geometry if rotation is None else replace(tool.geometry, axes=tool.geometry.axes @ rotation.T)
    return replace(tool, geometry=turned, centre=centre)


def towards(start: FloatArray, target: FloatArray, reach: float) -> FloatArray:
    """Return the point on the way to a target that is at most `reach` away from the start."""
    way = target - start
    length = length_of(way)
    return np.asarray(target if length <= reach else start + way * (reach / length), dtype=float)


def turning_towards(rotation: FloatArray, wanted: FloatArray, duration_s: float) -> FloatArray:
    """Return the angular velocity (3,), rad/s, at which a tool turns to a rotation (3, 3) in a time, s, or in more at its fastest."""
    if wanted is rotation or np.linalg.norm(wanted - rotation) <= 2.0**0.5 * LEAST_TURN:  # the norm is 8^(1/2) sin(angle / 2)
        return np.zeros(3)
    left = Rotation.from_matrix(wanted @ rotation.T).as_rotvec()
    return np.asarray(left / max(duration_s, float(np.linalg.norm(left)) / TURNING))


def waiting_place(tool: RigidIndenter, points: FloatArray, step_mm: float) -> FloatArray:
    """Return where a tool waits (3,), mm: where it was made, raised by steps until it is clear of points (n, 3), mm, of the body."""
    centre = np.array(tool.centre, dtype=float)
    for _ in range(MOST_RAISED):
        if placed(tool, centre).gap(points).min() > 0.0:
            return centre
        centre[2] += step_mm
    below = tool.geometry.reach(np.array([0.0, 0.0, -1.0]))
    return np.array([*centre[:2], float(points[:, 2].max()) + below + step_mm])


def farthest_in_a_step(tool: RigidIndenter) -> float:
    """Return how far a tool may move in a step, mm, so that nothing passes through its middle."""
    size = np.asarray(tool.geometry.size)
    return THROUGH * float(size[size > 0.0].min(initial=np.inf))


def surface_samples(positions: FloatArray, faces: IntArray) -> FloatArray:
    """Return corners, middles of edges and centroid of every triangle (7 f, 3), mm.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        Of the nodes, mm.
    faces : ndarray, shape (f, 3), int
        Triangles.
    """
    corners = positions[faces]
    middles = 0.5 * (corners + np.roll(corners, 1, axis=1))
    return np.concatenate([corners, middles, corners.mean(axis=1, keepdims=True)], axis=1).reshape(-1, 3)


def indentation_depth(tool: RigidIndenter, force: FloatArray, rest: FloatArray, positions: FloatArray, faces: IntArray) -> float:
    """Return how deep a tool lies below the surface at rest, along its force, mm; 0 without force.

    A sample that was moved by m along the force, and is now g away from the tool (negative inside), says that the tool has come m - g deep:
    exactly where it lies ahead of the tool, and less elsewhere. The largest counts: the displacement that an indentation test plots.

    Parameters
    ----------
    tool : RigidIndenter
        Where it is.
    force : ndarray, shape (3,)
        Of the tool on the body, mN.
    rest, positions : ndarray, shape (n, 3)
        Of the nodes at rest and now, mm.
    faces : ndarray, shape (f, 3), int
        Triangles of the surface.
    """
    size = float(np.linalg.norm(force))
    if size == 0.0 or not len(faces):
        return 0.0
    nodes, corners = np.unique(faces, return_inverse=True)
    moved = positions[nodes]
    deep = ((moved - rest[nodes]) @ force / size - tool.gap(moved))[corners.reshape(faces.shape)].max(axis=1)
    sides = positions[faces] - np.roll(positions[faces], 1, axis=1)
    near = faces[deep + 2.0 * np.sqrt((sides**2).sum(axis=2).max(axis=1)) >= deep.max()]  # others cannot have a deeper sample
    now = surface_samples(positions, near)
    return max(0.0, float(((now - surface_samples(rest, near)) @ force / size - tool.gap(now)).max()))
