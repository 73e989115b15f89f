"""Figures 16 to 18: what the report says of cuts with and without refinement holds on a hand of our own."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from naibu.reproduction.chapter4.cutting import DEPTH_MM, DISTANCE_MM, SHAKE_MM, chapter4_cut, shaken_path
from naibu.validation import hand_surface
from naibu.viewer.chapters.chapter import Chapter


@pytest.fixture(scope="module")
def chapter() -> Chapter:
    return chapter4_cut(distances=(3.0,), frames=2)


def test_the_tool_shakes_on_the_back_of_the_hand():
    points, _ = hand_surface()
    tips = shaken_path(points, 0)
    near = np.linalg.norm(points[:, None, :2] - tips[None, ::20, :2], axis=2) + 1e3 * (points[:, 2:] < 0)
    assert np.abs(points[near.argmin(axis=0), 2] - tips[::20, 2]).max() < 3.0
    smooth = np.polynomial.Polynomial.fit(np.arange(len(tips)), tips[:, 0], 3)(np.arange(len(tips)))
    assert np.std(tips[:, 0] - smooth) == pytest.approx(SHAKE_MM, rel=0.3)


def test_refinement_follows_the_shaking_tool_and_the_mesh_of_the_scan_does_not(chapter):
    (fine, rough) = chapter.sections[0].tables[0].rows
    assert fine[3] <= 0.5 * DISTANCE_MM < rough[3]
    assert (fine[-1], rough[-1]) == ("yes", "no")
    assert rough[2] < fine[2] < 1.15 * rough[2]  # it is local


def test_edges_are_shorter_than_the_distance_and_mostly_longer_than_half_of_it(chapter):
    (row,) = chapter.sections[1].tables[0].rows
    assert row[0] == 3.0 and row[2] <= 0.5 and row[4] < 1.0 and row[5] > 50.0


def test_the_groove_is_as_deep_as_stated_and_opens_behind_the_tool(chapter):
    found = dict(chapter.sections[2].tables[0].rows)
    assert found["walls, mm²"] == pytest.approx(2.0 * DEPTH_MM * found["length of the cut, mm"], rel=0.1)
    assert 0.0 < found["widest opening, half of the cut, mm"] < found["widest opening, mm"]


def test_all_figures_can_be_drawn(chapter):
    for section in chapter.sections:
        for figure in section.figures:
            canvas = plt.figure(figsize=(2, 2))
            figure.draw(canvas)
            assert canvas.axes
            plt.close(canvas)
