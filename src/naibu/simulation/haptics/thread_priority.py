"""Threads that must act at a given time, such as that which serves a haptic device."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from naibu.core.cores import usable_cores

REST = 0.06  # of the time of a step: what a thread that is scheduled first rests at least; Linux stops for 50 ms what takes 95 % of a core


@contextmanager
def scheduled_first() -> Iterator[bool]:
    """Let the calling thread run before all other programs within the context, where the system permits it.

    A thread of normal priority that wakes on a busy machine waits for the others' share of the processor, several ms on Linux whatever its
    niceness. A thread of the lowest real-time priority (``SCHED_RR``) does not. Linux permits that to the superuser and to those who have a
    limit for it (``ulimit -r``). Threads and processes that the thread starts are of normal priority. Nothing is changed where this
    process may use one core only, since a thread that is late would leave nothing of it to the others.

    Yields
    ------
    bool
        Whether the thread is scheduled first.
    """
    if sys.platform != "linux" or usable_cores() < 2:
        yield False
        return
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(os.sched_get_priority_min(os.SCHED_RR)))
    except OSError:  # not permitted
        yield False
        return
    try:
        yield True
    finally:  # with the flag, which only the superuser may take away
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, priority)
