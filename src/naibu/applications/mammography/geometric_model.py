"""Geometric model of a breast between two plates: closed maps from the unloaded to the compressed breast and back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.mammography.breast_shape import BreastShape, opened_at
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError

_LEAST_PART = 0.1  # thinnest compression, of the unloaded thickness
_CELLS, _LAYERS = 40, 5
_STEPS = 60


@dataclass(frozen=True, slots=True)
class CompressionParameters:
    """What outlines and plate distance leave open.

    Attributes
    ----------
    volume_ratio : float
        Volume of the compressed over that of the unloaded breast.
    along_share : float
        Part of the growth of the area that is elongation along the chest wall, the rest away from it: exponent of the growth.
    bending : float
        How much more the middle of the sections moves outwards than at the plates, as a part of the mean movement.
    """

    volume_ratio: float = 1.0
    along_share: float = 0.5
    bending: float = 0.3

    def __post_init__(self) -> None:
        if not 0.5 <= self.volume_ratio <= 1.5:
            raise InputError(f"volume_ratio is {self.volume_ratio:g}: must be between 0.5 and 1.5")
        if not -0.5 <= self.along_share <= 1.5:
            raise InputError(f"along_share is {self.along_share:g}: must be between -0.5 and 1.5")
        if not -1.0 <= self.bending <= 1.5:
            raise InputError(f"bending is {self.bending:g}: must be between -1 and 1.5")


DEFAULT_PARAMETERS = CompressionParameters()


@dataclass(frozen=True, slots=True, eq=False)
class Compression:
    """A breast between two plates that are perpendicular to the axis of a view :cite:p:`kita2001`.

    Columns of the breast along the compression stay straight between their ends but for bending, and shorten to fit between the plates;
    the plane half-way between the plates is not displaced along the compression. At the height zeta (-1 and 1 at the plates) a point
    moves away from the nipple's axis and the chest wall by the factors 1 + (stretch - 1) q, q = 1 + bending (1/3 - zeta^2), so that
    sections perpendicular to the chest wall bend outwards. With both stretches 1 and no bending this is the
    model of the literature, whose mid-plane does not deform.

    Attributes
    ----------
    shape : BreastShape
        The unloaded breast.
    angle_deg : float
        Positioner angle of the view.
    thickness_mm : float
        Distance of the plates.
    along, away : float
        Mean stretches along the chest wall and away from it.
    bending : float
        See `CompressionParameters`.
    hidden_mm : float
        Tissue at the chest wall that the image does not reach: distances in the view are less by this.
    base_curvature : float
        Of the base, 1/mm, where it may lift off what it lies on: it arches with its ends down. 0 at a chest wall.
    contact : (float, float)
        Where the plates first touch: least and greatest unloaded position along the compression, mm.
    """

    shape: BreastShape
    angle_deg: float
    thickness_mm: float
    along: float
    away: float
    bending: float
    hidden_mm: float = 0.0
    base_curvature: float = 0.0
    contact: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "contact", plate_contact(self.shape, self.angle_deg))

    @property
    def outermost(self) -> float:
        """Largest q between the plates."""
        return 1.0 + max(self.bending / 3.0, -self.bending * 2.0 / 3.0)

    @property
    def silhouette(self) -> tuple[float, float]:
        """Stretches of the outline in the view: along the chest wall and away from it."""
        return 1.0 + (self.along - 1.0) * self.outermost, 1.0 + (self.away - 1.0) * self.outermost

    def outline(self) -> FloatArray:
        """Return the outline (m, 2) in the image, depth and position along the chest wall, mm, without what the image does not reach."""
        centres, squares = self.shape.in_view(self.angle_deg, self.shape.depths)
        along, away = self.silhouette
        reach = np.sqrt(np.maximum(squares[:, 0], 0.0))
        ends = [np.column_stack([away * self.shape.depths, along * (centres[:, 0] + sign * reach)]) for sign in (-1.0, 1.0)]
        return opened_at(np.vstack([ends[0], ends[1][::-1]]), self.hidden_mm)

    def compress(self, points: ArrayLike) -> FloatArray:
        """Return positions in the compressed breast.

        Parameters
        ----------
        points : array_like, shape (..., 3)
            Unloaded: laterally, upwards, and away from the chest wall, mm.

        Returns
        -------
        ndarray, shape (..., 3)
            Along the detector, along the compression from half-way between the plates, and away from the chest wall, mm.
        """
        p = np.asarray(points, dtype=float)
        t = np.deg2rad(self.angle_deg)
        along, across = np.cos(t) * p[..., 0] + np.sin(t) * p[..., 1], np.cos(t) * p[..., 1] - np.sin(t) * p[..., 0]
        centre, pressed, part, _ = self._columns(along, p[..., 2])
        height = pressed + part * (across - centre)
        stretch_along, stretch_away = self._stretches(height)
        return np.stack([along * stretch_along, height, p[..., 2] * stretch_away + self._rise(height)], axis=-1)

    def uncompress(self, points: ArrayLike) -> FloatArray:
        """Return unloaded positions (..., 3) of positions (..., 3) in the compressed breast: the inverse of `compress`."""
        p = np.asarray(points, dtype=float)
        stretch_along, stretch_away = self._stretches(p[..., 1])
        along, depth = p[..., 0] / stretch_along, (p[..., 2] - self._rise(p[..., 1])) / stretch_away
        centre, pressed, part, _ = self._columns(along, depth)
        across = centre + (p[..., 1] - pressed) / part
        t = np.deg2rad(self.angle_deg)
        return np.stack([np.cos(t) * along - np.sin(t) * across, np.sin(t) * along + np.cos(t) * across, depth], axis=-1)

    def project(self, points: ArrayLike) -> FloatArray:
        """Return depths and positions along the chest wall (..., 2) in the view, mm, of unloaded points (..., 3); by parallel rays."""
        return np.asarray(self.compress(points)[..., [2, 0]] - np.array([self.hidden_mm, 0.0]))

    def on_ray(self, place: ArrayLike, count: int = 101) -> tuple[FloatArray, BoolArray]:
        """Return unloaded positions of the points that appear at one place of the view.

        Parameters
        ----------
        place : array_like, shape (..., 2)
            Depth and position along the chest wall in the view, mm.
        count : int
            Number of points between the plates.

        Returns
        -------
        points : ndarray, shape (..., count, 3)
            From the lower to the upper plate, mm.
        inside : ndarray of bool, shape (..., count)
            Which of them lie inside of the breast.
        """
        at = np.asarray(place, dtype=float)[..., None, :] + np.array([self.hidden_mm, 0.0])
        heights = np.broadcast_to(0.5 * self.thickness_mm * np.linspace(-1.0, 1.0, count), (*at.shape[:-2], count))
        ray = np.stack(np.broadcast_arrays(at[..., 1], heights, at[..., 0]), axis=-1)
        points = self.uncompress(ray)
        t = np.deg2rad(self.angle_deg)
        along, across = np.cos(t) * points[..., 0] + np.sin(t) * points[..., 1], np.cos(t) * points[..., 1] - np.sin(t) * points[..., 0]
        centre, _, _, half = self._columns(along, points[..., 2])
        inside: BoolArray = (
            (np.abs(across - centre) <= half * (1 + 1e-9))
            & (half > 0.0)
            & (points[..., 2] >= 0.0)
            & (points[..., 2] <= self.shape.depth_mm)
        )
        return points, inside

    def volume_mm3(self) -> float:
        """Return the volume of the compressed breast, by the midpoint rule over 40 x 40 columns and the Gauss rule along them."""
        depth_mm = self.shape.depth_mm
        theta = (np.arange(_CELLS) + 0.5) * 0.5 * np.pi / _CELLS
        depths, depth_weights = depth_mm * np.sin(theta), depth_mm * np.cos(theta) * 0.5 * np.pi / _CELLS
        centres, squares = self.shape.in_view(self.angle_deg, depths)
        phi = -0.5 * np.pi + (np.arange(_CELLS) + 0.5) * np.pi / _CELLS
        width = np.sqrt(np.maximum(squares[:, 0], 0.0))[:, None]
        along = centres[:, :1] + width * np.sin(phi)
        weights = depth_weights[:, None] * width * np.cos(phi) * np.pi / _CELLS
        _, pressed, part, half = self._columns(along, np.broadcast_to(depths[:, None], along.shape))
        nodes, node_weights = np.polynomial.legendre.leggauss(_LAYERS)
        height = pressed[..., None] + (part * half)[..., None] * nodes
        stretch_along, stretch_away = self._stretches(height)
        area = (stretch_along * stretch_away) @ node_weights
        return float(np.sum(weights * part * half * area))

    def _rise(self, height: FloatArray) -> FloatArray:
        return np.asarray(0.5 * self.base_curvature * ((0.5 * self.thickness_mm) ** 2 - height**2))

    def _stretches(self, height: FloatArray) -> tuple[FloatArray, FloatArray]:
        zeta = np.clip(height / (0.5 * self.thickness_mm), -1.0, 1.0)
        q = 1.0 + self.bending * (1.0 / 3.0 - zeta**2)
        return 1.0 + (self.along - 1.0) * q, 1.0 + (self.away - 1.0) * q

    def _columns(self, along: FloatArray, depth: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return of the columns: unloaded centre from the nipple's axis, compressed centre, factor of length, unloaded half length."""
        centres, squares = self.shape.in_view(self.angle_deg, depth)
        safe = np.maximum(squares[..., 0], 1e-12)
        offset = along - centres[..., 0]
        determinant = np.maximum(squares[..., 0] * squares[..., 1] - squares[..., 2] ** 2, 0.0)
        half = np.sqrt(np.maximum(determinant / safe * (1.0 - offset**2 / safe), 0.0))
        centre = centres[..., 1] + squares[..., 2] / safe * np.clip(offset, -np.sqrt(safe), np.sqrt(safe))
        low, high = self.contact
        gap = 0.5 * self.thickness_mm
        pressed = (centre - 0.5 * (low + high)) * min(1.0, 2.0 * gap / (high - low))
        room = np.maximum(gap - np.abs(pressed), 1e-9)
        part = np.where(half > room, room / np.maximum(half, 1e-12), 1.0)
        return centre, pressed, part, half


