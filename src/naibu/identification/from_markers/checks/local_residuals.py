"""Where neighbouring markers are off together by more than noise explains.

An inclusion, a void or a crack that the model lacks shows like this, while residuals over a whole state can hide it. Means over each
marker and its nearest ones are a local statistic of spatial association :cite:p:`anselin1995`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.neighbours import neighbours

FEWEST = 21  # markers, three times a neighbourhood, of which the most tell what scatter is usual
MEDIAN_OF_NOISE = 0.6745  # of the absolute values of standard normal deviates


@dataclass(frozen=True, slots=True, eq=False)
class LocalResidual:
    """The neighbourhood whose markers are off together most clearly.

    Attributes
    ----------
    point : ndarray, shape (3,)
        Mean position of its markers, mm.
    axis : int
        Along which they are off: 0, 1 or 2.
    mean_mm : float
        By how much on average, mm, signed.
    times_noise : float
        The same over the standard deviation of such a mean where residuals are independent.
    """

    point: FloatArray
    axis: int
    mean_mm: float
    times_noise: float


def largest_local_residual(points: FloatArray, residual: FloatArray, sd: FloatArray, count: int) -> LocalResidual | None:
    """Return the neighbourhood whose mean residual is largest in units of its noise.

    Parameters
    ----------
    points, residual, sd : ndarray, shape (k, 3)
        Markers, their residuals and the standard deviations of these from noise, mm, all finite. Where the usual (median) residual is
        larger than `sd` says, noise is taken to be so much larger.
    count : int
        Neighbours of a marker that are averaged with it.

    Returns
    -------
    LocalResidual or None
        None for fewer than 21 markers.
    """
    if len(points) < FEWEST:
        return None
    nearby = np.column_stack([np.arange(len(points)), neighbours(points, count)[1]])
    usual = max(float(np.median(np.abs(residual / sd))) / MEDIAN_OF_NOISE, 1.0)
    means = residual[nearby].mean(axis=1)
    times = np.abs(means) / (usual * np.sqrt((sd[nearby] ** 2).sum(axis=1)) / nearby.shape[1])
    marker, axis = np.unravel_index(int(np.argmax(times)), times.shape)
    return LocalResidual(points[nearby[marker]].mean(axis=0), int(axis), float(means[marker, axis]), float(times[marker, axis]))
