"""The command line: ``naibu demo``, ``identify``, ``predict``, ``report``, ``import``, ``doctor``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

import naibu
from naibu import workflow
from naibu.core.errors import InputError, NaibuError
from naibu.core.solution import Status
from naibu.doctor import doctor_rows, healthy
from naibu.identification.calibration import global_names
from naibu.identification.specimen import ContactModel, ModelSettings
from naibu.io.tables import import_markers, write_experiment_folder
from naibu.presentation import accuracy_table
from naibu.validation.baselines import baselines

app = App(name="naibu", help="Find the mechanical parameters of soft objects from markers measured inside them.", version=naibu.__version__)
console = Console()
DEMO = ("ct_two_material_1", "ct_two_material_2", "ct_two_material_3")
DEMO_KNOWN = "hardness 5=222 kPa"  # mean of the report's compression tests, Table 3.4
Law = Literal["neo_hookean", "neo_hookean_isochoric", "mooney_rivlin", "yeoh", "saint_venant_kirchhoff"]


@contextmanager
def _progress() -> Iterator[workflow.Progress]:
    """A progress line that tells the stage, the iteration and the objective."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("chi-squared {task.fields[objective]}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        tasks: dict[str, object] = {}

        def tell(stage: str, iteration: int, objective: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=None, objective="")
            bar.update(tasks[stage], objective=f"{objective:.0f} (iteration {iteration + 1})")  # type: ignore[arg-type]

        tell("identify", -1, float("inf"))
        yield tell


@app.command
def demo(*, out: Path = Path("naibu-demo")) -> None:
    """Calibrate both gels of the bundled two-material experiments, predict each from the others, and write a report.

    Parameters
    ----------
    out
        Folder for the results.
    """
    console.print(f"Identifying both gels from {', '.join(DEMO)} (bundled CT measurements) ...")
    _identify(list(DEMO), [DEMO_KNOWN], None, out, ModelSettings(), cross_validate=True, resume=False)


@app.command
def identify(
    experiments: list[str],
    *,
    known: Annotated[list[str] | None, Parameter(negative=())] = None,
    state: Annotated[list[str] | None, Parameter(negative=())] = None,
    out: Path = Path("naibu-results"),
    law: Law = "neo_hookean",
    contact: ContactModel = "coulomb",
    joined: Literal["glued", "sliding"] = "glued",
    element_size_mm: float = 0.0,
    cross_validate: bool = False,
    resume: bool = True,
) -> None:
    """Identify materials, friction and boundary conditions from measured experiments.

    Parameters
    ----------
    experiments
        Folders with a meta.toml and a CSV for each state, or names of bundled datasets.
    known
        A material with known Young's modulus, 'hardness 5=222 kPa'; or just its name, to get ratios. May be repeated.
    state
        Use only this state, 'EXPERIMENT/STATE'. May be repeated.
    out
        Folder for the results.
    law
        Hyperelastic law.
    contact
        What plates and table do to the surface sideways: rub (coulomb), hold it (stick), or hold it by springs.
    joined
        Whether blocks that were cast apart are glued or may slide.
    element_size_mm
        Edge of the elements; 0 chooses.
    cross_validate
        Also predict every experiment from the others.
    resume
        Continue an interrupted search in the same folder.
    """
    settings = ModelSettings(law=law, contact=contact, joined=joined, element_size_mm=element_size_mm)
    _identify(experiments, known or [], _states(state or []), out, settings, cross_validate=cross_validate, resume=resume)


def _states(chosen: list[str]) -> dict[str, list[str]] | None:
    out: dict[str, list[str]] = {}
    for text in chosen:
        experiment, _, name = text.partition("/")
        if not name:
            raise InputError(f"--state {text!r} must name experiment and state, such as ct_cube_plate/height_45")
        out.setdefault(experiment, []).append(name)
    return out or None


def _identify(
    experiments: list[str], known: list[str], states: dict[str, list[str]] | None, out: Path, settings: ModelSettings, *, cross_validate: bool, resume: bool
) -> None:
    start = time.perf_counter()
    with _progress() as progress:
        result = workflow.identify(
            experiments, known=known, states=states, settings=settings, out=out, cross_validate=cross_validate, resume=resume, progress=progress
        )
    calibration = result.calibration
    for trial in calibration.trials:
        for sentence in trial.specimen.experiment.loading.assumed:
            console.print(f"[dim]{trial.specimen.experiment.name}: {sentence}[/dim]")
    values = result.model.parameters.values()
    compared = {t.label: baselines(t, values[workflow.opening(t.specimen.experiment, t.state)]) for t in calibration.trials}
    table = accuracy_table(calibration, compared, result.left_out)
    _print_table(table.title, table.columns, table.rows)
    model = result.model
    rows = [(p.name, f"{p.value:.4g}", *(f"{b:.4g}" for b in model.interval(p.name)), p.unit) for p in model.parameters if p.name in global_names(model.parameters, calibration.trials)]
    _print_table("Parameters", ("parameter", "estimate", "95 % from", "to", "unit"), rows)
    console.print(f"{calibration.match.status.value} Residuals are {model.noise_factor:.2f} times the stated noise. {time.perf_counter() - start:.0f} s.")
    console.print(f"Report: {out / workflow.REPORT_FILE}   model: {out / workflow.MODEL_FILE}")
    if calibration.match.status is Status.INTERRUPTED:
        console.print("Interrupted. The same command continues from here.")
        sys.exit(130)


