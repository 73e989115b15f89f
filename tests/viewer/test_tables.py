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


def test_subscripts_of_forces_are_set_and_names_are_left_alone() -> None:
    table = Table("Loads", ("F_z, mN", "file"), ((1.0, "M_x_of_A_z.csv <b>"),), note="V = π σ V_in / 2; F_RX")
    page = table_html(table)
    assert "F<sub>z</sub>, mN" in page and "V<sub>in</sub> / 2; F<sub>RX</sub>" in page
    assert "M_x_of_A_z.csv &lt;b&gt;" in page


def test_provenance_shows_every_entry_of_nested_mappings() -> None:
    html = provenance_table({"naibu": "0.1", "settings": {"law": "linear", "sizes": [8, 16]}, "seed": None})
    found = re.findall(r"<th scope=\"row\">([^<]*)</th><td>([^<]*)</td>", html)
    assert found == [("naibu", "0.1"), ("settings › law", "linear"), ("settings › sizes", "8, 16"), ("seed", "–")]


def test_embedded_json_cannot_end_its_script_element() -> None:
    assert "</" not in embedded_json({"title": "</script><b>"})
    with pytest.raises(ValueError, match="not JSON compliant"):
        embedded_json({"value": math.nan})


def test_rounding_beside_the_numbers_of_its_column_is_shown_as_zero() -> None:
    html = table_html(Table("t", ("depth, mm", "small"), ((15.0, 3e-12), (2.2e-11, 1e-12))))
    assert "10<sup>−11</sup>" not in html and html.count("10<sup>−12</sup>") == 2


def test_columns_of_long_text_are_marked_for_narrow_screens() -> None:
    why = "the report counts springs on faces twice, and ours once, as its Table 3 does"
    html = table_html(Table("t", ("what", "why", "E, kPa"), (("one", why, 2.0), ("two", "", 3.0))))
    assert html.count('<th scope="col" class="words">') == 1 and html.count('<td class="words">') == 2
    assert table_html(Table("t", ("what",), ())).count("words") == 0
