"""Tables 3.4 and 3.5: the printed columns are the report's, ours follow from it and from the markers."""

from __future__ import annotations

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import InputError
from naibu.reproduction.chapter3.material_tests import (
    CHANCE,
    COMPLIANCE,
    CONSTRAINED,
    SLACK,
    Specimens,
    explained_spread,
    table_3_4,
    table_3_5,
)
from naibu.reproduction.chapter3.poisson_readings import GELS, constrained_block, marker_ratios, matching_pairs, readings
from naibu.viewer.chapters.chapter import Section

PAPER = {t["id"]: t["rows"] for t in datasets.paper_tables()["tables"]}


@pytest.fixture(scope="module")
def ratio_section() -> Section:
    return table_3_5(divisions=4)


def test_table_3_4_prints_the_reports_values_and_their_means():
    rows = table_3_4().tables[0].rows
    specimens = [r for r in rows if r[1] is not None]
    assert [[r[0], r[1], r[2], r[3] * 1e3] for r in specimens] == [r[:4] for r in PAPER["3.4"]]
    means = {r[0]: r for r in rows if r[1] is None}
    for gel in GELS:
        own = [r[3] * 1e-3 for r in PAPER["3.4"] if r[0] == gel]
        assert means[gel][7] == pytest.approx(np.mean(own), abs=0.06)
        assert means[gel][7] == pytest.approx(means[gel][6], rel=0.005)  # the report's means check
        low, high = map(float, means[gel][9].split(" to "))
        assert low < min(own) < max(own) < high  # three specimens say little


def made(effect, size, moduli=(300.0, 150.0)) -> Specimens:
    """Six specimens whose apparent moduli differ by one effect alone."""
    diameter, height = np.array([30.0, 40, 35, 35, 35, 35]), np.array([35.0, 25, 20, 30, 25, 15])
    gel = np.array([0, 0, 0, 1, 1, 1])
    area, shape, e = np.pi * diameter**2 / 4, diameter / (4 * height), np.array(moduli)[gel]
    apparent = {
        CONSTRAINED: e * (1 + 2 * shape**2),
        COMPLIANCE: height / area / (height / (area * e) + size),  # deflections of specimen and machine add
        SLACK: e * 0.1 * height / (0.1 * height + size),  # force of a strain of 10 %, over the strain with the slack in it
    }[effect]
    return Specimens(gel, shape, area / height, height, apparent)


@pytest.mark.parametrize(("effect", "size"), [(CONSTRAINED, 0.0), (COMPLIANCE, 2e-5), (SLACK, 0.8)])
def test_an_effect_is_found_in_specimens_that_have_it(effect, size):
    specimens = made(effect, size)
    moduli, found, residual_sd = explained_spread(specimens, effect)
    assert moduli == pytest.approx((300.0, 150.0), rel=1e-4)
    assert residual_sd < 1e-5
    if size:
        assert found == pytest.approx(size, rel=1e-3)
    assert explained_spread(specimens, CHANCE)[2] > 0.05


def test_held_faces_do_not_explain_the_spread():
    left = {row[0]: row[-1] for row in table_3_4().tables[1].rows}
    assert left[CONSTRAINED] > 1.5 * left[CHANCE]
    assert max(left[SLACK], left[COMPLIANCE]) < 0.6 * left[CHANCE]


def test_table_3_5_prints_the_reports_values(ratio_section):
    rows = ratio_section.tables[0].rows
    printed = [r for r in rows if r[1].startswith("report")]
    assert [[r[0], r[2], r[3], r[4]] for r in printed] == PAPER["3.5"]
    for row in printed:
        assert row[5] == pytest.approx(row[3] / row[2], abs=1e-3)
        assert row[8] == pytest.approx((1 - row[2]) * (1 + row[3]) ** 2, abs=1e-3)


def test_markers_keep_the_volume_that_the_printed_strains_lose(ratio_section):
    rows = ratio_section.tables[0].rows
    assert max(r[8] for r in rows if r[1].startswith("report")) < 0.84
    ours = [r for r in rows if r[1].startswith("markers")]
    assert len(ours) == 5
    assert all(abs(r[8] - 1.0) < max(0.03, 2 * r[9]) for r in ours)
    assert {g: s.ratio.value > 0.47 for s in marker_ratios() for g in [s.gel]} == {
        "hardness 5": True,
        "hardness 0": True,
        "not stated": True,
    }


def test_no_strain_measure_and_no_reading_explains_both_rows(ratio_section):
    _, measures, candidates, _ = ratio_section.tables
    assert not any(all(abs(j - 1.0) <= 0.03 for j in row[1:]) for row in measures.rows)
    assert not any(max(row[-2:]) <= 2.0 for row in candidates.rows)
    assert matching_pairs([(-a, t, nu) for _, a, t, nu in PAPER["3.5"]]).fitting[1] == 0


def test_pairs_that_fit_finds_a_pair_that_is_there():
    seen = readings("ct_cube_plate", "height_45")
    pair = seen.longitudinal["all layers"], seen.transversal["one gel, hardness not stated, layer 3"], 0.5
    found = matching_pairs([pair, (-0.9, 2.0, 0.0)])
    assert found.fitting[0] >= 1
    assert found.fitting[1] == 0
    assert found.tried > 50


def test_readings_follow_from_the_mean_heights_of_the_layers():
    experiment = datasets.load("ct_cube_plate")
    free, loaded = (np.nanmean(m.points[:, 2].reshape(5, 25), axis=1) for m in (experiment.initial, experiment.state("height_35").markers))
    along = readings("ct_cube_plate", "height_35").longitudinal
    assert along["all layers"] == pytest.approx((loaded[4] - loaded[0]) / (free[4] - free[0]) - 1)
    assert along["stated height"] == pytest.approx(35 / 60 - 1)


def test_held_block_at_small_strain_widens_by_poissons_ratio_and_no_more():
    """Between a free bar (nu times the shortening) and a confined one (nothing); symmetric; nothing at the constrained faces."""
    block = constrained_block(0.01, 0.3, 4)
    middle = block.transversal_at(0.5)
    assert 0.002 < middle < 0.0035
    assert block.transversal[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert block.transversal == pytest.approx(block.transversal[::-1], abs=1e-5)
    assert 1.0 - 0.01 < block.volume_ratio < 1.0 - 0.01 * (1 - 2 * 0.3)


def test_a_ratio_as_printed_would_be_seen_as_lost_volume(ratio_section):
    rows = ratio_section.tables[3].rows
    volume = {(r[0], r[1]): r[4] for r in rows}
    assert volume["hardness 5", "printed"] < 0.87
    assert all(volume[g, "0.49"] > 0.975 for g in GELS)


def test_figure_is_drawn(ratio_section):
    from matplotlib.figure import Figure

    canvas = Figure()
    ratio_section.figures[0].draw(canvas)
    assert len(canvas.axes[0].lines) == 6


def test_states_without_positions_are_refused():
    with pytest.raises(InputError, match="no measured positions"):
        readings("ct_two_material_4", "deformed")
