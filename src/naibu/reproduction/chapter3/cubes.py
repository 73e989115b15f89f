"""Identification of every tetrahedron of a cube: Tables 3.2, 3.3 and Figs. 3.9 to 3.19 of the 2008 report :cite:p:`hirai2008`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.identification.equilibrium_gap.batch import batch_equilibrium_gap
from naibu.reproduction.chapter3 import figures as drawn
from naibu.reproduction.chapter3.bodies import LAYERS, PushedBody, Split, cube, shape_error_percent
from naibu.reproduction.chapter3.cell_identification import SIDE_MM, SIDEWAYS, CellResult, identify_cells
from naibu.reproduction.printed_tables import printed_table
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

SPLITS: tuple[Split, ...] = get_args(Split)
# ranges of single elements in the text of 3.4.1 and 3.4.2: Young's modulus, Pa, and Poisson's ratio. The text gives those of layer 1 with
# the true Poisson ratio of layer 2, see the notes of the paper's table.
PRINTED_RANGES = {
    "lower half": ((240.0, 670.0), (0.39, 0.46)),
    "layer 1": ((60.0, 460.0), (0.35, 0.47)),
    "layer 2": ((450.0, 630.0), (0.35, 0.46)),
}
# the most frequent results of single elements, in the same text
PRINTED_MODES = {"lower half": ("430-440, 450-460", "0.41-0.42"), "layer 1": ("460", "0.35"), "layer 2": ("evenly spread", None)}
E_BIN_PA, NU_BIN, FREQUENT = 10.0, 0.01, 3


def uniform_section() -> Section:
    """Return Table 3.2 and Figs. 3.9, 3.11 to 3.13."""
    results: dict[str, CellResult] = {split: identify_cells(cube(split=split)) for split in SPLITS}
    _, ((e, nu, e_found, nu_found, error),) = printed_table("3.2")
    text = (
        "A cube of 40 mm, 4 x 4 x 4 cells of six tetrahedra, is fixed to the floor; its top is moved 10 mm down. The upper half is known, "
        f"all moduli of the lower half are unknown: {results['symmetric'].estimate.equations} equations for "
        f"{results['symmetric'].estimate.unknowns} unknowns, none of which they determine individually, so the solution of minimum norm is "
        "used.",
        "The report shows its meshes in a figure only. A mesh whose cells are mirror images of their neighbours spreads the moduli nearly "
        "as printed, one of equal cells far more; so the former is assumed to be Fig. 3.9 (a), the latter (b): even the most frequent "
        "values of the report are among ours. The moduli of the known half are not printed; 500 Pa and 0.43 are assumed. The data are "
        "exact: the whole spread is the choice of the method among solutions.",
        "The error (3.35) of a solution of minimum norm is rounding error, whatever the moduli are, because it is in equilibrium at every "
        "node. That the report prints more shows that its displacements were not quite in equilibrium. Under a sideways displacement of "
        "the top, which was not used for identification, the error is larger than rounding.",
    )
    rows: list[tuple[Cell, ...]] = [("true", e, nu, *(None,) * 8)]
    rows.append(
        (
            "paper, symmetric",
            e_found,
            nu_found,
            *PRINTED_RANGES["lower half"][0],
            *PRINTED_RANGES["lower half"][1],
            *PRINTED_MODES["lower half"],
            error,
            None,
        )
    )
    rows += [(f"ours, {split}", *_moments(result, "lower half"), result.error, result.sideways) for split, result in results.items()]
    table = Table("Table 3.2", _columns(), tuple(rows), caption="Uniform parameters, every tetrahedron unknown.", note=_DEFINITION)
    found, shown = results["symmetric"], {split: result.body.mesh for split, result in results.items()}
    figures = (
        Figure("Figure 3.9", "The two meshes: faces of the cube.", lambda c: drawn.meshes(c, shown)),
        Figure("Figure 3.11", "Moduli of every unknown tetrahedron (symmetric mesh).", lambda c: drawn.by_cell(c, found, "lower half")),
        Figure("Figure 3.12", "Distribution of the moduli.", lambda c: drawn.histograms(c, found, "lower half", PRINTED_RANGES)),
        Figure("Figure 3.13", "Front of the deformed cube with true and with identified moduli.", lambda c: drawn.deformed(c, found)),
    )
    return Section("Uniform parameters (3.4.1)", text, (table,), figures)


_DEFINITION = (
    "Error (3.35): squared distances of all nodes added up, over width times height, times 100. Moduli of single tetrahedra are averaged "
    "as in the report."
)


def _columns() -> tuple[str, ...]:
    return (
        "what",
        "E mean, Pa",
        "nu mean",
        "E lowest, Pa",
        "E highest, Pa",
        "nu lowest",
        "nu highest",
        "most frequent E, Pa",
        "most frequent nu",
        "error (3.35), %",
        "error (3.35) of a push from the side, %",
    )


def _moments(result: CellResult, layer: str) -> tuple[Cell, ...]:
    """Return the means of E and nu, the ranges of E, Pa, and nu, and their most frequent values."""
    at = result.layer(layer)
    e, nu = 1e3 * result.estimate.young_modulus[at], result.estimate.poisson_ratio[at]
    numbers = (e.mean(), nu.mean(), e.min(), e.max(), nu.min(), nu.max())
    return *map(float, numbers), most_frequent(e, E_BIN_PA), most_frequent(nu, NU_BIN)


def most_frequent(values: FloatArray, width: float) -> str:
    """Return the fullest bins of a histogram of given bin width, the fullest first, as ``"430-440, 450-460"``."""
    bins, count = np.unique(np.floor(values / width), return_counts=True)
    fullest = bins[np.argsort(-count, kind="stable")][:FREQUENT]
    return ", ".join(f"{k * width:.{0 if width >= 1.0 else 2}f}-{(k + 1.0) * width:.{0 if width >= 1.0 else 2}f}" for k in fullest)


def layer_section() -> Section:
    """Return Table 3.3 and Figs. 3.15 to 3.19."""
    results: dict[str, CellResult] = {split: identify_cells(cube(LAYERS, split=split)) for split in SPLITS}
    _, printed = printed_table("3.3")
    rows: list[tuple[Cell, ...]] = []
    for layer, (_, e, nu, e_found, nu_found, error) in zip(LAYERS, printed, strict=True):
        ranges = PRINTED_RANGES[layer]
        rows.append((f"{layer}, true", e, nu, *(None,) * 8))
        rows.append((f"{layer}, paper", e_found, nu_found, *ranges[0], *ranges[1], *PRINTED_MODES[layer], error, None))
        rows += [(f"{layer}, ours, {s}", *_moments(r, layer), r.error, r.sideways) for s, r in results.items()]
    note = (
        f"{_DEFINITION} One error is printed for both layers. The printed mean nu of layer 2, 0.32, lies outside the printed range of its "
        "elements."
    )
    table = Table(
        "Table 3.3",
        _columns(),
        tuple(rows),
        caption="Two unknown layers, every tetrahedron unknown.",
        note=note,
    )
    found = results["symmetric"]
    figures: list[Figure] = []
    for layer, numbers in zip(LAYERS, (("3.15", "3.16"), ("3.17", "3.18")), strict=True):
        figures += [
            Figure(f"Figure {numbers[0]}", f"Moduli of every tetrahedron, {layer}.", lambda c, at=layer: drawn.by_cell(c, found, at)),  # type: ignore[misc]
            Figure(
                f"Figure {numbers[1]}",
                f"Distribution of the moduli, {layer}.",
                lambda c, at=layer: drawn.histograms(c, found, at, PRINTED_RANGES),  # type: ignore[misc]
            ),
        ]
    figures.append(
        Figure("Figure 3.19", "Front of the deformed cube with true and with identified moduli.", lambda c: drawn.deformed(c, found))
    )
    text = (
        "The unknown half has two layers, 250 Pa with 0.43 next to the floor and 500 Pa with 0.38 above. Means over a layer are close to "
        "the truth, as the report states, and even its mean of 0.32 for a true 0.38 is reproduced; single tetrahedra are not identified.",
    )
    return Section("Two layers (3.4.2)", text, (table,), tuple(figures))


def identifiability_section() -> Section:
    """Return what meshes and load cases can determine at all."""
    down, aside, across = (0.0, 0.0, -10.0), SIDEWAYS, (0.0, 10.0, 0.0)
    bent = np.random.default_rng(0).normal((0.0, 0.0, -5.0), 3.0, (6, 25, 3))
    cases: dict[str, Sequence[ArrayLike]] = {
        "1: down": (down,),
        "2: down, sideways": (down, aside),
        "3: down, and both ways sideways": (down, aside, across),
        "6: every node of the top displaced independently": tuple(bent),
    }
    rows: list[tuple[Cell, ...]] = []
    for split in SPLITS:
        for name, pushes in cases.items():
            body = cube(LAYERS, split=split, pushes=pushes)
            zones = body.zones(each_cell=True)
            found = batch_equilibrium_gap(body.mesh, body.load_cases(), zones, method="minimum_norm")
            fixed = found.determined.all(axis=1)
            truth = np.array([LAYERS[zone.split(":")[0]][0] for zone in zones.names])
            error = float(np.abs(found.young_modulus / truth - 1.0)[fixed].max()) if fixed.any() else None
            rows.append((split, name, found.equations, found.unknowns, found.rank, int(fixed.sum()), zones.count, error))
    columns = ("mesh", "load cases", "equations", "unknowns", "rank", "tetrahedra determined", "of", "their largest relative error of E")
    table = Table("Meshes and load cases", columns, tuple(rows), caption="Moduli determined by exact displacements.")
    text = (
        "Rigid motions of the top give at most three independent load cases, as the body is linear. Even if the nodes of the top move "
        "independently the rank stays below the number of unknowns: two moduli per tetrahedron are more than nodal equilibrium can "
        "determine, on either mesh. What is determined is recovered exactly. More load cases do not help; fewer unknowns do.",
    )
    return Section("Identifiability by mesh and load cases", text, (table,))


def mean_error_percent(body: PushedBody, found: Mapping[str, tuple[float, float]]) -> float:
    """Return the error (3.35), per cent, for other Young's moduli, kPa, and Poisson's ratios of whole regions."""
    other = PushedBody(body.name, body.mesh, {**body.truth, **found}, body.known, body.pushes, body.law)
    first, second = body.displacement(body.pushes[0]), other.displacement(body.pushes[0])
    return shape_error_percent(first, second, SIDE_MM, SIDE_MM)
