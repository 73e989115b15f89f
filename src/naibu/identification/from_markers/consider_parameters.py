"""Consider parameters: what a calibration took for known, and is known only roughly, and the equations of its end with them free.

Quantities that a calibration takes for known, though they are known only roughly, are *consider parameters*
(:cite:p:`schmidt1966,tapley2004`): the curvature of the law, the friction of a surface on which an object merely lies, the size of a
pixel. They are not estimated, but enter the covariance of everything that is, through their sensitivities and priors. What the model
still misses is a smooth discrepancy (:cite:p:`kennedy2001`), whose size and reach follow from the correlation of the residuals of
neighbouring markers; data that share it count as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist, squareform

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.parameters import Parameter, ParameterSet
from naibu.identification.from_markers.calibration import PIXEL_SCALE_SD, SHAPE_SD, Calibration
from naibu.identification.from_markers.gauss_newton import Matcher, NormalEquations
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

# Parameters of laws that predictions count with. The cubic term grows with the fourth power of the strain; where that of a predicted state
# is beyond what was calibrated, displacements to first order in it exaggerate many times: what stiffens is strained less.
PREDICTED_SHAPES = ("c01_fraction", "c20_ratio")
# standard deviations of what is taken for known, on the optimiser's scale
ELEMENTS, ELEMENTS_SD = "error of the elements", 0.5  # relative: for orders of convergence of 1 to 2, where 1.5 is taken
FRICTION_SD = 1.0
STRAIGHT_BASE_SD_MM = 1.0  # of a stated height, as of a mould
STIFFNESS_SD = 0.7  # of the modulus of a gel whose scale is not known: its weight deforms it accordingly
NEIGHBOURS = 1.3  # markers within this many spacings are neighbours
LEAST_NOISE = 0.5  # times the stated noise
REACH = 2.0  # of a smooth discrepancy, in spacings of the markers


@dataclass(frozen=True, slots=True, eq=False)
class Considered:
    """The end of a search with its consider parameters free.

    Attributes
    ----------
    parameters : ParameterSet
        Free ones of the search, the consider parameters and, where the error of the elements is known, its size (`ELEMENTS`).
    fits : tuple of LoadCaseFit
        The solutions of the search with derivatives with respect to all of them, less the error of the elements.
    equations : NormalEquations
        The linearised objective.
    slopes : ndarray, shape (p,)
        Of the free parameters: d physical / d inner.
    sought : ndarray, shape (p,), bool
        Whether the search sought a free parameter.
    smooth_mm2 : float
        Variance of a coordinate that the model misses, smooth over the markers.
    noise_factor : float
        Factor on the stated noise that explains the rest of the residuals.
    variance : float
        Of a datum in units of the stated noise, for parameters: a smooth discrepancy is seen once by all markers that share it.
    """

    parameters: ParameterSet
    fits: tuple[LoadCaseFit, ...]
    equations: NormalEquations
    slopes: FloatArray
    sought: BoolArray
    smooth_mm2: float
    noise_factor: float
    variance: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names (p,) of the free parameters."""
        return tuple(p.name for p in self.parameters.free)

    @property
    def base(self) -> BoolArray:
        """Whether a free parameter (p,) was sought, or is the size of the error of the elements."""
        return np.asarray(self.sought | np.array([name == ELEMENTS for name in self.names]))

    def step(self, kept: BoolArray) -> FloatArray:
        """Return the step (s,) to the optimum of the parameters that are `kept` (p,), poses following; 0 for others."""
        inside, hessian = self._inside(kept)
        out = np.zeros(len(inside))
        out[inside] = np.linalg.solve(hessian, self.equations.gradient[inside] / self.variance)
        return out

    def covariance(self, kept: BoolArray) -> FloatArray:
        """Return the covariance (p, p) of the parameters that are `kept` (p,), the poses marginalised; 0 for others."""
        count, size = int(kept.sum()), len(kept)
        out = np.zeros((size, size))
        out[np.ix_(kept, kept)] = np.linalg.inv(self._inside(kept)[1])[:count, :count]
        return out

    def shift(self, kept: BoolArray) -> FloatArray:
        """Return by how much the parameters (p,) would move if the consider parameters that are `kept` (p,) had been sought, too.

        The search ended close to the optimum, which is not close enough where data hardly tell parameters apart: both are steps from there.
        """
        return (self.step(kept) - self.step(self.base))[: len(kept)]

    def _inside(self, kept: BoolArray) -> tuple[BoolArray, FloatArray]:
        """Which unknowns (s,) are `kept`, all poses among them, and their part of the Hessian with priors."""
        inside = np.concatenate([kept, np.ones(len(self.equations.gradient) - len(kept), dtype=bool)])
        hessian = self.equations.data / self.variance
        prior = [1.0 / p.prior_sd**2 if np.isfinite(p.prior_sd) else 0.0 for p in self.parameters.free]
        hessian[: len(kept), : len(kept)] += np.diag(prior)
        return inside, hessian[np.ix_(inside, inside)]


