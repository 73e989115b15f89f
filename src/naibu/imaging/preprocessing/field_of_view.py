"""Field of view of a scan: the box that holds data, without the planes that a resampling or an export filled in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.bone_mask import otsu_thresholds

Box = tuple[slice, slice, slice]
_Run = tuple[int, float]  # how many outer planes have one intensity or are NaN, and that intensity
# empirical: an end is abrupt where the object's first plane has this share of its largest; the share of that plane that is neither object
# nor of the intensity of the planes beyond it, above which air has noise, and the planes beyond it are padding
ABRUPT, NOISY = 0.2, 0.4
FULL = 0.98  # share of a plane without that intensity: a scan of the inside of an object that was shifted, and filled at one end
# empirical: volume of the object over that in the other scan, below which an abrupt end is a cut: where the other end is not abrupt, and
# where it is, as those of blocks are
SHRUNK, LOST = 0.97, 0.9


def fields_of_view(reference: Volume, deformed: Volume) -> tuple[Box, Box]:
    """Return the boxes (z, y, x) of two scans of one object that hold data.

    Outer planes of NaN are padding. So are outer planes of one intensity, unless the other scan has outer planes of the same intensity, the
    air beside the object has it too, and the object is whole: then it is that of a background without noise.

    Parameters
    ----------
    reference, deformed : Volume
        Scans on one grid.

    Returns
    -------
    reference, deformed : tuple of slice
        Boxes along z, y, x; the whole scan where nothing is padded.

    Notes
    -----
    Beside a background without noise an object is taken for cut off at planes of that intensity where its end is abrupt, and the other scan
    shows that it goes on: up to a face of that scan, or to an end that is not abrupt, or with a larger volume. A block that was compressed
    to less than nine tenths of its volume is taken for cut at its ends: these are then not compared, and all of it can still be answered.
    """
    scans = [_Scan.of(np.asarray(v.values)) for v in (reference, deformed)]
    return _box(scans[0], scans[1]), _box(scans[1], scans[0])


def in_box(box: Box, shape: tuple[int, ...]) -> BoolArray:
    """Return the voxels (nz, ny, nx) of a box."""
    inside = np.zeros(shape, dtype=bool)
    inside[box] = True
    return inside


@dataclass(slots=True, eq=False)
class _Scan:
    """Intensities, runs of outer planes (axis, end), and the areas of the object's planes, found when first needed."""

    values: FloatArray
    runs: list[tuple[_Run, _Run]]
    areas: list[FloatArray] | None = None

    @classmethod
    def of(cls, values: FloatArray) -> _Scan:
        runs = []
        for axis in range(3):
            others = tuple(a for a in range(3) if a != axis)
            low, high = (f.reduce(values, axis=others) for f in (np.fmin, np.fmax))  # NaN only where a plane holds nothing else
            runs.append((_run(low, high), _run(low[::-1], high[::-1])))
        return cls(values, runs)

    @property
    def levels(self) -> set[float]:
        """Intensities of outer planes."""
        return {level for ends in self.runs for count, level in ends if count}

    def of_object(self) -> list[FloatArray]:
        """Return the numbers of bright voxels of the planes across z, y, x."""
        if self.areas is None:
            bright = self.bright(self.values)
            self.areas = [bright.sum(axis=tuple(a for a in range(3) if a != axis)).astype(float) for axis in range(3)]
        return self.areas

    def bright(self, values: FloatArray) -> BoolArray:
        """Return which of some values belong to the object."""
        known = self.values[np.isfinite(self.values)]
        limit = float(otsu_thresholds(known, 2)[0]) if len(known) and known.min() < known.max() else np.inf
        return np.asarray(values > limit)

    def abrupt(self, axis: int, end: int) -> bool:
        """Return whether the object ends abruptly at its first plane from an end."""
        area = self.of_object()[axis][:: -1 if end else 1][self.runs[axis][end][0] :]
        return bool(len(area) and area[0] >= ABRUPT * max(area.max(), 1.0))

    def extent(self, axis: int) -> int:
        """Return the number of planes that show the object."""
        return int(np.count_nonzero(self.of_object()[axis]))

    def differs(self, axis: int, end: int) -> bool:
        """Return whether the first plane shows that the intensity of those beyond it is not that of air."""
        count, level = self.runs[axis][end]
        inner = [slice(low, n - high) for ((low, _), (high, _)), n in zip(self.runs, self.values.shape, strict=True)]
        at = count if end == 0 else self.values.shape[axis] - 1 - count
        inner[axis] = slice(at, at + 1)
        plane = self.values[tuple(inner)]
        shifted = all(low == 0 or high == 0 for (low, _), (high, _) in self.runs)
        other = plane != level
        return float(np.mean(other & ~self.bright(plane))) > NOISY or (shifted and float(np.mean(other)) > FULL)


def _box(own: _Scan, other: _Scan) -> Box:
    slices = []
    for axis, n in enumerate(own.values.shape):
        low, high = (own.runs[axis][end][0] if _is_padding(own, other, axis, end) else 0 for end in (0, 1))
        slices.append(slice(low, n - high) if low + high < n else slice(0, n))
    return slices[0], slices[1], slices[2]


def _is_padding(own: _Scan, other: _Scan, axis: int, end: int) -> bool:
    count, level = own.runs[axis][end]
    if count in (0, own.values.shape[axis]):
        return count > 0
    if level not in other.levels or own.differs(axis, end):
        return True
    if not own.abrupt(axis, end):
        return False
    ratio = own.of_object()[0].sum() / max(float(other.of_object()[0].sum()), 1.0)
    if other.abrupt(axis, end):
        shorter = [own.extent(a) / max(other.extent(a), 1) for a in range(3)]
        return other.runs[axis][end][0] == 0 or (ratio < LOST and axis == int(np.argmin(shorter)))
    return bool(ratio < SHRUNK)


def _run(low: FloatArray, high: FloatArray) -> _Run:
    level = float(low[0])
    same = (np.isnan(low) & np.isnan(high)) if np.isnan(level) else (low == level) & (high == level)
    return (len(same) if same.all() else int(np.argmin(same))), level
