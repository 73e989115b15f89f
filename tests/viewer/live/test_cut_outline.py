"""The outline of a cut: found at rest from nodes that a cut has doubled, on tetrahedra and on voxels."""

from __future__ import annotations

import numpy as np

from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.surface import surface_triangles
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.meshing.cutting.volume import cut_volume
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_faces
from naibu.simulation.cuts.lattice_cut import cut_lattice
from naibu.viewer.live.cut_outline import cut_outline, sides_of_cuts


def lengths(points, edges):
    return np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)


def test_a_cut_half_way_through_a_block_is_outlined_on_its_three_sides():
    mesh = box((10, 10, 10), (4, 4, 4), cell_type="tetra", centred=False)
    faces = boundary_faces(mesh).faces
    assert len(cut_outline(mesh.points, faces)) == 0
    blade = swept_blade(np.array([[[5.0, -1.0, 5.0], [5.0, -1.0, 12.0]], [[5.0, 11.0, 5.0], [5.0, 11.0, 12.0]]]))
    cut = cut_volume(mesh, blade, 5.0)
    faces = boundary_faces(cut.mesh).faces
    side = sides_of_cuts(cut.mesh.points, faces)
    corners = cut.mesh.points[faces[side]]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert np.isclose(area.sum(), 2 * 5 * 10)
    edges = cut_outline(cut.mesh.points, faces)
    ends = cut.mesh.points[edges]
    assert np.allclose(ends[:, :, 0], 5.0)
    assert np.isclose(lengths(cut.mesh.points, edges).sum(), 2 * (10 + 5 + 5))  # the upper edge, and down both sides, of each lip
    assert ((ends[:, :, 2] > 10 - 1e-9).all(axis=1) | (np.abs(ends[:, :, 1] - 5.0) > 5 - 1e-9).all(axis=1)).all()


def test_voxels_whose_faces_are_halved_otherwise_are_outlined_too():
    lattice = classic_lattice(box_mask((4, 3, 2)), 2.5, density=1e-6)
    blade = swept_blade(np.array([[[5.0, -1.0, 2.5], [5.0, -1.0, 9.0]], [[5.0, 9.0, 2.5], [5.0, 9.0, 9.0]]]))
    found = cut_lattice(lattice, lattice_parameters(lattice, 1.0, 1.0, np.inf), blade)
    points, faces = found.lattice.points, surface_triangles(found.lattice)
    edges = cut_outline(points, faces)
    assert np.isclose(lengths(points, edges).sum(), 2 * (7.5 + 2.5 + 2.5))
    assert np.allclose(points[edges][:, :, 0], 5.0)
