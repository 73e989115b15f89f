"""A ball that is pressed on an open cut and dragged across it and back, with friction on the ball and between the sides of the cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics.contact.indenter_motion import IndenterVelocity
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, spherical_indenter
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.lip_assembly import LipAssembler, with_lips
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicEngine, DynamicSession, DynamicState
from naibu.mechanics.finite_strain.sessions.quasi_static_session import QuasiStaticEngine
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeEngine, RealTimeSession
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.meshing.cutting.volume import cut_volume
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_faces

SIZE, RADIUS, FRICTION, OF_SIDES, STEP = 20.0, 6.0, 0.3, 0.4, 1.0 / 60.0
SPEED = 12.0  # mm/s
WAY = [(0.0, -1.0)] * 12 + [(1.0, 0.0)] * 30 + [(-1.0, 0.0)] * 30 + [(0.0, 1.0)] * 16  # down 2.4 mm, across by 6, back, and up
MESH = box((SIZE,) * 3, (4, 4, 4), cell_type="tetra", centred=False)
CUT = cut_volume(MESH, swept_blade([[[x, 11.0, SIZE + 1.0], [x, 9.0, 10.0]] for x in (-1.0, SIZE + 1.0)]), SIZE / 4).mesh
LAW = material("neo_hookean", young_modulus=10.0, poisson_ratio=0.3)
PLAIN = Assembler.from_materials(elements(CUT, "standard"), CUT.regions, [LAW])
MADE = with_lips(PLAIN, CUT.points, boundary_faces(CUT).faces, OF_SIDES)
MASS = body_force(PLAIN.elements, np.full(CUT.n_cells, 1e-6), np.array([1.0, 0.0, 0.0]))[:, 0]
FLOOR = np.flatnonzero(CUT.points[:, 2] < 1e-9)


def ball() -> RigidIndenter:
    """It waits 0.2 mm above the body, beside the cut."""
    at = [0.5 * SIZE, 7.5, SIZE + RADIUS + 0.2]
    return spherical_indenter(at, RADIUS, static_friction=FRICTION, kinetic_friction=FRICTION)


@dataclass
class Dragged:
    """What was found in every step."""

    force: FloatArray  # of the ball (steps, 3), mN
    balance: FloatArray  # forces of ball and floor less the change of momentum (steps, 3), mN
    dissipated: FloatArray  # work of the ball less what kinetic and strain energy have grown by, mN mm
    work: FloatArray  # of the ball so far, mN mm
    volume: float  # smallest det F
    closed: list[int]  # pairs of the sides that press
    whole: BoolArray  # steps that were not taken in parts
    session: DynamicSession


def dragged(kind: type[DynamicEngine]) -> Dragged:
    options = {"background": False} if kind is RealTimeEngine else {}
    engine = kind(CUT.points, MADE, MASS, boundary_faces(CUT).faces, step=STEP, **options)
    force, balance, energy, work, volume, closed, whole = [], [], [], [0.0], np.inf, [], []

    def stored(state: DynamicState) -> float:
        return float(PLAIN.forces(state.displacement)[0]) + 0.5 * float((MASS * (state.velocity**2).sum(axis=1)).sum())

    with engine.session(constrained=[FLOOR], indenters=[ball()]) as session:
        for along, down in WAY:
            before, velocity = session.state(), SPEED * np.array([0.0, along, down])
            forces = session.step([[0.0, 0.0, 0.0]], [IndenterVelocity(velocity)])
            after = session.state()
            force.append(forces.indenters[0, 0])
            momentum = (MASS[:, None] * (after.velocity - before.velocity)).sum(axis=0) / STEP
            balance.append(forces.bodies[0, 0] + forces.indenters[0, 0] - momentum)
            work.append(work[-1] + STEP * float(force[-1] @ velocity))
            energy.append(stored(after))
            whole.append(np.allclose(STEP * after.velocity, after.displacement - before.displacement, atol=1e-9))
            volume = min(volume, engine.assembler.forces(after.displacement)[2])
            closed.append(_require_coulomb(engine, before, after))
            if isinstance(session, RealTimeSession):
                pressing = _require_coulomb_on_the_ball(session)
                rubbing = MADE.in_step(before.displacement, before.lips).lips.rubbing(after.displacement)
                told = session.unbalanced * (pressing + rubbing + engine.faint_mn)
                assert np.abs(balance[-1]).sum() <= told + engine.faint_mn
    spent = np.array(work[1:]) - (np.array(energy) - stored(engine.rest()))
    return Dragged(np.array(force), np.array(balance), spent, np.array(work[1:]), volume, closed, np.array(whole), session)


def _require_coulomb(engine: DynamicEngine, before: DynamicState, after: DynamicState) -> int:
    """No pair of the sides pulls, or rubs beyond its limit; returns how many press."""
    stepped = engine.assembler.in_step(before.displacement, before.lips)
    assert isinstance(stepped, LipAssembler) and stepped.lips is not None
    across, traction = stepped.lips.slip_forces(after.displacement)
    assert (across >= 0.0).all()
    assert (np.linalg.norm(traction, axis=1) <= OF_SIDES * across * (1.0 + 1e-9)).all()
    return int(np.count_nonzero(across > 0.0))


def _require_coulomb_on_the_ball(session: RealTimeSession) -> float:
    """The force of no point leaves the cone of friction; returns the sum of their components, mN."""
    (near,) = session._near
    rubbing = near.contact.area * np.linalg.norm(near.response.tangential, axis=1)
    whole = np.linalg.norm(near.response.force, axis=1)
    assert (rubbing <= FRICTION / np.hypot(1.0, FRICTION) * whole * (1.0 + 1e-6) + 1e-9).all()
    return float(np.abs(near.response.force).sum())


@pytest.fixture(scope="module")
def exact() -> Dragged:
    return dragged(DynamicEngine)


@pytest.fixture(scope="module")
def fast() -> Dragged:
    return dragged(RealTimeEngine)


@pytest.mark.parametrize(("name", "left", "divided"), [("exact", 0.02, 0.02), ("fast", 0.05, 0.15)])
def test_momentum_is_balanced_no_element_inverts_and_no_energy_comes_from_nothing(
    name: str, left: float, divided: float, exact: Dragged, request: pytest.FixtureRequest
) -> None:
    """Steps in real time may leave something to the next ones, and tell how much.

    In the few that Newton's method cannot take whole rounding decides what they leave: in one of five draws with noise of 1e-5, over .05.
    """
    found: Dragged = request.getfixturevalue(name)
    most = np.linalg.norm(found.force, axis=1).max()
    unbalanced = np.linalg.norm(found.balance, axis=1)
    assert unbalanced[exact.whole].max() < left * most
    assert unbalanced[~exact.whole].max(initial=0.0) < divided * most
    assert np.median(np.linalg.norm(found.balance, axis=1)) < 0.002 * most
    assert found.volume > 0.2
    assert max(found.closed) > 4  # the sides touch under the ball
    assert np.linalg.norm(found.force[-1]) == 0.0 and most > 100.0
    assert found.dissipated.min() > -0.005 * found.work.max()
    lost = np.maximum.accumulate(found.dissipated) - found.dissipated
    assert lost.max() < 0.02 * found.work.max()  # what the penalties give back where the ball leaves
    assert found.dissipated[-1] > 0.1 * found.work.max()  # friction, and the damping of long steps


def test_in_real_time_the_force_is_that_of_newtons_method_without_a_step_of_it(exact: Dragged, fast: Dragged) -> None:
    assert isinstance(fast.session, RealTimeSession) and fast.session.newton_steps == 0
    apart = np.linalg.norm(fast.force - exact.force, axis=1) / np.linalg.norm(exact.force, axis=1).max()
    # most where the ball leaves, and little of the force is left; where Newton's method takes parts of a step, its force is their mean
    assert apart.max() < 0.2 and apart[exact.whole].max() < 0.1 and np.quantile(apart, 0.9) < 0.02 and np.count_nonzero(~exact.whole) < 6
    assert fast.whole.all()
    there, back = fast.force[12:42, 1], fast.force[42:72, 1]
    assert back[-1] < 0.0 < there[-1]  # it drags the body along


def test_at_rest_on_the_cut_the_force_is_the_static_one_and_in_balance(exact: Dragged) -> None:
    """The same way offline, in steps of a millimetre at most: friction depends on the path, but hardly on its steps."""
    engine = QuasiStaticEngine(CUT.points, MADE, boundary_faces(CUT).faces)
    with engine.session(constrained=[FLOOR], indenters=[ball()]) as session:
        for along, down in [(0.0, -0.6), (0.0, -1.2), (0.0, -1.8), (0.0, -2.4), *((0.5 * k, -2.4) for k in range(1, 13))]:
            found = session.step([[0.0, 0.0, 0.0]], [RigidTransform.of(np.eye(3), (0.0, along, down))])
            pressing = found.indenters[0, 0]
            assert np.linalg.norm(found.bodies[0, 0] + pressing) < 0.01 * np.linalg.norm(pressing)
    np.testing.assert_allclose(pressing, exact.force[41], atol=0.03 * np.linalg.norm(exact.force[41]))
