"""Reads cells of a chapter's tables, and compares those of the paper with ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from naibu.viewer.chapters.chapter import Section
from naibu.viewer.chapters.comparisons import Comparison, Verdict
from naibu.viewer.tables import Cell


@dataclass(frozen=True, slots=True)
class Tables:
    """Cells of the tables of a chapter, by title, row and column.

    Attributes
    ----------
    sections : sequence of Section
        Of the chapter.
    """

    sections: Sequence[Section]

    def cell(self, title: str, row: Sequence[Cell], column: str) -> Cell:
        """Return a cell: of the first table of that title, the first row that begins with these cells, and the column of that name.

        Raises
        ------
        KeyError
            There is none.
        """
        for table in (t for s in self.sections for t in s.tables if t.title == title):
            for cells in table.rows:
                if tuple(cells[: len(row)]) == tuple(row):
                    return cells[table.columns.index(column)]
        raise KeyError(f"{title}: {row}, {column}")

    def rows(self, title: str, *columns: str) -> list[tuple[Cell, ...]]:
        """Return columns of all rows of the first table of a title.

        Raises
        ------
        KeyError
            There is none.
        """
        for table in (t for s in self.sections for t in s.tables if t.title == title):
            places = [table.columns.index(column) for column in columns]
            return [tuple(row[k] for k in places) for row in table.rows]
        raise KeyError(title)

    def number(self, title: str, row: Sequence[Cell], column: str) -> float:
        """Return a cell that is a number.

        Raises
        ------
        KeyError
            There is none.
        """
        found = self.cell(title, row, column)
        if not isinstance(found, float | int):
            raise KeyError(f"{title}: {row}, {column} is {found!r}, not a number")
        return float(found)


def alike(paper: float, ours: float, *, within: float) -> bool:
    """Return whether a number is within a share of the printed one."""
    return math.isfinite(ours) and abs(ours - paper) <= within * abs(paper)


def verdict(agrees: bool) -> Verdict:
    """Return the word."""
    return "agrees" if agrees else "differs"


def compared(what: str, both: Sequence[float], unit: str, *, within: float, why: str = "", differs: str = "") -> Comparison:
    """Compare numbers.

    Parameters
    ----------
    what : str
        The quantity.
    both : sequence of float
        The printed one and ours.
    unit : str
        Of both.
    within : float
        Share of the printed number by which ours may be off.
    why, differs : str
        What is said where they agree, and where they do not.
    """
    paper, ours = both
    agrees = alike(paper, ours, within=within)
    shown = [f"{value:.4g} {unit}".strip().replace("-", "−") for value in both]
    return Comparison(what, shown[0], shown[1], verdict(agrees), why if agrees else differs)
