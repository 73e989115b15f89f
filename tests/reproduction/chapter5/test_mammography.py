"""Section on mammography: what the measured markers show, and how far models without a marker are from them."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from naibu.reproduction.agreement.read_tables import Tables
from naibu.reproduction.agreement.skin_and_chip import _mammography
from naibu.reproduction.chapter5.half_ellipsoid import distances_mm, hardness_modulus, mechanical_model, phantom_markers
from naibu.reproduction.chapter5.mammography import CURVE, OBSERVED, SCANNED, phantom_section, scans_section
from naibu.reproduction.chapter5.marker_cells import cell_sizes, marker_cells, size_ratio
from naibu.reproduction.chapter5.scanned_breasts import CONSTRAINED, EQUILIBRIUM, GEOMETRIC, IN_SCAN
from naibu.viewer.chapters.chapter import Section

_COLUMNS = ("measured", "equilibrium")


@pytest.fixture(scope="module")
def phantom() -> Section:
    return phantom_section()


def test_models_without_a_marker_come_near_the_measured_ones(phantom: Section) -> None:
    markers = phantom.tables[0]
    unmoved, plane, bent, soft, stiff = (float(str(row[2])) for row in markers.rows)
    assert soft < stiff < 1.0 < bent < 1.5 < plane < unmoved
    held, free, soft, stiff = (float(str(row[3])) for row in markers.rows[1:])
    assert soft < 1.5 < free < 3.0 < held
    assert soft < stiff


def test_the_measured_volume_stays_though_a_layer_gets_denser(phantom: Section) -> None:
    tables = Tables((phantom,))
    for where, most in (("between the plates", 0.94), ("beside them", 0.97)):
        area, predicted = (tables.number(OBSERVED, ("area of the lowest layer, over that at rest", where), c) for c in _COLUMNS)
        assert area < most and predicted == pytest.approx(area, abs=0.01)
        volume, predicted = (tables.number(OBSERVED, ("volume, over that at rest", where), c) for c in _COLUMNS)
        assert volume == pytest.approx(1.0, abs=0.01) and predicted == pytest.approx(1.0, abs=0.01)  # markers lie on voxels of 0.5 mm


def test_cells_of_a_stretched_lattice_have_its_determinant() -> None:
    lattice = 10.0 * np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    lattice += np.random.default_rng(0).normal(0.0, 0.5, lattice.shape)
    gradient = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, -0.1], [0.05, 0.0, 1.2]])
    cells = marker_cells(lattice, 22.0)
    kept = np.abs(cell_sizes(lattice, cells)).sum()
    assert kept > 0.9 * 30.0**3  # rows on the lattice's sides make flat cells, which are left out
    ratio = size_ratio(lattice, lattice @ gradient.T, cells, lattice[cells].mean(axis=1)[:, 0] < 15.0)
    assert ratio == pytest.approx(np.linalg.det(gradient))


@pytest.mark.slow
def test_the_outlines_bring_points_of_a_scan_nearer_to_their_places() -> None:
    section = scans_section()
    tables = Tables((section,))
    scan, closed, free, onto = (
        np.mean([tables.number(SCANNED, (name,), view) for view in ("CC, mm", "MLO, mm")])
        for name in (IN_SCAN, GEOMETRIC, EQUILIBRIUM, CONSTRAINED)
    )
    assert onto < free < closed < scan and free < 3.5
    assert tables.number(CURVE, ("outlines, distances and angle",), "mean, mm") < 3.0
    section.figures[0].draw(Canvas())
    assert [c.verdict for c in _mammography(Tables((section, phantom_section())))].count("agrees") == 4


def test_a_durometer_sphere_that_hardly_penetrates_gives_the_modulus_of_hertz() -> None:
    depth, force = 0.01 * 2.54, 539.0 + 99.0 * 78.4
    hertz = force / (4.0 / 3.0 * 2.54**0.5 * depth**1.5) * (1.0 - 0.5**2)
    assert hardness_modulus(99.0) == pytest.approx(hertz, rel=2e-3)
    assert hardness_modulus(5.0) / hardness_modulus(0.0) == pytest.approx(222.0 / 125.0, rel=0.08)  # ratio of the compression tests


def test_a_coarse_and_a_fine_mesh_come_near_the_markers_alike() -> None:
    before, after = phantom_markers()
    assert len(before) > 150
    coarse, fine = (distances_mm(mechanical_model(hardness_modulus(0.0), edge=edge)(before), after) for edge in (0.2, 0.14))
    assert fine[2] < 1.5
    assert fine[1] < 0.75
    np.testing.assert_allclose(coarse, fine, atol=0.25)
