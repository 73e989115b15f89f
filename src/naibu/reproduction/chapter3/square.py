"""The square of the 2008 report :cite:p:`hirai2008` (chapter 3.3): equation counts, two triangles, and accumulation of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.equilibrium_gap.batch import batch_equilibrium_gap
from naibu.identification.equilibrium_gap.incremental import IncrementalStep, incremental_equilibrium_gap
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.reproduction.chapter3.bodies import SQUARE, PushedBody, square
from naibu.reproduction.printed_tables import printed_table
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

REPORT_ORDER = (14, 13, 12, 11, 10, 9, 8, 7, 6, 5)  # node numbers of Fig. 3.8
SMALL_MM = 1e-4  # noise to which errors are proportional
STEP_NOISE_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class ErrorAccumulation:
    """Errors of the incremental and the batch method with the same noise.

    Attributes
    ----------
    steps : tuple of IncrementalStep
        Steps in the order of the report.
    incremental, batch : ndarray, shape (16,)
        Median over draws of the relative error of Young's modulus of every unknown triangle.
    """

    steps: tuple[IncrementalStep, ...]
    incremental: FloatArray
    batch: FloatArray


def square_section(seed: int, draws: int) -> Section:
    """Return the two-dimensional results of the report and the 2007 paper, and ours.

    Parameters
    ----------
    seed : int
        Seed of the noise.
    draws : int
        Draws of noise, for medians and standard deviations.
    """
    growth, table = error_accumulation(seed, draws), two_triangles(seed, draws)
    needed = [float(row[-1]) for row in table.rows if row[-1] is not None]
    worst = float(growth.incremental.max() / growth.batch.max())
    text = (
        "A square of 200 x 200 mm, 4 x 4 cells of two triangles, E 5 kPa, nu 0.43, stands on a fixed floor; its top is displaced, and the "
        "upper half is known. All data are displacements computed on the same mesh, as in the report, so that only errors of the method "
        "appear.",
        "Without noise the incremental and the batch method return the true moduli of all 16 triangles from two load cases, whatever "
        "their size, because small strain is linear. The errors printed in 2007 are therefore neither of the method nor of the mesh, as "
        f"that paper assumes: errors of the displacements of {min(needed):.1g} to {max(needed):.1g} % of the push suffice to explain them, "
        "such as a damped motion that has not quite reached equilibrium, or numbers written with few digits.",
        f"With noise the errors accumulate from step to step: the largest median error is {worst:.1f} times that of the batch method, "
        "which uses the same equations simultaneously.",
    )
    caption = "Order of the incremental method, and the error of every triangle with noise."
    figure = Figure("Figure 3.8", caption, lambda canvas: _draw(canvas, growth))
    tables = (equation_counts(), table, _growth_table(growth))
    return Section("The square (3.3; Robomec paper of 2007)", text, tables, (figure,))


def equation_counts() -> Table:
    """Return Table 3.1: numbers of unknown moduli and of equations."""
    _, ((unknowns, equations),) = printed_table("3.1")
    body = square()
    zones, trials = body.zones(each_cell=True), body.load_cases()
    one, two = (batch_equilibrium_gap(body.mesh, trials[:k], zones, method="minimum_norm") for k in (1, 2))
    rows: tuple[tuple[Cell, ...], ...] = (
        ("unknown moduli", unknowns, one.unknowns),
        ("equations, one trial", equations, one.equations),
        ("equations, two trials", 2 * equations, two.equations),
        ("independent equations, one trial", None, one.rank),
        ("independent equations, two trials", None, two.rank),
    )
    return Table("Table 3.1", ("quantity", "paper", "ours"), rows, caption="Number of unknown moduli and of equations of the square.")


def two_triangles(seed: int, draws: int) -> Table:
    """Return Table 2 of the 2007 paper: triangles 13 and 14 from the equilibrium of node 13, all others known."""
    _, printed = printed_table("3-2d")
    rows: list[tuple[Cell, ...]] = []
    for values in printed:
        pushes = 1e3 * np.array(values[:4]).reshape(2, 2)
        body = square(tuple(pushes))
        paper = 1e-3 * np.array(values[4:])
        found = _of_two(body, 0.0, seed)
        spread = np.std([_of_two(body, SMALL_MM, seed + k)[0] for k in range(draws)])
        needed = 100.0 * SMALL_MM * abs(paper[0] - found[0]) / spread / np.linalg.norm(pushes, axis=1).max()
        pairs = [float(v) for pair in zip(paper, found, strict=True) for v in pair]
        rows.append((*(f"({x:g}, {y:g})" for x, y in pushes), *pairs, float(needed)))
    moduli = [f"{name}{cell}, kPa, {who}" for cell in (13, 14) for name in ("lambda", "mu") for who in ("paper", "ours")]
    return Table(
        "Table 2 (2007)",
        ("push 1 (x, y), mm", "push 2 (x, y), mm", *moduli, "noise that explains lambda13, % of the push"),
        tuple(rows),
        caption="Two unknown triangles after two pushes of the top; true lambda 10.74 kPa, mu 1.748 kPa.",
        note="The last column is the standard deviation of the displacement noise relative to the larger push, at which the printed lambda "
        "of triangle 13 would lie one standard deviation off. x to the left and y downwards are positive.",
    )


def _of_two(body: PushedBody, sd_mm: float, seed: int) -> FloatArray:
    """Return lambda and mu of triangle 13, then of 14, kPa."""
    lame, shear = body.moduli
    of_cell = np.full(body.mesh.n_cells, KNOWN)
    of_cell[[13, 14]] = 0, 1
    zones = Zones(of_cell, ("triangle 13", "triangle 14"), lame, shear)
    found = incremental_equilibrium_gap(body.mesh, body.load_cases(sd_mm=sd_mm, seed=seed), zones, order=(13,)).estimate
    return np.stack([found.lame_lambda, found.shear_modulus], axis=1).ravel()


def error_accumulation(seed: int, draws: int) -> ErrorAccumulation:
    """Return the errors of both methods over draws of noise of SD `STEP_NOISE_MM`."""
    body = square()
    zones = body.zones(each_cell=True)
    errors, batch = [], []
    for k in range(draws):
        trials = body.load_cases(sd_mm=STEP_NOISE_MM, seed=seed + k)
        result = incremental_equilibrium_gap(body.mesh, trials, zones, order=REPORT_ORDER)
        errors.append(np.abs(result.estimate.young_modulus / SQUARE[0] - 1.0))
        batch.append(np.abs(batch_equilibrium_gap(body.mesh, trials, zones).young_modulus / SQUARE[0] - 1.0))
    return ErrorAccumulation(result.steps, np.median(errors, axis=0), np.median(batch, axis=0))


def _growth_table(growth: ErrorAccumulation) -> Table:
    rows = tuple(
        (
            step.node,
            ", ".join(str(z) for z in step.zones),
            step.depth,
            step.condition,
            100.0 * float(growth.incremental[list(step.zones)].max()),
            100.0 * float(growth.batch[list(step.zones)].max()),
        )
        for step in growth.steps
    )
    return Table(
        "Incremental and batch",
        ("node", "triangles identified", "preceding steps", "condition number", "error, incremental, %", "error, batch, %"),
        rows,
        caption=f"Errors of Young's modulus in the report's order, with noise of {STEP_NOISE_MM:g} mm (medians).",
    )


def _draw(canvas: Canvas, growth: ErrorAccumulation) -> None:
    """Draw the triangles of the square, coloured by the error of each method, with the order of the nodes."""
    mesh = square().mesh
    panels = canvas.subplots(1, 2, sharey=True)
    top = 100.0 * float(growth.incremental.max())
    for axes, title, error in zip(panels, ("incremental", "batch"), (growth.incremental, growth.batch), strict=True):
        shown = _with_known(error, mesh.n_cells)
        image = axes.tripcolor(*mesh.points.T, mesh.cells, facecolors=100.0 * shown, vmin=0.0, vmax=top, edgecolors="white", cmap="viridis")
        axes.set(title=title, xlabel="x (mm)", aspect="equal")
    for number, step in enumerate(growth.steps, start=1):
        panels[0].annotate(str(number), mesh.points[step.node], color="k", ha="center", va="center", bbox={"fc": "w", "boxstyle": "circle"})
    panels[0].set_ylabel("y (mm)")
    canvas.colorbar(image, ax=panels, label="median error of E (%)")


def _with_known(values: FloatArray, n_cells: int) -> FloatArray:
    """Return values of the unknown cells, which come first, with NaN for the known ones."""
    return np.concatenate([values, np.full(n_cells - len(values), np.nan)])
