"""Simulated motion as a self-contained page: a coloured deforming surface, rigid indenters and force curves over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape

import numpy as np

from naibu.core.arrays import FloatArray, Int16Array, IntArray, require_shape
from naibu.core.errors import InputError
from naibu.viewer.cards import Card, cards_html
from naibu.viewer.embedding import embedded_bytes, embedded_json
from naibu.viewer.page_frame import page_html
from naibu.viewer.tables import Table, provenance_section, table_html
from naibu.viewer.ticks import ticks_between

STEPS = 4000  # quantisation levels from zero to the largest displacement
LEVELS = 255  # quantisation levels of the colours
SMALLEST_IN_NEWTON = 500.0  # mN
POINTS_OF_A_CURVE = 600
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 420.0, 330.0, 66.0, 12.0, 14.0, 44.0
CURVES = 5  # curve colours in the style sheet


@dataclass(frozen=True, slots=True, eq=False)
class RigidShape:
    """A rigid indenter or floor in the 3-D view.

    Attributes
    ----------
    name : str
        Name in the legend of the force curves.
    kind : str
        ``"box"``, ``"cylinder"``, ``"sphere"``, or ``"plane"``, which is not drawn because the grid represents it.
    size : ndarray, shape (3,)
        Half edge lengths of a box; radius and half length of a cylinder; radius of a sphere; mm.
    axes : ndarray, shape (3, 3)
        Rows are the axes of the body; the third is the axis of a cylinder.
    """

    name: str
    kind: str
    size: FloatArray
    axes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ColourField:
    """A scalar field shown as colours.

    Attributes
    ----------
    name : str
        Quantity with its unit.
    values : ndarray, shape (s, n)
        Values at the points in every frame.
    diverging : bool
        Whether to use a diverging colour map centred on zero.
    """

    name: str
    values: FloatArray
    diverging: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MotionPage:
    """The content of the page.

    Attributes
    ----------
    title : str
        Heading.
    sentences : sequence of str
        Paragraphs below the heading.
    times : ndarray, shape (s,)
        Times of the frames, s.
    faces : ndarray, shape (f, 3), int
        Triangles of the surface, point numbers.
    reference : ndarray, shape (n, 3)
        Points of the surface in the reference configuration, mm.
    displacement : ndarray, shape (s, n, 3)
        Displacement of the points in every frame, mm.
    fields : sequence of ColourField
        Fields to choose from; the first one is shown initially.
    bodies : sequence of RigidShape
        Indenters and floor.
    positions : ndarray, shape (s, b, 3)
        Centres of the bodies in every frame, mm.
    force_times, force : ndarray, shape (k,) and (k, b, 3)
        Times, s, and forces of the bodies on the object, mN.
    tables : sequence of Table
        Tables below the view.
    provenance : mapping
        How the motion was computed.
    cards : sequence of Card
        What to know first.
    clock : (str, str)
        What `times` are, and their unit: another quantity that grows, such as a travel in mm, for motions without inertia.
    """

    title: str
    sentences: Sequence[str]
    times: FloatArray
    faces: IntArray
    reference: FloatArray
    displacement: FloatArray
    fields: Sequence[ColourField]
    bodies: Sequence[RigidShape]
    positions: FloatArray
    force_times: FloatArray
    force: FloatArray
    tables: Sequence[Table] = ()
    provenance: Mapping[str, object] = field(default_factory=dict)
    cards: Sequence[Card] = ()
    clock: tuple[str, str] = ("time", "s")

    def __post_init__(self) -> None:
        s, n, b = len(self.times), len(self.reference), len(self.bodies)
        shapes = {
            "reference": (self.reference, (n, 3)),
            "displacement": (self.displacement, (s, n, 3)),
            "positions": (self.positions, (s, b, 3)),
            "force": (self.force, (len(self.force_times), b, 3)),
            **{f.name: (f.values, (s, n)) for f in self.fields},
        }
        for name, (array, shape) in shapes.items():
            require_shape(f"{self.title!r}: {name}", array, shape)
        if not s or not self.fields:
            raise InputError(f"{self.title!r}: a motion needs at least one frame and at least one field")


def motion_html(page: MotionPage, max_bytes: int) -> str:
    """Return the page as text; every second frame is dropped, except the first and the last, until the page is small enough.

    Raises
    ------
    InputError
        The page is too large even with two frames.
    """
    while True:
        text = _html(page)
        if len(text.encode()) <= max_bytes:
            return text
        if len(page.times) <= 2:
            raise InputError(
                f"the page of {len(page.reference)} surface points has {len(text) / 1e6:.1f} MB, the limit is {max_bytes / 1e6:.1f} MB; "
                "open the series in ParaView instead"
            )
        page = _thinned(page)


def _thinned(page: MotionPage) -> MotionPage:
    last = len(page.times) - 1
    kept = np.append(np.arange(0, last, 2), last)
    fields = [replace(f, values=f.values[kept]) for f in page.fields]
    return replace(page, times=page.times[kept], displacement=page.displacement[kept], fields=fields, positions=page.positions[kept])


def _html(page: MotionPage) -> str:
    data = embedded_json(_packed(page))
    lead = cards_html(page.cards) + "".join(f"<p>{escape(s)}</p>" for s in page.sentences)
    tables = "".join(table_html(t) for t in page.tables)
    curves = f'<div class="curves">{force_curves(page)}</div>' if len(page.force_times) and len(page.bodies) else ""
    provenance = provenance_section(page.provenance) if page.provenance else ""
    main = (
        '<section class="motion"><div id="naibu-motion"></div>'
        '<noscript><p class="no-3d">The 3-D view needs JavaScript; curves and tables are complete without it.</p></noscript>'
        f"{curves}</section>{f'<section>{tables}</section>' if tables else ''}{provenance}"
    )
    forces = ", forces in mN or N, as stated at the curves" if curves else ""
    footer = f"Lengths in mm{forces}. This page is self-contained: it loads nothing from the network."
    frames = f'<script type="application/json" id="naibu-frames">{data}</script>'
    return page_html(page.title, lead, main, footer, data=frames, script="report.js")


def _packed(page: MotionPage) -> dict[str, object]:
    """Return the frames as integers; ``viewer-src/src/decode.js`` is the inverse."""
    quantum = (float(np.abs(page.displacement).max(initial=0.0)) or 1.0) / STEPS
    whole = np.rint(page.displacement / quantum).astype(np.int16).reshape(len(page.times), -1)
    return {
        "times": [round(float(t), 6) for t in page.times],
        "clock": page.clock,
        "faces": page.faces.ravel().tolist(),
        "reference": np.round(page.reference, 3).ravel().tolist(),
        "quantum": quantum,
        "displacement": embedded_bytes(_differences(whole)),
        "fields": [_levels(f) for f in page.fields],
        "bodies": [
            {"name": b.name, "kind": b.kind, "size": b.size.tolist(), "axes": np.round(b.axes, 6).ravel().tolist()} for b in page.bodies
        ],
        "positions": np.round(page.positions.reshape(len(page.times), -1), 3).tolist(),
    }


def _differences(rows: Int16Array) -> bytes:
    """Return second differences along the rows, small for smooth motions: all low bytes, then all high bytes."""
    out = rows.copy()
    out[1:] = rows[1:] - rows[:-1]  # overflow wraps around, and so do the sums
    second = out.copy()
    second[2:] = out[2:] - out[1:-1]
    pairs = second.astype("<i2").reshape(-1, 1).view(np.uint8)
    return np.ascontiguousarray(pairs.T).tobytes()


def _levels(colours: ColourField) -> dict[str, object]:
    low, high = float(colours.values.min()), float(colours.values.max())
    if colours.diverging:
        high = max(-low, high)
        low = -high
    span = (high - low) or 1.0
    levels = np.rint((colours.values - low) / span * LEVELS).astype(np.uint8)
    shown = {"name": colours.name, "low": low, "high": low + span, "diverging": colours.diverging}
    return shown | {"levels": embedded_bytes(levels.tobytes())}


def force_curves(page: MotionPage) -> str:
    """Return the force-time curve of every body as SVG, along the axis of its largest force, with a time marker that the page moves."""
    unit, factor = force_unit(float(np.abs(page.force).max(initial=0.0)))
    t, curves = page.force_times, [_strongest(factor * page.force[:, k]) for k in range(len(page.bodies))]
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
    body += f'<text x="{middle:.0f}" y="{HEIGHT - 8:.0f}" text-anchor="middle">{escape(page.clock[0])} ({page.clock[1]})</text>'
    up = 0.5 * (TOP + HEIGHT - BOTTOM)
    body += f'<text transform="translate(12 {up:.0f}) rotate(-90)" text-anchor="middle">force on the object ({unit})</text>'
    body += (
        f'<g id="naibu-now" data-from="{LEFT:g}" data-to="{WIDTH - RIGHT:g}" transform="translate({LEFT:g} 0)">'
        f'<path d="M0 {TOP:g}V{HEIGHT - BOTTOM:g}" class="now"/></g>'
    )
    label = f"Forces of {', '.join(b.name for b in page.bodies)} on the object over {page.clock[0]}"
    svg = f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" aria-label="{escape(label)}">{body}</svg>'
    return f'<p class="fig-title">Forces on the object</p>{svg}<ul class="curve-key">{keys}</ul>'


def force_unit(largest: float) -> tuple[str, float]:
    """Return the unit in which forces up to `largest`, mN, are read most easily, and the factor from mN."""
    return ("N", 1e-3) if largest >= SMALLEST_IN_NEWTON else ("mN", 1.0)


def _strongest(force: FloatArray) -> tuple[FloatArray, str]:
    """Return the component (k,) along the signed axis of the largest force, and the name of that axis."""
    axis = int(np.argmax(np.abs(force).sum(axis=0)))
    sign = -1.0 if force[:, axis].sum() < 0.0 else 1.0
    return sign * force[:, axis], f"{'+' if sign > 0 else '−'}{'xyz'[axis]}"


def _thin_curve(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return at most about `POINTS_OF_A_CURVE` points, including the extremes of every interval."""
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
