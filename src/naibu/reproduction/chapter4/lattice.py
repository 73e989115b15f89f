"""Calibration of a dough lattice on shape and force, in the eight patterns of the 2008 report :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.identification.lattice_calibration.gauss_newton import CalibrationProblem, calibrate_lattice
from naibu.identification.lattice_calibration.report_indices import ReportIndices
from naibu.identification.lattice_calibration.unknowns import UNITS
from naibu.reproduction.chapter4.lattice_figures import final_shapes, force_waves
from naibu.reproduction.chapter4.patterns import ONE_SET, START, PatternStudy, pattern_study, with_interval_factor
from naibu.reproduction.printed_tables import printed_table
from naibu.validation.specimens.lattice_twin import FORCE_SD_MN, POINT_SD_MM, POINTS, TRUTH, dough_lattice, dough_twin
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table

PRINTED_FORCE_N = {"a": 3803.6, "b": 538.7, "c": 7448.3, "d": 979.5}  # captions of Figure 14 of the ICAT paper
PRINTED_COUNTS = {"first": (2821, 2795, 3075, 2815, 2811), "second": (2255, 2195, 2213, 2201, 2165)}  # the third and the second corrected
DRAWS = 10
_ON_SECOND = ("g", "force 1 on 2", "joint 1 on 2")
TWIN_TEXT = (
    "The measurements of the report are not available. A virtual twin replaces the dough: a block of 10 x 5 x 7 cm and 510 g fixed to the "
    "floor, compressed by two opposite indenters that close at 20 mm/s on the middle of its faces, pause and retract. Two stereo "
    f"cameras capture about {POINTS} points at five times, with a noise SD of {POINT_SD_MM:g} mm per coordinate; a sensor on each indenter "
    f"reads its force every 2 ms with a noise SD of {FORCE_SD_MN:g} mN. The loaded faces, the speed of each indenter and the time of the "
    "second capture are our interpretation."
)


def chapter4_lattice(seed: int = 0, *, points: int = POINTS, draws: int = DRAWS) -> Chapter:
    """Reproduce the calibrations of chapter 4.3 on a virtual twin.

    Parameters
    ----------
    seed : int
        Seed of the twin's noise.
    points : int
        Number of captured points.
    draws : int
        Twins, with noise and points of their own, for which one joint set is compared with two.
    """
    study = pattern_study(seed, points=points)
    others = [pattern_study(seed + k, points=points, patterns=ONE_SET, near=study.estimates) for k in range(1, draws)]
    sections = (exact_section(seed, points), *pattern_sections(study, others))
    settings: dict[str, Cell] = {"seed": seed, "points": points, "draws": draws, "point_sd_mm": POINT_SD_MM, "force_sd_mn": FORCE_SD_MN}
    return Chapter("ch4-lattice", "Chapter 4.3: lattices of dough, calibrated on shape and force", sections, settings)


def exact_section(seed: int, points: int) -> Section:
    """Return the calibration of the nine parameters of a twin that obeys the model."""
    twin = dough_twin(law="same", seed=seed, points=points)
    found = calibrate_lattice(CalibrationProblem.of(dough_lattice(), twin.captures), START)
    rows: list[tuple[Cell, ...]] = []
    for name, value, (low, high) in zip(found.unknowns.names, found.values, found.intervals(), strict=True):
        truth = TRUTH[name]
        rows.append(
            (f"{name}, {UNITS[name.split()[0]]}", truth, float(value), f"{low:.4g} to {high:.4g}", "yes" if low <= truth <= high else "no")
        )
    columns = ("parameter", "truth", "estimate", "95 % interval", "truth inside")
    note = (
        f"Both load cases, shape and force, {len(dough_lattice().points)} nodes: {found.iterations} iterations, {found.runs} simulations "
        "(the report's genetic algorithm took about a month). The 95 % intervals are for one parameter at a time; those of the classes of "
        "one kind fail together, because the data determine their sum best. " + found.undetermined[-1]
    )
    return Section(
        "Nine parameters of a twin that obeys the model",
        (TWIN_TEXT,),
        (Table("Nine parameters", columns, tuple(rows), caption="True and estimated values.", note=note),),
    )


def pattern_sections(study: PatternStudy, others: Sequence[PatternStudy] = ()) -> tuple[Section, ...]:
    """Return the tables of the patterns (a) to (h), printed and ours, and one joint parameter set compared with the report's two."""
    first = _pattern_table("4-force-1", "first", "abcd", ("joint 1",), study)
    second = _pattern_table("4-force-2", "second", "efgh", ("joint 2", "joint 1 on 2"), study)
    text = (
        "Here the twin has half the node spacing of the model, and its surface is stiffer and less viscous than its core: no nine "
        "parameters fit it exactly. Each pattern loads the virtual dough by displacement or by the measured force, uses the parameters "
        "calibrated on S_shape or S_force of the first or second load case, and is evaluated by both. Ours minimise chi-squared of signed "
        "distances, or of forces while the indenters are at rest.",
        "Under force control the virtual dough responds with the same force whatever its parameters, except for the inertia of the nodes "
        "under the indenter: S_force in (d), (f) and (h) is independent of the parameters, which keep their initial values; the printed "
        "values of (c) and (d), some newtons per sample, cannot follow from the model. In (a) and (e) shape determines the common scale "
        "of K, C1 and C2 through inertia alone: forces are then far off, as in the report. Neither occurs if shape and force are fitted "
        "jointly.",
    )
    return (
        Section("Eight patterns of loading and calibration", text, (first, second), _figures(study)),
        Section(
            "One parameter set or two",
            (),
            (_one_set(study), _drawn_sets((study, *others)), _parameter_table(study), _undetermined_table(study)),
        ),
    )


