"""Chapter 4.3 of the report: a lattice of dough calibrated on shape and force, in eight patterns (spec L6)."""

from __future__ import annotations

import numpy as np

from naibu.identification.lattice_calibration.gauss_newton import CalibrationProblem, ReportIndices, calibrate_lattice
from naibu.identification.lattice_calibration.unknowns import UNITS
from naibu.reproduction.chapter4.patterns import START, PatternStudy, pattern_study, with_interval_factor
from naibu.reproduction.printed_tables import printed_table
from naibu.validation.specimens.lattice_twin import FORCE_SD_MN, POINT_SD_MM, POINTS, TRUTH, dough_lattice, dough_twin
from naibu.viewer.chapter import Chapter, Section
from naibu.viewer.tables import Cell, Table

PRINTED_FORCE_N = {"a": 3803.6, "b": 538.7, "c": 7448.3, "d": 979.5}  # captions of Figure 14 of the ICAT paper
PRINTED_COUNTS = {"first": (2821, 2795, 3075, 2815, 2811), "second": (2255, 2195, 2213, 2201, 2165)}  # the third and the second corrected
TWIN_TEXT = (
    "The captures of the report are not available. A virtual twin stands for the dough: a block of 10 x 5 x 7 cm and 510 g on a "
    "floor to which it "
    "sticks, pushed by two facing bodies that close at 20 mm/s and cover the middle of their faces, kept, and set free. Two stereo "
    "cameras see "
    f"about {POINTS} points at five times, each coordinate with a noise of {POINT_SD_MM:g} mm; a sensor on each body reads its force "
    "every 2 ms with "
    f"a noise of {FORCE_SD_MN:g} mN. Which faces the bodies cover, how they share the speed and when the second capture is taken are "
    "our reading."
)


def chapter4_lattice(seed: int = 0, *, points: int = POINTS) -> Chapter:
    """Reproduce the calibrations of chapter 4.3 on a virtual twin.

    Parameters
    ----------
    seed : int
        Of the twin's noise.
    points : int
        Captured points.
    """
    study = pattern_study(seed, points=points)
    sections = (exact_section(seed, points), *pattern_sections(study))
    settings: dict[str, Cell] = {"seed": seed, "points": points, "point_sd_mm": POINT_SD_MM, "force_sd_mn": FORCE_SD_MN}
    return Chapter("ch4-lattice", "Chapter 4.3: lattices of dough, calibrated on shape and force", sections, settings)


def exact_section(seed: int, points: int) -> Section:
    """Return the calibration of the nine parameters of a twin that follows the model's law."""
    twin = dough_twin(law="same", seed=seed, points=points)
    found = calibrate_lattice(CalibrationProblem.of(dough_lattice(), twin.captures), START)
    rows: list[tuple[Cell, ...]] = []
    for name, value, (low, high) in zip(found.unknowns.names, found.values, found.intervals(), strict=True):
        truth = TRUTH[name]
        rows.append(
            (f"{name}, {UNITS[name.split()[0]]}", truth, float(value), f"{low:.4g} to {high:.4g}", "yes" if low <= truth <= high else "no")
        )
    columns = ("parameter", "truth", "found", "95 % interval", "truth inside")
    note = (
        f"Both pushings, shape and force, {len(dough_lattice().points)} masses: {found.iterations} iterations, {found.runs} simulated "
        "pushings (the report's genetic algorithm took about a month). Intervals of 95 % hold for one parameter at a time; those of the "
        "classes of one kind miss together where they miss, since the data know their sum best. " + found.undetermined[-1]
    )
    return Section(
        "Nine parameters of a twin that follows the law",
        (TWIN_TEXT,),
        (Table("Nine parameters", columns, tuple(rows), caption="Truth and found.", note=note),),
    )


def pattern_sections(study: PatternStudy) -> tuple[Section, ...]:
    """Return the tables of the patterns (a) to (h), printed beside ours, and whether one set can do what the report's two do."""
    first = _pattern_table("4-force-1", "first", "abcd", ("joint 1",), study)
    second = _pattern_table("4-force-2", "second", "efgh", ("joint 2", "joint 1 on 2"), study)
    text = (
        "Here the twin's masses stand at half the spacing of the model's, and its surface is stiffer and less viscous than its "
        "core: no nine "
        "parameters fit it exactly. Each pattern pushes the virtual dough by displacement or by the measured force, takes the "
        "parameters that were "
        "calibrated on S_shape or S_force of the first or second pushing, and is evaluated by both. In ours, chi-squared of signed "
        "distances, or of "
        "forces while the bodies keep still, is made small.",
        "Pushed by force, the virtual dough answers with the same force whatever its parameters, but for the inertia of the masses "
        "under the body: "
        "S_force in (d), (f) and (h) says nothing about the parameters, which stay at their start; the printed ones of (c) and (d), "
        "some newtons a "
        "sample, cannot come from the law. In (a) and (e) the shape leaves the common scale of K, C1 and C2 to inertia alone: "
        "forces are then far off, "
        "as in the report. Both defects vanish where shape and force count together.",
    )
    return (
        Section("Eight patterns of pushing and calibrating", text, (first, second)),
        Section("One set of parameters or two", (), (_one_set(study), _parameter_table(study), _undetermined_table(study))),
    )


