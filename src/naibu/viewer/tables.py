"""Tables of a page and their HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from html import escape

from naibu.core.errors import InputError
from naibu.viewer.json_values import jsonable

Cell = str | float | int | None
UNITS = {"mm": "mm", "mm2": "mm²", "mm3": "mm³", "deg": "degrees", "percent": "%"}  # by the last word of a key
_LONG_TEXT = 60  # characters of a cell: in a narrow column it would be many lines high
_ROUNDING = 1e-11  # of the largest number of a column
_SUBSCRIPT = re.compile(r"\b([A-Z])_(x|y|z|in|R[XYZ])\b")  # of forces, moments and voltages


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text and numbers; units belong in the column headers.

    Attributes
    ----------
    title : str
        Heading, such as ``"Table 3.2"``.
    columns : tuple of str
        Column headers, with units.
    rows : tuple of tuple
        Cells of each row, one per column; None and NaN are shown as a dash.
    caption : str
        What the table shows, beside the title.
    note : str
        What a reader must know, below the table: assumptions, misprints of a source, why a number differs.

    Raises
    ------
    InputError
        A row has more or fewer cells than there are columns.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    _: KW_ONLY
    caption: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise InputError(f"table {self.title!r}: row {i} has {len(row)} cells, there are {len(self.columns)} columns")


def table_html(table: Table, *, shortest: bool = False) -> str:
    """Return a table as HTML; columns of numbers are aligned right.

    Parameters
    ----------
    table : Table
        What to show.
    shortest : bool
        Whether numbers are written as `cell_text` writes them with this option.
    """
    numeric = [_is_numeric(table, i) for i in range(len(table.columns))]
    wordy = [any(isinstance(value, str) and len(value) > _LONG_TEXT for value in column) for column in zip(*table.rows, strict=True)]
    kind = [' class="num"' if n else ' class="words"' if w else "" for n, w in zip(numeric, wordy or numeric, strict=True)]
    head = "".join(f'<th scope="col"{k}>{text_html(c)}</th>' for c, k in zip(table.columns, kind, strict=True))
    body = ""
    finite = [[abs(v) for v in column if isinstance(v, float | int) and math.isfinite(v)] for column in zip(*table.rows, strict=True)]
    largest = [max(column, default=0.0) for column in finite]
    for row in table.rows:
        cells = [cell_text(_rounded(value, most), shortest=shortest) for value, most in zip(row, largest, strict=True)]
        first = f'<th scope="row"{kind[0]}>{cells[0]}</th>' if cells else ""
        rest = "".join(f"<td{k}>{v}</td>" for v, k in zip(cells[1:], kind[1:], strict=True))
        body += f"<tr>{first}{rest}</tr>"
    inner = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    note = f'<p class="note">{text_html(table.note)}</p>' if table.note else ""
    caption = f' <span class="what">{text_html(table.caption)}</span>' if table.caption else ""
    # the heading is outside of the scrolling part, so that a phone shows all of it
    return f'<p class="caption">{text_html(table.title)}{caption}</p>{scrollable(table.title, inner)}{note}'


def _rounded(value: Cell, largest: float) -> Cell:
    """Return 0 for what is but rounding beside the largest number of its column."""
    return 0.0 if isinstance(value, float) and abs(value) < _ROUNDING * largest else value


def text_html(text: str) -> str:
    """Return text as HTML, with the subscripts of quantities: ``F_z`` and ``V_in`` are set as they are printed."""
    return _SUBSCRIPT.sub(r"\1<sub>\2</sub>", escape(text))


def cell_text(value: Cell, *, shortest: bool = False) -> str:
    """Return a cell as HTML text.

    Parameters
    ----------
    value : str, float, int or None
        Content of the cell; None and NaN give a dash.
    shortest : bool
        Whether a float is written with at most four significant digits and without trailing zeros, so that a printed value keeps the
        digits it was printed with; otherwise with three significant digits.
    """
    if value is None:
        return "–"
    if isinstance(value, str):
        return text_html(value)
    if isinstance(value, int):
        return str(value).replace("-", "−")
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return _number(value, shortest)


def _number(value: float, shortest: bool) -> str:
    size = abs(value)
    if size != 0 and (size >= 1e5 or size < 1e-3):
        mantissa, exponent = f"{value:.{3 if shortest else 2}e}".split("e")
        mantissa = mantissa.rstrip("0").rstrip(".") if shortest else mantissa
        return f"{mantissa}·10<sup>{int(exponent)}</sup>".replace("-", "−")
    if shortest:
        text = f"{value:.0f}" if size >= 1e3 else f"{value:.4g}"
    else:
        text = f"{value:.{0 if size >= 100 else 1 if size >= 10 else 2 if size >= 1 or size == 0 else 3}f}"
    return text.replace("-", "−")


def quantity_of(key: str) -> str:
    """Return the quantity that a key of a JSON file names, with its unit: ``"volume_before_mm3"`` gives ``"volume before, mm³"``."""
    words = key.split("_")
    unit = UNITS.get(words[-1])
    return " ".join(words) if unit is None else f"{' '.join(words[:-1])}, {unit}"


def scrollable(label: str, inner: str, kind: str = "") -> str:
    """Wrap wide content so that it scrolls horizontally, by touch and by keyboard."""
    return f'<div class="scroll {kind}" role="group" tabindex="0" aria-label="{escape(label, quote=True)}">{inner}</div>'


def _is_numeric(table: Table, column: int) -> bool:
    cells = [row[column] for row in table.rows if row[column] is not None]
    return bool(cells) and not any(isinstance(c, str) for c in cells)


def provenance_table(provenance: Mapping[str, object]) -> str:
    """Return a nested mapping as an HTML table with one row per entry."""
    rows = "".join(f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in _flat(provenance))
    return f'<div class="prov-box"><table class="prov"><tbody>{rows}</tbody></table></div>'


def provenance_section(provenance: Mapping[str, object]) -> str:
    """Return the collapsed section of a page that states how its numbers were computed."""
    return f'<section id="provenance"><details><summary>How this was computed</summary>{provenance_table(provenance)}</details></section>\n'


def _flat(entries: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in entries.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name} › ")
            continue
        plain = jsonable(value)
        yield name, ", ".join(str(v) for v in plain) if isinstance(plain, list) else "–" if plain is None else str(plain)
