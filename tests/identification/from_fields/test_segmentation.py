"""Regions made of fields: clusters, merging and borders against cases whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, logarithms, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, first_point
from naibu.identification.from_fields.inversion.regularization import ZoneGraph
from naibu.identification.from_fields.regions.merging import CLEAR, merged
from naibu.identification.from_fields.regions.relative_map import identify_relative_map
from naibu.identification.from_fields.regions.segmentation import (
    Criterion,
    areas_between,
    border_moves,
    clusters,
    joined,
    segment,
)
from naibu.meshing.primitives import box
from naibu.reproduction.chapter3.bodies import LAYERS, cube
from naibu.validation.specimens.quadratic_body import QuadraticBody

MESH = box((40.0, 40.0, 40.0), (4, 4, 4), cell_type="tetra")
ZONES = Zones.of(MESH, known={}, each_cell=True)
GRAPH = ZoneGraph.of(MESH, ZONES)
HEIGHT = MESH.points[MESH.cells].mean(axis=1)[:, 2]
LAYER = (HEIGHT // 10.0).astype(int)


def quadratic(hessian: np.ndarray, gradient: np.ndarray) -> Concentrated:
    return Concentrated(hessian, gradient, [], [])


def same_partition(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two labellings part alike, whatever the numbers."""
    pairs = np.unique(np.stack([one, other], axis=1), axis=0)
    return len(pairs) == len(np.unique(one)) == len(np.unique(other))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), noise=st.sampled_from([0.0, 0.02, 0.05]))
