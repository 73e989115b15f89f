"""Content of reports: calibrations and predictions as the records that a page shows. Here residuals are predicted minus measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray
from naibu.core.experiment import Experiment
from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.checks.assumed_law import HANGING, HANGS
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase
from naibu.identification.from_markers.specimen.specimen_model import Specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.cross_validation import LeftOut, ModelRow
from naibu.identification.prediction.platen_position import marker_layers
from naibu.identification.prediction.prediction import Prediction
from naibu.identification.verdict import Explanation, Verdict
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.meshing.surface import boundary_faces, triangles_of_faces
from naibu.viewer.result_page.estimates import text_to_width
from naibu.viewer.result_page.payload import Box, Correlation, ParameterRow, Report, ResidualSet, Scene, Step, VerdictNote
from naibu.viewer.tables import Cell, Table

_ACCURACY_COLUMNS = ("experiment/state", "markers", "x mm", "y mm", "z mm", "3-D mm", "in noise units")
INCOMPRESSIBLE, NOT_VERY_COMPRESSIBLE = 0.499, 0.3  # Poisson's ratios
WEAK = 0.6  # of the width of the prior: an interval as wide as that owes little to the data
LABELS: Mapping[str, str] = {
    "young_modulus": "Young's modulus",
    "poisson_ratio": "Poisson's ratio",
    "c01_fraction": "C01 / (C10 + C01)",
    "c20_ratio": "C20 / C10",
    "c30_ratio": "C30 / C10",
}


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Accuracy of predicted markers.

    Attributes
    ----------
    markers : int
        Number of markers measured completely in both states; no others count.
    x, y, z, total : float
        Root mean square along the axes, and of the distance, mm; NaN without markers.
    noise_units : float
        Root mean square in units of the noise.
    """

    markers: int
    x: float
    y: float
    z: float
    total: float
    noise_units: float


def accuracy(specimen: Specimen, fit: LoadCaseFit, residual: FloatArray | None = None) -> Accuracy:
    """Return the accuracy of a fit; of another `residual` (k, 3), mm, where the fit itself is not registered to the measured markers."""
    r = fit.residual if residual is None else residual
    whole = np.isfinite(r).all(axis=1) & ~np.any(specimen.marker_filled, axis=1)
    if not whole.any():
        return Accuracy(0, *([np.nan] * 5))
    squared = r[whole] ** 2
    x, y, z = np.sqrt(squared.mean(axis=0)).tolist()
    noise_units = np.sqrt((squared / fit.sd[whole] ** 2).mean())
    return Accuracy(int(whole.sum()), x, y, z, float(np.sqrt(squared.sum(axis=1).mean())), float(noise_units))


def accuracy_table(calibration: Calibration, baselines: Mapping[str, Mapping[str, float]], left_out: Sequence[LeftOut] = ()) -> Table:
    """Return RMS of every load case, of its prediction when left out, and of simple baselines."""
    names = list(dict.fromkeys(k for row in baselines.values() for k in row))
    unseen = {f"{r.experiment}/{r.state}": r.rms_mm for r in left_out}
    rows = []
    for load_case, fit in zip(calibration.load_cases, calibration.match.fits, strict=True):
        compared = baselines.get(load_case.name, {})
        extra = ([unseen.get(load_case.name)] if unseen else []) + [compared.get(n) for n in names]
        rows.append(
            (*_accuracy_row(load_case.name, accuracy(load_case.specimen, fit)), *(None if v is None else round(v, 3) for v in extra))
        )
    columns = (*_ACCURACY_COLUMNS, *(["left out mm"] if unseen else []), *(f"{n} mm" for n in names))
    note = "Root mean square over markers measured completely in both states."
    if unseen:
        note += " Left out: the other experiments identified the parameters."
    if names:
        note += (
            " The last columns: 3-D distances that the best rigid motion, the best affine map, and linear elasticity without slip leave."
        )
    return Table("Measured against predicted markers", columns, tuple(rows), note=note)


