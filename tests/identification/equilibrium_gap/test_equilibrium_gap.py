"""Equilibrium gap of fields: exact where displacements are exact, at the Cramer-Rao bound where they are noisy, honest about the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from other_mesh import load_cases_of
from scipy.optimize import approx_fprime

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.status import Status
from naibu.identification.equilibrium_gap.batch import EquilibriumGapEstimate, batch_equilibrium_gap
from naibu.identification.equilibrium_gap.equations import load_case_equations, nodal_field
from naibu.identification.equilibrium_gap.incremental import incremental_equilibrium_gap
from naibu.identification.equilibrium_gap.weighted import weighted_equilibrium_gap
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_elements.linear_simplices import connection_matrices, lumped_mass, simplices
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.reproduction.chapter3.bodies import LAYERS, SQUARE, SQUARE_PUSHES, UNIFORM, PushedBody, cube, square

REPORT_ORDER = (14, 13, 12, 11, 10, 9, 8, 7, 6, 5)
SHEARED = ((0.0, 0.0, -10.0), (10.0, 0.0, 0.0))


def found(estimate: EquilibriumGapEstimate) -> np.ndarray:
    return np.concatenate([estimate.lame_lambda, estimate.shear_modulus])


def true(body: PushedBody, zones: Zones) -> np.ndarray:
    lame, shear = body.moduli
    first = [int(np.flatnonzero(zones.of_cell == z)[0]) for z in range(zones.count)]
    return np.concatenate([lame[first], shear[first]])


def stacked(body: PushedBody, zones: Zones) -> tuple[np.ndarray, np.ndarray]:
    parts = [(b.columns(), b.informative) for b in load_case_equations(body.mesh, body.load_cases(), zones, law=body.law)]
    return np.vstack([a[keep].toarray() for (a, _), keep in parts]), np.concatenate([b[keep] for (_, b), keep in parts])


@pytest.mark.parametrize(
    "body",
    [
        square(SQUARE_PUSHES[0][:1]),
        square(),
        cube(),
        cube(LAYERS, split="asymmetric"),
        cube(LAYERS, pushes=SHEARED),
        cube(LAYERS, split="asymmetric", pushes=(*SHEARED, (0, 10, 0))),
    ],
    ids=lambda body: f"{body.name}, {len(body.pushes)} pushes",
)
def test_exact_displacements_give_what_the_balances_determine(body: PushedBody) -> None:
    """The solution of minimum norm is the truth less its part in the null space; where that is empty, it is the truth."""
    zones = body.zones(each_cell=True)
    estimate = batch_equilibrium_gap(body.mesh, body.load_cases(), zones, method="minimum_norm")
    truth, (matrix, right) = true(body, zones), stacked(body, zones)
    _, singular, basis = np.linalg.svd(matrix)
    rank = int((singular > 1e-9 * singular[0]).sum())
    assert (estimate.rank, estimate.equations, estimate.unknowns) == (rank, len(right), 2 * zones.count)
    assert matrix @ found(estimate) == pytest.approx(right, abs=1e-10 * np.abs(right).max())
    assert basis[:rank] @ found(estimate) == pytest.approx(basis[:rank] @ truth, abs=1e-6 * np.linalg.norm(truth))
    assert basis[rank:] @ found(estimate) == pytest.approx(np.zeros(len(basis) - rank), abs=1e-9 * np.linalg.norm(truth))
    fixed = estimate.determined.T.ravel()
    assert found(estimate)[fixed] == pytest.approx(truth[fixed], rel=1e-6)
    assert (np.linalg.norm(basis[rank:][:, ~fixed], axis=0) > 1e-6).all()


def test_numbers_of_equations_are_those_of_table_3_1() -> None:
    body = square()
    one, two = body.load_cases()[:1], body.load_cases()
    zones = body.zones(each_cell=True)
    assert (zones.count, batch_equilibrium_gap(body.mesh, one, zones, method="minimum_norm").equations) == (16, 20)
    estimate = batch_equilibrium_gap(body.mesh, two, zones)
    assert (estimate.equations, estimate.rank, estimate.determined.all()) == (40, 32, True)
    assert estimate.young_modulus == pytest.approx(np.full(16, SQUARE[0]), rel=1e-6)
    assert estimate.poisson_ratio == pytest.approx(np.full(16, SQUARE[1]), rel=1e-6)
    with pytest.raises(InputError, match=r"1 load case gives 20 equations for 32 unknown moduli; add load cases .*'minimum_norm'"):
        batch_equilibrium_gap(body.mesh, one, zones)


def test_a_minimum_norm_about_the_truth_is_the_truth() -> None:
    body = cube()
    estimate = batch_equilibrium_gap(body.mesh, body.load_cases(), body.zones(each_cell=True), method="minimum_norm", about=UNIFORM)
    assert estimate.young_modulus == pytest.approx(np.full(192, UNIFORM[0]), rel=1e-6)
    assert not estimate.determined.any()


@pytest.mark.parametrize("split", ["symmetric", "asymmetric"])
def test_in_three_dimensions_single_cells_stay_open_however_many_trials_there_are(split: str) -> None:
    rng = np.random.default_rng(0)
    ranks = []
    for count in (3, 5):
        body = cube(LAYERS, split=split, pushes=[rng.normal((0, 0, -5), 3.0, (25, 3)) for _ in range(count)])  # type: ignore[arg-type]
        zones = body.zones(each_cell=True)
        ranks.append(batch_equilibrium_gap(body.mesh, body.load_cases(), zones, method="minimum_norm").rank)
    assert ranks[0] == ranks[1] < 2 * zones.count
    with pytest.raises(InputError, match="equations fix only"):
        batch_equilibrium_gap(body.mesh, body.load_cases(), zones)


@pytest.mark.parametrize("order", [None, REPORT_ORDER])
def test_the_incremental_method_finds_every_triangle_of_the_square(order: Sequence[int] | None) -> None:
    body = square()
    result = incremental_equilibrium_gap(body.mesh, body.load_cases(), body.zones(each_cell=True), order=order)
    assert result.estimate.young_modulus == pytest.approx(np.full(16, SQUARE[0]), rel=1e-6)
    assert sorted(z for step in result.steps for z in step.zones) == list(range(16))
    if order is not None:  # equations (3.23), (3.28), and figure 3.8 (c), (d)
        assert [step.zones for step in result.steps[:3]] == [(15,), (13, 14), (11, 12)]
        assert result.steps[-1].zones == (0,)
        assert result.depth[[15, 13, 11, 9, 8]].tolist() == [1, 2, 3, 4, 5]


def test_the_incremental_method_goes_as_far_as_it_can_in_three_dimensions() -> None:
    rng = np.random.default_rng(1)
    body = cube(LAYERS, split="asymmetric", pushes=[rng.normal((0, 0, -5), 3.0, (25, 3)) for _ in range(4)])
    zones = body.zones(each_cell=True)
    result = incremental_equilibrium_gap(body.mesh, body.load_cases(), zones, partial=True)
    reached = ~np.isnan(result.estimate.lame_lambda)
    assert 100 < reached.sum() < zones.count
    assert found(result.estimate)[np.tile(reached, 2)] == pytest.approx(true(body, zones)[np.tile(reached, 2)], rel=1e-6)
    assert ((result.depth > 0) == reached).all()
    with pytest.raises(InputError, match=rf"after {reached.sum()} of 192 zones"):
        incremental_equilibrium_gap(body.mesh, body.load_cases(), zones)


def test_a_step_inherits_the_errors_of_those_before_it_and_the_batch_does_not() -> None:
    """Median errors of noise draws, small enough to be linear in the noise; a step alone is told the true moduli of the steps before."""
    body, inherited, alone, batch = square(), [], [], []
    zones = body.zones(each_cell=True)
    truth = true(body, zones)
    last = zones.of_cell == 0
    told = replace(zones, of_cell=np.where(last, 0, -1), names=zones.names[:1], known_lambda=body.moduli[0], known_mu=body.moduli[1])
    for seed in range(60):
        trials = body.load_cases(sd_mm=1e-4, seed=seed)
        result = incremental_equilibrium_gap(body.mesh, trials, zones, order=REPORT_ORDER)
        inherited.append(np.abs(found(result.estimate) / truth - 1.0))
        alone.append(np.abs(found(incremental_equilibrium_gap(body.mesh, trials, told, order=(5,)).estimate) / truth[[0, 16]] - 1.0))
        batch.append(np.abs(found(batch_equilibrium_gap(body.mesh, trials, zones)) / truth - 1.0))
    assert result.depth[0] == 7
    assert (np.median(inherited, axis=0)[[0, 16]] > 2.0 * np.median(alone, axis=0)).all()
    assert np.median(batch) < 0.7 * np.median(inherited)


def weighed(divisions: int = 4) -> tuple[Mesh, FieldLoadCase]:
    """A cube that stands on its floor under its own weight, uniform."""
    body = cube(divisions=divisions)
    weight = lumped_mass(simplices(body.mesh), 1e-6)[:, None] * np.array([0.0, 0.0, -9810.0])
    floor = np.flatnonzero(body.mesh.points[:, 2] < 1e-9)
    u = LinearBody.of(body.mesh).solve(*body.moduli, PrescribedDisplacement.none(body.mesh.n_points).and_also(floor, np.zeros(3)), weight)
    field = DisplacementField.from_arrays(body.mesh.points, u)
    return body.mesh, FieldLoadCase.of("standing", field, body.mesh, loaded=body.mesh.points[:, 2] < 1e-9, external_force=weight)


def test_a_density_gives_the_scale_where_nothing_is_known() -> None:
    mesh, trial = weighed()
    zones = Zones.of(mesh, known={})
    for estimate in (batch_equilibrium_gap(mesh, [trial], zones), weighted_equilibrium_gap(mesh, [trial], zones)):
        assert estimate.young_modulus == pytest.approx(np.full(2, UNIFORM[0]), rel=1e-6)
        assert estimate.poisson_ratio == pytest.approx(np.full(2, UNIFORM[1]), rel=1e-6)
    without = replace(trial, external_force=np.zeros_like(trial.external_force))
    for method in (batch_equilibrium_gap, weighted_equilibrium_gap, incremental_equilibrium_gap):
        with pytest.raises(InputError, match="only ratios of moduli"):
            method(mesh, [without], zones)


def test_trials_that_contradict_each_other_are_named() -> None:
    """One displacement under two different weights: each makes sense, both do not."""
    mesh, trial = weighed()
    heavy = replace(trial, name="in lead", external_force=4.0 * trial.external_force)
    zones = Zones.of(mesh, known={})
    assert batch_equilibrium_gap(mesh, [heavy], zones).young_modulus == pytest.approx(np.full(2, 4.0 * UNIFORM[0]), rel=1e-6)
    with pytest.raises(InputError, match=r"'standing', 'in lead' contradict each other: alone they leave .* together 1.. % .* 'standing'"):
        batch_equilibrium_gap(mesh, [trial, heavy], zones)


def test_a_known_force_on_the_top_gives_the_scale_and_thickness_counts() -> None:
    body = square(SQUARE_PUSHES[0][:1])
    u, (lame, shear) = body.displacement((0.0, -25.0)), body.moduli
    reaction = LinearBody.of(body.mesh, thickness_mm=3.0).forces(lame, shear, u)
    floor = body.mesh.points[:, 1] < 1e-9
    force = np.where(floor[:, None], 0.0, reaction)
    trial = FieldLoadCase.of("push", DisplacementField.from_arrays(body.mesh.points, u), body.mesh, loaded=floor, external_force=force)
    estimate = batch_equilibrium_gap(body.mesh, [trial], Zones.of(body.mesh, known={}), thickness_mm=3.0)
    assert estimate.young_modulus == pytest.approx(np.full(2, SQUARE[0]), rel=1e-6)
    thin = batch_equilibrium_gap(body.mesh, [trial], Zones.of(body.mesh, known={}))
    assert thin.young_modulus == pytest.approx(np.full(2, 3.0 * SQUARE[0]), rel=1e-6)


@pytest.mark.parametrize("law", ["neo_hookean", "saint_venant_kirchhoff"])
def test_balance_at_finite_strain_is_exact_with_the_right_law_and_absurd_with_the_linear_one(law: str) -> None:
    body = cube(LAYERS, pushes=((0.0, 0.0, -6.0), (6.0, 0.0, -3.0)), law=law)  # type: ignore[arg-type]
    trials, zones = body.load_cases(), body.zones()
    for estimate in (
        batch_equilibrium_gap(body.mesh, trials, zones, law=body.law),
        weighted_equilibrium_gap(body.mesh, trials, zones, law=body.law),
    ):
        assert found(estimate) == pytest.approx(true(body, zones), rel=2e-6)
    linear = batch_equilibrium_gap(body.mesh, trials, zones)
    assert np.abs(linear.young_modulus / [0.25, 0.5] - 1.0).max() > 0.1
    cells = body.zones(each_cell=True)
    single = batch_equilibrium_gap(body.mesh, trials, cells, law=body.law, method="minimum_norm")
    fixed = single.determined.T.ravel()
    assert fixed.any()
    assert found(single)[fixed] == pytest.approx(true(body, cells)[fixed], rel=1e-4)


def test_nodes_take_a_field_of_their_own_or_interpolate_one_linearly() -> None:
    mesh, rng = cube().mesh, np.random.default_rng(4)
    slope = rng.standard_normal((3, 3))
    own = nodal_field(
        DisplacementField.from_arrays(mesh.points[::-1], mesh.points[::-1] @ slope, sd_mm=0.1, valid=np.arange(125) > 0), mesh
    )
    assert own.displacement[:-1] == pytest.approx(mesh.points[:-1] @ slope)
    assert own.has_data.tolist() == [True] * 124 + [False]
    assert own.covariance.diagonal()[:-3] == pytest.approx(0.01)
    points = rng.uniform(-2.0, 42.0, (800, 3)) * [1.0, 1.0, 0.6]
    other = nodal_field(DisplacementField.from_arrays(points, points @ slope, sd_mm=0.1), mesh)
    low = mesh.points[:, 2] < 25.0
    assert other.has_data[low].sum() > 60
    assert not other.has_data[~low].any()
    assert other.displacement[other.has_data] == pytest.approx((mesh.points @ slope)[other.has_data], abs=1e-10)
    variance = other.covariance.diagonal().reshape(-1, 3)[other.has_data]
    assert (variance <= 0.01 + 1e-12).all()
    assert (variance >= 0.01 / 4 - 1e-12).all()


@pytest.mark.parametrize("dimension", [1, 2])
def test_fields_are_interpolated_in_fewer_dimensions_too(dimension: int) -> None:
    rng = np.random.default_rng(2)
    line = Mesh.from_arrays(np.linspace(0.0, 9.0, 10)[:, None], [[i, i + 1] for i in range(9)], "line")
    mesh = line if dimension == 1 else square().mesh
    high = float(mesh.points.max())
    points = np.vstack([rng.uniform(0.0, high, (200, dimension)), [[a * high] * dimension for a in (-0.1, 0.55)]])
    given = DisplacementField.from_arrays(points, 2.0 * points + 1.0)
    field = nodal_field(given, mesh)
    assert field.displacement[field.has_data] == pytest.approx(2.0 * mesh.points[field.has_data] + 1.0, abs=1e-9)
    inside = (mesh.points < points.max()).all(axis=1)
    assert field.has_data[inside].mean() > 0.7


def test_an_interface_between_two_marker_layers_gets_their_mean() -> None:
    """Markers at z = 0, 10, 30, 40, as in the report's cubes; nodes on the interface at 20 half way (figure 3.42 b)."""
    mesh = cube().mesh
    markers = mesh.points[mesh.points[:, 2] != 20.0]
    bent = np.column_stack([markers[:, 2] ** 2, markers[:, 0] * markers[:, 2], np.abs(markers[:, 2] - 20.0)])
    field = nodal_field(DisplacementField.from_arrays(markers, bent, sd_mm=1.0), mesh)
    at = mesh.points[:, 2] == 20.0
    x = mesh.points[at, 0]
    assert field.displacement[at] == pytest.approx(np.column_stack([np.full(25, 500.0), 20.0 * x, np.full(25, 10.0)]), abs=1e-9)
    assert field.covariance.diagonal().reshape(-1, 3)[at] == pytest.approx(0.5)
    assert (field.interpolated == at).all()


