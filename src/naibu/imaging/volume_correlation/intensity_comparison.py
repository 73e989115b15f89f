"""Intensity residuals of digital volume correlation: warping, gain and offset, robust weights."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array
from naibu.imaging.volume_correlation._warp_kernels import OUTSIDE, weighted_residuals
from naibu.imaging.volume_correlation.image_level import GainMap, ImageLevel

# errors of a field extend over an edge, whose voxels therefore tell less than their residuals, taken for independent, would
JITTER = 2.5  # empirical, of the observed sub-voxel jitter
MAD = 1.4826  # standard deviation of a normal distribution, in median absolute deviations
# quantiles of the gradient between classes of voxels, of which there are enough, and fewest voxels
CLASSES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
ENOUGH, LEAST_SEEN = 200_000, 1200
LEAST_CURVATURE = 0.3  # empirical, on textured balls: robust weights of large residuals curve the other way
ROUNDING = 1e-6  # least residual SD, of the intensity range: identical volumes would divide by zero


@dataclass(frozen=True, slots=True)
class ComparisonSettings:
    """How the intensities of two volumes are compared on one resolution level.

    Attributes
    ----------
    robust : float
        Residual, in residual standard deviations, at which the weight of a voxel has fallen to a quarter; inf for least squares.
    jitter_sd_voxels : float
        Standard deviation of the sub-voxel jitter, voxels.
    reference_fraction : float
        Fraction of the image intensity gradient that is taken from the reference; the rest from the deformed volume.
    gain_cell_mm : float
        Cell size of the lattice of local gain, mm; 0 for one gain.
    far : bool
        Whether the volumes are far from registered: the residual SD is then that of all residuals, those at edges included.
    """

    robust: float
    jitter_sd_voxels: float
    reference_fraction: float
    gain_cell_mm: float
    far: bool = False


class IntensityComparison:
    """Residuals of the listed voxels of a level, and their contributions to the normal equations.

    Attributes
    ----------
    value, residual, weight : ndarray, shape (n,), float32
        Intensity of the deformed volume at the displaced voxels, residual, and its weight (inverse variance times robust weight).
    reference_gradient, gradient : ndarray, shape (n, 3), float32
        Image intensity gradient of the reference, pushed forward, and the one that is used, per mm.
    displacement, force : ndarray, shape (n, 3), float32
        Displacement, mm, and weight times residual times gradient.
    products : ndarray, shape (n, 6), float32
        Weight times products xx, xy, xz, yy, yz, zz of the gradient.
    gain, offset : ndarray, shape (n,), float32
        Which map intensities of the deformed volume to those of the reference.
    residual_sd : float
        Standard deviation of the residual, robust once the volumes are nearly registered.
    jitter_voxels : float
        Sub-voxel jitter SD, voxels: that of the settings, or a smaller one that the residuals tell.
    local_gain : ndarray, shape (2 k,)
        Gain and offset at the points of their lattice, where they are local.
    """

    def __init__(self, level: ImageLevel, settings: ComparisonSettings) -> None:
        self.level, self.settings = level, settings
        n = len(level.intensity)
        self.value, self.residual, self.weight = (np.zeros(n, np.float32) for _ in range(3))
        self.reference_gradient, self.gradient, self.displacement, self.force = (np.zeros((n, 3), np.float32) for _ in range(4))
        self.products, self.agreement = np.zeros((n, 6), np.float32), np.zeros((n, 12), np.float32)
        self.gain, self.offset = np.ones(n, np.float32), np.zeros(n, np.float32)
        self.robust_weight, self.residual_sd = np.ones(n, np.float32), 0.0
        self.jitter_voxels, self.local_gain = settings.jitter_sd_voxels, np.zeros(0)

    @property
    def seen(self) -> BoolArray:
        """Which displaced voxels lie in the deformed volume (n,)."""
        return np.asarray(self.value > 0.9 * OUTSIDE)

    def match(self) -> None:
        """Match gain and offset of the volumes at the present displacement."""
        seen, gain = self.seen, GainMap(self.level, self.settings.gain_cell_mm or 1.0)
        if self.residual_sd == 0.0:
            self.gain[:], self.offset[:], _ = gain.everywhere(self.value, self.robust_weight)
            self._update_residual_sd(seen)
        if self.settings.gain_cell_mm:
            self.local_gain = gain.local(self.value, self.robust_weight, self.residual_sd**2)
            self.gain, self.offset = gain.values(self.local_gain)
        self._update_residual_sd(seen)

    def weigh(self) -> None:
        """Weight the residuals at the present displacement, gain and offset."""
        s = self.settings
        scalars = np.array(
            [self.residual_sd**-2, (self.jitter_voxels * self.level.spacing.mean()) ** 2, s.robust**-2, s.reference_fraction]
        )
        weighted_residuals(
            self.level.intensity, self.value, self.gain, self.offset, self.reference_gradient, self.gradient, scalars.astype(np.float32),
            self.products, self.force, self.weight, self.residual, self.agreement,
        )  # fmt: skip

    @property
    def robust_sums(self) -> tuple[float, float]:
        """Sums of the weights, and of the derivatives of weight times residual: robust forces rise less than residuals do."""
        w = self.weight.astype(float)
        # with q = sqrt(w / w at r = 0): the derivative of r q^2 is q^2 (4 q - 3)
        q = 1 / (1 + (self.residual.astype(float) / (self.settings.robust * self.residual_sd)) ** 2)
        return float(w.sum()), float((w * (4 * q - 3)).sum())

    @property
    def curvature_share(self) -> Float32Array:
        """Derivatives (n,) of weight times residual, over the weight, `LEAST_CURVATURE` or more: what Newton's method has of a weight."""
        # with q = sqrt(w / w at r = 0): the derivative of r q^2 is q^2 (4 q - 3)
        q = 1 / (1 + (self.residual / np.float32(self.settings.robust * self.residual_sd)) ** 2)
        return np.asarray(np.maximum(4 * q - 3, np.float32(LEAST_CURVATURE)), dtype=np.float32)

    def bounded_jitter(self, observed_voxels: float) -> float:
        """Return the sub-voxel jitter to weigh by, voxels, given the observed one: never more than the settings say."""
        return min(self.settings.jitter_sd_voxels, JITTER * observed_voxels)

    @property
    def observed_jitter_voxels(self) -> float:
        """Sub-voxel jitter SD, voxels: how residuals grow with the intensity gradient, by regression of their variance on its square."""
        some = slice(None, None, max(1, len(self.value) // ENOUGH))
        seen = self.seen[some]
        steep, residual = (self.gradient[some][seen].astype(float) ** 2).sum(axis=1), np.abs(self.residual[some][seen])
        if len(steep) < LEAST_SEEN:
            return self.settings.jitter_sd_voxels / JITTER
        order = np.argsort(steep, kind="stable")
        parts = [order[int(a * len(order)) : int(b * len(order))] for a, b in pairwise(CLASSES)]
        variance = np.array([max(MAD * float(np.median(residual[part])), ROUNDING) ** 2 for part in parts])
        root = np.sqrt([len(part) for part in parts])
        terms = np.stack([np.ones(len(parts)), [steep[part].mean() for part in parts]], axis=1) * (root / variance)[:, None]
        jitter = float(np.linalg.lstsq(terms, root, rcond=None)[0][1])
        return float(np.sqrt(max(jitter, 0.0)) / self.level.spacing.mean())

    @property
    def gradient_correlation(self) -> float:
        """Correlation of the image intensity gradients of both volumes over all voxels that are seen."""
        both = self.agreement.sum(axis=0, dtype=np.float64)  # zero where nothing is seen
        return float(both[[0, 3, 5]].sum() / max(float(both[[6, 9, 11]].sum()), 1e-30))

    def anchor(self, first: Float32Array, fraction: float) -> None:
        """Add springs to displacements `first` (n, 3), mm, of a fraction of the mean stiffness that the intensities give."""
        seen = self.seen
        if not seen.any():  # nothing pulls
            return
        diagonal = self.products[:, [0, 3, 5]]
        strength = np.float32(fraction * diagonal[seen].sum(axis=1).mean() / 3)
        for k in (0, 3, 5):
            self.products[:, k] += strength
        self.force -= strength * (self.displacement - first)

    def _update_residual_sd(self, seen: BoolArray) -> None:
        r = self.differences(seen)
        rest = r[seen] if seen.any() else self.level.intensity
        spread = float(np.sqrt(np.mean(rest**2))) if self.settings.far else MAD * float(np.median(np.abs(rest)))
        self.residual_sd = max(spread, ROUNDING * float(np.ptp(self.level.intensity)))
        self.weigh_robustly(r, seen)

    def differences(self, seen: BoolArray) -> AnyFloatArray:
        """Return the residuals (n,) at the present gain and offset, 0 where nothing is seen."""
        return np.where(seen, self.level.intensity - self.gain * self.value - self.offset, 0)

    def weigh_robustly(self, r: AnyFloatArray, seen: BoolArray) -> None:
        """Renew the robust weights of residuals r (n,)."""
        self.robust_weight = np.where(seen, 1 / (1 + (r / (self.settings.robust * self.residual_sd)) ** 2) ** 2, 0).astype(np.float32)