def comparison_table(rows: Sequence[ModelRow]) -> Table:
    """Return candidate models side by side, in their order."""
    best = min((r.bic for r in rows if np.isfinite(r.bic)), default=np.nan)
    columns = ("law", "contact", "joints", "in noise units", "parameters", "BIC above best", "left out, 3-D mm", "trouble")
    cells: list[tuple[Cell, ...]] = []
    for r in rows:
        figures = (r.noise_factor, r.bic - best, r.left_out_mm)
        noise, above, left_out = (round(v, 3) if np.isfinite(v) else None for v in figures)
        cells.append((r.settings.law, r.settings.contact, r.settings.joined, noise, r.parameter_count, above, left_out, r.problem))
    note = (
        "BIC: Bayesian information criterion, misfit with a penalty for parameters; differences above 10 are decisive. "
        "Left out: over all markers of the experiments, each predicted from the others."
    )
    return Table("Models compared", columns, tuple(cells), note=note)


def _accuracy_row(label: str, a: Accuracy) -> tuple[Cell, ...]:
    return (label, a.markers, *(round(v, 3) for v in (a.x, a.y, a.z, a.total, a.noise_units)))


def scene(specimen: Specimen, state: str, fit: LoadCaseFit, measured: FloatArray, values: Mapping[str, float], role: str) -> Scene:
    """Return one state for the 3-D view, in the object's frame.

    Parameters
    ----------
    specimen : Specimen
        The meshed experiment.
    state : str
        Name of the state.
    fit : LoadCaseFit
        Its solution.
    measured : ndarray, shape (k, 3)
        Measured markers in the object's frame, mm; NaN where not measured.
    values : mapping
        Physical values of all parameters.
    role : str
        Whether the state was fitted or predicted.
    """
    body = specimen.reshaped(values)
    whole = body.whole
    boundary = boundary_faces(whole.mesh)
    nodes, local = np.unique(boundary.faces, return_inverse=True)
    faces = triangles_of_faces(local.reshape(boundary.faces.shape))
    steps = []
    indenters = specimen.moved_indenters(values, state)
    experiment = specimen.experiment
    for s in fit.solution.states:
        markers = body.marker_points + body.at_markers(fit.since_scan(s.displacement))
        boxes = tuple(_box(specimen.experiment, c, s.load) for c in indenters)
        travel = float(max(np.linalg.norm(c.stop - c.start) for c in indenters))
        label = f"{100 * s.load:.0f} % of the load" if s.load < 1.0 else "full load"
        steps.append(
            Step(label, s.load * travel, whole.mesh.points[nodes] + whole.field(fit.since_scan(s.displacement))[nodes], markers, boxes)
        )
    layer = marker_layers(specimen.marker_points[:, 2], experiment.nominal_spacing_mm)
    sd = np.sqrt((fit.sd**2).mean(axis=1))
    # a marker whose reference position was completed from the lattice counts in no figure of accuracy, here neither
    shown = np.where(np.any(specimen.marker_filled, axis=1)[:, None], np.nan, measured)
    return Scene(
        f"{experiment.name}/{state}", experiment.name, state, faces, whole.mesh.points[nodes], tuple(steps), body.marker_ids,
        body.marker_points, shown, sd, layer, role,
    )  # fmt: skip


def _box(experiment: Experiment, indenter: Contact, load: float) -> Box:
    """A slab whose face touches the object, drawn for a plate or bar at a fraction of its path."""
    half = 0.5 * np.array(experiment.shape.size_mm) + 4.0
    normal = indenter.surface.normal
    axis = int(np.argmax(np.abs(normal)))
    half[axis] = 2.0
    loading = experiment.loading
    if loading.kind == "bar" and loading.bar_width_mm:
        half["xy".index("x" if loading.bar_axis == "y" else "y")] = loading.bar_width_mm / 2.0
        half[2] = 5.0
    turned = indenter.orientation(load)
    (x, y, z), (a, b, c) = (indenter.position(load) - turned @ (normal * half[axis])).tolist(), half.tolist()
    qx, qy, qz, qw = Rotation.from_matrix(turned).as_quat().tolist()
    return Box((x, y, z), (a, b, c), (qx, qy, qz, qw))


