"""Closed surfaces: every edge passed once each way, and a volume enclosed."""

from __future__ import annotations

import numpy as np

from naibu.viewer.live.closed_surface import is_closed

POINTS = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_a_tetrahedron_is_closed_unless_a_face_is_missing_turned_or_all_look_inwards() -> None:
    assert is_closed(POINTS, FACES)
    assert is_closed(POINTS - 100.0, FACES)
    assert not is_closed(POINTS, FACES[1:])
    assert not is_closed(POINTS, np.vstack([FACES[:1, ::-1], FACES[1:]]))
    assert not is_closed(POINTS, FACES[:, ::-1])
    assert not is_closed(POINTS, np.zeros((0, 3), dtype=np.int64))
