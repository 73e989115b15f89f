"""Motion of rigid indenters during a step: a pose at its end, a velocity, or a force along a guide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray, as_vector, require_positive
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics.contact.rigid_indenters import RigidIndenter


@dataclass(frozen=True, slots=True, eq=False)
class IndenterVelocity:
    """A velocity of an indenter during a step.

    Attributes
    ----------
    velocity : ndarray, shape (3,)
        Of its reference point, mm/s.
    angular_velocity : ndarray, shape (3,)
        rad/s, about the reference point.
    """

    velocity: ArrayLike = (0.0, 0.0, 0.0)
    angular_velocity: ArrayLike = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class IndenterForce:
    """A force that drives a guided indenter during a step; its speed and the reaction are found together.

    Attributes
    ----------
    force : float
        Along the direction, mN.
    direction : ndarray, shape (3,)
        In which the indenter is guided; of any length.
    mass_kg : float
        Of the indenter.
    """

    force: float
    direction: ArrayLike
    mass_kg: float

    def guide(self) -> FloatArray:
        """Return the unit vector of the direction.

        Raises
        ------
        InputError
            A direction without length, a force that is not finite, or a mass that is not positive.
        """
        along = as_vector("direction", self.direction)
        if not np.linalg.norm(along) > 0.0:
            raise InputError("the direction of a driven indenter must have a length")
        if not np.isfinite(self.force):
            raise InputError(f"the force on a driven indenter must be finite, not {self.force:g} mN")
        require_positive("mass_kg", self.mass_kg, "kg")
        return np.asarray(along / np.linalg.norm(along))


IndenterMotion = RigidTransform | IndenterVelocity | IndenterForce
"""Motion of an indenter in a step: its pose at the end of it, from the position in which it was made; a velocity; or a force."""

SHARE = 0.5  # of the radius of the largest sphere in an indenter, by which it may move at once where it touches
MOST_PARTS = 4096  # of a step whose indenters are fast
CAUTION = 0.9  # of a gap, by which an indenter may move at once


def safe_fraction(
    indenters: Sequence[RigidIndenter], points: FloatArray, centres: FloatArray, axes: FloatArray, travel: FloatArray, turn: FloatArray,
    approach: float = 0.0,
) -> float:  # fmt: skip
    """Return the fraction of a motion, at most 1, in which no indenter passes through points, by conservative advancement.

    Either it reaches none, or it goes so little of its own thickness into them that the nearest face is the one it came with
    :cite:p:`ericson2005`.

    Parameters
    ----------
    indenters : sequence of RigidIndenter
        Their shapes.
    points : ndarray, shape (p, 3)
        Of the object, mm.
    centres, axes : ndarray, shape (k, 3) and (k, 3, 3)
        Where they are, mm, and their axes, in rows.
    travel, turn : ndarray, shape (k, 3)
        How far they move, mm, and turn, rad, about their reference points.
    approach : float
        How far the object moves meanwhile, mm.
    """
    fraction = 1.0
    for indenter, centre, own, moved, turned in zip(indenters, centres, axes, travel, turn, strict=True):
        allowed, arms = SHARE * indenter.geometry.inradius, points - centre
        way = float(np.linalg.norm(moved)) + approach
        if turned.any():
            way += float(np.linalg.norm(turned)) * float(np.linalg.norm(arms, axis=1).max())
        if way > fraction * allowed:
            gap = float(replace(indenter.geometry, axes=own).distance(arms).min())
            fraction = min(fraction, max(allowed, CAUTION * gap) / way)
    return fraction


def step_parts(
    indenters: Sequence[RigidIndenter], points: FloatArray, centres: FloatArray, axes: FloatArray, travel: FloatArray, turn: FloatArray,
    approach: float = 0.0,
) -> int:  # fmt: skip
    """Return into how many parts, a power of two, a step is divided in each of which no indenter passes through points.

    The parameters are those of `safe_fraction`.
    """
    if slow_enough(indenters, travel, turn, approach):
        return 1
    allowed, ways = harmless_ways(indenters), np.maximum(np.linalg.norm(travel, axis=1), approach)
    if turn.any():
        arms = np.array([np.linalg.norm(points - centre, axis=1).max() for centre in centres])
        ways = ways + np.linalg.norm(turn, axis=1) * arms
    if (ways <= allowed).all() or safe_fraction(indenters, points, centres, axes, travel, turn, approach) >= 1.0:
        return 1
    return int(min(2 ** np.ceil(np.log2((ways / allowed).max())), MOST_PARTS))


def parts_of_approach(
    indenters: Sequence[RigidIndenter], points: FloatArray, moves: FloatArray, centres: FloatArray, axes: FloatArray, travel: FloatArray,
    turn: FloatArray,
) -> int:  # fmt: skip
    """Return into how many parts, a power of two, a step is divided in each of which no point passes through an indenter.

    It looks at every point by itself: only points that come nearer to an indenter, and that could reach it, count. The distance from a
    convex shape grows for ever on a straight line on which it begins to grow.

    Parameters
    ----------
    indenters : sequence of RigidIndenter
        Their shapes.
    points, moves : ndarray, shape (p, 3)
        Of the object, mm, and how far each moves in the step, mm.
    centres, axes, travel, turn
        Of the indenters; see `safe_fraction`.
    """
    parts = 1.0
    for indenter, centre, own, moved, turned in zip(indenters, centres, axes, travel, turn, strict=True):
        arms = points - centre
        relative = moves - moved - np.cross(turned, arms)
        ways, allowed = np.linalg.norm(relative, axis=1), SHARE * indenter.geometry.inradius
        fast = ways > allowed
        if not fast.any():
            continue
        shape, arms, relative, ways = replace(indenter.geometry, axes=own), arms[fast], relative[fast], ways[fast]
        gaps = shape.distance(arms)
        reaching = gaps < ways
        if indenter.geometry.convex:
            reaching &= shape.distance(arms + 1e-3 * relative) < gaps
        parts = max(parts, float((ways[reaching] / allowed).max(initial=1.0)))
    return int(min(2 ** np.ceil(np.log2(parts)), MOST_PARTS))


def slow_enough(indenters: Sequence[RigidIndenter], travel: FloatArray, turn: FloatArray, approach: float = 0.0) -> bool:
    """Tell whether indenters that do not turn, and what they touch, move so little that none passes through anything.

    Each may move by `SHARE` of the radius of the largest sphere in the indenter: together they stay below that radius.
    """
    return not turn.any() and bool((np.maximum(np.linalg.norm(travel, axis=1), approach) <= harmless_ways(indenters)).all())


def harmless_ways(indenters: Sequence[RigidIndenter]) -> FloatArray:
    """Return how far (k,), mm, indenters may move at once where they touch."""
    return np.array([SHARE * i.geometry.inradius for i in indenters])


Poses = dict[int, tuple[FloatArray, FloatArray]]


def indenter_velocities(
    indenters: Sequence[RigidIndenter], motions: Sequence[IndenterMotion], centres: FloatArray, axes: FloatArray, duration_s: float
) -> tuple[FloatArray, FloatArray, Poses]:
    """Return velocities (k, 3), mm/s, and angular velocities (k, 3), rad/s, of indenters, and the centre and axes of those given a pose.

    Parameters
    ----------
    indenters : sequence of RigidIndenter
        As they were made; a pose transforms them.
    motions : sequence of IndenterMotion
        One for each indenter, or none: they stand still. Those driven by a force have no velocity yet.
    centres, axes : ndarray, shape (k, 3) and (k, 3, 3)
        Where they are, mm, and their axes, in rows.
    duration_s : float
        In which a pose is reached.

    Raises
    ------
    InputError
        A pose or velocity that is not finite or not in three dimensions.
    """
    velocity, spin, poses = np.zeros((len(indenters), 3)), np.zeros((len(indenters), 3)), {}
    for k, motion in enumerate(motions):
        if isinstance(motion, IndenterVelocity):
            velocity[k] = as_vector(f"velocity of motions[{k}]", motion.velocity)
            spin[k] = as_vector(f"angular_velocity of motions[{k}]", motion.angular_velocity)
        elif isinstance(motion, RigidTransform):
            if motion.rotation.shape != (3, 3):
                raise InputError(f"motions[{k}] is a pose in {len(motion.rotation)} dimensions; give one in three")
            body = indenters[k]
            centre = as_vector(f"the pose of motions[{k}]", motion.applied(np.asarray(body.centre, dtype=float)[None])[0])
            turned = body.geometry.axes @ motion.rotation.T
            velocity[k] = (centre - centres[k]) / duration_s
            spin[k] = Rotation.from_matrix(turned.T @ axes[k]).as_rotvec() / duration_s
            poses[k] = (centre, turned)
    return velocity, spin, poses
