"""Verb ``predict``: an identified model under another load, of markers or of displacement fields."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from naibu.cli.identifying import FIELD_FILES
from naibu.cli.shell.console import WARNING, say
from naibu.cli.shell.described import Flag, Out, Overwrite
from naibu.cli.shell.run_record import found, wrote
from naibu.cli.shell.verbs import MARKERS, verb
from naibu.core.errors import InputError


@verb(
    MARKERS,
    "predict naibu-results my_gel -s pressed --height-mm 42",
    "predict naibu-demo ct_two_material_1 --heights-from-markers",
    "predict moduli --hold z- --move z+=0,0,-5              # a model of displacement fields: plates",
    "predict moduli other/field.h5                          # the surface moves as in another field",
)
def predict(
    model: Path,
    experiment: str | None = None,
    *,
    state: Annotated[str | None, Parameter(name=("--state", "-s"))] = None,
    height_mm: float | None = None,
    heights_from_markers: Flag = False,
    hold: list[str] | None = None,
    move: list[str] | None = None,
    out: Out = Path("naibu-prediction"),
    overwrite: Overwrite = False,
) -> None:
    """Predict how a body moves under another load, with a model that was identified from markers or from displacement fields.

    Of markers: those of a state of an experiment. Of displacement fields: the displacement everywhere in the body, with its standard
    deviation, when sides are held and moved, or when the surface moves as in a measured field, with which the inside is compared.

    Parameters
    ----------
    model
        The model.json that 'naibu identify' wrote, or its folder. One of markers and fields together predicts either.
    experiment
        Of markers: folder or name of a bundled dataset; its unloaded state is needed, the loaded one may be missing. With a model of
        displacement fields: a measured field; it may be left out where a side is moved.
    state
        Name of the loaded state; required if there are several.
    height_mm
        Height of the plate or bar above the base, or distance between the side plates.
    heights_from_markers
        Take the height from the mean z of the lowest and the highest marker layer of the measured state, or the distance of side
        plates from that of its outermost marker columns: the only data used of it.
    hold
        With a model of displacement fields: a side that does not move, x-, x+, y-, y+, z- or z+. May be repeated.
    move
        With a model of displacement fields: a side and its displacement in mm, 'z+=0,0,-5'. May be repeated.
    out
        Folder for predicted.html and summary.json; of markers also predicted.csv, of displacement fields also field.h5; and files for
        ParaView. It may be that of a model of markers.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
    from naibu.workflows.joint_model import JointModel
    from naibu.workflows.results.result_folder import read_any_model

    of_markers = {"state": state, "height_mm": height_mm, "heights_from_markers": heights_from_markers or None}
    of_fields = {"hold": hold, "move": move}
    read = read_any_model(model)
    asks_fields = bool(hold or move) or Path(experiment or "").suffix.lower() in FIELD_FILES
    if isinstance(read, IdentifiedBody) or (isinstance(read, JointModel) and asks_fields):
        _require_unset(of_markers, "goes with models of markers")
        _predict_field(model, experiment, hold or [], move or [], out, overwrite)
        return
    _require_unset(of_fields, "goes with models of displacement fields, and this one is of markers")
    if experiment is None:
        raise InputError("EXPERIMENT is missing: name the folder of an experiment, or a bundled dataset; see naibu predict --help")
    _predict_markers(model, experiment, state, height_mm, heights_from_markers, out, overwrite)


def _require_unset(options: Mapping[str, object], reason: str) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"`{name}` {reason}; leave it out")


def _predict_markers(
    model: Path, experiment: str, state: str | None, height_mm: float | None, heights_from_markers: bool, out: Path, overwrite: bool
) -> None:
    from naibu.workflows import predict as predict_workflow
    from naibu.workflows.results.report_content import accuracy, fitted_too

    result = predict_workflow.predict(
        model, experiment, state=state, height_mm=height_mm, heights_from_markers=heights_from_markers, out=out, overwrite=overwrite
    )
    for note in (*result.specimen.experiment.loading.assumed, *result.notes):
        say(note, "dim")
    if result.registered:
        a = accuracy(result.specimen, result.fit, result.residual)
        rms = f"RMS x {a.x:.3f}, y {a.y:.3f}, z {a.z:.3f}, 3-D {a.total:.3f} mm"
        say(f"{a.markers} markers: {rms} ({a.noise_units:.2f} times the noise)")
        if told := fitted_too(result.model, result):
            say(told, WARNING)
    say(result.interval)
    wrote(*(out / name for name in ("predicted.html", "predicted.csv", "summary.json")))
    say(f"Predicted at {result.platen_position_mm:.2f} mm: {out / 'predicted.csv'}   page: {out / 'predicted.html'}")


def _predict_field(model: Path, field: str | None, hold: list[str], move: list[str], out: Path, overwrite: bool) -> None:
    from naibu.workflows.fields.predict_field import predict_field

    run = predict_field(model, field, held=hold, moved=move, out=out, overwrite=overwrite)
    for note in run.notes:
        say(note)
    if run.comparison is not None:
        found(rms_mm=run.comparison.rms_mm.tolist(), rms_in_standard_deviations=run.comparison.rms_sd)
    wrote(*run.files)
    say(f"Page: {out / 'predicted.html'}   field: {out / 'field.h5'}   for ParaView: {out / 'predicted.vtu'}")
