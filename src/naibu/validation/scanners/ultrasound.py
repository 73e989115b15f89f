"""Virtual B-mode ultrasound: speckle that moves with the material, echoes of markers, reverberation ghosts.

Every scatterer reflects a short wave packet, a Gaussian point spread function with a carrier phase. The field at a pixel is the coherent
sum of all packets, and its magnitude, log-compressed, is shown: fully developed speckle :cite:p:`wagner1983` that moves with the material
and decorrelates as that is deformed, as in a scanner.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray, BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.core.volume import Volume
from naibu.validation.scanners._render_kernels import add_echoes
from naibu.validation.scanners.ct_mr import VirtualObject, VirtualScan, seen_markers
from naibu.validation.scanners.motions import Motion
from naibu.validation.scanners.textures import Intensity

# echoes further than this many standard deviations from the grid are left out: their amplitude is below exp(-4.5) = 1 %
_REACH = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Scatterers:
    """Points of the material that scatter sound.

    Attributes
    ----------
    positions : ndarray, shape (n, 3)
        Material points, mm.
    strengths : ndarray, shape (n,)
        Amplitudes: normally distributed, with the RMS amplitude of the echo at the position.
    per_mm3 : float
        Number per cubic millimetre of the reference configuration.
    """

    positions: FloatArray
    strengths: FloatArray
    per_mm3: float

    @classmethod
    def drawn(cls, echo: Intensity, low: ArrayLike, high: ArrayLike, *, per_mm3: float, seed: int) -> Scatterers:
        """Return random scatterers in a box of the reference configuration.

        Parameters
        ----------
        echo : callable
            RMS amplitude (n,) of the field at material points (n, 3), mm; there are no scatterers where it is 0.
        low, high : array_like, shape (3,)
            Corners of the box, mm.
        per_mm3 : float
            Number per cubic millimetre. Speckle is fully developed from about 20 per resolution cell (`UltrasoundDevice.cell_mm3`).
        seed : int
            Seed of positions and amplitudes.

        Raises
        ------
        InputError
            A box of negative size, a density that is not positive, or no scatterer in the box.
        """
        a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
        if a.shape != (3,) or b.shape != (3,) or not (b > a).all() or not (np.isfinite(per_mm3) and per_mm3 > 0.0):
            raise InputError(f"scatterers need low < high, mm, and a positive density, not {a.tolist()}, {b.tolist()} and {per_mm3}")
        rng = np.random.default_rng([seed, 11])
        positions = rng.uniform(a, b, (rng.poisson(per_mm3 * float(np.prod(b - a))), 3))
        strengths = np.asarray(echo(positions), dtype=float)
        kept = strengths > 0.0
        if not kept.any():
            raise InputError(f"no scatterer in the box from {a.tolist()} to {b.tolist()} mm: the echo is 0 there, or the density too low")
        return cls(positions[kept], strengths[kept] * rng.standard_normal(int(kept.sum())), per_mm3)


@dataclass(frozen=True, slots=True)
class Ghost:
    """A false copy of every marker, by sound reflected more than once (reverberation).

    Attributes
    ----------
    shift_mm : tuple of float
        Its position relative to the marker along x, y, z, mm.
    strength : float
        Its amplitude as a fraction of that of the marker.
    """

    shift_mm: tuple[float, float, float]
    strength: float = 0.5


@dataclass(frozen=True, slots=True)
class UltrasoundDevice:
    """An ultrasound scanner in B-mode.

    Attributes
    ----------
    frequency_mhz, speed_m_s : float
        Frequency and speed of the sound.
    spread_mm : tuple of float
        Standard deviation of the amplitude of a point echo along x, y, z, mm: width of the beam, length of the pulse, slice thickness.
    beam : int
        Axis of the grid along which sound travels: 0 for x, 1 for y (images whose rows lie at one depth), 2 for z.
    noise : float
        RMS amplitude of the receiver noise.
    range_db : float, optional
        Dynamic range, dB, from `white` down, of the 256 intensity levels; None for amplitudes without compression.
    white : float
        Amplitude of intensity level 255.
    ghosts : tuple of Ghost
        False copies of markers.
    """

    frequency_mhz: float = 7.5
    speed_m_s: float = 1530.0
    spread_mm: tuple[float, float, float] = (0.45, 0.2, 1.0)
    beam: int = 1
    noise: float = 0.02
    range_db: float | None = 50.0
    white: float = 10.0
    ghosts: tuple[Ghost, ...] = ()

    def __post_init__(self) -> None:
        positive = (self.frequency_mhz, self.speed_m_s, *self.spread_mm, self.white, 1.0 if self.range_db is None else self.range_db)
        if (
            not all(np.isfinite(v) and v > 0.0 for v in positive)
            or self.noise < 0.0
            or self.beam not in (0, 1, 2)
            or len(self.spread_mm) != 3
        ):
            raise InputError(
                f"an ultrasound scanner needs positive numbers, noise of at least 0 and a beam along axis 0, 1 or 2, not {self}"
            )

    @property
    def wavelength_mm(self) -> float:
        """Wavelength, mm."""
        return 1e-3 * self.speed_m_s / self.frequency_mhz

    @property
    def cell_mm3(self) -> float:
        """Volume of a resolution cell, mm^3: the integral of the squared echo of a point over its peak."""
        return float(np.pi**1.5 * np.prod(self.spread_mm))


def ultrasound(
    body: VirtualObject, scatterers: Scatterers, motion: Motion, grid: Volume, device: UltrasoundDevice, *, seed: int
) -> VirtualScan:
    """Scan an object with a virtual B-mode ultrasound scanner.

    Parameters
    ----------
    body : VirtualObject
        Its markers are point reflectors whose echo has the amplitude ``body.kind.intensity``; its intensities do not matter.
    scatterers : Scatterers
        Scatterers of the material.
    motion : Motion
        Positions of the material in the scanner.
    grid : Volume
        Grid of pixels: an image is a volume of one slice (`empty_grid`).
    device : UltrasoundDevice
        The scanner.
    seed : int
        Seed of the receiver noise.

    Returns
    -------
    VirtualScan
        Intensities, uint8, or amplitudes, float32, without `range_db`; and true positions of the markers whose centre projects into the
        grid and is no further from an image's plane than the plane is thick.
    """
    spacing, spread = grid.spacing_mm, np.asarray(device.spread_mm)
    turns = 2.0 / device.wavelength_mm  # the path is twice the depth
    real, imaginary = np.zeros(grid.shape), np.zeros(grid.shape)
    positions = grid.to_index(motion.to_space(scatterers.positions)) * spacing
    size = spacing * (np.array(grid.shape[::-1]) - 1)
    near = ((positions > -_REACH * spread) & (positions < size + _REACH * spread)).all(axis=1)
    each = 1.0 / np.sqrt(scatterers.per_mm3 * device.cell_mm3)
    add_echoes(real, imaginary, spacing, positions[near], each * scatterers.strengths[near], spread, device.beam, turns)
    where, seen = _seen(body, motion, grid, spread)
    bright = np.full(len(where), body.kind.intensity)
    for shift, strength in (((0.0, 0.0, 0.0), 1.0), *((g.shift_mm, g.strength) for g in device.ghosts)):
        at = grid.to_index(where + np.asarray(shift)) * spacing
        add_echoes(real, imaginary, spacing, at, strength * bright, spread, device.beam, turns)
    rng = np.random.default_rng([seed, 13])
    noise = device.noise * np.sqrt(0.5) * rng.standard_normal((2, *grid.shape))
    amplitude = np.hypot(real + noise[0], imaginary + noise[1])
    return VirtualScan(grid.with_values(_shown(amplitude, device)), Markers.from_arrays(body.ids[seen], where[seen]))


def ultrasound_sequence(
    body: VirtualObject, scatterers: Scatterers, motions: Sequence[Motion], grid: Volume, device: UltrasoundDevice, *, seed: int
) -> Iterator[VirtualScan]:
    """Scan an object repeatedly, one frame for each motion, on demand; see `ultrasound`."""
    for frame, motion in enumerate(motions):
        yield ultrasound(body, scatterers, motion, grid, device, seed=seed + frame)


def _seen(body: VirtualObject, motion: Motion, grid: Volume, spread: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the positions of markers (k, 3), mm, and which of them lie in the grid, or near the plane of an image."""
    where, seen = seen_markers(body, motion, grid)
    flat = np.array(grid.shape[::-1]) == 1
    if flat.any() and len(where):
        at = grid.to_index(where)
        inside = (at > -0.5) & (at < np.array(grid.shape[::-1]) - 0.5)
        seen = np.asarray(np.where(flat, np.abs(at) * grid.spacing_mm <= spread, inside).all(axis=1))
    return where, seen


def _shown(amplitude: FloatArray, device: UltrasoundDevice) -> AnyArray:
    """Return the log-compressed intensity levels of amplitudes."""
    if device.range_db is None:
        return amplitude.astype(np.float32)
    level = 1.0 + 20.0 * np.log10(np.maximum(amplitude, 1e-300) / device.white) / device.range_db
    return np.asarray(np.clip(np.rint(255.0 * level), 0, 255), dtype=np.uint8)
