"""Rigid inclusions in digital volume correlation: their motion by Gauss-Newton on intensities, and the test whether they are rigid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from naibu.core.arrays import Float32Array, FloatArray, Int32Array, IntArray
from naibu.core.progress import Progress, report_progress
from naibu.core.rigid_transform import RigidTransform
from naibu.imaging.volume_correlation._warp_kernels import OUTSIDE
from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.intensity_comparison import IntensityComparison

# empirical, voxels: sub-voxel jitter SD, less than the field's, for six unknowns do not fit noise; SD of the interpolation bias, which no
# number of voxels averages out; SD of the field about the rigid motion of an inclusion
JITTER, INTERPOLATED, FOLLOWS = 0.05, 0.02, 0.4
STEPS, CONVERGED_MM = 6, 1e-3  # Gauss-Newton steps, and the step at which they end, far below any accuracy of the images
# empirical: an inclusion is rigid if its mean bounded residual is at most so many times that of the field, which also fits noise
RIGID = 1.3
LEAST_VOXELS = 50  # too few for six unknowns and a test
# what noise and texture enclose by chance fills up to 8 cells, bones of legs 22 and more. In units of the least volume: below, a rigid
# motion has to fit better than the field, or the field stands, which fits as well. It does so by chance in one volume of so many
CHANCE, FALSE = 5.0, 0.01
CORRELATED = 8.0  # voxels that share a squared residual: (2 pi)^(3/2) sigma^3 after smoothing by 0.8 voxels
# empirical: parts do not belong to an inclusion whose bounded residual is so much larger, in residual variances, than that of the field, or
# whose displacement is so far from it, voxels; removed so many times
WORSE, APART, PRUNED = 0.15, 0.6, 2
OUTLIER = 9.0  # residual variances at which a residual counts half, and what a voxel outside the deformed volume counts
UNSEEN = 1e-30  # least value there: of an inclusion that has left the field of view no voxel counts, and it does not move
# least part of the normal matrix that is information, in any direction: an inclusion without texture is then very uncertain
LEAST_SHARE = 0.02
# empirical: root mean square error of the motion of bones along their axis over that which random residuals give: errors of gain, of offset
# and of voxels that hold two tissues are shared by many voxels
SYSTEMATIC = 2.0
REGULAR = 1e-9  # of the trace, on the diagonal of the normal matrix: an inclusion without texture does not move


@dataclass(frozen=True, slots=True, eq=False)
class InclusionMotion:
    """Rigid motion of an inclusion, mm along the axes of the volume from its first voxel.

    Attributes
    ----------
    number : int
        Label of the inclusion in `CorrelationResult.inclusions`.
    transform : RigidTransform
        Rotation about the centroid of the inclusion, and displacement of the centroid, mm.
    covariance : ndarray, shape (6, 6)
        Of a small further rotation about the displaced centroid, rad, and of the displacement of the centroid, mm.
    """

    number: int
    transform: RigidTransform
    covariance: FloatArray

    def displacement(self, points: FloatArray) -> FloatArray:
        """Return the displacement (n, 3), mm, of points (n, 3), mm, both along the axes of the volume."""
        return self.transform.displacement(points)

    def displacement_covariance(self, points: FloatArray) -> FloatArray:
        """Return the covariance (n, 3, 3), mm^2, of the displacement of points (n, 3), mm."""
        x, y, z = (self.transform.applied(points) - self.transform.position).T
        arms = np.zeros((len(points), 3, 6))
        arms[:, 0, 1], arms[:, 0, 2], arms[:, 1, 0] = z, -y, -z
        arms[:, 1, 2], arms[:, 2, 0], arms[:, 2, 1] = x, y, -x
        arms[:, [0, 1, 2], [3, 4, 5]] = 1.0
        return np.asarray(arms @ self.covariance @ np.swapaxes(arms, 1, 2))


class RigidInclusion:
    """Listed voxels that move as a rigid body, compared at a resolution of their own."""

    def __init__(self, number: int, voxels: IntArray, level: ImageLevel) -> None:
        self.number, self.voxels, self.level = number, voxels, level
        self.points = level.index[voxels].astype(float) * level.spacing
        self.centre = self.points.mean(axis=0) if len(voxels) else np.zeros(3)
        self.rotation, self.shift = np.eye(3), np.zeros(3)
        self.started = False
        self.draws: list[FloatArray] = []
        self.weight = float((FOLLOWS * level.spacing.mean()) ** -2)

    def start(self, displacement: Float32Array) -> None:
        """Start from the least-squares rigid motion of displacements (n, 3), mm, of its voxels :cite:p:`kabsch1976`."""
        after = self.points + displacement
        mean = after.mean(axis=0)
        u, _, vt = np.linalg.svd((self.points - self.centre).T @ (after - mean))
        self.rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        self.shift, self.started = mean - self.centre, True

    @property
    def motion(self) -> InclusionMotion:
        """Motion found, with the sample covariance of its perturbations."""
        draws = np.array(self.draws)
        covariance = draws.T @ draws / len(draws)
        covariance[3:, 3:] += (INTERPOLATED * self.level.spacing.mean()) ** 2 * np.eye(3)
        return InclusionMotion(self.number, RigidTransform(self.rotation, self.centre, self.centre + self.shift), covariance)

    @property
    def moved(self) -> FloatArray:
        """Displaced positions of its voxels (n, 3), mm."""
        return np.asarray((self.points - self.centre) @ self.rotation.T + self.centre + self.shift)

    def linearised(self, comparison: IntensityComparison) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residuals (n,), their derivatives (n, 6) with reversed sign, weights (n,), and information (6, 6) at the present motion.

        Derivatives are by a small further rotation about the displaced centroid, rad, and by the displacement of the centroid, mm. The
        intensity gradient is the mean of those of both volumes, which converges from further away. The information is that of the
        derivatives by the gradient of one volume with those by the other: noise, which is not the same in both, does not count.
        """
        level, at, x = self.level, self.voxels, self.moved
        gain, offset = comparison.gain[at], comparison.offset[at]
        value, gradient = np.empty(len(at), np.float32), np.empty((len(at), 3), np.float32)
        level.sample(x, value, gradient)
        seen = value > 0.9 * OUTSIDE
        r = np.where(seen, level.intensity[at] - gain * value - offset, 0.0)
        each = [gain[:, None] * gradient / level.spacing, level.gradient[at] @ self.rotation.T]
        arm = x - self.centre - self.shift
        own, other = (np.concatenate([np.cross(arm, g), g], axis=1) for g in each)
        derivatives = 0.5 * (own + other)
        precision = 1 / (comparison.residual_sd**2 + (JITTER * level.spacing.mean()) ** 2 * (derivatives[:, 3:] ** 2).sum(axis=1))
        w = np.where(seen, precision / (1 + r * r * precision / comparison.settings.robust**2) ** 2, 0.0)
        common = (own * w[:, None]).T @ other
        return r, derivatives, w, 0.5 * (common + common.T)

    def fit(self, comparison: IntensityComparison) -> None:
        """Find the motion from the intensities of its voxels by Gauss-Newton, with gain and offset of the whole object."""
        for _ in range(STEPS):
            r, self.derivatives, w, common = self.linearised(comparison)
            matrix = (self.derivatives * w[:, None]).T @ self.derivatives
            self.normal = matrix + max(REGULAR * np.trace(matrix), UNSEEN) * np.eye(6)
            d = np.linalg.solve(self.normal, self.derivatives.T @ (w * r))
            self.rotation, self.shift = Rotation.from_rotvec(d[:3]).as_matrix() @ self.rotation, self.shift + d[3:]
            if np.abs(d[3:]).max() < CONVERGED_MM:
                break
        self.root_weight = np.sqrt(w)
        root = np.linalg.cholesky(self.normal)
        inverse = np.linalg.inv(root)
        shares, axes = np.linalg.eigh(inverse @ common @ inverse.T)
        self.information = root @ (axes * np.clip(shares, LEAST_SHARE, 1.0)) @ axes.T @ root.T

    def misfits(self, comparison: IntensityComparison, positions: FloatArray) -> FloatArray:
        """Return the bounded squared residuals (n,), in residual variances, of its voxels displaced to positions (n, 3), mm."""
        value, gradient = np.empty(len(positions), np.float32), np.empty((len(positions), 3), np.float32)
        self.level.sample(positions, value, gradient)
        at = self.voxels
        residual = self.level.intensity[at] - comparison.gain[at] * value - comparison.offset[at]
        square = (residual / comparison.residual_sd).astype(float) ** 2
        return np.where(value > 0.9 * OUTSIDE, square / (1 + square / OUTLIER), OUTLIER)

    def pruned(self, comparison: IntensityComparison) -> RigidInclusion:
        """Return the largest part where a rigid motion of the whole fits the intensities as well as the field does."""
        if len(self.voxels) < LEAST_VOXELS:
            return self
        self.start(comparison.displacement[self.voxels])
        self.fit(comparison)
        worse = self.misfits(comparison, self.moved) - self.misfits(comparison, self.points + comparison.displacement[self.voxels])
        apart = np.linalg.norm(self.moved - self.points - comparison.displacement[self.voxels], axis=1) > APART * self.level.spacing.mean()
        shape = comparison.level.mask.shape
        x, y, z = (self.level.index[self.voxels].astype(int) - comparison.level.low[::-1]).T
        box, inside = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        box[z, y, x], inside[z, y, x] = worse, 1.0
        mean = (ndimage.gaussian_filter(v, 1.5, mode="constant")[z, y, x] for v in (box, inside))
        good = np.zeros(shape, dtype=bool)
        good[z, y, x] = (next(mean) < WORSE * next(mean)) & ~apart
        good = ndimage.binary_opening(np.pad(good, 2, mode="edge"), iterations=1)[2:-2, 2:-2, 2:-2] & good
        labels, n = ndimage.label(good)
        if n:
            good = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
        return RigidInclusion(self.number, self.voxels[good[z, y, x]], self.level)

    def follow(self, comparison: IntensityComparison) -> None:
        """Fit the motion, and replace the intensity data of its voxels by it in the normal equations."""
        if not self.started:
            self.start(comparison.displacement[self.voxels])
        self.fit(comparison)
        self.hold(comparison)

    def hold(self, comparison: IntensityComparison) -> None:
        """Replace the intensity data of its voxels by its present motion in the normal equations."""
        at = self.voxels
        comparison.products[at] = 0
        for k in (0, 3, 5):
            comparison.products[at, k] = self.weight
        comparison.force[at] = self.weight * (self.moved - self.points - comparison.displacement[at])

    def perturbed(self, random: Float32Array, rng: np.random.Generator) -> FloatArray:
        """Return the random forces (k, 3) on its voxels of the motion that random residuals (n,) of all voxels give."""
        d = SYSTEMATIC * np.linalg.solve(self.information, self.derivatives.T @ (self.root_weight * random[self.voxels]))
        self.draws.append(d)
        drawn = np.cross(d[:3], self.moved - self.centre - self.shift) + d[3:]
        white = rng.standard_normal((len(self.voxels), 3)) / np.sqrt(self.weight)
        return np.asarray(self.weight * (drawn + white))


