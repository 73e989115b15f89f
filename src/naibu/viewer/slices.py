"""A pair of volumes and the displacement between them as a page of slices, with arrows, strain and uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from naibu.core.arrays import AnyFloatArray
from naibu.core.errors import InputError
from naibu.viewer.cards import Card, cards_html
from naibu.viewer.embedding import embedded_bytes, embedded_json
from naibu.viewer.page_frame import filled_template
from naibu.viewer.tables import Table, table_html

GREY_LEVELS = 255
LEVELS = 254  # of an overlay; 255 means undefined
FEW_VOXELS = 1_500_000
ENDS = ("RL", "AP", "IS")
FRAME = (
    "Positions and displacements are in the frame of the scan, as in the tables: x to the left (L), y to the back (P), z upwards (S) of a "
    "patient who lies in the scanner. The letters at the edges name the nearest of these directions."
)


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """A scalar field shown as colours over the image.

    Attributes
    ----------
    name : str
        Quantity with its unit, ``"displacement, mm"``.
    values : ndarray, shape (nz, ny, nx)
        Values on the voxel grid; NaN where undefined.
    middle : float, optional
        Centre of a diverging colour map; by default a sequential map from the smallest to the largest value.
    """

    name: str
    values: AnyFloatArray
    middle: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SliceView:
    """The content of the page.

    Attributes
    ----------
    title : str
        Heading.
    sentences : sequence of str
        Paragraphs below the heading.
    spacing_mm : ndarray, shape (3,)
        Voxel spacing along x, y, z, mm.
    images : sequence of (str, ndarray of shape (nz, ny, nx))
        Names and intensities on one grid, shown on one intensity scale: reference, deformed, deformed warped back.
    displacement : ndarray, shape (nz, ny, nx, 3)
        Displacement along the axes of the grid, mm; NaN where undefined.
    overlays : sequence of Overlay
        Fields to choose from.
    tables : sequence of Table
        Tables below the slices.
    origin_mm : array_like, shape (3,), optional
        Position of the first voxel along the axes of the grid, mm.
    difference : tuple of (str, int, int), optional
        Further images to choose from, as differences: name, and the numbers of two images.
    direction : array_like, shape (3, 3)
        Axes of the grid in the frame of the scan, in columns: values are read in that frame.
    cards : sequence of Card
        What to know first.
    details : sequence of str
        Paragraphs below the tables, folded.
    """

    title: str
    sentences: Sequence[str]
    spacing_mm: AnyFloatArray
    images: Sequence[tuple[str, AnyFloatArray]]
    displacement: AnyFloatArray
    overlays: Sequence[Overlay]
    tables: Sequence[Table] = ()
    origin_mm: AnyFloatArray | Sequence[float] = (0.0, 0.0, 0.0)
    difference: tuple[tuple[str, int, int], ...] = ()
    direction: AnyFloatArray | Sequence[Sequence[float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    cards: Sequence[Card] = ()
    details: Sequence[str] = ()


def slices_html(view: SliceView) -> str:
    """Return the page as text; large volumes are subsampled to every second, third, ... voxel.

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
        "first": [float(o + d * (k // 2)) for o, d, k in zip(view.origin_mm, view.spacing_mm, every, strict=True)],
        "images": _images([(name, v[steps]) for name, v in view.images]),
        "difference": [[name, a, b] for name, a, b in view.difference],
        "overlays": [_overlay(o, o.values[steps]) for o in view.overlays],
        "arrows": _arrows(view.displacement[steps]),
        "direction": np.asarray(view.direction, dtype=float).tolist(),
        "letters": _letters(np.asarray(view.direction, dtype=float)),
    }
    lead = "".join(f"<p{' class=lead' if i == 0 else ''}>{escape(s)}</p>" for i, s in enumerate(view.sentences))
    words = f"{cards_html(view.cards)}{lead}"
    tables = "".join(table_html(t) for t in view.tables)
    if view.details:
        tables += f"<details><summary>Details</summary>{''.join(f'<p>{escape(s)}</p>' for s in view.details)}</details>"
    return filled_template(
        "slices.html", {"TITLE": escape(view.title), "WORDS": words, "TABLES": tables, "FRAME": FRAME, "DATA": embedded_json(payload)}
    )


def _letters(direction: AnyFloatArray) -> list[list[str]]:
    """Return for each axis of the grid the letters of its beginning and its end, in a frame whose axes point to L, P and S."""
    main = np.argmax(np.abs(direction), axis=0)
    return [list(ENDS[k] if direction[k, axis] >= 0.0 else ENDS[k][::-1]) for axis, k in enumerate(main)]


def _stride(shape: tuple[int, ...], spacing: AnyFloatArray) -> list[int]:
    """Return the subsampling factors along x, y, z; the finest axis is subsampled first."""
    size, every = np.array(shape[::-1]), np.ones(3, dtype=int)
    while np.prod(-(-size // every)) > FEW_VOXELS:
        every[np.argmin(np.where(size // every > 1, spacing * every, np.inf))] += 1
    return [int(k) for k in every]


def _images(images: Sequence[tuple[str, AnyFloatArray]]) -> list[dict[str, object]]:
    """Return the images on the intensity scale of the first; undefined voxels are black."""
    known = images[0][1][np.isfinite(images[0][1])]
    low, high = (float(q) for q in np.percentile(known, (0.2, 99.8)))
    span = high - low or 1.0
    return [
        {"name": name, "low": low, "high": high, "data": _packed(np.clip((np.nan_to_num(v, nan=low) - low) / span, 0.0, 1.0) * GREY_LEVELS)}
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
    """Return displacements as integer multiples of a length; -32768 where undefined."""
    known = np.asarray(np.isfinite(displacement).all(axis=-1))
    largest = float(np.abs(displacement[known]).max()) if known.any() else 1.0
    quantum = (largest or 1.0) / 32000.0
    whole = np.where(known[..., None], np.round(np.nan_to_num(displacement) / quantum), -32768).astype("<i2")
    return {"quantum": quantum, "data": embedded_bytes(np.ascontiguousarray(whole).tobytes(), level=6)}


def _packed(values: AnyFloatArray) -> str:
    return embedded_bytes(np.ascontiguousarray(np.round(values).astype(np.uint8)).tobytes(), level=6)
