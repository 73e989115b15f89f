"""Tangents that are kept: which is given up, and which is used."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, IndenterVelocity, RealTimeEngine, body_force, elements, material, plane_indenter
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangents import kept_tangents
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.tangents.kept_tangents import KeptTangents
from naibu.mechanics.linear_algebra.direct import SuperLUSolver
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors
from naibu.meshing import boundary_faces, box


def at(depth: float, held: tuple[int, ...] = ()) -> EarlierTangent:
    """A tangent of two nodes pressed to a depth, mm."""
    solver, none = SuperLUSolver(), np.zeros(0, np.int64)
    factors = UpdatedFactors(solver.factorize(sp.bsr_matrix(np.eye(6), blocksize=(3, 3))), 2)
    factors.prepare(np.array([0]))
    empty = np.zeros((0, 3, 3))
    return EarlierTangent(factors, empty, empty, np.array(held, dtype=np.int64), none, empty, solver, pressed(depth))


def pressed(depth: float) -> FloatArray:
    return np.array([[0.0, 0.0, -depth], [0.0, 0.0, 0.0]])


def test_the_older_of_the_two_that_are_most_alike_is_given_up() -> None:
    kept, made = KeptTangents(), [at(depth) for depth in (0.0, 2.0, 5.0, 5.1, 8.0)]
    assert [kept.keep(tangent) for tangent in made] == [[]] * 5
    assert kept.keep(at(12.0)) == [made[2]]
    assert kept.keep(at(11.5))[0].displacement[0, 2] == -12.0
    assert sorted(-t.displacement[0, 2] for t in kept.drained()) == [0.0, 2.0, 5.1, 8.0, 11.5]
    assert kept.drained() == []


def test_those_that_hold_other_nodes_are_given_up_first() -> None:
    kept, other = KeptTangents(), at(3.0, held=(1,))
    for tangent in (at(0.0), other, at(3.0), at(6.0), at(9.0)):
        kept.keep(tangent)
    assert kept.keep(at(9.1)) == [other]


def test_few_are_kept_where_their_columns_take_much_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    one = at(0.0)
    assert one.factors.column_bytes == 6 * 3 * 4  # three columns of six numbers in single precision
    monkeypatch.setattr(kept_tangents, "MOST_BYTES", 2.5 * one.factors.column_bytes)
    kept, newest = KeptTangents(), at(9.0)
    given_up = [len(kept.keep(tangent)) for tangent in (one, at(5.0), newest)]
    assert given_up == [0, 0, 1]
    monkeypatch.setattr(kept_tangents, "MOST_BYTES", 0.0)
    last = at(20.0)
    assert len(kept.keep(last)) == 2
    assert kept.drained() == [last]  # the newest is never given up


def test_the_newest_of_the_nearest_is_used() -> None:
    kept, held, none, points = KeptTangents(), np.array([1]), np.zeros(0, np.int64), np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 0.0]])
    first, second, third = (at(depth, held=(1,)) for depth in (0.0, 4.0, 8.0))
    for tangent in (second, first):
        kept.keep(tangent)
    assert kept.nearest(points, pressed(1.0), held, 10.0, [third]) is first
    assert kept.nearest(points, pressed(2.2), held, 10.0, [third]) is first  # about as near, and newer
    assert kept.nearest(points, pressed(3.0), held, 10.0, [third]) is second
    assert kept.nearest(points, pressed(7.0), held, 10.0, [third]) is third
    assert kept.nearest(points, pressed(4.0), held, 1e5, [third]) is first  # of a body of 100 m these are one state
    assert kept.nearest(points, pressed(1.0), none, 10.0, [third]) is None
    kept.drop(first)
    assert kept.nearest(points, pressed(1.0), held, 10.0, ()) is second


def test_of_a_body_that_nothing_holds_one_that_has_turned_is_as_near() -> None:
    kept, none, points = KeptTangents(), np.zeros(0, np.int64), np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 0.0]])
    short, long = at(8.0), at(0.0)
    for tangent in (long, short):
        kept.keep(tangent)
    lying = np.array([[19.0, 0.0, 3.0], [0.0, 0.0, 3.0]]) - points  # 19 mm long, as one of them was when it stood
    assert kept.nearest(points, lying, none, 10.0, ()) is long


def test_a_body_whose_tool_leaves_finds_the_tangents_of_the_way_in() -> None:
    """While a plate leaves faster than tangents are renewed, each step uses one of a state nearer than the last one made."""
    size, mesh = 40.0, box((40.0, 40.0, 40.0), (4, 4, 4))
    discrete = elements(mesh, "mean_dilatation")
    assembler = Assembler.from_materials(discrete, mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.49)])
    mass = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    made = RealTimeEngine(mesh.points, assembler, mass, boundary_faces(mesh).faces, background=False)
    plate = plane_indenter((0.0, 0.0, size + 0.1), (0.0, 0.0, -1.0), static_friction=0.3, kinetic_friction=0.3)
    held = [np.flatnonzero(mesh.points[:, 2] < 1e-9)]
    with made.session(constrained=held, indenters=[plate]) as session:
        assert isinstance(session, RealTimeSession)
        for _ in range(40):
            session.step(motions=[IndenterVelocity((0.0, 0.0, -15.0))])
        deepest = np.linalg.norm(session.state().displacement)
        for _ in range(8):
            session.step(motions=[IndenterVelocity((0.0, 0.0, 60.0))])
            assert session._earlier is not None
            now = session.state().displacement
            assert np.linalg.norm(session._earlier.displacement - now) < 0.3 * deepest
        assert np.linalg.norm(now) < 0.35 * deepest
