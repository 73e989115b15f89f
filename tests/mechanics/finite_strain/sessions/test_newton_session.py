"""Steps that iterations with an earlier tangent do not solve: when Newton's method is asked."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing

import numpy as np
import pytest
from touched_models import small_mesh

from naibu.core.arrays import FloatArray
from naibu.mechanics.finite_strain.sessions import real_time_session
from naibu.mechanics.finite_strain.sessions.earlier_tangent import EarlierTangent
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeEngine, RealTimeSession
from naibu.mechanics.finite_strain.sessions.tangent_session import TangentSession
from naibu.simulation import FiniteElementBody


def pulled(background: bool) -> tuple[RealTimeSession, FloatArray]:
    """A body that is held below, and a node at its top that is gripped."""
    body = small_mesh().body
    assert isinstance(body, FiniteElementBody) and isinstance(body.engine, RealTimeEngine)
    object.__setattr__(body.engine, "background", background)
    session = body.session()
    assert isinstance(session, RealTimeSession)
    top = int(body.points[:, 2].argmax())
    body.grip(session, np.array([top], dtype=np.int64))
    return session, np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 60.0]])


def stepped(session: RealTimeSession, velocity: FloatArray) -> None:
    while session.step_within(1e-3, velocity) is None:
        pass


def test_a_step_behind_one_that_newtons_method_took_fast_does_not_wait_for_a_tangent(monkeypatch: pytest.MonkeyPatch) -> None:
    """And ends in the same balance as one for which nothing hurries."""
    monkeypatch.setattr(real_time_session, "ACCEPTED", -1.0)
    waited: list[float] = []
    renewed = TangentSession._renewed

    def counted(session: TangentSession) -> Generator[None, None, EarlierTangent]:
        waited.append(session.reached.displacement.max())
        return (yield from renewed(session))

    monkeypatch.setattr(RealTimeSession, "_renewed", counted)
    ends = []
    for pays in (-1.0, 1e9):
        monkeypatch.setattr(real_time_session, "NEWTON_PAYS", pays)
        waited.clear()
        session, velocity = pulled(background=True)
        with closing(session):
            for _ in range(3):
                stepped(session, velocity)
            ends.append(session.state().displacement)
            assert session.newton_steps == 3 and len(waited) == (3 if pays < 0.0 else 1)
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-2 * np.abs(ends[0]).max())
