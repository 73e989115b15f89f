"""Tangents of earlier states that are kept: a body that goes back where it came from finds the one of that place again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.finite_strain.sessions.earlier_tangent import EarlierTangent

MOST = 5  # tangents
MOST_BYTES = 3e8  # of the columns of their inverses
NEARER = 0.6  # of the distance of the tangent in use, at which another one takes its place: that costs a factorization of the contact


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
        self, displacement: FloatArray, held: IntArray, used: EarlierTangent | None, others: Iterable[EarlierTangent]
    ) -> EarlierTangent | None:
        """Return that of the state nearest to a displacement (n, 3), mm, among those kept and `others`; None where none holds these nodes.

        The one in use is returned where another is not much nearer.
        """
        usable = [t for t in (*self._kept, *others) if np.array_equal(t.held, held)]
        if not usable:
            return None
        best = min(usable, key=lambda t: _distance(t.displacement, displacement))
        if used is None or not any(used is t for t in usable):
            return best
        near = _distance(best.displacement, displacement) <= NEARER * _distance(used.displacement, displacement)
        return best if near else used

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
