"""What a calibration leaves uncertain about other load cases: parameters, what was not sought, and the misfit of the model.

Quantities that a calibration takes for known, though they are known only roughly, are *consider parameters*
(:cite:p:`schmidt1966,tapley2004`): the curvature of the law, the friction of a surface on which an object merely lies, the size of a
pixel. They are not estimated, but enter the covariance of everything that is, through their sensitivities and priors, and so widen the
prediction of a state in which they count. The estimate that they would have moves the others; the square of that motion is part of the
second moment that is kept. What the model still misses is a smooth discrepancy (:cite:p:`kennedy2001`), whose size and reach follow from
the correlation of the residuals of neighbouring markers; data that share it count as one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist, squareform

from naibu.core.arrays import FloatArray
from naibu.core.parameters import Parameter, ParameterSet
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase
from naibu.identification.from_markers.specimen.parameter_names import (
    SHAPE_NAMES,
    friction,
    pixel_scale,
    shape_parameter,
    straight_base,
    young_modulus,
)
from naibu.identification.from_markers.specimen.specimen_model import Specimen

# standard deviations of what is taken for known, on the optimiser's scale
SHAPE_SD: Mapping[str, float] = {"c01_fraction": 0.3, "c20_ratio": 0.3}
FRICTION_SD = 1.0
STRAIGHT_BASE_SD_MM = 1.0  # of a stated height, as of a mould
STIFFNESS_SD = 0.7  # of the modulus of a gel whose scale is not known: its weight deforms it accordingly
PIXEL_SCALE_SD = 0.005
NEIGHBOURS = 1.3  # markers within this many spacings are neighbours
LEAST_NOISE = 0.5  # times the stated noise
REACH = 2.0  # of a smooth discrepancy, in spacings of the markers


@dataclass(frozen=True, slots=True)
class CalibratedState:
    """A state that was used: its loading, and the root mean square equivalent logarithmic strain at its markers."""

    loading: str
    strain: float


@dataclass(frozen=True, slots=True, eq=False)
class PredictiveUncertainty:
    """What a calibration leaves uncertain about other load cases.

    Attributes
    ----------
    names : tuple of str
        Free parameters of the calibration, then the consider parameters.
    covariance : ndarray, shape (p, p)
        Second moment of the errors of `names`, on the optimiser's scale.
    discrepancy_mm : float
        Standard deviation of a coordinate from what the model misses, smooth over the markers, in the calibrating states.
    noise_factor : float
        Factor on the stated measurement noise that explains the rest of the residuals.
    states : mapping of str to CalibratedState
        The states used, by ``experiment/state``.
    mesh_step : tuple of float
        Change of `names` that would fit best with vanishing elements, on the optimiser's scale; empty where that was not estimated.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    discrepancy_mm: float
    noise_factor: float
    states: Mapping[str, CalibratedState]
    mesh_step: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, for JSON."""
        return {
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "discrepancy_mm": self.discrepancy_mm,
            "noise_factor": self.noise_factor,
            "states": {label: asdict(s) for label, s in self.states.items()},
            "mesh_step": list(self.mesh_step),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PredictiveUncertainty:
        """Read what `to_dict` wrote, which `naibu.identification.prediction.stored_model` has checked."""
        names = tuple(data["names"])
        covariance = np.array(data["covariance"], dtype=float).reshape(len(names), len(names))
        states = {str(label): CalibratedState(str(s["loading"]), float(s["strain"])) for label, s in data["states"].items()}
        return cls(
            names,
            covariance,
            float(data["discrepancy_mm"]),
            float(data["noise_factor"]),
            states,
            tuple(map(float, data.get("mesh_step", ()))),
        )


def with_considered(body: Specimen, parameters: ParameterSet) -> ParameterSet:
    """Return the parameters of a specimen with those that were taken for known, and are not, free within their priors."""
    have, experiment = parameters.values(), body.experiment
    freed: dict[str, Parameter] = {}
    new = [
        Parameter(name, 0.0, "", prior_sd=sd)
        for m in experiment.materials
        for kind, sd in SHAPE_SD.items()
        if kind not in SHAPE_NAMES.get(body.law.name, ()) and (name := shape_parameter(m, kind)) not in have
    ]
    if (name := pixel_scale(experiment)) not in have:
        new.append(Parameter(name, experiment.xy_scale, "", prior_sd=PIXEL_SCALE_SD))
    if experiment.loading.kind == "side_plates":
        doubtful = {friction(layer.material, experiment.loading.base_material): FRICTION_SD for layer in experiment.layers}
        if len(experiment.materials) == 1:
            doubtful[young_modulus(experiment.materials[0])] = STIFFNESS_SD
        if body.has_unknown_base:
            doubtful[straight_base(experiment)] = STRAIGHT_BASE_SD_MM
        freed = {
            p.name: Parameter(p.name, p.value, p.unit, p.scale, prior_sd=doubtful[p.name])
            for p in parameters
            if p.fixed and p.name in doubtful
        }
    return ParameterSet.of([*parameters.changed(freed), *new])


def predictive_uncertainty(calibration: Calibration) -> PredictiveUncertainty:
    """Return what a calibration leaves uncertain about other load cases.

    Raises
    ------
    ConvergenceError
        The tangent at a solution is singular.
    """
    match, load_cases = calibration.match, calibration.load_cases
    parameters = match.parameters
    for body in {t.specimen.experiment.name: t.specimen for t in load_cases}.values():
        parameters = with_considered(body, parameters)
    matcher = Matcher(load_cases, parameters)
    fits = matcher.differentiated(match.fits, parameters.values())
    equations = matcher.normal_equations(fits, parameters.start())
    smooth = smooth_variance(load_cases, match.fits)
    noise = np.mean([np.nanmean(np.where(np.isfinite(f.residual), f.sd**2, np.nan)) for f in match.fits])
    white = max(LEAST_NOISE**2, match.noise_factor**2 - smooth / noise)
    # a smooth discrepancy is seen once by all markers that share it; a misfit below the stated noise does not narrow the parameters
    variance = max(1.0, white) + smooth / noise * float(np.mean([np.nanmean(_sharing(t)) for t in load_cases]))
    names = [p.name for p in parameters.free]
    prior = np.diag([1.0 / p.prior_sd**2 if np.isfinite(p.prior_sd) else 0.0 for p in parameters.free])
    size = len(names)
    hessian = equations.data / variance
    hessian[:size, :size] += prior
    covariance = np.linalg.inv(hessian)[:size, :size]
    sought = {p.name for p in match.parameters.free}
    pull = np.array([0.0 if n in sought else g for n, g in zip(names, equations.gradient, strict=False)])
    shift = covariance @ pull / variance
    states = {
        t.name: CalibratedState(t.specimen.experiment.loading.kind, strain_at_markers(t.specimen, match.parameters.values(), f))
        for t, f in zip(load_cases, match.fits, strict=True)
    }
    steps = (
        {} if calibration.mesh is None else dict(zip((p.name for p in match.parameters.free), calibration.mesh.step.tolist(), strict=True))
    )
    return PredictiveUncertainty(
        tuple(names), covariance + np.outer(shift, shift), float(np.sqrt(smooth)), float(np.sqrt(white)), states,
        tuple(steps.get(name, 0.0) for name in names) if steps else (),
    )  # fmt: skip


def smooth_variance(load_cases: Sequence[MarkerLoadCase], fits: Sequence[LoadCaseFit]) -> float:
    """Return the variance, mm2, of a residual that neighbouring markers share: the mean product of their residuals along each axis."""
    total, count = 0.0, 0
    for load_case, fit in zip(load_cases, fits, strict=True):
        pairs = _neighbours(load_case.specimen.marker_points)
        products = fit.residual[pairs[:, 0]] * fit.residual[pairs[:, 1]]
        total += float(np.nansum(products))
        count += int(np.isfinite(products).sum())
    return max(0.0, total / count) if count else 0.0


def _spacing(points: FloatArray) -> float:
    """Median distance of a marker from the nearest other one, mm."""
    distances = np.asarray(KDTree(points).query(points, 2)[0])
    return float(np.median(distances[:, 1]))


def _neighbours(points: FloatArray) -> FloatArray:
    return np.asarray(KDTree(points).query_pairs(NEIGHBOURS * _spacing(points), output_type="ndarray"))


def _sharing(load_case: MarkerLoadCase) -> FloatArray:
    """Number of measured markers (k,) over which a smooth discrepancy is about the same; NaN for markers not measured."""
    points, seen = load_case.specimen.marker_points, np.isfinite(load_case.measured).all(axis=1)
    near = np.exp(-0.5 * (squareform(pdist(points)) / (REACH * _spacing(points))) ** 2)
    return np.where(seen, near @ seen, np.nan)


def strain_at_markers(body: Specimen, values: Mapping[str, float], fit: LoadCaseFit) -> float:
    """Return the root mean square equivalent logarithmic (Hencky) strain at the markers of a solution."""
    f = body.reshaped(values).deformation_gradient(fit.solution.displacement)
    principal = 0.5 * np.log(np.maximum(np.linalg.eigvalsh(np.einsum("kji,kjl->kil", f, f)), 1e-12))
    deviator = principal - principal.mean(axis=1, keepdims=True)
    return float(np.sqrt(2.0 / 3.0 * (deviator**2).sum(axis=1).mean()))
