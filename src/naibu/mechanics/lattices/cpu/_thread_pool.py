"""Threads that help with the steps of a lattice, and never keep them waiting where another process has taken their core.

A step is cut into jobs, and a job into parts that do not disturb one another. The thread that called works on the parts one by one; helpers
take parts from it where they come in time. It so waits for a part only that a helper has begun, and then, after a short while, asleep, so
that the helper can go on on its core. Where it still had to wait, it works alone for some hundred steps, and longer each time. Sums are
made by parts, in their order: who computed them makes no difference, nor when.

Helpers are Python's threads in kernels without its lock. They spin for a few steps' time, then look again at times, and
go to sleep after some 20 ms without work. Numba's own threads (OpenMP, TBB) are not used, for those of OpenMP wait for one another
spinning, many ms in every job where a core is taken. Only their number is what `LatticeEngine` takes by default, so that
`NUMBA_NUM_THREADS` and `numba.set_num_threads` count here as well.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.extending import intrinsic
from numba.core.typing.templates import signature

from naibu._numba.compilation import njit
from naibu.core.arrays import IntArray

TICKET, DONE, JOB, PARTS, STOP, HELPING, REST, LAST_REST, CALM = (8 * k for k in range(9))  # places in a control, in lines of the cache
MOST_PARTS = 128
_PART = 256  # more than any number of parts; a ticket is this times the number of the job, plus the next part
_SPINS = 100_000  # of some ns each, before a helper looks again only at times
_LOOKS = 200  # of some 100 us each, before it goes to sleep
_PATIENCE = 20_000  # spins before the thread that called sleeps itself, so that the helper that it waits for gets its core
_NAP_US = 50
STALL = 6  # naps in a step after which the team rests: some half ms; the parts themselves differ by less
_LEAST_REST, _MOST_REST = 200, 12_800  # steps
_CALM = 1_000  # steps with helpers and without stall after which the next rest is half as long


def new_control(parts: int) -> IntArray:
    """Return what a thread and its helpers share: a job, its parts, and how many of them are begun and done."""
    control = np.zeros(9 * 8, dtype=np.int64)
    control[PARTS], control[TICKET] = parts, parts
    return control


def _address(context: Any, builder: Any, array_type: Any, array: Any, place: Any) -> Any:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [place])


def _look(typingcontext, array, place):  # type: ignore[no-untyped-def]
    """Return array[place], and see what was written before it was."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load_atomic(_address(context, builder, sig.args[0], args[0], args[1]), "acquire", 8)

    return types.int64(array, types.intp), codegen


def _post(typingcontext, array, place, value):  # type: ignore[no-untyped-def]
    """Set array[place] after all that was written before."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store_atomic(args[2], _address(context, builder, sig.args[0], args[0], args[1]), "release", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), codegen


def _add(typingcontext, array, place, value):  # type: ignore[no-untyped-def]
    """Add to array[place] and return what it was."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.atomic_rmw("add", _address(context, builder, sig.args[0], args[0], args[1]), args[2], "acq_rel")

    return types.int64(array, types.intp, types.int64), codegen


def _swap(typingcontext, array, place, old, new):  # type: ignore[no-untyped-def]
    """Set array[place] to `new` if it is `old`, and return whether it was."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        where = _address(context, builder, sig.args[0], args[0], args[1])
        found = builder.cmpxchg(where, args[2], args[3], "acq_rel", "acquire")
        return builder.zext(builder.extract_value(found, 1), ir.IntType(8))

    return types.uint8(array, types.intp, types.int64, types.int64), codegen


look: Any = intrinsic(_look)
post: Any = intrinsic(_post)
add: Any = intrinsic(_add)
swap: Any = intrinsic(_swap)

if os.name == "posix":
    _sleep: Any = types.ExternalFunction("usleep", signature(types.int32, types.uint32))  # type: ignore[no-untyped-call]

    @njit(cache=True)
    def _nap() -> None:  # pragma: no cover
        _sleep(np.uint32(_NAP_US))

else:

    @njit(cache=True)
    def _nap() -> None:  # pragma: no cover
        pass


@njit(cache=True)
def publish(control, job):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Offer the parts of a job; those of the one before are done."""
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
    """Say that a part is done."""
    add(control, DONE, 1)


@njit(cache=True)
def wait(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Wait for the parts that helpers have begun; return how many naps that took."""
    spins, naps = 0, 0
    while look(control, DONE) < control[PARTS]:
        spins += 1
        if spins > _PATIENCE:
            _nap()
            naps += 1
    return naps


@njit(cache=True)
def judge(control, naps):  # type: ignore[no-untyped-def]  # pragma: no cover
    """After a step that took naps, decide whether helpers are asked in the next ones.

    After a stall, which another process causes that has a helper's core, they are not for `_LEAST_REST` steps, after the next one for more
    than twice as many.
    """
    if naps >= STALL:
        control[LAST_REST] = min(2 * control[LAST_REST] + _LEAST_REST, _MOST_REST)
        control[REST], control[CALM] = control[LAST_REST], 0
    elif control[REST] > 0:
        control[REST] -= 1
    else:
        control[CALM] += 1
        if control[CALM] >= _CALM:
            control[LAST_REST], control[CALM] = control[LAST_REST] // 2, 0


@njit(cache=True)
def expect(control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Wait for a part and take it; return its number, or -1 where there was none for long or the work is over."""
    looks, spins = 0, 0
    while not look(control, STOP):
        part = claim(control)
        if part >= 0:
            return part
        spins += 1
        if spins > _SPINS:
            _nap()
            looks += 1
            if looks > _LOOKS:
                break
    return -1


class _Helper(Thread):
    """A thread that waits for kernels to run."""

    def __init__(self) -> None:
        super().__init__(name="lattice helper", daemon=True)
        self.tasks: SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]]] = SimpleQueue()
        self.start()

    def run(self) -> None:
        while True:
            kernel, arguments = self.tasks.get()
            control = arguments[0]
            try:
                kernel(*arguments)
            finally:
                control[HELPING] -= 1  # under Python's lock, as all that changes it
            del kernel, arguments, control  # hold on to no array while asleep
            _IDLE.append(self)


_IDLE: list[_Helper] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_IDLE.clear)


def lend(kernel: Callable[..., object], control: IntArray, *arguments: Any) -> None:
    """Have helpers run a kernel on a control and more, one for each part but the first, unless the team rests; those still there stay.

    The kernel is compiled without Python's lock and returns when `expect` gives -1.
    """
    if control[REST]:
        return
    for _ in range(int(control[PARTS]) - 1 - int(control[HELPING])):
        control[HELPING] += 1
        try:
            helper = _IDLE.pop()
        except IndexError:
            helper = _Helper()
        helper.tasks.put((kernel, (control, *arguments)))


def dismiss(control: IntArray) -> None:
    """Send the helpers of a control away."""
    control[STOP] = 1