def load_case_scene(load_case: MarkerLoadCase, fit: LoadCaseFit, values: Mapping[str, float], role: str = "fitted") -> Scene:
    """Return a fitted load case for the 3-D view."""
    measured = fit.pose.inverse().applied(load_case.measured * load_case.specimen.enlargement(values))
    return scene(load_case.specimen, load_case.state, fit, measured, values, role)


def prediction_scene(prediction: Prediction, role: str = "predicted unseen") -> Scene:
    """Return a prediction for the 3-D view."""
    p = prediction
    return scene(p.specimen, p.state, p.fit, p.measured_in_object, p.values, role)


def shared_names(model: CalibratedModel) -> tuple[str, ...]:
    """Return the names of the free parameters of materials and friction, which hold beyond the experiments used."""
    own = {label.partition("/")[0] for label in model.load_cases}
    return tuple(p.name for p in model.parameters.free if p.name.partition(":")[0].partition("/")[0] not in own)


def parameter_label(name: str) -> str:
    """Return the name of a parameter as a reader writes it: ``"gel: young_modulus"`` is "gel: Young's modulus"."""
    subject, separator, kind = name.rpartition(": ")
    return f"{subject}{separator}{LABELS.get(kind, kind.replace('_', ' '))}"


def parameter_rows(model: CalibratedModel, names: Sequence[str]) -> tuple[ParameterRow, ...]:
    """Return estimates with 95 % intervals, given values with a note; moduli are multiples of one of them where none is known in kPa."""
    rows = []
    for p in model.parameters:
        if p.name in names or (p.fixed and p.name.endswith("young_modulus")):
            low, high = model.interval(p.name)
            low = -np.inf if np.isinf(high) and not model.is_lower_bound(p.name) else low
            note = "" if not p.fixed else ("given" if model.reference is None else "sets the scale: moduli are ratios to it")
            factor, unit = model.shown(p)
            beside = _if_only_weight(p, model) or _by_law(p, model)
            rows.append(ParameterRow(p.name, parameter_label(p.name), factor * p.value, factor * low, factor * high, unit, note, beside))
    return tuple(rows)


def undetermined(model: CalibratedModel, names: Sequence[str], priors: ParameterSet | None = None) -> tuple[str, ...]:
    """Return, in words, what the data do not determine about the parameters `names`; `priors` tells what was assumed of them."""
    out = []
    if model.is_weighed:
        out.append(
            "The stiffness follows from the weight that bends the object, at the density of water and the stated size; "
            "whatever else holds it down, such as a base that sticks, would look like a smaller modulus. No more follows "
            "than a lower bound, and the same is true of forces."
        )
    elif not model.known_materials.scale_is_absolute:
        out.append("Displacements alone do not give the absolute stiffness: the moduli are ratios to the material that sets the scale.")
    by_name: dict[str, Parameter] = {p.name: p for p in model.parameters}
    assumed = {p.name: p for p in priors or ()}
    for name in names:
        if sentence := _undetermined(by_name[name], model, assumed.get(name)):
            out.append(f"{name}: {sentence}")
    if len(names) > 1:
        correlation = model.correlation(names)
        for i, j in zip(*np.where(np.triu(np.abs(correlation), 1) > 0.9), strict=True):
            out.append(f"{names[i]} and {names[j]} are determined only together (correlation {correlation[i, j]:+.2f}).")
    return tuple(out)


def _undetermined(p: Parameter, model: CalibratedModel, assumed: Parameter | None) -> str:
    """What the data leave open about one parameter; empty where they determine it."""
    sd, (low, high) = model.standard_deviation(p.name, law_exact=True), model.interval(p.name)
    if p.scale == "incompressibility" and high > INCOMPRESSIBLE:
        if low > NOT_VERY_COMPRESSIBLE:
            return f"at least {low:.3f}; the data do not distinguish it from incompressible."
        return f"the data leave it open between {low:.2f} and 0.5."
    if np.isfinite(p.prior_sd) and sd > WEAK * p.prior_sd:
        factor, unit = model.shown(p)
        before = "" if assumed is None else f"; {factor * assumed.value:.3g} {unit}".rstrip() + " was assumed beforehand"
        return f"the data hardly determine it; {factor * p.value:.3g} {unit}".rstrip() + f" was found{before}."
    if p.name.endswith("friction") and high > 4.0 * p.value:
        return f"known only to lie between {low:.2g} and {high:.2g}; where surfaces do not slip, a larger friction looks the same."
    if p.name.endswith(HANGING) and _by_law(p, model):
        return (
            "its interval counts in that the material may stiffen more or less with strain than the law says (model-form uncertainty). "
            "'naibu compare' tells whether another law fits better."
        )
    return ""