@app.command
def predict(
    model: Path,
    experiment: str,
    *,
    state: str | None = None,
    height_mm: float | None = None,
    heights_from_markers: bool = False,
    out: Path = Path("naibu-prediction"),
) -> None:
    """Predict the markers of a state with a calibrated model.

    Parameters
    ----------
    model
        The model.json that 'naibu identify' wrote, or its folder.
    experiment
        Folder or name of a bundled dataset; its free state is needed, the loaded one may be missing.
    state
        Name of the loaded state; needed where there are several.
    height_mm
        Height of the plate or bar above the base, or distance of the side plates.
    heights_from_markers
        Take the height from the mean z of the lowest and the highest marker layer of the measured state, and from nothing else of it.
    out
        Folder for predicted.csv, summary.json, report.html and files for ParaView.
    """
    result = workflow.predict(model, experiment, state=state, height_mm=height_mm, heights_from_markers=heights_from_markers, out=out)
    for note in (*result.specimen.experiment.loading.assumed, *result.notes):
        console.print(f"[dim]{note}[/dim]")
    if result.registered:
        n, x, y, z, total, noise = workflow.residual_rows(result.residual, result.fit.sd, ~result.specimen.marker_filled.any(axis=1))
        console.print(f"{n} markers: RMS x {x:.3f}, y {y:.3f}, z {z:.3f}, 3-D {total:.3f} mm ({noise:.2f} times the noise)")
    console.print(f"Predicted at {result.opening_mm:.2f} mm: {out / 'predicted.csv'}   report: {out / workflow.REPORT_FILE}")


@app.command
def report(folder: Path) -> None:
    """Write report.html anew from the results in a folder.

    Parameters
    ----------
    folder
        Where 'naibu identify' or 'naibu predict' wrote its results.
    """
    console.print(f"Report: {workflow.report(folder)}")


@app.command(name="import")
def import_tables(
    initial: Path,
    loaded: Annotated[list[Path], Parameter(negative=())],
    *,
    out: Path,
    shape: Literal["box", "half_ellipsoid", "cylinder", "hemisphere"] = "box",
    size_mm: tuple[float, float, float],
    loading: Literal["plate", "bar", "side_plates"] = "plate",
    bar_width_mm: float | None = None,
    title: str = "Imported experiment",
    unit: str | None = None,
    spacing_mm: float | None = None,
) -> None:
    """Make an experiment folder from tables of marker positions (CSV, TSV or Excel).

    Parameters
    ----------
    initial
        Table of the free state, with columns for label, x, y and z.
    loaded
        Tables of the loaded states; their file names become the states' names.
    out
        Folder to make.
    shape, size_mm
        Outer shape of the object and its extents along x, y, z.
    loading, bar_width_mm
        What presses it, and how wide a bar is.
    title
        What the experiment is.
    unit
        Unit of the coordinates where the column names do not tell it.
    spacing_mm
        Spacing of a regular marker lattice.
    """
    from naibu.core.experiment import Loading, Shape

    states = {path.stem: import_markers(path, unit=unit) for path in loaded}
    folder = write_experiment_folder(
        out, import_markers(initial, unit=unit), states, title=title, shape=Shape(shape, size_mm), loading=Loading(loading, bar_width_mm), spacing_mm=spacing_mm
    )
    console.print(f"Wrote {folder}. Describe layers and materials in its meta.toml, then run: naibu identify {folder}")


@app.command
def doctor() -> None:
    """Tell what is installed, what is missing, what that is for, and how to get it."""
    rows = doctor_rows()
    _print_table("naibu doctor", ("what", "status", "found", "for", "remedy"), [(r.name, r.status, r.found, r.purpose, r.remedy) for r in rows])
    if not healthy(rows):
        sys.exit(1)


def _print_table(title: str, columns: tuple[str, ...], rows: object) -> None:
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:  # type: ignore[attr-defined]
        table.add_row(*("-" if c is None else str(c) for c in row))
    console.print(table)


def main() -> None:
    """Run the command line; a user's mistake ends with one message and exit code 2."""
    try:
        app()
    except NaibuError as error:
        console.print(f"[bold red]error[/bold red] {error}", highlight=False, markup=True)
        sys.exit(2)
    except KeyboardInterrupt:
        console.print("Interrupted; nothing half-written was left behind.")
        sys.exit(130)
