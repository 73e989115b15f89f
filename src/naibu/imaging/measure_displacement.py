"""Every way of sensing the displacement between two volumes behind one call and one result (spec S2-S8)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import block_matching
from naibu.imaging.dense_matching.hybrid import hybrid_flow
from naibu.imaging.dense_matching.optical_flow import horn_schunck, lucas_kanade
from naibu.imaging.displacement.strain import displacement_gradient
from naibu.imaging.feature_matching.correlation_matching import candidate_matches
from naibu.imaging.feature_matching.harris import interest_points
from naibu.imaging.feature_matching.relaxation_labelling import PotentialMatches, relaxed
from naibu.imaging.feature_matching.scattered_interpolation import dense_from_sparse, sparse_displacement
from naibu.imaging.preprocessing.object_mask import object_mask
from naibu.imaging.preprocessing.resampling import require_mask, resampled_to_grid
from naibu.imaging.preprocessing.rigid_registration import rigid_from_points, total_displacement
from naibu.imaging.volume_correlation.correlate import correlate_volumes

Method = Literal["default", "features", "sad-blocks", "ssd-blocks", "ncc-blocks", "horn-schunck", "lucas-kanade", "hybrid", "rigid"]
METHODS: tuple[Method, ...] = get_args(Method)
Progress = Callable[[str], None]
POINTS_BEFORE, POINTS_AFTER = 1500, 4000
FEWEST_MATCHES = 12  # for a rigid motion that is worth taking out
FARTHEST_SHARE = 0.12  # of the object's size: how far points are searched for at the first go
BLOCK_MM, REACH_MM = 8.0, 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """A displacement, and how it was found.

    Attributes
    ----------
    method : str
        One of `METHODS`.
    displacement : DisplacementField
        The whole motion, rigid part included, at the voxels of the reference; NaN outside the mask. Its covariance is None where the
        method states none.
    mask : ndarray, shape (nz, ny, nx), bool
        The object before.
    gradient : ndarray, shape (nz, ny, nx, 3, 3)
        ``du_a / dx_b``.
    rigid : RigidTransform, optional
        What was taken out first.
    matches : PotentialMatches, optional
        Points matched by the method of features, in the frame of the object before.
    facts : dict
        Numbers that the method tells about its own work.
    """

    method: Method
    displacement: DisplacementField
    mask: BoolArray
    gradient: FloatArray
    rigid: RigidTransform | None = None
    matches: PotentialMatches | None = None
    facts: dict[str, float | int | str] = field(default_factory=dict)


def measure_displacement(
    reference: Volume, deformed: Volume, *, method: Method = "default", mask: ArrayLike | None = None, progress: Progress | None = None
) -> Sensed:
    """Return the displacement that carries one volume onto another, by a method of one's choice with settings that fit the volumes.

    Parameters
    ----------
    reference, deformed : Volume
        Before and after, on one grid.
    method : str
        ``"default"`` correlates the volumes with the mechanics' help (`naibu.imaging.volume_correlation.correlate`); ``"features"``
        matches interest points by relaxation (S3-S6); ``"sad-blocks"``, ``"ssd-blocks"``, ``"ncc-blocks"`` match blocks;
        ``"horn-schunck"``, ``"lucas-kanade"`` follow the optical flow; ``"hybrid"`` combines both as the report does (S7); ``"rigid"``
        moves the object as one piece (S2).
    mask : array_like, shape (nz, ny, nx), optional
        Voxels of the object before; by default what `naibu.imaging.preprocessing.object_mask.object_mask` finds.
    progress : callable, optional
        Told what begins.

    Raises
    ------
    InputError
        An unknown method, volumes on different grids, a constant volume, or a mask that is empty or of another shape.
    """
    if method not in METHODS:
        raise InputError(f"there is no method {method!r}; choose one of {', '.join(METHODS)}")
    if not reference.same_grid(deformed):
        raise InputError(
            f"the volumes lie on different grids: {_grid(reference)} before, {_grid(deformed)} after. Resample one to the other's grid "
            "(naibu.imaging.preprocessing.resampling.resampled_to_grid)"
        )
    inside = object_mask(reference) if mask is None else require_mask(mask, reference)
    if method == "default":
        return _correlated(reference, deformed, inside, None if mask is None else inside, progress)
    tell = progress or (lambda stage: None)
    tell("rigid motion")
    matches, rigid = rigid_start(reference, deformed, inside)
    if method == "features":
        return _from_features(reference, matches, rigid, inside)
    tell(method)
    back = resampled_to_grid(deformed, reference, through=rigid.applied)
    found = _still(reference) if method == "rigid" else _flow(method, reference, back, inside)
    vectors = total_displacement(found.vectors, rigid, reference)
    vectors[~inside] = np.nan
    whole = DisplacementField.on_grid(reference, vectors, valid=found.valid & inside, quality=found.quality)
    return Sensed(method, whole, inside, displacement_gradient(vectors, reference), rigid=rigid, facts={"matched points": len(matches)})


def _grid(volume: Volume) -> str:
    return f"{'x'.join(str(n) for n in volume.shape[::-1])} voxels of {'x'.join(f'{d:g}' for d in volume.spacing_mm)} mm"


def rigid_start(reference: Volume, deformed: Volume, mask: BoolArray) -> tuple[PotentialMatches, RigidTransform]:
    """Match interest points of the object, and return them with the rigid motion that most of them share.

    The motion is the identity where fewer than a dozen points agree. Points are searched within an eighth of the object's size.
    """
    extent = np.ptp(np.argwhere(mask), axis=0)[::-1] + 1
    half = np.array([4, 4, 2 if extent[2] > 4 else 0])
    reach = np.maximum(half, np.ceil(FARTHEST_SHARE * (extent * reference.spacing_mm).max() / reference.spacing_mm))
    reach = np.minimum(reach, extent // 2 + 1).astype(int)
    before = interest_points(reference, count=POINTS_BEFORE, mask=mask).points_mm
    after = interest_points(deformed, count=POINTS_AFTER).points_mm
    found = relaxed(candidate_matches(reference, deformed, before, after, search=reach, match=half))
    return found, _shared_motion(found)


def _shared_motion(found: PotentialMatches) -> RigidTransform:
    """Horn's motion of the matches, from which the worst are left out until the others stay within three times their median."""
    kept = np.ones(len(found), dtype=bool)
    for _ in range(20):
        if kept.sum() < FEWEST_MATCHES:
            return RigidTransform.identity()
        try:
            motion = rigid_from_points(found.reference_mm[kept], found.deformed_mm[kept]).transform
        except InputError:  # on one line
            return RigidTransform.identity()
        off = np.linalg.norm(motion.applied(found.reference_mm) - found.deformed_mm, axis=1)
        good = off <= 3.0 * np.median(off[kept])
        if (good == kept).all():
            break
        kept = good
    return motion


