"""Contact points near a body: their forces are those of the whole contact, in every regime."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics import RigidIndenter, box_indenter, cylindrical_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.contact.indenter_contacts import indenter_contacts
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact, local_positions
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing import boundary_faces, box

SIZE = 30.0
INDENTERS = [
    plane_indenter((0.0, 0.0, SIZE), (0.1, 0.2, -1.0), static_friction=0.3, kinetic_friction=0.3),
    spherical_indenter((2.0, 1.0, SIZE + 6.0), 8.0, static_friction=0.3, kinetic_friction=0.3),
    box_indenter((2.0, 1.0, SIZE + 1.0), (10.0, 14.0, 4.0), static_friction=0.3, kinetic_friction=0.3),
    cylindrical_indenter((2.0, 1.0, SIZE + 1.0), 3.0, 20.0, axis=(1.0, 0.0, 0.3), static_friction=1.0, kinetic_friction=1.0),
]


def displaced(n: int) -> FloatArray:
    return 0.2 * np.random.default_rng(3).standard_normal((n, 3))


@pytest.mark.parametrize("indenter", INDENTERS, ids=[i.geometry.name for i in INDENTERS])
def test_forces_and_gaps_are_those_of_all_points(indenter: RigidIndenter) -> None:
    mesh = box((SIZE, SIZE, SIZE), (6, 6, 6))
    whole = indenter_contacts([indenter], mesh.points, boundary_faces(mesh).faces, normal_stiffness=500.0, tangential_stiffness=90.0)[0]
    u = displaced(mesh.n_points)
    anchors = whole.local(displaced(mesh.n_points)[::-1], 1.0)
    expected = whole.evaluate(u, anchors, 1.0, curvature=False)
    assert 5 < (expected.gap < 0.0).sum() < len(expected.gap)
    near = NearbyContact.of(whole, anchors, local_positions(whole, u, 1.0)[1], 1.0)
    force = np.zeros_like(u)
    near.add_force(u, force)
    np.testing.assert_allclose(force, whole.scattered(expected.force, len(u), expected.orientation), atol=1e-9)
    np.testing.assert_allclose(near.gap, expected.gap[near.points], atol=1e-12)
    np.testing.assert_allclose(near.touching().response.stiffness, expected.stiffness[expected.gap < 0.0], atol=1e-9)


@pytest.mark.parametrize("indenter", INDENTERS, ids=[i.geometry.name for i in INDENTERS])
def test_the_stiffness_is_the_derivative_of_the_forces(indenter: RigidIndenter) -> None:
    """Flat faces have a kernel of their own; points stick, slip and lie beyond edges."""
    mesh = box((SIZE, SIZE, SIZE), (6, 6, 6))
    faces = boundary_faces(mesh).faces
    whole = indenter_contacts([indenter], mesh.points, faces, normal_stiffness=500.0, tangential_stiffness=90.0)[0]
    u, pattern = displaced(mesh.n_points), block_pattern(mesh.n_points, faces)
    still = np.arange(len(whole.nodes))[:, None] % 2 == 0
    anchors = np.where(still, whole.local(u, 1.0), whole.local(u - 20.0 * u[::-1], 1.0))
    near = NearbyContact.of(whole, anchors, local_positions(whole, u, 1.0)[1], 1.0)
    near.add_force(u, np.zeros_like(u))
    response = whole.evaluate(u, anchors, 1.0, curvature=False)
    slips = response.slip_direction[response.gap < 0.0].any(axis=1)
    assert 0 < slips.sum() < len(slips)
    blocks, expected = np.zeros((2, pattern.n_blocks, 3, 3))
    near.add_stiffness(pattern, pattern.positions(whole.nodes), blocks)
    whole.add_stiffness(response, pattern, pattern.positions(whole.nodes), expected)
    np.testing.assert_allclose(blocks, expected, atol=1e-11 * np.abs(expected).max())


def test_the_secant_of_friction_times_the_elastic_slip_is_the_friction() -> None:
    """On a plane, where points slip; where they stick, the secant is the derivative."""
    mesh = box((SIZE, SIZE, SIZE), (4, 4, 4))
    plane = plane_indenter((0.0, 0.0, SIZE - 0.1), (0.0, 0.0, -1.0), static_friction=0.3, kinetic_friction=0.3)
    faces = boundary_faces(mesh).faces
    whole = indenter_contacts([plane], mesh.points, faces, normal_stiffness=500.0, tangential_stiffness=90.0)[0]
    rest = np.zeros_like(mesh.points)
    pattern = block_pattern(mesh.n_points, faces, np.zeros((0, 2), np.int64))
    for slip, slips in ((1e-3, False), (2.0, True)):
        along = np.array([0.6 * slip, 0.8 * slip, 0.0])
        near = NearbyContact.of(whole, whole.local(rest, 1.0) - along @ whole.orientation(1.0), local_positions(whole, rest, 1.0)[1], 0.05)
        force = np.zeros_like(rest)
        near.add_force(rest, force)
        touching = near.touching()
        assert touching.response.slip_direction.any(axis=1).all() == slips
        blocks = np.zeros((pattern.n_blocks, 3, 3))
        touching.add_secant_stiffness(pattern, pattern.positions(whole.nodes), blocks)
        friction = (pattern.matrix(blocks) @ np.tile(along, len(rest))).reshape(-1, 3)
        assert np.abs(force[:, :2]).max() > 0.0
        np.testing.assert_allclose(friction[:, :2], -force[:, :2], atol=1e-9 * np.abs(force).max())
