"""What decoded readings tell of drag and slip: words, a card and a section of the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.fingertip.slip import SLIPS_FROM, SidewaysForces
from naibu.core.arrays import FloatArray, IntArray
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_MOST_DRAWN = 1500


def drawn_rows(count: int) -> IntArray:
    """Return which of the readings figures show: all, or so many that a browser draws them at ease."""
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_DRAWN)).round().astype(np.int64))


def slip_words(sideways: SidewaysForces, friction: float | None) -> list[str]:
    """Return ``sticks``, ``may slide`` or ``slides`` for every reading; empty without a contact or a friction coefficient."""
    if friction is None:
        return [""] * len(sideways.contact)
    slides, may = sideways.slides(friction), sideways.may_slide(friction)
    words = np.where(slides, "slides", np.where(may, "may slide", "sticks"))
    return [str(word) for word in np.where(sideways.contact > 0, words, "")]


def slip_card(times: FloatArray, sideways: SidewaysForces, friction: float) -> Card:
    """Return when a contact first slides."""
    slides = np.flatnonzero(sideways.slides(friction))
    detail = f"friction {friction:g}"
    if len(slides):
        return Card("Slides from", f"{times[slides[0]]:.4g} s", detail)
    return Card("Slides", "may be" if sideways.may_slide(friction).any() else "never", detail)


def slip_summary(times: FloatArray, sideways: SidewaysForces, friction: float | None) -> tuple[tuple[str, str], ...]:
    """Return names and values for the console."""
    if not sideways.contact.any():
        return ()
    top = int(np.nanargmax(sideways.size))
    low, high = sideways.size_95[top]
    rows = [("largest sideways force over that along the rod", f"{sideways.size[top]:.3g} ({low:.3g} to {high:.3g})")]
    if friction is not None:
        card = slip_card(times, sideways, friction)
        rows.append((card.label.lower(), card.value))
    return tuple(rows)


def slip_section(times: FloatArray, sideways: SidewaysForces, friction: float | None, touch_s: float) -> Section:
    """Return the section on drag and slip: one row a contact, and T / F over time."""
    if not sideways.contact.any():
        return Section("Drag and slip", ("No contact was found in the record.",))
    contacts = tuple(_contact(times, sideways, k, friction) for k in range(1, int(sideways.contact.max(initial=0)) + 1))
    columns = (
        "contact",
        "from, s",
        "to, s",
        "largest T / F",
        "its 95 % interval",
        "may slide from, s",
        "slides from, s",
        "part that sticks",
    )
    table = Table(
        "Contacts", columns, contacts,
        note=f"T: sideways force since the contact's first {touch_s:g} s. A contact slides from {SLIPS_FROM:g} of the friction coefficient "
        "on. Part that sticks: least radius of the sticking middle over that of the contact by Mindlin's theory of spheres (Hertz's "
        "pressure), in which the rim slips first; the finite elements are too coarse to check it.",
    )  # fmt: skip

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        rows = drawn_rows(len(times))
        axes.fill_between(times[rows], *sideways.size_95[rows].T, alpha=0.3, linewidth=0)
        axes.plot(times[rows], sideways.size[rows], linewidth=0.8, label="T / F")
        if friction is not None:
            axes.axhline(friction, color="0.3", linestyle=":", label="friction")
            axes.legend(fontsize=8)
        axes.set(xlabel="time (s)", ylabel="sideways force over that along the rod", ylim=(0.0, None))

    text = (
        "A rod that presses towards the centre moves the moment over F_z little; a sideways force moves it in proportion. The rod is "
        "supposed to keep its direction: one that turns is taken for one that drags. Once a contact is dragged, its direction and place "
        "above are off.",
        *(() if friction is not None else ("Without a friction coefficient it is not told whether a contact slides.",)),
    )
    return Section("Drag and slip", text, (table,), (Figure("Drag", "With 95 % intervals.", draw, (9.0, 3.2)),))


def _contact(times: FloatArray, sideways: SidewaysForces, k: int, friction: float | None) -> tuple[Cell, ...]:
    held = sideways.contact == k
    at = times[held]
    top = int(np.argmax(sideways.size[held]))
    low, high = sideways.size_95[held][top]
    largest = (float(sideways.size[held][top]), f"{low:.3g} to {high:.3g}")
    if friction is None:
        return k, float(at[0]), float(at[-1]), *largest, None, None, None
    may, slides = at[sideways.may_slide(friction)[held]], at[sideways.slides(friction)[held]]
    least = float(sideways.sticking_radius(friction)[held].min())
    return k, float(at[0]), float(at[-1]), *largest, _first(may), _first(slides), least


def _first(times: FloatArray) -> float | None:
    return float(times[0]) if len(times) else None
