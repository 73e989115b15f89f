"""Cards with which a page opens: a quantity, its value and what is known of it, in a row of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True, slots=True)
class Card:
    """One number to know.

    Attributes
    ----------
    label : str
        The quantity.
    value : str
        Its value with unit.
    detail : str
        Interval, standard deviation, or what else belongs to the value.
    """

    label: str
    value: str
    detail: str = ""


def cards_html(cards: Sequence[Card]) -> str:
    """Return cards as a list of definitions; nothing where there are none."""
    if not cards:
        return ""
    inner = "".join(
        f"<div><dt>{escape(card.label)}</dt><dd><strong>{escape(card.value)}</strong>"
        f"{f'<span>{escape(card.detail)}</span>' if card.detail else ''}</dd></div>"
        for card in cards
    )
    return f'<dl class="cards">{inner}</dl>'
