"""Interest points: the Harris corner detector :cite:p:`harris1988` in two and three dimensions, on voxels of any shape."""

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
    """Points of a volume about which the intensity changes in every direction, strongest first.

    Attributes
    ----------
    points_mm : ndarray, shape (n, 3)
        Centres of their voxels, mm.
    indices : ndarray, shape (n, 3), int64
        Indices of their voxels along x, y, z.
    responses : ndarray, shape (n,)
        Response of the detector: intensity^2/mm^2 for ``"ratio"``; in 3-D intensity^6/mm^6 and intensity^4/mm^4 combined for ``"harris"``.
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
    """Return the response (nz, ny, nx) of the Harris corner detector :cite:p:`harris1988`.

    Parameters
    ----------
    volume : Volume
        Intensities; a volume of one slice is an image, with the detector in two dimensions.
    response : {"ratio", "harris"}
        ``det M / tr M``, free of a constant, or ``det M - k tr(M)^2``.
    k : float
        Constant of ``"harris"``, 0 or more; 0.04 to 0.06 is usual.
    gradient_sigma_mm : float, optional
        Standard deviation of the Gaussian that smooths before derivatives are taken, mm, 0 or more; by default 0.7 of the smallest
        spacing.
    window_sigma_mm : float, optional
        Standard deviation of the Gaussian window of M, mm, 0 or more; by default the smallest spacing.

    Returns
    -------
    ndarray, shape (nz, ny, nx), float32
        Response.

    Raises
    ------
    InputError
        A constant volume, unknown voxels, an unknown response, a negative k, or a negative standard deviation.

    Notes
    -----
    ``M = G * (grad I grad I^T)``, the structure tensor (1.13), with intensity gradients per mm, so that the response does not depend on
    the size of the voxels. In three dimensions ``det M`` and ``tr(M)^2`` do not grow alike with contrast, so that the meaning of k depends
    on the unit of intensity; ``"ratio"`` does not.
    """
    if response not in ("ratio", "harris") or k < 0.0:
        raise InputError(f"response must be 'ratio' or 'harris' with k >= 0, not {response!r} with {k}")
    for name, sigma in (("gradient_sigma_mm", gradient_sigma_mm), ("window_sigma_mm", window_sigma_mm)):
        if sigma is not None and not (np.isfinite(sigma) and sigma >= 0.0):
            raise InputError(f"{name} must be 0 or more, mm, not {sigma}")
    inner, outer = default_sigmas(volume.spacing_mm, volume.shape, gradient_sigma_mm, window_sigma_mm)
    intensity = known_intensities(volume.values, float(np.mean(volume.values, dtype=float)))
    if not float(intensity.max()) > float(intensity.min()):
        raise InputError("the volume is constant: it has no interest points")
    return response_of(intensity, volume.spacing_mm, inner, outer, k if response == "harris" else None)


def default_sigmas(
    spacing_mm: FloatArray, shape: tuple[int, ...], gradient_sigma_mm: float | None, window_sigma_mm: float | None
) -> tuple[float, float]:
    """Return the standard deviations, mm, before derivatives and of the window; see `harris_response`."""
    finest = float(spacing_mm[np.array(shape[::-1]) > 1].min())
    return 0.7 * finest if gradient_sigma_mm is None else gradient_sigma_mm, finest if window_sigma_mm is None else window_sigma_mm


def known_intensities(values: AnyArray, shift: float) -> Float32Array:
    """Return intensities less a shift, in single precision.

    Raises
    ------
    InputError
        Unknown voxels.
    """
    intensity = np.asarray(values - shift, dtype=np.float32)
    if not np.isfinite(intensity).all():
        raise InputError("the volume has unknown voxels (NaN); find interest points before it is resampled, or fill them")
    return intensity


def response_of(
    intensity: Float32Array, spacing_mm: FloatArray, gradient_sigma_mm: float, window_sigma_mm: float, k: float | None
) -> Float32Array:
    """Return the response (nz, ny, nx) of the Harris detector to intensities; without k the ratio of determinant and trace."""
    gradients = gradient(smoothed(intensity, gradient_sigma_mm / spacing_mm), spacing_mm)
    tensor = np.empty((6, *intensity.shape), dtype=np.float32)
    products(gradients, tensor)
    plane = intensity.shape[0] == 1
    for entry in (0, 1, 3) if plane else range(6):
        tensor[entry] = smoothed(tensor[entry], window_sigma_mm / spacing_mm)
    out = np.empty(intensity.shape, dtype=np.float32)
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
    """Return the strongest interest points of a volume by the Harris corner detector :cite:p:`harris1988`.

    Parameters
    ----------
    volume : Volume
        Intensities; a volume of one slice is an image.
    count : int, optional
        Largest number of points, 1 or more; the report takes 200 to 5000.
    threshold : float
        Response that points must exceed.
    min_distance_mm : float, optional
        Of two points nearer than this, mm, the stronger is kept; by default twice the smallest spacing, and all are kept at 0.
    mask : array_like, shape (nz, ny, nx), optional
        Where points may lie.
    border : int or array_like, shape (3,)
        Voxels along x, y, z at every face where no points are wanted, such as half a match box; 0 or more.
    response, k, gradient_sigma_mm, window_sigma_mm
        As in `harris_response`.

    Returns
    -------
    InterestPoints
        Strongest first.

    Raises
    ------
    InputError
        No point above the threshold, a constant volume, an empty mask, a count below one, a negative distance or border.
    """
    if count is not None and count < 1:
        raise InputError(f"count must be one or more, not {count}; leave it out to keep all points")
    if min_distance_mm is not None and not min_distance_mm >= 0.0:
        raise InputError(f"min_distance_mm must be 0 or more, mm, not {min_distance_mm}")
    edge = np.broadcast_to(np.asarray(border, dtype=int), 3)
    if (edge < 0).any():
        raise InputError(f"border must be 0 or more voxels along every axis, not {edge.tolist()}")
    strength = harris_response(volume, response=response, k=k, gradient_sigma_mm=gradient_sigma_mm, window_sigma_mm=window_sigma_mm)
    allowed = np.ones(volume.shape, dtype=bool) if mask is None else require_mask(mask, volume).copy()
    for axis, b in zip((2, 1, 0), edge, strict=True):
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
