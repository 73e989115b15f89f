"""Sessions against runs of many steps, and what decides whether workers are asked; no test looks at a clock of the machine's."""

from __future__ import annotations

from threading import Thread
from time import sleep

import numpy as np
import pytest

from naibu._numba import thread_pool
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.session import LatticeSession
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, explicit_step_limit

LATTICE = classic_lattice(box_mask((9, 7, 10)), 5.0, total_mass_kg=0.6)
Z = LATTICE.points[:, 2]
CONSTRAINED = ConstrainedNodes.of(np.flatnonzero(Z < 1), 0) + ConstrainedNodes.of(np.flatnonzero(Z > 49), 1, axes=(2, 0))
FEWER = ConstrainedNodes.of(np.flatnonzero(Z < 1), 0)
PUSH = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, -30.0]])
OPTIONS = [{"method": "implicit", "step": 2e-3, "threads": threads} for threads in (1, 2, 3)] + [
    {"method": method, "step": 1e-4, "threads": threads, "precision": precision}
    for method in ("euler", "symplectic_euler")
    for threads in (1, 2, 3)
    for precision in ("double", "single")
]


def engine(**options):
    return LatticeEngine.of(LATTICE, lattice_parameters(LATTICE, 10.0, 0.01, 0.02), **options)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_session_takes_the_steps_of_a_run(options):
    made = engine(**options)
    weight = [0.0, 1e-3, -2e-3]
    with LatticeSession.of(made, constrained=CONSTRAINED, external_force=weight) as session:
        reactions = [session.step(PUSH).bodies[0] for _ in range(12)]
        last = session.step(PUSH, steps=5).bodies
        pushed = session.state()
        session.constrain(FEWER)
        session.step(0.0, steps=8)
        released = session.state()
    first = made.run(made.rest(), 17, CONSTRAINED, PUSH, weight)
    second = made.run(first.state, 8, FEWER, 0.0, weight)
    np.testing.assert_array_equal(reactions, first.reaction[:12])
    np.testing.assert_array_equal(last, first.reaction[12:])
    for ours, own in ((pushed, first.state), (released, second.state)):
        np.testing.assert_array_equal(ours.position, own.position)
        np.testing.assert_array_equal(ours.velocity, own.velocity)
        np.testing.assert_array_equal(ours.extension, own.extension)
    np.testing.assert_array_equal(session.positions([3, 700]), released.position[[3, 700]])
    assert session.steps == 25


