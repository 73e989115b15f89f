"""Cards with which a page opens."""

from __future__ import annotations

import math

from naibu.viewer.cards import Card, cards_html
from naibu.viewer.result_page.estimates import parameter_cards
from naibu.viewer.result_page.payload import ParameterRow


def test_cards_are_a_list_of_definitions_and_escape_what_they_show() -> None:
    page = cards_html([Card("<b>", "1 & 2", "a > b"), Card("E", "20 kPa")])
    assert page.startswith("<dl") and page.count("<dt>") == 2 and page.count("<span>") == 1
    assert "&lt;b&gt;" in page and "1 &amp; 2" in page and "<b>" not in page
    assert cards_html([]) == ""


def test_a_parameter_shows_its_interval_or_why_there_is_none() -> None:
    rows = [
        ParameterRow("g: E", "gel: Young's modulus", 20.123, 18.9, 21.4, "kPa"),
        ParameterRow("g: nu", "gel: Poisson's ratio", 0.49, 0.47, math.inf, ""),
        ParameterRow("f", "friction", 0.3, -math.inf, math.inf, ""),
        ParameterRow("h: E", "hard: Young's modulus", 200.0, 200.0, 200.0, "kPa", "given"),
        ParameterRow("h: c", "hard: C20 / C10", 0.6, -0.002, 1.1, ""),
    ]
    shown = [(card.value, card.detail) for card in parameter_cards(rows)]
    assert shown == [
        ("20.1 kPa", "95 %: 18.9 to 21.4"),
        ("at least 0.47", "95 %"),
        ("0.300", "not bounded by the data"),
        ("200 kPa", "given"),
        ("0.6", "95 %: 0.0 to 1.1"),
    ]
