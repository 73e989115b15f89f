"""Relaxation labelling: from many-to-many candidates to one-to-one matches that agree with their neighbours.

The method of :cite:t:`zhang1995` with four strengths of match: that of :cite:t:`chen2001`, which the report compares itself with, and the
three of :cite:t:`hirai2008` (chapter 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray, require_positive
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
        Index of a reference point and of a deformed point.
    reference_mm, deformed_mm, projected_mm : ndarray, shape (n, 3)
        Points of the reference, points of the deformed volume, and reference points after the rigid motion, mm.
    scores : ndarray, shape (n,)
        Normalised cross-correlation.
    strengths : ndarray, shape (n,)
        Strength of match.
    energies : ndarray, shape (t,)
        Energy in every iteration: the mean strength of the match set.
    counts : ndarray, shape (t,), int64
        Size of the match set in every iteration.
    stop : str
        Why the iterations ended.
    """

    pairs: IntArray
    reference_mm: FloatArray
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
    neighbours: int = 20,
    distance_tolerance: float = 0.3,
) -> PotentialMatches:
    """Return one-to-one matches by relaxation labelling.

    Parameters
    ----------
    candidates : Candidates
        Pairs with their cross-correlation (see `naibu.imaging.feature_matching.correlation_matching.candidate_matches`).
    strength : {"chen", "residual", "direction", "direction26"}
        Support of a pair by a potential match in both its neighbourhoods: see the notes.
    radius_mm : float, optional
        Radius of the neighbourhoods, mm; by default the median distance of the reference points to their neighbour number `neighbours`.
    alpha_step, alpha_max : float
        The weight alpha of the neighbours grows from 0 by `alpha_step` per iteration up to `alpha_max`; both 0 or more.
    max_iterations : int
        Largest number of iterations, 1 or more; the report needs 101 for 72 matches.
    neighbours : int
        Sets the default of `radius_mm`; 1 or more.
    distance_tolerance : float
        Relative difference of distances beyond which neighbours give no support, and scale of the weight below it, for the strength
        ``"chen"``; above 0.

    Returns
    -------
    PotentialMatches
        The match set of highest energy.

    Raises
    ------
    InputError
        An unknown strength, a length or tolerance that is not positive, a negative alpha, or numbers below one.

    Notes
    -----
    A pair is in the match set when each is the other's best. Every iteration computes the strength of every candidate from the match set,
    the energy (1.5) as the mean strength of the match set, and a new set from mutual best strengths; it ends when the energy falls.
    Equations are those of the report. With cs the cross-correlation, n a neighbour pair, ``diff = |d1 - d2| / mean(d1, d2)`` the relative
    difference of its distances from the pair in the reference and the deformed volume (printed (1.19) lacks the modulus), and directions
    those of displacements that remain after the rigid motion:

    ``chen``: ``cs + alpha sum cs(n) exp(-diff / 0.3)``, 0 where diff > 0.3, the `distance_tolerance` of :cite:t:`zhang1995`.

    ``residual`` (1.15): ``cs + alpha sum cs(n) eta / (1 + diff)``, ``eta = exp(-lambda zeta) / sum exp(-lambda zeta)``,
    ``lambda = (zeta - mean zeta)^2``, zeta the intensity residual of the neighbour pair in units of its mean over all candidates, without
    which (1.16) would depend on the unit of intensity.

    ``direction`` (1.6): ``cs + sum cs(n) exp(-O (1 + diff))``, ``O = 1 + 1 / (1 + cos theta)``, weight 0 at 180 degrees, no alpha.

    ``direction26`` (1.23): ``cs + alpha sum cs(n) w``, ``w = exp(-diff)`` for one direction among 26 (8 in a plane), else
    ``exp(-A diff / 3)``, A = 1, 2, 3 for less than, equal to, and more than 90 degrees. A displacement of zero counts as 90
    degrees from any other, and as the same direction as another zero.
    """
    if strength not in STRENGTHS:
        raise InputError(f"strength must be one of {', '.join(STRENGTHS)}, not {strength!r}")
    for name, number in (("max_iterations", max_iterations), ("neighbours", neighbours)):
        if number < 1:
            raise InputError(f"{name} must be 1 or more, not {number}")
    for name, weight in (("alpha_step", alpha_step), ("alpha_max", alpha_max)):
        if not weight >= 0.0:
            raise InputError(f"{name} must be 0 or more, not {weight}")
    tolerance = require_positive("distance_tolerance", distance_tolerance)
    radius = _usual_radius(candidates.projected_mm, neighbours) if radius_mm is None else require_positive("radius_mm", radius_mm, "mm")
    field = _Field.of(candidates, STRENGTHS[strength], radius, tolerance)
    kept = mutual_best(candidates.pairs, candidates.scores, field.n_reference, field.n_deformed)
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
        kept = mutual_best(candidates.pairs, values, field.n_reference, field.n_deformed)
        grown = min(alpha + alpha_step, alpha_max) if strength != "direction" else 0.0
        if grown == alpha and np.array_equal(kept, best):
            stop = "nothing changed"
            break
        alpha = grown
    pairs = candidates.pairs[best]
    return PotentialMatches(
        pairs,
        candidates.reference_mm[pairs[:, 0]],
        candidates.deformed_mm[pairs[:, 1]],
        candidates.projected_mm[pairs[:, 0]],
        candidates.scores[best],
        sm[best],
        np.array(energies),
        np.array(counts),
        stop,
    )


