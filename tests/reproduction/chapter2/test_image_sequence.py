"""Successive images of one cross-section: beads are found in each, and move as the model does."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from naibu.reproduction.chapter2.image_sequence import BEADS, PIXEL_MM, sequence_section
from naibu.reproduction.chapter2.simulations import agar_under_bar


def test_beads_are_located_in_every_image() -> None:
    section = sequence_section()
    rows = np.array(section.tables[0].rows, dtype=float)
    assert rows[:, 0] == pytest.approx([0.0, 0.6, 1.2, 1.8, 2.4, 3.0])
    assert (rows[:, 1] == len(BEADS)).all()
    assert rows[:, 3].max() < 0.3 * PIXEL_MM
    assert rows[2, 4] < rows[1, 4] < 0.0 == rows[0, 4]
    canvas = Canvas(figsize=section.figures[0].size)
    section.figures[0].draw(canvas)
    canvas.draw_without_rendering()


def test_the_bar_goes_down_stays_and_comes_back() -> None:
    study = agar_under_bar(push_mm=2.0, path_s=(1.0, 1.5, 2.5))
    top = study.series.displacement[:, study.middle_top, 1]
    assert np.interp([0.5, 1.0, 1.5, 2.0, 2.5, 3.0], study.series.times, top) == pytest.approx([-1.0, -2.0, -2.0, -1.0, 0.0, 0.0], abs=1e-9)