def rigid_inclusions_among(
    comparison: IntensityComparison,
    labels: Int32Array,
    level: ImageLevel,
    *,
    given: bool,
    least_mm3: float,
    progress: Progress | None = None,
) -> list[RigidInclusion]:
    """Return the inclusions whose intensities a rigid motion matches as well as the field does.

    Parameters
    ----------
    comparison : IntensityComparison
        Fit of a field at full resolution.
    labels : ndarray, shape (nz, ny, nx), int32
        Candidates, labelled from 1.
    level : ImageLevel
        The same voxels, with the smoothing for inclusions.
    given : bool
        Whether the user named the inclusions: all are then taken as they are.
    least_mm3 : float
        Least volume of an inclusion that was not given, mm^3.
    progress : Progress, optional
        Called for every candidate.
    """
    box = tuple(slice(int(a), int(b)) for a, b in zip(comparison.level.low, comparison.level.high, strict=True))
    listed = labels[box][comparison.level.mask]
    out: list[RigidInclusion] = []
    count = int(labels.max())
    for number in range(1, count + 1):
        report_progress(progress, "rigid inclusions", done=number, total=count)
        inclusion = RigidInclusion(len(out) + 1, np.flatnonzero(listed == number), level)
        for _ in range(0 if given else PRUNED):
            inclusion = inclusion.pruned(comparison)
        size_mm3 = len(inclusion.voxels) * float(np.prod(level.spacing))
        if size_mm3 < (0.0 if given else least_mm3) or len(inclusion.voxels) < LEAST_VOXELS:
            continue
        displacement = comparison.displacement[inclusion.voxels]
        inclusion.start(displacement)
        inclusion.fit(comparison)
        free = inclusion.misfits(comparison, inclusion.points + displacement)
        rigid = inclusion.misfits(comparison, inclusion.moved)
        as_good = rigid.mean() < RIGID * free.mean() and np.count_nonzero(inclusion.root_weight) >= LEAST_VOXELS
        if given or (as_good and (size_mm3 > CHANCE * least_mm3 or fits_better(rigid - free, count))):
            out.append(inclusion)
    return out


def fits_better(excess: FloatArray, trials: int) -> bool:
    """Return whether the bounded squared residuals of a rigid motion fall below those of the field by more than chance.

    Parameters
    ----------
    excess : ndarray, shape (n,)
        Those of the rigid motion less those of the field.
    trials : int
        Candidates among which it is one, 1 or more.
    """
    error = float(excess.std()) * np.sqrt(CORRELATED / len(excess))
    return bool(excess.mean() < ndtri(FALSE / trials) * error)
