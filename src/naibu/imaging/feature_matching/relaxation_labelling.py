"""Relaxation labelling: from many-to-many candidates to one-to-one matches that agree with their neighbours (spec S5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.imaging.feature_matching._relaxation_kernels import CHEN, DIRECTION, DIRECTION26, RESIDUAL, mutual_best, strengths
from naibu.imaging.feature_matching.correlation_matching import Candidates

Strength = Literal["chen", "residual", "direction", "direction26"]
STRENGTHS: dict[Strength, int] = {"chen": CHEN, "residual": RESIDUAL, "direction": DIRECTION, "direction26": DIRECTION26}
Stop = Literal["the energy fell", "nothing changed", "max_iterations was reached"]


@dataclass(frozen=True, slots=True, eq=False)
class PotentialMatches:
    """The potential match set: pairs of points each of which is the other's best.

    Attributes
    ----------
    pairs : ndarray, shape (n, 2), int64
        Numbers of a point before and a point after.
    initial_mm, deformed_mm, projected_mm : ndarray, shape (n, 3)
        Points before, points after, and where the rigid motion carries those before, mm.
    scores : ndarray, shape (n,)
        Normalised correlation.
    strengths : ndarray, shape (n,)
        Strength of match.
    energies : ndarray, shape (t,)
        Mean strength of the match set in every iteration.
    counts : ndarray, shape (t,), int64
        Size of the match set in every iteration.
    stop : str
        Why the iteration ended.
    """

    pairs: IntArray
    initial_mm: FloatArray
    deformed_mm: FloatArray
    projected_mm: FloatArray
    scores: FloatArray
    strengths: FloatArray
    energies: FloatArray
    counts: IntArray
    stop: Stop

    def __len__(self) -> int:
        return len(self.pairs)


def relaxed(
    candidates: Candidates,
    *,
    strength: Strength = "direction26",
    radius_mm: float | None = None,
    alpha_step: float = 0.1,
    alpha_max: float = 1.0,
    max_iterations: int = 101,
) -> PotentialMatches:
    """Return the matches on which neighbours agree (spec S5).

    Parameters
    ----------
    candidates : Candidates
        Pairs with their correlation (see `naibu.imaging.feature_matching.correlation_matching.candidate_matches`).
    strength : {"chen", "residual", "direction", "direction26"}
        What a pair gains from a potential match in both its neighbourhoods: see the notes.
    radius_mm : float, optional
        Radius of the neighbourhoods, mm; by default that which holds some 20 points before on average.
    alpha_step, alpha_max : float
        The weight alpha of the neighbours grows from 0 by `alpha_step` an iteration up to `alpha_max`.
    max_iterations : int
        Give up after so many; the report needs 101 for 72 matches.

    Returns
    -------
    PotentialMatches
        The set with the highest energy.

    Raises
    ------
    InputError
        An unknown strength, a radius that is not positive, or fewer than one iteration.

    Notes
    -----
    A pair is in the match set when each is the other's best. Every iteration computes the strength of every candidate from the match set,
    the energy (1.5) as the mean strength of the match set, and a new set from mutual best strengths; it ends when the energy falls.
    With cs the correlation, n a neighbour pair, ``diff = |d1 - d2| / mean(d1, d2)`` the relative difference of its distances from the
    pair before and after (printed (1.19) lacks the modulus), and directions those of displacements that remain after the rigid motion:

    ``chen``: ``cs + alpha sum cs(n) exp(-diff / 0.3)``, 0 where diff > 0.3 (Zhang 1995; the report's baseline).

    ``residual`` (1.15): ``cs + alpha sum cs(n) eta / (1 + diff)``, ``eta = exp(-lambda zeta) / sum exp(-lambda zeta)``,
    ``lambda = (zeta - mean zeta)^2``, zeta the grey residual of the neighbour pair in units of its mean over all candidates, without which
    (1.16) would depend on the unit of grey.

    ``direction`` (1.6): ``cs + sum cs(n) exp(-O (1 + diff))``, ``O = 1 + 1 / (1 + cos theta)``; 180 degrees weigh nothing. It has no alpha.

    ``direction26`` (1.23): ``cs + alpha sum cs(n) w``, ``w = exp(-diff)`` for one direction among 26 (8 in a plane), else
    ``exp(-A diff / 3)``, A = 1, 2, 3 for less than, equal to, and more than 90 degrees. Where a point stays in place it counts as 90
    degrees from any other, and as one direction with another that stays.

    References
    ----------
    Z. Zhang, R. Deriche, O. Faugeras, Q.-T. Luong: A robust technique for matching two uncalibrated images through the recovery of the
    unknown epipolar geometry. Artificial Intelligence 78 (1995) 87-119.
    """
    if strength not in STRENGTHS:
        raise InputError(f"strength must be one of {', '.join(STRENGTHS)}, not {strength!r}")
    if max_iterations < 1 or (radius_mm is not None and not radius_mm > 0.0):
        raise InputError(f"radius_mm must be positive and max_iterations at least 1, not {radius_mm} and {max_iterations}")
    radius = _usual_radius(candidates.projected_mm) if radius_mm is None else radius_mm
    field = _Field.of(candidates, STRENGTHS[strength], radius)
    kept = mutual_best(candidates.pairs, candidates.scores, field.n_initial, field.n_deformed)
    best, sm = kept, candidates.scores
    energies: list[float] = []
    counts: list[int] = []
    alpha = 0.0
    stop: Stop = "max_iterations was reached"
    for _ in range(max_iterations):
        values = field.strengths(kept, alpha)
        energy = float(values[kept].mean())
        if energies and energy < energies[-1]:
            stop = "the energy fell"
            break
        energies.append(energy)
        counts.append(len(kept))
        best, sm = kept, values
        kept = mutual_best(candidates.pairs, values, field.n_initial, field.n_deformed)
        grown = min(alpha + alpha_step, alpha_max) if strength != "direction" else 0.0
        if grown == alpha and np.array_equal(kept, best):
            stop = "nothing changed"
            break
        alpha = grown
    pairs = candidates.pairs[best]
    return PotentialMatches(
        pairs,
        candidates.initial_mm[pairs[:, 0]],
        candidates.deformed_mm[pairs[:, 1]],
        candidates.projected_mm[pairs[:, 0]],
        candidates.scores[best],
        sm[best],
        np.array(energies),
        np.array(counts),
        stop,
    )


def direction_states(vectors: FloatArray, plane: bool = False) -> IntArray:
    """Return the direction of vectors (n, 3) as one of 26 states, 8 in a plane: (n, 3) whole numbers -1, 0, 1; zero vectors have none.

    The state is that of the 26 neighbours of a cube, seen from its middle, that lies nearest in angle.
    """
    grid = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    states = grid[(np.abs(grid).sum(axis=1) > 0) & ((grid[:, 2] == 0) | (not plane))]
    cosine = vectors @ (states / np.linalg.norm(states, axis=1)[:, None]).T
    out = states[np.argmax(cosine, axis=1)]
    out[np.linalg.norm(vectors, axis=1) < 1e-9] = 0
    return np.ascontiguousarray(out, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    """Candidates with what is the same in all iterations."""

    candidates: Candidates
    kind: int
    radius: float
    residuals: FloatArray
    moves: FloatArray
    states: IntArray
    start: IntArray
    near: IntArray

    @classmethod
    def of(cls, candidates: Candidates, kind: int, radius: float) -> _Field:
        before, after = (candidates.projected_mm, candidates.deformed_mm)
        moves = after[candidates.pairs[:, 1]] - before[candidates.pairs[:, 0]]
        plane = bool(np.ptp(before[:, 2]) < 1e-9 and np.ptp(after[:, 2]) < 1e-9)
        known = np.where(np.isfinite(candidates.residuals), candidates.residuals, np.nanmax(candidates.residuals, initial=0.0))
        # neighbours are looked up once: in compressed rows
        rows = cKDTree(before).query_pairs(radius, output_type="ndarray")
        both = np.concatenate([rows, rows[:, ::-1]])
        both = both[np.argsort(both[:, 0], kind="stable")]
        start = np.searchsorted(both[:, 0], np.arange(len(before) + 1))
        zeta = known / max(float(known.mean()), 1e-300)
        states = direction_states(moves, plane)
        return cls(candidates, kind, radius, zeta, moves, states, start.astype(np.int64), np.ascontiguousarray(both[:, 1], dtype=np.int64))

    @property
    def n_initial(self) -> int:
        return len(self.candidates.initial_mm)

    @property
    def n_deformed(self) -> int:
        return len(self.candidates.deformed_mm)

    def strengths(self, kept: IntArray, alpha: float) -> FloatArray:
        """Return the strength of every candidate, given the match set."""
        c = self.candidates
        match_of = np.full(self.n_initial, -1)
        match_of[c.pairs[kept, 0]] = kept
        out = np.empty(len(c))
        strengths(
            *(self.kind, alpha, c.pairs, c.scores, self.residuals, c.projected_mm, c.deformed_mm, self.moves, self.states),
            *(self.start, self.near, match_of, self.radius, out),
        )
        return out


def _usual_radius(points_mm: FloatArray, neighbours: int = 20) -> float:
    """Return the radius, mm, within which a point has so many neighbours, by the median."""
    k = min(neighbours + 1, len(points_mm))
    distance = cKDTree(points_mm).query(points_mm, k=[k])[0]
    return max(float(np.median(distance)), 1e-9)