def _pattern_table(number: str, which: str, letters: str, joint: tuple[str, ...], study: PatternStudy) -> Table:
    _, printed = printed_table(number)
    ours = [study.found[name] for name in (*letters, *joint)]
    rows: list[tuple[Cell, ...]] = []
    for quantity, time, *cells in printed:
        rows.append((quantity, time, *cells, *(_entry(found, str(quantity), time) for found in ours)))
    rows.append(("S_force, N", "kept", *(PRINTED_FORCE_N.get(k) for k in letters), *(found.force_mn / 1e3 for found in ours)))
    columns = ("quantity", "time", *(f"paper ({k})" for k in letters), *(f"ours ({k})" for k in letters), *(f"ours {k}" for k in joint))
    note = (
        "Sums of distances, cm, those below 0.05 cm not counted, and the same for each captured point; points 0.25 cm or more away. "
        "The twin has no "
        "error of registration: ours are smaller, and at the first time (before the push) only noise. Paper: points "
        f"{', '.join(map(str, PRINTED_COUNTS[which]))}. S_force is the sum over 1000 samples and two sensors; its noise alone makes "
        f"{2 * 1000 * FORCE_SD_MN * np.sqrt(8.0 / np.pi) / 1e3:.0f} N. Joint: by displacement, on shape and force together."
    )
    caption = f"Patterns ({letters[0]}) to ({letters[-1]}), {which} pushing."
    return Table(number, columns, tuple(rows), caption=caption, note=note)


def _entry(found: ReportIndices, quantity: str, time: Cell) -> Cell:
    """Return our value of a row of the printed tables."""
    chosen = range(len(found.shape_mm)) if time == "total" else [int(time or 0) - 1]
    distance, points = sum(found.shape_mm[k] for k in chosen) / 10.0, sum(found.points[k] for k in chosen)
    large = sum(found.large[k] for k in chosen)
    return {"sum": distance, "per point": distance / points, "points >= 0.25 cm": large, "percentage": 100.0 * large / points}[quantity]


def _one_set(study: PatternStudy) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for text, shape, force, joint in (
        ("first pushing", "a", "force 1", "joint 1"),
        ("second pushing", "e", "force 2", "joint 2"),
        ("second, calibrated on the first", "g", "force 1 on 2", "joint 1 on 2"),
    ):
        shapes = [sum(study.found[k].shape_mm) / 10.0 for k in (shape, force, joint)]
        forces = [study.found[k].force_mn / 1e3 for k in (shape, force, joint)]
        rows.append((text, shapes[0], shapes[1], shapes[2], shapes[2] / shapes[0], forces[0], forces[1], forces[2], forces[2] / forces[1]))
    columns = (
        "pushed by displacement", "S_shape, set for shape, cm", "set for force", "one joint set", "joint / set for shape",
        "S_force, set for shape, N", "set for force", "one joint set", "joint / set for force",
    )  # fmt: skip
    note = "The report concludes that two sets are needed, one for what is seen and one for what is felt."
    return Table("One set or two", columns, tuple(rows), caption="The joint set beside the set for shape and the set for force.", note=note)


def _parameter_table(study: PatternStudy) -> Table:
    names = next(iter(study.estimates.values())).unknowns.names
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(names):
        rows.append((f"{name}, {UNITS[name.split()[0]]}", *(with_interval_factor(e, k) for e in study.estimates.values())))
    where = ("first", "second")
    columns = ("parameter", *(f"{where[number]}, by {mode}, {index}" for number, mode, index in study.estimates))
    note = "Found, and the factor by which the 95 % interval reaches up and down. What the data leave open stays near the start."
    return Table("Parameters", columns, tuple(rows), caption="What each calibration found.", note=note)


def _undetermined_table(study: PatternStudy) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for (number, mode, index), estimate in study.estimates.items():
        for sentence in estimate.undetermined[:-1] or ("All combinations are determined.",):
            rows.append((f"{('first', 'second')[number]}, by {mode}, {index}", sentence))
    return Table("Not determined", ("calibration", "combination"), tuple(rows), caption="What the data of each calibration leave open.")