def _if_only_weight(p: Parameter, model: CalibratedModel) -> str:
    """The interval of a modulus that follows from the weight of the object, if nothing else holds that on its table."""
    if not model.is_lower_bound(p.name):
        return ""
    low, high = model.interval_of_model(p.name)
    return f"{low:.3g} to {high:.3g} if nothing but its weight holds the object down"


def _by_law(p: Parameter, model: CalibratedModel) -> str:
    """The interval that a parameter would have if the law were exactly right, where the law makes it much wider."""
    exact = model.standard_deviation(p.name, law_exact=True)
    if not exact or model.standard_deviation(p.name) < HANGS * exact:
        return ""
    factor, _ = model.shown(p)
    low, high = (factor * bound for bound in model.interval(p.name, law_exact=True))
    return f"{text_to_width(low, high - low)} to {text_to_width(high, high - low)} if the law is exactly {model.settings.law}"


def build_report(
    calibration: Calibration,
    model: CalibratedModel,
    verdict: Verdict,
    baselines: Mapping[str, Mapping[str, float]],
    left_out: Sequence[LeftOut] = (),
) -> Report:
    """Gather everything that a calibration's page shows."""
    names, values = shared_names(model), model.parameters.values()
    scenes = tuple(load_case_scene(t, f, values) for t, f in zip(calibration.load_cases, calibration.match.fits, strict=True))
    assumed = dict.fromkeys(
        f"{t.specimen.experiment.name}: {s}" for t in calibration.load_cases for s in t.specimen.experiment.loading.assumed
    )
    return Report(
        title="Calibration of " + ", ".join(dict.fromkeys(t.specimen.experiment.name for t in calibration.load_cases)),
        headline=_calibration_headline(calibration, model, verdict, left_out),
        verdict=verdict_note(verdict),
        scenes=scenes,
        accuracy=accuracy_table(calibration, baselines, left_out),
        residuals=tuple(ResidualSet.from_scene(s) for s in scenes),
        parameters=parameter_rows(model, names),
        correlation=_correlation(model, names),
        undetermined=undetermined(model, names, calibration.priors),
        tables=(_boundary_table(model, names), *_assumptions(tuple(assumed))),
        provenance=model.provenance,
    )


def verdict_note(verdict: Verdict) -> VerdictNote:
    """Return the verdict for the page, with its details."""
    reasons = tuple(f"{r[0].upper()}{r[1:]}." for r in verdict.reasons[3:])
    return VerdictNote(verdict.sentence, verdict.explanation is Explanation.EXPLAINED, (*reasons, *verdict.outliers, *verdict.notes))


def _calibration_headline(
    calibration: Calibration, model: CalibratedModel, verdict: Verdict, left_out: Sequence[LeftOut]
) -> tuple[str, ...]:
    found = [accuracy(t.specimen, f).total for t, f in zip(calibration.load_cases, calibration.match.fits, strict=True)]
    states = f"{len(found)} loaded states" if len(found) > 1 else "one loaded state"
    worst = f"{np.nanmax(found):.2f} mm" if np.isfinite(found).any() else ""
    out = []
    if worst and verdict.explanation is Explanation.NOT_EXPLAINED:
        out.append(f"The best fit of the model to the markers of {states} leaves {'up to ' * (len(found) > 1)}{worst} (RMS, 3-D).")
    elif worst:
        out.append(f"One set of parameters fits the markers of {states} to {worst}{' or better' * (len(found) > 1)} (RMS, 3-D).")
    if left_out:
        out.append(f"Predicted from the other experiments, they are met to {max(r.rms_mm for r in left_out):.2f} mm or better (RMS, 3-D).")
    out.append(f"Residuals are {model.noise_factor:.2f} times the stated measurement noise. {search_sentence(calibration.match.status)}")
    return tuple(out)


