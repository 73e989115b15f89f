"""A chapter as a self-contained HTML page, and its tables as JSON."""

from __future__ import annotations

import base64
import io
import json
import math
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from naibu._version import __version__
from naibu.io.files.atomic import write_atomically
from naibu.viewer.cards import cards_html
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.comparisons import comparison_cards, comparison_table
from naibu.viewer.marker_view import SCRIPT
from naibu.viewer.page_frame import page_html
from naibu.viewer.tables import Cell, provenance_section, table_html, text_html


def write_chapter(chapter: Chapter, folder: Path) -> tuple[Path, Path]:
    """Write ``NAME.html`` and ``NAME.json`` into a folder and return their paths.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    page = write_atomically(folder / f"{chapter.name}.html", chapter_html(chapter))
    return page, write_atomically(folder / f"{chapter.name}.json", chapter_numbers_text(chapter))


def chapter_numbers_text(chapter: Chapter) -> str:
    """Return the text of the JSON file of a chapter."""
    return json.dumps(chapter_numbers(chapter), indent=1, ensure_ascii=False) + "\n"


def chapter_numbers(chapter: Chapter) -> dict[str, Any]:
    """Return all tables of a chapter with its settings, ready for JSON; NaN and infinities become null."""
    tables = [
        {
            "section": section.title,
            "title": table.title,
            "caption": table.caption,
            "columns": list(table.columns),
            "rows": [[_plain(cell) for cell in row] for row in table.rows],
            "note": table.note,
        }
        for section in chapter.sections
        for table in section.tables
    ]
    return {
        "chapter": chapter.name,
        "title": chapter.title,
        "naibu": __version__,
        "settings": chapter.settings,
        "comparisons": [asdict(comparison) for comparison in chapter.comparisons],
        "tables": tables,
    }


def chapter_html(chapter: Chapter) -> str:
    """Return the page as text, with all its figures drawn."""
    links = "".join(f'<li><a href="#s{i}">{text_html(section.title)}</a></li>' for i, section in enumerate(chapter.sections))
    sections = "\n".join(_section(f"s{i}", section) for i, section in enumerate(chapter.sections))
    sections += provenance_section({"naibu": __version__, **chapter.settings})
    contents = f'<nav aria-label="Contents"><ul>{links}</ul></nav>' if len(chapter.sections) > 1 else ""
    cards = (*chapter.cards, *comparison_cards(chapter.comparisons))
    if chapter.comparisons:
        sections = _section("agreement", Section("What agrees, and what does not", (), (comparison_table(chapter.comparisons),))) + sections
    header, footer = cards_html(cards) + contents, "This page is self-contained: it loads nothing from the network."
    if chapter.view is None or not chapter.view.scenes:
        return page_html(chapter.title, header, sections, footer)
    return page_html(chapter.title, header, chapter.view.html() + sections, footer, data=chapter.view.data(), script=SCRIPT)


def _section(name: str, section: Section) -> str:
    parts = [f'<h2 id="h-{name}">{text_html(section.title)}</h2>', *(f"<p>{text_html(text)}</p>" for text in section.paragraphs)]
    parts += [table_html(table, shortest=True) for table in section.tables] + [_figure(figure) for figure in section.figures]
    return f'<section id="{name}" class="long" aria-labelledby="h-{name}">{"".join(parts)}</section>'


def _plain(cell: Cell) -> Cell:
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell


def _figure(figure: Figure) -> str:
    from matplotlib import rc_context
    from matplotlib.figure import Figure as Canvas

    with rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": figure.name}):
        canvas = Canvas(figsize=figure.size, layout="constrained")
        figure.draw(canvas)
        stream = io.BytesIO()
        canvas.savefig(stream, format="svg", metadata={"Date": None})
    data = base64.b64encode(stream.getvalue()).decode()
    caption = f"<b>{text_html(figure.name)}</b> {text_html(figure.caption)}"
    alt = escape(f"{figure.name}. {figure.caption}", quote=True)
    picture = f'<img alt="{alt}" src="data:image/svg+xml;base64,{data}">'
    # a checkbox enlarges the figure without a script, by mouse and by keyboard
    zoom = f'<input type="checkbox" class="visually-hidden" aria-label="Enlarge {escape(figure.name, quote=True)}">'
    return f'<figure><label class="zoom">{zoom}<span>{picture}</span></label><figcaption>{caption}</figcaption></figure>'
