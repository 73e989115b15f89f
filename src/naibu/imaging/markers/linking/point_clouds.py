"""Two point clouds whose links are sought: neighbours, spacings, a grid of the deformed points, and predictions from links found so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray
from naibu.imaging.markers.linking._point_matching_kernels import fill_grid, propose, propose_few

# Empirical values, judged by tests/imaging/markers/test_point_matching.py and benchmarks/particle_gels.py.
# points up to which a wave of growth is too small for threads
FEW = 600
# neighbours that are used, in two and three dimensions
NEIGHBOURS = {2: 12, 3: 20}
# a spacing, the unit of all distances, in mean distances of nearest neighbours
SPACING = 1.15


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Reference points with their neighbours, deformed points in a grid, and the spacings of both."""

    reference: FloatArray
    neighbours: IntArray
    reference_scale: FloatArray
    deformed: FloatArray
    deformed_scale: FloatArray
    grid: tuple[FloatArray, float, IntArray, IntArray, IntArray]  # origin, width, dims, starts, members
    growth: float  # spacing of the deformed points by that of the reference points

    @property
    def dimensions(self) -> int:
        """Two or three."""
        return int(self.reference.shape[1])


@dataclass(slots=True, eq=False)
class State:
    """Links while they grow: deformed point of every reference point and the reverse (-1: none), residuals, local gradients."""

    link: IntArray
    owner: IntArray
    residual: FloatArray
    gradients: FloatArray

    @property
    def count(self) -> int:
        """Number of links."""
        return int((self.link >= 0).sum())


def prepared(reference: FloatArray, deformed: FloatArray) -> Cloud:
    """Return two clouds with neighbours, spacings and the grid."""
    d = reference.shape[1]
    k = min(NEIGHBOURS[d], len(reference) - 1)
    tree = cKDTree(reference)
    neighbours = np.ascontiguousarray(np.asarray(tree.query(reference, k=k + 1, workers=-1)[1])[:, 1:], dtype=np.int64)
    reference_scale, deformed_scale = local_spacing(reference), local_spacing(deformed)
    growth = float(np.mean(deformed_scale) / np.mean(reference_scale))
    return Cloud(reference, neighbours, reference_scale, deformed, deformed_scale, grid_of(deformed, deformed_scale), growth)


def grid_of(points: FloatArray, scale: FloatArray) -> tuple[FloatArray, float, IntArray, IntArray, IntArray]:
    """Return origin, width, numbers of cells, starts and members of a grid of points (m, d) whose spacing is `scale` (m,)."""
    width = 0.6 * float(np.mean(scale))
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    width = max(width, float((np.maximum(extent, width).prod() / (4.0 * len(points) + 64.0)) ** (1.0 / points.shape[1])))
    dims = (extent / width).astype(np.int64) + 1
    starts, members = np.zeros(int(dims.prod()) + 2, dtype=np.int64), np.empty(len(points), dtype=np.int64)
    fill_grid(points, low, width, dims, starts, members)
    return low, width, dims, starts, members


def local_spacing(points: FloatArray) -> FloatArray:
    """Return the typical distance of neighbours around every point (n,), mm."""
    distance, index = cKDTree(points).query(points, k=min(9, len(points)), workers=-1)
    nearest = np.asarray(distance)[:, 1]
    local = SPACING * nearest[index].mean(axis=1)
    return np.asarray(np.maximum(local, 0.2 * SPACING * nearest.mean() + 1e-12))


def proposed(
    cloud: Cloud, state: State, active: IntArray, reach: FloatArray, *, robust: bool
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Return predictions, proposals, distances and local gradients of active reference points."""
    d, count = cloud.dimensions, len(active)
    predicted, proposal, distance = np.empty((count, d)), np.empty(count, dtype=np.int64), np.empty(count)
    fitted = np.zeros((count, d, d))
    (propose if count > FEW else propose_few)(
        cloud.reference, cloud.neighbours, cloud.deformed, *cloud.grid, cloud.reference_scale, active, state.link, state.gradients, reach,
        NEIGHBOURS[d], robust, predicted, proposal, distance, fitted,
    )  # fmt: skip
    return predicted, proposal, distance, fitted
