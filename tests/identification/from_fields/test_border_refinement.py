"""Borders of regions within cells: a sphere among cubes, and the derivatives of the moduli of cells."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.border_refinement import Borders, _Mixing, refined_borders
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, logarithms, young_and_poisson
from naibu.identification.from_fields.gauss_newton import Bounds, first_point
from naibu.identification.from_fields.segmentation import joined
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes

SIDE_MM, RADIUS_MM = 30.0, 7.5
SD_MM = 0.01


@cache
def model(cells: int = 9, sphere: bool = True) -> tuple[FieldModel, Zones]:
    """A block of which every cell is a zone, and its regions: cells whose middle lies in a sphere, or one half."""
    mesh = box((SIDE_MM,) * 3, (cells,) * 3, layers=[("known", SIDE_MM / 3.0), ("body", SIDE_MM / 1.5)])
    rng = np.random.default_rng(0)
    points = rng.uniform([-13.0, -13.0, 2.0], [13.0, 13.0, 28.0], (1200, 3))
    vectors = points * [0.02, 0.02, -0.05] + SD_MM * rng.standard_normal(points.shape)
    loaded = np.zeros(mesh.n_points, dtype=bool)
    loaded[boundary_nodes(mesh)] = True
    case = FieldLoadCase.of("press", DisplacementField.from_arrays(points, vectors, sd_mm=SD_MM), mesh, loaded=loaded)
    zones = Zones.of(mesh, known={"known": (10.0, 0.45)}, each_cell=True)
    middles = mesh.points[mesh.cells].mean(axis=1)[zones.of_cell >= 0]
    of_zone = _in_sphere(middles) if sphere else middles[:, 0] > 0.0
    return FieldModel(mesh, [case], zones, "linear", "accurate"), joined(zones, of_zone.astype(np.int64))


def _in_sphere(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(points - [0.0, 0.0, 20.0], axis=-1) < RADIUS_MM)


def test_borders_start_with_the_volume_of_the_cells_and_are_rounder_than_these() -> None:
    fields, zones = model()
    borders = _Mixing.of(fields, zones).borders
    points = np.random.default_rng(1).uniform([-15.0, -15.0, 10.0], [15.0, 15.0, 30.0], (20_000, 3))
    deep = borders.distances(points)[0][:, 0]
    # volume of the sphere that the border encloses, by Monte Carlo, against that of the cells
    cells = zones.of_cell == 1
    assert abs((deep > 0.0).mean() * 30.0 * 30.0 * 20.0 / borders.volumes[cells].sum() - 1.0) < 0.05
    truth = _in_sphere(points)
    size = borders.edge_mm
    boxed = (np.abs(points[:, None] - borders.middles[cells]).max(axis=2) <= 0.5 * size + 1e-9).any(axis=1)

    def dice(found: np.ndarray) -> float:
        return 2.0 * float((found & truth).sum()) / float(found.sum() + truth.sum())

    assert dice(deep > 0.0) > max(0.9, dice(boxed) + 0.05)
    np.testing.assert_array_equal(borders.region_at(points, np.zeros(len(points))), deep > 0.0)
    assert (borders.region_at(points, np.full(len(points), -1)) == -1).all()


def test_a_plane_border_is_where_it_was() -> None:
    """The mean of a half-space in a Gaussian window is the normal distribution of the distance from its border."""
    fields, zones = model(10, False)
    borders = Borders.of(fields.mesh, zones)
    x = np.linspace(-2.0, 2.0, 9)
    deep = borders.distances(np.column_stack([x, np.zeros(9), np.full(9, 20.0)]))[0][:, 0]
    np.testing.assert_allclose(deep, x, atol=0.12 * borders.edge_mm)


def test_derivatives_of_the_moduli_of_cells() -> None:
    mixing = _Mixing.of(*model())
    rng = np.random.default_rng(2)
    theta, moves = np.array([1.0, 2.0, 2.5, 2.2]), mixing.borders.moves.ravel() + 0.2 * rng.standard_normal(10)
    _, slopes = mixing.moduli(theta, moves)
    step = 1e-6
    for column in range(14):
        change = step * np.eye(14)[column]
        ends = [mixing.moduli(theta + s * change[:4], moves + s * change[4:])[0] for s in (1.0, -1.0)]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2.0 * step), slopes[:, column], atol=1e-6)


def test_size_and_stiffness_of_an_inclusion_are_found_together() -> None:
    """Measurements of a mixed border on the same cells: the interval holds the modulus, and is wider than with a known border."""
    fields, zones = model()
    truth = np.array([5.0, 15.0])
    lame, shear = np.array([lame_parameters(e, 0.45) for e in truth]).T
    mixing = _Mixing.of(fields, zones)
    moves = mixing.borders.moves.ravel() + np.array([0.7, 0.3, 0, 0, 0, 0, 0, 0, 0, 0])
    start = first_point(fields, mixing.moduli(logarithms(lame, shear), moves)[0])
    state = start.states[0]
    rng = np.random.default_rng(3)
    field = fields.observed[0].load_case.field
    seen = (fields.observed[0].operator @ state.ravel() * SD_MM).reshape(-1, 3) + SD_MM * rng.standard_normal(field.points.shape)
    case = replace(fields.observed[0].load_case, field=DisplacementField.from_arrays(field.points, seen, sd_mm=SD_MM))
    again = FieldModel(fields.mesh, [case], fields.zones, "linear", "accurate")
    guess = replace(start, theta=logarithms(*np.array([lame_parameters(e, 0.45) for e in (6.0, 9.0)]).T))
    found = refined_borders(again, zones, guess, Bounds())
    young = young_and_poisson(found.theta)[0]
    assert (np.abs(np.log(young / truth)) < 3.0 * np.sqrt(np.diag(found.covariance))[:2]).all()
    of_contrast, known = (c[0, 0] + c[1, 1] - 2.0 * c[0, 1] for c in (found.covariance, found.at_these_borders))
    assert of_contrast > 1.05 * known
    assert abs(young[1] / truth[1] - 1.0) < 0.15
