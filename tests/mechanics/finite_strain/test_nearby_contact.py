"""Contact points near a body: their forces are those of the whole contact, in every regime."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics import RigidIndenter, box_indenter, cylindrical_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.contact.indenter_contacts import indenter_contacts
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact, local_positions
from naibu.meshing import boundary_faces, box

SIZE = 30.0
INDENTERS = [
    plane_indenter((0.0, 0.0, SIZE), (0.1, 0.2, -1.0), static_friction=0.3, kinetic_friction=0.3),
    spherical_indenter((2.0, 1.0, SIZE + 6.0), 8.0, static_friction=0.3, kinetic_friction=0.3),
    box_indenter((2.0, 1.0, SIZE + 1.0), (10.0, 14.0, 4.0)),
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