def direction_states(vectors: FloatArray, plane: bool = False) -> IntArray:
    """Quantise the direction of vectors (n, 3) to 26 states, 8 in a plane: (n, 3) whole numbers -1, 0, 1; zero vectors have none.

    The state is the offset to the one of the 26 neighbours of a voxel that is nearest in angle.
    """
    grid = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    states = grid[(np.abs(grid).sum(axis=1) > 0) & ((grid[:, 2] == 0) | (not plane))]
    cosine = vectors @ (states / np.linalg.norm(states, axis=1)[:, None]).T
    out = states[np.argmax(cosine, axis=1)]
    out[np.linalg.norm(vectors, axis=1) < 1e-9] = 0
    return np.ascontiguousarray(out, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    """Candidates with what stays the same in all iterations."""

    candidates: Candidates
    kind: int
    radius: float
    tolerance: float
    residuals: FloatArray
    moves: FloatArray
    states: IntArray
    start: IntArray
    near: IntArray

    @classmethod
    def of(cls, candidates: Candidates, kind: int, radius: float, tolerance: float) -> _Field:
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
        near = np.ascontiguousarray(both[:, 1], dtype=np.int64)
        return cls(candidates, kind, radius, tolerance, zeta, moves, states, start.astype(np.int64), near)

    @property
    def n_reference(self) -> int:
        return len(self.candidates.reference_mm)

    @property
    def n_deformed(self) -> int:
        return len(self.candidates.deformed_mm)

    def strengths(self, kept: IntArray, alpha: float) -> FloatArray:
        """Return the strength of every candidate, given the match set."""
        c = self.candidates
        match_of = np.full(self.n_reference, -1)
        match_of[c.pairs[kept, 0]] = kept
        out = np.empty(len(c))
        strengths(
            *(self.kind, alpha, self.tolerance, c.pairs, c.scores, self.residuals, c.projected_mm, c.deformed_mm, self.moves, self.states),
            *(self.start, self.near, match_of, self.radius, out),
        )
        return out


def _usual_radius(points_mm: FloatArray, neighbours: int) -> float:
    """Return the median radius, mm, within which a point has so many neighbours."""
    k = min(neighbours + 1, len(points_mm))
    distance = cKDTree(points_mm).query(points_mm, k=[k])[0]
    return max(float(np.median(distance)), 1e-9)
