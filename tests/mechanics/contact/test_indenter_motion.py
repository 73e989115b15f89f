"""Steps are divided where points would pass through an indenter, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.mechanics.contact.indenter_motion import SHARE, parts_of_approach
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter

PLATE_MM = 2.0  # thick, in z


def parts(points: list[list[float]], moves: list[list[float]], travel: tuple[float, ...] = (0.0, 0.0, 0.0)) -> int:
    plate: RigidIndenter = box_indenter((0.0, 0.0, 0.0), (40.0, 40.0, PLATE_MM))
    still = np.zeros((1, 3))
    axes = plate.geometry.axes[None]
    return parts_of_approach([plate], np.array(points), np.array(moves), still, axes, np.array([travel]), still)


@pytest.mark.parametrize("way", [3.0, 11.0, 40.0])
def test_no_part_takes_a_point_far_into_a_plate(way: float) -> None:
    found = parts([[0.0, 0.0, 1.5]], [[0.0, 0.0, -way]])
    assert way / found <= SHARE * 0.5 * PLATE_MM
    assert found == parts([[0.0, 0.0, 1.5]], [[0.0, 0.0, 0.0]], (0.0, 0.0, way))
    assert found & (found - 1) == 0


def test_points_that_leave_or_cannot_reach_the_plate_divide_no_step() -> None:
    assert parts([[0.0, 0.0, 1.0], [0.0, 0.0, 60.0], [70.0, 0.0, 0.0]], [[0.0, 0.0, 8.0], [0.0, 0.0, -8.0], [8.0, 0.0, 0.0]]) == 1
    assert parts([[0.0, 0.0, 1.0]], [[0.0, 0.0, -8.0]], (0.0, 0.0, -8.0)) == 1
