"""A thread is scheduled first within a context, and only that thread."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from naibu.simulation.haptics import thread_priority
from naibu.simulation.haptics.thread_priority import scheduled_first

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems keep their schedule")


def policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


def test_the_system_says_so_within_the_context_and_not_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_priority, "usable_cores", lambda: 2)
    before, started = policy(), []
    with scheduled_first() as permitted:
        assert policy() == (os.SCHED_RR if permitted else before)
        other = threading.Thread(target=lambda: started.append(policy()))
        other.start()
        other.join()
    assert policy() == before
    assert started == [os.SCHED_OTHER]


def test_one_core_is_left_to_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_priority, "usable_cores", lambda: 1)
    before = policy()
    with scheduled_first() as permitted:
        assert not permitted
        assert policy() == before


def test_what_the_system_refuses_is_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr(thread_priority, "usable_cores", lambda: 2)
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with scheduled_first() as permitted:
        assert not permitted


def test_users_without_the_rights_of_the_superuser_get_their_schedule_back(monkeypatch: pytest.MonkeyPatch) -> None:
    state = [os.SCHED_OTHER]

    def permitted_but_for_the_flag(_: int, wanted: int, __: object) -> None:  # sched_setscheduler(2): EPERM
        if state[0] & os.SCHED_RESET_ON_FORK and not wanted & os.SCHED_RESET_ON_FORK:
            raise PermissionError("Operation not permitted")
        state[0] = wanted

    monkeypatch.setattr(thread_priority, "usable_cores", lambda: 2)
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: state[0])
    monkeypatch.setattr(os, "sched_setscheduler", permitted_but_for_the_flag)
    with scheduled_first() as permitted:
        assert permitted
        assert policy() == os.SCHED_RR
    assert policy() == os.SCHED_OTHER
