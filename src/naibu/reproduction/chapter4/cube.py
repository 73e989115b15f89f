"""Calibration of a cube of dough as classic and octree lattices: Tables III to VI of the 2008 report :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.forward_model import Capture, PushedLattice
from naibu.identification.lattice_calibration.gauss_newton import CalibrationProblem, calibrate_lattice
from naibu.identification.lattice_calibration.report_indices import ReportIndices, indices_of
from naibu.identification.lattice_calibration.unknowns import LatticeUnknowns
from naibu.mechanics.lattices.model.lattice import Lattice, box_mask, classic_lattice
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.reproduction.chapter4.lattice_figures import FinalShape, final_shapes
from naibu.reproduction.chapter4.patterns import START, with_interval_factor
from naibu.reproduction.printed_tables import printed_table
from naibu.validation.specimens.lattice_twin import (
    CUBE_CM,
    CUBE_G,
    CUBE_PUSHING,
    FORCE_SD_MN,
    POINT_SD_MM,
    POINTS,
    dough_lattice,
    dough_parameters,
    virtual_capture,
)
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

MODELS = ("classic", "type 0", "type 1", "type 2")
TABLES = {8: ("4-III", "4-V"), 16: ("4-IV", "4-VI")}  # calibrated parameters and shape differences, by voxels per edge
FIGURES = {8: "Fig. 13", 16: "Fig. 14"}
ORDERS = ("1st", "2nd", "3rd")
EDGE_MM = 10.0 * CUBE_CM[0]


def chapter4_cube(seed: int = 0, *, points: int = POINTS, sizes: tuple[int, ...] = (8, 16)) -> Chapter:
    """Reproduce Tables III to VI: classic and octree lattices calibrated on a virtual twin of the cube.

    Parameters
    ----------
    seed : int
        Seed of the twin's noise.
    points : int
        Number of captured points.
    sizes : tuple of int
        Voxels per edge, among 8 and 16.
    """
    settings: dict[str, Cell] = {"seed": seed, "points": points, "point_sd_mm": POINT_SD_MM, "force_sd_mn": FORCE_SD_MN}
    cubes: list[CalibratedCube] = []
    for n in sorted(sizes):
        cubes.append(calibrated_cube(n, seed, points, coarser=cubes[-1] if cubes else None))
    sections = tuple(cube_section(cube) for cube in cubes)
    return Chapter("ch4-cube", "Chapter 4.3: a cube of dough as classic and octree lattices", sections, settings)


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCube:
    """A twin of the cube of n voxels per edge, and the lattices of all models calibrated on it."""

    n: int
    capture: Capture
    lattices: tuple[Lattice, ...]
    fits: tuple[LatticeEstimate, ...]


def calibrated_cube(n: int, seed: int, points: int, *, coarser: CalibratedCube | None = None) -> CalibratedCube:
    """Return the cube of n voxels per edge, calibrated on a twin with half the node spacing.

    The searches begin from the same models of a `coarser` cube, if there is one; weak priors stay around the initial guess.
    """
    spacing = EDGE_MM / n
    truth = dough_lattice(spacing / 2.0, size_cm=CUBE_CM, mass_g=CUBE_G)
    capture = virtual_capture(truth, dough_parameters(truth, zones=True), CUBE_PUSHING, seed=seed, points=points)
    mask, mass = box_mask((n, n, n)), 1e-3 * CUBE_G
    lattices = [classic_lattice(mask, spacing, total_mass_kg=mass)]
    lattices += [octree_lattice(mask, spacing, kind, total_mass_kg=mass, scaling="edge") for kind in range(3)]
    fits: list[LatticeEstimate] = []
    for k, lattice in enumerate(lattices):
        unknowns = LatticeUnknowns.of(lattice, classes=False, levels=True)
        start = {name: value * spacing / 10.0 for name, value in START.items()}
        near = None if coarser is None else _scaled(coarser.fits[k], unknowns, coarser.n / n)
        problem = CalibrationProblem.of(lattice, [capture], unknowns)
        fits.append(calibrate_lattice(problem, start, max_iterations=80, warm_start=near))
    return CalibratedCube(n, capture, tuple(lattices), tuple(fits))


def _scaled(fit: LatticeEstimate, unknowns: LatticeUnknowns, factor: float) -> FloatArray:
    """Return the values of another estimate times a factor; of levels that it does not have, those of its highest one."""
    known = dict(zip(fit.unknowns.names, fit.values, strict=True))
    found = []
    for name in unknowns.names:
        kind, _, level = name.split()
        found.append(next(known[f"{kind} level {k}"] for k in range(int(level), -1, -1) if f"{kind} level {k}" in known))
    return factor * np.array(found)


def cube_section(cube: CalibratedCube) -> Section:
    """Return the tables of a calibrated cube."""
    n, capture, fits = cube.n, cube.capture, list(cube.fits)
    text = (
        "A cube of 8 cm and 630 g, compressed at two opposite sides by indenters 2 cm wide. One set of K, C1 and C2 for every level of the "
        f"octree, as in the report, calibrated on shape and force of one twin, with a node spacing of {EDGE_MM / n / 2.0:g} mm and a "
        "different surface. The units printed with the parameters cannot be those of a spring (gf/cm^3): they are shown as printed.",
    )
    title = f"{n + 1} x {n + 1} x {n + 1} nodes"
    pushed = [PushedLattice.of(lattice, capture.pushing) for lattice in cube.lattices]
    motions = [p.run(fit.parameters()) for p, fit in zip(pushed, fits, strict=True)]
    shapes = [FinalShape.of(model, capture, p, m) for model, p, m in zip(MODELS, pushed, motions, strict=True)]
    figure = Figure(
        FIGURES[n], "Final shapes, and captured points that lie 2.5 mm or more away from them (orange).", final_shapes(shapes), (8.0, 7.0)
    )
    found = [indices_of(capture, p, m) for p, m in zip(pushed, motions, strict=True)]
    return Section(title, text, (_parameters(n, fits), _differences(n, found)), (figure,))


def _parameters(n: int, fits: list[LatticeEstimate]) -> Table:
    number = TABLES[n][0]
    _, printed = printed_table(number)
    rows: list[tuple[Cell, ...]] = []
    for name, *cells in printed:
        kind, order = str(name).split("_")
        found: list[Cell] = []
        for fit in fits:
            own = f"{kind} level {ORDERS.index(order)}"
            found.append(with_interval_factor(fit, fit.unknowns.names.index(own)) if own in fit.unknowns.names else None)
        rows.append((name, *cells, *found))
    columns = ("parameter", *(f"paper, {m}" for m in MODELS), *(f"ours, {m}, mN/mm or mN s/mm" for m in MODELS))
    note = (
        "1st: between the finest nodes; 2nd and 3rd: in cubes of two and four voxels per edge, referred to one voxel; the values of an "
        "element are larger by its scaling factor. a is not determined by any data (it has no effect) and is not calibrated."
    )
    return Table(f"Table {number[2:]}", columns, tuple(rows), caption=f"Calibrated parameters, {n + 1} nodes per edge.", note=note)


def _differences(n: int, found: list[ReportIndices]) -> Table:
    number = TABLES[n][1]
    _, printed = printed_table(number)
    rows: list[tuple[Cell, ...]] = []
    for time, *cells in printed:
        chosen = range(5) if time == "sum" else [int(time) - 1]
        for k, (model, ours) in enumerate(zip(MODELS, found, strict=True)):
            distance, points = sum(ours.shape_mm[i] for i in chosen), sum(ours.points[i] for i in chosen)
            rows.append((time, model, cells[k], distance / 1e3, cells[4 + k], distance / points))
    rows += [("S_force, N", model, None, ours.force_mn / 1e3, None, None) for model, ours in zip(MODELS, found, strict=True)]
    columns = ("time", "lattice", "paper, sum, m", "ours, sum, m", "paper, mean, mm", "ours, mean, mm")
    note = "The 4 to 5 mm per point of the paper include registration errors, ours none."
    if number == "4-V":
        note = f"The report prints the octrees' means at the second time in cm. {note}"
    return Table(f"Table {number[2:]}", columns, tuple(rows), caption=f"S_shape at five times, {n + 1} nodes per edge.", note=note)
