"""Stiff bodies in soft matter, bones above all: where they may be, how they move, and whether they are rigid (spec S2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.volume_correlation._warp_kernels import OUTSIDE, sample_spline

if TYPE_CHECKING:
    from naibu.imaging.volume_correlation.gauss_newton import Correlation
    from naibu.imaging.volume_correlation.image_level import ImageLevel

# grey values that part dark rims from the rest, between that of air and of the object
DARK = (0.5, 0.6, 0.7)
CLOSING = (0.0, 0.3, 0.5)  # radii by which rims are closed, of the size
VOTES = 3
LARGEST = 25.0  # area that a rim encloses at most, squares of the size
PLACE = 0.05  # voxels: see Comparison.place; a rigid body has too few unknowns to follow noise
STEPS, CLOSE_MM = 6, 1e-3
# voxels: bias of interpolation, which no number of voxels averages out
INTERPOLATED = 0.02
# of a voxel: how closely the field must follow a rigid body
FOLLOWS = 0.4
# a rigid motion may fit so much worse than a field, which also follows noise
RIGID = 1.3
LEAST_VOXELS = 50
# parts that fit so much worse, squares of the scatter, or are so far from the field, voxels, do not belong to a body
WORSE, APART, PRUNED = 0.15, 0.6, 2


def enclosed_bodies(volume: Volume, mask: BoolArray, size_mm: float) -> Int32Array:
    """Return numbered bodies with dark rims, such as bones in magnetic resonance: candidates for stiff bodies.

    Parameters
    ----------
    volume : Volume
        The scan.
    mask : ndarray, shape (nz, ny, nx), bool
        The object.
    size_mm : float
        Length that tells bodies from streaks: they are thicker than half of it, deeper than that in the object, and hold three cubes of it.

    Returns
    -------
    ndarray, shape (nz, ny, nx), int32
        Number of the body of every voxel from 1, 0 where there is none.
    """
    spacing = volume.spacing_mm[::-1]
    smooth = ndimage.gaussian_filter(np.asarray(volume.values, dtype=np.float32), 0.5)
    out = np.zeros(volume.shape, np.int32)
    if mask.all():
        return out
    air = float(np.median(smooth[~mask]))
    body = float(np.median(smooth[mask]))
    where = np.argwhere(mask)
    box = tuple(slice(int(a), int(b)) for a, b in zip(where.min(axis=0), where.max(axis=0) + 1, strict=True))
    smooth, inside = smooth[box], mask[box]
    # bodies run out of the scan at the faces of the box that the object touches
    rim = [(int(w.start > 0), int(w.stop < n)) for w, n in zip(box, volume.shape, strict=True)]
    cut = tuple(slice(a, a + n) for (a, _), n in zip(rim, inside.shape, strict=True))
    depth = ndimage.distance_transform_edt(np.pad(inside, rim), sampling=spacing)[cut]
    deep = depth > 0.47 * size_mm
    # rims are thin and broken here and there: what some of several ways to close them encloses counts
    votes = np.zeros(inside.shape, np.int8)
    for level in DARK:
        dark = (smooth < air + level * (body - air)) & deep
        for radius in CLOSING:
            votes += _filled(_closed(dark, spacing, radius * size_mm) if radius else dark, spacing, LARGEST * size_mm**2)
    filled = votes >= VOTES
    bodies = _opened(filled, spacing, 0.31 * size_mm) & filled
    labels, n = ndimage.label(bodies)
    big = np.bincount(labels.ravel(), minlength=n + 1) * np.prod(spacing) > 3.0 * size_mm**3
    big[0] = False
    number = np.cumsum(big) * big
    out[box] = number[labels]
    return out


def _closed(found: BoolArray, spacing: FloatArray, radius: float) -> BoolArray:
    pad = [int(radius // s) + 1 for s in spacing]
    wide = np.pad(found, [(p, p) for p in pad], mode="edge")
    if not wide.any():
        return found
    grown = ndimage.distance_transform_edt(~wide, sampling=spacing) <= radius
    shrunk = ndimage.distance_transform_edt(grown, sampling=spacing) > radius
    return np.asarray(shrunk[tuple(slice(p, -p) for p in pad)])


def _filled(found: BoolArray, spacing: FloatArray, largest: float) -> BoolArray:
    """Return a body with the holes filled that are no larger than an area, mm^2, in slices across any axis."""
    out = found.copy()
    for axis in range(3):
        area = float(np.prod(np.delete(spacing, axis)))
        for page, solid in zip(np.moveaxis(out, axis, 0), np.moveaxis(found, axis, 0), strict=True):
            if not solid.any():
                continue
            holes, n = ndimage.label(ndimage.binary_fill_holes(solid) & ~solid)
            if n:
                small = np.bincount(holes.ravel()) * area <= largest
                small[0] = False
                page |= small[holes]
    return out


def _opened(found: BoolArray, spacing: FloatArray, radius: float) -> BoolArray:
    pad = [int(radius // s) + 1 for s in spacing]
    wide = np.pad(found, [(p, p) for p in pad], mode="edge")
    core = ndimage.distance_transform_edt(wide, sampling=spacing) > radius
    if not core.any():
        return np.zeros_like(found)
    grown = ndimage.distance_transform_edt(~core, sampling=spacing) <= radius
    return np.asarray(grown[tuple(slice(p, -p) for p in pad)])


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion:
    """Rigid motion of a body, mm along the axes of the volume from its first voxel.

    Attributes
    ----------
    number : int
        Number of the body in the result's `bodies`.
    transform : RigidTransform
        The motion about the body's middle, mm.
    covariance : ndarray, shape (6, 6)
        Of a small further rotation about the moved middle, rad, and of the shift, mm.
    """

    number: int
    transform: RigidTransform
    covariance: FloatArray

    def displacement(self, points: FloatArray) -> FloatArray:
        """Return the displacement (n, 3), mm, of points (n, 3), mm, both along the axes of the volume."""
        return self.transform.displacement(points)

    def displacement_covariance(self, points: FloatArray) -> FloatArray:
        """Return its covariance (n, 3, 3), mm^2."""
        x, y, z = (self.transform.applied(points) - self.transform.position).T
        arms = np.zeros((len(points), 3, 6))
        arms[:, 0, 1], arms[:, 0, 2], arms[:, 1, 0] = z, -y, -z
        arms[:, 1, 2], arms[:, 2, 0], arms[:, 2, 1] = x, y, -x
        arms[:, [0, 1, 2], [3, 4, 5]] = 1.0
        return np.asarray(arms @ self.covariance @ np.swapaxes(arms, 1, 2))


class StiffBody:
    """Listed voxels of a body that moves rigidly, compared at a resolution of its own."""

    def __init__(self, number: int, voxels: IntArray, level: ImageLevel) -> None:
        self.number, self.voxels, self.level = number, voxels, level
        self.points = level.index[voxels].astype(float) * level.spacing
        self.middle = self.points.mean(axis=0) if len(voxels) else np.zeros(3)
        self.rotation, self.shift = np.eye(3), np.zeros(3)
        self.started = False
        self.draws: list[FloatArray] = []
        self.weight = float((FOLLOWS * level.spacing.mean()) ** -2)

    def start(self, move: Float32Array) -> None:
        """Take the rigid motion nearest to displacements (n, 3), mm, of its voxels."""
        after = self.points + move
        mean = after.mean(axis=0)
        u, _, vt = np.linalg.svd((self.points - self.middle).T @ (after - mean))
        self.rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        self.shift, self.started = mean - self.middle, True

    @property
    def motion(self) -> BodyMotion:
        """The motion found, with the covariance of the draws so far."""
        draws = np.array(self.draws)
        covariance = draws.T @ draws / len(draws)
        covariance[3:, 3:] += (INTERPOLATED * self.level.spacing.mean()) ** 2 * np.eye(3)
        return BodyMotion(self.number, RigidTransform(self.rotation, self.middle, self.middle + self.shift), covariance)

    @property
    def moved(self) -> FloatArray:
        """Where its voxels are after the motion (n, 3), mm."""
        return np.asarray((self.points - self.middle) @ self.rotation.T + self.middle + self.shift)

    def fitted(self, fit: Correlation) -> None:
        """Find the motion from the grey values of its voxels, with the gain of the whole."""
        level, at = self.level, self.voxels
        gain, offset = fit.gain[at], fit.offset[at]
        value, slope = np.empty(len(at), np.float32), np.empty((len(at), 3), np.float32)
        for _ in range(STEPS):
            x = self.moved
            sample_spline(level.deformed, (x / level.spacing).astype(np.float32), value, slope)
            seen = value > 0.9 * OUTSIDE
            r = np.where(seen, level.grey[at] - gain * value - offset, 0.0)
            g = 0.5 * (gain[:, None] * slope / level.spacing + level.slope[at] @ self.rotation.T)
            precision = 1 / (fit.scatter**2 + (PLACE * level.spacing.mean()) ** 2 * (g**2).sum(axis=1))
            w = np.where(seen, precision / (1 + r * r * precision / fit.how.robust**2) ** 2, 0.0)
            self.arms = np.concatenate([np.cross(x - self.middle - self.shift, g), g], axis=1)
            matrix = (self.arms * w[:, None]).T @ self.arms
            self.normal = matrix + 1e-9 * np.trace(matrix) * np.eye(6)
            d = np.linalg.solve(self.normal, self.arms.T @ (w * r))
            self.rotation, self.shift = Rotation.from_rotvec(d[:3]).as_matrix() @ self.rotation, self.shift + d[3:]
            if np.abs(d[3:]).max() < CLOSE_MM:
                break
        self.root_weight = np.sqrt(w)

    def misfits(self, fit: Correlation, places: FloatArray) -> FloatArray:
        """Return the bounded squared residuals (n,) of its voxels at places (n, 3), mm, in units of the scatter; 9 outside the scan."""
        value, slope = np.empty(len(places), np.float32), np.empty((len(places), 3), np.float32)
        sample_spline(self.level.deformed, (places / self.level.spacing).astype(np.float32), value, slope)
        at = self.voxels
        square = ((self.level.grey[at] - fit.gain[at] * value - fit.offset[at]) / fit.scatter).astype(float) ** 2
        return np.where(value > 0.9 * OUTSIDE, square / (1 + square / 9.0), 9.0)

    def pruned(self, fit: Correlation) -> StiffBody:
        """Return the largest part of the body where a rigid motion of the whole fits as well as the field does."""
        if len(self.voxels) < LEAST_VOXELS:
            return self
        self.start(fit.move[self.voxels])
        self.fitted(fit)
        worse = self.misfits(fit, self.moved) - self.misfits(fit, self.points + fit.move[self.voxels])
        apart = np.linalg.norm(self.moved - self.points - fit.move[self.voxels], axis=1) > APART * self.level.spacing.mean()
        shape = fit.level.mask.shape
        x, y, z = (self.level.index[self.voxels].astype(int) - fit.level.low[::-1]).T
        box, inside = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        box[z, y, x], inside[z, y, x] = worse, 1.0
        mean = (ndimage.gaussian_filter(v, 1.5, mode="constant")[z, y, x] for v in (box, inside))
        good = np.zeros(shape, dtype=bool)
        good[z, y, x] = (next(mean) < WORSE * next(mean)) & ~apart
        good = ndimage.binary_opening(np.pad(good, 2, mode="edge"), iterations=1)[2:-2, 2:-2, 2:-2] & good
        labels, n = ndimage.label(good)
        if n:
            good = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
        return StiffBody(self.number, self.voxels[good[z, y, x]], self.level)

    def follow(self, fit: Correlation) -> None:
        """Replace the data of its voxels by the body's motion."""
        if not self.started:
            self.start(fit.move[self.voxels])
        self.fitted(fit)
        at = self.voxels
        fit.products[at] = 0
        for k in (0, 3, 5):
            fit.products[at, k] = self.weight
        fit.force[at] = self.weight * (self.moved - self.points - fit.move[at])

    def waver(self, fit: Correlation, force: Float32Array, random: Float32Array, rng: np.random.Generator) -> None:
        """Replace random forces (voxels, 3) of its voxels by those of the motion that random residuals (voxels,) give."""
        at = self.voxels
        d = np.linalg.solve(self.normal, self.arms.T @ (self.root_weight * random[at]))
        self.draws.append(d)
        drawn = np.cross(d[:3], self.moved - self.middle - self.shift) + d[3:]
        white = rng.standard_normal((len(at), 3)) / np.sqrt(self.weight)
        force[at] = self.weight * (drawn + white)


