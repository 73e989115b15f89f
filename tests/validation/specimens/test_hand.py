"""The hand-like surface: level surfaces of known areas and volumes, and one rim at the wrist."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.meshing.cutting.surfaces.surface_input import linked_surface
from naibu.validation import hand_surface
from naibu.validation.specimens.hand import level_surface


def test_the_level_surface_of_a_ball_has_its_area_and_volume():
    step = 0.5
    axes = [np.arange(-6.0, 6.1, step)] * 3
    x, y, z = np.meshgrid(*axes, indexing="ij")
    points, triangles = level_surface(np.sqrt(x**2 + y**2 + z**2) - 5.0, np.full(3, -6.0), step)
    a, b, c = points[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(4 * np.pi * 25, rel=0.02)
    assert (a * normal).sum() / 6.0 == pytest.approx(4 / 3 * np.pi * 125, rel=0.02)  # the normals point outwards
    assert not linked_surface(points, triangles).repairs
    assert len(points) - len(triangles) // 2 == 2


def test_a_hand_is_one_surface_with_its_rim_at_the_wrist():
    points, triangles = hand_surface(5.0)
    start = linked_surface(points, triangles)
    assert not start.repairs
    t, i = np.nonzero(start.neighbours < 0)
    rim = start.points[start.triangles[t, (i + 1) % 3]]
    assert len(rim) > 10
    assert np.ptp(rim[:, 1]) < 5.0 and rim[:, 1].max() < -25.0
    assert len(points) - (3 * len(triangles) + len(rim)) // 2 + len(triangles) == 1  # a disc: fingers do not touch
    np.testing.assert_array_equal(points, hand_surface(5.0)[0])