def _figures(study: PatternStudy) -> tuple[Figure, ...]:
    """Return the figures of shapes and forces of the patterns that were computed."""
    found = []
    for letters, number, which in (("abcd", 13, "First"), ("efgh", 15, "Second")):
        if all(k in study.shapes for k in letters):
            text = f"{which} load case: final shapes, and captured points that lie 0.25 cm or more away from them (orange)."
            found.append(Figure(f"Fig. {number}", text, final_shapes([study.shapes[k] for k in letters]), (8.0, 6.5)))
            text = f"{which} load case: force of the first indenter, measured and computed."
            found.append(Figure(f"Fig. {number + 1}", text, force_waves([study.waves[k] for k in letters]), (8.0, 5.0)))
    return tuple(found)


def _drawn_sets(studies: Sequence[PatternStudy]) -> Table:
    """Return how one joint set compares with the two sets of the first load case, over several draws."""
    rows: list[tuple[Cell, ...]] = []
    for text, shape, force, joint in (("first load case", "a", "force 1", "joint 1"), ("second, calibrated on the first", *_ON_SECOND)):
        ratios = np.array(
            [
                (
                    sum(s.found[joint].shape_mm) / sum(s.found[shape].shape_mm),
                    s.found[joint].force_mn / s.found[force].force_mn,
                    s.found[shape].force_mn / s.found[joint].force_mn,
                    sum(s.found[force].shape_mm) / sum(s.found[joint].shape_mm),
                )
                for s in studies
            ]
        )
        rows.append((text, len(studies), *(f"{r.mean():.3g} ({r.min():.3g} to {r.max():.3g})" for r in ratios.T)))
    columns = (
        "displacement control", "draws", "S_shape, joint / set for shape", "S_force, joint / set for force",
        "S_force, set for shape / joint", "S_shape, set for force / joint",
    )  # fmt: skip
    note = "Mean, least and largest ratio over twins with noise and captured points of their own."
    return Table("One set or two, drawn", columns, tuple(rows), caption="One joint set against two sets.", note=note)


