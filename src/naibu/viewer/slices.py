"""A pair of volumes and the displacement between them as one page: slices along three axes, arrows, strain, uncertainty."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

import numpy as np

from naibu.core.arrays import AnyFloatArray
from naibu.core.errors import InputError
from naibu.viewer.tables import Table, table_html

GREYS = 255
LEVELS = 254  # of an overlay; 255 says that nothing is known
FEW_VOXELS = 1_500_000


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """Values that colours show.

    Attributes
    ----------
    name : str
        With its unit, ``"displacement, mm"``.
    values : ndarray, shape (nz, ny, nx)
        NaN where nothing is known.
    middle : float, optional
        Value that two colours meet at, for what may be more or less than that; by default one scale from the least to the most.
    """

    name: str
    values: AnyFloatArray
    middle: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SliceView:
    """What the page shows.

    Attributes
    ----------
    title : str
        Heading.
    sentences : sequence of str
        What was found, in words.
    spacing_mm : ndarray, shape (3,)
        Distance of voxels along x, y, z, mm.
    images : sequence of (str, ndarray of shape (nz, ny, nx))
        Grey volumes on one grid, on one grey scale: before, after, after carried back.
    displacement : ndarray, shape (nz, ny, nx, 3)
        Along the axes of the grid, mm; NaN where there is none.
    overlays : sequence of Overlay
        What colours may show.
    tables : sequence of Table
        Below the slices.
    difference : tuple of (str, int, int), optional
        Differences that are offered too: a name, and the numbers of two images.
    """

    title: str
    sentences: Sequence[str]
    spacing_mm: AnyFloatArray
    images: Sequence[tuple[str, AnyFloatArray]]
    displacement: AnyFloatArray
    overlays: Sequence[Overlay]
    tables: Sequence[Table] = ()
    difference: tuple[tuple[str, int, int], ...] = ()


def slices_html(view: SliceView) -> str:
    """Return the page; volumes of more voxels than a page should carry are shown at every second, third, ... voxel.

    Raises
    ------
    InputError
        No image, or arrays on different grids.
    """
    if not view.images:
        raise InputError("a page of slices needs at least one image")
    shape = view.images[0][1].shape
    for name, values in [*view.images, *((o.name, o.values) for o in view.overlays), ("displacement", view.displacement[..., 0])]:
        if values.shape != shape:
            raise InputError(f"{name!r} has shape {values.shape}, the first image {shape}; all must lie on one grid")
    every = _stride(shape, np.asarray(view.spacing_mm, dtype=float))
    steps = tuple(slice(k // 2, None, k) for k in every[::-1])
    payload = {
        "size": [len(range(s.start, n, s.step)) for s, n in zip(steps, shape, strict=True)][::-1],
        "spacing": [float(d * k) for d, k in zip(view.spacing_mm, every, strict=True)],
        "first": [float(d * (k // 2)) for d, k in zip(view.spacing_mm, every, strict=True)],
        "images": _images([(name, v[steps]) for name, v in view.images]),
        "difference": [[name, a, b] for name, a, b in view.difference],
        "overlays": [_overlay(o, o.values[steps]) for o in view.overlays],
        "arrows": _arrows(view.displacement[steps]),
    }
    template = (files("naibu.viewer") / "assets" / "slices.html").read_text(encoding="utf-8")
    data = json.dumps(payload, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    words = "".join(f"<p>{escape(s)}</p>" for s in view.sentences)
    tables = "".join(table_html(t) for t in view.tables)
    return template.replace("$TITLE", escape(view.title)).replace("$WORDS", words).replace("$TABLES", tables).replace("$DATA", data)


def _stride(shape: tuple[int, ...], spacing: AnyFloatArray) -> list[int]:
    """Every how many voxels along x, y, z: finer axes are thinned first."""
    size, every = np.array(shape[::-1]), np.ones(3, dtype=int)
    while np.prod(-(-size // every)) > FEW_VOXELS:
        every[np.argmin(np.where(size // every > 1, spacing * every, np.inf))] += 1
    return [int(k) for k in every]


def _images(images: Sequence[tuple[str, AnyFloatArray]]) -> list[dict[str, object]]:
    """On the grey scale of the first one; what is not known is black."""
    known = images[0][1][np.isfinite(images[0][1])]
    low, high = (float(q) for q in np.percentile(known, (0.2, 99.8)))
    span = high - low or 1.0
    return [
        {"name": name, "low": low, "high": high, "data": _packed(np.clip((np.nan_to_num(v, nan=low) - low) / span, 0.0, 1.0) * GREYS)}
        for name, v in images
    ]


def _overlay(overlay: Overlay, values: AnyFloatArray) -> dict[str, object]:
    known = np.asarray(np.isfinite(values))
    low, high = (float(q) for q in np.percentile(values[known], (0.5, 99.5))) if known.any() else (0.0, 1.0)
    if overlay.middle is not None:
        reach = max(high - overlay.middle, overlay.middle - low) or 1.0
        low, high = overlay.middle - reach, overlay.middle + reach
    elif 0.0 < low < 0.5 * high:
        low = 0.0
    span = high - low or 1.0
    levels = np.where(known, np.clip((np.nan_to_num(values) - low) / span, 0.0, 1.0) * LEVELS, LEVELS + 1)
    return {"name": overlay.name, "low": low, "high": low + span, "diverging": overlay.middle is not None, "data": _packed(levels)}


def _arrows(displacement: AnyFloatArray) -> dict[str, object]:
    """Whole multiples of a length; -32768 where nothing is known."""
    known = np.asarray(np.isfinite(displacement).all(axis=-1))
    largest = float(np.abs(displacement[known]).max()) if known.any() else 1.0
    quantum = (largest or 1.0) / 32000.0
    whole = np.where(known[..., None], np.round(np.nan_to_num(displacement) / quantum), -32768).astype("<i2")
    return {"quantum": quantum, "data": _zipped(np.ascontiguousarray(whole).tobytes())}


def _packed(values: AnyFloatArray) -> str:
    return _zipped(np.ascontiguousarray(np.round(values).astype(np.uint8)).tobytes())


def _zipped(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, compresslevel=6, mtime=0)).decode("ascii")
