"""Baselines for predictions: rigid transform, affine map, linear elasticity, and moduli from the equilibrium gap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError, NaibuError
from naibu.core.experiment import Experiment
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.core.rigid_transform import registration
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.initial_guess import equilibrium_gap
from naibu.identification.from_markers.observations import MarkerLoadCase
from naibu.identification.from_markers.specimen.parameter_names import platen_position, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.resting_state import since_scan
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.prediction.prediction import rms
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import solve

FOLLOWED = SolverSettings(
    smallest_step=0.01, tolerance=1e-5, max_total_iterations=100, pseudo_transient=False
)  # a comparison needs no rescue
# Young's modulus, kPa, and Poisson's ratio that Hirai et al. (2008), Tables 3.4 and 3.5, give for their two gels
REPORT = {"hardness 5": (222.0, 0.33), "hardness 0": (125.0, 0.44)}


def baselines(load_case: MarkerLoadCase, values: Mapping[str, float]) -> dict[str, float]:
    """Return the root mean square distance, mm, of measured markers from three simple models of the state.

    Only markers with three trusted coordinates in the loaded state count; all parameters of the maps are fitted to the data.

    Parameters
    ----------
    load_case : Load case
        A measured state.
    values : mapping of str to float
        Identified or stated parameters; the linear model takes the platen position and the moduli from them.

    Returns
    -------
    dict
        ``rigid``: a rigid transform of the reference configuration; ``affine``: the best affine map; ``linear``: linear elasticity with
        the parameters of `linear_parameters`, sticking everywhere, registered to the markers; NaN where it has no solution (a law for
        small strain can turn elements over).

    Raises
    ------
    InputError
        A platen position out of reach.
    """
    residual = load_case.measured - _linear(load_case, values)
    return {**_of_maps(load_case), "linear": rms(residual) if np.isfinite(residual).any() else np.nan}


def _of_maps(load_case: MarkerLoadCase) -> dict[str, float]:
    free, measured = load_case.specimen.marker_points, load_case.measured
    return {
        "rigid": rms(measured - registration(free, measured).applied(free)),
        "affine": rms(measured - affine(free, measured)),
    }


def baselines_of(calibration: Calibration) -> Iterator[tuple[str, str, float]]:
    """Give load case, name and distance, mm, of the baselines of all load cases, one after the other.

    Those of `baselines`, without the linear one where it does not apply, and "equilibrium gap", see `equilibrium_gap_baseline`.
    """
    values = calibration.match.parameters.values()
    for load_case in calibration.load_cases:
        try:
            found = baselines(load_case, values)
        except NaibuError:
            found = _of_maps(load_case)
        yield from ((load_case.name, name, distance) for name, distance in found.items())
    for label, distance in equilibrium_gap_baseline(calibration):
        yield label, "equilibrium gap", distance


def equilibrium_gap_baseline(calibration: Calibration) -> Iterator[tuple[str, float]]:
    """Give the root mean square distance, mm, of every load case with the moduli of the equilibrium gap between the markers.

    The boundary conditions, friction and known materials are those of the calibration. Nothing where the equilibrium gap has no solution
    (no lattice, one material); without the load cases that cannot be solved with its moduli.
    """
    experiments = {t.specimen.experiment.name: t.specimen.experiment for t in calibration.load_cases}
    states = {name: [t.state for t in calibration.load_cases if t.specimen.experiment.name == name] for name in experiments}
    try:
        found = equilibrium_gap(list(experiments.values()), calibration.known_materials, states)
    except (InputError, np.linalg.LinAlgError):
        return
    values = calibration.match.parameters.values()
    for name, (modulus, ratio) in found.items():
        values[young_modulus(name)] = modulus
        values[poisson_ratio(name)] = min(ratio, MAX_POISSON_RATIO - 1e-4)
    for load_case in calibration.load_cases:
        near = calibration.warm_starts[load_case.name].warm_start(values)
        try:
            displacement = since_scan(solve(load_case.specimen.problem(values, load_case.state), settings=FOLLOWED, warm_start=near))
        except ConvergenceError:
            continue
        body = load_case.specimen.reshaped(values)
        moved = body.marker_points + body.at_markers(displacement)
        yield load_case.name, rms(load_case.measured - registration(moved, load_case.measured).applied(moved))


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


def linear_parameters(experiment: Experiment, values: Mapping[str, float]) -> dict[str, float]:
    """Return the Young's moduli, kPa, and Poisson's ratios of the linear baseline, by parameter name.

    They are those of :cite:t:`hirai2008` for an experiment on both of its gels, and else the identified or stated ones in `values`.
    """
    if set(experiment.materials) == set(REPORT):
        found = {m: REPORT[m] for m in experiment.materials}
    else:
        found = {m: (values[young_modulus(m)], values[poisson_ratio(m)]) for m in experiment.materials}
    return {name(m): v for m, pair in found.items() for name, v in zip((young_modulus, poisson_ratio), pair, strict=True)}


def _linear(load_case: MarkerLoadCase, values: Mapping[str, float]) -> FloatArray:
    """Positions (k, 3), mm, of linear elasticity with the parameters of `linear_parameters`, registered to the measured ones."""
    experiment = load_case.specimen.experiment
    position = platen_position(experiment, load_case.state)
    platen_position_mm = values[position]
    full = experiment.shape.size_mm[1 if experiment.loading.kind == "side_plates" else 2]
    if not 0.3 * full < platen_position_mm <= full:
        raise InputError(f"a platen position of {platen_position_mm:g} mm is not between 30 % and 100 % of the object's {full:g} mm")
    size = load_case.specimen.settings.element_size_mm
    body = specimen(experiment, ModelSettings(law="linear_elastic", contact="stick", element_size_mm=size))
    chosen = linear_parameters(experiment, values) | {position: platen_position_mm}
    try:
        solution = solve(body.problem(chosen, load_case.state), settings=FOLLOWED)
    except ConvergenceError:
        return np.full_like(load_case.measured, np.nan)
    moved = body.marker_points + body.at_markers(since_scan(solution))
    return registration(moved, load_case.measured).applied(moved)
