"""Parameter estimates as HTML: table of confidence intervals, and correlation matrix (colours after :cite:t:`ottosson2020`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.viewer.cards import Card
from naibu.viewer.result_page.payload import Correlation, ParameterRow
from naibu.viewer.tables import cell_text, scrollable
from naibu.viewer.ticks import tick_text, ticks_between

NEGATIVE, NEUTRAL, POSITIVE = (0.45, -0.05, -0.11), (0.965, 0.0, 0.0), (0.50, 0.11, 0.09)
LOG_SPAN = 30.0


class _Scale:
    """Horizontal scale of an interval plot, per cent of its width; logarithmic where values differ by more than `LOG_SPAN`."""

    def __init__(self, rows: Sequence[ParameterRow]) -> None:
        ends = [v for r in rows for v in (r.estimate, r.lower, r.upper) if math.isfinite(v)] or [0.0, 1.0]
        low, high = min(ends), max(ends)
        self.log = low > 0 and high / low > LOG_SPAN
        if self.log:
            self.low, self.high = math.floor(math.log10(low) * 3) / 3, math.ceil(math.log10(high) * 3) / 3
            return
        pad = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
        self.low = 0.0 if low >= 0 and low < 0.6 * high else low - pad
        self.high = high + pad

    def percent(self, value: float) -> float:
        at = math.log10(max(value, 1e-300)) if self.log else value
        return min(100.0, max(0.0, 100 * (at - self.low) / (self.high - self.low)))

    def ticks(self) -> list[float]:
        if not self.log:
            return ticks_between(self.low, self.high, 4)
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        few = (1,) if len(decades) > 4 else (1, 3)
        return [m * 10.0**d for d in decades for m in few if self.low - 1e-9 <= math.log10(m * 10.0**d) <= self.high + 1e-9]


def parameter_table(rows: Sequence[ParameterRow]) -> str:
    """Return the table of estimates with 95 % confidence intervals, in numbers and drawn; parameters of one unit have a common scale."""
    units = list(dict.fromkeys(r.unit for r in rows))
    body = ""
    for unit in units:
        group = [r for r in rows if r.unit == unit]
        scale = _Scale(group)
        body += _unit_row(unit, scale) + "".join(_parameter_row(r, scale) for r in group)
    columns = '<colgroup><col class="c-name"><col class="c-value"><col class="c-plot"><col></colgroup>'
    head = "".join(f'<th scope="col">{t}</th>' for t in ("Parameter", "Estimate [95 % interval]", "Interval (one scale per unit)", "Note"))
    inner = f'<table class="params">{columns}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return scrollable("Parameters", inner, "wide-params")


def parameter_cards(rows: Sequence[ParameterRow]) -> tuple[Card, ...]:
    """Return what was estimated as cards: value, and the 95 % interval, or why there is none."""
    return tuple(_card(row) for row in rows)


def _card(row: ParameterRow) -> Card:
    width = row.upper - row.lower
    value = f"{_plain(row.estimate, width)} {row.unit}".rstrip()
    low, high = (math.isfinite(v) for v in (row.lower, row.upper))
    if row.note or not (low or high):
        return Card(row.label, value, row.note or "not bounded by the data")
    if not (low and high):  # the estimate is no more likely than what lies on the open side
        bound = f"at least {row.lower:.3g}" if low else f"at most {row.upper:.3g}"
        return Card(row.label, f"{bound} {row.unit}".rstrip(), "; ".join(filter(None, ("95 %", row.beside))))
    interval = f"{_plain(row.lower, width)} to {_plain(row.upper, width)}"
    return Card(row.label, value, f"95 %: {interval}{f'; {row.beside}' * bool(row.beside)}")


def _plain(value: float, width: float) -> str:
    text = text_to_width(value, width)
    return f"{value:.3g}" if "<" in text else text


def _unit_row(unit: str, scale: _Scale) -> str:
    marks = ""
    for tick in scale.ticks():
        at = f"{scale.percent(tick):.1f}%"
        marks += f'<text x="{at}" y="11" text-anchor="middle" class="soft">{tick_text(tick)}</text>'
        marks += f'<line x1="{at}" x2="{at}" y1="15" y2="20" class="zero"/>'
    name = f"In {escape(unit)}" if unit else "Without unit"
    kind = ", logarithmic scale" if scale.log else ""
    svg = f'<svg width="100%" height="20" aria-hidden="true">{marks}</svg>'
    return f'<tr class="unit-row"><th scope="rowgroup">{name}{kind}</th><td></td><td class="plot">{svg}</td><td></td></tr>'


def _parameter_row(row: ParameterRow, scale: _Scale) -> str:
    width = row.upper - row.lower
    low, high = (text_to_width(v, width) if math.isfinite(v) else "?" for v in (row.lower, row.upper))
    unit = f" {escape(row.unit)}" if row.unit else ""
    value = f"<strong>{text_to_width(row.estimate, width)}</strong> [{low}, {high}]{unit}"
    name = escape(row.label) if row.label == row.name else f"{escape(row.label)} <code>{escape(row.name)}</code>"
    svg = f'<svg width="100%" height="20" aria-hidden="true">{_interval(row, scale)}</svg>'
    return f'<tr><th scope="row">{name}</th><td>{value}</td><td class="plot">{svg}</td><td>{escape(row.remarks)}</td></tr>'


def text_to_width(value: float, width: float) -> str:
    """Return a value with the decimals of two significant digits of its interval's width.

    Parameters
    ----------
    value, width : float
        Value, and width of its interval, in one unit.
    """
    if not (math.isfinite(value) and math.isfinite(width) and width > 0) or not 1e-3 <= abs(value) < 1e5:
        return cell_text(value)
    digits = min(6, max(0, 1 - math.floor(math.log10(width))))
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")  # a zero has no sign


def _interval(row: ParameterRow, scale: _Scale) -> str:
    left = scale.percent(row.lower) if math.isfinite(row.lower) else 0.0
    right = scale.percent(row.upper) if math.isfinite(row.upper) else 100.0
    out = '<line x1="0%" x2="100%" y1="10" y2="10" class="track"/>'
    out += f'<line x1="{left:.1f}%" x2="{right:.1f}%" y1="10" y2="10" class="interval"/>'
    for open_end, at, sign in ((not math.isfinite(row.lower), "0%", -1), (not math.isfinite(row.upper), "100%", 1)):
        if open_end:
            out += f'<svg x="{at}" overflow="visible"><path d="M0 4 {9 * sign} 10 0 16Z" class="interval-open"/></svg>'
        else:
            end = f"{left if sign < 0 else right:.1f}%"
            out += f'<line x1="{end}" x2="{end}" y1="5" y2="15" class="interval"/>'
    if math.isfinite(row.estimate):
        out += f'<circle cx="{scale.percent(row.estimate):.1f}%" cy="10" r="4.5" class="estimate"/>'
    return out


def diverging_colour(value: float) -> tuple[str, str]:
    """Return background and text colour of a correlation: blue for -1, pale for 0, brown-red for 1, uniform in OKLab."""
    end = POSITIVE if value >= 0 else NEGATIVE
    t = min(1.0, abs(value))
    linear = _linear_rgb(*(a + t * (b - a) for a, b in zip(NEUTRAL, end, strict=True)))
    luminance = float(linear @ np.array([0.2126, 0.7152, 0.0722]))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    ground = "#" + "".join(f"{round(255 * c):02x}" for c in srgb.tolist())
    return ground, "#ffffff" if luminance < 0.179 else "#000000"


def _linear_rgb(lightness: float, a: float, b: float) -> FloatArray:
    """Return linear sRGB of an OKLab colour, clipped to the gamut."""
    cones = np.array(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ]
    )
    to_rgb = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    return np.asarray(np.clip(to_rgb @ cones**3, 0.0, 1.0))


def correlation_table(correlation: Correlation) -> str:
    """Return the correlation matrix as a heat map with values; columns are numbered like the rows."""
    names, matrix = correlation.names, np.asarray(correlation.matrix, dtype=np.float64)
    head = '<th scope="col"><span class="name">Parameter</span></th>' + "".join(
        f'<th scope="col" title="{escape(n, quote=True)}">{i}</th>' for i, n in enumerate(names, 1)
    )
    body = ""
    for i, (name, row) in enumerate(zip(names, matrix, strict=True), 1):
        label = f'<span class="number">{i}</span> <span class="name">{escape(name)}</span>'
        body += f'<tr><th scope="row">{label}</th>{"".join(_correlation_cell(v) for v in row.tolist())}</tr>'
    inner = f'<table class="corr"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    stops = ", ".join(diverging_colour(v)[0] for v in np.linspace(-1, 1, 21).tolist())
    ramp = f'<span class="ramp" style="background:linear-gradient(to right, {stops})"></span>'
    key = f'<div class="corr-key"><span>−1</span>{ramp}<span>1</span></div>'
    # On a phone the rows show numbers only, and this list their names.
    listed = f'<ol class="corr-names">{"".join(f"<li>{escape(n)}</li>" for n in names)}</ol>'
    return key + scrollable("Correlation of the parameters", inner) + listed


def _correlation_cell(value: float) -> str:
    if not math.isfinite(value):
        return "<td>–</td>"
    ground, ink = diverging_colour(value)
    return f'<td style="background:{ground};color:{ink}">{f"{value:.2f}".replace("-", "−")}</td>'
