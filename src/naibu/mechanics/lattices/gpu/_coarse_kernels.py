"""Kernels of the coarse correction of the implicit solver of a lattice, for NVIDIA Warp; see `coarse_levels`.

Every node of a level gathers what it needs, in an order that is always the same, so that sums are.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def restrict_masses(
    first: wp.array[wp.int32],
    source: wp.array[wp.int32],
    weight: wp.array[wp.float32],
    diagonal: wp.array[wp.float64],
    z: wp.array[wp.vec3d],
    right: wp.array[wp.vec3d],
) -> None:
    """Set the right sides of the first level to the weighted residuals of masses, given as diagonal z."""
    k = wp.tid()
    s = wp.vec3d()
    for h in range(first[k], first[k + 1]):
        i = source[h]
        s += (wp.float64(weight[h]) * diagonal[i]) * z[i]
    right[k] = s


@wp.kernel
def combine(
    first: wp.array[wp.int32],
    source: wp.array[wp.int32],
    weight: wp.array[wp.float32],
    values: wp.array[wp.vec3d],
    scale: wp.array[wp.float64],
    own: wp.array[wp.vec3d],
    result: wp.array[wp.vec3d],
) -> None:
    """Set the result to the weighted values of another level, plus own ones times their scale if there is any."""
    k = wp.tid()
    s = wp.vec3d()
    if scale.shape[0] > 0:
        s = scale[k] * own[k]
    for h in range(first[k], first[k + 1]):
        s += wp.float64(weight[h]) * values[source[h]]
    result[k] = s


@wp.kernel
def spread(
    first: wp.array[wp.int32],
    source: wp.array[wp.int32],
    weight: wp.array[wp.float32],
    values: wp.array[wp.vec3d],
    smoothed: wp.array[wp.vec3d],
    z: wp.array[wp.vec3d],
) -> None:
    """Set z to what masses have from the smoother plus the weighted values of the first level."""
    i = wp.tid()
    s = smoothed[i]
    for h in range(first[i], first[i + 1]):
        s += wp.float64(weight[h]) * values[source[h]]
    z[i] = s


@wp.kernel
def times(inverse: wp.array2d[wp.mat33d], right: wp.array[wp.vec3d], result: wp.array[wp.vec3d]) -> None:
    """Set the result to a matrix times the right sides."""
    i = wp.tid()
    s = wp.vec3d()
    for k in range(right.shape[0]):
        s += inverse[i, k] * right[k]
    result[i] = s
