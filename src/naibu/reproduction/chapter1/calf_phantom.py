"""MR phantom of a calf before and after compression by a plate, in place of the volumes of :cite:t:`hirai2008` (chapter 1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, FloatArray, Int8Array
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions, with_slices_between
from naibu.reproduction.chapter1.calf_motion import FIBULA, TIBIA, CalfMotion
from naibu.validation.scanners.ct_mr import PLASTIC_BEAD, VirtualObject, scan
from naibu.validation.scanners.imaging_artifacts import MRDevice
from naibu.validation.scanners.motions import FormulaMotion, Motion, Still
from naibu.validation.scanners.textures import Texture

Tissue = Literal["air", "skin", "fat", "muscle", "bone"]
TISSUES: tuple[Tissue, ...] = get_args(Tissue)
FIELD_OF_VIEW_MM, SLICE_GAP_MM = 200.0, 2.0
PIXELS, SLICES = 256, 29  # 57 slices with the interpolated ones
_AIR, _SKIN, _FAT, _MUSCLE, _BONE = range(5)
_SKIN_MM, _FASCIA_MM = 2.0, 0.9
# middles of the muscles' cross-sections at z = 0, mm, and their drift along the leg
_MUSCLES = np.array(
    [(2, -36), (12, -28), (30, -26), (40, -6), (2, -10), (10, 6), (-14, 4), (28, 14), (-22, 22), (2, 24), (20, 36), (-32, 6), (-4, 42)],
    dtype=float,
)
_DRIFT = np.array(
    [(0.10, 0.02), (0.06, -0.04), (-0.05, 0.06), (0.02, 0.10), (-0.03, 0.02), (0.04, 0.05), (0.02, -0.08), (0.08, -0.05), (-0.06, 0.08),
     (0.10, 0.05), (-0.08, 0.06), (0.05, 0.10), (-0.12, -0.04)]
)  # fmt: skip
# x, y, drift along x and y per mm, radius, mm, and intensity: slow veins are bright, fast vessels are dark
_VESSELS = (
    (4.0, 2.0, 0.03, 0.05, 1.8, 35.0), (7.5, 3.0, 0.02, 0.04, 1.4, 235.0), (15.0, 0.0, -0.05, 0.02, 1.5, 30.0),
    (12.0, -20.0, 0.04, 0.03, 1.3, 240.0), (-4.0, 33.0, 0.10, 0.02, 1.6, 240.0), (24.0, 28.0, -0.08, 0.05, 1.4, 25.0),
    (-28.0, 13.0, 0.02, -0.10, 1.5, 30.0), (-50.0, -3.0, 0.02, 0.10, 1.7, 40.0), (6.0, 50.5, 0.12, 0.0, 1.6, 35.0),
    (42.0, 30.0, 0.06, -0.07, 1.3, 40.0), (-33.0, 38.0, 0.09, 0.07, 1.4, 40.0), (46.0, -22.0, 0.06, 0.10, 1.3, 40.0),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class CalfPhantom:
    """The undeformed calf: skin, a ring of fat, muscles separated by septa, two bones with marrow, vessels; the leg runs along z.

    Attributes
    ----------
    seed : int
        Of the texture of fat, muscle and marrow.
    """

    seed: int
    _fibres: Texture = field(init=False, repr=False)
    _lobules: Texture = field(init=False, repr=False)
    _grain: Texture = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_fibres", Texture.drawn((2.3, 2.3, 12.0), seed=self.seed, knots=64))
        object.__setattr__(self, "_lobules", Texture.drawn((3.0, 3.0, 7.0), seed=self.seed + 1, knots=64))
        object.__setattr__(self, "_grain", Texture.drawn((1.5, 1.5, 4.0), seed=self.seed + 2, knots=96))

    def tissue(self, material: FloatArray) -> Int8Array:
        """Return the tissue (n,) at material points (n, 3), mm, as its number in `TISSUES`."""
        out = np.zeros(len(material), dtype=np.int8)
        depth = _depth(material)
        inside = np.flatnonzero(depth > 0.0)
        m, d = material[inside], depth[inside]
        kind = np.where(d < _SKIN_MM, _SKIN, np.where(d < _fat_depth(m), _FAT, _MUSCLE))
        kind[(_into_tibia(m) > 0.0) | (_into_fibula(m) > 0.0)] = _BONE
        out[inside] = kind
        return out

    def intensity(self, material: FloatArray) -> FloatArray:
        """Return the intensity (n,), of 256 levels, at material points (n, 3), mm; 4 in air."""
        out = np.full(len(material), 4.0)
        depth = _depth(material)
        inside = np.flatnonzero(depth > 0.0)
        m, d = material[inside], depth[inside]
        border, into = _fat_depth(m), (_into_tibia(m), _into_fibula(m))
        intensity = np.full(len(m), 122.0)  # skin
        fat = (d >= _SKIN_MM) & (d < border)
        intensity[fat] = self._fat(m[fat])
        muscle = (d >= border) & (into[0] <= 0.0) & (into[1] <= 0.0)
        intensity[muscle] = np.where(d[muscle] < border[muscle] + _FASCIA_MM, 62.0, self._muscle(m[muscle]))
        for x, y, along_x, along_y, radius, value in _VESSELS:
            intensity[np.hypot(m[:, 0] - x - along_x * m[:, 2], m[:, 1] - y - along_y * m[:, 2]) < radius] = value
        for depth_in_bone, rim in zip(into, (3.4, 2.2), strict=True):
            intensity[depth_in_bone > 0.0] = 22.0
            marrow = depth_in_bone > rim
            intensity[marrow] = 178.0 + 13.0 * self._lobules(m[marrow]) + 6.0 * self._grain(m[marrow])
        out[inside] = intensity
        return out

    def _fat(self, m: FloatArray) -> FloatArray:
        lobules = self._lobules(m)
        return np.where(np.abs(lobules) < 0.09, 150.0, 208.0 + 9.0 * lobules + 5.0 * self._grain(m))

    def _muscle(self, m: FloatArray) -> FloatArray:
        fibres = self._fibres(m)
        # bright: fat among the fibres, and in the septa
        return np.where((fibres > 1.75) | (_between_muscles(m) < _FASCIA_MM), 168.0, 104.0 + 9.0 * fibres + 5.0 * self._grain(m))


@dataclass(frozen=True, slots=True, eq=False)
class CalfCase:
    """Two scans of the calf, with the true motion.

    Attributes
    ----------
    reference, deformed : Volume
        Before and after the compression, 256 intensity levels, with interpolated slices.
    truth : ndarray, shape (nz, ny, nx, 3)
        Displacement of the tissue at the voxels of the reference volume, mm.
    tissue : ndarray, shape (nz, ny, nx), int8
        Tissue at these voxels, as its number in `TISSUES`.
    tissue_after : ndarray, shape (nz, ny, nx), bool
        Where tissue lies in the deformed volume.
    motion : Motion
        The true motion.
    """

    reference: Volume
    deformed: Volume
    truth: FloatArray
    tissue: Int8Array
    tissue_after: BoolArray
    motion: Motion

    def of(self, *kinds: Tissue) -> BoolArray:
        """Return where one of these tissues lies before (nz, ny, nx)."""
        return np.isin(self.tissue, [TISSUES.index(kind) for kind in kinds])

    @property
    def leg(self) -> BoolArray:
        """Where there is tissue before (nz, ny, nx)."""
        return np.asarray(self.tissue != _AIR)

    def slices(self, first: int, last: int | None = None) -> CalfCase:
        """Return the slices from `first` to `last`, both included; by default the one alone, as an image whose motion is plane.

        The truth of an image is the motion of its tissue within the slice.
        """
        k = slice(first, (first if last is None else last) + 1)
        origin = self.reference.to_physical((0.0, 0.0, float(first)))
        cut = [Volume(v.values[k], v.spacing_mm, origin, v.direction) for v in (self.reference, self.deformed)]
        truth = self.truth[k].copy()
        if last is None:
            truth[..., 2] = 0.0
        return CalfCase(cut[0], cut[1], truth, self.tissue[k], self.tissue_after[k], self.motion)


def calf_case(seed: int = 0, *, pixels: int = PIXELS, slices: int = SLICES, motion: Motion | None = None, noise: float = 4.0) -> CalfCase:
    """Scan the phantom before and after the compression, as the report did: slices 2 mm apart, one interpolated between each two.

    Parameters
    ----------
    seed : int
        Of texture and noise.
    pixels : int
        Along x and y, over 200 mm.
    slices : int
        That are scanned, two or more.
    motion : Motion, optional
        By default `naibu.reproduction.chapter1.calf_motion.CalfMotion`.
    noise : float
        Standard deviation of the noise of each channel of the scanner, intensity levels.
    """
    phantom = CalfPhantom(seed)
    moved = CalfMotion() if motion is None else motion
    step = FIELD_OF_VIEW_MM / pixels
    corner = (-0.5 * step * (pixels - 1), -0.5 * step * (pixels - 1), -0.5 * SLICE_GAP_MM * (slices - 1))
    grid = Volume.from_array(np.zeros((slices, pixels, pixels), np.uint8), spacing_mm=(step, step, SLICE_GAP_MM), origin_mm=corner)
    body = VirtualObject.of(phantom.intensity, np.zeros((0, 3)), PLASTIC_BEAD, air=4.0)
    taken = []
    states: tuple[Motion, Motion] = (Still(), FormulaMotion(moved.to_space, moved.to_material))
    for number, (state, gain) in enumerate(zip(states, (1.0, 1.03), strict=True)):
        seen = scan(body, state, grid, MRDevice(noise=noise, gain=gain), seed=100 * seed + number)
        levels = np.minimum(seen.volume.values, 255).astype(np.uint8)
        taken.append(with_slices_between(seen.volume.with_values(levels)))
    points = positions(taken[0]).reshape(-1, 3)
    tissue = phantom.tissue(points)
    truth = np.zeros_like(points)
    truth[tissue != _AIR] = moved.to_space(points[tissue != _AIR]) - points[tissue != _AIR]
    after = phantom.tissue(moved.to_material(points)) != _AIR
    shape = taken[0].shape
    return CalfCase(taken[0], taken[1], truth.reshape(*shape, 3), tissue.reshape(shape), after.reshape(shape), moved)


def _depth(m: FloatArray) -> FloatArray:
    """Return how deep points (n, 3) lie under the skin, mm; negative in air."""
    angle = np.arctan2(m[:, 1], m[:, 0])
    radius = 54.0 + 2.5 * np.cos(2.0 * angle + 0.3) + 2.0 * np.cos(3.0 * angle - 0.8) + 2.0 * np.sin(angle)
    return np.asarray(radius - 0.05 * m[:, 2] - 0.0007 * m[:, 2] ** 2 - np.hypot(m[:, 0], m[:, 1]))


def _fat_depth(m: FloatArray) -> FloatArray:
    """Return how deep the fat reaches, mm."""
    angle = np.arctan2(m[:, 1], m[:, 0])
    return np.asarray(7.5 + 2.0 * np.sin(angle) + 0.8 * np.cos(4.0 * angle + 0.02 * m[:, 2]))


def _into_tibia(m: FloatArray) -> FloatArray:
    x, y = m[:, 0] - TIBIA[0], m[:, 1] - TIBIA[1]
    return np.asarray(12.8 + 1.6 * np.cos(3.0 * (np.arctan2(y, x) - 0.5)) - np.hypot(x, y))


def _into_fibula(m: FloatArray) -> FloatArray:
    x, y = m[:, 0] - FIBULA[0], m[:, 1] - FIBULA[1]
    return np.asarray(5.6 + 0.6 * np.cos(3.0 * (np.arctan2(y, x) + 0.4)) - np.hypot(x, y))


def _between_muscles(m: FloatArray) -> FloatArray:
    """Return how far points are from the septum between the two nearest muscles, mm, nearly."""
    # muscles drift slowly along the leg: their middles are those at the middle of the points' slab
    out = np.empty(len(m))
    slab = np.round(m[:, 2] / 0.25).astype(int)
    for number in np.unique(slab):
        some = slab == number
        near = np.asarray(cKDTree(_MUSCLES + 0.25 * number * _DRIFT).query(m[some, :2], k=2)[0])
        out[some] = 0.5 * (near[:, 1] - near[:, 0])
    return out
