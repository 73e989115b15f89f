"""Chapter 2 of the 2008 report :cite:p:`hirai2008`: squares loaded and released, agar under a weight (ultrasound) and a bar (MR)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.mechanics.small_strain.rheology import Rheology
from naibu.reproduction.chapter2 import figures as drawn
from naibu.reproduction.chapter2.agar_identification import agar_section
from naibu.reproduction.chapter2.image_sequence import sequence_section
from naibu.reproduction.chapter2.marker_measurements import (
    MARKER_HEIGHT_MM,
    TRIALS,
    MarkerMeasurement,
    magnetic_resonance_measurement,
    ultrasound_trial,
)
from naibu.reproduction.chapter2.simulations import (
    AGAR,
    AGAR_PUSH_MM,
    ASSUMED,
    MR_SIZE_MM,
    PHASES_S,
    SQUARES,
    Study,
    agar_block,
    agar_block_3d,
    agar_under_bar,
    pushed_square,
)
from naibu.validation.analytic.viscoelastic import released_strain, residual_strain
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

COMPARED = (2, 3, 4)  # markers
REPORTED_ERROR_MM = {2: (1.0, 0.5), 3: (1.8, 0.5), 4: (2.8, 0.2)}  # trial 1, weight one mesh left of the middle


def chapter2(seed: int = 0, *, step_s: float = 0.05, divisions: int = 10, cell_mm: float = 3.75) -> Chapter:
    """Reproduce chapter 2.

    Parameters
    ----------
    seed : int
        Of the noise of the virtual scanner.
    step_s, divisions : float and int
        Time step of the squares, s, and their cells per edge.
    cell_mm : float
        Edge length of the cells of the three-dimensional agar block, mm.
    """
    readings = {name: ultrasound_trial(name) for name in TRIALS}
    agar = agar_section({name: (seen.start, seen.displacement) for name, seen in readings.items()}, cell_mm=max(cell_mm, 5.0))
    sections = (_squares(step_s, divisions), _ultrasound(cell_mm), agar, _magnetic_resonance(), sequence_section(seed))
    settings: dict[str, Cell] = {"seed": seed, "step_s": step_s, "divisions": divisions, "cell_mm": cell_mm, **ASSUMED}
    return Chapter("ch2", "Chapter 2: internal deformation of viscoelastic objects, simulated and measured", sections, settings)


def _squares(step_s: float, divisions: int) -> Section:
    studies = [pushed_square(name, step_s=step_s, divisions=divisions) for name in SQUARES]
    columns = ("square", "E, C1, C2 as printed", "relaxation time, s", "retardation time, s", "residual, ours, % of the indentation",
               "residual, closed form, %", "permanent, closed form, %", "force at 10 s, mN/mm", "force at 20 s, mN/mm")  # fmt: skip
    rows = tuple(_square_row(study) for study in studies)
    note = (
        "The report prints no numbers for these simulations, only shapes; it states that the viscoplastic and the rheological square keep "
        "deformation. Residual: displacement of the middle of the top at 30 s. Closed form: without inertia every point of a homogeneous "
        "body follows the one-dimensional three-element (Jeffreys) model. The elastic square has inertia and no damping, so it vibrates "
        "about its undeformed shape: its row gives the mean over the 10 s after release. Forces are per mm of thickness, in the units of "
        "the squares."
    )
    snapshots = [
        Figure(f"Fig. {i} (paper)", f"The {s.name} at seven times.", drawn.snapshots(s), (10.0, 2.0))
        for i, s in enumerate(studies, start=1)
    ]
    curves = Figure(
        "Loaded point", "Displacement of the middle of the top, and force of the indenter, against time.", drawn.curves(studies), (8.0, 3.2)
    )
    text = (
        f"A square fixed to the floor is indented in the middle of its top until {PHASES_S[0]:g} s, kept so until {PHASES_S[1]:g} s, and "
        "released until 30 s. Until release all three have the same shape, except for inertia: with one material and equal Poisson ratios, "
        "the displacements under prescribed displacements do not depend on the moduli. Only the forces and the recovery differ."
    )
    return Section(
        "Three squares, indented and released",
        (text,),
        (Table("Squares", columns, rows, caption="Residual deformation after release.", note=note),),
        (*snapshots, curves),
    )


def _square_row(study: Study) -> tuple[Cell, ...]:
    m, series = study.material, study.series
    elements = m.young_modulus, m.voigt_viscosity, m.series_viscosity
    y = -series.displacement[:, study.middle_top, 1]
    push = float(y.max())
    calm = series.times > PHASES_S[1] if np.isinf(m.relaxation_time) else series.times >= PHASES_S[2]
    force = -series.force("indenter")[:, 1]
    at = [float(force[int(np.argmin(np.abs(series.times - t)))]) for t in PHASES_S[:2]]
    constrained = PHASES_S[1] - PHASES_S[0]
    closed = float(released_strain(elements, 1.0, PHASES_S[0], constrained, [PHASES_S[2]])[0])
    for_good = residual_strain(elements, 1.0, PHASES_S[0], constrained)
    printed = ", ".join(f"{value:g}" if np.isfinite(value) else "none" for value in elements)
    kept = 100.0 * float(y[calm].mean()) / push
    return study.name, printed, m.relaxation_time, m.retardation_time, kept, 100.0 * closed, 100.0 * for_good, *at


def _ultrasound(cell_mm: float) -> Section:
    trials = {name: ultrasound_trial(name) for name in TRIALS}
    middle, left = agar_block(), agar_block(shifted_cells=1.0)
    text = (
        "A block of agar, 75 x 75 x 30 mm, under a weight 40 mm wide that sinks by 7.5 mm. In a homogeneous body with equal Poisson ratios "
        "the displacement under a prescribed indentation does not depend on E, C1 and C2: only the Poisson ratio, the boundary conditions "
        "and the position of the weight matter. The markers therefore test these, and the linear law at a strain of 25 %, not the "
        "printed moduli, which only affect the force of the weight.",
        "The report's errors are those of its plane simulation with the weight one cell left of the middle, against trial 1. They give its "
        "simulated displacements up to a sign; ours differ from those by some tenths of a mm, which boundary conditions and grid points "
        "that are not described can explain.",
    )
    figures = (
        Figure("Fig. 2.4", "Markers before and after, measured.", drawn.measured_markers(trials), (7.0, 3.0)),
        Figure("Fig. 2.9", "The simulated block under the weight.", drawn.deformed_block(left, 6.0), (7.0, 3.0)),
        Figure("Fig. 2.10", "Paths of markers 2, 3 and 4: solid, weight in the middle; dashed, one cell left; crosses, measured.",
               drawn.marker_paths(middle, left, trials, COMPARED), (8.5, 3.0)),
    )  # fmt: skip
    tables = (_table_2_1(trials, middle, left), _table_of_errors(trials, middle, left), _table_of_variants(trials, cell_mm))
    return Section("Agar under a weight, measured by ultrasound", text, tables, figures)


def _table_2_1(trials: dict[str, MarkerMeasurement], middle: Study, left: Study) -> Table:
    columns = ("trial", "marker", "initial x, mm", "initial y, mm", "moved x, mm", "moved y, mm",
               "middle, x, mm", "middle, y, mm", "one cell left, x, mm", "one cell left, y, mm")  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for name, seen in trials.items():
        simulated = [study.displacement_at(seen.start, 6.0) for study in (middle, left)]
        for i, marker in enumerate(seen.ids):
            first = seen.start[i] - np.array([0.0, MARKER_HEIGHT_MM])
            values = [*first, *seen.displacement[i], *simulated[0][i], *simulated[1][i]]
            rows.append((name, int(marker), *[float(v) for v in values]))
    note = (
        "Positions and displacements measured (resolution 0.5 mm), and displacements simulated at the measured initial positions, 20 mm "
        "above the floor for y = 0. Trial 2 began with the middle marker at y = -3: the block had not recovered, or the origin was kept."
    )
    return Table("Table 2.1", columns, tuple(rows), caption="Marker displacements by ultrasound, and ours.", note=note)


def _table_of_errors(trials: dict[str, MarkerMeasurement], middle: Study, left: Study) -> Table:
    columns = ("marker", "report x, mm", "report y, mm", "ours, trial 1, x, mm", "ours, trial 1, y, mm", "middle, trial 1, x, mm",
               "middle, trial 1, y, mm", "ours, trial 2, x, mm", "ours, trial 2, y, mm")  # fmt: skip
    errors = [marker_errors(study, trials[trial]) for study, trial in ((left, "trial1"), (middle, "trial1"), (left, "trial2"))]
    rows = tuple(
        (marker, *REPORTED_ERROR_MM[marker], *[float(v) for error in errors for v in error[i]]) for i, marker in enumerate(COMPARED)
    )
    note = (
        "Report and 'ours': weight one cell left of the middle. As in the report, the simulation is evaluated at grid points in place of "
        "the markers, 10 mm apart in the row 10 mm below the top."
    )
    return Table("Errors against ultrasound", columns, rows, caption="Difference of simulated and measured displacement.", note=note)


def marker_errors(study: Study, seen: MarkerMeasurement) -> FloatArray:
    """Return the absolute errors (3, 2), mm, of the simulated markers 2, 3 and 4, evaluated at grid points as in the report."""
    rest = (0.0,) * (study.mesh.dimension - 2)
    lattice = [(10.0 * (marker - 3), *rest, MARKER_HEIGHT_MM) for marker in COMPARED]
    simulated = study.displacement_at(lattice, study.series.times[-1])[:, [0, -1]]
    chosen = np.searchsorted(seen.ids, COMPARED)
    return np.asarray(np.abs(simulated - seen.displacement[chosen]))


def _table_of_variants(trials: dict[str, MarkerMeasurement], cell_mm: float) -> Table:
    softer = with_poisson_ratio(AGAR, 0.45)
    variants = (
        ("as the report: no slip at weight and floor, nu 0.35, one cell left", agar_block(shifted_cells=1.0)),
        ("weight in the middle", agar_block()),
        ("frictionless weight", agar_block(shifted_cells=1.0, weight_sticks=False)),
        ("frictionless floor", agar_block(shifted_cells=1.0, floor_sticks=False)),
        ("frictionless weight and floor", agar_block(shifted_cells=1.0, weight_sticks=False, floor_sticks=False)),
        ("nu 0.45", agar_block(shifted_cells=1.0, material=softer)),
        ("nu 0.49", agar_block(shifted_cells=1.0, material=with_poisson_ratio(AGAR, 0.49))),
        ("three dimensions, round weight, nu 0.35", agar_block_3d(shift_mm=2.5, cell_mm=cell_mm)),
        ("three dimensions, round weight, nu 0.45", agar_block_3d(shift_mm=2.5, cell_mm=cell_mm, material=softer)),
    )
    rows: list[tuple[Cell, ...]] = []
    for name, study in variants:
        errors = [marker_errors(study, trials[trial]) for trial in TRIALS]
        force = -float(study.series.force("weight")[-1, -1]) * 1e-3
        rows.append((name, *[float(np.sqrt((e[:, a] ** 2).mean())) for e in errors for a in (0, 1)], force))
    reported = np.array(list(REPORTED_ERROR_MM.values()))
    printed: tuple[Cell, ...] = ("printed in the report", *[float(v) for v in np.sqrt((reported**2).mean(axis=0))], None, None, None)
    columns = ("simulation", "trial 1, RMS x, mm", "trial 1, RMS y, mm", "trial 2, RMS x, mm", "trial 2, RMS y, mm", "force at the end, N")
    note = (
        f"Indentation {AGAR_PUSH_MM:g} mm throughout; forces 6 s after its start; the weight is 4.9 N. Plane strain assumes a weight "
        "as deep as the block, three dimensions a round one. Gels are nearly incompressible, so a Poisson ratio near 0.5 is the better "
        "assumption: it moves the markers further sideways, as measured; linear triangles and tetrahedra then lock, their forces are too "
        "large."
    )
    return Table("Variants", columns, (printed, *rows), caption="Effect of what the report does not state or assumes.", note=note)


def with_poisson_ratio(material: Rheology, poisson_ratio: float) -> Rheology:
    """Return the material with another Poisson ratio in all its elements."""
    return replace(material, poisson_ratio=poisson_ratio, voigt_poisson_ratio=poisson_ratio, series_poisson_ratio=poisson_ratio)


def fitted_push(study: Study, seen: MarkerMeasurement, trusted: BoolArray) -> tuple[float, FloatArray]:
    """Return the indentation, mm, that fits the trusted markers best, and the displacements (k, 2), mm, of all markers."""
    shape = study.displacement_at(seen.start, study.series.times[-1]) / -study.series.displacement[-1, study.middle_top, 1]
    push = float((shape * seen.displacement)[trusted].sum() / (shape[trusted] ** 2).sum())
    return push, push * shape


def _magnetic_resonance() -> Section:
    study = agar_under_bar()
    (seen, trusted), (unloaded, _) = magnetic_resonance_measurement(), magnetic_resonance_measurement("unloaded")
    push, simulated = fitted_push(study, seen, trusted)
    rows: list[tuple[Cell, ...]] = []
    for i, marker in enumerate(seen.ids):
        values = [*seen.displacement[i], *simulated[i], *unloaded.displacement[i]]
        rows.append((int(marker), "yes" if trusted[i] else "no: suspect", *[float(v) for v in values]))
    error = simulated - seen.displacement
    spread = [float(np.sqrt((e[trusted] ** 2).mean())) for e in (error, seen.displacement)]
    columns = ("marker", "in the fit", "measured x, mm", "measured y, mm", "ours x, mm", "ours y, mm",
               "residual after unloading x, mm", "residual after unloading y, mm")  # fmt: skip
    note = (
        f"The indentation is not stated; {push:.2g} mm fits best (least squares over trusted markers); the residual is {spread[0]:.2g} mm "
        f"RMS of {spread[1]:.2g} mm. Coordinates are whole millimetres, whose rounding alone gives 0.41 mm RMS. Simulated: the "
        f"cross-section of {MR_SIZE_MM[0]:g} x {MR_SIZE_MM[1]:g} mm in plane strain."
    )
    text = (
        "Marker 5, directly under the bar, moves down by 2 mm and back: viscoelastic deformation is visible. As the report says, the other "
        "markers move too little to conclude more; the comparison can only show that nothing contradicts the model.",
    )
    table = Table("Table 2.2", columns, tuple(rows), caption="Marker displacements by MR, and ours.", note=note)
    figure = Figure("Table 2.2, drawn", "Measured (blue) and simulated (orange) displacements, magnified threefold.",
                    drawn.cross_section(study, seen.start, seen.displacement, simulated, trusted), (7.0, 3.4))  # fmt: skip
    return Section("Agar under a bar, measured by MR", text, (table,), (figure,))
