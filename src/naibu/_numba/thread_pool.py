"""A thread pool for the steps of a lattice, which never waits for a worker whose core another process has taken.

A step is cut into jobs, and a job into independent parts. The calling thread works on the parts one by one; workers take parts from it
where they come in time. The caller waits only for parts that a worker has begun, spinning at first and then asleep, so that the worker can
get its core back. After such a stall the caller works alone for some hundred steps, and longer after each further stall. Sums are made by
parts in their order, so results do not depend on which thread computed what.

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

from naibu._numba.atomics import ATOMIC, add, look, nap, post, swap
from naibu._numba.compilation import njit
from naibu.core.arrays import IntArray

TICKET, DONE, JOB, PARTS, STOP, WORKING, ALONE, LAST_ALONE, CALM = (8 * k for k in range(9))  # indices into a control, one cache line each
MOST_PARTS = 128
_PART = 256  # more than any number of parts; a ticket is this times the number of the job, plus the next part
_SPINS = 100_000  # of some ns each, before a worker looks only at intervals
_LOOKS = 200  # of some 100 us each, before it goes to sleep
_PATIENCE = 20_000  # spins before the calling thread sleeps, so that the worker that it waits for gets its core
_NAP_US = 50
STALL = 6  # naps in a step after which the caller works alone: some half ms; the parts themselves differ by less
_LEAST_ALONE, _MOST_ALONE = 200, 12_800  # steps
_CALM = 1_000  # steps with workers and without stall after which the next time alone is half as long


def new_control(parts: int) -> IntArray:
    """Return the shared state of a caller and its workers: the job, its number of parts, and how many are begun and done."""
    control = np.zeros(9 * 8, dtype=np.int64)
    control[PARTS], control[TICKET] = parts, parts
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
        if spins > _PATIENCE:
            nap(_NAP_US)
            naps += 1
    return naps


@njit(cache=True)
def adapt(control, naps):  # type: ignore[no-untyped-def]  # pragma: no cover
    """After a step that took so many naps, decide whether workers take part in the next steps.

    After a stall (another process has a worker's core) the caller works alone for `_LEAST_ALONE` steps, after the next stall for more than
    twice as many.
    """
    if naps >= STALL:
        control[LAST_ALONE] = min(2 * control[LAST_ALONE] + _LEAST_ALONE, _MOST_ALONE)
        control[ALONE], control[CALM] = control[LAST_ALONE], 0
    elif control[ALONE] > 0:
        control[ALONE] -= 1
    else:
        control[CALM] += 1
        if control[CALM] >= _CALM:
            control[LAST_ALONE], control[CALM] = control[LAST_ALONE] // 2, 0


@njit(cache=True)
def next_part(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Wait for a part and take it; return its number, or -1 after long without one or once the workers are stopped."""
    looks, spins = 0, 0
    while not look(control, STOP):
        part = claim(control)
        if part >= 0:
            return part
        spins += 1
        if spins > _SPINS:
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

    The kernel releases the global interpreter lock and returns when `next_part` gives -1. Nothing starts while the caller works alone.
    """
    if control[ALONE] or not ATOMIC:
        return
    for _ in range(int(control[PARTS]) - 1 - int(control[WORKING])):
        control[WORKING] += 1
        try:
            worker = _IDLE.pop()
        except IndexError:
            worker = _Worker()
        worker.tasks.put((kernel, (control, *arguments)))


def stop_workers(control: IntArray) -> None:
    """Let the workers of a control return."""
    control[STOP] = 1
