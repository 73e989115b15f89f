"""First matching of interest points by normalised cross-correlation :cite:p:`zhang1995,hirai2008` (chapter 1.4, equations 1.1 to 1.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, as_points
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.feature_matching._correlation_kernels import candidates, compare
from naibu.imaging.preprocessing.resampling import positions


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidate pairs of points, many to many.

    Attributes
    ----------
    reference_mm : ndarray, shape (n, 3)
        Points of the reference, mm.
    deformed_mm : ndarray, shape (m, 3)
        Points of the deformed volume, mm.
    projected_mm : ndarray, shape (n, 3)
        Points of the reference after the rigid motion, mm.
    pairs : ndarray, shape (c, 2), int64
        Index of a reference point and of a deformed point, in the order of the former.
    scores : ndarray, shape (c,)
        Normalised cross-correlation of the boxes about them, -1 to 1.
    residuals : ndarray, shape (c,)
        Mean absolute intensity difference of the boxes, the second one rotated with the rigid motion; NaN where that leaves the volume.
    """

    reference_mm: FloatArray
    deformed_mm: FloatArray
    projected_mm: FloatArray
    pairs: IntArray
    scores: FloatArray
    residuals: FloatArray

    def __len__(self) -> int:
        return len(self.pairs)


def candidate_matches(
    reference: Volume,
    deformed: Volume,
    reference_mm: ArrayLike,
    deformed_mm: ArrayLike,
    *,
    search: ArrayLike = (8, 8, 3),
    match: ArrayLike = (4, 4, 2),
    rigid: RigidTransform | None = None,
    least_score: float = 0.6,
    search_growth: float = 0.0,
    turned_boxes: bool = False,
) -> Candidates:
    """Return candidate pairs: points in each other's search box whose surroundings correlate.

    Parameters
    ----------
    reference, deformed : Volume
        The image pair, with voxels of one size; their grids may differ otherwise.
    reference_mm, deformed_mm : array_like, shape (n, 3) and (m, 3)
        Interest points of each, mm (see `naibu.imaging.feature_matching.harris.interest_points`).
    search : array_like, shape (3,)
        Half the search box (u, v, w) along x, y, z, voxels: the box has ``(2u+1)(2v+1)(2w+1)``.
    match : array_like, shape (3,)
        Half the match box (m, n, h) along x, y, z, voxels. The report: (4, 4, 2) in (8, 8, 3), or (4, 4, 1) in (8, 8, 1).
    rigid : RigidTransform, optional
        Motion of the bone, which maps the reference points to the centres of their search boxes; by default none.
    least_score : float
        Pairs that score less are left out; -1 to 1.
    search_growth : float
        The search box grows by this fraction of itself from the intensity-weighted centroid of a slice to the point furthest from it; 0 or
        more. The report's box grows with that distance, by how much it does not say.
    turned_boxes : bool
        Whether the match box in the deformed volume is rotated with the rigid motion, and intensities are interpolated in it; the report
        compares voxel by voxel.

    Returns
    -------
    Candidates
        Pairs in the order of the reference points.

    Raises
    ------
    InputError
        Points of another shape, half boxes that are not whole numbers, a negative growth, voxels of different size, or no pair above
        `least_score`.
    """
    x1, x2 = as_points("reference_mm", reference_mm, 3, least=1), as_points("deformed_mm", deformed_mm, 3, least=1)
    if not search_growth >= 0.0:
        raise InputError(f"search_growth must be 0 or more, not {search_growth}")
    search_half, match_half = (_half(box, name) for box, name in ((search, "search"), (match, "match")))
    if np.abs(reference.spacing_mm - deformed.spacing_mm).max() > 1e-4 * reference.spacing_mm.min():
        raise InputError(
            f"the voxels of reference and deformed differ: {reference.spacing_mm.tolist()} and {deformed.spacing_mm.tolist()} mm; resample "
            "one volume to the spacing of the other"
        )
    # a volume of one slice is an image: its boxes are flat
    match_half = np.where(np.array(reference.shape[::-1]) > 1, match_half, 0)
    motion = RigidTransform.identity() if rigid is None else rigid
    projected = motion.applied(x1)
    half = np.broadcast_to(search_half.astype(float), x1.shape).copy()
    if search_growth > 0.0:
        half *= 1.0 + search_growth * _eccentricity(reference, x1)[:, None]
    pairs = _pairs(deformed.to_index(projected), deformed.to_index(x2), half)
    scores, residuals = np.empty(len(pairs)), np.empty(len(pairs))
    # steps along the axes of the reference, rotated with the motion and expressed in those of the deformed volume
    turn = deformed.direction.T @ motion.rotation @ reference.direction
    turn = (turn * reference.spacing_mm) / deformed.spacing_mm[:, None]
    turn = np.where(np.abs(turn - np.eye(3)).max() < 1e-9, np.eye(3), turn)
    intensity1, intensity2 = (np.ascontiguousarray(v.values, dtype=np.float32) for v in (reference, deformed))
    at1, at2 = _whole(reference.to_index(x1)), _whole(deformed.to_index(x2))
    compare(intensity1, intensity2, at1, at2, pairs, match_half, turn if turned_boxes else np.eye(3), turn, scores, residuals)
    good = scores >= least_score
    if not good.any():
        best = f"the best of {len(pairs)} pairs scores {np.nanmax(scores):.2f}" if np.isfinite(scores).any() else "no pair was in reach"
        raise InputError(f"no pair of points scores {least_score:g}: {best}; widen search, give a rigid motion or lower least_score")
    return Candidates(x1, x2, projected, pairs[good], scores[good], residuals[good])


def _pairs(points: FloatArray, others: FloatArray, half: FloatArray) -> IntArray:
    """Return the indices (c, 2) of points and others no further apart than half, in the order of the points."""
    order = np.argsort(others[:, 0], kind="stable")
    room = 16 * len(points)
    while True:
        first, second = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64)
        n = candidates(points, order, others[order, 0].copy(), others, half + 1e-9, first, second)
        if n <= room:
            return np.column_stack([first[:n], second[:n]])
        room = n


def _eccentricity(volume: Volume, points_mm: FloatArray) -> FloatArray:
    """Return the distance (n,) of points from the intensity-weighted centroid of their slices, as a fraction of the largest."""
    centred = np.asarray(volume.values, dtype=float)
    centred = centred - centred.min()
    total = np.maximum(centred.sum(axis=(1, 2)), 1e-300)
    centres = np.einsum("zyx,zyxc->zc", centred, positions(volume)) / total[:, None]
    slices = np.clip(np.rint(volume.to_index(points_mm)[:, 2]).astype(int), 0, volume.shape[0] - 1)
    distance = np.linalg.norm(points_mm - centres[slices], axis=1)
    return np.asarray(distance / max(float(distance.max()), 1e-300))


def _whole(index: FloatArray) -> FloatArray:
    """Return indices, those within rounding error of a whole number rounded to it."""
    nearest = np.rint(index)
    return np.where(np.abs(index - nearest) < 1e-6, nearest, index)


def _half(box: ArrayLike, name: str) -> IntArray:
    h = np.asarray(box)
    if h.shape != (3,) or h.dtype.kind not in "iu" or (h < 0).any():
        raise InputError(f"{name}, half a box, must be three whole numbers of voxels along x, y, z, 0 or more, not {h.tolist()}")
    return h.astype(np.int64)
