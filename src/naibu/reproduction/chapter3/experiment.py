"""Identification of a gel from measured markers, the marker grid as mesh: chapter 3.6.3 of the 2008 report :cite:p:`hirai2008`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from naibu import datasets
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.equilibrium_gap.batch import EquilibriumGapEstimate, batch_equilibrium_gap
from naibu.identification.equilibrium_gap.weighted import weighted_equilibrium_gap
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_markers.specimen.marker_mesh import MarkerMesh, marker_mesh
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw
from naibu.reproduction.chapter3 import figures as drawn
from naibu.reproduction.chapter3.bodies import LAYERS, Split, cube, split_hexahedra
from naibu.reproduction.chapter3.cubes import mean_error_percent
from naibu.reproduction.printed_tables import printed_table
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

EXPERIMENT = "ct_two_material_2"  # the report's: a plate on the whole top
OTHERS = {"ct_two_material_1": "bar", "ct_two_material_3": "plate, soft layer between hard ones"}
KNOWN, UNKNOWN = "hardness 5", "hardness 0"
MARKER_SD_MM, COMPLETED_SD_MM = 0.2, 0.5  # of a displacement; the latter where it was completed from the marker grid, or interpolated
NEARLY_INCOMPRESSIBLE = 0.47
Balanced = Literal["all but top and bottom", "inner"]
BALANCED: tuple[Balanced, ...] = get_args(Balanced)
Method = Literal["least_squares", "weighted"]
LAWS: tuple[SimplexLaw, ...] = ("linear", "neo_hookean")


@dataclass(frozen=True, slots=True, eq=False)
class MarkerLattice:
    """The marker grid of a compressed gel as a mesh of tetrahedra.

    Attributes
    ----------
    name : str
        Name of the experiment.
    source : MarkerMesh
        Marker grid, with nodes on the interfaces half way between markers.
    mesh : Mesh
        Tetrahedra; nodes without a cell are at the origin.
    shape : tuple of int
        Planes, rows and columns of nodes.
    """

    name: str
    source: MarkerMesh
    mesh: Mesh
    shape: tuple[int, int, int]

    def trial(self, balanced: Balanced) -> FieldLoadCase:
        """Return the measured state, in equilibrium at all nodes except those of top and bottom, or at the inner nodes only."""
        loaded = np.ones(self.shape, dtype=bool)
        if balanced == "inner":
            loaded.ravel()[self.source.interior] = False
        else:
            loaded[1:-1] = False
        sd = np.where(self.source.measured, MARKER_SD_MM, COMPLETED_SD_MM)
        field = DisplacementField.from_arrays(self.mesh.points, self.source.displacement, sd_mm=sd)
        return FieldLoadCase.of(self.name, field, self.mesh, loaded=loaded.ravel())


def marker_lattice(name: str, split: Split = "symmetric") -> MarkerLattice:
    """Return a bundled experiment with 5 x 5 markers per layer as tetrahedra (Fig. 3.42)."""
    source = marker_mesh(datasets.load(name), "deformed")
    rows = columns = 5
    planes = source.mesh.n_points // (rows * columns)
    low = source.mesh.cells.min(axis=1)
    index = np.column_stack([low % columns, low // columns % rows, low // (rows * columns)])
    cells = split_hexahedra(source.mesh.cells, index, split)
    regions = np.repeat(source.mesh.regions, 6)
    mesh = Mesh.from_arrays(source.mesh.points, cells, "tetra", regions=regions, region_names=source.mesh.region_names)
    return MarkerLattice(name, source, mesh, (planes, rows, columns))


def experiment_section() -> Section:
    """Return Table 3.7 and our results from the same markers."""
    body = marker_lattice(EXPERIMENT)
    errors = printed_errors(body)
    text = (
        "Two gels lie on each other; the upper one, hardness 5, is known, the lower one, hardness 0, is identified. The markers are the "
        "nodes of the mesh, with further nodes half way between the two layers at the interface (Fig. 3.42). Coordinates that are lost in "
        "the text of the report are completed from the marker grid.",
        "The report treats the nodes on the sides of the grid as traction-free, although 10 mm of gel lie outside. The residuals weighted "
        "by the marker noise show it: with the linear law chi squared per degree of freedom is many times larger there than at the inner "
        "nodes, and no iteration converges. The gel also shortens by a quarter between the outer markers, too much for the linear law.",
        "The printed moduli are not reproduced from the printed positions, neither by the report's method - two moduli for every "
        "tetrahedron, of minimum norm, averaged - nor with one pair for the gel. Linear tetrahedra as large as the marker spacing lock "
        "in a nearly incompressible gel, and at the interpolated interface both gels have the same strain. No row is a measurement of this "
        "gel; `naibu identify`, whose mesh is independent of the markers, provides one.",
        f"The printed error of Table 3.7, 5.51e-2 per cent, is a hundredth of what its own moduli give, "
        f"{float(errors.rows[2][2] or 0.0):.3g} per cent: it appears to be the ratio (3.35) itself. The report concludes from it that the "
        "error is below 1 per cent.",
    )
    figure = Figure("Figure 3.42", "Markers as nodes, and nodes on the interface.", lambda canvas: _draw(canvas, body), (8.0, 3.6))
    return Section("The experiment (3.6.3)", text, (table_3_7(body), errors, _other_experiments()), (figure,))


def table_3_7(body: MarkerLattice) -> Table:
    """Return Table 3.7, that of the SI2007 paper, and ours from the markers of the same experiment."""
    (hard, soft), (tested, result) = printed_table("3.7")[1], printed_table("3.7b")[1]
    other = printed_table("3.5b")[1][0][2]
    empty = (None,) * 4
    rows: list[tuple[Cell, ...]] = [
        ("compression test (Tables 3.4, 3.5)", None, hard[3], 1e-3 * soft[2], soft[3], *empty),
        ("paper, Table 3.7", None, hard[3], 1e-3 * soft[4], soft[5], *empty),
        ("compression test, SI2007 paper", None, other, 1e-3 * tested[1], tested[2], *empty),
        ("paper, SI2007", None, other, 1e-3 * result[1], result[2], *empty),
    ]
    for nu in (hard[3], NEARLY_INCOMPRESSIBLE):
        rows += [_single_cells(body, nu, balanced) for balanced in BALANCED]
        rows += [_one_pair(body, nu, "inner", law, "least_squares") for law in LAWS]
        rows += [_one_pair(body, nu, balanced, law, "weighted") for balanced in BALANCED for law in LAWS]
    columns = (
        "method",
        "nodes in equilibrium",
        "nu of the known gel",
        "E, kPa",
        "nu",
        "SD of E, kPa",
        "SD of nu",
        "chi2 / dof",
        "equilibrium gap, %",
    )
    note = (
        "The SI2007 paper exchanges the Poisson ratios of the gels. A weighted equilibrium gap that does not converge within its limit of "
        "iterations gives no moduli: the likelihood then hardly depends on them. A Poisson ratio above 0.5 (least squares) is not physical."
    )
    return Table(
        "Table 3.7",
        columns,
        tuple(rows),
        caption=f"The unknown gel, hardness 0, with E 222 kPa of the known one; experiment {EXPERIMENT}.",
        note=note,
    )


def _single_cells(body: MarkerLattice, nu: float, balanced: Balanced) -> tuple[Cell, ...]:
    """Return the result of the report's method: two moduli per tetrahedron, of minimum norm, averaged."""
    zones = Zones.of(body.mesh, known={KNOWN: (222.0, nu)}, each_cell=True)
    found = batch_equilibrium_gap(body.mesh, [body.trial(balanced)], zones, method="minimum_norm")
    e, poisson = float(found.young_modulus.mean()), float(found.poisson_ratio.mean())
    return ("every tetrahedron, minimum norm, mean (the report's)", balanced, nu, e, poisson, None, None, None, 100.0 * found.residual)


