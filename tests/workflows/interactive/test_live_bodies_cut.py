"""Bodies that are loaded when they are cut, and whose sides rub then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.mechanics.finite_strain.lip_assembly import LipAssembler, with_multipliers
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeEngine
from naibu.simulation import FiniteElementBody, InteractiveSimulation
from naibu.workflows import touchable


@pytest.mark.slow
@pytest.mark.parametrize("prepared", [False, True], ids=["at once", "prepared"])
def test_gels_that_are_cut_right_through_under_their_weight_go_on_with_friction(prepared: bool) -> None:
    """The whole weight comes to bear on pairs none of which pressed before, for which Newton's method alone finds no balance."""
    body = touchable("demo").body
    assert isinstance(body, FiniteElementBody) and isinstance(body.engine, RealTimeEngine)
    simulation = InteractiveSimulation(replace(body, lips_friction=0.4), {})
    frames = [simulation.advance() for _ in range(40)]
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    middle = 0.5 * (low[2] + high[2])
    blade = [[[x, low[1] - 30.0, middle + 2.0], [x, high[1] + 30.0, middle - 2.0]] for x in (low[0] - 30.0, high[0] + 30.0)]
    if prepared:
        simulation.begin_cut(blade)
        assert simulation.finish_cut(wait=True)
    else:
        simulation.cut(blade)
    frames = [simulation.advance() for _ in range(60)]
    simulation.close()
    assert not any(frame.failed for frame in frames)
    now = simulation.body
    assert isinstance(now, FiniteElementBody) and isinstance(now.engine.assembler, LipAssembler)
    state = simulation._session.state()
    stepped = with_multipliers(now.engine.assembler, state.multipliers)
    assert isinstance(stepped, LipAssembler)
    stepped = stepped.in_step(state.displacement, state.lips)
    assert stepped.lips is not None
    across, traction = stepped.lips.slip_forces(state.displacement)
    above = now.engine.points[:, 2] > middle + 2.0
    assert across.sum() == pytest.approx(9810.0 * now.engine.mass[above].sum(), rel=0.3)
    assert (np.linalg.norm(traction, axis=1) <= 0.4 * across * 1.005 + 1e-9).all()
