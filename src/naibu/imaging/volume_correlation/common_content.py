"""Test of a volume correlation against chance: whether both volumes show the same content, cell by cell.

Any search finds some displacement, also between volumes that have nothing in common. Two things tell it from the true one, neither of
which needs the noise to be known: the image intensity gradients of both volumes agree, and the residual has no structure of an image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray
from naibu.core.errors import InputError
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit

# correlation of the image intensity gradients of the registered volumes, below which nothing was matched: two volumes of noise or of
# unrelated textures reach 0.00 to 0.01, the same leg under 25 times its noise 0.16
LEAST_AGREEMENT = 0.05
# the same in a window of a few cells, without the surface: by chance up to 0.25, in the leg under three times its
# noise 0.44 or more; below, a cell has no texture, or not the same in both volumes
MATCHED, LEAST_MATCHED = 0.3, 0.8
# where the residual has the structure of an image, noise does not explain that gradients agree little: a strain too large to be followed
# leaves 0.28 to 0.5, good fits of legs, chests and small balls 0.7 or more
MATCHED_IF_STRUCTURED, MUCH_STRUCTURE = 0.6, 0.25
# autocorrelation of the residual at a distance of two voxels: -0.05 to 0.1 where it is the noise of an image that was smoothed by half a
# voxel, 0.3 where both volumes show different things
STRUCTURED = 0.15
LAG = 2
# empirical: autocovariance of the residual, without robust weights, LAG voxels apart: in that of the reference, and in residual variances,
# above which a cell shows in one volume what is not in the other. A counterpart leaves 0.3 and 0.25 at most, none 1 (the texture of one
# volume) or 2 (of both) and more. Noise has none, however much of it there is. Beside such a cell, into which what it shows may reach, less
# is enough
UNLIKE, LEAST_UNLIKE = 0.6, 0.25
BESIDE, LEAST_BESIDE = 0.15, 0.15
NARROW = 0.5  # cells: SD of the window in which they are compared, as narrow as so few voxels allow: what appears may be thin
WINDOWS = (1.0, 2.0, 4.0)  # cells: SDs of the windows in which a cell is judged, the first that holds enough of the inside
SURFACE = 1.5  # cells: depth below which a voxel may show the contrast of the surface
LEAST_VOXELS = 40  # of the inside of the object in a window; thinner objects are judged by their surface, too

MOST_MOVING = 0.33  # fraction of the cells that have not converged, above which nothing was found: 0.7 in legs of two persons
LEAST_OVERLAP = 0.05  # fraction of the object in the deformed volume after its motion, below which the volumes do not overlap


@dataclass(frozen=True, slots=True, eq=False)
class CommonContent:
    """What the cells of a fit have in common in both volumes.

    Attributes
    ----------
    agreement : ndarray, shape (m,)
        Regression of the image intensity gradients of one volume on those of the other: 1 for identical volumes, 0 by chance. The surface
        is left out: it says how the object is bounded, and not how what is inside has moved.
    structure : ndarray, shape (m,)
        Autocorrelation of the residual two voxels apart.
    unlike : ndarray, shape (m,), bool
        Cells that show in one volume what is not in the other: see `unlike_cells`.
    """

    agreement: FloatArray
    structure: FloatArray
    unlike: BoolArray

    @property
    def matched(self) -> BoolArray:
        """Cells (m,) with a texture that both volumes share; the displacement of others would be an extrapolation."""
        return np.asarray(self.agreement > np.where(self.structure > MUCH_STRUCTURE, MATCHED_IF_STRUCTURED, MATCHED))

    def refuse_chance(self, inner: BoolArray, least: float = LEAST_MATCHED) -> None:
        """Refuse volumes that agree in less than a share `least` of the given cells (m,), and differ elsewhere by more than noise.

        Raises
        ------
        InputError
            Such volumes.
        """
        share, other = float(self.matched[inner].mean()), inner & ~self.matched
        if share < least and float(np.median(self.structure[other])) > STRUCTURED:
            raise InputError(
                f"the volumes match in {100.0 * share:.0f} % of the object only, and what is left elsewhere after registration has the "
                "structure of "
                f"an image (autocorrelation {np.median(self.structure[other]):.2f} at {LAG} voxels; that of noise is below "
                f"{STRUCTURED:g}): "
                "check that both show the same object; where it has no texture only markers can be followed (naibu.imaging.detect_markers)"
            )


def refuse_unrelated(fit: CorrelationFit) -> None:
    """Refuse volumes whose gradients do not agree anywhere, such as noise.

    Raises
    ------
    InputError
        Such volumes.
    """
    agreement = fit.gradient_correlation
    if agreement < LEAST_AGREEMENT:
        raise InputError(
            f"the volumes show no common content: after registration their intensity gradients correlate by {agreement:.2f} (1 for "
            "identical volumes, 0 by chance); check that both show the same object, at the same positions of the grid"
        )


def common_content(fit: CorrelationFit, depth_mm: Float32Array) -> CommonContent:
    """Return what the cells of a fit have in common.

    Parameters
    ----------
    fit : CorrelationFit
        After `compare`.
    depth_mm : ndarray, shape (n,)
        Distance of the listed voxels from the surface of the object, mm.
    """
    return content_of(fit, content_sums(fit, depth_mm))


def content_sums(fit: CorrelationFit, depth_mm: Float32Array) -> FloatArray:
    """Return sums (m, 13) over the voxels of every cell, from which `content_of` follows."""
    inside = depth_mm > SURFACE * float(fit.system.grid.step_mm.mean())
    common, own = (fit.agreement[:, axes].sum(axis=1) for axes in ([0, 3, 5], [6, 9, 11]))
    # steep edges show an outline, also that of another object: they count by the jitter of the settings, however well they fit
    voxel, precision = np.float32(fit.level.spacing.mean()), np.float32(fit.residual_sd**-2) * own / np.maximum(fit.weight, 1e-30)
    sds = (np.float32(sd) * voxel for sd in (fit.jitter_voxels, fit.settings.jitter_sd_voxels))
    observed, stated = (1 + sd**2 * precision for sd in sds)
    lower = observed / stated
    every = common * lower, own * lower, np.ones_like(lower)
    residual = fit.residual * np.sqrt(fit.weight * lower)
    # one by one: as large as the voxels' list, all of them together would be the most memory that is needed at a time
    alike = _lagged(fit, residual, residual), residual**2
    columns = chain(every, (v * inside for v in every), alike, _lagged_intensities(fit))
    return np.stack([fit.cell_sums(v) for v in columns], axis=1)


def content_of(fit: CorrelationFit, cells: FloatArray) -> CommonContent:
    """Return what cells have in common from the sums (m, 13) of `content_sums`."""
    sums = cells[:, :3], cells[:, 3:6]
    judged = fit.windowed(sums[0], WINDOWS[0])
    for width in WINDOWS[::-1]:
        deep = fit.windowed(sums[1], width) * (2.0 * np.sqrt(np.pi) * width) ** 3
        judged = np.where(deep[:, 2:] > LEAST_VOXELS, deep, judged)
    product, square = (fit.windowed(v, WINDOWS[0]) for v in cells[:, 6:8].T)
    agreement, structure = judged[:, 0] / np.maximum(judged[:, 1], 1e-30), product / np.maximum(square, 1e-30)
    return CommonContent(agreement, structure, unlike_cells(fit, cells[:, 8:]))


def unlike_cells(fit: CorrelationFit, lagged: FloatArray) -> BoolArray:
    """Return the cells (m,) that show in one volume what is not in the other, such as a bubble, a needle, or tissue that was cut away.

    `lagged` (m, 5) are sums of products, `LAG` voxels apart: of residuals, of intensities, of either of these alone, and of ones.

    Notes
    -----
    Voxels of such a cell count little, as all large residuals do, so that gradients agree as they do next to them. But the residual of what
    has no counterpart is as large as what is shown: the normalised sum of squared differences :cite:p:`pan2010` is that of unrelated
    images. Products at a distance are taken in place of squares, in which noise would have to be known.
    """
    left, shown, first, second, pairs = (fit.windowed(v, NARROW) for v in lagged.T)
    some = np.maximum(pairs, 1e-30)
    left, shown = left / some, shown / some - first * second / some**2
    dense = np.zeros(tuple(int(n) for n in fit.system.grid.cells[::-1]), dtype=bool)
    at = tuple(fit.system.cells[:, 2:].T)
    dense[at] = (left > LEAST_UNLIKE) & (left > UNLIKE * shown)
    near = ndimage.binary_dilation(dense, np.ones((3, 3, 3), dtype=bool))[at]
    return np.asarray(dense[at] | (near & (left > LEAST_BESIDE) & (left > BESIDE * shown)))


def _lagged_intensities(fit: CorrelationFit) -> Iterator[Float32Array]:
    """Give mean products (n,) with the voxels LAG further: of residuals, intensities, their first and second factor, and of ones."""
    seen = fit.seen.astype(np.float32)
    # about their mean, which does not matter but for rounding
    intensity = seen * (fit.level.intensity - fit.level.intensity.mean()) / np.float32(fit.residual_sd)
    residual = seen * fit.residual / np.float32(fit.residual_sd)
    for pair in ((residual, residual), (intensity, intensity), (intensity, seen), (seen, intensity), (seen, seen)):
        yield _lagged(fit, *pair)


def _lagged(fit: CorrelationFit, values: Float32Array, others: Float32Array) -> Float32Array:
    """Return the mean products (n,) of values and others of the voxels LAG further along the axes of the finest voxels."""
    spacing = fit.level.spacing
    axes = [2 - a for a in range(3) if spacing[a] < 1.5 * spacing.min() and fit.level.mask.shape[2 - a] > LAG]
    first, second, total = (np.zeros(fit.level.mask.shape, np.float32) for _ in range(3))
    first[fit.level.mask], second[fit.level.mask] = values, others
    for axis in axes:
        here, there = (tuple(s if a == axis else slice(None) for a in range(3)) for s in (slice(None, -LAG), slice(LAG, None)))
        total[here] += first[here] * second[there] / len(axes)
    return np.asarray(total[fit.level.mask])


def require_overlap(seen: float) -> None:
    """Refuse an object of which only a small fraction is seen in the deformed volume.

    Raises
    ------
    InputError
        Such an object.
    """
    if seen < LEAST_OVERLAP:
        raise InputError(
            f"only {100.0 * seen:.1f} % of the object lies in the deformed volume after its motion: the volumes do not overlap, or do not "
            "show the "
            "same object"
        )


def require_convergence(moving: float) -> None:
    """Refuse a field of which so many cells still moved in the last step that nothing was found.

    Raises
    ------
    InputError
        Such a field.
    """
    if moving > MOST_MOVING:
        raise InputError(
            f"no displacement fits the volumes: {100.0 * moving:.0f} % of the object had not converged after the last step; check that "
            "both show the "
            "same object, and give masks of it if there is much else in them"
        )
