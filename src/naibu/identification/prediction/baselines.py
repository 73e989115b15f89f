"""What simple models make of a measured state: the yardsticks that an identified model has to beat."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.experiment import Experiment
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.core.rigid_transform import registration
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.initial_guess import force_balance
from naibu.identification.from_markers.observations import Trial
from naibu.identification.from_markers.parameter_names import platen_position, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen_model import ModelSettings, specimen
from naibu.identification.prediction.prediction import rms
from naibu.mechanics.finite_strain.statics import solve

REPORT = {"hardness 5": (222.0, 0.33), "hardness 0": (125.0, 0.44)}  # Young's modulus, kPa, and Poisson's ratio (report, Tables 3.4, 3.5)
REPORT_SINGLE_GEL = (222.0, 0.38)  # of a gel without a name; its modulus has no bearing on displacements


def baselines(trial: Trial, platen_position_mm: float) -> dict[str, float]:
    """Return the root mean square distance (mm) between measured markers and three simple descriptions of the state.

    Only markers with three trusted coordinates in the loaded state count; all of each description's freedoms are fitted to the data.

    Parameters
    ----------
    trial : Trial
        A measured state.
    platen_position_mm : float
        Height of the plate or bar above the base, or distance of the side plates, for the linear model.

    Returns
    -------
    dict
        ``rigid``: the free state moved rigidly; ``affine``: under the best affine map; ``linear``: linear elasticity with the report's
        parameters, sticking everywhere, registered to the markers; NaN where it has no solution (a law for small strain can turn
        elements over).

    Raises
    ------
    InputError
        Layers of materials that the report does not know, or an opening out of reach.
    """
    free, measured = trial.specimen.marker_points, trial.measured
    return {
        "rigid": rms(measured - registration(free, measured).applied(free)),
        "affine": rms(measured - affine(free, measured)),
        "linear": rms(residual) if np.isfinite(residual := measured - _linear(trial, platen_position_mm)).any() else np.nan,
    }


def balanced(calibration: Calibration) -> dict[str, float]:
    """Return the root mean square distance (mm) of every trial with the moduli that force balance between the markers gives (spec I2, I3).

    The boundary conditions, friction and the materials known beforehand are those of the calibration. Empty where force balance has no
    answer (no lattice, one material); without the trials that cannot be solved with its moduli.
    """
    experiments = {t.specimen.experiment.name: t.specimen.experiment for t in calibration.trials}
    states = {name: [t.state for t in calibration.trials if t.specimen.experiment.name == name] for name in experiments}
    try:
        found = force_balance(list(experiments.values()), calibration.known_materials, states)
    except (InputError, np.linalg.LinAlgError):
        return {}
    values = calibration.match.parameters.values()
    for name, (modulus, ratio) in found.items():
        values[young_modulus(name)] = modulus
        values[poisson_ratio(name)] = min(ratio, MAX_POISSON_RATIO - 1e-4)
    out = {}
    for trial in calibration.trials:
        try:
            displacement = solve(trial.specimen.problem(values, trial.state)).displacement
        except ConvergenceError:
            continue
        body = trial.specimen.reshaped(values)
        moved = body.marker_points + body.observation @ displacement
        out[trial.label] = rms(trial.measured - registration(moved, trial.measured).applied(moved))
    return out


def affine(points: FloatArray, measured: FloatArray) -> FloatArray:
    """Return points (k, 3) under the affine map that brings them closest to `measured` (k, 3), single coordinates of which may be NaN.

    Raises
    ------
    InputError
        Fewer than four markers know a coordinate.
    """
    design = np.column_stack([np.ones(len(points)), points])
    out = np.empty_like(points)
    for axis, name in enumerate("xyz"):
        seen = np.isfinite(measured[:, axis])
        if seen.sum() < 4:
            raise InputError(f"only {seen.sum()} markers have a measured {name}; an affine map needs 4")
        out[:, axis] = design @ np.linalg.lstsq(design[seen], measured[seen, axis], rcond=None)[0]
    return out


def report_parameters(experiment: Experiment) -> dict[str, float]:
    """Return the report's moduli, kPa, and Poisson's ratios of the materials, by parameter name.

    Raises
    ------
    InputError
        Several materials, of which the report does not know one.
    """
    values = {}
    for name in experiment.materials:
        if name not in REPORT and len(experiment.materials) > 1:
            raise InputError(f"the report measured {', '.join(REPORT)}; experiment {experiment.name!r} also has {name!r}")
        values[young_modulus(name)], values[poisson_ratio(name)] = REPORT.get(name, REPORT_SINGLE_GEL)
    return values


def _linear(trial: Trial, platen_position_mm: float) -> FloatArray:
    """Positions (k, 3), mm, of linear elasticity with the report's parameters, registered to the measured ones."""
    experiment = trial.specimen.experiment
    full = experiment.shape.size_mm[1 if experiment.loading.kind == "side_plates" else 2]
    if not 0.3 * full < platen_position_mm <= full:
        raise InputError(f"an opening of {platen_position_mm:g} mm is not between 30 % and 100 % of the object's {full:g} mm")
    size = trial.specimen.settings.element_size_mm
    body = specimen(experiment, ModelSettings(law="linear_elastic", contact="stick", element_size_mm=size))
    values = report_parameters(experiment) | {platen_position(experiment, trial.state): platen_position_mm}
    try:
        solution = solve(body.problem(values, trial.state))
    except ConvergenceError:
        return np.full_like(trial.measured, np.nan)
    moved = body.marker_points + body.observation @ solution.displacement
    return registration(moved, trial.measured).applied(moved)
