"""A simulated motion as one self-contained page: a coloured surface that deforms, rigid bodies, force curves, one clock."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape

import numpy as np

from naibu.core.arrays import FloatArray, Int16Array, IntArray
from naibu.core.errors import InputError
from naibu.viewer.page_frame import asset, page_html
from naibu.viewer.tables import Table, provenance_section, table_html
from naibu.viewer.ticks import ticks_between

STEPS = 4000  # whole multiples from no displacement to the largest
LEVELS = 255  # of colours
POINTS_OF_A_CURVE = 600
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 420.0, 330.0, 66.0, 12.0, 14.0, 44.0
CURVES = 5  # colours of the style sheet


@dataclass(frozen=True, slots=True, eq=False)
class RigidShape:
    """A rigid body of the view.

    Attributes
    ----------
    name : str
        For the key of the curves.
    kind : str
        ``"box"``, ``"cylinder"``, ``"sphere"``, or ``"plane"``, which is not drawn: the grid stands for it.
    size : ndarray, shape (3,)
        Half edges of a box; radius and half length of a cylinder; radius of a sphere, mm.
    axes : ndarray, shape (3, 3)
        Rows are the body's axes, the third a cylinder's.
    """

    name: str
    kind: str
    size: FloatArray
    axes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ColourField:
    """Values that colours show.

    Attributes
    ----------
    name : str
        With its unit.
    values : ndarray, shape (s, n)
        Of the points in every frame.
    two_sided : bool
        Whether they may be more or less than zero, which then has a colour of its own.
    """

    name: str
    values: FloatArray
    two_sided: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MotionPage:
    """What the page shows.

    Attributes
    ----------
    title : str
        Heading.
    sentences : sequence of str
        Below it.
    times : ndarray, shape (s,)
        Of the frames, s.
    faces : ndarray, shape (f, 3), int
        Triangles of the surface.
    rest : ndarray, shape (n, 3)
        Points of the surface, mm.
    displacement : ndarray, shape (s, n, 3)
        mm.
    fields : sequence of ColourField
        The first one is shown first.
    bodies : sequence of RigidShape
        Indenters and floor.
    places : ndarray, shape (s, b, 3)
        Their centres, mm.
    force_times, force : ndarray, shape (k,) and (k, b, 3)
        Forces of the bodies on the object, mN, and when, s.
    tables : sequence of Table
        Below the view.
    provenance : mapping
        How it was computed.
    """

    title: str
    sentences: Sequence[str]
    times: FloatArray
    faces: IntArray
    rest: FloatArray
    displacement: FloatArray
    fields: Sequence[ColourField]
    bodies: Sequence[RigidShape]
    places: FloatArray
    force_times: FloatArray
    force: FloatArray
    tables: Sequence[Table] = ()
    provenance: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s, n, b = len(self.times), len(self.rest), len(self.bodies)
        shapes = {
            "rest": (self.rest, (n, 3)),
            "displacement": (self.displacement, (s, n, 3)),
            "places": (self.places, (s, b, 3)),
            "force": (self.force, (len(self.force_times), b, 3)),
            **{f.name: (f.values, (s, n)) for f in self.fields},
        }
        for name, (array, shape) in shapes.items():
            if np.shape(array) != shape:
                raise InputError(f"{self.title!r}: {name} must have the shape {shape}, not {np.shape(array)}")
        if not s or not self.fields:
            raise InputError(f"{self.title!r}: a motion needs at least one frame, and something for its colours to show")


def motion_html(page: MotionPage, max_bytes: int) -> str:
    """Return the page as text; every second frame is left out until it is small enough, the first and the last one never.

    Raises
    ------
    InputError
        Two frames alone are too large.
    """
    while True:
        text = _html(page)
        if len(text.encode()) <= max_bytes:
            return text
        if len(page.times) <= 2:
            raise InputError(
                f"a page of {len(page.rest)} surface points would have {len(text) / 1e6:.1f} MB, the limit is {max_bytes / 1e6:.1f} MB; "
                "look at the series in ParaView"
            )
        page = _thinned(page)


def _thinned(page: MotionPage) -> MotionPage:
    last = len(page.times) - 1
    kept = np.append(np.arange(0, last, 2), last)
    fields = [replace(f, values=f.values[kept]) for f in page.fields]
    return replace(page, times=page.times[kept], displacement=page.displacement[kept], fields=fields, places=page.places[kept])


def _html(page: MotionPage) -> str:
    data = json.dumps(_packed(page), separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    lead = "".join(f"<p>{escape(s)}</p>" for s in page.sentences)
    tables = "".join(table_html(t) for t in page.tables)
    curves = f'<div class="curves">{force_curves(page)}</div>' if len(page.force_times) and len(page.bodies) else ""
    provenance = provenance_section(page.provenance) if page.provenance else ""
    main = (
        '<section class="motion"><div id="naibu-motion"></div>'
        '<noscript><p class="no-3d">The 3-D view needs JavaScript; curves and tables are complete without it.</p></noscript>'
        f"{curves}</section>{f'<section>{tables}</section>' if tables else ''}{provenance}"
    )
    footer = "Lengths in mm, forces in mN. This page is self-contained: it loads nothing from the network."
    scripts = f'<script type="application/json" id="naibu-frames">{data}</script><script>{asset("report.js")}</script>'
    return page_html(page.title, lead, main, footer, scripts=scripts)


def _packed(page: MotionPage) -> dict[str, object]:
    """Return the frames as whole numbers; ``viewer-src/src/decode.js`` undoes it."""
    quantum = (float(np.abs(page.displacement).max(initial=0.0)) or 1.0) / STEPS
    whole = np.rint(page.displacement / quantum).astype(np.int16).reshape(len(page.times), -1)
    return {
        "times": [round(float(t), 6) for t in page.times],
        "faces": page.faces.ravel().tolist(),
        "rest": np.round(page.rest, 3).ravel().tolist(),
        "quantum": quantum,
        "displacement": _zipped(_differences(whole)),
        "fields": [_levels(f) for f in page.fields],
        "bodies": [
            {"name": b.name, "kind": b.kind, "size": b.size.tolist(), "axes": np.round(b.axes, 6).ravel().tolist()} for b in page.bodies
        ],
        "places": np.round(page.places.reshape(len(page.times), -1), 3).tolist(),
    }


def _differences(rows: Int16Array) -> bytes:
    """Return second differences down the rows, which are small as motions are smooth: all low bytes, then all high bytes."""
    out = rows.copy()
    out[1:] = rows[1:] - rows[:-1]  # wraps around, as the sums will
    second = out.copy()
    second[2:] = out[2:] - out[1:-1]
    pairs = second.astype("<i2").reshape(-1, 1).view(np.uint8)
    return np.ascontiguousarray(pairs.T).tobytes()


def _levels(colours: ColourField) -> dict[str, object]:
    low, high = float(colours.values.min()), float(colours.values.max())
    if colours.two_sided:
        high = max(-low, high)
        low = -high
    span = (high - low) or 1.0
    levels = np.rint((colours.values - low) / span * LEVELS).astype(np.uint8)
    return {"name": colours.name, "low": low, "high": low + span, "two_sided": colours.two_sided, "levels": _zipped(levels.tobytes())}


def _zipped(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, compresslevel=9, mtime=0)).decode("ascii")


def force_curves(page: MotionPage) -> str:
    """Return the force of every body over time as SVG, each along the axis in which it is strongest, with a mark that the page moves."""
    t, curves = page.force_times, [_strongest(page.force[:, k]) for k in range(len(page.bodies))]
    values = np.concatenate([v for v, _ in curves])
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    low, high = (low, high) if high > low else (0.0, 1.0)
    pad = 0.04 * (high - low)
    low, high = low - (pad if low < 0.0 else 0.0), high + pad
    end = float(page.times[-1]) or float(t[-1])

    def x(time: FloatArray | float) -> FloatArray:
        return np.asarray(LEFT + (WIDTH - LEFT - RIGHT) * np.asarray(time) / end)

    def y(force: FloatArray | float) -> FloatArray:
        return np.asarray(HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (np.asarray(force) - low) / (high - low))

    body = "".join(_tick_down(float(x(v)), v) for v in ticks_between(0.0, end, 6))
    body += "".join(_tick_across(float(y(v)), v) for v in ticks_between(low, high, 6))
    keys = ""
    for k, (shape, (force, axis)) in enumerate(zip(page.bodies, curves, strict=True)):
        a, b = _thin_curve(t, force)
        path = "M" + "L".join(f"{p:.1f} {q:.1f}" for p, q in zip(x(a), y(b), strict=True))
        body += f'<path d="{path}" class="curve c-{k % CURVES}"/>'
        line = f'<svg class="key" width="22" height="10" aria-hidden="true"><path d="M0 5h22" class="curve c-{k % CURVES}"/></svg>'
        keys += f"<li>{line} {escape(shape.name)}, along {axis}</li>"
    middle = 0.5 * (LEFT + WIDTH - RIGHT)
    body += f'<text x="{middle:.0f}" y="{HEIGHT - 8:.0f}" text-anchor="middle">time (s)</text>'
    up = 0.5 * (TOP + HEIGHT - BOTTOM)
    body += f'<text transform="translate(12 {up:.0f}) rotate(-90)" text-anchor="middle">force on the object (mN)</text>'
    body += (
        f'<g id="naibu-now" data-from="{LEFT:g}" data-to="{WIDTH - RIGHT:g}" transform="translate({LEFT:g} 0)">'
        f'<path d="M0 {TOP:g}V{HEIGHT - BOTTOM:g}" class="now"/></g>'
    )
    said = f"Forces of {', '.join(b.name for b in page.bodies)} on the object over time"
    svg = f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" aria-label="{escape(said)}">{body}</svg>'
    return f'<p class="fig-title">Forces on the object</p>{svg}<ul class="curve-key">{keys}</ul>'


def _strongest(force: FloatArray) -> tuple[FloatArray, str]:
    """Return the component (k,) along the axis and the way in which a force is strongest, and that way's name."""
    axis = int(np.argmax(np.abs(force).sum(axis=0)))
    sign = -1.0 if force[:, axis].sum() < 0.0 else 1.0
    return sign * force[:, axis], f"{'+' if sign > 0 else '−'}{'xyz'[axis]}"


def _thin_curve(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return at most about `POINTS_OF_A_CURVE` points, the extremes of every stretch among them."""
    if len(times) <= POINTS_OF_A_CURVE:
        return times, values
    kept = {0, len(times) - 1}
    for part in np.array_split(np.arange(len(times)), POINTS_OF_A_CURVE // 2):
        kept |= {int(part[np.argmin(values[part])]), int(part[np.argmax(values[part])])}
    order = np.array(sorted(kept))
    return times[order], values[order]


def _tick_down(x: float, value: float) -> str:
    line = f'<path d="M{x:.1f} {TOP:g}V{HEIGHT - BOTTOM:g}" class="grid"/>'
    return f'{line}<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 15:.0f}" text-anchor="middle" class="soft">{value:g}</text>'


def _tick_across(y: float, value: float) -> str:
    line = f'<path d="M{LEFT:g} {y:.1f}H{WIDTH - RIGHT:g}" class="{"zero" if value == 0.0 else "grid"}"/>'
    return f'{line}<text x="{LEFT - 7:g}" y="{y + 4:.1f}" text-anchor="end" class="soft">{f"{value:g}".replace("-", "−")}</text>'