def _pattern_table(number: str, which: str, letters: str, joint: tuple[str, ...], study: PatternStudy) -> Table:
    _, printed = printed_table(number)
    ours = [study.found[name] for name in (*letters, *joint)]
    rows: list[tuple[Cell, ...]] = []
    for quantity, time, *cells in printed:
        rows.append((quantity, time, *cells, *(_entry(found, str(quantity), time) for found in ours)))
    rows.append(("S_force, N", "kept", *(PRINTED_FORCE_N.get(k) for k in letters), *(found.force_mn / 1e3 for found in ours)))
    columns = ("quantity", "time", *(f"paper ({k})" for k in letters), *(f"ours ({k})" for k in letters), *(f"ours {k}" for k in joint))
    note = (
        "Sums of distances, cm, without those below 0.05 cm, and the same per captured point; points 0.25 cm or more away. The twin has no "
        "registration error: ours are smaller, and at the first time (before loading) only noise. Paper: points "
        f"{', '.join(map(str, PRINTED_COUNTS[which]))}. S_force is the sum over 1000 samples and two sensors; noise alone gives "
        f"{2 * 1000 * FORCE_SD_MN * np.sqrt(8.0 / np.pi) / 1e3:.0f} N. Joint: by displacement, on shape and force together."
    )
    caption = f"Patterns ({letters[0]}) to ({letters[-1]}), {which} load case."
    return Table(f"Table {number[-1]} (ICAT 2007)", columns, tuple(rows), caption=caption, note=note)


def _entry(found: ReportIndices, quantity: str, time: Cell) -> Cell:
    """Return our value for a row of the printed tables."""
    chosen = range(len(found.shape_mm)) if time == "total" else [int(time or 0) - 1]
    distance, points = sum(found.shape_mm[k] for k in chosen) / 10.0, sum(found.points[k] for k in chosen)
    large = sum(found.large[k] for k in chosen)
    return {"sum": distance, "per point": distance / points, "points >= 0.25 cm": large, "percentage": 100.0 * large / points}[quantity]


def _one_set(study: PatternStudy) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for text, shape, force, joint in (
        ("first load case", "a", "force 1", "joint 1"),
        ("second load case", "e", "force 2", "joint 2"),
        ("second, calibrated on the first", "g", "force 1 on 2", "joint 1 on 2"),
    ):
        shapes = [sum(study.found[k].shape_mm) / 10.0 for k in (shape, force, joint)]
        forces = [study.found[k].force_mn / 1e3 for k in (shape, force, joint)]
        rows.append((text, shapes[0], shapes[1], shapes[2], shapes[2] / shapes[0], forces[0], forces[1], forces[2], forces[2] / forces[1]))
    columns = (
        "displacement control", "S_shape, set for shape, cm", "set for force", "one joint set", "joint / set for shape",
        "S_force, set for shape, N", "set for force", "one joint set", "joint / set for force",
    )  # fmt: skip
    note = "The report concludes that two sets are needed, one for shape and one for force."
    return Table("One set or two", columns, tuple(rows), caption="The joint set and the sets for shape and for force.", note=note)


def _parameter_table(study: PatternStudy) -> Table:
    names = next(iter(study.estimates.values())).unknowns.names
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(names):
        rows.append((f"{name}, {UNITS[name.split()[0]]}", *(with_interval_factor(e, k) for e in study.estimates.values())))
    where = ("first", "second")
    columns = ("parameter", *(f"{where[number]}, by {mode}, {index}" for number, mode, index in study.estimates))
    note = "Estimate, and the factor by which the 95 % interval extends. Undetermined parameters stay near the initial values."
    return Table("Parameters", columns, tuple(rows), caption="Estimates of each calibration.", note=note)


def _undetermined_table(study: PatternStudy) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for (number, mode, index), estimate in study.estimates.items():
        for sentence in estimate.undetermined[:-1] or ("All combinations are determined.",):
            rows.append((f"{('first', 'second')[number]}, by {mode}, {index}", sentence))
    return Table("Not determined", ("calibration", "combination"), tuple(rows), caption="Combinations left open by the data.")
