"""Moduli of regions that were fitted without a penalty, with the errors of measurement, discretisation and knowledge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.status import Status
from naibu.identification.from_fields.assumptions import assumed_law
from naibu.identification.from_fields.assumptions.known_ratios import asked_ratios, doubt_of_ratios
from naibu.identification.from_fields.assumptions.negative_ratio import asked_negative_ratio, judged_negative_ratio
from naibu.identification.from_fields.assumptions.other_assumptions import MovedBorder, assumptions, covariance_of
from naibu.identification.from_fields.assumptions.other_causes import Fitted, OtherCauses
from naibu.identification.from_fields.assumptions.score_test import ScoreTest
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import FieldElements, LawName
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Linearised, Point
from naibu.identification.from_fields.forward.zones_within_cells import RegionAt
from naibu.identification.from_fields.inversion.gauss_newton import AT_BOUND, Bounds, Objective
from naibu.identification.from_fields.mesh_error import (
    COARSE,
    at_least_to,
    doubt_in_all,
    one_cell_thick,
    relative_change,
    stretch_of,
    told_of_elements,
    weight_of_change,
)
from naibu.identification.from_fields.regions.border_refinement import CorrectedRegions, RefinedRegions
from naibu.identification.from_fields.size_correction import SizeCorrection, without_size_of_elements
from naibu.identification.from_fields.surface.bias import LEFT, without_bias
from naibu.identification.from_fields.surface.noise import SurfaceNoise
from naibu.identification.from_fields.surface.skewness import distances_of_bounds
from naibu.identification.from_fields.uncertainty import ErrorBudget, Uncertainty, intervals
from naibu.identification.from_fields.verdicts.discrepancy import doubt_of_model
from naibu.identification.from_fields.verdicts.statement import statement
from naibu.identification.from_fields.verdicts.verdict import FEW_POINTS, inflation, tells_poisson, verdict, with_enough_points
from naibu.identification.from_fields.verdicts.within_cells import DETERMINED, HalfSize, judged_within_cells, with_limits
from naibu.identification.verdict import Verdict


@dataclass(frozen=True, slots=True, eq=False)
class RegionFit:
    """The best fit of regions, as a search without a penalty ended.

    Attributes
    ----------
    model : FieldModel
    point : Point
    status : Status
        Of the search.
    refined : RefinedRegions or None
        Of a map: regions whose borders run through cells, as these fit them.
    corrected : CorrectedRegions or None
        The same on cells of half the size.
    of_map : bool
        Whether the zones are regions of a map: where errors of the elements helped to tell which regions there are.
    """

    model: FieldModel
    point: Point
    status: Status
    refined: RefinedRegions | None = None
    corrected: CorrectedRegions | None = None
    of_map: bool = False

    @property
    def freedom(self) -> float:
        """Degrees of freedom."""
        return self.model.n_free - 2.0 * self.model.zones.count


@dataclass(frozen=True, slots=True, eq=False)
class EstimateSettings:
    """What of the arguments of `naibu.identification.from_fields.estimate.identify_field` errors depend on."""

    law: LawName
    elements: FieldElements
    bounds: Bounds
    region_at: RegionAt | None
    borders: Sequence[MovedBorder]
    other_mesh: FloatArray | None


def region_estimate(fit: RegionFit, settings: EstimateSettings) -> FieldEstimate:
    """Return the moduli of a fit with their errors; the steps of the estimate are those that were taken here."""
    model, found = fit.model, _Measured.of(fit, settings)
    others = assumptions(found.at, found.quadratic, settings.law, found.stretch, settings.borders)
    of_known = covariance_of(others, len(found.size.theta))
    finer = None if found.size.shift is None else found.size.residuals
    free, law = assumed_law.with_law_free(found.at, finer, fit.freedom, found.stretch)
    variance = found.shared * max(1.0, found.misfit / fit.freedom)
    test = ScoreTest.of(found.at, found.quadratic, finer)
    ratios = asked_ratios(test, variance, found.stretch)
    judged, thin = _judged(fit, found, settings)
    explained = judged
    of_elements, coarse = _of_elements(fit, found, settings, judged, thin)
    total = found.of_noise.with_added(of_known + doubt_of_ratios(ratios, len(of_known))).with_law(law)
    total = total if of_elements is None else total.with_added(of_elements)
    unsaid = np.repeat([0.0, 0.0 if tells_poisson(model) else AT_BOUND], model.zones.count)
    at_bounds = settings.bounds.doubt_at(found.size.theta)
    total = total.with_added(np.outer(LEFT * found.taken, LEFT * found.taken)).with_added(np.diag(at_bounds**2 + unsaid**2))
    unbiased = Objective(bounds=settings.bounds).clipped(found.size.theta - found.bias)
    theta = np.where(at_bounds > 0.0, found.size.theta, unbiased)
    by_elements = None if of_elements is None else replace(found.of_noise, covariance=of_elements).of_young_and_poisson(theta)[0]
    known = found.size.shift is not None and found.size.alike
    judged, of_law = assumed_law.judged(judged, free, model.zones, theta, total, elements_known=known)
    whole = Fitted(test, fit.point, variance, found.stretch, found.size.residuals, found.misfit - fit.freedom, settings.bounds)
    causes = OtherCauses.asked(whole, judged, 0.0 if free is None else free.fall, ratios, of_map=fit.refined is not None)
    judged = causes.judged(judged, model.zones, theta, total, coarse=coarse)
    judged = judged_negative_ratio(judged, asked_negative_ratio(model, fit.point, variance, settings.bounds), explained.reasons)
    accounted = max(causes.accounted, 0.0 if law is None or free is None else free.fall)
    of_model = doubt_of_model(explained, found.information, found.misfit - fit.freedom, accounted)
    total = total.with_added(causes.covariance(len(theta)) + of_model * np.outer(found.stretch, found.stretch))
    judged = with_limits(judged, model.zones.names, by_elements, intervals(theta, total)[0], model.zones.unit, of_law=of_law)
    of_mesh = np.full(len(theta), np.nan) if of_elements is None else np.sqrt(np.diag(of_elements))
    budget = ErrorBudget(found.of_noise.standard_deviations(), of_mesh, np.sqrt(np.diag(of_known)), found.shared)
    limits = (*told_of_elements(coarse, thin), *(FEW_POINTS,) * (not tells_poisson(model)))
    words = statement(judged, model.zones, theta, total, others, limits=limits, budget=budget)
    states = tuple(u[: model.mesh.n_points] for u in found.point.states)
    borders, parts = (None, None) if fit.refined is None else (fit.refined.borders, fit.refined.parts)
    return FieldEstimate(
        model.mesh, model.zones, theta, states, found.misfit, fit.freedom, total, None, None, None, None, fit.status, found.size.told,
        words, judged, budget, found.size.shift, others, borders, parts, found.taken, free,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """Moduli at vanishing element size, with the errors of measurement.

    Attributes
    ----------
    point : Point
        Where the score without bias vanishes.
    at : Linearised
        There.
    quadratic : Concentrated
        In the moduli there.
    size : SizeCorrection
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    misfit : float
        Chi squared.
    shared : float
        Factor on the variance of moduli for residuals that neighbours share.
    on_mesh, of_noise : Uncertainty
        On the mesh, and at vanishing element size.
    bias, taken : ndarray, shape (2 count,)
        What of the bias is left, and all of it that is taken off the best fit.
    information : ndarray, shape (2 count, 2 count)
        Fisher information of the moduli for the stated noise.
    """

    point: Point
    at: Linearised
    quadratic: Concentrated
    size: SizeCorrection
    stretch: FloatArray
    misfit: float
    shared: float
    on_mesh: Uncertainty
    of_noise: Uncertainty
    bias: FloatArray
    taken: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, fit: RegionFit, settings: EstimateSettings) -> _Measured:
        model, freedom, refined = fit.model, fit.freedom, fit.refined
        variance = fit.point.misfit / freedom if freedom > 0.0 else 1.0
        score = without_bias(model, fit.point, Objective(bounds=settings.bounds), variance)
        quadratic, point = score.quadratic, score.at.point
        noise = SurfaceNoise.of(score.at, quadratic, variance)
        size = _size(fit, settings, score.at, quadratic, noise)
        size = replace(size, theta=np.where(score.free, size.theta, point.theta))  # how far beyond its bound one is, no fit says
        misfit = sum(float(r @ r) for r in size.residuals)
        factor = 1.0 if freedom <= 0.0 else max(1.0, float(np.sqrt(misfit / freedom)))
        of_noise = Uncertainty.of(noise.information.matrix, factor)
        shared = inflation(model.observed, size.residuals, score.at.jacobians(quadratic), of_noise.covariance, freedom)
        of_noise = Uncertainty(of_noise.information / shared, of_noise.covariance * shared)
        of_noise = of_noise.with_sides(distances_of_bounds(score, of_noise, variance, factor * float(np.sqrt(shared))))
        at, of_noise = model.linearised(model.evaluate(point.theta, point.states)), of_noise.with_added(size.of_noise)
        if refined is not None:
            of_noise = of_noise.with_added(factor**2 * shared * (refined.covariance - refined.at_these_borders)).with_added(refined.apart)
        stretch = stretch_of(np.zeros_like(size.theta) if size.shift is None or fit.corrected is not None else size.shift)
        bias = score.left(noise.information)
        taken = fit.point.theta - point.theta + bias
        stretched, information = of_noise.stretched(stretch), noise.information.matrix
        return cls(point, at, quadratic, size, stretch, misfit, shared, of_noise, stretched, bias, taken, information)


def _size(fit: RegionFit, settings: EstimateSettings, at: Linearised, quadratic: Concentrated, noise: SurfaceNoise) -> SizeCorrection:
    """Return moduli at vanishing element size, which regions whose borders run through cells may have already."""
    objective, from_best = Objective(bounds=settings.bounds), at.point.theta - fit.point.theta
    if fit.corrected is not None:
        none, theta = np.zeros_like(quadratic.hessian), objective.clipped(fit.corrected.refined.theta + from_best)
        return SizeCorrection(theta, fit.corrected.residuals, fit.corrected.shift, True, none, ())
    found = without_size_of_elements(at, quadratic, noise, settings.law, settings.elements, settings.bounds, settings.region_at)
    if fit.refined is None:
        return found
    return replace(found, theta=objective.clipped(found.theta + fit.refined.theta - at.point.theta + from_best))


def _judged(fit: RegionFit, found: _Measured, settings: EstimateSettings) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict on the residuals and on zones that end within cells, and the zones that are one cell thick."""
    model, size, freedom = fit.model, found.size, fit.freedom
    judged = with_enough_points(verdict(model.observed, size.residuals, freedom), model)
    thin = () if settings.region_at is None or fit.corrected is not None else one_cell_thick(model.mesh)
    if settings.region_at is not None and size.shift is not None:
        beyond_noise = (found.point.misfit - freedom, found.misfit - freedom)
        half = HalfSize(found.point.theta, size.theta, found.on_mesh, beyond_noise=beyond_noise)
        judged = judged_within_cells(judged, model.zones.names, half, np.isin(model.zones.names, thin))
    return judged, thin


def _of_elements(
    fit: RegionFit, found: _Measured, settings: EstimateSettings, judged: Verdict, thin: tuple[str, ...]
) -> tuple[FloatArray | None, bool]:
    """Return the covariance (2 count, 2 count) of what elements leave in doubt, None where it is not known; and whether they are coarse."""
    shift, names, sure = found.size.shift, fit.model.zones.names, found.on_mesh.standard_deviations() < DETERMINED
    if shift is None:
        return None, False
    if fit.corrected is None:
        layers, apart = np.isin(names, thin) if thin else None, np.isin(names, judged.mesh_dependent)
        change, weight = relative_change(shift), weight_of_change(found.size.theta - shift)
        mixed = settings.region_at is not None or not found.size.alike or fit.model.surface_sought or fit.of_map
        covariance = doubt_in_all(change, sure, found.quadratic.hessian, apart, mixed=mixed, thin=layers, weight=weight)
        coarse = bool(sure.any()) and (bool(thin) or float(np.abs(weight * change)[sure].max(initial=0.0)) > COARSE)
    else:
        covariance, coarse = fit.corrected.doubt, not fit.corrected.converged
    return at_least_to(settings.other_mesh, found.size.theta, covariance * np.outer(found.stretch, found.stretch)), coarse
