"""Verbs for experiments with markers: ``demo``, ``identify``, ``predict``, ``compare``, ``report``, ``import``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from naibu.cli.console import INTERRUPTED, app, print_table, progress_display, say
from naibu.cli.described import ObjectOptions
from naibu.core.errors import InputError

# imported where used, so that --help is immediate and doctor runs even if numpy is broken
if TYPE_CHECKING:
    from naibu.identification.from_markers.specimen_model import ModelSettings
    from naibu.workflows.identify import Identification

DEMO = ("ct_two_material_1", "ct_two_material_2", "ct_two_material_3")
DEMO_KNOWN = "hardness 5=222 kPa"  # mean of the report's compression tests, Table 3.4
ContactModel = Literal["coulomb", "stick", "springs"]
PixelScale = Literal["given", "sought"]
Joined = Literal["tied", "sliding"]
Law = Literal["neo_hookean", "neo_hookean_isochoric", "mooney_rivlin", "yeoh", "saint_venant_kirchhoff"]


@app.command
def demo(*, out: Path = Path("naibu-demo")) -> None:
    """Calibrate both gels of the bundled two-material experiments, predict each experiment from the others, and write a report.

    Parameters
    ----------
    out
        Folder for the results.
    """
    say(f"Identifying both gels from {', '.join(DEMO)} (bundled CT measurements) ...")
    _identify(DEMO, known=(DEMO_KNOWN,), out=out, cross_validate=True)


@app.command
def identify(
    experiments: list[str],
    *,
    known: list[str] | None = None,
    state: list[str] | None = None,
    out: Path = Path("naibu-results"),
    law: Law = "neo_hookean",
    contact: ContactModel = "coulomb",
    joined: Joined = "tied",
    pixel_scale: PixelScale = "given",
    element_size_mm: float = 0.0,
    cross_validate: bool = False,
    resume: bool = True,
) -> None:
    """Identify material parameters, friction and boundary conditions by finite element model updating (FEMU).

    Parameters
    ----------
    experiments
        Folders with a meta.toml and a CSV table for each state, or names of bundled datasets.
    known
        A material with known Young's modulus, 'hardness 5=222 kPa', or only its name, to obtain ratios. May be repeated.
    state
        Use only this state, 'EXPERIMENT/STATE'. May be repeated.
    out
        Folder for the results.
    law
        Hyperelastic law.
    contact
        Tangential contact of plates and table: Coulomb friction, sticking, or springs.
    joined
        Whether blocks that were cast separately are tied or may slide on each other.
    pixel_scale
        Whether the pixel size along x and y is taken from the file (given) or identified for every experiment (sought).
    element_size_mm
        Edge length of the elements; 0 selects it automatically.
    cross_validate
        Also predict every experiment from the others.
    resume
        Resume an interrupted identification in the same folder.
    """
    from naibu.identification.from_markers.specimen_model import ModelSettings

    settings = ModelSettings(law=law, contact=contact, joined=joined, element_size_mm=element_size_mm, pixel_scale=pixel_scale)
    states = _states(experiments, state or [])
    _identify(experiments, known=known or (), states=states, settings=settings, out=out, cross_validate=cross_validate, resume=resume)


def _states(experiments: Sequence[str], chosen: Sequence[str]) -> dict[str, list[str]] | None:
    """Return states by experiment; all states of an experiment are used if none is named."""
    out: dict[str, list[str]] = {}
    for text in chosen:
        experiment, _, name = text.rpartition("/")
        if not experiment and len(experiments) == 1:
            experiment = Path(experiments[0]).resolve().name
        if not name or not experiment:
            raise InputError(f"--state {text!r} must name experiment and state, such as ct_cube_plate/height_45")
        out.setdefault(experiment, []).append(name)
    return out or None


def _identify(
    experiments: Sequence[str],
    *,
    known: Sequence[str],
    out: Path,
    states: dict[str, list[str]] | None = None,
    settings: ModelSettings | None = None,
    cross_validate: bool = False,
    resume: bool = True,
) -> None:
    from naibu.workflows import identify

    began = time.perf_counter()
    with progress_display() as progress:
        result = identify.identify(
            list(experiments), known=known, states=states, settings=settings, out=out, cross_validate=cross_validate, resume=resume,
            progress=progress,
        )  # fmt: skip
    _show(result)
    say(f"{time.perf_counter() - began:.0f} s. Results in {out}: open report.html; naibu predict takes model.json.")
    if result.interrupted:
        say("Interrupted: these are the results so far. The same command continues from here.")
        sys.exit(INTERRUPTED)


def _show(result: Identification) -> None:
    """Print assumptions, residuals of the markers, and the parameters."""
    from naibu.workflows.report_content import accuracy_table, parameter_rows, shared_names, undetermined

    calibration, model = result.calibration, result.model
    experiments = {t.specimen.experiment.name: t.specimen.experiment for t in calibration.load_cases}
    for experiment in experiments.values():
        for line in experiment.loading.assumed:
            say(f"{experiment.name}: {line}", "dim")
    table = accuracy_table(calibration, result.baselines, result.left_out)
    print_table(table.title, table.columns, table.rows)
    names = shared_names(model)
    rows = [(r.name, f"{r.estimate:.4g}", f"{r.lower:.4g}", f"{r.upper:.4g}", r.unit, r.note) for r in parameter_rows(model, names)]
    print_table("Parameters", ("parameter", "estimate", "95 % from", "to", "unit", ""), rows)
    for line in undetermined(model, names):
        say(line, "dim")
    say(f"{calibration.match.status.value} Residuals are {model.noise_factor:.2f} times the stated noise.")


@app.command
def predict(
    model: Path,
    experiment: str,
    *,
    state: str | None = None,
    height_mm: float | None = None,
    heights_from_markers: Annotated[bool, Parameter(negative=())] = False,
    out: Path = Path("naibu-prediction"),
) -> None:
    """Predict the markers of a state with a calibrated model.

    Parameters
    ----------
    model
        The model.json that 'naibu identify' wrote, or its folder.
    experiment
        Folder or name of a bundled dataset; its unloaded state is needed, the loaded one may be missing.
    state
        Name of the loaded state; required if there are several.
    height_mm
        Height of the plate or bar above the base, or distance between the side plates.
    heights_from_markers
        Take the height from the mean z of the lowest and the highest marker layer of the measured state, the only data used of it.
    out
        Folder for predicted.csv, summary.json, predicted.html and files for ParaView; may be that of the model.
    """
    from naibu.workflows import predict as predict_workflow
    from naibu.workflows.report_content import accuracy

    result = predict_workflow.predict(
        model, experiment, state=state, height_mm=height_mm, heights_from_markers=heights_from_markers, out=out
    )
    for note in (*result.specimen.experiment.loading.assumed, *result.notes):
        say(note, "dim")
    if result.registered:
        a = accuracy(result.specimen, result.fit, result.residual)
        rms = f"RMS x {a.x:.3f}, y {a.y:.3f}, z {a.z:.3f}, 3-D {a.total:.3f} mm"
        say(f"{a.markers} markers: {rms} ({a.noise_units:.2f} times the noise)")
    say(f"Predicted at {result.platen_position_mm:.2f} mm: {out / 'predicted.csv'}   page: {out / 'predicted.html'}")


@app.command
def compare(
    experiments: list[str],
    *,
    known: list[str] | None = None,
    law: list[Law] | None = None,
    contact: list[ContactModel] | None = None,
    joined: list[Joined] | None = None,
    element_size_mm: float = 0.0,
    out: Path = Path("naibu-comparison"),
) -> None:
    """Compare material laws and contact models: calibrate each combination, and predict each experiment from the others.

    Parameters
    ----------
    experiments
        Folders or names of bundled datasets.
    known
        A material with known Young's modulus, or only its name. May be repeated.
    law
        Hyperelastic law to try. May be repeated; neo_hookean and mooney_rivlin by default.
    contact
        Tangential contact model of plates and table. May be repeated; coulomb and stick by default.
    joined
        Joint between blocks that were cast separately. May be repeated; tied by default.
    element_size_mm
        Edge length of the elements; 0 selects it automatically.
    out
        Folder for comparison.json; models that it already contains are not repeated.
    """
    from naibu.identification.from_markers.specimen_model import ModelSettings
    from naibu.workflows import compare as compare_workflow
    from naibu.workflows.report_content import comparison_table

    laws: list[Law] = law or ["neo_hookean", "mooney_rivlin"]
    contacts: list[ContactModel] = contact or ["coulomb", "stick"]
    joints: list[Joined] = joined or ["tied"]
    candidates = [
        ModelSettings(law=one, contact=two, joined=three, element_size_mm=element_size_mm)
        for one, two, three in product(laws, contacts, joints)
    ]
    with progress_display() as progress:
        rows = compare_workflow.compare(experiments, candidates=candidates, known=known or (), out=out, progress=progress)
    table = comparison_table(rows)
    print_table(table.title, table.columns, table.rows)
    say(table.note, "dim")


@app.command
def report(folder: Path) -> None:
    """Write the HTML pages again from the results in a folder, without solving.

    Parameters
    ----------
    folder
        Folder with results of 'naibu identify' or 'naibu predict'.
    """
    from naibu.workflows import report as report_workflow

    for page in report_workflow.report(folder):
        say(f"Report: {page}")


@app.command(name="import")
def import_tables(
    initial: Path,
    loaded: list[Path],
    *,
    out: Path,
    size_mm: tuple[float, float, float],
    described: ObjectOptions | None = None,
    title: str = "Imported experiment",
    unit: str | None = None,
    spacing_mm: float | None = None,
    xy_step_mm: float | None = None,
    z_step_mm: float | None = None,
) -> None:
    """Make an experiment folder from tables of marker positions (CSV, TSV or Excel).

    Parameters
    ----------
    initial
        Table of the unloaded state, with columns for label, x, y and z.
    loaded
        Tables of the loaded states, which are named after their files.
    out
        Folder to make.
    size_mm
        Dimensions of the object along x, y, z.
    title
        Title of the experiment.
    unit
        Unit of the coordinates, if the column names do not state it.
    spacing_mm
        Spacing of a regular marker lattice.
    xy_step_mm
        Resolution of the in-plane coordinates, such as the pixel size, from which their uncertainty is computed.
    z_step_mm
        Resolution of the heights, such as the slice spacing.
    """
    from naibu.io.marker_tables import import_markers, write_experiment_folder

    about = (described or ObjectOptions()).described(size_mm)
    names = [path.stem for path in loaded]
    if len(set(names)) < len(names):
        raise InputError(f"two tables would both be the state {max(names, key=names.count)!r}; rename one file")
    write_experiment_folder(
        out, import_markers(initial, unit=unit), {path.stem: import_markers(path, unit=unit) for path in loaded}, title=title,
        spacing_mm=spacing_mm, xy_step_mm=xy_step_mm, z_step_mm=z_step_mm, **about,
    )  # fmt: skip
    before = "" if about["layers"] else "Describe layers and materials in its meta.toml, then run"
    say(f"Wrote {out}. {before or 'Run'}: naibu identify {out}")
