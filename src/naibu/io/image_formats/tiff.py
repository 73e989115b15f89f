"""TIFF stacks, multi-page files or folders of slices, read and written with tifffile."""

from __future__ import annotations

import html
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.files.atomic import write_atomically
from naibu.io.files.reading import require_regular
from naibu.io.image_formats.geometry import MM_PER_UNIT, ReadOptions, no_colours, three_axes, unit_length, volume_with_axes

_ENDINGS = (".tif", ".tiff")
_PIXELS, _ATTRIBUTE = re.compile(r"<(?:\w+:)?Pixels\b([^>]*)>"), re.compile(r"(\w+)\s*=\s*[\"']([^\"']*)[\"']")
_NUMBER = re.compile(r"(\d+)(?!.*\d)")


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a scalar volume from one file, or from a folder with one slice per file (see `naibu.io.images.read_volume`)."""
    tifffile = optional_package("tifffile", f"{path.name}: reading TIFF files")
    if path.is_dir():
        files = slices_of_folder(path)
        parts = [_loaded(tifffile, file) for file in files]
        different = next((f.name for f, p in zip(files, parts, strict=True) if p[0].shape != parts[0][0].shape), None)
        if different:
            raise InputError(f"{path.name}: slice {different} differs in size from {files[0].name}; a folder must contain one stack")
        values, stated = np.stack([part[0] for part in parts]), parts[0][1]
    else:
        values, stated = _loaded(tifffile, path)
    values = three_axes(path.name, values)
    if options.spacing_mm is not None:
        return volume_with_axes(path.name, values, (0.0, 0.0, 0.0), np.diag(options.spacing_mm))
    steps = np.asarray(stated["steps"], dtype=float)
    if not np.isfinite(steps).all():
        raise no_spacing(path.name, stated)
    return volume_with_axes(path.name, values, stated["origin"], steps, options.unit_mm or 1.0)


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write intensities (nz, ny, nx) with the geometry as JSON in the image description, where `read` finds it."""
    tifffile = optional_package("tifffile", f"{path.name}: writing TIFF files")
    if values.ndim != 3:
        raise InputError(f"{path.name}: TIFF is written for scalar volumes only; write vectors as .mha")
    stored = values.astype(np.uint8) if values.dtype == bool else values
    metadata = {
        "spacing_mm": grid.spacing_mm.tolist(),
        "origin_mm": grid.origin_mm.tolist(),
        "direction": grid.direction.tolist(),
    }
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        stored,
        photometric="minisblack",
        compression="zlib" if compressed else None,
        resolution=tuple(10.0 / grid.spacing_mm[:2]),
        resolutionunit="CENTIMETER",
        metadata=metadata,
    )
    return write_atomically(path, buffer.getvalue())


def slices_of_folder(folder: Path) -> list[Path]:
    """Return the TIFF files of a folder, sorted by the last number in their names.

    Raises
    ------
    InputError
        No such files, names without numbers, or a number that is missing or occurs twice.
    """
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _ENDINGS)
    if not files:
        raise InputError(f"{folder.name}: contains neither DICOM nor TIFF slices; give the folder of the slices, or a file")
    found = [_NUMBER.search(file.stem) for file in files]
    if not all(found):
        nameless = next(file.name for file, match in zip(files, found, strict=True) if not match)
        raise InputError(f"{folder.name}: {nameless} has no number in its name, so the slice order is unknown; number the files")
    numbers = [int(match.group(1)) for match in found if match]
    order = np.argsort(numbers, kind="stable")
    steps = np.diff(np.array(numbers)[order])
    if len(steps) and (steps != steps[0]).any():
        bad = int(np.flatnonzero(steps != np.median(steps))[0])
        raise InputError(
            f"{folder.name}: between {files[order[bad]].name} and {files[order[bad + 1]].name} slices are missing or duplicated; "
            "complete the stack"
        )
    return [files[i] for i in order]


