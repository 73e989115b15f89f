"""Tick positions and tick labels of SVG axes."""

from __future__ import annotations

import math


def nice_step(span: float, at_most: int) -> float:
    """Return the smallest 1, 2, 2.5 or 5 times a power of ten that divides `span` into at most `at_most` parts."""
    if not span > 0:
        return 1.0
    raw = span / at_most
    power = 10.0 ** math.floor(math.log10(raw))
    return next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw * (1 - 1e-9))


def ticks_between(low: float, high: float, at_most: int = 5) -> list[float]:
    """Return round numbers from `low` to `high`."""
    step = nice_step(high - low, at_most)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def tick_text(value: float) -> str:
    """Return the label of a tick, with a true minus sign."""
    return f"{0.0 if abs(value) < 1e-12 else value:.4g}".replace("-", "−")
