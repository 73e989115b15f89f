"""The verb ``calibrate``: lattices from captured shapes and recorded forces."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from naibu.cli.shell.console import INTERRUPTED, WARNING, errors, print_table, progress_display, say
from naibu.cli.shell.described import Flag, Out, Overwrite, Whole, WorkerOptions
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import SIMULATE, verb
from naibu.cli.studies import stopped_gently
from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport

if TYPE_CHECKING:
    from naibu.workflows.studies.calibration.calibrate import LatticeCalibration


@verb(
    SIMULATE,
    "calibrate --example dough   # writes inputs to try it with",
    "calibrate dough/dough.toml --shapes dough/shapes.csv --forces dough/forces.csv --open",
    "calibrate dough/dough.toml --forces dough/forces.csv --starts 4 --workers 2   # do other values fit as well?",
    "calibrate my_study.toml --shapes 0=rest.ply --shapes 0.5=pressed.ply --forces stamp=sensor.csv --friction common",
)
def calibrate(
    study: str = "",
    *,
    shapes: Annotated[list[str] | None, Parameter(name=("--shapes", "-s"))] = None,
    forces: list[str] | None = None,
    groups: Literal["class", "zone", "class and zone", "all", "given"] = "class",
    friction: Literal["given", "common", "each"] = "given",
    pull_off: Flag = False,
    method: Literal["gauss-newton", "cma-es", "genetic"] = "gauss-newton",
    point_sd_mm: float = 0.5,
    force_sd_mn: float | None = None,
    sensor_errors: Literal["none", "offset", "delay", "offset and delay", "drift", "drift and delay"] = "none",
    force_drift_mn_per_s: float | None = None,
    max_runs: Whole = 2000,
    seed: Whole = 0,
    threads: Whole = 2,
    starts: Whole = 1,
    where: WorkerOptions | None = None,
    example: Path | None = None,
    out: Out = Path("naibu-calibration"),
    overwrite: Overwrite = False,
) -> None:
    """Identify the parameters of a lattice from what cameras and force sensors recorded of it.

    Writes a study with the values that were found, which naibu simulate runs. Ctrl-C keeps the best values so far.

    Parameters
    ----------
    study
        File STUDY.toml, or name of a study, as for naibu simulate: the object, the indenters and their paths. Its parameters are where
        the search starts.
    shapes
        Captured points in the coordinates of the study: a CSV table with columns time_s, x_mm, y_mm, z_mm, or TIME=FILE (s) with a CSV or
        PLY file of one instant. May be repeated.
    forces
        Record of a force sensor: a CSV table with columns time_s, fx_mN, fy_mN, fz_mN (other units by their names: Fx (N)), and a column
        indenter where there are several; or NAME=FILE. What the indenter exerts on the object. May be repeated.
    groups
        Elements that share K, C1 and C2: those of a class (short, normal, long: nine values), of a zone (surface, core), of both, or all;
        given: none is unknown.
    friction
        Static and kinetic friction: given by the study, unknown and common to all bodies, or unknown for each.
    pull_off
        Pull-off is unknown too, where the study states a rough one.
    method
        Gauss-Newton, or a search without derivatives (pip install "naibu[calibrate]"), whose intervals come from derivatives at its end.
    point_sd_mm
        Standard deviation of a coordinate of the captured points, mm.
    force_sd_mn
        Standard deviation of a component of a force in one sample, mN; by default estimated from the records.
    sensor_errors
        Errors of the force sensors that are estimated along: an offset (they were not tared), a delay of their clocks, a drift (with an
        offset), or none.
    force_drift_mn_per_s
        Standard deviation of the drift of a component of a force sensor, mN/s, as from its data sheet; 0 if it has none. By default
        0.5 % of the largest force of a record, per second; with --sensor-errors drift any drift is as likely.
    max_runs
        Number of simulations of a search without derivatives, at most.
    seed
        Seed of the random numbers, of such a search or of the example.
    threads
        Number of threads that compute derivatives.
    starts
        Number of independent searches: from the values of the study, and from a Latin hypercube within a factor of 10 around them. The best
        is taken, and intervals reach to other values that fit as well.
    example
        Write inputs to try the verb with into this folder, and do nothing else.
    out
        Folder for calibration.html, calibration.json and STUDY-calibrated.toml.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    if example is not None:
        _write_example(example, seed, overwrite)
        return
    if not study:
        raise InputError("naibu calibrate needs STUDY; naibu calibrate --example dough writes inputs to try it with")
    from naibu.workflows.studies.calibration.calibrate import calibrate_study

    began = time.perf_counter()
    with stopped_gently("simulation") as stopping, progress_display() as display:

        def progress(report: ProgressReport) -> None:
            display(report)
            if stopping():
                raise KeyboardInterrupt

        run = calibrate_study(
            study, shapes=shapes or (), forces=forces or (), out=out, groups=groups, friction=friction, pull_off=pull_off, method=method,
            point_sd_mm=point_sd_mm, force_sd_mn=force_sd_mn, sensor_errors=sensor_errors,
            force_drift_mn_per_s=force_drift_mn_per_s, max_runs=max_runs, seed=seed, threads=threads, starts=starts,
            overwrite=overwrite, progress=progress, **(where or WorkerOptions()).arguments,
        )  # fmt: skip
    _show(run)
    say(f"{time.perf_counter() - began:.0f} s. Page: {run.files[0]}   numbers: {run.files[1]}   study: {run.files[2]}")
    if not run.estimate.finished:
        errors.print("Interrupted: the best values so far are kept.", soft_wrap=True)
        sys.exit(INTERRUPTED)


def _write_example(folder: Path, seed: int, overwrite: bool) -> None:
    from naibu.workflows.studies.calibration.example import write_calibration_example

    written = write_calibration_example(folder, seed=seed, overwrite=overwrite)
    wrote(*written)
    study, shapes, forces = (quote(str(path)) for path in written)
    say(f"Wrote {', '.join(map(str, written))}. Run: naibu calibrate {study} --shapes {shapes} --forces {forces}")


def _show(run: LatticeCalibration) -> None:
    """Print what was found, what the data do not determine, and warnings."""
    from naibu.workflows.studies.calibration.page import held_intervals

    found = run.estimate
    rows = [
        (name, f"{value:.4g}" if known else "not determined", f"{low:.4g} to {high:.4g}", unit)
        for name, unit, value, (low, high), known in zip(
            found.unknowns.names, found.unknowns.units, found.values, held_intervals(found), found.determined(), strict=True
        )
    ]
    print_table("naibu calibrate", ("parameter", "estimate", "95 % interval", "unit"), rows, left=True)
    for sentence in found.undetermined:
        say(sentence, "dim")
    for warning in run.warnings:
        say(warning, WARNING)
    wrote(*run.files)
