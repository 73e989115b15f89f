"""One process holds a lock at a time; where locks do not work, work goes on."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from naibu._numba import process_lock
from naibu._numba.process_lock import ProcessLock

HOLD = """
import sys, time
from pathlib import Path
from naibu._numba.process_lock import ProcessLock
with ProcessLock(Path(sys.argv[1]), 10.0):
    print("held", flush=True)
    time.sleep(60.0)
"""


def test_a_lock_excludes_until_it_is_released_and_leaves_no_file(tmp_path: Path) -> None:
    order: list[str] = []

    def second() -> None:
        with ProcessLock(tmp_path / "lock", 30.0):
            order.append("second")

    with ProcessLock(tmp_path / "lock", 30.0):
        other = threading.Thread(target=second)
        other.start()
        time.sleep(0.2)
        order.append("first")
    other.join()
    assert order == ["first", "second"] and list(tmp_path.iterdir()) == []


def test_a_process_that_is_killed_lets_go(tmp_path: Path) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path / "lock")], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    start = time.monotonic()
    with ProcessLock(tmp_path / "lock", 0.3):  # waits in vain, and goes on
        waited = time.monotonic() - start
    holder.kill()
    holder.wait()
    start = time.monotonic()
    with ProcessLock(tmp_path / "lock", 60.0):
        assert time.monotonic() - start < 30.0
    assert waited >= 0.3


def test_an_interruption_releases_it(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), ProcessLock(tmp_path / "lock", 10.0):
        raise KeyboardInterrupt
    with ProcessLock(tmp_path / "lock", 0.0):
        pass
    assert list(tmp_path.iterdir()) == []


def test_work_goes_on_where_no_file_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with ProcessLock(tmp_path / "file" / "lock", 10.0):
        done = True
    assert done


def test_work_goes_on_where_the_file_system_has_no_locks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def unsupported(descriptor: int) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(process_lock, "_take", unsupported)
    start = time.monotonic()
    with ProcessLock(tmp_path / "lock", 10.0):
        assert time.monotonic() - start < 5.0


def on_windows(monkeypatch: pytest.MonkeyPatch) -> tuple[ModuleType, list[int]]:
    """The module as Windows has it, over a lock of bytes that raises what the one there raises."""
    held: list[int] = []

    def locking(descriptor: int, mode: int, count: int) -> None:
        file = os.fstat(descriptor).st_ino
        if mode == 2 and file in held:
            raise PermissionError(13, "Permission denied")
        (held.append if mode == 2 else held.remove)(file)

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(LK_NBLCK=2, LK_UNLCK=0, locking=locking))
    monkeypatch.setattr(sys, "platform", "win32")
    spec = importlib.util.spec_from_file_location("windows_lock", process_lock.__file__)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, held


def test_windows_waits_for_a_lock_that_is_held(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    module, held = on_windows(monkeypatch)
    path = tmp_path / "lock"
    path.touch()
    held.append(path.stat().st_ino)
    threading.Timer(0.3, held.clear).start()
    start = time.monotonic()
    with module.ProcessLock(path, 30.0):
        assert time.monotonic() - start >= 0.25 and held == [path.stat().st_ino]
    assert held == []
