"""Tables of the 2008 report :cite:p:`hirai2008` as printed."""

from __future__ import annotations

from typing import Any

from naibu import datasets


def printed_table(number: str) -> tuple[tuple[str, ...], list[list[Any]]]:
    """Return columns and rows of a table of the report, as printed; see `naibu.datasets.paper_tables`.

    Parameters
    ----------
    number : str
        Number of the table, such as ``"3.2"`` or ``"4-III"``.
    """
    table = next(t for t in datasets.paper_tables()["tables"] if t["id"] == number)
    return tuple(table["columns"]), table["rows"]