def test_layers_are_the_clusters(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    theta = np.concatenate([0.5 * LAYER, 0.2 * (LAYER % 2)]) + noise * rng.standard_normal(2 * ZONES.count)
    assert same_partition(clusters(GRAPH, theta, 4), LAYER)


def test_clusters_hang_together() -> None:
    """Two balls of one modulus that do not touch are two clusters of three."""
    x = MESH.points[MESH.cells].mean(axis=1)[:, 0]
    apart = np.where(x < -10.0, 1, np.where(x > 10.0, 2, 0))
    theta = np.concatenate([np.where(apart > 0, 1.0, 0.0), np.zeros(ZONES.count)])
    assert same_partition(clusters(GRAPH, theta, 3), apart)


def test_a_homogeneous_field_is_one_cluster() -> None:
    assert clusters(GRAPH, np.zeros(2 * ZONES.count), 20).max() == 0


def test_areas_between_layers() -> None:
    expected = np.zeros((4, 4))
    expected[[0, 1, 2, 1, 2, 3], [1, 2, 3, 0, 1, 2]] = 1600.0
    assert areas_between(GRAPH, LAYER) == pytest.approx(expected, rel=1e-12)


def test_merging_joins_what_the_data_do_not_tell_apart_and_nothing_else() -> None:
    """Independent clusters with standard errors of 0.01 at 0, 0.005, 1 and 1.01; two sum to half of (difference / sd)^2 / 2."""
    theta = np.array([0.0, 0.005, 1.0, 1.01, 0.0, 0.0, 0.0, 0.0])
    hessian = np.eye(8) / 0.01**2
    labels, found = merged(quadratic(hessian, np.zeros(8)), theta, np.zeros((4, 4)), 0.0, charge=5.0)
    assert labels.tolist() == [0, 0, 1, 1]
    assert found == pytest.approx([0.0025, 1.005, 0.0, 0.0], abs=1e-3)
    labels, _ = merged(quadratic(hessian, np.zeros(8)), theta, np.zeros((4, 4)), 0.0, charge=0.1)  # 0.0625 and 0.25 chi squared halves
    assert labels.tolist() == [0, 0, 1, 2]


def test_merging_takes_correlations_and_the_gradient_into_account() -> None:
    """Merging is the constrained minimum of the quadratic: compare with the stacked system solved directly."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((30, 6))
    hessian, gradient, theta = 50.0 * root.T @ root, rng.standard_normal(6), 0.01 * rng.standard_normal(6)
    labels, found = merged(quadratic(hessian, gradient), theta, np.zeros((3, 3)), 0.0, charge=1e9)
    assert labels.tolist() == [0, 0, 0]
    gather = np.kron(np.eye(2), np.ones((3, 1)))
    prior = np.eye(6)
    expected = np.linalg.solve(gather.T @ (hessian + prior) @ gather, gather.T @ ((hessian + prior) @ theta - gradient))
    assert found == pytest.approx(expected, rel=1e-9)


def test_small_jumps_across_large_faces_are_merged_but_clear_ones_never_for_their_area() -> None:
    area = np.array([[0.0, 1600.0], [1600.0, 0.0]])
    data = quadratic(np.eye(4) * 200.0, np.zeros(4))  # a jump j costs 50 j^2
    for jump, regions in ((0.1, 1), (3.0, 2)):
        labels, _ = merged(data, np.array([0.0, jump, 0.0, 0.0]), area, 0.01, charge=1.0)
        assert labels.max() + 1 == regions, jump
    assert 0.01 * 1600.0 * CLEAR < 50.0 * 3.0**2


def test_borders_give_way_to_the_data() -> None:
    """A Hessian that knows every zone's ln mu: two layers of which some zones are on the wrong side."""
    n = ZONES.count
    truth = (LAYER >= 2).astype(np.int64)
    wrong = truth.copy()
    beside = np.flatnonzero((HEIGHT > 18.0) & (HEIGHT < 22.0))[::3]
    wrong[beside] = 1 - wrong[beside]
    values = np.array([0.0, 1.0, 0.0, 0.0])
    hessian = np.zeros((2 * n, 2 * n))
    hessian[:n, :n] = 4.0 * np.eye(n)
    deviation = np.concatenate([values[wrong] - values[truth], np.zeros(n)])
    labels, moves = border_moves(GRAPH, wrong, values, quadratic(hessian, hessian @ deviation), weight=1e-4)
    assert same_partition(labels, truth) and moves == len(beside)
    kept, none = border_moves(GRAPH, truth, values, quadratic(hessian, np.zeros(2 * n)), weight=1e-4)
    assert none == 0 and (kept == truth).all()


def test_without_data_a_bump_on_a_border_is_smoothed_away() -> None:
    n = ZONES.count
    bumped = (LAYER >= 2).astype(np.int64)
    bumped[np.flatnonzero((HEIGHT > 20.0) & (HEIGHT < 24.0))[0]] = 0
    labels, _ = border_moves(
        GRAPH, bumped, np.array([0.0, 1.0, 0.0, 0.0]), quadratic(np.zeros((2 * n, 2 * n)), np.zeros(2 * n)), weight=1.0
    )
    assert areas_between(GRAPH, labels).sum() <= areas_between(GRAPH, bumped).sum()


def test_the_criterion_counts_borders_and_regions() -> None:
    body = cube(LAYERS)
    zones = body.zones(each_cell=True)
    model = FieldModel(body.mesh, body.load_cases(sd_mm=0.1), zones, elements="as_given")
    lame, shear = body.moduli
    unknown = zones.of_cell >= 0
    point = first_point(model, logarithms(lame[unknown], shear[unknown]))
    criterion = Criterion.of(model, ZoneGraph.of(body.mesh, zones), point, 0.05)
    layer = body.mesh.regions[unknown].astype(np.int64)
    regions = model.with_zones(joined(zones, layer))
    theta = point.theta.reshape(2, -1)[:, [0, -1]].ravel()
    cost = criterion.value(layer, regions.evaluate(theta, point.states))
    scale = max(1.0, point.misfit / model.n_free)
    contrasts = 0.5 * float((np.diff(theta.reshape(2, -1)) ** 2).sum())  # over a variance of 1
    charges = 2.0 * (np.log(model.n_free) + np.log(192))
    expected = 0.5 * point.misfit / scale + 0.05 / scale * 1600.0 * CLEAR + contrasts + charges
    assert cost == pytest.approx(expected, rel=1e-6)


def test_two_layers_come_out_of_a_blurred_field() -> None:
    """The start has a third of the contrast and blurred borders, as total variation leaves it; noise is 0.1 % of the push."""
    body = cube(LAYERS, pushes=((0.0, 0.0, -10.0), (7.0, 0.0, -7.0)))
    zones = body.zones(each_cell=True)
    graph = ZoneGraph.of(body.mesh, zones)
    unknown = zones.of_cell >= 0
    model = FieldModel(body.mesh, body.load_cases(sd_mm=0.01), zones, elements="as_given")
    height = body.mesh.points[body.mesh.cells].mean(axis=1)[unknown, 2]
    share = np.clip((height - 6.0) / 8.0, 0.0, 1.0)
    theta = np.concatenate([np.log(0.12) + 0.25 * share, np.log(5.5) - 0.2 * share])
    start = first_point(model, theta)
    found = segment(model, graph, start, 0.02, Bounds())
    assert found.zones.count == 2 and same_partition(found.of_zone, body.mesh.regions[unknown])
    young, poisson = young_and_poisson(found.point.theta)
    order = np.argsort(young)
    assert young[order] == pytest.approx([0.25, 0.5], rel=0.01)
    assert poisson[order] == pytest.approx([0.43, 0.38], abs=0.003)
    assert found.zones.names == ("segment 1", "segment 2")


def test_layers_that_only_errors_of_large_cells_contradict_are_regions() -> None:
    """A map of many moduli makes up for errors of cells of 10 mm, two layers cannot; on smaller cells they explain the data."""
    solved = QuadraticBody("cube", unknown=(5.0, 0.45), known=(15.0, 0.45)).solved((0.0, 0.0, -4.0), divisions=8)
    mesh, loaded = QuadraticBody("cube").model(4, "hexahedron")
    rng = np.random.default_rng(1)
    points, u = solved.at(rng.uniform(0.02, 0.98, (600, 3)))
    sd = 0.002 * float(np.linalg.norm(u, axis=1).max())
    field = DisplacementField.from_arrays(points, u + sd * rng.standard_normal(u.shape), sd_mm=sd)
    found = identify_relative_map(mesh, [FieldLoadCase.of("push", field, mesh, loaded=loaded)], law="linear")
    assert found.zones.count == 2
    low, high = found.intervals()[0][1]
    assert low < 1.0 / 3.0 < high < 0.6
