"""Verbs for experiments: ``demo``, ``identify``, ``compare``, ``report``, ``import``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from naibu.cli.identifying import FIELD_FILES, ContactModel, Joined, Law, PixelScale, Unit, identify_from_both, identify_from_fields
from naibu.cli.shell.console import GRAVE, INTERRUPTED, NOT_EXPLAINED, WARNING, print_table, progress_display, say
from naibu.cli.shell.described import Flag, Known, ObjectOptions, Out, Overwrite, WorkerOptions, require_left_out
from naibu.cli.shell.run_record import found, wrote
from naibu.cli.shell.verbs import MARKERS, START, verb
from naibu.core.errors import InputError

# imported where used, so that --help is immediate and doctor runs even if numpy is broken
if TYPE_CHECKING:
    from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
    from naibu.workflows.markers.identify import Identification

DEMO = ("ct_two_material_1", "ct_two_material_2", "ct_two_material_3")
DEMO_KNOWN = "hardness 5=222 kPa"  # mean of the report's compression tests, Table 3.4


@verb(START, "demo --open   # some minutes; opens the report")
def demo(*, out: Out = Path("naibu-demo"), overwrite: Overwrite = False, where: WorkerOptions | None = None) -> None:
    """Calibrate both gels of the bundled two-material experiments, predict each experiment from the others, and write a report.

    Parameters
    ----------
    out
        Folder for the results.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    say(f"Identifying both gels from {', '.join(DEMO)} (bundled CT measurements) ...")
    _identify(DEMO, known=(DEMO_KNOWN,), out=out, cross_validate=True, overwrite=overwrite, where=where)


