"""A chapter as one self-contained HTML page, and its numbers as JSON."""

from __future__ import annotations

import base64
import io
import json
import math
from html import escape
from pathlib import Path
from typing import Any

from naibu._version import __version__
from naibu.io.files.atomic import write_atomically
from naibu.viewer.chapter import Cell, Chapter, Figure, Section, Table

STYLE = """
:root { color-scheme: light; --line: #d5d8dc; --soft: #5b6470; --band: #f5f7f9; }
body { font: 16px/1.55 system-ui, sans-serif; color: #1b1f24; max-width: 62rem; margin: 2rem auto 4rem; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; line-height: 1.25; } h2 { font-size: 1.25rem; margin-top: 2.6rem; border-bottom: 1px solid var(--line); }
figure { margin: 1.6rem 0; } figure img { max-width: 100%; height: auto; } figcaption, .note { color: var(--soft); font-size: .9rem; }
.scroll { overflow-x: auto; margin-top: 1.4rem; } table { border-collapse: collapse; font-size: .92rem; }
caption { text-align: left; padding-bottom: .4rem; } th, td { padding: .25rem .8rem; border-bottom: 1px solid var(--line); }
th { text-align: left; background: var(--band); vertical-align: bottom; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
footer { margin-top: 3rem; color: var(--soft); font-size: .85rem; }
nav a { margin-right: 1rem; } @media print { body { max-width: none; } }
"""


def write_chapter(chapter: Chapter, folder: Path) -> tuple[Path, Path]:
    """Write ``NAME.html`` and ``NAME.json`` into a folder and return their paths.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    page = write_atomically(folder / f"{chapter.name}.html", chapter_html(chapter))
    return page, write_atomically(
        folder / f"{chapter.name}.json", json.dumps(chapter_numbers(chapter), indent=1, ensure_ascii=False) + "\n"
    )


def chapter_numbers(chapter: Chapter) -> dict[str, Any]:
    """Return all tables of a chapter with its settings, ready for JSON; what is not a number becomes null."""
    tables = [
        {
            "section": section.title,
            "name": table.name,
            "caption": table.caption,
            "columns": list(table.columns),
            "rows": [[_plain(cell) for cell in row] for row in table.rows],
            "note": table.note,
        }
        for section in chapter.sections
        for table in section.tables
    ]
    return {"chapter": chapter.name, "title": chapter.title, "naibu": __version__, "settings": chapter.settings, "tables": tables}


def chapter_html(chapter: Chapter) -> str:
    """Return the page as text; figures are drawn here."""
    links = " ".join(f'<a href="#s{i}">{escape(section.title)}</a>' for i, section in enumerate(chapter.sections))
    sections = "\n".join(_section(i, section) for i, section in enumerate(chapter.sections))
    settings = ", ".join(f"{escape(str(k))} {_shown(v)}" for k, v in chapter.settings.items())
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(chapter.title)}</title><style>{STYLE}</style></head><body>\n<h1>{escape(chapter.title)}</h1>\n<nav>{links}</nav>\n"
        f"{sections}\n<footer>naibu {__version__}; {settings}</footer>\n</body></html>\n"
    )


def _section(index: int, section: Section) -> str:
    parts = [f'<h2 id="s{index}">{escape(section.title)}</h2>', *(f"<p>{escape(text)}</p>" for text in section.paragraphs)]
    parts += [_table(table) for table in section.tables] + [_figure(figure) for figure in section.figures]
    return "\n".join(parts)


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    body = "\n".join("<tr>" + "".join(_cell(cell) for cell in row) + "</tr>" for row in table.rows)
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    caption = f"<caption><b>{escape(table.name)}</b> {escape(table.caption)}</caption>"
    return f'<div class="scroll"><table>{caption}<thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>{note}'


def _cell(cell: Cell) -> str:
    return f'<td class="number">{_shown(cell)}</td>' if isinstance(cell, int | float) or cell is None else f"<td>{escape(cell)}</td>"


def _shown(cell: Cell) -> str:
    """A cell as text: four significant digits, a dash where there is nothing."""
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return "–"
    return f"{cell:.4g}" if isinstance(cell, float) else escape(str(cell))


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
    caption = f"<b>{escape(figure.name)}</b> {escape(figure.caption)}"
    return f'<figure><img alt="{escape(figure.name)}" src="data:image/svg+xml;base64,{data}"><figcaption>{caption}</figcaption></figure>'
