"""A hand-like surface as a scanner would give it: smooth, noisy, and open at the wrist."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter

from naibu.core.arrays import BoolArray, FloatArray, IntArray

BLEND_MM = 2.5  # width over which bones are joined
NOISE_LENGTH = 1.5  # grid steps over which the noise of a scanner is alike
# joints from the wrist to the tip (x, y, z) and radius there, mm
FINGERS = (
    ((-12, 0, 0, 17), (-27, 36, 2, 14), (-50, 60, 6, 10), (-66, 80, 8, 8)),  # thumb
    ((-8, 0, 0, 18), (-24, 80, 0, 12), (-36, 122, 0, 8), (-41, 150, -2, 7)),
    ((-2, 0, 0, 18), (-4, 84, 2, 12), (-6, 130, 2, 8), (-7, 160, 0, 7)),
    ((4, 0, 0, 18), (15, 80, 1, 12), (23, 124, 1, 8), (27, 151, -1, 7)),
    ((10, 0, 0, 17), (31, 72, -2, 11), (46, 104, -3, 7), (54, 126, -5, 6)),
    ((0, 0, 0, 20), (0, -40, 0, 21)),  # forearm
)


def hand_surface(spacing_mm: float = 3.0, noise_mm: float = 0.15, seed: int = 0) -> tuple[FloatArray, IntArray]:
    """Return points (n, 3), mm, and triangles (t, 3) of a hand with its palm in the x-y plane and its fingers along y, open at the wrist.

    Parameters
    ----------
    spacing_mm : float
        About the length of the edges.
    noise_mm : float
        Standard deviation of the noise along the normals.
    seed : int
        Of the noise.
    """
    low, high = np.array([-84.0, -32.0, -32.0]), np.array([72.0, 176.0, 32.0])
    axes = [np.arange(a, b + spacing_mm, spacing_mm) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = np.zeros(grid.shape[:3])
    for joints in FINGERS:
        for a, b in pairwise(np.array(joints, dtype=np.float64)):
            inside += np.exp(-_capsule(grid, a, b) / BLEND_MM)
    distance = -BLEND_MM * np.log(inside)
    rough = gaussian_filter(np.random.default_rng(seed).normal(size=distance.shape), NOISE_LENGTH)
    distance += noise_mm * rough / rough.std()
    return level_surface(distance, low, spacing_mm)


def _capsule(grid: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance from a capsule between two spheres (x, y, z, radius), mm."""
    along = b[:3] - a[:3]
    share = np.clip(((grid - a[:3]) @ along) / (along @ along), 0.0, 1.0)
    apart = np.linalg.norm(grid - a[:3] - share[..., None] * along, axis=-1)
    return np.asarray(apart - (a[3] + share * (b[3] - a[3])))


def level_surface(values: FloatArray, origin: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """Return points and triangles of the surface on which values on a grid are zero, open where it leaves the grid.

    Each cell that the surface crosses has a point at the mean of the crossings of its edges; four of them around each crossed edge of the
    grid make two triangles :cite:p:`gibson1998`. Values are negative inside.
    """
    below = values < 0.0
    number = np.full([n - 1 for n in values.shape], -1, dtype=np.int64)
    total, count = np.zeros((*number.shape, 3)), np.zeros(number.shape)
    crossed = [_crossings(values, below, axis) for axis in range(3)]
    for axis, (at, place) in enumerate(crossed):
        for cells, valid in _cells_around(at, axis, number.shape):
            np.add.at(total, tuple(cells[valid].T), place[valid])
            np.add.at(count, tuple(cells[valid].T), 1.0)
    used = count > 0.0
    number[used] = np.arange(used.sum())
    points = origin + spacing * total[used] / count[used][:, None]
    triangles = []
    for axis, (at, _) in enumerate(crossed):
        around = list(_cells_around(at, axis, number.shape))
        whole = np.all([valid for _, valid in around], axis=0)
        quads = np.stack([number[tuple(cells[whole].T)] for cells, _ in around], axis=1)
        turned = below[tuple(at[whole].T)]  # the inside lies before the edge: its direction points outwards
        quads[~turned] = quads[~turned][:, ::-1]
        triangles += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return np.asarray(points), np.concatenate(triangles)


def _crossings(values: FloatArray, below: BoolArray, axis: int) -> tuple[IntArray, FloatArray]:
    """Lower ends (k, 3) of the edges of the grid along an axis that are crossed, and where, in steps of the grid."""
    first, second = np.moveaxis(values, axis, 0)[:-1], np.moveaxis(values, axis, 0)[1:]
    change = np.moveaxis(below, axis, 0)[:-1] != np.moveaxis(below, axis, 0)[1:]
    at = np.argwhere(np.moveaxis(change, 0, axis))
    share = first[change] / (first[change] - second[change])
    order = np.argwhere(change)
    back = [k + 1 if k < axis else k for k in range(3)]  # axes of the grid in `order`
    back[axis] = 0
    place = order[:, back].astype(np.float64)
    place[:, axis] += share
    rank = np.lexsort(order[:, back].T[::-1])
    return at, place[rank]


def _cells_around(at: IntArray, axis: int, shape: tuple[int, ...]) -> list[tuple[IntArray, BoolArray]]:
    """Return the four cells (k, 3) around edges of the grid, counterclockwise about the axis, and whether they exist."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    out = []
    for dj, dk in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
        cells = at.copy()
        cells[:, j] += dj
        cells[:, k] += dk
        valid: BoolArray = np.all((cells >= 0) & (cells < np.array(shape)), axis=1)
        out.append((cells, valid))
    return out
