"""Penalties against closed forms and finite differences, and the choice of their weight."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.core.status import Status
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Point
from naibu.identification.from_fields.inversion.gauss_newton import Found
from naibu.identification.from_fields.inversion.regularization import (
    Laplacian,
    TotalVariation,
    ZoneGraph,
    cell_volumes,
    inner_faces,
    regularization,
)
from naibu.identification.from_fields.inversion.regularization_weight import FACTOR, SLACK, WeightTrial, choose_weight, corner
from naibu.meshing.primitives import box
from naibu.reproduction.chapter3.bodies import square

MESH = box((40.0, 40.0, 40.0), (4, 4, 4), layers=[("lower", 20.0), ("upper", 20.0)], cell_type="tetra")
ZONES = Zones.of(MESH, known={"upper": (1.0, 0.3)}, each_cell=True)
GRAPH = ZoneGraph.of(MESH, ZONES)


def test_faces_and_volumes_are_those_of_the_body() -> None:
    assert cell_volumes(MESH).sum() == pytest.approx(40.0**3, rel=1e-12)
    assert GRAPH.volume.sum() == pytest.approx(0.5 * 40.0**3, rel=1e-12)
    cells, area = inner_faces(MESH)
    boundary = 6 * 40.0**2
    corners = MESH.points[MESH.cells]
    total = sum(
        np.linalg.norm(np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a]), axis=1).sum() / 2
        for a, b, c in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))
    )
    assert 2.0 * area.sum() + boundary == pytest.approx(total, rel=1e-12)
    between = MESH.regions[cells[:, 0]] != MESH.regions[cells[:, 1]]
    assert area[between].sum() == pytest.approx(40.0**2, rel=1e-12)


def test_lengths_of_inner_edges_in_the_plane() -> None:
    mesh = square().mesh
    _, length = inner_faces(mesh)
    assert length.sum() == pytest.approx(2 * 3 * 4 * 50.0 + 16 * 50.0 * np.sqrt(2.0), rel=1e-12)


def a_step(height: float = 10.0) -> np.ndarray:
    """Logarithms that jump by ln 2 and 0.3 between two layers of 10 mm."""
    upper = MESH.points[MESH.cells].mean(axis=1)[ZONES.of_cell >= 0, 2] > height
    return np.concatenate([np.where(upper, np.log(2.0), 0.0), np.where(upper, 0.3, 0.0)])


def test_total_variation_of_a_step_is_area_times_jump() -> None:
    penalty = TotalVariation(GRAPH, rounding=1e-6, bulk_weight=1.0)
    assert penalty.value(a_step()) == pytest.approx(1600.0 * np.hypot(np.log(2.0), 0.3), rel=1e-4)
    assert TotalVariation(GRAPH, rounding=1e-6, bulk_weight=0.0).value(a_step()) == pytest.approx(1600.0 * np.log(2.0), rel=1e-4)


def test_both_moduli_jump_cheaper_at_one_place_than_at_two() -> None:
    penalty = TotalVariation(GRAPH, rounding=1e-6)
    together, apart = a_step(), a_step()
    heights = MESH.points[MESH.cells].mean(axis=1)[ZONES.of_cell >= 0, 2]
    apart[len(apart) // 2 :] = 0.0
    cells = (heights < 10.0) & (MESH.points[MESH.cells].mean(axis=1)[ZONES.of_cell >= 0, 0] < 0.0)
    same_area = a_step()
    same_area[len(apart) // 2 :] = np.where(cells, 0.3, 0.0)
    assert penalty.value(together) < penalty.value(same_area)


def test_laplacian_tends_to_the_integral_of_the_squared_gradient_of_a_line() -> None:
    """On a row of equal cells: area / distance times squared jumps; a slope g across length L costs about g^2 A L / 2."""
    mesh = box((400.0, 10.0, 10.0), (40, 1, 1), centred=False, cell_type="tetra")
    column = np.floor(mesh.points[mesh.cells].mean(axis=1)[:, 0] / 10.0).astype(int)
    zones = Zones(column, tuple(f"{i}" for i in range(40)), np.full(mesh.n_cells, np.nan), np.full(mesh.n_cells, np.nan))
    penalty = Laplacian(ZoneGraph.of(mesh, zones))
    theta = np.concatenate([0.01 * (10.0 * np.arange(40) + 5.0), np.zeros(40)])
    assert penalty.value(theta) == pytest.approx(0.5 * 0.01**2 * 100.0 * 390.0, rel=1e-9)


@pytest.mark.parametrize("penalty", [TotalVariation(GRAPH), TotalVariation(GRAPH, rounding=0.3, bulk_weight=0.4), Laplacian(GRAPH)])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.sampled_from([0.01, 0.3, 2.0]))
def test_gradient_and_majoriser(penalty: TotalVariation | Laplacian, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    theta, step = size * rng.standard_normal(2 * GRAPH.count), rng.standard_normal(2 * GRAPH.count)
    h = 1e-6 * size
    numerical = (penalty.value(theta + h * step) - penalty.value(theta - h * step)) / (2 * h)
    assert penalty.gradient(theta) @ step == pytest.approx(numerical, rel=1e-5, abs=1e-6)
    quadratic = penalty.value(theta) + penalty.gradient(theta) @ step + 0.5 * step @ (penalty.hessian(theta) @ step)
    assert penalty.value(theta + step) <= quadratic * (1.0 + 1e-12)
    constant = np.concatenate([np.full(GRAPH.count, 1.3), np.full(GRAPH.count, -0.2)])
    assert penalty.value(constant) == pytest.approx(0.0, abs=1e-9)


def solver_of(misfit, penalty, tried: list[float]):
    """A stand-in for searches: misfit and penalty are given functions of the weight."""

    def solve(weight: float, start: Found | None) -> WeightTrial:
        tried.append(weight)
        point = Point(np.zeros(2), (), (), misfit(weight), 0.0)
        return WeightTrial(weight, Found(point, 0.0, Status.CONVERGED, 1), misfit(weight), penalty(weight))

    return solve


@pytest.mark.parametrize("first", [1e3, 1.0, 1e-4])
def test_discrepancy_principle_finds_the_weight_from_both_sides(first: float) -> None:
    tried: list[float] = []
    choice = choose_weight(solver_of(lambda w: 100.0 + 50.0 * w, lambda w: 1.0 / w, tried), first, 120.0, "discrepancy")
    assert choice.taken.misfit <= 1.1 * SLACK * 120.0
    assert choice.taken.misfit >= 120.0 * SLACK / 1.2
    assert [t.weight for t in choice.trials] == sorted(tried, reverse=True)
    assert "discrepancy" in choice.reason


def test_where_the_noise_is_out_of_reach_the_corner_is_taken_and_told() -> None:
    """Misfit 500 + 300 w and penalty 40 + 4 / w: the corner of their logarithms lies near w = 1."""
    tried: list[float] = []
    choice = choose_weight(solver_of(lambda w: 500.0 + 300.0 * w, lambda w: 40.0 + 4.0 / w, tried), 100.0, 120.0, "discrepancy")
    assert "corner of the L-curve" in choice.reason and "4.18 times above" in choice.reason
    assert len(tried) < 12
    assert choice.taken.weight < 10.0


def test_where_no_jump_is_needed_no_weight_is_tried() -> None:
    """A misfit that falls below that of noise without a jump does so at every weight: the greatest is infinite."""
    tried: list[float] = []
    solve = solver_of(lambda w: 100.0 * w / (1.0 + w), lambda w: 1.0 / w, [])
    choice = choose_weight(solver_of(lambda w: 100.0, lambda w: 1.0 / w, tried), 1.0, 120.0, "discrepancy", lambda: solve(7.0, None))
    assert tried == [] and choice.met and choice.taken.weight == 7.0 and "87.5 against 120" in choice.reason
    choose_weight(solver_of(lambda w: 40.0 + 50.0 * w, lambda w: 1.0 / w, tried), 1.0, 60.0, "discrepancy", lambda: solve(7.0, None))
    assert tried  # 87.5 is more than noise of 60


def test_corner_of_a_right_angle() -> None:
    weights = [FACTOR**-k for k in range(7)]
    values = [(1000.0, 1.0), (300.0, 1.05), (100.0, 1.1), (95.0, 1.2), (93.0, 10.0), (92.0, 100.0), (91.0, 1000.0)]
    trials = [
        WeightTrial(w, Found(Point(np.zeros(2), (), (), m, 0.0), 0.0, Status.CONVERGED, 1), m, p)
        for w, (m, p) in zip(weights, values, strict=True)
    ]
    assert corner(trials) in (2, 3)


def test_a_given_weight_is_taken_as_it_is() -> None:
    tried: list[float] = []
    choice = choose_weight(solver_of(lambda w: w, lambda w: w, tried), 5.0, 1.0, 0.25)
    assert tried == [0.25] and choice.taken.weight == 0.25
    l_curve = choose_weight(solver_of(lambda w: 1.0 + w, lambda w: 1.0 + 1.0 / w, tried), 50.0, 1.0, "l_curve")
    assert 0.05 < l_curve.taken.weight < 20.0


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match="'ridge'"):
        regularization("ridge", GRAPH)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="rounding"):
        TotalVariation(GRAPH, rounding=0.0)
    solve = solver_of(lambda w: w, lambda w: w, [])
    with pytest.raises(InputError, match="positive"):
        choose_weight(solve, 1.0, 1.0, -1.0)
    with pytest.raises(InputError, match="'best'"):
        choose_weight(solve, 1.0, 1.0, "best")  # type: ignore[arg-type]