def considered(calibration: Calibration) -> Considered:
    """Return the end of a calibration with its consider parameters free; nothing is solved anew.

    The error of the elements is an offset that residuals have in common with what another law would do. It is taken off, and its size,
    which follows from an order of convergence between 1 and 2, is a consider parameter itself.

    Raises
    ------
    ConvergenceError
        The tangent at a solution is singular.
    """
    match, load_cases, parameters = calibration.match, calibration.load_cases, calibration.priors
    for body in {t.specimen.experiment.name: t.specimen for t in load_cases}.values():
        parameters = with_considered(body, parameters)
    values = parameters.values() | match.parameters.values()
    fits = Matcher(load_cases, parameters).differentiated(match.fits, values)
    if calibration.mesh is not None:
        parameters = ParameterSet.of([*parameters, Parameter(ELEMENTS, 0.0, "", prior_sd=ELEMENTS_SD)])
        values[ELEMENTS] = 0.0
        fits = [_less_elements(f, moved) for f, moved in zip(fits, calibration.mesh.moved, strict=True)]
    inner = np.array([p.inner(values[p.name]) for p in parameters.free])
    equations = Matcher(load_cases, parameters).normal_equations(fits, inner)
    names = {p.name for p in match.parameters.free}
    sought = np.array([p.name in names for p in parameters.free])
    slopes = np.array([p.slope(values[p.name]) for p in parameters.free])
    smooth, white, variance = variances(load_cases, match.fits, match.noise_factor)
    return Considered(parameters, tuple(fits), equations, slopes, sought, smooth, float(np.sqrt(white)), variance)


def _less_elements(fit: LoadCaseFit, moved: FloatArray) -> LoadCaseFit:
    """Return a fit as vanishing elements would have it, with the error of the elements (k, 3), mm, as another direction."""
    return replace(fit, residual=fit.residual - moved, jacobian=np.concatenate([fit.jacobian, moved[:, :, None]], axis=2))


def with_considered(body: Specimen, parameters: ParameterSet, shapes: Sequence[str] = tuple(SHAPE_SD)) -> ParameterSet:
    """Return the parameters of a specimen with those that were taken for known, and are not, free within their priors.

    Of laws these are `shapes`, where the law of the specimen does not have them.
    """
    have, experiment = parameters.values(), body.experiment
    freed: dict[str, Parameter] = {}
    new = [
        Parameter(name, 0.0, "", prior_sd=SHAPE_SD[kind])
        for m in experiment.materials
        for kind in shapes
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


def variances(load_cases: Sequence[MarkerLoadCase], fits: Sequence[LoadCaseFit], noise_factor: float) -> tuple[float, float, float]:
    """Return the smooth part of residuals, mm2, and in units of the noise what is not shared, and what a datum counts for parameters."""
    smooth = smooth_variance(load_cases, fits)
    noise = float(np.mean([np.nanmean(np.where(np.isfinite(f.residual), f.sd**2, np.nan)) for f in fits]))
    white = max(LEAST_NOISE**2, noise_factor**2 - smooth / noise)
    # a misfit below the stated noise does not narrow the parameters
    return smooth, white, max(1.0, white) + smooth / noise * sharing(load_cases)


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


def sharing(load_cases: Sequence[MarkerLoadCase]) -> float:
    """Return over how many measured markers a smooth discrepancy is about the same: those that count as one."""
    return float(np.mean([np.nanmean(_sharing(t)) for t in load_cases]))


def _sharing(load_case: MarkerLoadCase) -> FloatArray:
    """The same number of every marker (k,); NaN for markers not measured."""
    points, seen = load_case.specimen.marker_points, np.isfinite(load_case.measured).all(axis=1)
    near = np.exp(-0.5 * (squareform(pdist(points)) / (REACH * _spacing(points))) ** 2)
    return np.where(seen, near @ seen, np.nan)