def plate_contact(shape: BreastShape, angle_deg: float) -> tuple[float, float]:
    """Return where plates touch the unloaded breast: least and greatest position along the compression, mm."""
    centres, squares = shape.in_view(angle_deg, shape.depths)
    reach = np.sqrt(np.maximum(squares[:, 1], 0.0))
    return float((centres[:, 1] - reach).min()), float((centres[:, 1] + reach).max())


def compressed(
    shape: BreastShape,
    angle_deg: float,
    thickness_mm: float,
    parameters: CompressionParameters = DEFAULT_PARAMETERS,
    *,
    free_base: bool = False,
) -> Compression:
    """Return the compression of a breast of known unloaded shape, with the stretches that its volume asks for.

    Parameters
    ----------
    shape : BreastShape
        The unloaded breast.
    angle_deg : float
        Positioner angle of the view: 0 of CC.
    thickness_mm : float
        Distance of the plates.
    parameters : CompressionParameters
        What shape and distance leave open.
    free_base : bool
        Whether the base may arch off a table, as that of a phantom does, instead of being held by a chest wall. The plates shorten the base
        more than what lies above it; sections that stay plane then give a beam the curvature of the regression of the shortening on the
        height.

    Raises
    ------
    InputError
        Plates farther apart than the breast is thick, or closer than a tenth of that.
    """
    require_thickness(shape, angle_deg, thickness_mm)
    growth = 1.0
    for _ in range(_STEPS):
        state = with_growth(shape, angle_deg, thickness_mm, growth, parameters)
        ratio = parameters.volume_ratio * shape.volume_mm3 / state.volume_mm3()
        growth *= ratio
        if abs(ratio - 1.0) < 1e-6:
            break
    state = with_growth(shape, angle_deg, thickness_mm, growth, parameters)
    return replace(state, base_curvature=_free_curvature(state)) if free_base else state