@verb(
    MARKERS,
    "identify my_gel -k 'gel=20 kPa' --open          # your experiment folder, one modulus known",
    "identify ct_two_material_1 -k 'hardness 5'      # bundled data, moduli as ratios",
    "identify naibu-sense/field.h5 --zones labels.nii.gz -k 'label 1=10 kPa' --map   # a displacement field",
)
def identify(
    experiments: list[str],
    *,
    known: Known = None,
    state: Annotated[list[str] | None, Parameter(name=("--state", "-s"))] = None,
    out: Out = Path("naibu-results"),
    law: Law = "neo_hookean",
    contact: ContactModel = "coulomb",
    joined: Joined = "tied",
    pixel_scale: PixelScale = "given",
    element_size_mm: float = 0.0,
    cross_validate: bool = False,
    resume: bool = True,
    mask: Path | None = None,
    zones: Path | None = None,
    zone_name: list[str] | None = None,
    loaded: list[str] | None = None,
    cell_map: Annotated[bool, Parameter(name="--map", negative=())] = False,
    unit: Unit | None = None,
    spacing_mm: tuple[float, float, float] | None = None,
    node_spacing: tuple[float, float, float] | None = None,
    check_components: bool = True,
    overwrite: Overwrite = False,
    where: WorkerOptions | None = None,
) -> None:
    """Identify material parameters, friction and boundary conditions by finite element model updating (FEMU).

    Operands are experiments with markers, or files of displacement fields, such as the field.h5 of naibu sense, which need a mask or zones.
    With both, materials and zones of one name share their moduli.

    The first line says whether the model explains the markers: explained, explained in part (what and where), or not explained. In the last
    case the results are written, marked as not to be used, and the exit code is 3.

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
        Edge length of the elements; 0 selects it automatically, and smaller ones where these would change moduli of fields.
    cross_validate
        Also predict every experiment from the others.
    resume
        Resume an interrupted identification in the same folder.
    mask
        With fields: volume that is not zero in the object.
    zones
        With fields: volume of labels, one for each material, 0 outside.
    zone_name
        With fields: name of a label, 'gel=1' or '1=gel'. May be repeated.
    loaded
        With fields: a side where forces act, x-, x+, y-, y+, z- or z+, if they act at no other. May be repeated.
    cell_map
        With fields: map the unknown moduli cell by cell, and make regions of the map. Without --known they are multiples of that of the
        largest region.
    unit
        With fields in tables and meshes: their unit, where they do not state it; by default mm.
    spacing_mm
        With fields in voxels (SPAM, ALDVC): size of a voxel along x, y, z.
    node_spacing
        With TIFF files of SPAM: voxels from node to node along x, y, z.
    check_components
        With fields: refuse those that would suit an elastic body far better with components of other signs or in another order.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    of_fields = [name for name in experiments if Path(name).suffix.lower() in FIELD_FILES]
    others = [name for name in experiments if name not in of_fields]
    of_scan: dict[str, Any] = {
        "mask": mask, "zones": zones, "zone_name": zone_name or [], "known": known or (), "loaded": loaded or (), "unit": unit,
        "spacing_mm": spacing_mm, "node_spacing": node_spacing, "check_components": check_components, "out": out, "overwrite": overwrite,
    }  # fmt: skip
    if not (of_fields and others) and (mask is not None or zones is not None or not others):
        require_left_out(
            "goes with markers, and these are displacement fields", states=bool(state), contact=contact != "coulomb",
            joined=joined != "tied", pixel_scale=pixel_scale != "given", cross_validate=cross_validate, resume=not resume,
            workers=where is not None,
        )  # fmt: skip
        identify_from_fields(experiments, law=law, each_cell=cell_map, element_size_mm=element_size_mm, **of_scan)
        return
    from naibu.identification.from_markers.specimen.specimen_model import ModelSettings

    settings = ModelSettings(law=law, contact=contact, joined=joined, element_size_mm=element_size_mm, pixel_scale=pixel_scale)
    if of_fields and others:
        require_left_out(
            "goes with markers or fields, not with both", each_cell=cell_map, cross_validate=cross_validate, resume=not resume,
            workers=where is not None, law=law != "neo_hookean",
        )  # fmt: skip
        identify_from_both(others, of_fields, states=_states(others, state or []), settings=settings, **of_scan)
        return
    require_left_out(
        "goes with displacement fields, and these are markers", zone_names=bool(zone_name), each_cell=cell_map, unit=unit is not None,
        spacing_mm=spacing_mm is not None, node_spacing=node_spacing is not None, loaded=bool(loaded),
        check_components=not check_components,
    )  # fmt: skip
    _identify(
        experiments, known=known or (), states=_states(experiments, state or []), settings=settings, out=out,
        cross_validate=cross_validate, resume=resume, overwrite=overwrite, where=where,
    )  # fmt: skip


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
    overwrite: Overwrite = False,
    where: WorkerOptions | None = None,
) -> None:
    from naibu.workflows.markers import identify

    began = time.perf_counter()
    with progress_display() as progress:
        result = identify.identify(
            list(experiments), known=known, states=states, settings=settings, out=out, cross_validate=cross_validate, resume=resume,
            overwrite=overwrite, progress=progress, **(where or WorkerOptions()).arguments,
        )  # fmt: skip
    _show(result)
    wrote(*(out / name for name in ("report.html", "model.json", "identification.json", "residuals.csv")))
    say(f"{time.perf_counter() - began:.0f} s. Results in {out}: open report.html; naibu predict takes model.json.")
    if result.interrupted:
        say("Interrupted: these are the results so far. The same command continues from here.")
        sys.exit(INTERRUPTED)
    if not result.verdict.ok:
        say("The model does not explain the data: the results are marked as not to be used.", GRAVE)
        sys.exit(NOT_EXPLAINED)


def _show(result: Identification) -> None:
    """Print the verdict, assumptions, residuals of the markers, and the parameters."""
    from naibu.workflows.results import report_content as content

    calibration, model = result.calibration, result.model
    note = content.verdict_note(result.verdict)
    say(note.sentence, "bold" if note.sound else GRAVE)
    found(verdict=note.sentence, usable=result.verdict.ok, noise_factor=model.noise_factor)
    for line in note.details:
        say(f"- {line}")
    experiments = {t.specimen.experiment.name: t.specimen.experiment for t in calibration.load_cases}
    for experiment in experiments.values():
        for line in experiment.loading.assumed:
            say(f"{experiment.name}: {line}", "dim")
    table = content.accuracy_table(calibration, result.baselines, result.left_out)
    print_table(table.title, table.columns, table.rows)
    names = content.shared_names(model)
    rows = [(r.name, r.estimate, r.lower, r.upper, r.unit, r.remarks) for r in content.parameter_rows(model, names)]
    print_table("Parameters", ("parameter", "estimate", "95 % from", "to", "unit", "note"), rows, digits=4)
    for line in content.undetermined(model, names, calibration.priors):
        say(line, "dim")
    say(f"{content.search_sentence(calibration.match.status)} Residuals are {model.noise_factor:.2f} times the stated noise.")


@verb(MARKERS, "compare my_gel -k gel --law neo_hookean --law yeoh   # which law explains the markers best")
def compare(
    experiments: list[str],
    *,
    known: Known = None,
    law: list[Law] | None = None,
    contact: list[ContactModel] | None = None,
    joined: list[Joined] | None = None,
    element_size_mm: float = 0.0,
    out: Out = Path("naibu-comparison"),
    overwrite: Overwrite = False,
    where: WorkerOptions | None = None,
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
    overwrite
        Discard what the folder already contains, and compute everything anew.
    """
    from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
    from naibu.workflows.markers import compare as compare_workflow
    from naibu.workflows.results.report_content import comparison_table

    laws: list[Law] = law or ["neo_hookean", "mooney_rivlin"]
    contacts: list[ContactModel] = contact or ["coulomb", "stick"]
    joints: list[Joined] = joined or ["tied"]
    candidates = [
        ModelSettings(law=one, contact=two, joined=three, element_size_mm=element_size_mm)
        for one, two, three in product(laws, contacts, joints)
    ]
    with progress_display() as progress:
        rows = compare_workflow.compare(
            experiments, candidates=candidates, known=known or (), out=out, overwrite=overwrite, progress=progress,
            **(where or WorkerOptions()).arguments,
        )  # fmt: skip
    wrote(out / "comparison.json")
    table = comparison_table(rows)
    print_table(table.title, table.columns, table.rows)
    say(table.note, "dim")


