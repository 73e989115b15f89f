"""A thread pool for the steps of a lattice, which never waits for a worker whose core another process has taken.

A step is cut into jobs, and a job into independent parts. The calling thread works on the parts one by one; workers take parts from it
where they come in time. The caller waits only for parts that a worker has begun, spinning at first and then asleep, so that the worker can
get its core back. Time is taken of steps with workers and without, in turn, and those that are slower become rare: where only one core is
free, the caller soon works alone. Sums are made by parts in their order, so results do not depend on which thread computed what.

Workers are Python threads in kernels that release the global interpreter lock. They spin for the time of a few steps, then look at
intervals, and go to sleep after some 20 ms without work. Numba's own threads (OpenMP, TBB) are not used: OpenMP threads spin while they
wait for one another, many ms in every job where a core is taken. Only their number is the default of `LatticeEngine`, so that
``NUMBA_NUM_THREADS`` and `numba.set_num_threads` count here as well.

Where this Numba has no atomic operations for us (`ATOMIC` is False), the calling thread does all parts.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np

from naibu._numba.compilation import njit
from naibu._numba.intrinsics.atomics import ATOMIC, add, look, nap, post, relax, swap, ticks
from naibu.core.arrays import IntArray
from naibu.core.cores import usable_cores

# indices into a control, one cache line each
TICKET, DONE, JOB, PARTS, STOP, WORKING, IDLE, LONE, NAPS, BEGAN = (8 * k for k in range(10))
# of the choice whether to work alone: windows left alone, those of the last time, windows together and from how many on one alone is tried;
# steps, work and time in this window; time for a unit of work alone and together, 0 where it is not known
ALONE, REST, CALM, TRY, STEPS, WORK, SPENT, RATE_ALONE, RATE_TOGETHER = (8 * k for k in range(10, 19))
MOST_PARTS = 128
_PART = 256  # more than any number of parts; a ticket is this times the number of the job, plus the next part
_SPINS = 10_000  # of some 20 ns each, before a worker looks only at intervals
_LOOKS = 200  # of some 100 us each, before it goes to sleep
_PATIENCE = 1_000  # spins before the calling thread sleeps, so that the worker that it waits for gets its core
_NAP_US = 50
STALL = 6  # naps in a step after which the choice is made at once: some half ms; the parts themselves differ by less
WINDOW_NS, _WINDOW_STEPS = 1_000_000, 2  # least time and steps between two choices
_STEPS_WITHOUT_CLOCK = 200  # between two choices where there is no clock; then only stalls tell
_FIRST_TRY, LEAST_REST, MOST_WINDOWS = 16, 8, 512  # windows
_UNIT = 16.0  # of the times of a unit of work, in 1/ns, for whole numbers


def new_control(parts: int) -> IntArray:
    """Return the shared state of a caller and its workers: the job, its number of parts, and how many are begun and done."""
    control = np.zeros(19 * 8, dtype=np.int64)
    control[PARTS], control[TICKET], control[TRY] = parts, parts, _FIRST_TRY
    return control


@njit(cache=True)
def publish(control, job):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Offer the parts of a job; the one before is done."""
    control[JOB] = job
    post(control, DONE, 0)
    post(control, TICKET, (control[TICKET] // _PART + 1) * _PART)


@njit(cache=True)
def claim(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the next part of the job and return its number, or -1 if none is left."""
    while True:
        ticket = look(control, TICKET)
        part = ticket % _PART
        if part >= control[PARTS]:
            return -1
        if swap(control, TICKET, ticket, ticket + 1):
            return part


@njit(cache=True)
def finish(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Count a part as done."""
    add(control, DONE, 1)


@njit(cache=True)
def wait(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Wait for the parts that workers have begun; return how many naps that took."""
    spins, naps = 0, 0
    while look(control, DONE) < control[PARTS]:
        spins += 1
        relax()
        if spins > _PATIENCE:
            nap(_NAP_US)
            naps += 1
    return naps


@njit(cache=True)
def first_part(control, job):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Begin a job as its caller; return the first part to do, or -1 if workers have all."""
    control[LONE] = control[PARTS] == 1 or control[ALONE] > 0 or control[IDLE] > 0 or control[WORKING] == 0
    if control[LONE]:
        return 0
    publish(control, job)
    return claim(control)


@njit(cache=True)
def following_part(control, part):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the caller's part after one that it has done, or -1 if none is left."""
    if control[LONE]:
        return part + 1 if part + 1 < control[PARTS] else -1
    finish(control)
    return claim(control)


@njit(cache=True)
def end_job(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Wait until all parts of the caller's job are done."""
    if not control[LONE]:
        control[NAPS] += wait(control)


@njit(cache=True)
def begin_step(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the time at which a step begins."""
    if control[PARTS] > 1:
        control[BEGAN] = ticks()


@njit(cache=True)
def end_step(control, work):  # type: ignore[no-untyped-def]  # pragma: no cover
    """After a step of so much work, a whole number in any unit, decide whether workers take part in the next ones."""
    naps = control[NAPS]
    control[NAPS] = 0
    if control[PARTS] > 1 and not control[IDLE]:
        adapt(control, work, naps, ticks() - control[BEGAN])


@njit(cache=True)
def adapt(control, work, naps, spent):  # type: ignore[no-untyped-def]  # pragma: no cover
    """After a step of so much work, naps and time, ns, decide whether workers take part in the next steps.

    Steps are taken together; from time to time, and after a stall, a window of them alone, for comparison. Where those together take
    longer, the caller works alone for `LEAST_REST` windows, after the next time for more than twice as many.
    """
    control[STEPS] += 1
    control[WORK] += work
    control[SPENT] += spent
    stalled, timed = naps >= STALL, control[SPENT] > 0
    enough = control[STEPS] >= _WINDOW_STEPS and control[SPENT] >= WINDOW_NS if timed else control[STEPS] >= _STEPS_WITHOUT_CLOCK
    if not enough and not (stalled and control[ALONE] == 0):
        return
    rate = np.int64(_UNIT * control[SPENT] / control[WORK])
    control[STEPS], control[WORK], control[SPENT] = 0, 0, 0
    if control[ALONE] > 0:
        control[RATE_ALONE] += (rate - control[RATE_ALONE]) // (4 if control[RATE_ALONE] else 1)
        control[ALONE] -= 1
        return
    control[RATE_TOGETHER] += (rate - control[RATE_TOGETHER]) // (4 if control[RATE_TOGETHER] else 1)
    control[CALM] += 1
    slower = control[RATE_TOGETHER] > control[RATE_ALONE] if timed else stalled
    if slower and (control[RATE_ALONE] or not timed):
        control[REST] = min(2 * control[REST] + LEAST_REST, MOST_WINDOWS)
        control[ALONE], control[RATE_TOGETHER], control[CALM] = control[REST], 0, 0
    elif (stalled and control[RATE_ALONE] == 0) or control[CALM] >= control[TRY]:
        control[TRY] = min(2 * control[TRY], MOST_WINDOWS)
        control[ALONE], control[REST], control[CALM] = 1, control[REST] // 2, 0


@njit(cache=True)
def next_part(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Wait for a part and take it; return its number, or -1 after long without one or once the workers are stopped."""
    looks, spins = 0, 0
    while not look(control, STOP):
        part = claim(control)
        if part >= 0:
            return part
        spins += 1
        relax()
        if spins > _SPINS or look(control, ALONE):
            nap(_NAP_US)
            looks += 1
            if looks > _LOOKS:
                break
    return -1


class _Worker(Thread):
    """A thread that waits for kernels to run."""

    def __init__(self) -> None:
        super().__init__(name="lattice worker", daemon=True)
        self.tasks: SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]]] = SimpleQueue()
        self.start()

    def run(self) -> None:
        while True:
            kernel, arguments = self.tasks.get()
            control = arguments[0]
            try:
                kernel(*arguments)
            finally:
                control[WORKING] -= 1  # under the global interpreter lock, as everything that changes it
            del kernel, arguments, control  # keep no array alive while asleep
            _IDLE.append(self)


_IDLE: list[_Worker] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_IDLE.clear)


def start_workers(kernel: Callable[..., object], control: IntArray, *arguments: Any) -> None:
    """Let workers run ``kernel(control, *arguments)``, one for each part but the first; those that still run it count.

    The kernel releases the global interpreter lock and returns when `next_part` gives -1. Nothing starts while the caller works alone, nor
    where this process may use one core only.
    """
    if control[ALONE] or control[IDLE] or not ATOMIC or _one_core():
        return
    for _ in range(int(control[PARTS]) - 1 - int(control[WORKING])):
        control[WORKING] += 1
        try:
            worker = _IDLE.pop()
        except IndexError:
            worker = _Worker()
        worker.tasks.put((kernel, (control, *arguments)))


def _one_core() -> bool:
    return usable_cores() == 1


def stop_workers(control: IntArray) -> None:
    """Let the workers of a control return."""
    control[STOP] = 1
