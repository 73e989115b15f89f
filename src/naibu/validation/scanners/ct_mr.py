"""Virtual CT and MR scanners: volumes of an object in any known motion, with the true positions of its markers.

Every voxel is the mean of samples of the intensity at the *material* points that lie there: texture is carried by the material, nothing is
ever warped, and no interpolation links two scans. Markers are rigid and move with the material. Point spread function, shading, streaks,
noise and rounding of the device follow. Ultrasound is made of echoes instead: see `naibu.validation.scanners.ultrasound`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.filters import smoothed
from naibu.validation.scanners._render_kernels import fill_markers
from naibu.validation.scanners.imaging_artifacts import Device
from naibu.validation.scanners.motions import Motion
from naibu.validation.scanners.textures import Intensity

# largest edge of the cells in which markers are rendered, mm, and parts of a cell along each axis in which their faces count as flat: fine
# against markers of 2 mm and slices of 1 mm
_CELL_MM, _CELLS = 0.12, 2
# step of the central differences of the motion that give the tilt of a marker, mm
_TILT_STEP = 0.5


@dataclass(frozen=True, slots=True)
class MarkerKind:
    """Shape and intensity of a marker: a ball, or a flat washer.

    Attributes
    ----------
    diameter_mm : float
        Diameter of the ball, or outer diameter of the washer.
    thickness_mm : float
        Thickness of the washer; 0 for a ball.
    hole_mm : float
        Diameter of the washer's hole.
    intensity : float
        Intensity.
    """

    diameter_mm: float
    thickness_mm: float = 0.0
    hole_mm: float = 0.0
    intensity: float = 3600.0

    def __post_init__(self) -> None:
        if not (self.diameter_mm > self.hole_mm >= 0.0 and self.thickness_mm >= 0.0):
            raise InputError(f"a marker needs a positive diameter, larger than its hole, and a thickness of at least 0 mm, not {self}")


STEEL_WASHER = MarkerKind(2.8, 0.3, 1.1, 3600.0)  # an M1 washer, as in chapter 2 of the report
PLASTIC_BEAD = MarkerKind(2.0, intensity=40.0)  # no MR signal, as in chapter 2 of the report


@dataclass(frozen=True, slots=True, eq=False)
class VirtualObject:
    """An object to be scanned, in the frame of its reference configuration.

    Attributes
    ----------
    intensity : callable
        Intensity (n,) at material points (n, 3), mm; that of air outside the body.
    ids : ndarray, shape (k,), int64
        Labels of the markers.
    positions, normals : ndarray, shape (k, 3)
        Centres, mm, and axes of the markers.
    kind : MarkerKind
        Shape and intensity of the markers.
    air : float
        Intensity where there is no material.
    """

    intensity: Intensity
    ids: IntArray
    positions: FloatArray
    normals: FloatArray
    kind: MarkerKind
    air: float = 0.0

    @classmethod
    def of(
        cls,
        intensity: Intensity,
        positions: ArrayLike,
        kind: MarkerKind,
        *,
        normals: ArrayLike | None = None,
        ids: ArrayLike | None = None,
        air: float = 0.0,
    ) -> VirtualObject:
        """Return an object from arrays; by default washers lie flat, and labels count from 1.

        Raises
        ------
        InputError
            Shapes that do not match, coordinates that are not finite, or a normal of length zero.
        """
        p = np.asarray(positions, dtype=float).reshape(-1, 3)
        n = np.tile([0.0, 0.0, 1.0], (len(p), 1)) if normals is None else np.asarray(normals, dtype=float)
        labels = np.arange(1, len(p) + 1) if ids is None else np.asarray(ids, dtype=np.int64)
        if n.shape != p.shape or labels.shape != (len(p),) or not (np.isfinite(p).all() and np.isfinite(n).all()):
            raise InputError(f"markers need finite positions and normals (k, 3) and ids (k,), not {p.shape}, {n.shape}, {labels.shape}")
        length = np.linalg.norm(n, axis=1, keepdims=True)
        if (length == 0.0).any():
            raise InputError(f"the normal of marker {labels[np.flatnonzero(length == 0.0)[0]]} has length zero")
        return cls(intensity, labels, p, n / np.where(length > 0.0, length, 1.0), kind, air)

    def without(self, lost: ArrayLike) -> VirtualObject:
        """Return the object without the markers of these labels."""
        keep = ~np.isin(self.ids, np.asarray(lost))
        return replace(self, ids=self.ids[keep], positions=self.positions[keep], normals=self.normals[keep])


@dataclass(frozen=True, slots=True, eq=False)
class VirtualScan:
    """A volume, and the true positions of the markers whose centre lies in it."""

    volume: Volume
    markers: Markers


def scan(
    body: VirtualObject, motion: Motion, grid: Volume, device: Device, *, seed: int, samples: int | tuple[int, int, int] = 2
) -> VirtualScan:
    """Scan an object.

    Parameters
    ----------
    body : VirtualObject
        Intensities and markers of the reference configuration.
    motion : Motion
        Positions of its material in the scanner.
    grid : Volume
        Grid of voxels; its values do not matter (`empty_grid`).
    device : Device
        `CTDevice` or `MRDevice`.
    seed : int
        Seed of the noise.
    samples : int or tuple of int
        Samples of the object per voxel, for all axes or along x, y, z; markers have their own, finer ones. The point spread function acts
        on samples, before voxels take their mean.

    Returns
    -------
    VirtualScan
        Volume, uint16, and true positions of the markers, mm.

    Raises
    ------
    InputError
        Fewer than one sample.
    """
    parts = np.broadcast_to(np.asarray(samples), (3,))
    if parts.dtype.kind not in "iu" or (parts < 1).any():
        raise InputError(f"samples is {samples}; a voxel needs at least one sample along every axis")
    fine = _finer(grid, parts)
    values = _mean(smoothed(_sampled(body, motion, fine), device.blur_mm / fine.spacing_mm), parts)
    where, seen = seen_markers(body, motion, grid)
    metal, blurred = np.zeros(grid.shape, dtype=np.float32), np.zeros(grid.shape, dtype=np.float32)
    if seen.any():
        normals = _carried(motion, body.positions[seen], body.normals[seen]) @ grid.direction
        for at, normal in zip(grid.to_index(where[seen]), normals, strict=True):
            _add_marker(body.kind, at, normal, grid.spacing_mm, np.broadcast_to(device.blur_mm, (3,)), metal, blurred)
        values += np.minimum(blurred, 1.0) * (np.float32(body.kind.intensity) - values)
    recorded = device.recorded(values, np.minimum(metal, 1.0), grid.spacing_mm, np.random.default_rng([seed, 7]))
    return VirtualScan(grid.with_values(recorded), Markers.from_arrays(body.ids[seen], where[seen]))


def _add_marker(
    kind: MarkerKind, at: FloatArray, normal: FloatArray, spacing: FloatArray, blur: FloatArray, metal: Float32Array, blurred: Float32Array
) -> None:
    """Add to metal and blurred (nz, ny, nx) the fraction of every voxel that a marker at a continuous index fills, without and with blur.

    A box about the marker is rendered on fine cells: blur acts before voxels take their mean, or a washer thinner than a slice would seem
    to lie in the middle of that slice.
    """
    size = np.array(metal.shape[::-1])
    margin = (0.5 * np.hypot(kind.diameter_mm, kind.thickness_mm) + 3.0 * blur) / spacing
    low, high = np.maximum(np.floor(at - margin).astype(int), 0), np.minimum(np.ceil(at + margin).astype(int) + 1, size)
    if (high <= low).any():
        return
    parts = np.ceil(spacing / _CELL_MM).astype(int)
    cell = spacing / parts
    fraction = np.zeros(tuple(int(n) for n in ((high - low) * parts)[::-1]), dtype=np.float32)
    centre = (at - low + 0.5) * spacing - 0.5 * cell
    shape = np.array([kind.diameter_mm, kind.hole_mm, kind.thickness_mm])
    fill_markers(fraction, cell, centre[None], normal[None], shape, np.full(3, _CELLS))
    box = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    metal[box] += _mean(fraction, parts)
    blurred[box] += _mean(smoothed(fraction, blur / cell), parts)


def seen_markers(body: VirtualObject, motion: Motion, grid: Volume) -> tuple[FloatArray, BoolArray]:
    """Return the positions of the markers (k, 3), mm, and whether their centres lie in the grid (k,)."""
    where = motion.to_space(body.positions) if len(body.positions) else body.positions
    at = grid.to_index(where)
    return where, np.asarray(((at > -0.5) & (at < np.array(grid.shape[::-1]) - 0.5)).all(axis=1))


def empty_grid(low: ArrayLike, high: ArrayLike, spacing_mm: ArrayLike) -> Volume:
    """Return a grid of voxels of that spacing (3,) over a box from `low` to `high`, mm.

    Raises
    ------
    InputError
        A box of negative size, or a spacing that is not positive.
    """
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    spacing = np.broadcast_to(np.asarray(spacing_mm, dtype=float), (3,))
    if a.shape != (3,) or b.shape != (3,) or not (b > a).all() or not (spacing > 0.0).all():
        raise InputError(
            f"a grid needs low < high and a positive spacing along x, y, z, mm, not {a.tolist()}, {b.tolist()}, {spacing.tolist()}"
        )
    count = np.maximum(np.round((b - a) / spacing).astype(int) + 1, 1)
    return Volume.from_array(np.zeros(count[::-1], dtype=np.uint8), spacing_mm=spacing, origin_mm=a)


def _finer(grid: Volume, parts: IntArray) -> Volume:
    """Return the grid of the samples."""
    shape = np.array(grid.shape) * parts[::-1]
    blank = np.broadcast_to(np.float32(0.0), tuple(int(n) for n in shape))
    return Volume(blank, grid.spacing_mm / parts, grid.to_physical(0.5 / parts - 0.5), grid.direction)


def _mean(values: Float32Array, parts: IntArray) -> Float32Array:
    """Return the means of parts along x, y, z of values (nz, ny, nx)."""
    if (parts == 1).all():
        return values
    (nz, ny, nx), (x, y, z) = values.shape, (int(n) for n in parts)
    return np.asarray(values.reshape(nz // z, z, ny // y, y, nx // x, x).mean(axis=(1, 3, 5)), dtype=np.float32)


def _sampled(body: VirtualObject, motion: Motion, grid: Volume) -> Float32Array:
    """Return the intensity at the centre of every voxel, slice by slice."""
    nz, ny, nx = grid.shape
    values = np.full(grid.shape, body.air, dtype=np.float32)
    y, x = np.indices((ny, nx))
    for k in range(nz):
        index = np.stack([x, y, np.full((ny, nx), k)], axis=2).reshape(-1, 3)
        material = motion.to_material(grid.to_physical(index))
        inside = np.isfinite(material).all(axis=1)
        if inside.any():
            values[k].reshape(-1)[inside] = body.intensity(material[inside])
    return values


def _carried(motion: Motion, positions: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the normals (k, 3) of small plates after the motion."""
    aside = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    edges = [motion.to_space(positions + _TILT_STEP * t) - motion.to_space(positions - _TILT_STEP * t) for t in (first, second)]
    turned = np.cross(edges[0], edges[1])
    return np.asarray(turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-300))