def test_nodes_without_data_take_their_neighbours_out_and_nothing_else() -> None:
    body = square()
    zones = body.zones()
    u = body.displacement((0.0, -25.0))
    u[6] = np.nan
    trial = FieldLoadCase.of("hole", DisplacementField.from_arrays(body.mesh.points, u), body.mesh, loaded=body.constrained)
    balance = load_case_equations(body.mesh, [trial], zones)[0]
    around = set(body.mesh.cells[(body.mesh.cells == 6).any(axis=1)].ravel().tolist())
    assert set((balance.rows // 2).tolist()) == set(range(5, 20)) - around
    estimate = batch_equilibrium_gap(body.mesh, [trial], zones)
    assert estimate.young_modulus == pytest.approx([SQUARE[0]], rel=1e-6)


def test_a_mesh_coarser_than_the_truth_errs_less_as_it_is_refined() -> None:
    """Data of a mesh of 32 cells an edge, identified on 4, 8 and 16: the error of the linear triangles, which no exactness test sees."""
    fine = square(SQUARE_PUSHES[0][:1], divisions=32)
    u = fine.displacement((0.0, -25.0))
    errors = []
    for divisions in (4, 8, 16):
        body = square(SQUARE_PUSHES[0][:1], divisions=divisions)
        trial = FieldLoadCase.of("fine", DisplacementField.from_arrays(fine.mesh.points, u), body.mesh, loaded=body.constrained)
        estimate = weighted_equilibrium_gap(body.mesh, [trial], body.zones())
        errors.append(abs(estimate.young_modulus[0] / SQUARE[0] - 1.0))
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.05


def cramer_rao(body: PushedBody, zones: Zones, sd_mm: float) -> np.ndarray:
    """Bound of the moduli's covariance if every node is measured: the displacement depends on them and on that of the constrained nodes.

    Dense and by differentiating the solution, which `weighted_equilibrium_gap` never does.
    """
    lame, shear = body.moduli
    linear, constrained = LinearBody.of(body.mesh), np.repeat(body.constrained, body.mesh.dimension)
    stiffness = linear.stiffness(lame, shear).toarray()
    inner = np.linalg.inv(stiffness[np.ix_(~constrained, ~constrained)])
    total = np.zeros((2 * zones.count,) * 2)
    for push in body.pushes:
        u = body.displacement(push)
        of_moduli = np.zeros((constrained.size, 2 * zones.count))
        for k in range(2 * zones.count):
            unit = (zones.of_cell == k % zones.count).astype(float)
            force = linear.forces(unit * (k < zones.count), unit * (k >= zones.count), u).ravel()
            of_moduli[~constrained, k] = -inner @ force[~constrained]
        of_boundary = np.zeros((constrained.size, int(constrained.sum())))
        of_boundary[constrained] = np.eye(int(constrained.sum()))
        of_boundary[~constrained] = -inner @ stiffness[np.ix_(~constrained, constrained)]
        cross = of_boundary.T @ of_moduli
        total += of_moduli.T @ of_moduli - cross.T @ np.linalg.solve(of_boundary.T @ of_boundary, cross)
    return np.linalg.inv(total) * sd_mm**2


CASES = {
    "square": (square(), 0.2),
    "uniform cube": (cube(), 0.05),
    "two layers": (cube(LAYERS), 0.05),
    "two layers, two pushes, asymmetric": (cube(LAYERS, split="asymmetric", pushes=SHEARED), 0.05),
}


@pytest.mark.parametrize("name", CASES)
def test_the_covariance_of_the_weighted_gap_is_the_cramer_rao_bound(name: str) -> None:
    body, sd = CASES[name]
    zones = body.zones()
    exact = [replace(t, field=DisplacementField.from_arrays(t.field.points, t.field.vectors, sd_mm=sd)) for t in body.load_cases()]
    estimate = weighted_equilibrium_gap(body.mesh, exact, zones)
    assert found(estimate) == pytest.approx(true(body, zones), rel=1e-6)
    bound = cramer_rao(body, zones, sd)
    assert estimate.covariance == pytest.approx(bound, rel=1e-5, abs=1e-9 * np.abs(bound).max())


def scatter(body: PushedBody, sd: float, draws: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Errors (draws, u) of the weighted gap and of least squares, chi squared over its expectation (draws,), and the bound (u, u)."""
    zones = body.zones()
    truth = true(body, zones)
    white, plain, chi = [], [], []
    for seed in range(draws):
        trials = body.load_cases(sd_mm=sd, seed=1000 + seed)
        estimate = weighted_equilibrium_gap(body.mesh, trials, zones)
        assert estimate.status is Status.CONVERGED
        white.append(found(estimate) - truth)
        chi.append(estimate.chi_squared / estimate.degrees_of_freedom)
        plain.append(found(batch_equilibrium_gap(body.mesh, trials, zones)) - truth)
    return np.array(white), np.array(plain), np.array(chi), cramer_rao(body, zones, sd)


def over_bound(errors: np.ndarray, bound: np.ndarray) -> float:
    """Root mean square error in units of the bound, over all combinations of the moduli: 1 for an efficient estimator."""
    return float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", errors, np.linalg.inv(bound), errors)) / len(bound)))


@pytest.mark.parametrize("name", CASES)
def test_twenty_draws_scatter_by_no_more_than_the_bound_allows(name: str) -> None:
    body, sd = CASES[name]
    white, plain, chi, bound = scatter(body, sd, 20)
    assert over_bound(white, bound) < 1.2
    assert over_bound(plain, bound) > 1.5 * over_bound(white, bound)
    equations = sum(len(b.rows) for b in load_case_equations(body.mesh, body.load_cases(), body.zones()))
    freedom = equations - len(bound)
    assert chi.mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / freedom / 20))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_hundred_draws_have_no_bias_and_the_spread_of_the_bound_in_every_modulus(name: str) -> None:
    body, sd = CASES[name]
    white, plain, _, bound = scatter(body, sd, 100)
    spread = np.sqrt(np.diag(bound))
    assert (np.sqrt((white**2).mean(axis=0)) / spread).max() < 1.2
    assert np.abs(white.mean(axis=0) / spread).max() < 0.35
    biased = np.abs(plain.mean(axis=0)) / (plain.std(axis=0) / 10.0)
    assert biased.max() > 4.0


def test_the_whitened_estimate_is_a_stationary_point_of_the_likelihood_written_out_densely() -> None:
    body, sd = square(SQUARE_PUSHES[0]), 0.2
    zones, trials = body.zones(), body.load_cases(sd_mm=0.2, seed=3)
    lame, shear = connection_matrices(simplices(body.mesh))
    index = (body.mesh.cells[:, :, None] * 2 + np.arange(2)).reshape(body.mesh.n_cells, 6)
    rows = ~np.repeat(body.constrained, 2)

    def deviance(log_moduli: np.ndarray) -> float:
        cell_lame, cell_shear = zones.per_cell(*np.exp(log_moduli).reshape(2, -1))
        stiffness = np.zeros((50, 50))
        for c, block in enumerate(cell_lame[:, None, None] * lame + cell_shear[:, None, None] * shear):
            stiffness[np.ix_(index[c], index[c])] += block
        k = stiffness[rows]
        residuals = [k @ t.field.vectors.ravel() for t in trials]
        return sum(float(r @ np.linalg.solve(sd**2 * k @ k.T, r)) for r in residuals)

    estimate = weighted_equilibrium_gap(body.mesh, trials, zones, tolerance=1e-10)
    at = np.log(found(estimate))
    assert estimate.chi_squared == pytest.approx(deviance(at), rel=1e-8)
    slope = (np.array([deviance(at + h) - deviance(at - h) for h in 1e-4 * np.eye(2)])) / 2e-4
    spread = np.sqrt(np.diag(estimate.covariance)) / found(estimate)  # type: ignore[arg-type]
    assert np.abs(slope * spread).max() < 1e-4
    away = approx_fprime(np.log(1.2 * found(estimate)), deviance, 1e-6)
    assert np.abs(away * spread).max() > 1.0


def test_a_variance_that_is_not_given_is_estimated() -> None:
    body = cube(LAYERS, pushes=SHEARED)
    given = body.load_cases(sd_mm=0.05, seed=5)
    plain = [replace(t, field=DisplacementField.from_arrays(t.field.points, t.field.vectors)) for t in given]
    first, second = (weighted_equilibrium_gap(body.mesh, trials, body.zones()) for trials in (given, plain))
    assert found(second) == pytest.approx(found(first), rel=1e-6)
    factor = second.standard_deviation / first.standard_deviation
    assert factor == pytest.approx(np.full((2, 2), np.sqrt(first.chi_squared / first.degrees_of_freedom)), rel=1e-4)
    assert factor == pytest.approx(1.0, abs=0.2)


def test_whitening_holds_at_finite_strain() -> None:
    body = cube(LAYERS, pushes=((0.0, 0.0, -6.0),), law="neo_hookean")
    zones, errors = body.zones(), []
    truth = true(body, zones)
    for seed in range(5):
        estimate = weighted_equilibrium_gap(body.mesh, body.load_cases(sd_mm=0.03, seed=seed), zones, law="neo_hookean")
        assert estimate.status is Status.CONVERGED
        errors.append((found(estimate) - truth) / estimate.standard_deviation.T.ravel())
    assert np.sqrt(np.mean(np.square(errors))) < 1.6


def test_bounds_keep_moduli_positive_where_least_squares_does_not() -> None:
    body = cube(LAYERS, split="asymmetric")
    trials = body.load_cases(sd_mm=0.1, seed=1)
    assert not batch_equilibrium_gap(body.mesh, trials, body.zones()).admissible.all()
    bounded = batch_equilibrium_gap(body.mesh, trials, body.zones(), method="bounded")
    assert (found(bounded) >= 0.0).all()
    whitened = weighted_equilibrium_gap(body.mesh, trials, body.zones())
    assert whitened.admissible.all()
    assert whitened.young_modulus == pytest.approx([0.25, 0.5], rel=0.15)


def test_data_on_points_of_their_own_need_the_noise_of_interpolation() -> None:
    body, truth = cube(), cube(divisions=16, split="asymmetric")
    coarse = (np.rint(body.mesh.points / 10.0) % 2 == 0).all(axis=1)
    (trial,) = load_cases_of(truth, body, body.mesh.points[coarse], sd_mm=0.05)
    with pytest.raises(InputError, match=r"share the data of the same points.*interpolation_sd_mm"):
        weighted_equilibrium_gap(body.mesh, [trial], body.zones())
    estimate = weighted_equilibrium_gap(body.mesh, [trial], body.zones(), interpolation_sd_mm=0.5)
    assert estimate.young_modulus == pytest.approx([UNIFORM[0]], rel=0.5)


def test_noisy_data_of_another_mesh_bias_least_squares_and_not_the_weighted_gap() -> None:
    """Data of 16 cells an edge, of the other split; with 8 cells an edge discretisation alone costs 2 %, and noise is 1 % of the push."""
    pushes = ((0.0, 0.0, -10.0), (7.0, 0.0, -7.0))
    truth, body = (cube(LAYERS, pushes=pushes, divisions=n, split=s) for n, s in ((16, "asymmetric"), (8, "symmetric")))  # type: ignore[arg-type]
    load_cases = load_cases_of(truth, body, body.mesh.points, sd_mm=0.1)
    weighted = weighted_equilibrium_gap(body.mesh, load_cases, body.zones())
    assert weighted.young_modulus == pytest.approx([0.25, 0.5], rel=0.03)
    assert weighted.poisson_ratio == pytest.approx([0.43, 0.38], abs=0.01)
    assert (batch_equilibrium_gap(body.mesh, load_cases, body.zones(), method="bounded").young_modulus < [0.125, 0.25]).all()


def broken() -> dict[str, tuple[str, str, list[FieldLoadCase], Zones, dict[str, object]]]:
    body = square()
    mesh, zones, (one, two) = body.mesh, body.zones(), body.load_cases()
    cells = body.zones(each_cell=True)
    u = two.field.vectors
    inverted = u.copy()
    inverted[7] += [0.0, 120.0]
    field = DisplacementField.from_arrays(mesh.points, inverted)
    line = DisplacementField.from_arrays(mesh.points[:5], u[:5])
    mixed = replace(one, field=DisplacementField.from_arrays(mesh.points, one.field.vectors, sd_mm=0.1))
    nowhere = FieldLoadCase.of("held", one.field, mesh, loaded=np.ones(mesh.n_points, dtype=bool))
    unfit = replace(zones, known_lambda=np.full_like(zones.known_lambda, np.nan))
    far = np.where(mesh.points[:, 1:] == 100.0, True, body.constrained[:, None])
    return {
        "no load case": ("field", "give at least one load case", [], zones, {}),
        "method": ("field", "method 'svd' is not known", [one], zones, {"method": "svd"}),
        "law": ("field", "law 'rubber' is not known", [one], zones, {"law": "rubber"}),
        "about": ("field", "has no use for it", [one], zones, {"about": (1.0, 0.3)}),
        "inverted": ("field", r"load case 'push 2': the displacement inverts the cell of nodes", [replace(two, field=field)], zones,
                     {"law": "neo_hookean"}),
        "points on a line": ("field", "lie on one plane or line", [replace(one, field=line)], zones, {}),
        "all loaded": ("field", "'held' gives no equation: 25 of 25 nodes have data", [nowhere], zones, {}),
        "moduli": ("field", "cell 16 is called known, but", [one], unfit, {}),
        "zones of another mesh": ("field", "the zones are for 128 cells", [one], square(divisions=8).zones(), {}),
        "border not measured": ("field", "the moduli have no scale", [replace(one, loaded=np.repeat(far, 2, axis=1))], zones, {}),
        "mixed noise": ("white", "fields of 'push 2' come without standard deviations", [mixed, two], zones, {}),
        "open": ("white", "leave a combination of the 32 moduli open", [mixed], cells, {}),
        "start": ("white", "start must be 1 positive lambda", [one], zones, {"start": (np.ones(2), np.ones(2))}),
        "interpolation": ("white", "interpolation_sd_mm must be", [one], zones, {"interpolation_sd_mm": -1.0}),
        "too few load cases": ("step", "after 1 of 16 zones: with 1 load cases .* at least 2 independent load cases", [one], cells, {}),
        "wrong order": ("step", "node 13 cannot be taken now: 4 equations for the 6 moduli of 3 open zones", [one, two], cells,
                        {"order": [13]}),
        "order outside": ("step", "node 2 is not in equilibrium", [one, two], cells, {"order": [2]}),
    }  # fmt: skip


@pytest.mark.parametrize("case", broken())
def test_what_cannot_be_balanced_is_said(case: str) -> None:
    method, words, trials, zones, options = broken()[case]
    call = {"field": batch_equilibrium_gap, "white": weighted_equilibrium_gap, "step": incremental_equilibrium_gap}[method]
    with pytest.raises(InputError, match=words):
        call(square().mesh, trials, zones, **options)  # type: ignore[operator]


def test_zones_that_no_balance_reaches_are_named() -> None:
    body = square()
    zones = body.zones(each_cell=True)
    u = body.displacement((0.0, -25.0))
    u[5] = np.nan
    trial = FieldLoadCase.of("hole", DisplacementField.from_arrays(body.mesh.points, u), body.mesh, loaded=body.constrained)
    with pytest.raises(InputError, match=r"'lower half: cell 0', .* and 1 more zones appear in no equation"):
        batch_equilibrium_gap(body.mesh, [trial], zones, method="minimum_norm")


def test_moduli_of_the_square_are_those_of_equation_3_1() -> None:
    assert lame_parameters(*SQUARE) == pytest.approx((10.7e0, 1.75), rel=5e-3)