def _loaded(tifffile: Any, path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Return the values of a file and the voxel geometry that it states."""
    require_regular(path)
    try:
        with tifffile.TiffFile(path) as file:
            if not len(file.pages):  # counting ends where pages refer to each other in a circle, iterating does not
                raise InputError(f"{path.name}: contains no image; copy the file again")
            series, page = file.series[0], file.pages[0]
            require_all_strips(path.name, page)
            samples = int(page.samplesperpixel)
            n_series, axes = len(file.series), str(series.axes)
            stated = stated_geometry(path.name, file, page)
            values = np.asarray(series.asarray()) if samples == 1 else np.zeros((1, 1, 1))
    except InputError:
        raise
    # tifffile's decoders raise exceptions of many types
    except Exception as error:
        raise InputError(f"{path.name}: cannot be read as TIFF ({error}); copy the file again") from error
    no_colours(path.name, samples)
    if n_series > 1:
        raise InputError(f"{path.name}: contains {n_series} images of different size or type; save one stack as a file of its own")
    if any(axis in axes and values.shape[axes.index(axis)] > 1 for axis in "TCS"):
        raise InputError(
            f"{path.name}: contains several time points or channels (axes {axes}, {values.shape}); save one as a stack; slices "
            "that tifffile wrote as channels get metadata={'axes': 'ZYX'}"
        )
    return values, stated


def require_all_strips(source: str, page: Any) -> None:
    """Raise unless a page lists as many strips or tiles as its size takes: tifffile would go through millions that are not there.

    Raises
    ------
    InputError
        Fewer are listed.
    """
    expected, listed = int(np.prod(page.chunked)), len(page.dataoffsets)
    if listed < expected and not page.is_contiguous:
        raise InputError(
            f"{source}: its size of {page.shape} takes {expected} strips, and it lists {listed}; its header is damaged, copy the file again"
        )


def no_spacing(source: str, stated: dict[str, Any]) -> InputError:
    """Return the error of a stack whose geometry (see `stated_geometry`) lacks the spacing along an axis."""
    known = {axis: value for axis, value in zip("xyz", stated["spacing"], strict=True) if np.isfinite(value)}
    lacking = ", ".join(axis for axis in "xyz" if axis not in known)
    there = f" (along {', '.join(known)}: {', '.join(f'{value:.6g}' for value in known.values())} mm)"
    what = f"states no voxel spacing along {lacking}{there}" if known else "does not state its voxel spacing"
    return InputError(f"{source}: {what}; give spacing_mm, for example (0.8, 0.8, 2.0)")


def stated_geometry(source: str, file: Any, page: Any) -> dict[str, Any]:
    """Return the voxel offsets along x, y, z as columns (NaN where the file states none), and the origin, mm."""
    shaped: dict[str, Any] = (file.shaped_metadata or ({},))[0] if file.is_shaped else {}
    if "spacing_mm" in shaped:
        axes = np.asarray(shaped.get("direction", np.eye(3)), dtype=float) * np.asarray(shaped["spacing_mm"], dtype=float)
        return {"steps": axes, "origin": shaped.get("origin_mm", (0.0, 0.0, 0.0)), "spacing": shaped["spacing_mm"]}
    if file.is_ome and (sizes := _ome_sizes(source, file.ome_metadata or "")):
        return _along_axes(np.array([sizes.get(axis, np.nan) for axis in "XYZ"]))
    imagej = file.imagej_metadata or {}
    named = str(imagej.get("unit", "")).replace("\\u00B5", "u")
    resolution_unit = {2: "inch", 3: "cm"}.get(int(getattr(page, "resolutionunit", 1) or 1))
    plane = unit_length(source, named) if named and named != "pixel" else (MM_PER_UNIT[resolution_unit] if resolution_unit else np.nan)
    step = np.full(3, np.nan)
    for axis, tag in ((0, "XResolution"), (1, "YResolution")):
        if tag in page.tags:
            numerator, denominator = page.tags[tag].value
            step[axis] = plane * denominator / numerator if numerator else np.nan
    if "spacing" in imagej:
        step[2] = plane * float(imagej["spacing"])
    return _along_axes(step)


def _along_axes(step: FloatArray) -> dict[str, Any]:
    return {"steps": np.where(np.eye(3, dtype=bool), np.diag(step), 0.0), "origin": (0.0, 0.0, 0.0), "spacing": step.tolist()}


def _ome_sizes(source: str, xml: str) -> dict[str, float]:
    """Return the size of a voxel along the axes (X, Y, Z) for which the OME metadata of the first image state one, mm."""
    pixels = _PIXELS.search(xml)
    stated = {name: html.unescape(value) for name, value in _ATTRIBUTE.findall(pixels.group(1))} if pixels else {}
    sizes = {}
    for axis in "XYZ":
        size = stated.get(f"PhysicalSize{axis}")
        unit = stated.get(f"PhysicalSize{axis}Unit", "µm")  # that of the schema
        if size is not None and unit not in ("pixel", "reference frame"):
            sizes[axis] = float(size) * unit_length(source, unit)
    return sizes
