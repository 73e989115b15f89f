"""Contacts beside an earlier tangent: derivatives of their forces, and how often they are looked at."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, RealTimeEngine, body_force, elements, material, plane_indenter
from naibu.mechanics.finite_strain.sessions.tangents.contact_beside_tangent import ContactBesideTangent
from naibu.meshing import boundary_faces, box

SIZE = 40.0  # mm


def dragged_over_its_table() -> tuple[FloatArray, FloatArray]:
    """The way of a gel that stands on its table under its weight, and is pulled aside by its top, and the force that it takes."""
    mesh = box((SIZE, SIZE, SIZE), (5, 5, 5))
    discrete = elements(mesh, "mean_dilatation")
    assembler = Assembler.from_materials(discrete, mesh.regions, [material(young_modulus=20.0, poisson_ratio=0.49)])
    weight = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([0.0, 0.0, -9810.0]))
    made = RealTimeEngine(
        mesh.points, assembler, -weight[:, 2] / 9810.0, boundary_faces(mesh).faces, normal_stiffness=1e3, background=False
    )  # fmt: skip
    table = plane_indenter((0.0, 0.0, 0.0), static_friction=0.4, kinetic_friction=0.4)
    session = made.session(external_force=weight, indenters=[table])
    session.step(steps=20)
    top = np.flatnonzero(mesh.points[:, 2] > SIZE - 1e-6)
    session.constrain([top], 1)
    ways, forces = [], []
    for _ in range(15):
        forces.append(session.step((60.0, 0.0, 0.0)).bodies[0, -1])
        ways.append(session.positions())
    return np.array(ways), np.array(forces)


def test_where_points_slip_steps_end_with_the_derivative_of_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its secant alone the contact is looked at more than half as often again, and motion and force are the same."""
    look, looked = ContactBesideTangent.__call__, [0]

    def counted(law: ContactBesideTangent, motion: FloatArray) -> FloatArray:
        looked[-1] += 1
        return look(law, motion)

    monkeypatch.setattr(ContactBesideTangent, "__call__", counted)
    ways, forces = dragged_over_its_table()
    looked.append(0)
    monkeypatch.setattr(ContactBesideTangent, "slips", False)
    expected, force = dragged_over_its_table()
    assert looked[1] > 1.5 * looked[0], looked
    assert np.abs(ways - expected).max() < 0.01 * np.abs(expected[-1] - expected[0]).max()
    np.testing.assert_allclose(forces, force, atol=0.02 * np.abs(force).max())
