"""The page of a chapter and its numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from browser import CHROMIUM, opened_browser
from matplotlib.figure import Figure as Canvas

from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Table


def draw(canvas: Canvas) -> None:
    canvas.subplots().plot([0, 1], [0, 1])


def test_page_and_numbers(tmp_path: Path) -> None:
    table = Table(
        "Table 9.9",
        ("what", "printed kPa", "ours kPa"),
        (("x & y", 1.0, 1.23456), ("z", None, float("nan"))),
        caption="A < B",
        note="a note",
    )
    sections = (Section("First <part>", ("Text.",), (table,), (Figure("Fig. 9.1", "A line.", draw),)),)
    page, numbers = write_chapter(Chapter("ch9", "Chapter 9", sections, {"seed": 3}), tmp_path)
    html, data = page.read_text(encoding="utf-8"), json.loads(numbers.read_text(encoding="utf-8"))
    assert "First &lt;part&gt;" in html and "x &amp; y" in html and "1.235" in html and html.count("<img") == 1
    assert "http://" not in html and "https://" not in html
    assert data["tables"][0]["rows"] == [["x & y", 1.0, 1.23456], ["z", None, None]] and data["settings"] == {"seed": 3}
    assert write_chapter(Chapter("ch9", "Chapter 9", sections, {"seed": 3}), tmp_path)[0].read_text(encoding="utf-8") == html


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")
def test_a_long_word_does_not_make_the_page_wider_than_a_phone(tmp_path: Path) -> None:
    """A paragraph named a function by its full path, and all of the page could be shifted sideways."""
    text = "See naibu.identification.material_testing.compression_test.young_modulus_of_cylinders."
    page, _ = write_chapter(Chapter("ch9", "Chapter 9", (Section("Part", (text,)),), {}), tmp_path)
    with opened_browser(390, 844) as browser:
        browser.resize(390, 844)
        browser.open(page.as_uri())
        browser.wait("document.readyState === 'complete' && document.querySelector('p') !== null")
        assert browser.value("document.documentElement.scrollWidth") <= 390
