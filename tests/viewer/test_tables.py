"""Tables of a page: how cells are written, and what a reader sees of a table."""

from __future__ import annotations

import math
import re

import pytest

from naibu.viewer.embedding import embedded_json
from naibu.viewer.tables import Table, cell_text, provenance_table, table_html


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.38, "0.38"),
        (1.23456, "1.235"),
        (250.0, "250"),
        (12345.6, "12346"),
        (-5e-17, "−5·10<sup>−17</sup>"),
        (2.5e6, "2.5·10<sup>6</sup>"),
        (0.0, "0"),
        (math.inf, "∞"),
        (math.nan, "–"),
        (7, "7"),
    ],
)
def test_shortest_numbers_keep_the_digits_they_were_printed_with(value: float, text: str) -> None:
    assert cell_text(value, shortest=True) == text


def test_only_columns_of_numbers_are_aligned_right() -> None:
    rows = (("a < b", 1.0, None), ("c", math.nan, "none"))
    html = table_html(Table("T & t", ("what", "E, kPa", "mixed"), rows, caption="A caption.", note="A note."))
    assert "T &amp; t" in html and "a &lt; b" in html and "A caption." in html and "A note." in html
    classes = re.findall(r"<th scope=\"col\"( class=\"num\")?>", html)
    assert [bool(c) for c in classes] == [False, True, False]
    assert html.count("<tr>") == 3 and html.count('<td class="num">') == 2


def test_provenance_shows_every_entry_of_nested_mappings() -> None:
    html = provenance_table({"naibu": "0.1", "settings": {"law": "linear", "sizes": [8, 16]}, "seed": None})
    found = re.findall(r"<th scope=\"row\">([^<]*)</th><td>([^<]*)</td>", html)
    assert found == [("naibu", "0.1"), ("settings › law", "linear"), ("settings › sizes", "8, 16"), ("seed", "–")]


def test_embedded_json_cannot_end_its_script_element() -> None:
    assert "</" not in embedded_json({"title": "</script><b>"})
    with pytest.raises(ValueError, match="not JSON compliant"):
        embedded_json({"value": math.nan})
