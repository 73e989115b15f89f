"""Interest points: the Harris operator in two and three dimensions, on voxels of any shape (spec S3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray, Float32Array, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.feature_matching._harris_kernels import peaks, respond, thin_out
from naibu.imaging.preprocessing._filter_kernels import products
from naibu.imaging.preprocessing.filters import gradient, smoothed
from naibu.imaging.preprocessing.resampling import require_mask

Response = Literal["ratio", "harris"]


@dataclass(frozen=True, slots=True, eq=False)
class InterestPoints:
    """Points of a volume about which the grey values change in every direction, strongest first.

    Attributes
    ----------
    points_mm : ndarray, shape (n, 3)
        Centres of their voxels, mm.
    indices : ndarray, shape (n, 3), int64
        Indices of their voxels along x, y, z.
    responses : ndarray, shape (n,)
        Response of the operator.
    """

    points_mm: FloatArray
    indices: IntArray
    responses: FloatArray

    def __len__(self) -> int:
        return len(self.points_mm)


def harris_response(
    volume: Volume,
    *,
    response: Response = "ratio",
    k: float = 0.05,
    gradient_sigma_mm: float | None = None,
    window_sigma_mm: float | None = None,
) -> Float32Array:
    """Return the response (nz, ny, nx) of the Harris operator (spec S3, equation 1.13).

    Parameters
    ----------
    volume : Volume
        Voxels; a volume of one slice is an image, whose operator is the one in two dimensions.
    response : {"ratio", "harris"}
        ``det M / tr M``, free of a constant, or ``det M - k tr(M)^2``.
    k : float
        Constant of the second, 0.04 to 0.06.
    gradient_sigma_mm : float, optional
        Standard deviation of the Gaussian that smooths before derivatives are taken, mm; by default 0.7 of the smallest spacing.
    window_sigma_mm : float, optional
        Standard deviation of the Gaussian window of M, mm; by default the smallest spacing.

    Raises
    ------
    InputError
        A constant volume, or a constant that is negative.

    Notes
    -----
    ``M = G * (grad I grad I^T)``, derivatives in grey per mm, so that the response is the same however fine the voxels are. In space
    ``det M`` and ``tr(M)^2`` do not grow alike with contrast, so that the meaning of k depends on the unit of grey: ``"ratio"`` is free
    of that.

    References
    ----------
    C. Harris, M. Stephens: A combined corner and edge detector. Alvey Vision Conference (1988) 147-151.
    """
    if response not in ("ratio", "harris") or k < 0.0:
        raise InputError(f"response must be 'ratio' or 'harris' with k >= 0, not {response!r} with {k}")
    inner, outer = default_sigmas(volume.spacing_mm, volume.shape, gradient_sigma_mm, window_sigma_mm)
    grey = known_grey(volume.values, float(np.mean(volume.values, dtype=float)))
    if not float(grey.max()) > float(grey.min()):
        raise InputError("the volume is constant: it has no interest points")
    return response_of(grey, volume.spacing_mm, inner, outer, k if response == "harris" else None)


def default_sigmas(
    spacing_mm: FloatArray, shape: tuple[int, ...], gradient_sigma_mm: float | None, window_sigma_mm: float | None
) -> tuple[float, float]:
    """Return the standard deviations, mm, before derivatives and of the window; see `harris_response`."""
    finest = float(spacing_mm[np.array(shape[::-1]) > 1].min())
    return 0.7 * finest if gradient_sigma_mm is None else gradient_sigma_mm, finest if window_sigma_mm is None else window_sigma_mm


def known_grey(values: AnyArray, shift: float) -> Float32Array:
    """Return grey values less a shift, in single precision.

    Raises
    ------
    InputError
        Unknown voxels.
    """
    grey = np.asarray(values - shift, dtype=np.float32)
    if not np.isfinite(grey).all():
        raise InputError("the volume has unknown voxels (NaN); look for interest points before it is resampled, or fill them")
    return grey


def response_of(
    grey: Float32Array, spacing_mm: FloatArray, gradient_sigma_mm: float, window_sigma_mm: float, k: float | None
) -> Float32Array:
    """Return the response (nz, ny, nx) of the Harris operator on grey values; without k the ratio of determinant and trace."""
    slopes = gradient(smoothed(grey, gradient_sigma_mm / spacing_mm), spacing_mm)
    tensor = np.empty((6, *grey.shape), dtype=np.float32)
    products(slopes, tensor)
    plane = grey.shape[0] == 1
    for entry in (0, 1, 3) if plane else range(6):
        tensor[entry] = smoothed(tensor[entry], window_sigma_mm / spacing_mm)
    out = np.empty(grey.shape, dtype=np.float32)
    respond(tensor, plane, -1.0 if k is None else k, out)
    return out


def interest_points(
    volume: Volume,
    *,
    count: int | None = None,
    threshold: float = 0.0,
    min_distance_mm: float | None = None,
    mask: ArrayLike | None = None,
    border: ArrayLike = 0,
    response: Response = "ratio",
    k: float = 0.05,
    gradient_sigma_mm: float | None = None,
    window_sigma_mm: float | None = None,
) -> InterestPoints:
    """Return the strongest interest points of a volume (spec S3).

    Parameters
    ----------
    volume : Volume
        Voxels; a volume of one slice is an image.
    count : int, optional
        At most so many, the strongest; the report takes 200 to 5000.
    threshold : float
        Least response.
    min_distance_mm : float, optional
        Of two points nearer than this, mm, the stronger stays; by default twice the smallest spacing.
    mask : array_like, shape (nz, ny, nx), optional
        Where points may lie.
    border : int or array_like, shape (3,)
        Voxels along x, y, z at every face where no points are wanted, such as half a match box.
    response, k, gradient_sigma_mm, window_sigma_mm
        As in `harris_response`.

    Returns
    -------
    InterestPoints
        Strongest first.

    Raises
    ------
    InputError
        No point above the threshold, a constant volume, an empty mask, or a count below one.
    """
    if count is not None and count < 1:
        raise InputError(f"{count} interest points are none; ask for one or more")
    strength = harris_response(volume, response=response, k=k, gradient_sigma_mm=gradient_sigma_mm, window_sigma_mm=window_sigma_mm)
    allowed = np.ones(volume.shape, dtype=bool) if mask is None else require_mask(mask, volume).copy()
    for axis, b in zip((2, 1, 0), np.broadcast_to(np.asarray(border, dtype=int), 3), strict=True):
        if volume.shape[axis] > 1 and b > 0:
            inner = np.moveaxis(allowed, axis, 0)
            inner[:b], inner[-b:] = False, False
    found = np.empty((strength.size // 4 + 8, 3), dtype=np.int64)
    index = found[: peaks(strength, allowed, threshold, found)]
    if len(index) == 0:
        raise InputError(
            f"no voxel has a response above {threshold:g} (the highest is {strength.max():g}); lower the threshold or widen the mask"
        )
    values = strength[index[:, 2], index[:, 1], index[:, 0]].astype(float)
    order = np.argsort(-values, kind="stable")
    index, values = index[order], values[order]
    active = np.array(volume.shape[::-1]) > 1
    reach = 2.0 * float(volume.spacing_mm[active].min()) if min_distance_mm is None else min_distance_mm
    keep = np.ones(len(index), dtype=bool)
    if reach > 0.0:
        keep[:] = False
        thin_out(index * volume.spacing_mm, reach, len(index) if count is None else count, keep)
    index, values = index[keep][:count], values[keep][:count]
    return InterestPoints(volume.to_physical(index), index, values)
