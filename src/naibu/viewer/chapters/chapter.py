"""The content of a chapter page: sections of text, tables and figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from naibu.viewer.cards import Card
from naibu.viewer.chapters.comparisons import Comparison
from naibu.viewer.marker_view import MarkerView
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure that matplotlib draws.

    Attributes
    ----------
    name : str
        Label, such as ``"Fig. 3.4"``.
    caption : str
        What it shows.
    draw : callable
        Draws on an empty matplotlib figure.
    size : (float, float)
        Width and height, inches.
    """

    name: str
    caption: str
    draw: Callable[[Canvas], None]
    size: tuple[float, float] = (7.0, 4.0)


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a chapter: a title, paragraphs, then tables and figures."""

    title: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True, slots=True)
class Chapter:
    """The content of a page of tables and figures, such as a reproduced chapter of the 2008 report.

    Attributes
    ----------
    name : str
        Name of its files, such as ``"ch3"``.
    title : str
        Heading of the page.
    sections : tuple of Section
        In reading order.
    settings : dict
        Seeds and sizes that the numbers depend on, shown at the end of the page.
    cards : tuple of Card
        What to know first.
    view : MarkerView, optional
        Shown in 3-D above the sections.
    comparisons : tuple of Comparison
        Statements of the source beside ours, with which the page opens.
    """

    name: str
    title: str
    sections: tuple[Section, ...]
    settings: dict[str, Cell] = field(default_factory=dict)
    cards: tuple[Card, ...] = ()
    view: MarkerView | None = None
    comparisons: tuple[Comparison, ...] = ()
