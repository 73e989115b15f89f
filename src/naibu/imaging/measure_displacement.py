"""Measurement of the displacement field between two volumes, by digital volume correlation or a classic method, in one call.

The classic methods are those of :cite:t:`hirai2008` (chapters 1 and 3.5): interest points and relaxation labelling, block matching, optical
flow, and rigid registration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.memory import return_freed_memory
from naibu.core.progress import Progress, report_progress
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
from naibu.imaging.preprocessing.field_of_view import fields_of_view, in_box
from naibu.imaging.preprocessing.object_mask import LeftOut, left_out, mask_in_view, mask_jumps
from naibu.imaging.preprocessing.resampling import require_mask, resampled_to_grid
from naibu.imaging.preprocessing.rigid_registration import rigid_from_points, total_displacement
from naibu.imaging.preprocessing.volume_pair import require_known, require_one_grid
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.block_displacements import LEFT
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.sliding.part_by_part import APART, correlated_parts, doubt_beside
from naibu.imaging.volume_correlation.sliding.sliding_plate import without_plate

Method = Literal["default", "features", "sad-blocks", "ssd-blocks", "ncc-blocks", "horn-schunck", "lucas-kanade", "hybrid", "rigid"]
METHODS: tuple[Method, ...] = get_args(Method)
# Settings of the classic methods in this one call; empirical. Who wants others calls the methods themselves.
REFERENCE_POINTS, DEFORMED_POINTS = 1500, 4000  # interest points
FEWEST_MATCHES = 12  # for a rigid registration
SEARCH_FRACTION = 0.12  # search radius, in extents of the object
OUTLIER, REJECTIONS = 3.0, 20  # matches further off than so many medians are rejected, in so many rounds at most
BLOCK_MM, SEARCH_MM = 8.0, 12.0  # block size and search range of block matching
MOST_NAMED = 3  # slices in a warning
# in volumes of the object: space within it, and bright regions beside it, above which the user is told that they are left out
LEFT_OUT, SEPARATE = 0.02, 0.2
LEAST_RANGE = 30.0 / 256.0  # of the intensity range, above which the hybrid takes block matching: as in the report

# what the diagnostics of the methods mean, with their units
FACTS = {
    "matches": "matched interest points",
    "iterations": "iterations",
    "stop": "stopped because",
    "residual_sd": "noise of the intensity residual, SD without outliers",
    "cell_size_mm": "cell size of the spline grid, mm",
    "rigid_inclusions": "rigid inclusions",
    "convergence": "convergence",
    "unconverged_cells": "cells of the spline grid that have not converged",
    "unconverged_fraction": "fraction of the cells in the object that have not converged",
    "parts": "parts that were measured by themselves, since they slide on each other",
    "left_out_within": "space within the object that is left out as air outside, fraction of its volume",
    "left_out_apart": "bright regions apart from the object that are left out, fraction of its volume",
    "coarse_factor": "block by block: voxels along an edge of the coarse voxels of this page",
    "blocks": "block by block: number of blocks",
    "passes": "block by block: passes through the volumes",
}


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredDisplacement:
    """Displacement field between two volumes, and the facts of its measurement.

    Attributes
    ----------
    method : str
        One of `METHODS`.
    displacement : DisplacementField
        Total displacement, rigid motion included, at the voxels of the reference; NaN outside the mask. Its covariance is None where the
        method states none.
    mask : ndarray, shape (nz, ny, nx), bool
        Voxels of the object in the reference.
    gradient : ndarray, shape (nz, ny, nx, 3, 3)
        Displacement gradient ``du_a / dx_b``.
    rigid : RigidTransform, optional
        Rigid registration that preceded the method.
    matches : PotentialMatches, optional
        Interest points matched by ``"features"``.
    facts : dict
        Diagnostics of the method, by name; see `FACTS`.
    warnings : tuple of str
        What makes the result doubtful, in sentences for the user.
    blocks : DisplacementField, optional
        Displacement of small blocks of voxels with independent errors, to which models are fitted; the default method measures them.
    strain_sd : ndarray, shape (nz, ny, nx), optional
        Standard deviation of a component of the Green-Lagrange strain, root mean square over the components; the default method states it.
    """

    method: Method
    displacement: DisplacementField
    mask: BoolArray
    gradient: AnyFloatArray
    rigid: RigidTransform | None = None
    matches: PotentialMatches | None = None
    facts: dict[str, float | int | str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    blocks: DisplacementField | None = None
    strain_sd: Float32Array | None = None


def measure_displacement(
    reference: Volume,
    deformed: Volume,
    *,
    method: Method = "default",
    mask: ArrayLike | None = None,
    deformed_mask: ArrayLike | None = None,
    progress: Progress | None = None,
) -> MeasuredDisplacement:
    """Measure the displacement field between two volumes by a named method, with settings that follow from the volumes.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes before and after the deformation, on one grid.
    method : str
        ``"default"`` is digital volume correlation regularised by mechanics (`naibu.imaging.correlate_volumes`); ``"features"`` matches
        interest points by relaxation labelling; ``"sad-blocks"``, ``"ssd-blocks"``, ``"ncc-blocks"`` match blocks by absolute or squared
        differences or normalised cross-correlation; ``"horn-schunck"``, ``"lucas-kanade"`` are optical flow; ``"hybrid"`` combines block
        matching and optical flow as the report does; ``"rigid"`` is the rigid motion of the whole object.
    mask : array_like, shape (nz, ny, nx), optional
        Voxels of the object in the reference; by default from `naibu.imaging.object_mask`, without a plate that the object slides on.
    deformed_mask : array_like, shape (nz, ny, nx), optional
        Voxels of the object in the deformed volume, for digital volume correlation; the classic methods do not use it.
    progress : Progress, optional
        Called at the beginning of every stage.

    Raises
    ------
    InputError
        An unknown method, volumes on different grids, a constant volume, voxels that are NaN for another method than the default, or a mask
        that is empty or of another shape.
    """
    if method not in METHODS:
        raise InputError(f"method must be one of {', '.join(METHODS)}, not {method!r}")
    require_one_grid(reference, deformed)
    if method != "default":
        _require_measured(reference, deformed)
    views = fields_of_view(reference, deformed)
    for volume, view, name in zip((reference, deformed), views, ("reference", "deformed"), strict=True):
        require_known(volume, view, name)
    facts: dict[str, float | int | str] = {}
    if mask is None:
        view = views[0]
        inside = mask_in_view(reference, view)
        left = left_out(reference, inside, view)
        doubts = _mask_doubts(inside, left)
        facts = {"left_out_within": left.surrounded, "left_out_apart": left.separate}
        # the surface has much of the contrast
        compared = ndimage.binary_dilation(inside, mask=in_box(view, reference.shape))
    else:
        inside, doubts = require_mask(mask, reference), ()
        compared = inside
    given = mask is not None or deformed_mask is not None
    if method == "default":
        found = _correlated(reference, deformed, inside, (compared, deformed_mask), progress, given=given)
    else:
        found = _by_classic_method(reference, deformed, method, inside, progress)
    return replace(found, warnings=doubts + found.warnings, facts=found.facts | facts)


def _require_measured(reference: Volume, deformed: Volume) -> None:
    """Refuse voxels that were not measured, which the classic methods would compare."""
    for name, volume in (("reference", reference), ("deformed", deformed)):
        if volume.values.dtype.kind == "f" and np.isnan(volume.values).any():
            raise InputError(
                f"the {name} volume has voxels that are NaN, which only digital volume correlation leaves out; choose method='default', or "
                "crop the volumes"
            )


def _mask_doubts(mask: BoolArray, left: LeftOut) -> tuple[str, ...]:
    doubts = []
    jumps = mask_jumps(mask)
    if len(jumps):
        where = ", ".join(f"{k - 1} and {k}" for k in jumps[:MOST_NAMED]) + (" ..." if len(jumps) > MOST_NAMED else "")
        doubts.append(
            f"The mask of the object that was found jumps between neighbouring slices ({where}, from 0): if the object has no such step, "
            "parts of it are missing or too much is in it; give a `mask`."
        )
    if left.surrounded > LEFT_OUT:
        doubts.append(
            f"Space within the object that is open to the outside, {100.0 * left.surrounded:.0f} % of the object's volume, is left out of "
            "its mask: "
            "it is as dark as the air outside, and no denser. If it belongs to the object, give a `mask`."
        )
    if left.separate > SEPARATE:
        doubts.append(
            f"Bright regions apart from the object, {100.0 * left.separate:.0f} % of its volume, are left out of its mask, which holds "
            "the largest "
            "region only. If they belong to the object, as a second lung or leg does, give a `mask` of all of it."
        )
    return tuple(doubts)


def _by_classic_method(
    reference: Volume, deformed: Volume, method: Method, inside: BoolArray, progress: Progress | None
) -> MeasuredDisplacement:
    report_progress(progress, "rigid registration")
    matches, rigid = matched_rigidly(reference, deformed, inside)
    if method == "features":
        return _from_features(reference, matches, rigid, inside)
    report_progress(progress, method)
    back = resampled_to_grid(deformed, reference, through=rigid.applied)
    found = _still(reference) if method == "rigid" else _flow(method, reference, back, inside)
    vectors = total_displacement(found.vectors, rigid, reference)
    vectors[~inside] = np.nan
    whole = DisplacementField.on_grid(reference, vectors, valid=found.valid & inside, quality=found.quality)
    return MeasuredDisplacement(
        method, whole, inside, displacement_gradient(vectors, reference), rigid=rigid, facts={"matches": len(matches)}
    )


def matched_rigidly(reference: Volume, deformed: Volume, mask: BoolArray) -> tuple[PotentialMatches, RigidTransform]:
    """Return matched interest points of the object, and the rigid transform that most of them share.

    The transform is the identity where fewer than a dozen matches agree. Points are searched within an eighth of the object's extent.
    """
    extent = np.ptp(np.argwhere(mask), axis=0)[::-1] + 1
    half = np.array([4, 4, 2 if extent[2] > 4 else 0])
    reach = np.maximum(half, np.ceil(SEARCH_FRACTION * (extent * reference.spacing_mm).max() / reference.spacing_mm))
    reach = np.minimum(reach, extent // 2 + 1).astype(int)
    before = interest_points(reference, count=REFERENCE_POINTS, mask=mask).points_mm
    after = interest_points(deformed, count=DEFORMED_POINTS).points_mm
    found = relaxed(candidate_matches(reference, deformed, before, after, search=reach, match=half))
    return found, _shared_motion(found)


def _shared_motion(found: PotentialMatches) -> RigidTransform:
    """Return the least-squares rigid transform of the matches, without those beyond three times the median distance."""
    kept = np.ones(len(found), dtype=bool)
    for _ in range(REJECTIONS):
        if kept.sum() < FEWEST_MATCHES:
            return RigidTransform.identity()
        try:
            motion = rigid_from_points(found.reference_mm[kept], found.deformed_mm[kept]).transform
        except InputError:  # on one line
            return RigidTransform.identity()
        off = np.linalg.norm(motion.applied(found.reference_mm) - found.deformed_mm, axis=1)
        good = off <= OUTLIER * np.median(off[kept])
        if (good == kept).all():
            break
        kept = good
    return motion


def _still(reference: Volume) -> DisplacementField:
    return DisplacementField.on_grid(reference, np.zeros((*reference.shape, 3)))


def _flow(method: Method, a: Volume, b: Volume, mask: BoolArray) -> DisplacementField:
    flat = np.array(a.shape[::-1]) > 1
    half = np.where(flat, np.clip(np.round(0.5 * BLOCK_MM / a.spacing_mm), 1, 4), 0).astype(int)
    block, search = 2 * half + 1, np.where(flat, np.ceil(SEARCH_MM / a.spacing_mm), 0).astype(int)
    if method == "horn-schunck":
        return horn_schunck(a, b, mask=mask)
    if method == "lucas-kanade":
        return lucas_kanade(a, b, mask=mask)
    if method == "hybrid":
        intensities = np.percentile(a.values[mask], (0.5, 99.5))
        return hybrid_flow(a, b, block=block, search=search, least_range=float(np.ptp(intensities)) * LEAST_RANGE, mask=mask)
    measures: dict[str, Literal["sad", "ssd", "ncc"]] = {"sad-blocks": "sad", "ssd-blocks": "ssd", "ncc-blocks": "ncc"}
    return block_matching(a, b, block=block, search=search, measure=measures[method], mask=mask)


def _from_features(reference: Volume, matches: PotentialMatches, rigid: RigidTransform, mask: BoolArray) -> MeasuredDisplacement:
    if len(matches) < FEWEST_MATCHES:
        raise InputError(
            f"only {len(matches)} interest points match, and {FEWEST_MATCHES} are needed: the volumes have too little texture in common"
        )
    dense = dense_from_sparse(sparse_displacement(matches), reference, outside="affine")
    vectors = np.where(mask[..., None], dense.vectors, np.nan)
    facts: dict[str, float | int | str] = {"matches": len(matches), "iterations": len(matches.energies), "stop": matches.stop}
    return MeasuredDisplacement(
        "features",
        DisplacementField.on_grid(reference, vectors, valid=dense.valid & mask, quality=dense.quality),
        mask,
        displacement_gradient(vectors, reference),
        rigid=rigid,
        matches=matches,
        facts=facts,
    )


def _correlated(
    reference: Volume,
    deformed: Volume,
    inside: BoolArray,
    masks: tuple[BoolArray, ArrayLike | None],
    progress: Progress | None,
    *,
    given: bool,
) -> MeasuredDisplacement:
    found = correlate_volumes(reference, deformed, mask=masks[0], deformed_mask=masks[1], progress=progress)
    alone = None if given else without_plate(reference, deformed, inside, found, progress)
    if alone is None:
        return _by_parts(reference, deformed, inside, found, progress)
    measured = _by_parts(reference, deformed, *alone, progress)
    told = f"The object slides on a plate, {100.0 * (1.0 - alone[0].sum() / inside.sum()):.0f} % of the mask that was found, as a patient "
    told += "does on a couch: the plate is left out, and not answered. If it belongs to the object, give a `mask`."
    return replace(measured, warnings=(told, *measured.warnings))


def _by_parts(
    reference: Volume, deformed: Volume, inside: BoolArray, found: CorrelationResult, progress: Progress | None
) -> MeasuredDisplacement:
    parts = correlated_parts(reference, deformed, inside, found, progress=progress)
    if not parts:
        return measured_by(found, reference, inside, reuse=True)
    joined = _joined([measured_by(own, reference, part) for part, own in parts], inside)
    if joined.displacement.covariance is not None:
        for one, other in permutations(parts, 2):
            at, doubt = doubt_beside(one, other)
            joined.displacement.covariance[at] += doubt
    return joined


def _joined(measured: Sequence[MeasuredDisplacement], inside: BoolArray) -> MeasuredDisplacement:
    """Return the displacement of parts of an object that were measured by themselves; the rest of it is not answered."""
    first, *others = measured
    vectors, gradient = first.displacement.vectors.copy(), first.gradient.copy()
    covariance, strain_sd = first.displacement.covariance, first.strain_sd
    for other in others:
        here = other.mask
        vectors[here], gradient[here] = other.displacement.vectors[here], other.gradient[here]
        if covariance is not None and other.displacement.covariance is not None:
            covariance[here] = other.displacement.covariance[here]
        if strain_sd is not None and other.strain_sd is not None:
            strain_sd[here] = other.strain_sd[here]
    valid = np.logical_or.reduce([one.displacement.valid for one in measured])
    blocks = [one.blocks for one in measured if one.blocks is not None]
    each = [np.concatenate([getattr(b, name) for b in blocks]) for name in ("points", "vectors", "covariance")]
    told = [
        f"{len(measured)} part(s) of the object, which differ in intensity, have a field of their own: parts slide on each other. "
        "What slides within a part is not answered, nor are thin structures of one part within another."
    ]
    rest = float((inside & ~np.logical_or.reduce([one.mask for one in measured])).sum() / inside.sum())
    if rest > 0.0:
        told.append(
            f"The rest of the object, {100.0 * rest:.0f} % of its volume, could not be measured by itself and is not answered: one field "
            "of all is wrong on both sides of where parts slide. A `mask` of a part that moves as one measures it."
        )
    return replace(
        first,
        displacement=DisplacementField.on_grid(first.displacement.grid, vectors, covariance=covariance, valid=valid),
        mask=inside, gradient=gradient, strain_sd=strain_sd,
        facts=_worst_of([one.facts for one in measured]) | {"parts": len(measured)},
        warnings=tuple(dict.fromkeys([*told, *(doubt for one in measured for doubt in one.warnings)])),
        blocks=DisplacementField.from_arrays(each[0], each[1], covariance=each[2]),
    )  # fmt: skip


def _worst_of(facts: Sequence[dict[str, float | int | str]]) -> dict[str, float | int | str]:
    """Return diagnostics of measurements together: sums of numbers, the largest of sizes and fractions, and every kind of convergence."""
    joined: dict[str, float | int | str] = {}
    for name in facts[0]:
        each = [one[name] for one in facts]
        if name == "convergence":
            joined[name] = ", ".join(dict.fromkeys(map(str, each)))
        else:
            joined[name] = (sum if isinstance(each[0], int) else max)(each)  # type: ignore[arg-type]
    return joined


def measured_by(found: CorrelationResult, reference: Volume, inside: BoolArray, *, reuse: bool = False) -> MeasuredDisplacement:
    """Return the displacement that volume correlation found, with the facts of its measurement, at the voxels of the object.

    Parameters
    ----------
    found : CorrelationResult
        On the grid of the reference.
    reference : Volume
        That grid.
    inside : ndarray, shape (nz, ny, nx), bool
        Voxels of the object.
    reuse : bool
        Whether the vectors of `found` may be overwritten, which saves the memory of a copy.
    """
    return_freed_memory()  # what the search has freed: the fields take some hundred bytes a voxel
    unconverged, cells = int((~found.converged).sum()), int(np.isfinite(found.cell_covariance[..., 0, 0]).sum())
    facts: dict[str, float | int | str] = {
        "residual_sd": found.residual_sd,
        "cell_size_mm": float(found.grid.step_mm.mean()),
        "rigid_inclusions": int(found.inclusions.max()),
        "convergence": found.status,
        "unconverged_cells": unconverged,
        "unconverged_fraction": unconverged / cells,
    }
    valid = found.valid & inside
    outside = ~valid
    vectors = found.displacement.vectors if reuse else found.displacement.vectors.copy()
    gradient = found.gradient(np.float32)
    for values in (vectors, gradient):
        values[outside] = np.nan
    covariance = found.covariance()
    covariance[outside] = np.nan
    field = DisplacementField.on_grid(reference, vectors, covariance=covariance, valid=valid)
    blocks = None if found.blocks is None else _in_object(found, found.blocks, valid)
    doubts = (*_convergence_doubts(unconverged, cells), *_misplacement_doubts(found.misplaced_fraction))
    strain_sd = found.strain_sd()
    strain_sd[outside] = np.nan
    return MeasuredDisplacement("default", field, inside, gradient, facts=facts, warnings=doubts, blocks=blocks, strain_sd=strain_sd)


def _in_object(found: CorrelationResult, blocks: DisplacementField, valid: BoolArray) -> DisplacementField:
    """Return the blocks whose middle lies in a valid voxel, less certain where the splines are biased or structures stay apart."""
    z, y, x = np.clip(np.rint(found.volume.to_index(blocks.points)).astype(int)[:, ::-1], 0, np.array(valid.shape) - 1).T
    kept = valid[z, y, x]
    points, covariance = blocks.points[kept], blocks.covariance
    if covariance is not None:
        left = LEFT**2 * found.bias_at(points) + found.misplacement_at(points)
        covariance = covariance[kept] + np.nan_to_num(left)[:, None, None] * np.eye(3)
    return DisplacementField.from_arrays(points, blocks.vectors[kept], covariance=covariance)


def _convergence_doubts(unconverged: int, cells: int) -> tuple[str, ...]:
    if not unconverged:
        return ()
    return (
        f"{unconverged} of {cells} cells of the grid ({100.0 * unconverged / cells:.1f} %) have not converged: their displacement is less "
        "certain, "
        "which its standard deviation includes.",
    )


def _misplacement_doubts(fraction: float) -> tuple[str, ...]:
    if fraction < APART:
        return ()
    return (
        f"In {100.0 * fraction:.0f} % of the object structures stay more than a voxel apart after registration, as where parts slide on "
        "each other "
        "or tear: the displacement near them is less certain, which its standard deviation includes. A `mask` of one part measures it.",
    )