def _free_curvature(state: Compression) -> float:
    """Return the curvature, 1/mm, by the regression of the columns' shortening on the height, weighted by the sections' areas."""
    depths = state.shape.depth_mm * (np.arange(_CELLS) + 0.5) / _CELLS
    centres, squares = state.shape.in_view(state.angle_deg, depths)
    phi = -0.5 * np.pi + (np.arange(_CELLS) + 0.5) * np.pi / _CELLS
    along = centres[:, :1] + np.sqrt(squares[:, :1]) * np.sin(phi)
    _, _, part, half = state._columns(along, np.broadcast_to(depths[:, None], along.shape))
    weights = half * np.sqrt(squares[:, :1]) * np.cos(phi)
    height, shortening = depths[:, None] - np.average(depths, weights=weights.sum(axis=1)), 1.0 - part
    return float(-np.sum(weights * height * shortening) / np.sum(weights * height**2))


def with_growth(shape: BreastShape, angle_deg: float, thickness_mm: float, growth: float, parameters: CompressionParameters) -> Compression:
    """Return the compression with a given growth of the area that columns cover, shared as the parameters say."""
    share = parameters.along_share
    return Compression(shape, angle_deg, thickness_mm, growth**share, growth ** (1.0 - share), parameters.bending)


def require_thickness(shape: BreastShape, angle_deg: float, thickness_mm: float) -> None:
    """Raise `InputError` where plates at a distance do not press a breast, or would flatten it."""
    low, high = plate_contact(shape, angle_deg)
    if not _LEAST_PART * (high - low) <= thickness_mm < high - low:
        raise InputError(
            f"thickness_mm is {thickness_mm:g}, and the unloaded breast is {high - low:.4g} mm thick along the "
            f"compression at {angle_deg:g} "
            f"degrees: the plates' distance must be below that, and at least {_LEAST_PART:g} of it"
        )