def test_sessions_of_one_engine_do_not_disturb_one_another():
    made = engine(step=2e-3)
    alone = made.run(made.rest(), 10, CONSTRAINED, PUSH)
    one, two = LatticeSession.of(made, constrained=CONSTRAINED), LatticeSession.of(made, constrained=FEWER)
    for _ in range(10):
        one.step(PUSH)
        two.step([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(one.state().position, alone.state.position)


@pytest.mark.parametrize("options", [{"method": "euler", "step": 1e-4}, {"method": "implicit", "step": 2e-3}], ids=str)
def test_who_computes_a_part_changes_nothing(options):
    """Runs with workers, and with the pool at rest, give the same to the last bit."""
    found = []
    for alone in (False, True):
        session = LatticeSession.of(engine(**options, threads=4), constrained=CONSTRAINED)
        for _ in range(20):
            session.step(PUSH, steps=10)
            session.stepper.control[thread_pool.ALONE] = 10_000 if alone else 0
        found.append(session.state())
    np.testing.assert_array_equal(found[0].position, found[1].position)
    np.testing.assert_array_equal(found[0].velocity, found[1].velocity)


@pytest.mark.parametrize("constrained", [CONSTRAINED, ConstrainedNodes.none()], ids=["held", "free"])
def test_implicit_steps_in_parts_differ_by_rounding(constrained):
    made = [engine(step=2e-3, threads=threads) for threads in (1, 2, 5)]
    push = PUSH if len(constrained.node) else np.zeros((0, 3))
    one, *more = (e.run(e.rest(), 30, constrained, push, [0.0, 2e-3, -1e-3]) for e in made)
    moved = np.abs(one.state.position - LATTICE.points).max()
    for other in more:
        np.testing.assert_allclose(other.state.position, one.state.position, atol=1e-5 * moved)
        np.testing.assert_allclose(other.reaction, one.reaction, atol=1e-4 * np.abs(one.reaction).max(initial=0.0))
        assert other.iterations == pytest.approx(one.iterations, rel=0.05)


def test_helpers_are_asked_only_while_steps_take_most_of_the_time():
    session = LatticeSession.of(engine(method="euler", step=1e-4, threads=2), constrained=CONSTRAINED)
    asked, now = [], [100.0]

    class Stub:
        def advance(self, velocity, reaction, *, alone=False):
            asked.append(not alone)
            now[0] += 1e-3  # what the call takes
            return 0, 0

    session.stepper, session.clock = Stub(), lambda: now[0]
    for pause in (5.0, 0.9e-3, 0.1e-3, 1.1e-3, 0.0):
        now[0] += pause
        session.step(PUSH)
    assert asked == [False, True, True, False, True]


WINDOW = thread_pool.WINDOW_NS  # longer than any number of steps that a window asks for


def taken(control, alone, together):
    """Take a step whose time is that alone or that together, and return whether it was alone."""
    rests = bool(control[thread_pool.ALONE])
    thread_pool.adapt(control, 10, 0, alone if rests else together)
    return rests


def test_the_faster_way_is_kept_and_the_other_one_tried_rarely():
    """With a free core nearly all steps are taken together; where those take longer, as with one core, nearly all alone."""
    for together, least, most in ((0.6, 0.0, 0.05), (1.6, 0.95, 1.0)):
        control = thread_pool.new_control(2)
        alone = [taken(control, WINDOW, int(together * WINDOW)) for _ in range(8_000)]
        assert least <= np.mean(alone[200:]) <= most
        assert 0 < np.sum(alone[200:]) < len(alone[200:])  # the other way is tried
        turned = [taken(control, WINDOW, int(WINDOW / together)) for _ in range(8_000)]  # a core becomes free, or another process takes it
        assert (np.mean(turned[4_000:]) > 0.5) == (together < 1.0)


def test_a_stall_is_answered_at_once():
    control = thread_pool.new_control(2)
    thread_pool.adapt(control, 10, thread_pool.STALL - 1, WINDOW // 10)
    assert not control[thread_pool.ALONE]
    thread_pool.adapt(control, 10, thread_pool.STALL, 5 * WINDOW)
    assert control[thread_pool.ALONE] == 1  # a window, to know how long steps alone take
    assert [taken(control, WINDOW // 2, 5 * WINDOW) for _ in range(4)] == [True, True, False, False]
    assert control[thread_pool.ALONE] == thread_pool.LEAST_REST


def test_without_a_clock_stalls_tell():
    control = thread_pool.new_control(2)
    rests = []
    for _ in range(4):
        thread_pool.adapt(control, 10, thread_pool.STALL, 0)
        rests.append(int(control[thread_pool.ALONE]))
        while control[thread_pool.ALONE]:
            thread_pool.adapt(control, 10, 0, 0)
    assert rests == [8, 24, 56, 120]


def test_no_worker_is_asked_where_there_is_one_core(monkeypatch):
    monkeypatch.setattr(thread_pool.os, "sched_getaffinity", lambda _: {0}, raising=False)
    with LatticeSession.of(engine(method="euler", step=1e-4, threads=2), constrained=CONSTRAINED) as session:
        session.step(PUSH, steps=20)
        session.step(PUSH, steps=20)
        assert not session.stepper.control[thread_pool.WORKING]


def test_a_helper_that_is_late_is_waited_for_and_stalls_the_team():
    control = thread_pool.new_control(2)
    control[thread_pool.DONE] = 2
    assert nogil_wait(control) == 0  # compiled before the worker begins
    thread_pool.publish(control, 7)
    assert control[thread_pool.JOB] == 7
    assert {thread_pool.claim(control), thread_pool.claim(control)} == {0, 1}
    assert thread_pool.claim(control) == -1
    thread_pool.finish(control)

    def late() -> None:
        sleep(0.05)
        thread_pool.finish(control)

    helper = Thread(target=late)
    helper.start()
    naps = nogil_wait(control)
    helper.join()
    assert control[thread_pool.DONE] == 2
    assert naps >= thread_pool.STALL


@thread_pool.njit(nogil=True)
def nogil_wait(control):
    return thread_pool.wait(control)


def test_parts_are_taken_once_by_many_helpers():
    """A thousand jobs of many parts, each of which counts itself."""
    control, counts = thread_pool.new_control(60), np.zeros(60, dtype=np.int64)
    count_worker(thread_pool.new_control(1) + stopped(), counts)  # compiles
    thread_pool.start_workers(count_worker, control, counts)
    count_parts(control, counts, 1000)
    thread_pool.stop_workers(control)
    np.testing.assert_array_equal(counts, 1000)


def stopped():
    control = np.zeros_like(thread_pool.new_control(1))
    control[thread_pool.STOP] = 1
    return control


@thread_pool.njit(nogil=True)
def count_parts(control, counts, jobs):
    for _ in range(jobs):
        thread_pool.publish(control, 0)
        part = thread_pool.claim(control)
        while part >= 0:
            counts[part] += 1
            thread_pool.finish(control)
            part = thread_pool.claim(control)
        thread_pool.wait(control)


@thread_pool.njit(nogil=True)
def count_worker(control, counts):
    part = thread_pool.next_part(control)
    while part >= 0:
        counts[part] += 1
        thread_pool.finish(control)
        part = thread_pool.next_part(control)


def test_a_session_that_blows_up_says_so():
    parameters = lattice_parameters(LATTICE, 30.0, 0.01, 5.0)
    made = LatticeEngine.of(LATTICE, parameters, step=8.0 * explicit_step_limit(LATTICE, parameters), method="symplectic_euler")
    session = LatticeSession.of(made, constrained=CONSTRAINED)
    with pytest.raises(ConvergenceError, match="implicit"):
        for _ in range(2000):
            session.step(PUSH)
    assert session.steps <= 2000
    with pytest.raises(ConvergenceError, match="diverged"):
        session.state()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s: s.step(np.full((2, 3), np.nan)), "velocity holds 6 NaN"),
        (lambda s: s.step(np.zeros((4, 3))), "velocity has 4 bodies, 2 move nodes"),
        (lambda s: s.step(np.zeros((2, 2))), "do not fit"),
        (lambda s: s.step(PUSH, steps=0), "steps must be at least 1, not 0"),
        (lambda s: s.constrain(ConstrainedNodes.of([10_000])), "the lattice has 0 to"),
        (lambda s: s.constrain(CONSTRAINED + CONSTRAINED), "constrained twice"),
        (lambda s: LatticeSession.of(s.engine, external_force=[np.inf, 0.0, 0.0]), "external_force"),
    ],
)
def test_bad_input_is_named(call, said):
    session = LatticeSession.of(engine(method="euler", step=1e-4), constrained=CONSTRAINED)
    with pytest.raises(InputError) as caught:
        call(session)
    assert said in str(caught.value)
    session.step(PUSH)
