"""Rigid registration: of corresponding points in closed form :cite:p:`horn1987`, or of intensities in a mask.

Intensities are registered by mutual information :cite:p:`mattes2003` with SimpleITK :cite:p:`lowekamp2013`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError, NaibuWarning
from naibu.core.optional_packages import optional_package
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import covered, positions, require_mask, resampled_to_grid

NARROW = 1e-6  # of the largest extent of the points: below it, to rounding, they lie on one line and leave the rotation about it open
HISTOGRAM_BINS = 32  # of the joint histogram of mutual information
FEWEST_VOXELS = 20  # of a part of a mask whose own motion is estimated; empirical
# residuals of neighbouring voxels are correlated: eight count as one; motions within two standard deviations count as none
CORRELATED, SIGNIFICANT = 8.0, 2.0


class NotRigidWarning(NaibuWarning):
    """The points or the mask of a rigid registration did not move rigidly."""


@dataclass(frozen=True, slots=True, eq=False)
class RigidRegistration:
    """Rigid transform found by registration, with residuals.

    Attributes
    ----------
    transform : RigidTransform
        ``x' = R x + t``.
    residuals_mm : ndarray, shape (n,)
        Distance of each transformed point, or of each part of the mask, from its measured position, mm.
    """

    transform: RigidTransform
    residuals_mm: FloatArray

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals, mm."""
        return float(np.sqrt(np.mean(self.residuals_mm**2)))


def total_displacement(displacement: ArrayLike, transform: RigidTransform, grid: Volume) -> FloatArray:
    """Return the displacement where a rigid transform follows a displacement: ``R (x + v) + t - x``.

    Parameters
    ----------
    displacement : array_like, shape (nz, ny, nx, 3)
        Displacement v, mm, measured against the deformed volume resampled through `transform`
        (`naibu.imaging.resampled_to_grid` with ``through=transform.applied``).
    transform : RigidTransform
        ``R x + t``.
    grid : Volume
        Voxels of the displacement.

    Returns
    -------
    ndarray, shape (nz, ny, nx, 3)
        Total displacement, mm.
    """
    points = positions(grid)
    return np.asarray(transform.applied(points + np.asarray(displacement, dtype=float)) - points)


def rigid_displacement(transform: RigidTransform, grid: Volume) -> FloatArray:
    """Return the displacement (nz, ny, nx, 3), mm, of all voxels of a grid by a rigid transform."""
    return transform.displacement(positions(grid))


