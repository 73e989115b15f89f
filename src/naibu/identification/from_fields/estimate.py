"""Identification of moduli from measured displacement fields by FEMU: homogeneous start, penalised fit, regions with standard errors.

The estimate is that of maximum likelihood (:cite:p:`kavanagh1971,avril2008`): moduli p and the displacement of the loaded nodes, where
forces are unknown, minimise::

    sum_t |S_t^-1/2 (H_t u_t - d_t)|^2 / 2 + w R(p),    with u_t in equilibrium at all other nodes,

by Gauss-Newton with exact derivatives: explicit for few zones, by adjoints and conjugate gradients for many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.core.status import Status
from naibu.identification.from_fields.assumptions import assumed_law
from naibu.identification.from_fields.assumptions.other_assumptions import MovedBorder
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import FieldElements, LawName
from naibu.identification.from_fields.forward.load_cases import KNOWN, FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import (
    FieldModel,
    Point,
    logarithms,
    young_and_poisson,
)
from naibu.identification.from_fields.forward.zones_within_cells import RegionAt
from naibu.identification.from_fields.inversion.gauss_newton import (
    Bounds,
    Found,
    Objective,
    SearchSettings,
    StepRule,
    exact_step,
    first_point,
    search,
)
from naibu.identification.from_fields.inversion.regularization import Regularization, RegularizationName, ZoneGraph, regularization
from naibu.identification.from_fields.inversion.regularization_weight import WeightChoice, WeightRule, WeightTrial, choose_weight
from naibu.identification.from_fields.inversion.truncated_newton import truncated_step
from naibu.identification.from_fields.mesh_error import misfit_on_finer_mesh
from naibu.identification.from_fields.region_estimate import EstimateSettings, RegionFit, region_estimate
from naibu.identification.from_fields.regions.border_refinement import (
    MOST_REGIONS,
    CorrectedRegions,
    RefinedRegions,
    on_finer_cells,
    refined_regions,
    without_errors_of_cells,
)
from naibu.identification.from_fields.regions.segmentation import (
    EXPLICIT,
    Segmentation,
    fitted_nearby,
    point_at,
    segment,
    weight_of_borders,
)
from naibu.identification.from_fields.uncertainty import resolution, resolution_report
from naibu.identification.from_fields.verdicts.within_cells import told_alike
from naibu.identification.load_case import require_load_cases
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import rigid_body_modes

FEW = 12  # zones up to which no penalty is needed by default
START_POISSON_RATIO = 0.4
NO_REGIONS = "No few regions of one material each explain the measurement: the result is a map under a penalty, without intervals."
MOST_UNKNOWNS = 120_000  # nodal displacements of the quadratic elements with which regions of a map are refitted
SEARCH_AT_WEIGHT = SearchSettings(max_iterations=15, tolerance=1e-3)
DOUBTFUL = 0.3  # of the deformation, by root mean square, from which a homogeneous body that leaves it makes the field itself doubtful
DOUBTFUL_SD = 5.0  # and standard deviations of the measurement
UNEXPLAINED = 3.0  # standard deviations of chi squared by which regions may fit worse than the regularised field


def identify_field(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    zones: Zones,
    *,
    law: LawName = "linear",
    regularization: RegularizationName | Literal["automatic"] | None = "automatic",
    weight: WeightRule | float = "discrepancy",
    segmented: bool = True,
    bounds: Bounds | None = None,
    start: tuple[FloatArray, FloatArray] | None = None,
    elements: FieldElements = "accurate",
    region_at: RegionAt | None = None,
    borders: Sequence[MovedBorder] = (),
    other_mesh: FloatArray | None = None,
    progress: Progress | None = None,
) -> FieldEstimate:
    """Find the moduli of zones from displacement fields measured in one or more load cases, no force being known.

    Parameters
    ----------
    mesh : Mesh
        Lines, triangles, linear tetrahedra or hexahedra; independent of the points of measurement.
    load_cases : sequence of FieldLoadCase
        Pushes of the body, the loaded components of its nodes, and what was measured.
    zones : Zones
        Known cells, and which cells share a pair of unknown moduli; `Zones.of(..., each_cell=True)` where nothing is known of regions.
    law : {"linear", "neo_hookean"}
        Small strain, or compressible neo-Hookean at finite strain (in three dimensions).
    regularization : {"automatic", "total_variation", "laplacian"} or None
        Penalty on jumps between neighbouring zones. Automatic is total variation for more than `FEW` zones, none for fewer.
    weight : {"discrepancy", "l_curve"} or float
        How much the penalty weighs (see `naibu.identification.from_fields.inversion.regularization_weight.choose_weight`).
    segmented : bool
        Whether to make regions of what was found under total variation, and to fit these without the penalty. The result are the regions
        if they explain the measurements, the regularised field otherwise.
    bounds : Bounds, optional
        Of the moduli.
    start : tuple of ndarray, shape (count,), optional
        lambda and mu of the zones, kPa, to start from; by default those of a homogeneous body that fits best.
    elements : {"accurate", "as_given"}
        Accurate gives tetrahedra mid-edge nodes and hexahedra the mean dilatation of their points, and extrapolates moduli of regions to
        vanishing element size from a mesh of half the element size. As given serves data computed with the very elements of `mesh`. Maps of
        the moduli of many tetrahedra use them as given; the regions made of such a map are refitted with accurate ones.
    region_at : callable, optional
        Number of the region of `mesh` at points (k, d), mm, negative outside of the body: where zones that are named in `zones` end inside
        of cells, what this changes is found on the mesh of half the element size, and corrected for. Maps do not use it.
    borders : sequence of MovedBorder
        Where borders of regions may lie as well; becomes part of the intervals, each by itself.
    other_mesh : ndarray, shape (2 count,), optional
        ln mu, then ln(kappa / mu) of the zones as found on another mesh: what elements leave in doubt is at least by how much these differ.
    progress : callable, optional
        Gets a report after every step, its stage in words, which are in `FieldEstimate.steps` too; and counted ones within long steps.

    Raises
    ------
    InputError
        No load case, zones of another mesh, or options that are not known.
    ConvergenceError
        No equilibrium at the start, or a measured field that does not fix how the loaded nodes move.
    """
    require_load_cases(load_cases)
    if len(zones.of_cell) != mesh.n_cells:
        raise InputError(f"the zones are of a mesh of {len(zones.of_cell)} cells, this mesh has {mesh.n_cells}")
    automatic: RegularizationName | None = "total_variation" if zones.count > FEW else None
    name = automatic if regularization == "automatic" else regularization
    of_map: FieldElements = "as_given" if name is not None and mesh.cell_type == "tetra" else elements
    model = FieldModel(mesh, load_cases, zones, law, of_map, progress)
    within = region_at if name is None else None
    recipe = _Recipe(model, tuple(load_cases), law, elements, bounds or Bounds(), [], progress, within, tuple(borders), other_mesh)
    point = recipe.start(start)
    return recipe.free(point) if name is None else recipe.regularized(point, name, weight, segmented)


def homogeneous_moduli(
    mesh: Mesh, load_cases: Sequence[FieldLoadCase], zones: Zones, *, law: LawName, bounds: Bounds, progress: Progress | None = None
) -> tuple[float, float, str]:
    """Return lambda and mu, kPa, of the unknown part of a body if it were homogeneous, and in words what that leaves.

    On larger cells than those of `identify_field` it is a start for that which is found in a small part of the time.

    Raises
    ------
    ConvergenceError
        No equilibrium, or a measured field that does not fix how the loaded nodes move.
    """
    model = FieldModel(mesh, load_cases, zones, law, progress=progress)
    recipe = _Recipe(model, tuple(load_cases), law, "accurate", bounds, [], progress, None, (), None)
    _, found = recipe.homogeneous()
    shear, ratio = np.exp(found.point.theta)
    return float(shear * (ratio - 2.0 / 3.0)), float(shear), recipe.steps[-1]


def _doubt(homogeneous: FieldModel, misfit: float) -> str:
    """Return in words what to check where a homogeneous body explains little of a field; empty where it does not."""
    modes = rigid_body_modes(homogeneous.computed.points)
    deformation = sum(float(o.beyond(modes, o.data) @ o.data) for o in homogeneous.observed)
    share, sd = np.sqrt(misfit / deformation) if deformation > 0.0 else 0.0, np.sqrt(misfit / homogeneous.n_free)
    if share < DOUBTFUL or sd < DOUBTFUL_SD:
        return ""
    return (
        f"; it leaves {100.0 * min(share, 1.0):.0f} % of the deformation unexplained (root mean square; {sd:.3g} standard deviations): "
        "unless stiffness varies that much, check signs, axes, units and frame of the displacements"
    )


@dataclass(slots=True, eq=False)
class _Recipe:
    """The steps of an identification, recorded and reported."""

    model: FieldModel
    load_cases: tuple[FieldLoadCase, ...]
    law: LawName
    elements: FieldElements
    bounds: Bounds
    steps: list[str]
    progress: Progress | None
    region_at: RegionAt | None
    borders: tuple[MovedBorder, ...]
    other_mesh: FloatArray | None

    def record(self, text: str, objective: float | None = None) -> None:
        """Keep a step in words, and report it."""
        self.steps.append(text)
        report_progress(self.progress, text, objective=objective)

    def start(self, given: tuple[FloatArray, FloatArray] | None) -> Point:
        """Return where to begin: the given moduli, or those of the homogeneous body that fits best."""
        objective = Objective(bounds=self.bounds)
        report_progress(self.progress, "finding how the loaded nodes move", done=0, total=1)
        if given is not None:
            return first_point(self.model, objective.clipped(logarithms(*(np.asarray(g, dtype=float) for g in given))))
        homogeneous, found = self.homogeneous()
        theta = np.repeat(found.point.theta, self.model.zones.count)
        if homogeneous.computed is self.model.computed:
            return self.model.evaluate(theta, found.point.states)
        return first_point(self.model, theta)

    def homogeneous(self) -> tuple[FieldModel, Found]:
        """Return the homogeneous body that fits best."""
        objective, zones = Objective(bounds=self.bounds), self.model.zones
        homogeneous = self._plain().with_zones(zones.of_one_material())
        known = zones.known_mu[zones.of_cell == KNOWN]
        shear = float(np.exp(np.log(known).mean())) if len(known) else 1.0
        ratio = 2.0 * (1.0 + START_POISSON_RATIO) / (3.0 * (1.0 - 2.0 * START_POISSON_RATIO))
        first = first_point(homogeneous, objective.clipped(np.log([shear, ratio])))
        found = search(homogeneous, first, objective, SearchSettings(tolerance=1e-3), progress=self.progress)
        young, poisson = young_and_poisson(found.point.theta)
        self.record(
            f"homogeneous start: Young's modulus {young[0]:.4g}{zones.unit}, Poisson's ratio {poisson[0]:.3f}, "
            f"misfit {found.point.misfit:.4g} (noise alone: {self.model.n_free:.4g}){_doubt(homogeneous, found.point.misfit)}"
        )
        return homogeneous, found

    def _plain(self) -> FieldModel:
        """Return the model with the elements of the mesh as they are, where these cost less and lead to a start as well."""
        if self.model.computed is self.model.mesh:
            return self.model
        return FieldModel(self.model.mesh, self.load_cases, self.model.zones, self.law, "as_given", self.progress)

    def free(self, point: Point) -> FieldEstimate:
        """Fit the zones without a penalty."""
        found = search(self.model, point, Objective(bounds=self.bounds), progress=self.progress)
        self.record(
            f"fit of {self.model.zones.count} zones without penalty: misfit {found.point.misfit:.4g} after {found.iterations} iterations"
        )
        return self._estimate(self.model, found.point, found.status)

    def regularized(self, point: Point, name: RegularizationName, weight: WeightRule | float, segmented: bool) -> FieldEstimate:
        """Fit under a penalty of automatic weight, and make regions of it."""
        graph = ZoneGraph.of(self.model.mesh, self.model.zones)
        penalty = regularization(name, graph)
        choice = self._weight(point, penalty, graph, weight)
        found = choice.taken.found
        objective = Objective(penalty, choice.taken.weight, self.bounds)
        at = self.model.linearised(self.model.evaluate(found.point.theta, found.point.states))
        resolved = resolution(at, objective, explicit=self._explicit())
        estimate = self._under_penalty(found, choice, resolved)
        if name != "total_variation" or not segmented:
            return self._as_map(estimate)
        natural = weight_of_borders(graph)
        if weight == "discrepancy" and choice.met and choice.taken.weight > natural:  # regions are judged by probability: noise makes none
            objective = Objective(penalty, natural, self.bounds)
            found = search(self.model, at.point, objective, SEARCH_AT_WEIGHT, rule=self._rule(), progress=self.progress)
            self.record(f"{penalty.name} of weight {natural:.3g}, for regions: misfit {found.point.misfit:.4g}")
            choice = replace(choice, trials=(WeightTrial(natural, found, found.point.misfit, penalty.value(found.point.theta)),), chosen=0)
            at = self.model.linearised(self.model.evaluate(found.point.theta, found.point.states))
        try:
            regions = segment(self.model, graph, at.point, choice.taken.weight, self.bounds, self.progress)
        except ConvergenceError as error:
            self.record(f"with regions of one material each no equilibrium was found ({error}): the regularised field is the result")
            return self._as_map(estimate, NO_REGIONS)
        return self._with_regions(estimate, regions, graph)

    def _rule(self) -> StepRule:
        return exact_step if self._explicit() else truncated_step

    def _explicit(self) -> bool:
        return self.model.zones.count <= EXPLICIT

    def _weight(self, point: Point, penalty: Regularization, graph: ZoneGraph, rule: WeightRule | float) -> WeightChoice:
        step = self._rule()

        def solve(weight: float, start: Found | None) -> WeightTrial:
            at = point if start is None else start.point
            first = self.model.evaluate(at.theta, at.states)
            found = search(self.model, first, Objective(penalty, weight, self.bounds), SEARCH_AT_WEIGHT, rule=step, progress=self.progress)
            done = WeightTrial(weight, found, found.point.misfit, penalty.value(found.point.theta))
            self.record(
                f"{penalty.name} of weight {weight:.3g}: misfit {done.misfit:.4g} (noise alone: {self.model.n_free:.4g}), "
                f"penalty {done.penalty:.4g}, {found.iterations} iterations"
            )
            return done

        def uniform() -> WeightTrial:
            one = self.model.with_zones(self.model.zones.of_one_material())
            start = one.evaluate(point.theta.reshape(2, -1).mean(axis=1), point.states)
            found = search(one, start, Objective(bounds=self.bounds), SEARCH_AT_WEIGHT, progress=self.progress)
            everywhere = self.model.evaluate(np.repeat(found.point.theta, self.model.zones.count), found.point.states)
            return WeightTrial(max(first, 2.0 * weight_of_borders(graph)), replace(found, point=everywhere), everywhere.misfit, 0.0)

        # a jump of 1 across the body would cost as much as a sixth of what the homogeneous body leaves unexplained
        first = 0.5 * point.misfit / (6.0 * float(graph.volume.sum()) ** ((self.model.mesh.dimension - 1) / self.model.mesh.dimension))
        choice = choose_weight(solve, first, self.model.n_free, rule, uniform)
        self.record(choice.reason)
        return choice

    def _under_penalty(self, found: Found, choice: WeightChoice, resolved: FloatArray) -> FieldEstimate:
        """Return the regularised field as an estimate."""
        mesh, zones = self.model.mesh, self.model.zones
        unknown = np.flatnonzero(zones.of_cell != KNOWN)
        of_zone = zones.of_cell[unknown]
        middles = mesh.points[mesh.cells[unknown]].mean(axis=1)
        centres = np.stack([np.bincount(of_zone, x, zones.count) for x in middles.T], axis=1)
        words = resolution_report(zones, centres / np.bincount(of_zone, minlength=zones.count)[:, None], resolved)
        point = found.point
        return FieldEstimate(
            mesh, zones, point.theta, point.states, point.misfit, self.model.n_free - float(resolved.sum()), None, choice,
            young_and_poisson(point.theta), resolved, None, found.status, tuple(self.steps), words,
        )  # fmt: skip

    def _as_map(self, field: FieldEstimate, *first: str) -> FieldEstimate:
        """Return the field under the penalty as the result, with sentences that come `first`."""
        words = assumed_law.warned(assumed_law.largest_strain(self.model, field.states), (*first, *field.identifiability))
        return replace(field, steps=tuple(self.steps), identifiability=words)

    def _with_regions(self, field: FieldEstimate, regions: Segmentation, graph: ZoneGraph) -> FieldEstimate:
        """Return the regions as the result if they explain the measurements, else the field under the penalty."""
        target = self.model.n_free
        limit = max(field.chi_squared, target) + UNEXPLAINED * float(np.sqrt(2.0 * target))
        if regions.point.misfit > limit:
            regions = replace(regions, point=self._fitted(regions))
        misfit, count = regions.point.misfit, regions.zones.count
        self.record(
            f"{regions.clusters} clusters made {count} regions ({regions.moved} zones changed sides): misfit {misfit:.4g} without penalty"
        )
        if misfit > limit:  # a map of many moduli makes up for errors of cells, regions cannot
            misfit = self._on_finer_mesh(regions) or misfit
        if misfit > limit:
            self.record(f"the regions leave more unexplained than noise would ({limit:.4g}): the regularised field is the result")
            return replace(self._as_map(field, NO_REGIONS), segmentation=regions)
        sharp = self._with_borders(regions, graph)
        assert sharp.uncertainty is not None and sharp.verdict is not None  # of regions that were fitted without a penalty
        told = told_alike(sharp.zones.names, sharp.theta, sharp.uncertainty, 0)
        judged = replace(sharp.verdict, limits="; ".join(filter(None, (told, sharp.verdict.limits))))
        sharp = replace(sharp, verdict=judged, identifiability=(judged.sentence, *sharp.identifiability[1:]))
        return replace(
            sharp, weights=field.weights, regularized=field.regularized, resolution=field.resolution, segmentation=regions,
            identifiability=(*sharp.identifiability, *field.identifiability),
        )  # fmt: skip

    def _on_finer_mesh(self, regions: Segmentation) -> float | None:
        """Return chi squared of regions on cells of half the size, None where there are none."""
        if self.elements != "accurate" or not self.model.averaged:
            return None
        misfit = misfit_on_finer_mesh(self.model.with_zones(regions.zones), regions.point, self.law)
        if misfit is not None:
            self.record(f"the regions on cells of half the size: misfit {misfit:.4g}")
        return misfit

    def _with_borders(self, regions: Segmentation, graph: ZoneGraph) -> FieldEstimate:
        """Return the fit of regions whose borders run through cells, where there are few regions in a map of single cells."""
        single = graph.count == int((self.model.zones.of_cell != KNOWN).sum()) and self.model.mesh.dimension == 3
        if not single or not 1 < regions.zones.count <= MOST_REGIONS:
            return self._sharp(regions.zones, self._fitted(regions), None)
        try:
            refined = refined_regions(self.model, regions, graph, self.bounds)
        except ConvergenceError:
            self.record("no equilibrium was found with borders within cells: those on faces of cells are kept")
            return self._sharp(regions.zones, self._fitted(regions), None)
        charge = float(np.log(self.model.n_free) + np.log(graph.count)) * (regions.zones.count - refined.zones.count)
        if not 0.5 * refined.point.misfit < 0.5 * regions.point.misfit + charge:
            self.record("borders within cells explain no more than those on faces of cells, which are kept")
            return self._sharp(regions.zones, self._fitted(regions), None)
        self.record(f"borders of {refined.zones.count} regions within cells: misfit {refined.point.misfit:.4g}")
        corrected = self._corrected(refined)
        fewer = None if corrected is None else without_errors_of_cells(self.model, regions, graph, corrected, self.bounds)
        if fewer is not None:
            self.record(f"of the regions on cells of half the size {fewer.zones.count} are left: others stood for errors of cells")
            return self._with_borders(fewer, graph)
        refined = refined if corrected is None else corrected.refined
        model = self.model.with_zones(refined.zones)
        try:
            fitted = fitted_nearby(model, point_at(model, refined.theta, refined.point), self.bounds, self.progress)
        except ConvergenceError:
            self.record("no equilibrium was found with the regions as whole cells: borders on faces of cells are kept")
            return self._sharp(regions.zones, self._fitted(regions), None)
        if corrected is not None:
            return self._estimate(model, model.evaluate(fitted.theta, fitted.states), Status.CONVERGED, refined, corrected)
        return self._sharp(refined.zones, fitted, refined)

    def _fitted(self, regions: Segmentation) -> Point:
        """Return the fit of regions of whole cells to the measurements alone, however far from where they were found."""
        model = self.model.with_zones(regions.zones)
        start = model.evaluate(regions.point.theta, regions.point.states)
        return search(model, start, Objective(bounds=self.bounds), progress=self.progress).point

    def _corrected(self, refined: RefinedRegions) -> CorrectedRegions | None:
        """Return regions with borders as cells of half the size fit them; None where there are none, or they find no equilibrium."""
        if self.elements != "accurate" or not self.model.averaged:
            return None
        try:
            corrected = on_finer_cells(self.model, self.law, refined, self.bounds)
        except ConvergenceError:
            corrected = None
        if corrected is None:
            self.record("on cells of half the size no equilibrium was found: borders are not corrected for the size of cells")
            return None
        young, before = (young_and_poisson(theta)[0] for theta in (corrected.refined.theta, refined.theta))
        most = 100.0 * float(np.abs(young / before - 1.0).max())
        self.record(f"borders and moduli on cells of half the size: Young's modulus changes by up to {most:.2g} %")
        return corrected

    def _sharp(self, zones: Zones, point: Point, refined: RefinedRegions | None) -> FieldEstimate:
        """Return the fit of regions, with accurate elements where those of the map were not and such a body is not too large."""
        model = self.model.with_zones(zones)
        if self.elements == "accurate" and not model.averaged and model.mesh.dimension == 3:
            accurate = FieldModel(model.mesh, self.load_cases, zones, self.law, "accurate", self.progress)
            if accurate.points.size <= MOST_UNKNOWNS:
                found = search(accurate, first_point(accurate, point.theta), Objective(bounds=self.bounds))
                self.record(f"fit of {zones.count} regions with quadratic elements: misfit {found.point.misfit:.4g}")
                return self._estimate(accurate, found.point, found.status, refined, of_map=True)
        return self._estimate(model, model.evaluate(point.theta, point.states), Status.CONVERGED, refined, of_map=True)

    def _estimate(
        self,
        model: FieldModel,
        point: Point,
        status: Status,
        refined: RefinedRegions | None = None,
        corrected: CorrectedRegions | None = None,
        of_map: bool = False,
    ) -> FieldEstimate:
        """Return moduli that were fitted without a penalty, with their errors."""
        settings = EstimateSettings(self.law, self.elements, self.bounds, self.region_at, self.borders, self.other_mesh)
        found = region_estimate(RegionFit(model, point, status, refined, corrected, of_map), settings)
        for told in found.steps:
            self.record(told)
        return replace(found, steps=tuple(self.steps))
