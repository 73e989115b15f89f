"""Tangents of bodies that have turned since, in axes that turn with them, as in corotational methods :cite:p:`felippa2005`.

A body that nothing holds turns as it is lifted, pulled or falls, and hardly changes its shape meanwhile. Its tangent turns with it: with
that of a state from which it has turned by some degrees, iterations would follow the rotation little by little, or not at all. Where parts
of a body move apart, as a piece that a cut has freed, the rotation of the whole is that of none of them, and its tangent stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.rigid_transform import registration
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.linear_algebra.paired_motion import PairedMotion
from naibu.mechanics.linear_algebra.turned_factors import TurnedFactors
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors

LEAST_TURN = 0.01  # rad, by which a tangent is turned, or turned anew
MOSTLY = 0.5  # of a motion, translation aside: what a rotation may leave of it where the body turns, rather than changes its shape


def rotation_to(before: FloatArray, after: FloatArray) -> tuple[FloatArray, float]:
    """Return the rotation (3, 3) that leads positions (n, 3), mm, to others best, and the root of the sum of the squares left, mm."""
    best = registration(before, after)
    return best.rotation, float(np.linalg.norm(after - best.applied(before)))


@dataclass(slots=True, eq=False)
class TurnedTangents:
    """The tangent in use as it was turned last, so that what is condensed with it serves several steps."""

    _of: EarlierTangent | None = field(init=False, default=None)
    _turned: EarlierTangent | None = field(init=False, default=None)
    _rotation: FloatArray = field(init=False, default_factory=lambda: np.eye(3))

    def of(self, tangent: EarlierTangent, points: FloatArray, displacement: FloatArray) -> EarlierTangent:
        """Return a tangent of a body that nothing holds, turned as the body has; as it is where a rotation explains little of the motion.

        Parameters
        ----------
        tangent : EarlierTangent
            Of an earlier state.
        points : ndarray, shape (n, 3)
            Nodes in the reference configuration, mm.
        displacement : ndarray, shape (n, 3)
            Where they are to be, mm.
        """
        if len(tangent.held):
            return tangent
        rotation, left = rotation_to(points + tangent.displacement, points + displacement)
        motion = displacement - tangent.displacement
        if left > MOSTLY * float(np.linalg.norm(motion - motion.mean(axis=0))):
            return tangent
        if tangent is not self._of or self._turned is None:
            self._of, self._turned, self._rotation = tangent, tangent, np.eye(3)
        if _angle(rotation @ self._rotation.T) >= LEAST_TURN:
            self._turned, self._rotation = turned(tangent, rotation), rotation
        return self._turned

    def forget(self) -> None:
        """Keep no tangent."""
        self._of = self._turned = None


def turned(tangent: EarlierTangent, rotation: FloatArray) -> EarlierTangent:
    """Return a tangent, contacts and pairs of sides of cuts among it, in axes that a rotation (3, 3) has turned."""
    factors, pairs = tangent.factors, tangent.pairs
    assert isinstance(factors, UpdatedFactors)
    if pairs.n_pairs:
        there = (pairs.of_condensed.reshape(-1, 3) @ rotation.T.astype(np.float32)).reshape(pairs.of_condensed.shape)
        pairs = PairedMotion(pairs.numbers, pairs.nodes, pairs.directions @ rotation.T, pairs.inverse, there)
    return replace(
        tangent, factors=TurnedFactors(factors, rotation), dilatation=tangent.dilatation @ rotation.T, pairs=pairs,
        contact=rotation @ tangent.contact @ rotation.T, lips=rotation @ tangent.lips @ rotation.T,
    )  # fmt: skip


def _angle(rotation: FloatArray) -> float:
    """Return the angle of a rotation (3, 3), rad."""
    return float(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0)))
