"""What a session in real time gives up, and when: iterations, the contact of one of them, and the body at rest as a beginning."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, IndenterVelocity, RealTimeEngine, body_force, elements, material, spherical_indenter
from naibu.mechanics.finite_strain.sessions import real_time_session, tangent_session
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangents import condensed_contact
from naibu.mechanics.finite_strain.sessions.tangents.condensed_contact import CondensedContact
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.trial_displacement import Trial
from naibu.mechanics.linear_algebra.updated_factors import ChangedInverse
from naibu.meshing import boundary_faces, box

SIZE = 40.0
STEPS = 6


@dataclass
class Clock:
    """Time of the processor, in a module, that passes only where a test says so, s."""

    now: float = 0.0

    def thread_time(self) -> float:
        return self.now


def engine(*, background: bool) -> RealTimeEngine:
    mesh = box((SIZE,) * 3, (3, 3, 3))
    discrete = elements(mesh, "mean_dilatation")
    assembler = Assembler.from_materials(discrete, mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.499)])
    mass = body_force(discrete, np.full(mesh.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
    return RealTimeEngine(mesh.points, assembler, mass, boundary_faces(mesh).faces, normal_stiffness=2e3, background=background)


def pressed(made: RealTimeEngine, steps: int = STEPS) -> RealTimeSession:
    """A session in which a sphere has pressed a block that is held below, for so many steps; closed."""
    sphere = spherical_indenter((1.0, 2.0, SIZE + 8.2), 8.0, static_friction=0.3, kinetic_friction=0.3)
    with made.session(constrained=[np.flatnonzero(made.points[:, 2] < 1e-9)], indenters=[sphere]) as session:
        for _ in range(steps):
            session.step(motions=[IndenterVelocity((0.0, 0.0, -30.0))])
    assert isinstance(session, RealTimeSession)
    return session


@pytest.mark.parametrize(("tangent_s", "most"), [(0.0, 1), (0.06, 2), (10.0, 3)])
def test_iterations_of_a_live_step_are_given_up_after_a_quarter_of_a_second(
    monkeypatch: pytest.MonkeyPatch, tangent_s: float, most: int
) -> None:
    """Each takes a tenth of one here: twice the time of a tangent, but no more; runs that are repeatable look at no clock."""
    clock, made, taken = Clock(), RealTimeSession._made, RealTimeSession._with_contact
    tries: list[list[tuple[EarlierTangent, DynamicState]]] = []

    def unmoved(self: RealTimeSession, tangent: EarlierTangent, *given: Any) -> Generator[None, None, FloatArray | None]:
        step = yield from taken(self, tangent, *given)
        if self._duration < self.engine.step or step is None:
            return step
        clock.now += 0.1
        if not tries or tries[-1][0][0] is not tangent or tries[-1][0][1] is not self.reached:
            tries.append([])
        tries[-1].append((tangent, self.reached))
        return 0.0 * step

    def timed(self: RealTimeSession, *given: Any) -> EarlierTangent:
        return replace(made(self, *given), seconds=tangent_s)

    monkeypatch.setattr(real_time_session, "time", clock)
    monkeypatch.setattr(real_time_session, "UNMOVED", -1.0)
    monkeypatch.setattr(real_time_session, "UNLIKELY", np.inf)
    monkeypatch.setattr(RealTimeSession, "_made", timed)
    monkeypatch.setattr(RealTimeSession, "_with_contact", unmoved)
    session = pressed(engine(background=True))
    assert session.divided_steps > 0 and session.newton_steps == 0
    assert max(map(len, tries)) <= most
    tries.clear()
    pressed(engine(background=False))
    assert max(map(len, tries)) > 3


def test_the_contact_of_an_iteration_of_a_part_is_sought_for_a_twentieth_of_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each matrix takes a fiftieth of one here, and no motion is good enough: three, and one with nodes held back."""
    clock, forces, matrix = Clock(), CondensedContact.forces, ChangedInverse.of
    counts: list[int] = []

    def factorized(*given: Any) -> ChangedInverse:
        clock.now += 0.02
        counts[-1] += 1
        return matrix(*given)

    def counted(self: CondensedContact, *given: Any) -> Generator[None, None, FloatArray]:
        counts.append(0)
        return (yield from forces(self, *given))

    found = RealTimeSession._quasi_newton

    def in_parts(self: RealTimeSession, *given: Any) -> Generator[None, None, Trial | None]:
        return (yield from found(self, *given)) if self._duration < self.engine.step else None

    for module in (real_time_session, condensed_contact):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(condensed_contact._Search, "_consistent", lambda *_: False)
    monkeypatch.setattr(condensed_contact._Floor, "reached", lambda *_: False)
    monkeypatch.setattr(ChangedInverse, "of", factorized)
    monkeypatch.setattr(CondensedContact, "forces", counted)
    monkeypatch.setattr(RealTimeSession, "_quasi_newton", in_parts)
    session = pressed(engine(background=True), 2)
    assert session.divided_steps > 0 and 3 <= max(counts) <= 4
    counts.clear()
    pressed(engine(background=False), 2)
    assert max(counts) > 8


def test_the_body_at_rest_is_not_begun_from_for_a_while_where_that_led_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it did, it was tried in every step that begins far from balance."""
    at_rest, improved = RealTimeSession._at_rest, RealTimeSession._improved
    begun: list[int] = []

    def nearer(self: RealTimeSession, kept: EarlierTangent, *given: Any) -> Trial | None:
        found = at_rest(self, kept, *given)
        if found is None or kept is self._earlier:
            return None
        begun.append(self.iterations)
        return replace(found, error=1.01 * real_time_session.UNLIKELY)

    def nowhere(self: RealTimeSession, tangent: EarlierTangent, *given: Any) -> Generator[None, None, Trial | None]:
        return None if any(tangent is kept for kept in self._engine._rest) else (yield from improved(self, tangent, *given))

    monkeypatch.setattr(tangent_session, "PERIOD", 1)
    monkeypatch.setattr(real_time_session, "UNLIKELY", real_time_session.ACCEPTED)
    monkeypatch.setattr(RealTimeSession, "_at_rest", nearer)
    monkeypatch.setattr(RealTimeSession, "_improved", nowhere)
    tries = []
    for vain in (real_time_session.VAIN, 0):
        monkeypatch.setattr(real_time_session, "VAIN", vain)
        begun.clear()
        pressed(engine(background=False), 10)
        tries.append(len(begun))
    assert tries[0] == 1 and tries[1] > 4
