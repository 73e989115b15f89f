"""Meshes: what is refused, and what moving does."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh

POINTS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
CELLS = np.array([[0, 1, 2], [1, 3, 2]])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cell_type": "wedge"}, "cell_type 'wedge' is not known"),
        ({"points": np.zeros((4, 3))}, r"shape \(n, 2\)"),
        ({"points": np.where(np.arange(8).reshape(4, 2) == 5, np.nan, 1.0)}, r"points\[2, 1\] is nan"),
        ({"cells": np.array([[0, 1]])}, r"shape \(m, 3\)"),
        ({"cells": np.array([[0, 1, 4]])}, "nodes 0 to 4, but the mesh has nodes 0 to 3"),
        ({"regions": np.zeros(3, dtype=int)}, r"one per cell\) must have shape \(2,\)"),
        ({"regions": np.array([0, 1])}, "only 1 region names"),
    ],
)
def test_arrays_that_form_no_mesh_are_refused(changed: dict[str, object], message: str) -> None:
    arguments = {"points": POINTS, "cells": CELLS, "cell_type": "triangle"} | changed
    with pytest.raises(InputError, match=message):
        Mesh.from_arrays(**arguments)  # type: ignore[arg-type]


def test_moved_adds_the_displacement_and_keeps_the_rest() -> None:
    mesh = Mesh.from_arrays(POINTS, CELLS, "triangle", regions=[0, 1], region_names=("soft", "hard"))
    moved = mesh.moved(np.full((4, 2), 0.25))
    assert np.array_equal(moved.points, POINTS + 0.25) and np.array_equal(mesh.points, POINTS)
    assert moved.cells is mesh.cells and moved.region_names == ("soft", "hard")
    with pytest.raises(InputError, match="displacement"):
        mesh.moved(np.zeros((4, 3)))


def test_arrays_are_in_row_major_order_however_a_mesh_is_made() -> None:
    """Numpy gives other columns of an array in column-major order, for which kernels would be compiled once more."""
    mesh = Mesh(POINTS, CELLS[:, [1, 2, 0]], "triangle", np.zeros(2, dtype=np.int64), ("body",))
    assert mesh.cells.flags.c_contiguous and mesh.cells.tolist() == [[1, 2, 0], [3, 2, 1]]
