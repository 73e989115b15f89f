"""Cells whose nodes are moved onto the borders of zones: volumes of round bodies, faces at the surface, cells that stay convex."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.meshing.quality import signed_volumes
from naibu.workflows.fields.block_mesh import block_mesh, misplaced, regions_of
from naibu.workflows.fields.border_fitting import fitted_to_borders

RADIUS_MM, SIDE_MM, VOXEL_MM = 11.0, 40.0, 0.8
NAMES = {1: "gel", 2: "lump"}


def scan(kind: str, direction: FloatArray) -> tuple[Volume, IntArray]:
    """Return a cube of gel around a ball or a rod along z, its grid in some direction."""
    n = round(SIDE_MM / VOXEL_MM)
    z, y, x = VOXEL_MM * (np.indices((n,) * 3) + 0.5) - 0.5 * SIDE_MM - 1.3
    distance = np.hypot(np.hypot(x, y), z) if kind == "ball" else np.hypot(x, y)
    volume = Volume.from_array(np.ones((n,) * 3, np.uint8), spacing_mm=(VOXEL_MM,) * 3, direction=direction)
    return volume, np.where(distance < RADIUS_MM, 2, 1)


def volume_of(mesh: Mesh, region: int) -> float:
    return float(signed_volumes(mesh)[mesh.regions == region].sum())


@pytest.mark.parametrize(("kind", "exact_mm3"), [("ball", 4.0 / 3.0 * np.pi * RADIUS_MM**3), ("rod", np.pi * RADIUS_MM**2 * SIDE_MM)])
@pytest.mark.parametrize("mirrored", [False, True])
def test_cells_of_a_round_zone_have_its_volume(kind: str, exact_mm3: float, mirrored: bool) -> None:
    inside, labels = scan(kind, np.diag([-1.0, 1.0, 1.0]) if mirrored else np.eye(3))
    before, cells = block_mesh(inside, labels, NAMES, 5.0)
    mesh, of_voxel = fitted_to_borders(before, cells, inside, regions_of(labels, NAMES))
    assert volume_of(mesh, 1) == pytest.approx(exact_mm3, rel=0.06)  # flat faces between nodes on a sphere lie inside of it
    assert volume_of(mesh, 0) + volume_of(mesh, 1) == pytest.approx(SIDE_MM**3, rel=1e-6)  # its surface stays
    wrong = [misplaced(m, c, inside, labels, NAMES)[1] for m, c in ((before, cells), (mesh, of_voxel))]
    assert wrong[1] < 0.5 * wrong[0]


def test_nodes_at_the_surface_stay_in_their_faces_and_no_corner_is_turned() -> None:
    inside, labels = scan("rod", np.eye(3))
    before, cells = block_mesh(inside, labels, NAMES, 5.0)
    mesh, _ = fitted_to_borders(before, cells, inside, regions_of(labels, NAMES))
    ends = [np.isclose(before.points, limit(before.points, axis=0)) for limit in (np.min, np.max)]
    for at in ends:
        np.testing.assert_allclose(mesh.points[at], before.points[at], atol=1e-9)
    assert np.abs(mesh.points - before.points).max() > 1.0
    corner = mesh.points[mesh.cells]
    for here, x, y, z in ((0, 1, 3, 4), (1, 2, 0, 5), (2, 3, 1, 6), (3, 0, 2, 7), (4, 7, 5, 0), (5, 4, 6, 1), (6, 5, 7, 2), (7, 6, 4, 3)):
        edges = corner[:, [x, y, z]] - corner[:, [here]]
        assert (np.linalg.det(edges) > 0.0).all()


def test_borders_in_planes_of_the_cells_move_nothing() -> None:
    inside, labels = scan("ball", np.eye(3))
    labels = np.where(np.indices(labels.shape)[0] < 20, 1, 2)
    before, cells = block_mesh(inside, labels, NAMES, 5.0)
    mesh, of_voxel = fitted_to_borders(before, cells, inside, regions_of(labels, NAMES))
    np.testing.assert_allclose(mesh.points, before.points, atol=0.05)
    np.testing.assert_array_equal(of_voxel, cells)
