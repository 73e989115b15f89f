"""Candidate peaks of markers: local maxima, their contrast to the shell around them, and the noise level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.markers._blob_kernels import mark_peaks, shell_contrast

# Empirical values, judged by tests/imaging/markers/test_detection.py and benchmarks/sense_markers.py, unless said otherwise.
# SD of the Gaussian, and radius of the shell, in diameters; fraction of the shell that must lie below a peak: at a flat edge half of it
# does, and touching markers cover a few directions
SMOOTHING, SHELL, SHELL_FRACTION = 0.25, 1.0, 0.67
# the noise is that of the calmer blocks of so many voxels an edge, sampled at so many points an edge
CALM_BLOCK, CALM_SAMPLES = 6, 3
# of more peaks only those above the valley of contrast are fitted, which bounds the time
MANY = 100_000
# the population of peaks: bandwidth of the density of the logarithm of contrast; a valley is at most this fraction of the modes beside it,
# and divides populations whose medians differ by this ratio
BANDWIDTH, VALLEY, APART = 0.08, 0.5, 1.6
# of two peaks closer than this, in diameters, the weaker belongs to the stronger: a tilted washer shows one in each of two slices
ONE_PEAK = 0.62
POPULATION = 5  # fewer peaks have no statistics


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """Peaks of one polarity, all in the sign that makes markers bright."""

    sign: float
    index: IntArray  # z, y, x
    contrast: FloatArray
    level: FloatArray
    noise: float
    threshold: float
    strongest: float  # largest contrast, even below the threshold


def find_peaks(smooth: Float32Array, sign: float, allowed: BoolArray, spacing: FloatArray, diameter: float, min_contrast: float) -> Peaks:
    """Return the peaks whose contrast exceeds `min_contrast` times the noise, the strongest first."""
    v = smooth if sign > 0 else -smooth
    reach = shell_reach(diameter, spacing)
    noise = noise_level(v, allowed, reach)
    mark = np.zeros(v.shape, dtype=bool)
    mark_peaks(v, allowed, reach, 0.5 * min_contrast * noise, mark)
    index = np.argwhere(mark)
    contrast = np.empty(len(index))
    shell = np.unique(np.round(SHELL * diameter * directions() / spacing[::-1]).astype(np.int64), axis=0)
    shell_contrast(v, index, shell, SHELL_FRACTION, contrast)
    strongest = float(contrast.max()) if len(contrast) else 0.0
    order = np.argsort(-contrast, kind="stable")
    order = order[contrast[order] > min_contrast * noise]
    order = order[_strongest(index[order, ::-1] * spacing, ONE_PEAK * diameter)]
    index, contrast = index[order], contrast[order]
    level = v[tuple(index.T)].astype(float) - contrast
    threshold = valley(contrast) if len(contrast) > MANY else 0.0
    return Peaks(sign, index, contrast, level, noise, threshold, strongest)


def shell_reach(diameter: float, spacing: FloatArray) -> IntArray:
    """Return the radius of the shell (3,), voxels along z, y, x, about a marker of that diameter, mm."""
    return np.asarray(np.maximum(np.round(SHELL * diameter / spacing[::-1]), 1).astype(np.int64))


def _strongest(points: FloatArray, reach: float) -> BoolArray:
    """Tell which of points (n, 3), in decreasing order of strength, have no kept stronger one within reach."""
    keep = np.ones(len(points), dtype=bool)
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray") if len(points) else np.zeros((0, 2), dtype=np.int64)
    for strong, weak in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:  # the first of a pair is the stronger
        if keep[strong]:
            keep[weak] = False
    return keep


def noise_level(v: Float32Array, allowed: BoolArray, reach: IntArray) -> float:
    """Return the standard deviation of the noise: of differences to the mean of six voxels `reach` away, in the calmer of small blocks.

    Blocks with edges or markers vary more, and are left out; so is padding without noise.
    """
    tall = [n // CALM_BLOCK for n in v.shape]
    inner = [np.linspace(r, n - 1 - r, max(t, 1) * CALM_SAMPLES).round().astype(int) for r, n, t in zip(reach, v.shape, tall, strict=True)]
    inner = [np.clip(i, 0, n - 1) for i, n in zip(inner, v.shape, strict=True)]
    around = np.zeros([len(i) for i in inner])
    for axis in range(3):
        for side in (-1, 1):
            moved = [np.clip(i + side * reach[a], 0, v.shape[a] - 1) if a == axis else i for a, i in enumerate(inner)]
            around += v[np.ix_(*moved)] / 6.0
    away = v[np.ix_(*inner)] - around
    away[~allowed[np.ix_(*inner)]] = np.nan
    parts = [len(i) // CALM_SAMPLES for i in inner]
    blocks = (
        away.reshape(parts[0], CALM_SAMPLES, parts[1], CALM_SAMPLES, parts[2], CALM_SAMPLES)
        .transpose(0, 2, 4, 1, 3, 5)
        .reshape(-1, CALM_SAMPLES**3)
    )
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    spread = np.median(np.abs(blocks - np.median(blocks, axis=1, keepdims=True)), axis=1) * 1.4826 if len(blocks) else np.zeros(0)
    spread = spread[spread > 1e-6 * float(np.ptp(v))]
    calm = float(np.percentile(spread, 20.0)) if len(spread) else 0.0
    return max(calm / float(np.sqrt(7.0 / 6.0)), 1e-6 * float(np.ptp(v)), 1e-30)


def directions(n: int = 60) -> FloatArray:
    """Return unit vectors (n, 3), evenly spread and in opposite pairs (golden spiral)."""
    k = np.arange(n // 2)
    z, turn = 1.0 - (k + 0.5) / (n // 2), np.pi * (1.0 + np.sqrt(5.0)) * k
    half = np.stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z], axis=1)
    return np.concatenate([half, -half])


def valley(contrast: FloatArray) -> float:
    """Return the contrast in the valley below the strongest population; that of the weakest peak where there is no valley."""
    if len(contrast) < POPULATION:
        return float(contrast.min()) if len(contrast) else 0.0
    x = np.log(contrast)
    width = BANDWIDTH * max(1.0, (60.0 / len(x)) ** 0.25)
    grid = np.arange(x.min() - 3.0 * width, x.max() + 3.0 * width, 0.2 * width)
    counts = np.histogram(x, bins=grid)[0].astype(float)
    density = np.convolve(counts, np.exp(-0.5 * (np.arange(-20, 21) * 0.2) ** 2))[20:-20]
    middle = 0.5 * (grid[1:] + grid[:-1])
    mode = int(np.argmax(density * np.exp(2.0 * middle)))  # few strong ones outweigh many weak ones
    lower = np.maximum.accumulate(density)  # the highest mode so far below
    deep = np.flatnonzero(density[:mode] < VALLEY * np.minimum(density[mode], lower[:mode]))
    if len(deep) == 0:
        return float(contrast.min())
    threshold = float(middle[deep[np.argmin(density[deep])]])
    below, above = x[x < threshold], x[x >= threshold]
    apart = len(below) > 0 and np.median(above) - np.median(below) > np.log(APART)
    return float(np.exp(threshold)) if apart else float(contrast.min())
