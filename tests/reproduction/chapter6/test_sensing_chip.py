"""Chapter 6: the chip's page prints the report's values, and ours agree or say why not."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from naibu import datasets
from naibu.applications.fingertip.fingertip import FingertipResolution
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.fillets import filleted_end
from naibu.reproduction.agreement.read_tables import Tables
from naibu.reproduction.chapter6 import sensing_chip
from naibu.reproduction.chapter6.tables import chapter6
from naibu.reproduction.chapters import AGREEMENT
from naibu.viewer.chapters.chapter import Chapter
from naibu.viewer.chapters.chapter_page import chapter_html
from naibu.viewer.tables import Table

(STRENGTH, SENSITIVITY) = next(t["rows"] for t in datasets.paper_tables()["tables"] if t["id"] == "6.1")


@pytest.fixture(scope="module")
def chapter() -> Chapter:
    resolution = ChipResolution(along=6, across=1, through=2, below=2, frame=3)
    with pytest.MonkeyPatch.context() as coarse:
        coarse.setattr(sensing_chip, "filleted_end", partial(filleted_end, fineness=1))
        return chapter6(resolution=resolution, fingertip_resolution=FingertipResolution(2, 2, 8))


def table(chapter: Chapter, title: str) -> Table:
    return next(t for section in chapter.sections for t in section.tables if t.title == title)


def test_table_6_1_prints_the_reports_values(chapter: Chapter) -> None:
    rows = table(chapter, "Sensitivity").rows
    assert [row[1] for row in rows] == [SENSITIVITY[1], SENSITIVITY[2], SENSITIVITY[2]]
    assert [row[2] for row in rows] == pytest.approx([row[1] for row in rows], rel=0.01)
    strength = table(chapter, "Table 6.1, strength").rows
    assert [row[1] for row in strength] == [STRENGTH[1], STRENGTH[2], None]


def test_the_printed_limits_together_exceed_the_strength_and_each_alone_does_not(chapter: Chapter) -> None:
    force, moment, both = (float(row[2]) for row in table(chapter, "Table 6.1, strength").rows)
    assert force < 2.0 and moment < 2.0 < both
    assert both == pytest.approx(force + moment, rel=0.01)
    # what the printed sensitivities need at the resistors, whatever the chip: V = pi sigma V_in / 2
    needed = [row[3] for row in table(chapter, "Table 6.1, strength").rows[:2]]
    assert needed == pytest.approx([2 * 1.0 / (718e-12 * 5.0) * 1e-9, 2 * 2.264 / (718e-12 * 5.0) * 1e-9], rel=1e-3)


def test_misprints_are_told_with_what_they_change(chapter: Chapter) -> None:
    rows = {row[0]: row for row in table(chapter, "Misprints").rows}
    assert set(rows) == {"(8)", "(11)", "(18)", "(20)", "(21)", "(22)"}
    assert rows["(8)"][4] == pytest.approx(2.0 * rows["(8)"][5])
    assert rows["(18)"][4] == pytest.approx(2.0 * rows["(18)"][5])
    # small at the printed limit: less than a hundredth of the stress
    assert rows["(21)"][4] == pytest.approx(rows["(21)"][5], rel=0.01)
    assert rows["(22)"][4] > 0.325 / 2 * (0.325 / 3 + 0.1625) / 0.325 * 1e3 > rows["(22)"][5]


def test_equations_agree_with_finite_elements_of_the_beams(chapter: Chapter) -> None:
    for name, closed, beams, _ in table(chapter, "Equations and finite elements").rows:
        # shear of the short beams; in (12) also the second shear modulus and the ends that cannot warp
        tolerance = 0.2 if name.startswith(("(4)", "(9)", "(10)", "(15)", "(19)")) else 0.3 if name.startswith("(12)") else 0.05
        assert beams == pytest.approx(closed, rel=tolerance), name


def test_the_filter_has_the_published_figures_and_a_better_one_stands_beside_it(chapter: Chapter) -> None:
    rows = {row[0]: row for row in table(chapter, "Filters").rows}
    assert rows["first order"][3] == pytest.approx(0.23, abs=0.03)
    assert rows["first order"][4] == pytest.approx(9.0, abs=0.01)
    assert rows["Kalman with jumps"][3] == pytest.approx(rows["first order"][3], abs=0.03)
    assert abs(rows["Kalman with jumps"][4]) < 0.1
    assert rows["Kalman with jumps"][6] < 0.2 * rows["first order"][6]


def test_the_gain_leaves_a_two_hundredth_of_the_range(chapter: Chapter) -> None:
    force = table(chapter, "Readout").rows[0]
    assert force[2] == pytest.approx(25.0, rel=0.05)
    assert force[2] < force[3] / 200.0


def test_every_figure_is_drawn(chapter: Chapter) -> None:
    page = chapter_html(chapter)
    assert page.count("data:image/svg+xml") == sum(len(section.figures) for section in chapter.sections) == 13
    assert all(np.isfinite(v) for row in table(chapter, "Designs").rows for v in row[1:])


def test_a_tilted_press_moves_m_y_and_leaves_m_x_alone(chapter: Chapter) -> None:
    rows = table(chapter, "Figures 6.9 and 6.11 at 3 N").rows
    tilt, seconds, _, m_x, m_y, share, jig, m_x_jig = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    assert tilt.tolist() == [0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0]
    assert (m_x == 0.0).all() and m_y[0] == 0.0 and (np.diff(m_y) > 0.0).all()
    # the misalignment turns the moment
    assert m_x_jig == pytest.approx(-m_y * np.sin(np.deg2rad(jig)), rel=1e-6, abs=1e-9)
    assert np.ptp(seconds) < 0.2 * seconds.mean() and share[-1] < 1.0


def test_nothing_bends_with_everything_turned_off(chapter: Chapter) -> None:
    rows = {str(row[0]): [float(v) for v in row[1:]] for row in table(chapter, "Geometry, contact and law turned off in turn").rows}
    assert max(rows["none (dead load, small strains)"][3:]) < 4.0
    # the dead load is the rod's: the same force reaches the chip in the same model
    assert rows["geometry and law (dead load)"][:3] == pytest.approx(rows["all"][:3], rel=1e-3)


def test_statements_of_the_report_find_their_tables(chapter: Chapter) -> None:
    found = AGREEMENT["ch6"](Tables(chapter.sections))
    assert len(found) >= 4 and {"agrees"} <= {c.verdict for c in found}
