"""The scripts of the gallery and of the tutorials run as they stand, and draw figures whose axes say what they show."""

from __future__ import annotations

import runpy
from pathlib import Path

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
    from matplotlib import pyplot

    runpy.run_path(str(script), run_name="__main__")
    figures = [pyplot.figure(number) for number in pyplot.get_fignums()]
    assert figures
    for axes in (axes for figure in figures for axes in figure.axes):
        shared = len(axes.get_shared_y_axes().get_siblings(axes)) > 1
        assert axes.get_ylabel() or shared, f"an axis of {script.name} has no y label"
        assert axes.get_xlabel() or axes.get_label() == "<colorbar>", f"an axis of {script.name} has no x label"


def test_there_is_a_gallery() -> None:
    assert len(SCRIPTS) >= 20 and len(TUTORIALS) >= 6
