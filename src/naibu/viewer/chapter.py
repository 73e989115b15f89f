"""What a page of results is made of: sections with tables and figures, such as a reproduced chapter of the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Cell = str | float | int | None


@dataclass(frozen=True, slots=True)
class Table:
    """One table; columns name their unit.

    Attributes
    ----------
    name : str
        What it reproduces, ``"Table 3.2"``.
    caption : str
        What it shows, in a sentence.
    columns : tuple of str
        Headers, with units.
    rows : tuple of tuple
        Cells; None where the report prints nothing.
    note : str
        What a reader must know: misprints, assumptions, why a number differs.
    """

    name: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure: `draw` paints it on an empty matplotlib figure of `size` inches."""

    name: str
    caption: str
    draw: Callable[[Canvas], None]
    size: tuple[float, float] = (7.0, 4.0)


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a chapter: paragraphs, then tables and figures."""

    title: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True, slots=True)
class Chapter:
    """A reproduced chapter.

    Attributes
    ----------
    name : str
        ``"ch3"``.
    title : str
        Heading of the page.
    sections : tuple of Section
        In the report's order.
    settings : dict
        Seeds and sizes that the numbers depend on.
    """

    name: str
    title: str
    sections: tuple[Section, ...]
    settings: dict[str, Cell] = field(default_factory=dict)
