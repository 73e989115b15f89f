"""Tangents of earlier states that are kept: a body that goes back where it came from finds the one of that place again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.tangents.turned_tangent import rotation_to

MOST = 5  # tangents
MOST_BYTES = 3e8  # of the columns of their inverses
AS_NEAR = 1.6  # times the distance of the nearest, up to which a newer one is used: it knows better what touches
SAME = 1e-3  # of the extent: distance, root of the mean square over the nodes, up to which states are the same


@dataclass(slots=True, eq=False)
class KeptTangents:
    """Tangents of states that are far from one another, as many as memory permits."""

    _kept: list[EarlierTangent] = field(init=False, default_factory=list)

    def keep(self, tangent: EarlierTangent) -> list[EarlierTangent]:
        """Keep the tangent that was made last, and return those that are given up for it."""
        given_up = []
        self._kept.append(tangent)
        while len(self._kept) > 1 and (len(self._kept) > MOST or sum(t.factors.column_bytes for t in self._kept) > MOST_BYTES):
            given_up.append(self._kept.pop(self._most_dispensable()))
        return given_up

    def drop(self, tangent: EarlierTangent) -> None:
        """Keep a tangent no longer."""
        self._kept = [kept for kept in self._kept if kept is not tangent]

    def drained(self) -> list[EarlierTangent]:
        """Return all, and keep none."""
        kept, self._kept = self._kept, []
        return kept

    def nearest(
        self, points: FloatArray, displacement: FloatArray, held: IntArray, extent_mm: float, older: Iterable[EarlierTangent]
    ) -> EarlierTangent | None:
        """Return the newest of those whose states are about as near as the nearest to a displacement.

        Where nothing is held, states that differ by a rotation are the same.

        Parameters
        ----------
        points : ndarray, shape (n, 3)
            Nodes in the reference configuration, mm.
        displacement : ndarray, shape (n, 3)
            Of the nodes of the body, mm.
        held : ndarray, shape (h,), int64
            Nodes that do not move; None is returned where no tangent holds just these.
        extent_mm : float
            Of the body.
        older : iterable of EarlierTangent
            Others beside those that are kept.
        """
        usable = [t for t in (*older, *self._kept) if np.array_equal(t.held, held)]
        if not usable:
            return None
        if len(held):
            far = [_distance(t.displacement, displacement) for t in usable]
        else:
            far = [rotation_to(points + t.displacement, points + displacement)[1] for t in usable]
        most = max(AS_NEAR * min(far), SAME * extent_mm * np.sqrt(len(displacement)))
        return [t for t, way in zip(usable, far, strict=True) if way <= most][-1]

    def _most_dispensable(self) -> int:
        """Return the number of the older one of the two that are nearest to each other; with other nodes held, that of the first."""
        newest = self._kept[-1]
        for k, tangent in enumerate(self._kept):
            if not np.array_equal(tangent.held, newest.held):
                return k
        n = len(self._kept)
        pairs = [(_distance(self._kept[j].displacement, self._kept[k].displacement), j) for j in range(n) for k in range(j + 1, n)]
        return min(pairs)[1]


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b))