def rigid_from_points(reference: ArrayLike, deformed: ArrayLike, *, rigid_within_mm: float | None = None) -> RigidRegistration:
    """Return the least-squares rigid registration of corresponding points, in closed form :cite:p:`horn1987`.

    Parameters
    ----------
    reference, deformed : array_like, shape (n, d)
        Positions of the same points in the reference and the deformed configuration, mm, d = 2 or 3; n of at least 3.
    rigid_within_mm : float, optional
        Warn where the root mean square of the residuals exceeds this, mm: the points do not belong to one rigid body.

    Returns
    -------
    RigidRegistration
        With the residual of every point.

    Raises
    ------
    InputError
        Fewer than three points, points that coincide or, in space, lie on one line, or shapes that do not fit.

    Warns
    -----
    NotRigidWarning
        The residual exceeds `rigid_within_mm`.

    Notes
    -----
    In space the rotation is the unit quaternion of the largest eigenvalue of Horn's 4 x 4 matrix, in a plane the angle of equation 3.36 in
    :cite:t:`hirai2008`. ``t = mean(x') - R mean(x)``; equation 8 there has the opposite sign.
    """
    x, y = np.asarray(reference, dtype=float), np.asarray(deformed, dtype=float)
    if x.ndim != 2 or x.shape != y.shape or x.shape[1] not in (2, 3):
        raise InputError(f"reference and deformed must have one shape (n, 2) or (n, 3), not {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("reference and deformed must be finite; leave out points that were not found")
    if len(x) < 3:
        raise InputError(f"reference and deformed must hold three points or more, not {len(x)}")
    middle_x, middle_y = x.mean(axis=0), y.mean(axis=0)
    for points, name in ((x - middle_x, "reference"), (y - middle_y, "deformed")):
        _require_spread(points, name)
    m = (x - middle_x).T @ (y - middle_y)
    rotation = _rotation_from_quaternion(_best_quaternion(m)) if x.shape[1] == 3 else _plane_rotation(m)
    translation = middle_y - rotation @ middle_x
    residuals = np.linalg.norm(x @ rotation.T + translation - y, axis=1)
    motion = RigidRegistration(RigidTransform.of(rotation, translation), residuals)
    _warn_unless_rigid(motion, rigid_within_mm, "point")
    return motion


def _require_spread(centred: FloatArray, name: str) -> None:
    extents = np.linalg.svd(centred, compute_uv=False)
    if not extents[0] > 0.0:
        raise InputError(f"all points of {name} coincide: choose points that are apart")
    if centred.shape[1] == 3 and extents[1] < NARROW * extents[0]:
        raise InputError(f"all points of {name} lie on one line, which leaves the rotation about it open: add a point off the line")


def _best_quaternion(m: FloatArray) -> FloatArray:
    """Return the unit quaternion (q0, qx, qy, qz) of Horn's matrix B of ``M = sum x y^T``."""
    a = m - m.T
    delta = np.array([a[1, 2], a[2, 0], a[0, 1]])
    b = np.empty((4, 4))
    b[0, 0], b[0, 1:], b[1:, 0] = np.trace(m), delta, delta
    b[1:, 1:] = m + m.T - np.trace(m) * np.eye(3)
    return np.asarray(np.linalg.eigh(b)[1][:, -1])


def _rotation_from_quaternion(q: FloatArray) -> FloatArray:
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (y * x + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (z * x - w * y), 2 * (z * y + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def _plane_rotation(m: FloatArray) -> FloatArray:
    angle = np.arctan2(m[0, 1] - m[1, 0], m[0, 0] + m[1, 1])
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _warn_unless_rigid(motion: RigidRegistration, within_mm: float | None, what: str) -> None:
    if within_mm is not None and motion.rms_mm > within_mm:
        worst = int(np.argmax(motion.residuals_mm))
        warnings.warn(
            f"the motion is not rigid: the residual is {motion.rms_mm:.3f} mm (root mean square), above {within_mm:g} mm, and largest "
            f"at {what} {worst} with {motion.residuals_mm[worst]:.3f} mm; check the correspondence or the mask",
            NotRigidWarning,
            stacklevel=3,
        )


def register_rigid(
    reference: Volume,
    deformed: Volume,
    mask: ArrayLike,
    *,
    start: RigidTransform | None = None,
    levels: int = 3,
    widening_mm: float = 6.0,
    sampling: float = 0.5,
    seed: int = 1,
    rigid_within_mm: float | None = None,
) -> RigidRegistration:
    """Return the rigid registration of the intensities in a mask, by mutual information with SimpleITK.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes before and after the deformation; their grids may differ.
    mask : array_like, shape (nz, ny, nx)
        Voxels of the reference that move rigidly, as from `naibu.imaging.bone_mask`; it should reach a little over the bone, whose edge has
        most of the contrast.
    start : RigidTransform, optional
        Initial transform; by default the translation between the intensity-weighted centroids.
    levels : int
        Number of grids, each twice as coarse as the next, from coarse to fine.
    widening_mm : float
        On coarse grids the mask is dilated by ``widening_mm (2^level - 1)``, mm, 0 or more: the surroundings of a bone have contrast that
        is visible from further away.
    sampling : float
        Fraction of the voxels of the mask in the metric, above 0 up to 1.
    seed : int
        Seed of that sample.
    rigid_within_mm : float, optional
        Warn where parts of the mask move by more than this relative to the transform, mm (root mean square); by default half the largest
        spacing.

    Returns
    -------
    RigidRegistration
        Its residuals are the remaining motions of eight parts of the mask.

    Raises
    ------
    InputError
        An empty mask, or volumes that do not overlap.
    MissingDependencyError
        SimpleITK is not installed.

    Warns
    -----
    NotRigidWarning
        The bone is not rigid, or the registration failed.
    """
    sitk = optional_package("SimpleITK", "rigid registration of intensities", "naibu[imaging]")
    inside = require_mask(mask, reference)
    fixed, moving = (_image(sitk, v.with_values(np.asarray(v.values, dtype=np.float32))) for v in (reference, deformed))
    transform = _start(sitk, fixed, moving, reference, inside, start)
    away = ndimage.distance_transform_edt(~inside, sampling=reference.spacing_mm[::-1])
    for level in range(levels)[::-1]:
        # far from the solution the metric of a bone alone is flat: begin with its surroundings
        near = away <= widening_mm * (2**level - 1)
        method = _method(sitk, level, float(reference.spacing_mm.min()), sampling, seed)
        method.SetMetricFixedMask(_image(sitk, reference.with_values(near.astype(np.uint8))))
        method.SetInitialTransform(transform, inPlace=True)
        try:
            method.Execute(fixed, moving)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise InputError(f"rigid registration failed ({reason}); do the volumes overlap? give start or a larger mask") from error
    motion = _motion(transform)
    found = RigidRegistration(motion, remaining_motion(reference, deformed, inside, motion))
    _warn_unless_rigid(found, float(reference.spacing_mm.max()) / 2 if rigid_within_mm is None else rigid_within_mm, "part")
    return found


def _method(sitk: Any, level: int, spacing_mm: float, sampling: float, seed: int) -> Any:
    """Return the registration on a grid coarser by ``2^level``."""
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(HISTOGRAM_BINS)
    method.SetMetricSamplingStrategy(method.RANDOM if sampling < 1.0 else method.NONE)
    method.SetMetricSamplingPercentage(min(sampling, 1.0), seed)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=1.0, minStep=1e-4, numberOfIterations=200, gradientMagnitudeTolerance=1e-8, relaxationFactor=0.6
    )
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([2**level])
    method.SetSmoothingSigmasPerLevel([0.5 * (2**level - 1) * spacing_mm])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
    return method


def remaining_motion(reference: Volume, deformed: Volume, mask: ArrayLike, motion: RigidTransform, parts: int = 8) -> FloatArray:
    """Return the motion (parts,), mm, of parts of a mask relative to a rigid transform, by least squares on the intensities of each.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes before and after the deformation.
    mask : array_like, shape (nz, ny, nx)
        Voxels of the reference that should move rigidly.
    motion : RigidTransform
        Rigid transform of the whole mask.
    parts : int
        Number of parts, a power of two; the mask is halved along its longest extent.
    """
    inside = require_mask(mask, reference)
    back = resampled_to_grid(deformed, reference, through=motion.applied)
    inside = inside & covered(deformed, reference, through=motion.applied)
    active = [a for a in range(3) if reference.shape[2 - a] > 1]
    intensity = np.asarray(reference.values, dtype=float)
    gradient = np.stack([np.gradient(0.5 * (intensity + back.values), reference.spacing_mm[a], axis=2 - a)[inside] for a in active], axis=1)
    # gradients are not known at the edge of the deformed volume
    known = np.isfinite(gradient).all(axis=1)
    inside[inside], gradient = known, gradient[known]
    change = (back.values - intensity)[inside]
    left = []
    for part in _halved(positions(reference)[inside], np.arange(len(change)), parts):
        # a gain and an offset between the volumes are no motion
        columns = np.column_stack([gradient[part], np.ones(len(part)), intensity[inside][part]])
        left.append(_significant_length(columns, -change[part], len(active)) if len(part) > FEWEST_VOXELS else 0.0)
    return np.array(left)


def _significant_length(columns: FloatArray, right: FloatArray, d: int) -> float:
    """Return the length of the first d unknowns of a least-squares problem along the directions in which they exceed their noise."""
    normal = np.linalg.pinv(columns.T @ columns, rcond=1e-10)
    solution = normal @ (columns.T @ right)
    variance = CORRELATED * float(np.mean((columns @ solution - right) ** 2))
    spread, directions = np.linalg.eigh(normal[:d, :d])
    along = directions.T @ solution[:d]
    return float(np.linalg.norm(along[np.abs(along) > SIGNIFICANT * np.sqrt(variance * np.maximum(spread, 0.0))]))


def _halved(points: FloatArray, which: IntArray, parts: int) -> list[IntArray]:
    if parts <= 1 or len(which) < FEWEST_VOXELS:
        return [which]
    centred = points[which] - points[which].mean(axis=0)
    along = centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1]
    order = which[np.argsort(along, kind="stable")]
    half = len(order) // 2
    return _halved(points, order[:half], parts // 2) + _halved(points, order[half:], parts // 2)


def _image(sitk: Any, volume: Volume) -> Any:
    image = sitk.GetImageFromArray(volume.values)
    image.SetSpacing(volume.spacing_mm.tolist())
    image.SetOrigin(volume.origin_mm.tolist())
    image.SetDirection(volume.direction.ravel().tolist())
    return image


def _start(sitk: Any, fixed: Any, moving: Any, reference: Volume, mask: BoolArray, start: RigidTransform | None) -> Any:
    """Return the initial transform, which rotates about the centroid of the mask."""
    transform = sitk.VersorRigid3DTransform()
    centre = positions(reference)[mask].mean(axis=0)
    if start is None:
        # SimpleITK cannot centre on a mask: only the translation of its guess is used
        guess = sitk.CenteredTransformInitializer(
            fixed, moving, sitk.VersorRigid3DTransform(), sitk.CenteredTransformInitializerFilter.MOMENTS
        )
        start = _motion(sitk.VersorRigid3DTransform(guess))
    transform.SetCenter(centre.tolist())
    transform.SetMatrix(start.rotation.ravel().tolist(), 1e-6)
    transform.SetTranslation(start.displacement(centre).tolist())
    return transform


def _motion(transform: Any) -> RigidTransform:
    rotation = np.array(transform.GetMatrix()).reshape(3, 3)
    centre = np.array(transform.GetCenter())
    return RigidTransform.of(rotation, np.array(transform.GetTranslation()) + centre - rotation @ centre)
