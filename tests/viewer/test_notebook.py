"""Results in a notebook: pages inline, tables, figures, and what is said where a package is missing."""

from __future__ import annotations

import sys
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import numpy as np
import pytest

from naibu.core.errors import MissingDependencyError
from naibu.viewer import notebook
from naibu.viewer.notebook import ShownInNotebook, inline_page
from naibu.viewer.result_figures import draw_marker_motion

PAGE = '<!DOCTYPE html><html lang="en"><title>"a" & \'b\'</title><script>if (1 < 2) { "</iframe>"; }</script></html>'


class Frames(HTMLParser):
    """Attributes of all elements, as a browser reads them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


class Result(ShownInNotebook):
    def page_html(self) -> str:
        return PAGE

    def plot(self):  # type: ignore[no-untyped-def]
        return notebook.empty_figure(2.0, 1.0)

    def to_records(self) -> tuple[dict[str, object], ...]:
        return ({"a": 1}, {"a": 2, "b": "x"})


def test_a_page_stands_in_a_frame_that_cannot_see_the_notebook() -> None:
    ((tag, attributes),) = Frames(Result()._repr_html_()).found
    assert tag == "iframe" and attributes["srcdoc"] == PAGE
    assert attributes["sandbox"] == "allow-scripts" and attributes["title"]


def test_a_page_that_is_too_large_is_named_and_not_embedded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notebook, "LARGEST_BYTES", 10)
    told = inline_page(PAGE, where="<out>/report.html")
    assert "iframe" not in told and "open &lt;out&gt;/report.html" in told


def test_tables_need_pandas_and_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingDependencyError, match=r"pandas.*pip install"):
        Result().to_dataframe()


def test_tables_are_data_frames() -> None:
    pandas = pytest.importorskip("pandas")
    found = Result().to_dataframe()
    assert list(found.columns) == ["a", "b"] and found["a"].tolist() == [1, 2]
    assert pandas.isna(found["b"][0]) and found["b"][1] == "x"


def test_figures_are_those_of_pyplot() -> None:
    figure = Result().plot()
    assert figure.number in plt.get_fignums()
    plt.close(figure)


def test_arrows_have_the_length_of_the_displacement() -> None:
    before = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 2.0], [1.0, 5.0, 3.0]])
    after = before + np.array([1.0, 2.0, 3.0])
    figure = plt.figure()
    draw_marker_motion(figure, before, after, ["ok", "suspect", "missing"])
    for axes, pair in zip(figure.axes, ((0, 2), (1, 2), (0, 1)), strict=True):
        arrows = [c for c in axes.collections if hasattr(c, "U")]
        assert [(float(a.U[0]), float(a.V[0])) for a in arrows] == [(1.0 + pair[0], 1.0 + pair[1])] * 2  # the missing one has none
        assert axes.get_xlabel() == f"{'xyz'[pair[0]]} (mm)"
    plt.close(figure)


def test_particles_of_a_plane_are_drawn_in_it() -> None:
    figure = plt.figure()
    draw_marker_motion(figure, np.array([[0.0, 0.0], [4.0, 1.0]]), np.array([[1.0, 2.0], [5.0, 3.0]]), ["ok", "ok"])
    (axes,) = figure.axes
    (arrows,) = axes.collections
    assert arrows.U.tolist() == [1.0, 1.0] and arrows.V.tolist() == [2.0, 2.0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (mm)", "y (mm)")
    plt.close(figure)