def _still(reference: Volume) -> DisplacementField:
    return DisplacementField.on_grid(reference, np.zeros((*reference.shape, 3)))


def _flow(method: Method, a: Volume, b: Volume, mask: BoolArray) -> DisplacementField:
    flat = np.array(a.shape[::-1]) > 1
    half = np.where(flat, np.clip(np.round(0.5 * BLOCK_MM / a.spacing_mm), 1, 4), 0).astype(int)
    block, search = 2 * half + 1, np.where(flat, np.ceil(REACH_MM / a.spacing_mm), 0).astype(int)
    if method == "horn-schunck":
        return horn_schunck(a, b, mask=mask)
    if method == "lucas-kanade":
        return lucas_kanade(a, b, mask=mask)
    if method == "hybrid":
        grey = np.percentile(a.values[mask], (0.5, 99.5))
        return hybrid_flow(a, b, block=block, search=search, least_range=float(np.ptp(grey)) * 30.0 / 256.0, mask=mask)
    measures: dict[str, Literal["sad", "ssd", "ncc"]] = {"sad-blocks": "sad", "ssd-blocks": "ssd", "ncc-blocks": "ncc"}
    return block_matching(a, b, block=block, search=search, measure=measures[method], mask=mask)


def _from_features(reference: Volume, matches: PotentialMatches, rigid: RigidTransform, mask: BoolArray) -> Sensed:
    if len(matches) < FEWEST_MATCHES:
        raise InputError(f"only {len(matches)} points of the volumes match; the images have too little texture in common for features")
    dense = dense_from_sparse(sparse_displacement(matches), reference, outside="affine")
    vectors = np.where(mask[..., None], dense.vectors, np.nan)
    facts: dict[str, float | int | str] = {"matched points": len(matches), "iterations": len(matches.energies), "stopped": matches.stop}
    return Sensed(
        "features",
        DisplacementField.on_grid(reference, vectors, valid=dense.valid & mask, quality=dense.quality),
        mask,
        displacement_gradient(vectors, reference),
        rigid=rigid,
        matches=matches,
        facts=facts,
    )


def _correlated(reference: Volume, deformed: Volume, inside: BoolArray, given: BoolArray | None, progress: Progress | None) -> Sensed:
    # without a mask the correlation takes one that reaches over the surface, which holds much of the contrast
    found = correlate_volumes(reference, deformed, mask=given, progress=progress)
    facts: dict[str, float | int | str] = {
        "grey noise": found.noise,
        "cells of the spline grid, mm": float(found.grid.step_mm.mean()),
        "rigid bodies": int(found.bodies.max()),
        "iterations": found.status,
    }
    valid = found.valid & inside
    outside = ~valid
    vectors, gradient, covariance = found.displacement.vectors.copy(), found.gradient(), found.covariance().astype(np.float64)
    for values in (vectors, gradient, covariance):
        values[outside] = np.nan
    field = DisplacementField.on_grid(reference, vectors, covariance=covariance, valid=valid)
    return Sensed("default", field, inside, gradient, facts=facts)
