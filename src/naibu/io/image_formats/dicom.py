"""DICOM series (read with pydicom): slices are sorted by position and checked to form a regular volume.

The geometry follows DICOM PS3.3, C.7.6.2 "Image Plane Module"; frames of enhanced files follow C.7.6.16.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.image_formats.geometry import ReadOptions, no_colours, volume_with_axes

# scanners round positions to some micrometres
EVEN, ALIGNED = 0.02, 2e-3


@dataclass(frozen=True)
class _Slice:
    """One image plane of a series with its position and orientation."""

    file: Path
    frame: int | None
    series: str
    description: str
    size: tuple[int, int]
    samples: int
    position: FloatArray
    axes: FloatArray
    pixel_mm: FloatArray
    apart_mm: float | None
    rescale: tuple[float, float]

    @property
    def name(self) -> str:
        """Name of the file, and of the frame where there are several."""
        return self.file.name if self.frame is None else f"{self.file.name} frame {self.frame + 1}"


def is_dicom(path: Path) -> bool:
    """Whether a file has the preamble of DICOM."""
    try:
        with open(path, "rb") as file:
            return file.read(132)[128:] == b"DICM"
    except OSError:
        return False


def read(path: Path, options: ReadOptions) -> Volume:
    """Read the series of a folder, or the one that a file belongs to (see `naibu.io.images.read_volume`)."""
    pydicom = optional_package("pydicom", f"{path.name}: reading DICOM files")
    slices = _one_series(path, _slices(pydicom, path), options.series)
    slices = _sorted_stack(path.name, slices)
    first = slices[0]
    step = _step(path.name, slices)
    values = _values(pydicom, path.name, slices)
    if options.rescaled or len({s.rescale for s in slices}) > 1:  # stored values of slices with different ones are not comparable
        scale = np.array([s.rescale for s in slices])
        values = values * scale[:, :1, None] + scale[:, 1:, None]
    axes = np.column_stack([first.axes[0] * first.pixel_mm[1], first.axes[1] * first.pixel_mm[0], step])
    return volume_with_axes(path.name, values, first.position, axes, options.unit_mm or 1.0)


def _slices(pydicom: Any, path: Path) -> list[_Slice]:
    """Return the image planes of a file, or of all files of a folder."""
    if path.is_dir():
        files: Iterable[Path] = sorted(file for file in path.rglob("*") if file.is_file())
    else:
        files = sorted(file for file in path.parent.iterdir() if is_dicom(file)) if path.exists() else [path]
    found: list[_Slice] = []
    for file in files:
        try:
            data = pydicom.dcmread(file, stop_before_pixels=True)
        except (pydicom.errors.InvalidDicomError, IsADirectoryError):
            continue
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror or error}); check the path") from error
        if "Rows" in data:
            found += _planes(file, data)
    if not found:
        raise InputError(f"{path.name}: contains no DICOM images; give the folder of the series, or one of its files")
    if not path.is_dir():
        own = {s.series for s in found if s.file == path}
        found = [s for s in found if s.series in own]
    return found


def _planes(file: Path, data: Any) -> list[_Slice]:
    """Return the planes of one file: one, or the frames of an enhanced file."""
    n = int(data.get("NumberOfFrames", 1) or 1)
    frames = data.get("PerFrameFunctionalGroupsSequence")
    if n == 1 and not frames:
        return [_plane(file, None, data, [data])]
    if not frames:
        raise InputError(
            f"{file.name}: contains {n} frames without positions (a cine or ultrasound sequence), which do not form a volume; export slices"
        )
    shared = data.get("SharedFunctionalGroupsSequence") or [{}]
    return [_plane(file, i, data, [*_groups(frame), *_groups(shared[0]), data]) for i, frame in enumerate(frames)]


def _groups(items: Any) -> list[Any]:
    """Return the first item of every functional group."""
    return [element.value[0] for element in items if element.VR == "SQ" and len(element.value)] if items else []


def _plane(file: Path, frame: int | None, data: Any, groups: Sequence[Any]) -> _Slice:
    def stated(tag: str) -> Any:
        return next((group.get(tag) for group in groups if group.get(tag) is not None), None)

    name = file.name if frame is None else f"{file.name} frame {frame + 1}"
    position, turn, pixel = (stated(tag) for tag in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"))
    if position is None or turn is None or pixel is None:
        lacking = "ImagePositionPatient" if position is None else "ImageOrientationPatient" if turn is None else "PixelSpacing"
        raise InputError(f"{name}: has no {lacking}, so its geometry is unknown; export the original series, not screen captures")
    apart = stated("SpacingBetweenSlices") or stated("SliceThickness")
    slope, intercept = stated("RescaleSlope"), stated("RescaleIntercept")
    return _Slice(
        file,
        frame,
        str(data.get("SeriesInstanceUID", "")),
        str(data.get("SeriesDescription", "")),
        (int(data.Rows), int(data.Columns)),
        int(data.get("SamplesPerPixel", 1)),
        np.array(position, dtype=float),
        np.array(turn, dtype=float).reshape(2, 3),
        np.array(pixel, dtype=float),
        None if apart is None else float(apart),
        (1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept)),
    )


def _one_series(path: Path, slices: list[_Slice], wanted: str | None) -> list[_Slice]:
    """Return the slices of the one series there is, or of the one asked for."""
    series = {s.series: s.description for s in slices}
    if wanted is not None:
        chosen = [uid for uid, description in series.items() if wanted in (uid, description)]
        if len(chosen) != 1:
            raise InputError(f"{path.name}: {len(chosen)} series are called {wanted!r}; the folder contains {_listed(slices, series)}")
        return [s for s in slices if s.series == chosen[0]]
    if len(series) > 1:
        raise InputError(
            f"{path.name}: contains {len(series)} series, {_listed(slices, series)}; give a file of the one that is meant in place of the "
            "folder, or choose it in Python with series="
        )
    return slices


def _listed(slices: list[_Slice], series: dict[str, str]) -> str:
    files = {uid: [s.name for s in slices if s.series == uid] for uid in series}
    return "; ".join(f"{uid} ({text or 'no description'}, {len(files[uid])} slices, {files[uid][0]} ...)" for uid, text in series.items())


def _sorted_stack(source: str, slices: list[_Slice]) -> list[_Slice]:
    """Return slices of one size and orientation sorted by position along the normal."""
    first = slices[0]
    for s in slices:
        no_colours(s.name, s.samples)
        if s.size != first.size or np.abs(s.pixel_mm - first.pixel_mm).max() > 1e-4 * first.pixel_mm.min():
            raise InputError(
                f"{source}: slices {first.name} and {s.name} differ in size or pixel spacing ({first.size}, {first.pixel_mm.tolist()} mm; "
                f"{s.size}, {s.pixel_mm.tolist()} mm); a series must be one stack"
            )
        if np.abs(s.axes - first.axes).max() > ALIGNED:
            raise InputError(f"{source}: slices {first.name} and {s.name} differ in orientation (a localizer?); separate them")
    normal = np.cross(*first.axes)
    return sorted(slices, key=lambda s: float(s.position @ normal))


def _step(source: str, slices: list[_Slice]) -> FloatArray:
    """Return the offset (3,), mm, from one slice to the next."""
    first = slices[0]
    normal = np.cross(*first.axes)
    if len(slices) == 1:
        return np.asarray(normal * (first.apart_mm or 1.0))
    steps = np.diff([s.position for s in slices], axis=0)
    along = steps @ normal
    usual = float(np.median(along))
    twice = int(np.argmin(along))
    if along[twice] < 0.01 * max(usual, 0.01):
        raise InputError(
            f"{source}: {slices[twice].name} and {slices[twice + 1].name} have the same position (several time points, echoes or "
            "repetitions); export one of them as a series of its own"
        )
    worst = int(np.argmax(np.abs(along - usual)))
    if abs(along[worst] - usual) > EVEN * usual:
        between = f"between {slices[worst].name} and {slices[worst + 1].name} ({along[worst]:.3f} mm apart, the others {usual:.3f} mm)"
        lost = round(along[worst] / usual) - 1
        if lost < 1 or np.sum(np.abs(along - usual) > EVEN * usual) > 1:
            range_ = f"{along.min():.3f} to {along.max():.3f} mm"
            what, between = "the slice spacing is uneven,", f"{range_} (most of all at {slices[worst].name} and {slices[worst + 1].name})"
        else:
            what = f"{lost} slice{'s are' if lost > 1 else ' is'} missing"
        raise InputError(f"{source}: {what} {between}; export the whole series again, or resample it to evenly spaced slices")
    total = slices[-1].position - first.position
    # the mean offset: rounding of single positions averages out
    return np.asarray(total / (len(slices) - 1))


def _values(pydicom: Any, source: str, slices: list[_Slice]) -> AnyArray:
    """Return the stored values (nz, ny, nx)."""
    pages: dict[Path, AnyArray] = {}
    planes = []
    for s in slices:
        if s.file not in pages:
            # one file per slice, as in most series: keep only the last
            pages = {} if s.frame is None else pages
            try:
                pages[s.file] = np.asarray(pydicom.dcmread(s.file).pixel_array)
            # pydicom raises whatever its decoders meet
            except Exception as error:
                raise InputError(
                    f"{source}: the pixels of {s.name} cannot be decoded ({error}); copy it again, or for compressed ones install "
                    "pylibjpeg with pip"
                ) from error
        page = pages[s.file]
        planes.append(page if s.frame is None or page.ndim == 2 else page[s.frame])
    return np.stack(planes)
