"""What agrees with the report: verdicts follow the numbers, and every statement finds its tables."""

from __future__ import annotations

import pytest

from naibu.reproduction.agreement.read_tables import Tables, compared
from naibu.reproduction.chapter4.cutting import chapter4_cut
from naibu.reproduction.chapter4.octree import chapter4_octree
from naibu.reproduction.chapters import AGREEMENT, CHAPTERS
from naibu.viewer.chapters.chapter import Chapter, Section
from naibu.viewer.chapters.chapter_page import chapter_html, chapter_numbers
from naibu.viewer.chapters.comparisons import Comparison, comparison_cards
from naibu.viewer.tables import Table


def test_the_verdict_follows_the_numbers() -> None:
    near = compared("E", (100.0, 104.0), "kPa", within=0.05, why="assumed", differs="not assumed")
    assert (near.paper, near.ours, near.verdict, near.why) == ("100 kPa", "104 kPa", "agrees", "assumed")
    far = compared("E", (100.0, 106.0), "kPa", within=0.05, why="assumed", differs="not assumed")
    assert (far.verdict, far.why) == ("differs", "not assumed")
    assert compared("E", (100.0, float("nan")), "kPa", within=0.05).verdict == "differs"


def test_cells_are_found_by_title_row_and_column() -> None:
    table = Table("Table 1", ("a", "b", "c"), (("x", 1, 2.5), ("x", 2, 3.5), ("y", None, None)))
    tables = Tables((Section("s", (), (table,)),))
    assert tables.number("Table 1", ("x", 2), "c") == 3.5 and tables.rows("Table 1", "c", "a")[0] == (2.5, "x")
    for title, row, column in (("Table 2", ("x",), "c"), ("Table 1", ("z",), "c"), ("Table 1", ("y",), "c")):
        with pytest.raises(KeyError):
            tables.number(title, row, column)


def test_a_page_opens_with_what_agrees() -> None:
    found = (Comparison("E <b>", "1", "2", "differs", "units"), Comparison("nu", "1", "1", "agrees"), Comparison("F", "-", "-", "agrees"))
    chapter = Chapter("ch9", "Nine", (Section("First", ("text",)),), comparisons=found)
    page = chapter_html(chapter)
    assert page.index("What agrees, and what does not") < page.index("<p>text</p>") and "E &lt;b&gt;" in page
    assert [(c.label, c.value) for c in comparison_cards(found)] == [("Agree", "2 of 3"), ("Differ", "1 of 3")]
    assert chapter_numbers(chapter)["comparisons"][0]["why"] == "units"


@pytest.mark.parametrize(
    ("name", "chapter"),
    [("ch4-cut", lambda: chapter4_cut(distances=(3.0,), frames=2)),
     ("ch4-octree", lambda: chapter4_octree(sizes=(8,)))],
)  # fmt: skip
def test_statements_find_their_tables(name: str, chapter) -> None:  # type: ignore[no-untyped-def]
    found = AGREEMENT[name](Tables(chapter().sections))
    assert len(found) >= 3
    assert all(c.what and c.paper and c.ours and (c.why or c.verdict == "agrees") for c in found)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CHAPTERS))
def test_every_chapter_opens_with_its_statements(name: str) -> None:
    found = CHAPTERS[name](0).comparisons
    assert len(found) >= 3
    assert all(c.why or c.verdict == "agrees" for c in found)
