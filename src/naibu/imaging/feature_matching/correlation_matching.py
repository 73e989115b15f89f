"""First matching of interest points by normalised correlation (spec S4, equations 1.1-1.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.feature_matching._correlation_kernels import candidates, compare
from naibu.imaging.preprocessing.resampling import positions


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Pairs of points that may be the same: many to many.

    Attributes
    ----------
    initial_mm : ndarray, shape (n, 3)
        Points before, mm.
    deformed_mm : ndarray, shape (m, 3)
        Points after, mm.
    projected_mm : ndarray, shape (n, 3)
        Where the rigid motion carries the points before, mm.
    pairs : ndarray, shape (c, 2), int64
        Numbers of a point before and a point after, in the order of the former.
    scores : ndarray, shape (c,)
        Normalised correlation of the boxes about them, -1 to 1.
    residuals : ndarray, shape (c,)
        Mean absolute grey difference of the boxes, the second one turned with the rigid motion; NaN where that leaves the volume.
    """

    initial_mm: FloatArray
    deformed_mm: FloatArray
    projected_mm: FloatArray
    pairs: IntArray
    scores: FloatArray
    residuals: FloatArray

    def __len__(self) -> int:
        return len(self.pairs)


def candidate_matches(
    initial: Volume,
    deformed: Volume,
    initial_mm: ArrayLike,
    deformed_mm: ArrayLike,
    *,
    search: ArrayLike = (8, 8, 3),
    match: ArrayLike = (4, 4, 2),
    rigid: RigidTransform | None = None,
    least_score: float = 0.6,
    search_growth: float = 0.0,
    turned_boxes: bool = False,
) -> Candidates:
    """Return the pairs of points in each other's search box whose surroundings look alike (spec S4).

    Parameters
    ----------
    initial, deformed : Volume
        Before and after, with voxels of one size; their grids may differ otherwise.
    initial_mm, deformed_mm : array_like, shape (n, 3) and (m, 3)
        Interest points of either, mm (see `naibu.imaging.feature_matching.harris.interest_points`).
    search : array_like, shape (3,)
        Half the search box (u, v, w) along x, y, z, voxels: the box has ``(2u+1)(2v+1)(2w+1)``.
    match : array_like, shape (3,)
        Half the match box (m, n, h) along x, y, z, voxels. The report: (4, 4, 2) in (8, 8, 3), or (4, 4, 1) in (8, 8, 1).
    rigid : RigidTransform, optional
        Motion of the bone, which carries the points before to where they are searched for; by default none.
    least_score : float
        Pairs that score less are left out.
    search_growth : float
        The search box grows by this share of itself from the middle of a slice, where grey mass has its centre, to the point furthest
        from it; the report's box grows with that distance, by how much it does not say.
    turned_boxes : bool
        Whether the match box in the deformed volume is turned with the rigid motion, and grey values are interpolated in it; the report
        compares the voxels as they lie.

    Returns
    -------
    Candidates
        Pairs in the order of the points before.

    Raises
    ------
    InputError
        Points of another shape, boxes that are no boxes, voxels of different size, or no pair above the least score.
    """
    x1, x2 = (_points(points, name) for points, name in ((initial_mm, "initial"), (deformed_mm, "deformed")))
    search_half, match_half = (_half(box, name) for box, name in ((search, "search"), (match, "match")))
    if np.abs(initial.spacing_mm - deformed.spacing_mm).max() > 1e-4 * initial.spacing_mm.min():
        raise InputError(
            f"the voxels differ: {initial.spacing_mm.tolist()} and {deformed.spacing_mm.tolist()} mm; resample one volume to the "
            "spacing of the other"
        )
    # a volume of one slice is an image: its boxes are flat
    match_half = np.where(np.array(initial.shape[::-1]) > 1, match_half, 0)
    motion = RigidTransform.identity() if rigid is None else rigid
    projected = motion.applied(x1)
    half = np.broadcast_to(search_half.astype(float), x1.shape).copy()
    if search_growth > 0.0:
        half *= 1.0 + search_growth * _eccentricity(initial, x1)[:, None]
    pairs = _pairs(deformed.to_index(projected), deformed.to_index(x2), half)
    scores, residuals = np.empty(len(pairs)), np.empty(len(pairs))
    # steps along the axes of the initial volume, carried along and expressed in those of the deformed one
    turn = deformed.direction.T @ motion.rotation @ initial.direction
    turn = (turn * initial.spacing_mm) / deformed.spacing_mm[:, None]
    turn = np.where(np.abs(turn - np.eye(3)).max() < 1e-9, np.eye(3), turn)
    grey1, grey2 = (np.ascontiguousarray(v.values, dtype=np.float32) for v in (initial, deformed))
    at1, at2 = _whole(initial.to_index(x1)), _whole(deformed.to_index(x2))
    compare(grey1, grey2, at1, at2, pairs, match_half, turn if turned_boxes else np.eye(3), turn, scores, residuals)
    good = scores >= least_score
    if not good.any():
        told = f"the best of {len(pairs)} pairs scores {np.nanmax(scores):.2f}" if np.isfinite(scores).any() else "no pair was in reach"
        raise InputError(f"no two points look alike by {least_score:g}: {told}; widen the search, give a rigid motion or lower least_score")
    return Candidates(x1, x2, projected, pairs[good], scores[good], residuals[good])


def _pairs(places: FloatArray, others: FloatArray, half: FloatArray) -> IntArray:
    """Return the numbers (c, 2) of places and others no further apart than half, in the order of the places."""
    order = np.argsort(others[:, 0], kind="stable")
    room = 16 * len(places)
    while True:
        first, second = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64)
        n = candidates(places, order, others[order, 0].copy(), others, half + 1e-9, first, second)
        if n <= room:
            return np.column_stack([first[:n], second[:n]])
        room = n


def _eccentricity(volume: Volume, points_mm: FloatArray) -> FloatArray:
    """Return the distance (n,) of points from the centre of grey mass of their slices, as a share of the largest."""
    places = positions(volume)
    grey = np.asarray(volume.values, dtype=float)
    grey = grey - grey.min()
    mass = np.maximum(grey.sum(axis=(1, 2)), 1e-300)
    centres = np.einsum("zyx,zyxc->zc", grey, places) / mass[:, None]
    slices = np.clip(np.rint(volume.to_index(points_mm)[:, 2]).astype(int), 0, volume.shape[0] - 1)
    distance = np.linalg.norm(points_mm - centres[slices], axis=1)
    return np.asarray(distance / max(float(distance.max()), 1e-300))


def _whole(index: FloatArray) -> FloatArray:
    """Return indices with those that rounding moved off a voxel put back on it."""
    nearest = np.rint(index)
    return np.where(np.abs(index - nearest) < 1e-6, nearest, index)


def _points(points_mm: ArrayLike, name: str) -> FloatArray:
    p = np.ascontiguousarray(points_mm, dtype=float)
    if p.ndim != 2 or p.shape[1] != 3 or len(p) == 0 or not np.isfinite(p).all():
        raise InputError(f"the {name} points must be finite and have shape (n, 3), mm, n at least 1, not {p.shape}")
    return p


def _half(box: ArrayLike, name: str) -> IntArray:
    h = np.asarray(box)
    if h.shape != (3,) or h.dtype.kind not in "iu" or (h < 0).any():
        raise InputError(f"half the {name} box must be three whole numbers of voxels along x, y, z, not {h.tolist()}")
    return h.astype(np.int64)
