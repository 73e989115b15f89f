"""The page of a parameter sweep: its table, rank correlations :cite:p:`spearman1904`, and scatter plots."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import chapter_html
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

SHOWN_ROWS = 500
LEAST_RUNS = 8  # of which rank correlations are shown
PLOTS_IN_A_ROW = 4
LABEL = 24  # letters in a line of a label


@dataclass(frozen=True, slots=True, eq=False)
class SweepRows:
    """The finished runs of a sweep.

    Attributes
    ----------
    numbers : tuple of int
        Of the runs, from 1.
    keys : tuple of str
        What is varied (p).
    values : ndarray, shape (runs, p)
        In the units of the study's file.
    quantities : tuple of str
        Names of the figures (q), with units.
    figures : ndarray, shape (runs, q)
        NaN where a run could not be computed.
    problems : tuple of str
        Why a run has no figures; empty where it has.
    """

    numbers: tuple[int, ...]
    keys: tuple[str, ...]
    values: FloatArray
    quantities: tuple[str, ...]
    figures: FloatArray
    problems: tuple[str, ...]

    @property
    def computed(self) -> Any:
        """Which runs have figures."""
        return np.array([not problem for problem in self.problems], dtype=bool)


def sweep_html(title: str, rows: SweepRows, total: int, settings: dict[str, Any]) -> str:
    """Return the page of a sweep.

    Parameters
    ----------
    title : str
        Heading.
    rows : SweepRows
        What was computed.
    total : int
        Number of runs asked for.
    settings : dict
        Contents of the sweep's file.
    """
    varied = [k for k in range(len(rows.quantities)) if _varies(rows.figures[rows.computed, k])]
    sections = [Section("Runs", tuple(_sentences(rows, total)), (_table(rows), *_problems(rows)))]
    if rows.computed.sum() >= LEAST_RUNS and varied:
        sections.insert(0, Section("What depends on what", (_HOW,), (_correlations(rows, varied),), tuple(_figures(rows, varied))))
    elif rows.computed.any() and varied:
        sections.append(Section("Figures against parameters", (), (), tuple(_figures(rows, varied))))
    told: dict[str, Cell] = {"study": settings["sweep"]["study"], "method": settings["sweep"]["method"], "seed": settings["sweep"]["seed"]}
    return chapter_html(Chapter("sweep", title, tuple(sections), told))


_HOW = (
    "Rank correlation (Spearman) between every parameter and every figure: 1 where the figure always grows with the parameter, -1 where it "
    "always falls, near 0 where it does not depend on it, or both rises and falls. It tells of monotonic dependence only."
)


def _sentences(rows: SweepRows, total: int) -> list[str]:
    failed = int((~rows.computed).sum())
    told = [f"{len(rows.numbers)} of {total} runs are finished."] if len(rows.numbers) < total else [f"{total} runs."]
    if failed:
        told.append(f"{failed} of them could not be computed; the second table says why.")
    still = [name for k, name in enumerate(rows.quantities) if rows.computed.any() and not _varies(rows.figures[rows.computed, k])]
    if still and len(rows.numbers) > 1:
        told.append(f"The same in all runs: {'; '.join(still)}.")
    if len(rows.numbers) > SHOWN_ROWS:
        told.append(f"The table shows the first {SHOWN_ROWS}; the CSV and JSON files hold all.")
    return told


def _varies(values: FloatArray) -> bool:
    return len(values) > 1 and bool(np.ptp(values) > 1e-9 * max(float(np.abs(values).max()), 1e-300))


def _table(rows: SweepRows) -> Table:
    cells: list[tuple[Cell, ...]] = []
    for k, number in enumerate(rows.numbers[:SHOWN_ROWS]):
        cells.append((number, *(float(f"{v:.4g}") for v in rows.values[k]), *(float(f"{v:.4g}") for v in rows.figures[k])))
    return Table("Runs", ("run", *map(_broken, rows.keys), *rows.quantities), tuple(cells))


def _problems(rows: SweepRows) -> tuple[Table, ...]:
    """Return a table of why runs could not be computed, with the runs of each reason; none where all were."""
    runs: dict[str, list[str]] = {}
    for number, why in zip(rows.numbers, rows.problems, strict=True):
        if why:
            runs.setdefault(why, []).append(str(number))
    if not runs:
        return ()
    cells = tuple((", ".join(numbers), why) for why, numbers in list(runs.items())[:SHOWN_ROWS])
    return (Table("Runs that could not be computed", ("run", "why"), cells),)


def _labelled(key: str) -> str:
    """Return the name of a parameter with its unit, which those of springs and dashpots do not hold."""
    table, _, name = key.partition(".")
    unit = {"K": ", mN/mm", "C": ", mN s/mm"}.get(name[:1], "") if table == "parameters" else ""
    return f"{key}{unit}"


def _broken(key: str) -> str:
    """Return a name with its unit whose line may break behind its dots."""
    return _labelled(key).replace(".", ".\u200b")


def _correlations(rows: SweepRows, varied: list[int]) -> Table:
    from scipy.stats import spearmanr  # slow to load, and not needed by workers

    lines: list[tuple[Cell, ...]] = []
    for k in varied:
        figures = rows.figures[rows.computed, k]
        found = [spearmanr(rows.values[rows.computed, p], figures).statistic for p in range(len(rows.keys))]
        lines.append((rows.quantities[k], *(round(float(r), 2) for r in found)))
    return Table(
        "Rank correlation",
        ("figure", *map(_broken, rows.keys)),
        tuple(lines),
        note="Spearman's rank correlation; it tells of monotonic dependence only.",
    )


def _figures(rows: SweepRows, varied: list[int]) -> list[Figure]:
    height = 2.3 * -(-len(rows.keys) // PLOTS_IN_A_ROW)
    return [
        Figure(f"Fig. {n + 1}", f"{rows.quantities[k]}, against each parameter; every point is a run.", _drawn(rows, k), (8.0, height))
        for n, k in enumerate(varied)
    ]


def _drawn(rows: SweepRows, quantity: int) -> Callable[[Canvas], None]:
    def draw(canvas: Canvas) -> None:
        across = min(len(rows.keys), PLOTS_IN_A_ROW)
        down = -(-len(rows.keys) // PLOTS_IN_A_ROW)
        for p, key in enumerate(rows.keys):
            axes = canvas.add_subplot(down, across, p + 1)
            axes.plot(rows.values[rows.computed, p], rows.figures[rows.computed, quantity], "o", markersize=4, alpha=0.7)
            axes.set_xlabel(_labelled(key))
            if p % across == 0:
                axes.set_ylabel(textwrap.fill(rows.quantities[quantity], LABEL))

    return draw