def _one_pair(body: MarkerLattice, nu: float, balanced: Balanced, law: SimplexLaw, method: Method) -> tuple[Cell, ...]:
    """Return the result with one pair of moduli for the gel."""
    zones, trial = Zones.of(body.mesh, known={KNOWN: (222.0, nu)}), body.trial(balanced)
    name = f"one pair, {law.replace('_', '-')}, {method.replace('_', ' ')}"
    try:
        found = _estimate(body.mesh, trial, zones, law, method)
    except InputError:  # a cell is inverted at the first step
        return (f"{name}: no result", balanced, nu, *(None,) * 6)
    weighted = method == "weighted"
    chi = found.chi_squared / found.degrees_of_freedom if weighted else None
    if not found.status.ok:
        return (f"{name}: not converged", balanced, nu, *(None,) * 4, chi, None)
    spread: tuple[Cell, Cell] = (float(found.engineering_deviation[0, 0]), float(found.engineering_deviation[0, 1]))
    e, poisson = float(found.young_modulus[0]), float(found.poisson_ratio[0])
    return (name, balanced, nu, e, poisson, *(spread if weighted else (None, None)), chi, 100.0 * found.residual)


def _estimate(mesh: Mesh, trial: FieldLoadCase, zones: Zones, law: SimplexLaw, method: Method) -> EquilibriumGapEstimate:
    if method == "least_squares":
        return batch_equilibrium_gap(mesh, [trial], zones, law=law)
    return weighted_equilibrium_gap(mesh, [trial], zones, law=law, max_sweeps=60)


