"""The scripts of the gallery and of the tutorials run as they stand, and draw figures whose axes say what they show, legibly."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"
SCRIPTS = sorted((DOCS / "gallery_src").glob("plot_*.py"))
TUTORIALS = sorted((DOCS / "tutorials_src").glob("plot_*.py"))


@pytest.fixture(autouse=True)
def no_window():
    """Draw into memory, and leave nothing open."""
    matplotlib = pytest.importorskip("matplotlib")
    before = matplotlib.get_backend()
    matplotlib.use("Agg")
    from matplotlib import pyplot

    pyplot.close("all")
    yield
    pyplot.close("all")
    matplotlib.use(before)


@pytest.mark.filterwarnings("ignore:.*non-interactive.*cannot be shown:UserWarning")
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_script_runs_and_labels_its_axes(script: Path) -> None:
    runs_and_labels_its_axes(script)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*non-interactive.*cannot be shown:UserWarning")
@pytest.mark.parametrize("script", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial_runs_and_labels_its_axes(script: Path) -> None:
    runs_and_labels_its_axes(script)


def runs_and_labels_its_axes(script: Path) -> None:
    """Run a script cell by cell, as Sphinx-Gallery does: it takes the figures that are open after a cell, and closes them."""
    from matplotlib import pyplot

    names: dict[str, Any] = {"__name__": "__main__", "__file__": str(script)}
    drawn = 0
    for code in cells(script.read_text(encoding="utf-8")):
        exec(compile(code, str(script), "exec"), names)
        figures = [pyplot.figure(number) for number in pyplot.get_fignums()]
        drawn += len(figures)
        for figure in figures:
            figure.canvas.draw()
            for axes in figure.axes:
                says_what_it_shows(axes, script.name)
        pyplot.close("all")
    assert drawn


def cells(text: str) -> list[str]:
    """Split a script at its lines ``# %%``; each cell keeps the numbers of its lines."""
    starts = [0, *(found.start() for found in re.finditer(r"^# %%", text, flags=re.MULTILINE)), len(text)]
    return ["\n" * text.count("\n", 0, start) + text[start:end] for start, end in pairwise(starts)]


def says_what_it_shows(axes: Any, script: str) -> None:
    shared = len(axes.get_shared_y_axes().get_siblings(axes)) > 1
    assert axes.get_ylabel() or shared, f"an axis of {script} has no y label"
    assert axes.get_xlabel() or axes.get_label() == "<colorbar>", f"an axis of {script} has no x label"
    if axes.name == "3d":
        return  # the labels of its axes lie one behind the other
    for axis, along in ((axes.xaxis, 0), (axes.yaxis, 1)):
        low, high = sorted(axis.get_view_interval())
        ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
        labels = [tick.label1 for tick in ticks if tick.label1.get_text() and tick.label1.get_visible() and low <= tick.get_loc() <= high]
        boxes = sorted((sorted(label.get_window_extent().get_points()[:, along]), label.get_text()) for label in labels)
        for ((_, end), before), ((start, _), after) in pairwise(boxes):
            assert end < start, f"the labels {before} and {after} of an axis of {script} overlap"


def test_there_is_a_gallery() -> None:
    assert len(SCRIPTS) >= 20 and len(TUTORIALS) >= 6
