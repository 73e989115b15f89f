"""Figures of the result page as inline SVG, coloured by the style sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.viewer.result_page.payload import ResidualSet, Scene
from naibu.viewer.ticks import tick_text, ticks_between

PANEL_WIDTH, LEFT, RIGHT = 340.0, 44.0, 12.0
ROW_HEIGHT, TOP, BOTTOM = 30.0, 8.0, 40.0
AXES = ("x", "y", "z")


def short(value: float, digits: int = 1) -> str:
    """Return a short text of an SVG coordinate."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits else f"{value:.0f}"
    return "0" if text in ("-0", "") else text


def rms_bars(scenes: Sequence[Scene]) -> str:
    """Return bars of the RMS 3-D residual of every state, mm, with a tick at the RMS expected from noise alone."""
    rows = [(s, *_rms_3d(s)) for s in scenes]
    known = [v for _, rms, noise, _ in rows for v in (rms, noise) if math.isfinite(v)]
    if not known:
        return ""
    limit = 1.04 * max(known)
    items = "".join(_rms_row(scene, rms, noise, count, limit) for scene, rms, noise, count in rows)
    bar = '<svg class="key" width="18" height="12" aria-hidden="true"><rect width="18" height="12" rx="2" class="bar-fill"/></svg>'
    tick = '<svg class="key" width="6" height="14" aria-hidden="true"><path d="M3 0v14" class="tick-noise"/></svg>'
    key = f"{bar} RMS distance between predicted and measured markers (mm). {tick} RMS expected from measurement noise alone."
    return f'<ul class="rms">{items}</ul><p class="note">{key}</p>'


def _rms_3d(scene: Scene) -> tuple[float, float, int]:
    residual = scene.residual_mm
    whole = np.isfinite(residual).all(axis=1)
    if not whole.any():
        return math.nan, math.nan, 0
    rms = math.sqrt(float((residual[whole] ** 2).sum(axis=1).mean()))
    sd = scene.sd_mm[whole]
    noise = math.sqrt(3 * float(np.mean(sd[np.isfinite(sd)] ** 2))) if np.isfinite(sd).any() else math.nan
    return rms, noise, int(whole.sum())


def _rms_row(scene: Scene, rms: float, noise: float, count: int, limit: float) -> str:
    role = f' <span class="role">{escape(scene.role)}</span>' if scene.role else ""
    marks = ""
    if math.isfinite(rms):
        marks = f'<rect width="{100 * rms / limit:.1f}%" y="2" height="14" rx="2" class="bar-fill"/>'
    if math.isfinite(rms) and math.isfinite(noise):
        at = f"{100 * noise / limit:.1f}%"
        marks += f'<line x1="{at}" x2="{at}" y1="0" y2="18" class="tick-noise"/>'
    value = f"{rms:.2f} mm" if math.isfinite(rms) else "not measured"
    value += f' <span class="role">{count} markers</span>' if count else ""
    bar = f'<svg width="100%" height="18" aria-hidden="true">{marks}</svg>'
    label = f'<span class="label">{escape(scene.label)}{role}</span>'
    return f'<li>{label}<span class="track-cell">{bar}</span><span class="value">{value}</span></li>'


def residual_panels(residuals: ResidualSet) -> str:
    """Return three strip plots, one per axis: residual, mm, against marker layer, with a noise band of two standard deviations."""
    finite = np.abs(residuals.residual_mm[np.isfinite(residuals.residual_mm)])
    band = np.abs(residuals.sd_mm[np.isfinite(residuals.sd_mm)])
    if finite.size == 0:
        return ""
    limit = 1.05 * max(float(finite.max()), 2.2 * float(band.max()) if band.size else 0.0, 1e-6)
    panels = "".join(_panel(residuals, axis, limit) for axis in range(3))
    return f'<figure><p class="fig-title">{escape(residuals.title)}</p><div class="panels">{panels}</div></figure>'


def _panel(residuals: ResidualSet, axis: int, limit: float) -> str:
    layers = np.unique(residuals.layer)
    height = TOP + ROW_HEIGHT * len(layers) + BOTTOM
    values = residuals.residual_mm[:, axis]
    ok = np.isfinite(values)
    rms = math.sqrt(float(np.mean(values[ok] ** 2))) if ok.any() else math.nan
    body = _panel_axes(axis, rms, limit, len(layers))
    # the lowest layer of the object is drawn at the bottom
    for row, layer in enumerate(reversed(layers.tolist())):
        here = ok & (residuals.layer == layer)
        body += _layer_row(values[here], residuals.sd_mm[residuals.layer == layer], TOP + ROW_HEIGHT * (row + 0.5), limit, layer)
    name = AXES[axis]
    label = f"{residuals.title}: residual along {name} by marker layer, RMS {rms:.2f} mm"
    return f'<svg viewBox="0 0 {PANEL_WIDTH:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">{body}</svg>'


def _across(value: float, limit: float) -> float:
    return LEFT + (PANEL_WIDTH - LEFT - RIGHT) * (0.5 + 0.5 * value / limit)


def _panel_axes(axis: int, rms: float, limit: float, n_layers: int) -> str:
    bottom = TOP + ROW_HEIGHT * n_layers
    middle = 0.5 * (LEFT + PANEL_WIDTH - RIGHT)
    out = ""
    for tick in ticks_between(-limit, limit, 6):
        x = short(_across(tick, limit))
        out += f'<path d="M{x} {TOP:.0f}V{bottom:.0f}" class="{"zero" if abs(tick) < 1e-12 else "grid"}"/>'
        out += f'<text x="{x}" y="{bottom + 14:.0f}" text-anchor="middle" class="soft">{tick_text(tick)}</text>'
    out += f'<text x="{middle:.0f}" y="{bottom + 31:.0f}" text-anchor="middle">{AXES[axis]} residual (mm), RMS {rms:.2f}</text>'
    up = 0.5 * (TOP + bottom)
    return out + f'<text transform="translate(12 {up:.0f}) rotate(-90)" text-anchor="middle">marker layer</text>'


def _layer_row(values: FloatArray, sd: FloatArray, y: float, limit: float, layer: int) -> str:
    known = sd[np.isfinite(sd)]
    half = 0.5 * ROW_HEIGHT - 2
    out = f'<text x="{LEFT - 8:.0f}" y="{y + 4:.0f}" text-anchor="end">{layer + 1}</text>'
    if known.size:
        two_sd = min(2 * float(np.median(known)), limit)
        left, right = _across(-two_sd, limit), _across(two_sd, limit)
        out = f'<rect x="{left:.1f}" y="{y - half:.1f}" width="{right - left:.1f}" height="{2 * half:.1f}" class="band"/>' + out
    if values.size == 0:
        return out
    dots = "".join(f"M{short(x)} {short(v)}h0" for x, v in zip(*_spread(values, y, limit), strict=True))
    middle = short(_across(float(np.median(values)), limit))
    return out + f'<path d="{dots}" class="dots"/><path d="M{middle} {y - half + 1:.1f}V{y + half - 1:.1f}" class="median"/>'


def _spread(values: FloatArray, y: float, limit: float) -> tuple[list[float], list[float]]:
    """Return positions of the dots, offset vertically in a fixed pattern so that equal values stay visible."""
    order: IntArray = np.argsort(values, kind="stable")
    heights = np.empty(len(values))
    heights[order] = np.array([0.0, 4.5, -4.5, 8.5, -8.5])[np.arange(len(values)) % 5]
    return [_across(v, limit) for v in values.tolist()], (y + heights).tolist()