@verb(MARKERS, "report naibu-results --open")
def report(folder: Path) -> None:
    """Write the HTML pages again from the results in a folder, without solving.

    Parameters
    ----------
    folder
        Folder with results of 'naibu identify' or 'naibu predict' with markers.
    """
    from naibu.workflows import report as report_workflow

    for page in report_workflow.report(folder):
        wrote(page)
        say(f"Report: {page}")


@verb(
    MARKERS,
    "import free.csv pressed.csv --size-mm 60 60 60 -l 'gel=0..60' --stated-mm pressed=45 -o my_gel",
    "import positions.xlsx pressed.xlsx --size-mm 60 60 60 --unit cm --preview   # look, and write nothing",
    "import free.csv pressed.csv --size-mm 60 60 60 --spacing-mm 10 --vertical found   # of a scan that is tilted",
    name="import",
)
def import_tables(
    initial: Path,
    loaded: list[Path],
    *,
    size_mm: tuple[float, float, float],
    described: ObjectOptions | None = None,
    title: str = "Imported experiment",
    unit: str | None = None,
    spacing_mm: float | None = None,
    xy_step_mm: float | None = None,
    z_step_mm: float | None = None,
    preview: Flag = False,
    out: Out = Path("naibu-experiment"),
    overwrite: Overwrite = False,
) -> None:
    """Make an experiment folder from tables of marker positions (CSV, TSV or Excel).

    What was read is shown first: markers in common, their span beside the object, their spacing, how far they moved.

    Parameters
    ----------
    initial
        Table of the unloaded state, with columns for the number of a marker, x, y and z.
    loaded
        Tables of the loaded states, which are named after their files.
    size_mm
        Dimensions of the object along x, y and z, z being its height, also where the tables have another axis upwards (vertical).
    title
        Title of the experiment.
    unit
        Unit of the coordinates (mm, cm, m, um or inch), if the column names do not state it; else mm.
    spacing_mm
        Spacing of a regular marker lattice.
    xy_step_mm
        Resolution of the in-plane coordinates, such as the pixel size, from which their uncertainty is computed.
    z_step_mm
        Resolution of the heights, such as the slice spacing.
    preview
        Only show what the tables hold, and what would be refused or warned of; nothing is written.
    out
        Folder to make.
    overwrite
        Use the folder even if it is not empty, and replace files of the same names.
    """
    from naibu.workflows.markers import import_tables as import_workflow

    about = (described or ObjectOptions()).described(size_mm)
    about["spacing_mm"] = spacing_mm
    seen = import_workflow.preview_tables(initial, loaded, unit=unit, **about)
    print_table(seen.title, seen.columns, seen.rows)
    say(seen.note, "dim")
    run = import_workflow.rehearsed_import if preview else import_workflow.import_tables
    notes = run(initial, loaded, out=out, unit=unit, title=title, xy_step_mm=xy_step_mm, z_step_mm=z_step_mm, overwrite=overwrite, **about)
    for note in notes:
        say(f"Warning: {note}", WARNING)
    if preview:
        return
    wrote(out)
    before = "" if about["layers"] else "Describe layers and materials in its meta.toml, then run"
    say(f"Wrote {out}. {before or 'Run'}: naibu identify {quote(str(out))}")
