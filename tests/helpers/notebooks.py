"""What a notebook shows of a result."""

from __future__ import annotations

from html import escape
from pathlib import Path

import matplotlib.pyplot as plt

from naibu.viewer.notebook import ShownInNotebook, ShownResult


def check_shown(result: ShownResult, page: Path | None = None) -> list[dict[str, object]]:
    """Check that a notebook shows the page that was written, and a figure whose axes have labels; return the rows of the table."""
    shown = result.page_html()
    assert escape(shown, quote=True) in result._repr_html_()
    assert page is None or shown == page.read_text(encoding="utf-8")
    if isinstance(result, ShownInNotebook):
        figure = result.plot()
        assert all(axes.get_xlabel() or axes.get_ylabel() for axes in figure.axes)
        plt.close(figure)
    return [dict(row) for row in result.to_records()]
