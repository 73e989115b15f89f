"""Steps that are taken in parts where their balance is not found: as a session of shorter ones takes them."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics import (
    Assembler,
    DynamicEngine,
    IndenterVelocity,
    RealTimeEngine,
    body_force,
    elements,
    material,
    spherical_indenter,
)
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_strain.sessions import real_time_session
from naibu.mechanics.finite_strain.sessions.divided_session import PARTS
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicSession, DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.trial_displacement import Trial
from naibu.meshing import boundary_faces, box

SIZE = 40.0
DOWN = [IndenterVelocity((0.0, 0.0, -30.0))]


def engine(kind: type[DynamicEngine], **options: bool) -> DynamicEngine:
    mesh = box((SIZE,) * 3, (3, 3, 3))
    discrete = elements(mesh, "mean_dilatation")
    assembler = Assembler.from_materials(discrete, mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.499)])
    mass = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    return kind(mesh.points, assembler, mass, boundary_faces(mesh).faces, normal_stiffness=2e3, **options)


def held(points: FloatArray) -> list[np.ndarray]:
    return [np.flatnonzero(points[:, 2] < 1e-9)]


def without_long_steps(monkeypatch: pytest.MonkeyPatch, longest_s: float) -> None:
    """No balance is found in real time for steps above a length."""
    found = RealTimeSession._quasi_newton

    def some(self: RealTimeSession, moving: FloatArray, contacts: tuple[Contact, ...]) -> Generator[None, None, Trial | None]:
        return (yield from found(self, moving, contacts)) if self._duration <= longest_s else None

    monkeypatch.setattr(RealTimeSession, "_quasi_newton", some)


@pytest.mark.parametrize(("friction", "steps"), [(0.0, 8), (0.3, 6)])  # then points slip, when a tolerance of the balance decides
@pytest.mark.parametrize("parts", PARTS)
def test_parts_are_the_steps_of_a_session_with_shorter_ones(
    monkeypatch: pytest.MonkeyPatch, parts: int, friction: float, steps: int
) -> None:
    made = engine(RealTimeEngine, background=False)
    without_long_steps(monkeypatch, 1.01 * made.step / parts)
    sphere = spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0, static_friction=friction, kinetic_friction=friction)
    shorter = replace(made, step=made.step / parts)
    both = [e.session(constrained=held(made.points), indenters=[sphere]) for e in (made, shorter)]
    with both[0] as session, both[1] as shorts:
        for _ in range(steps):
            forces = session.step(motions=DOWN)
            expected = shorts.step(motions=DOWN, steps=parts)
            moved, fast = np.abs(shorts.positions() - made.points).max(), np.abs(shorts.state().velocity).max()
            np.testing.assert_allclose(session.positions(), shorts.positions(), atol=0.005 * moved)
            np.testing.assert_allclose(session.state().velocity, shorts.state().velocity, atol=0.04 * fast)
            assert forces.indenters[0, 0, 2] == pytest.approx(expected.indenters[:, 0, 2].mean(), rel=0.005)
            assert forces.bodies[0, 0, 2] == pytest.approx(expected.bodies[:, 0, 2].mean(), rel=0.005, abs=1.0)
    assert moved > 1.0
    assert isinstance(session, RealTimeSession)
    assert session.divided_steps == steps and session.newton_steps == 0


@pytest.mark.parametrize("why", ["unsolved", "unforeseen"])
def test_whole_steps_that_lead_nowhere_are_soon_taken_in_parts(monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    """Where contact finds no balance and no share of a step helps, or a trial touches many nodes that a tangent is not prepared for."""
    taken, tries = RealTimeSession._with_contact, []

    def nowhere(self: RealTimeSession, *given: Any) -> Generator[None, None, FloatArray | None]:
        step = yield from taken(self, *given)
        if self._duration == self.engine.step and self._condensed is not None and step is not None:
            tries.append(1)
            self._condensed.balanced, step = False, 0.0 * step
        return step

    made, both = engine(RealTimeEngine, background=False), []
    for hindered in (False, True):
        with monkeypatch.context() as patched:
            if hindered and why == "unsolved":
                patched.setattr(RealTimeSession, "_with_contact", nowhere)
            if hindered and why == "unforeseen":
                patched.setattr(real_time_session, "UNFORESEEN", -1)
                patched.setattr(real_time_session, "UNLIKELY", 0.0)
            with made.session(constrained=held(made.points), indenters=[spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0)]) as session:
                for _ in range(3):
                    session.step(motions=DOWN)
                assert isinstance(session, RealTimeSession) and session.newton_steps == 0
                assert (session.divided_steps > 0) == hindered
                both.append(session.positions())
    assert len(tries) <= 4 * 3  # of each step: two beginnings, with two tangents; there were twice as many
    np.testing.assert_allclose(both[1], both[0], atol=0.1 * np.abs(both[0] - made.points).max())  # shorter steps damp less


def test_iterations_whose_error_stays_end_soon_and_begin_nowhere_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tangent of the step's own finds the balance then: an earlier one that went on, from two beginnings, took ten iterations before."""
    taken, tries = RealTimeSession._with_contact, []

    def unmoved(self: RealTimeSession, tangent: EarlierTangent, *given: Any) -> Generator[None, None, FloatArray | None]:
        step = yield from taken(self, tangent, *given)
        if tangent.displacement is self.reached.displacement or step is None:
            return step
        tries.append(1)
        return 0.0 * step

    made = engine(RealTimeEngine, background=False)
    monkeypatch.setattr(real_time_session, "UNLIKELY", np.inf)
    ends = []
    for hindered in (False, True):
        if hindered:
            monkeypatch.setattr(RealTimeSession, "_with_contact", unmoved)
        with made.session(constrained=held(made.points), indenters=[spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0)]) as session:
            session.step(motions=DOWN, steps=3)
            assert isinstance(session, RealTimeSession) and session.newton_steps == 0 and session.divided_steps == 0
            assert (session.waits > 0) == hindered
            ends.append(session.positions())
    assert session.waits <= len(tries) <= 3 * session.waits
    np.testing.assert_allclose(ends[1], ends[0], atol=0.02 * np.abs(ends[0] - made.points).max())