def printed_errors(body: MarkerLattice) -> Table:
    """Return the error (3.35) of the printed moduli of whole regions, with the displacement of the experiment, and the printed error."""
    moved = body.source.displacement[:, 2].reshape(body.shape[0], -1).mean(axis=1)
    push = float(moved[0] - moved[-1])
    (first,), layers = printed_table("3.2")[1], printed_table("3.3")[1]
    (hard, soft), (tested, identified) = printed_table("3.7")[1], printed_table("3.7b")[1]
    uniform = mean_error_percent(cube(), {"lower half": (1e-3 * first[2], first[3])})
    two = mean_error_percent(cube(LAYERS), {name: (1e-3 * row[3], row[4]) for name, row in zip(LAYERS, layers, strict=True)})
    down, known = ((0.0, 0.0, -push),), (1e-3 * hard[2], hard[3])
    gels = cube({"lower half": (1e-3 * soft[2], soft[3])}, known=known, pushes=down)
    others = cube({"lower half": (1e-3 * tested[1], tested[2])}, known=(known[0], printed_table("3.5b")[1][0][2]), pushes=down)
    rows: tuple[tuple[Cell, ...], ...] = (
        ("Table 3.2", first[4], uniform),
        ("Table 3.3, both layers", layers[-1][5], two),
        ("Table 3.7, hardness 0", soft[6], mean_error_percent(gels, {"lower half": (1e-3 * soft[4], soft[5])})),
        ("SI2007, hardness 0", None, mean_error_percent(others, {"lower half": (1e-3 * identified[1], identified[2])})),
    )
    return Table(
        "Error (3.35) of the printed moduli",
        ("moduli of", "printed error, %", "ours, %"),
        rows,
        caption="Simulation with the true and with the printed identified moduli, as means of whole regions.",
        note=f"Simulations of the experiment: a cube of 40 mm, base fixed, top face moved {push:.1f} mm down, which is the relative "
        "displacement of the highest and the lowest markers.",
    )


def _other_experiments() -> Table:
    """Return the results for the further two-material cubes: inner nodes, weighted."""
    rows: list[tuple[Cell, ...]] = []
    for name, what in OTHERS.items():
        body = marker_lattice(name)
        for nu in (0.33, NEARLY_INCOMPRESSIBLE):
            row = _one_pair(body, nu, "inner", "neo_hookean", "weighted")
            rows.append((name, what, "no" if ":" in str(row[0]) else "yes", *row[2:8]))
    columns = ("experiment", "loading", "converged", "nu of the known gel", "E, kPa", "nu", "SD of E, kPa", "SD of nu", "chi2 / dof")
    return Table("Other cubes", columns, tuple(rows), caption="Hardness 0 in further experiments: inner nodes, neo-Hookean, weighted.")


def _draw(canvas: Canvas, body: MarkerLattice) -> None:
    points = body.mesh.points.reshape(*body.shape, 3)
    moved = (body.mesh.points + body.source.displacement).reshape(*body.shape, 3)
    interpolated = np.asarray(~body.source.measured.reshape(*body.shape, 3).any(axis=(1, 2, 3)))
    drawn.marker_mesh_views(canvas, points, moved, interpolated)
