"""Pages of results inside a notebook, and what every result that has a page offers there."""

from __future__ import annotations

import csv
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from naibu.core.optional_packages import optional_package

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

HEIGHT_PX = 720
LARGEST_BYTES = 8_000_000  # a notebook keeps all that it shows


def inline_page(page: str, *, height_px: int = HEIGHT_PX, where: str = "") -> str:
    """Return a page as an HTML element that a notebook shows.

    The page stands in a frame of its own (``srcdoc``), may run its scripts and nothing else, and cannot see the notebook.

    Parameters
    ----------
    page : str
        HTML document.
    height_px : int
        Height of the frame, CSS pixels.
    where : str
        File of the page, named where it is too large to be shown.
    """
    if (size := len(page.encode())) > LARGEST_BYTES:
        told = f"; open {where}" if where else ""
        return f"<p>The page has {size / 1e6:.0f} MB, more than the {LARGEST_BYTES / 1e6:.0f} MB that a notebook shows{escape(told)}.</p>"
    return (
        f'<iframe title="Result of naibu" sandbox="allow-scripts" style="width: 100%; height: {height_px}px; border: 1px solid #8888" '
        f'srcdoc="{escape(page, quote=True)}"></iframe>'
    )


def data_frame(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> Any:
    """Return a table as ``pandas.DataFrame``.

    Raises
    ------
    MissingDependencyError
        pandas is not installed.
    """
    pandas = optional_package("pandas", "a table of results as a DataFrame")
    return pandas.DataFrame([dict(zip(columns, row, strict=True)) for row in rows], columns=list(columns))


def empty_figure(width: float, height: float) -> Canvas:
    """Return an empty figure of pyplot, width and height in inches, which scripts show with ``matplotlib.pyplot.show()``.

    Raises
    ------
    MissingDependencyError
        matplotlib cannot be loaded.
    """
    made: Canvas = optional_package("matplotlib.pyplot", "a figure of results", "matplotlib").figure(
        figsize=(width, height), layout="constrained"
    )
    return made


class ShownResult:
    """What every result with a page offers in a notebook: the page inline, and a table."""

    __slots__ = ()

    @abstractmethod
    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""

    @abstractmethod
    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return the table of the result, one mapping from column to value a row."""

    def to_dataframe(self) -> Any:
        """Return the table of the result as ``pandas.DataFrame``; `to_records` needs no other package.

        Raises
        ------
        MissingDependencyError
            pandas is not installed.
        """
        records = self.to_records()
        columns = list(dict.fromkeys(name for record in records for name in record))
        return data_frame(columns, [[record.get(name) for name in columns] for record in records])

    def _repr_html_(self) -> str:
        return inline_page(self.page_html())


class ShownInNotebook(ShownResult):
    """What a result with a page and a figure offers in a notebook."""

    __slots__ = ()

    @abstractmethod
    def plot(self) -> Canvas:
        """Return a figure of the result, drawn by matplotlib."""


class WrittenResult(ShownResult):
    """A result whose page is one of the files that were written."""

    __slots__ = ()

    files: tuple[Path, ...]

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document.

        Raises
        ------
        OSError
            The file has been moved or deleted since.
        """
        return next(path for path in self.files if path.suffix == ".html").read_text(encoding="utf-8")

    def _rows_of(self, name: str) -> tuple[Mapping[str, float], ...]:
        """Return the rows of a table of numbers among the files; NaN where a cell is empty."""
        with next(path for path in self.files if path.name == name).open(encoding="utf-8", newline="") as stream:
            return tuple({column: float(value or "nan") for column, value in row.items()} for row in csv.DictReader(stream))