def test_iterations_of_a_part_end_where_the_error_stays_though_it_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five of them came to the same."""
    made, taken = engine(RealTimeEngine, background=False), RealTimeSession._with_contact
    tries: list[list[DynamicState]] = []

    def unmoved(self: RealTimeSession, *given: Any) -> Generator[None, None, FloatArray | None]:
        step = yield from taken(self, *given)
        if not tries or tries[-1][0] is not self.reached:
            tries.append([])
        tries[-1].append(self.reached)
        return None if step is None else 0.0 * step

    without_long_steps(monkeypatch, 0.5 * made.step)
    monkeypatch.setattr(real_time_session, "ACCEPTED", 1e9)
    monkeypatch.setattr(real_time_session, "UNLIKELY", 1e9)
    monkeypatch.setattr(RealTimeSession, "_with_contact", unmoved)
    with made.session(constrained=held(made.points), indenters=[spherical_indenter((1.0, 2.0, SIZE + 8.05), 8.0)]) as session:
        session.step(motions=DOWN)
        assert isinstance(session, RealTimeSession) and session.divided_steps == 1
    assert max(map(len, tries)) == 2


@pytest.mark.parametrize("budget", [np.inf, 0.0])
def test_newtons_method_seeks_the_balance_of_a_whole_step_once(monkeypatch: pytest.MonkeyPatch, budget: float) -> None:
    """Of a session that a loop steps, and of one that is stepped by itself: that one went on in up to sixteen parts, in vain."""
    sought: list[float] = []

    def nothing(self: RealTimeSession, moving: FloatArray, contacts: tuple[Contact, ...]) -> Generator[None, None, Trial | None]:
        yield
        return None

    def none_found(self: RealTimeSession, h: float, moving: FloatArray, contacts: tuple[Contact, ...]) -> None:
        sought.append(h)

    monkeypatch.setattr(RealTimeSession, "_quasi_newton", nothing)
    monkeypatch.setattr(DynamicSession, "_balanced", none_found)
    made = engine(RealTimeEngine, background=False)
    with made.session(constrained=held(made.points), indenters=[spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0)]) as session:
        assert isinstance(session, RealTimeSession)
        with pytest.raises(ConvergenceError, match="finds no balance of momentum"):
            while session.step_within(budget, motions=DOWN) is None:
                pass
    assert sought == [made.step]


def test_a_step_under_way_shows_the_parts_that_have_been_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are states of a session with as short steps, one after the other; before the first and behind the last there is none."""
    made = engine(RealTimeEngine, background=False)
    without_long_steps(monkeypatch, 0.5 * made.step)
    sphere = spherical_indenter((1.0, 2.0, SIZE + 8.01), 8.0)
    both = [e.session(constrained=held(made.points), indenters=[sphere]) for e in (made, replace(made, step=made.step / PARTS[0]))]
    with both[0] as session, both[1] as shorts:
        assert isinstance(session, RealTimeSession) and session.positions_midway is None
        shown = []
        while session.step_within(0.0, motions=DOWN) is None:
            if (midway := session.positions_midway) is not None and not (shown and np.array_equal(midway, shown[-1])):
                shown.append(midway)
        assert session.positions_midway is None and len(shown) > 1  # parts in which nothing touches need no frame
        ends = []
        for _ in range(PARTS[0]):
            shorts.step(motions=DOWN)
            ends.append(shorts.positions())
    moved = np.abs(ends[-1] - made.points).max()
    apart = np.array([[np.abs(midway - end).max() for end in ends] for midway in shown]) / moved
    assert (apart.min(axis=1) < 0.005).all() and (np.diff(apart.argmin(axis=1)) > 0).all()
    assert apart.argmin(axis=1)[-1] == PARTS[0] - 2


def test_parts_that_are_taken_in_many_calls_are_the_same_and_can_be_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    made = engine(RealTimeEngine, background=False)
    without_long_steps(monkeypatch, 0.5 * made.step)
    ends = []
    for budget in (np.inf, 0.0):
        sphere = spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0)
        with made.session(constrained=held(made.points), indenters=[sphere]) as session:
            assert isinstance(session, RealTimeSession)
            for _ in range(4):
                before = session.positions()
                while session.step_within(budget, motions=DOWN) is None:
                    np.testing.assert_array_equal(session.positions(), before)
            ends.append(session.positions())
            if budget == 0.0:
                for _ in range(12):  # some parts are behind it
                    assert session.step_within(0.0, motions=DOWN) is None
                session.constrain(held(made.points))
                assert not session.under_way
                np.testing.assert_array_equal(session.positions(), ends[-1])
                session.step(motions=[IndenterVelocity((0.0, 0.0, 60.0))])  # contact is found anew
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-12, atol=1e-12)