def rigid_among(
    fit: Correlation, labels: Int32Array, level: ImageLevel, *, asked: bool, least_mm3: float, say: Callable[[str], None]
) -> list[StiffBody]:
    """Return the bodies that a rigid motion brings into agreement as well as the field does, or all where the user asked for them.

    Parameters
    ----------
    fit : Correlation
        A fit of a field to full resolution.
    labels : ndarray, shape (nz, ny, nx), int32
        Candidates, numbered from 1.
    level : ImageLevel
        The same voxels, as bodies are to be compared.
    asked : bool
        Whether to take all.
    least_mm3 : float
        Volume of a body at least.
    say : callable
        Told what was found.
    """
    box = tuple(slice(int(a), int(b)) for a, b in zip(fit.level.low, fit.level.high, strict=True))
    listed = labels[box][fit.level.mask]
    out: list[StiffBody] = []
    for number in range(1, int(labels.max()) + 1):
        body = StiffBody(len(out) + 1, np.flatnonzero(listed == number), level)
        for _ in range(0 if asked else PRUNED):
            body = body.pruned(fit)
        if len(body.voxels) * float(np.prod(level.spacing)) < (0.0 if asked else least_mm3) or len(body.voxels) < LEAST_VOXELS:
            continue
        body.start(fit.move[body.voxels])
        body.fitted(fit)
        voxels = body.voxels
        free = float(body.misfits(fit, body.points + fit.move[voxels]).mean())
        rigid = float(body.misfits(fit, body.moved).mean())
        taken = asked or rigid < RIGID * free
        size = len(voxels) * float(np.prod(level.spacing))
        say(f"a body of {size:.0f} mm^3: misfit {rigid:.3g} if rigid, {free:.3g} if not: {'rigid' if taken else 'not rigid'}")
        if taken:
            out.append(body)
    return out
