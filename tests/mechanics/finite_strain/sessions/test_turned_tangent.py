"""Tangents that turn with a body, beside those of the body where it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, RealTimeEngine, body_force, elements, material
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.tangents.turned_tangent import TurnedTangents
from naibu.meshing import boundary_faces, box

SIZE, NONE = 40.0, np.zeros(0, np.int64)
TURN = Rotation.from_rotvec([0.1, 0.25, -0.15]).as_matrix()


def engine() -> RealTimeEngine:
    mesh = box((SIZE,) * 3, (3, 3, 3))
    discrete = elements(mesh, "mean_dilatation")
    assembler = Assembler.from_materials(discrete, mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.499)])
    mass = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    return RealTimeEngine(mesh.points, assembler, mass, boundary_faces(mesh).faces, normal_stiffness=2e3, background=False)


def made(session: RealTimeSession, displacement: FloatArray) -> EarlierTangent:
    return session._made(displacement, (), (), NONE, NONE, None, None)


def test_a_tangent_of_a_body_that_has_turned_is_that_of_the_turned_body() -> None:
    model = engine()
    there = model.points @ TURN.T + [3.0, -20.0, 50.0] - model.points
    with model.session() as session:
        assert isinstance(session, RealTimeSession)
        tangent, expected = made(session, np.zeros_like(there)), made(session, there)
        turned = TurnedTangents().of(tangent, model.points, there)
        force = np.random.default_rng(0).normal(size=there.size)
        motion, by_turned, by_earlier = (t.factors.solve(force) for t in (expected, turned, tangent))
        assert np.linalg.norm(by_turned - motion) < 2e-3 * np.linalg.norm(motion)  # factors are in single precision
        assert np.linalg.norm(by_earlier - motion) > 0.05 * np.linalg.norm(motion)


@pytest.mark.parametrize("turn", [np.eye(3), TURN])
def test_a_tangent_stays_where_a_piece_comes_off_a_body_and_turns(turn: FloatArray) -> None:
    """The rotation of the whole is that of none of its parts: behind cuts that free a piece, steps took up to three times as long."""
    model = engine()
    piece = model.points[:, 2] > 0.8 * SIZE
    there = np.where(piece[:, None], model.points @ turn.T + [15.0, 0.0, -5.0] - model.points, 0.0)
    with model.session() as session:
        assert isinstance(session, RealTimeSession)
        tangent = made(session, np.zeros_like(there))
        assert TurnedTangents().of(tangent, model.points, there) is tangent
