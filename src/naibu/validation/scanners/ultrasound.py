"""Ultrasound of a virtual object in any known motion: speckle that moves with the material, echoes of markers, ghosts (spec S10).

Every scatterer sends back a short wave packet. The field at a pixel is the sum of all packets that reach it, with their phases, and what is
shown is its magnitude, compressed: so speckle comes about as in a scanner, moves with the material and changes as that is deformed.
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
from naibu.validation.scanners.textures import Grey

# echoes further than this many standard deviations from the grid are not seen
_REACH = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Scatterers:
    """Points of the material that send back sound.

    Attributes
    ----------
    places : ndarray, shape (n, 3)
        Material points, mm.
    strengths : ndarray, shape (n,)
        Amplitudes: normally distributed, times the root mean square amplitude asked for at the place.
    per_mm3 : float
        How many there are in a cubic millimetre of the free object.
    """

    places: FloatArray
    strengths: FloatArray
    per_mm3: float

    @classmethod
    def drawn(cls, echo: Grey, low: ArrayLike, high: ArrayLike, *, per_mm3: float, seed: int) -> Scatterers:
        """Draw scatterers in a box of the free object.

        Parameters
        ----------
        echo : callable
            Root mean square amplitude (n,) of the field at material points (n, 3), mm; there are no scatterers where it is 0.
        low, high : array_like, shape (3,)
            Corners of the box, mm.
        per_mm3 : float
            Density. Speckle is fully developed from some 20 to a resolution cell (`UltrasoundDevice.cell_mm3`).
        seed : int
            Of places and amplitudes.

        Raises
        ------
        InputError
            A box turned inside out, a density that is not positive, or no scatterer in the box.
        """
        a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
        if a.shape != (3,) or b.shape != (3,) or not (b > a).all() or not (np.isfinite(per_mm3) and per_mm3 > 0.0):
            raise InputError(f"scatterers need low < high, mm, and a positive density, not {a.tolist()}, {b.tolist()} and {per_mm3}")
        rng = np.random.default_rng([seed, 11])
        places = rng.uniform(a, b, (rng.poisson(per_mm3 * float(np.prod(b - a))), 3))
        strengths = np.asarray(echo(places), dtype=float)
        kept = strengths > 0.0
        if not kept.any():
            raise InputError(f"no scatterer in the box from {a.tolist()} to {b.tolist()} mm: the echo is 0 there, or the density too low")
        return cls(places[kept], strengths[kept] * rng.standard_normal(int(kept.sum())), per_mm3)


@dataclass(frozen=True, slots=True)
class Ghost:
    """A false copy of every marker, by sound that went to and fro more than once.

    Attributes
    ----------
    shift_mm : tuple of float
        Where it appears, from the marker, along x, y, z.
    strength : float
        Its amplitude as a share of the marker's.
    """

    shift_mm: tuple[float, float, float]
    strength: float = 0.5


@dataclass(frozen=True, slots=True)
class UltrasoundDevice:
    """An ultrasound scanner in B-mode.

    Attributes
    ----------
    frequency_mhz, speed_m_s : float
        Of the sound.
    spread_mm : tuple of float
        Standard deviation of the amplitude of a point's echo along x, y, z: width of the beam, length of the pulse, thickness of the plane.
    beam : int
        Axis of the grid along which sound travels: 0 for x, 1 for y (images whose rows lie at one depth), 2 for z.
    noise : float
        Root mean square amplitude of the receiver's noise.
    range_db : float, optional
        Range of amplitudes, from `white` down, that the 256 grey levels show; None to show amplitudes as they are.
    white : float
        Amplitude of grey level 255.
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
        """Length of a wave, mm."""
        return 1e-3 * self.speed_m_s / self.frequency_mhz

    @property
    def cell_mm3(self) -> float:
        """Volume of a resolution cell, mm3: the squared echo of a point, over its peak."""
        return float(np.pi**1.5 * np.prod(self.spread_mm))


def ultrasound(
    body: VirtualObject, scatterers: Scatterers, motion: Motion, grid: Volume, device: UltrasoundDevice, *, seed: int
) -> VirtualScan:
    """Scan an object by ultrasound.

    Parameters
    ----------
    body : VirtualObject
        Its markers are point reflectors whose echo has the amplitude ``body.kind.grey``; its grey values do not matter.
    scatterers : Scatterers
        Of the material.
    motion : Motion
        Where the material lies in the scanner.
    grid : Volume
        The pixels: an image is a volume of one slice (`empty_grid`).
    device : UltrasoundDevice
        The scanner.
    seed : int
        Of the receiver's noise.

    Returns
    -------
    VirtualScan
        Grey levels, uint8, or amplitudes, float32, without `range_db`; and true places of the markers whose centre projects into the grid
        and is no further from an image's plane than the plane is thick.
    """
    spacing, spread = grid.spacing_mm, np.asarray(device.spread_mm)
    turns = 2.0 / device.wavelength_mm  # there and back
    real, imaginary = np.zeros(grid.shape), np.zeros(grid.shape)
    places = grid.to_index(motion.to_space(scatterers.places)) * spacing
    size = spacing * (np.array(grid.shape[::-1]) - 1)
    near = ((places > -_REACH * spread) & (places < size + _REACH * spread)).all(axis=1)
    each = 1.0 / np.sqrt(scatterers.per_mm3 * device.cell_mm3)
    add_echoes(real, imaginary, spacing, places[near], each * scatterers.strengths[near], spread, device.beam, turns)
    where, seen = _seen(body, motion, grid, spread)
    bright = np.full(len(where), body.kind.grey)
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
    """Scan an object again and again, one frame for each motion; see `ultrasound`. Frames are made as they are asked for."""
    for frame, motion in enumerate(motions):
        yield ultrasound(body, scatterers, motion, grid, device, seed=seed + frame)


def _seen(body: VirtualObject, motion: Motion, grid: Volume, spread: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return where markers lie (k, 3), mm, and which of them lie in the grid, or close to the plane of an image."""
    where, seen = seen_markers(body, motion, grid)
    flat = np.array(grid.shape[::-1]) == 1
    if flat.any() and len(where):
        at = grid.to_index(where)
        inside = (at > -0.5) & (at < np.array(grid.shape[::-1]) - 0.5)
        seen = np.asarray(np.where(flat, np.abs(at) * grid.spacing_mm <= spread, inside).all(axis=1))
    return where, seen


def _shown(amplitude: FloatArray, device: UltrasoundDevice) -> AnyArray:
    """Return grey levels of amplitudes."""
    if device.range_db is None:
        return amplitude.astype(np.float32)
    level = 1.0 + 20.0 * np.log10(np.maximum(amplitude, 1e-300) / device.white) / device.range_db
    return np.asarray(np.clip(np.rint(255.0 * level), 0, 255), dtype=np.uint8)
