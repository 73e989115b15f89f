"""Turn calibrations and predictions into the records that a report shows and the files that other programs open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from naibu.core.parameters import Parameter
from naibu.identification.calibration import Calibration, global_names
from naibu.identification.comparison import LeftOut
from naibu.identification.displacement_matching import Trial, TrialFit
from naibu.identification.model import CalibratedModel
from naibu.identification.prediction import Prediction, marker_layers
from naibu.identification.specimen import Specimen
from naibu.meshing.surface import boundary_faces, triangles_of_faces
from naibu.viewer.payload import Box, Correlation, ParameterRow, Report, ResidualSet, Scene, Step, Table

Array = NDArray[np.float64]


def residual_rows(residual: Array, sd: Array, exact: NDArray[np.bool_]) -> tuple[int, float, float, float, float, float]:
    """Return number of whole markers, RMS along x, y, z and in 3-D (mm), and RMS in units of the noise.

    Only markers measured completely in both states (`exact`) count.
    """
    whole = np.isfinite(residual).all(axis=1) & exact
    r = residual[whole]
    if not len(r):
        return 0, *([np.nan] * 5)
    x, y, z = np.sqrt((r**2).mean(axis=0))
    return len(r), float(x), float(y), float(z), float(np.sqrt((r**2).sum(axis=1).mean())), float(np.sqrt(((r / sd[whole]) ** 2).mean()))


def accuracy_table(calibration: Calibration, baselines: Mapping[str, Mapping[str, float]], left_out: Sequence[LeftOut] = ()) -> Table:
    """Return RMS of every trial, of its prediction when left out, and of simple baselines."""
    names = list(dict.fromkeys(k for row in baselines.values() for k in row))
    unseen = {f"{r.experiment}/{r.state}": r.rms_mm for r in left_out}
    columns = ["experiment/state", "markers", "x mm", "y mm", "z mm", "3-D mm", "in noise units"]
    columns += (["3-D mm, left out"] if unseen else []) + [f"{n}, 3-D mm" for n in names]
    rows = []
    for trial, fit in zip(calibration.trials, calibration.match.fits, strict=True):
        numbers = residual_rows(fit.residual, fit.sd, ~trial.specimen.marker_filled.any(axis=1))
        extra = [unseen.get(trial.label)] if unseen else []
        rows.append((trial.label, *(round(v, 3) for v in numbers), *(_round(v) for v in extra), *(_round(baselines.get(trial.label, {}).get(n)) for n in names)))
    note = "Root mean square over markers measured completely in both states. Left out: the other experiments identified the parameters."
    return Table("Measured against predicted markers", tuple(columns), tuple(rows), note)


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def scene(specimen: Specimen, state: str, fit: TrialFit, measured: Array, values: Mapping[str, float], role: str) -> Scene:
    """Return one state for the 3-D view, in the object's frame.

    Parameters
    ----------
    specimen : Specimen
        The meshed experiment.
    state : str
        Name of the state.
    fit : TrialFit
        Its solution.
    measured : ndarray, shape (k, 3)
        Measured markers in the object's frame, mm; NaN where not measured.
    values : mapping
        Physical values of all parameters.
    role : str
        Whether the state was fitted or predicted.
    """
    boundary = boundary_faces(specimen.mesh)
    nodes, local = np.unique(boundary.faces, return_inverse=True)
    faces = triangles_of_faces(local.reshape(boundary.faces.shape))
    steps = []
    paths = specimen.indenter_paths(values, state)
    base_offset = values.get(f"{specimen.experiment.name}: base_offset", 0.0)
    for s in fit.solution.states:
        gradient = specimen.deformation_gradient(s.displacement)
        markers = specimen.marker_points + specimen.observation @ s.displacement + base_offset * gradient[:, :, 2]
        boxes = tuple(_box(specimen, start + s.load * (stop - start), normal) for start, stop, normal in paths)
        travel = float(max(np.linalg.norm(stop - start) for start, stop, _ in paths))
        label = f"{100 * s.load:.0f} % of the load" if s.load < 1.0 else "full load"
        steps.append(Step(label, s.load * travel, specimen.mesh.points[nodes] + s.displacement[nodes], markers, boxes))
    free = specimen.marker_points + [0.0, 0.0, base_offset]
    layer = marker_layers(specimen.marker_points[:, 2], specimen.experiment.nominal_spacing_mm)
    name = f"{specimen.experiment.name}/{state}"
    sd = np.sqrt((fit.sd**2).mean(axis=1))
    return Scene(name, specimen.experiment.name, state, faces, specimen.mesh.points[nodes], tuple(steps), specimen.marker_ids, free, measured, sd, layer, role)


def _box(specimen: Specimen, position: Array, normal: Array) -> Box:
    """A slab whose face touches the object, drawn for a plate or bar."""
    size = 0.5 * np.array(specimen.experiment.shape.size_mm) + 4.0
    half = size.copy()
    axis = int(np.argmax(np.abs(normal)))
    half[axis] = 2.0
    loading = specimen.experiment.loading
    if loading.kind == "bar" and loading.bar_width_mm:
        half["xy".index("x" if loading.bar_axis == "y" else "y")] = loading.bar_width_mm / 2.0
        half[2] = 5.0
    centre = position - normal * half[axis]
    if axis != 2:
        centre = centre + [0.0, 0.0, size[2] - 4.0]
    return Box(tuple(centre.tolist()), tuple(half.tolist()))


def trial_scene(trial: Trial, fit: TrialFit, values: Mapping[str, float], role: str = "fitted") -> Scene:
    """Return a fitted trial for the 3-D view."""
    measured = (trial.measured - fit.pose.position) @ fit.pose.rotation + fit.pose.centre
    return scene(trial.specimen, trial.state, fit, measured, values, role)


def prediction_scene(prediction: Prediction) -> Scene:
    """Return a prediction for the 3-D view."""
    return scene(prediction.specimen, prediction.state, prediction.fit, prediction.measured_in_object, prediction.values, "predicted unseen")


def parameter_rows(model: CalibratedModel, names: Sequence[str]) -> tuple[ParameterRow, ...]:
    """Return estimates with 95 % intervals, given values with a note."""
    rows = []
    for p in model.parameters:
        if p.name in names or (p.fixed and p.name.endswith("young_modulus")):
            low, high = model.interval(p.name)
            note = "" if not p.fixed else ("given" if model.knowledge.scale_is_absolute else "sets the scale: moduli are ratios to it")
            rows.append(ParameterRow(p.name, p.name.replace("_", " "), p.value, low, high, p.unit, note))
    return tuple(rows)


def undetermined(model: CalibratedModel, names: Sequence[str]) -> tuple[str, ...]:
    """Say in words what the data cannot tell about the parameters `names`."""
    out = []
    if not model.knowledge.scale_is_absolute:
        out.append("Displacements alone do not give the absolute stiffness: the moduli are ratios to the material that sets the scale.")
    by_name: dict[str, Parameter] = {p.name: p for p in model.parameters}
    for name in names:
        p, sd = by_name[name], model.standard_deviation(name)
        low, high = model.interval(name)
        if np.isfinite(p.prior_sd) and sd > 0.6 * p.prior_sd:
            out.append(f"{name}: the data hardly narrow it down; {p.value:.3g} {p.unit}".rstrip() + " is close to what was assumed before.")
        elif name.endswith("friction") and high > 4.0 * p.value:
            out.append(f"{name}: anything above {low:.2g} looks the same, because the surfaces do not slip.")
        elif name.endswith("poisson_ratio") and high > 0.499:
            out.append(f"{name}: at least {low:.3f}; the data cannot tell it from incompressible.")
    if len(names) > 1:
        correlation = model.correlation(names)
        for i, j in zip(*np.where(np.triu(np.abs(correlation), 1) > 0.9), strict=True):
            out.append(f"{names[i]} and {names[j]} are determined only together (correlation {correlation[i, j]:+.2f}).")
    return tuple(out)


def build_report(
    calibration: Calibration, model: CalibratedModel, baselines: Mapping[str, Mapping[str, float]], left_out: Sequence[LeftOut] = (), tables: Sequence[Table] = ()
) -> Report:
    """Gather everything that a calibration's page shows."""
    names = global_names(model.parameters, calibration.trials)
    values = model.parameters.values()
    scenes = [trial_scene(t, f, values) for t, f in zip(calibration.trials, calibration.match.fits, strict=True)]
    accuracy = accuracy_table(calibration, baselines, left_out)
    worst = max(float(row[5]) for row in accuracy.rows)  # type: ignore[arg-type]
    headline = [f"One set of parameters predicts the markers of {len(scenes)} loaded state{'s' * (len(scenes) > 1)} to {worst:.2f} mm or better (RMS, 3-D)."]
    if left_out:
        headline.append(f"Predicted from the other experiments, they lie within {max(r.rms_mm for r in left_out):.2f} mm.")
    headline.append(f"Residuals are {model.noise_factor:.2f} times the stated measurement noise. {calibration.match.status.value}")
    correlation = Correlation(tuple(names), model.correlation(names)) if len(names) > 1 else None
    residuals = tuple(ResidualSet.from_scene(s) for s in scenes)
    nuisance = [p for p in model.parameters.free if p.name not in names]
    rows = tuple((p.name, p.value, *model.interval(p.name), p.unit) for p in nuisance)
    boundary = Table("Boundary conditions, found with the rest", ("parameter", "estimate", "95 % from", "to", "unit"), tuple(tuple(_short(c) for c in r) for r in rows))
    return Report(
        "Calibration of " + ", ".join(dict.fromkeys(t.specimen.experiment.name for t in calibration.trials)), tuple(headline), tuple(scenes), accuracy,
        residuals, parameter_rows(model, names), correlation, undetermined(model, names), (boundary, *tables), model.provenance,
    )  # fmt: skip


def _short(cell: str | float) -> str | float:
    return cell if isinstance(cell, str) else float(f"{cell:.4g}")