def search_sentence(status: Status) -> str:
    """How the search ended, which says nothing about how well the model fits."""
    return {Status.CONVERGED: "The search converged.", Status.ITERATION_LIMIT: "The search reached its iteration limit."}.get(
        status, status.value
    )


def _correlation(model: CalibratedModel, names: Sequence[str]) -> Correlation | None:
    return Correlation(tuple(names), model.correlation(names)) if len(names) > 1 else None


def _boundary_table(model: CalibratedModel, names: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for p in model.parameters.free:
        if p.name not in names:
            low, high = model.interval(p.name)
            rows.append((p.name, _short(p.value), _short(low), _short(high), p.unit))
    return Table("Boundary conditions, found with the rest", ("parameter", "estimate", "95 % from", "to", "unit"), tuple(rows))


def _assumptions(sentences: Sequence[str]) -> tuple[Table, ...]:
    """A table of what was assumed; none where nothing was."""
    return (Table("Assumptions", ("what is not stated, and what is assumed",), tuple((s,) for s in sentences)),) if sentences else ()


def _short(value: float) -> float:
    return float(f"{value:.4g}")


def prediction_report(model: CalibratedModel, prediction: Prediction) -> Report:
    """Gather everything that a prediction's page shows."""
    p, names = prediction, shared_names(model)
    label = f"{p.specimen.experiment.name}/{p.state}"
    view = prediction_scene(p, "also used to identify" if fitted_too(model, p) else "predicted unseen")
    table = Table("Measured against predicted markers", _ACCURACY_COLUMNS, (_accuracy_row(label, accuracy(p.specimen, p.fit, p.residual)),))
    return Report(
        title=f"Prediction of {label}",
        headline=_prediction_headline(model, p),
        verdict=VerdictNote(f"The model is doubtful. {model.reservation}", sound=False) if model.reservation else None,
        scenes=(view,),
        accuracy=table if p.registered else None,
        residuals=(ResidualSet.from_scene(view),) if p.registered else (),
        parameters=parameter_rows(model, names),
        correlation=_correlation(model, names),
        undetermined=undetermined(model, names),
        tables=(_used_table(model, p), *_assumptions((*p.specimen.experiment.loading.assumed, *p.notes))),
        provenance=model.provenance,
    )


def fitted_too(model: CalibratedModel, p: Prediction) -> str:
    """What a prediction of a state says that the model was identified from; empty for any other state."""
    if f"{p.specimen.experiment.name}/{p.state}" not in model.load_cases:
        return ""
    return "The model was identified from this state too: the distance is that of the fit, and no test of the model."


def _prediction_headline(model: CalibratedModel, p: Prediction) -> tuple[str, ...]:
    what = {"side_plates": "side plates {} mm apart", "bar": "the bar {} mm above the base"}.get(
        p.specimen.experiment.loading.kind, "the plate {} mm above the base"
    )
    place, label = what.format(f"{p.platen_position_mm:.2f}"), f"{p.specimen.experiment.name}/{p.state}"
    if not p.registered:
        return (f"{len(p.points)} markers of {label} are predicted, with {place}; no measured positions are there to compare.", p.interval)
    a = accuracy(p.specimen, p.fit, p.residual)
    lead = f"The markers of {label} are predicted to {a.total:.2f} mm (RMS, 3-D), with {place}."
    return (
        lead,
        *filter(None, (fitted_too(model, p),)),
        f"Residuals are {a.noise_units:.2f} times the stated measurement noise, after a rigid registration of the scan.",
        p.interval,
    )


def _used_table(model: CalibratedModel, p: Prediction) -> Table:
    """Values that the prediction used and the model did not estimate for it."""
    known = model.parameters.values()
    rows = tuple((name, _short(value)) for name, value in p.values.items() if name not in known or not np.isclose(known[name], value))
    return Table("Boundary conditions and other values used (mm, rad, kPa)", ("parameter", "value"), rows)
