"""The first run of a verb says that it compiles, and stops at once when it is told to."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

from naibu import cli
from naibu._numba.reports import report
from naibu.cli.shell import cold_start
from naibu.cli.shell.cold_start import SECONDS, CompilationNotice, first_run
from naibu.workflows.installation import warm_up


def plain_console() -> Console:
    return Console(file=io.StringIO(), width=200)


def printed(console: Console) -> list[str]:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


def test_what_needs_no_compilation_says_nothing_and_changes_nothing() -> None:
    console, before = plain_console(), signal.getsignal(signal.SIGTERM)
    threads = threading.active_count()
    with first_run("identify", console):
        assert threading.active_count() == threads + 1
    assert printed(console) == []
    assert signal.getsignal(signal.SIGTERM) is before and threading.active_count() == threads
    assert signal.set_wakeup_fd(-1) == -1


def test_compilations_are_announced_at_once_and_then_every_few_seconds() -> None:
    console, now = plain_console(), [0.0]
    notice = CompilationNotice("sense", console, lambda: now[0])
    notice("naibu.a", False)
    first = printed(console)
    assert len(first) == 1 and "first time" in first[0] and f"about {SECONDS['sense']} s" in first[0]
    for _ in range(4):  # a kernel within another, three seconds each
        notice("naibu.b", False)
        now[0] += 3.0
        notice("naibu.b", True)
    notice("naibu.a", True)
    assert printed(console)[1:] == ["compiling kernels, 2 done, 6 s: b", "compiling kernels, 4 done, 12 s: b"]
    assert notice.depth == 0


def test_only_compilations_within_the_context_are_announced() -> None:
    console = plain_console()
    with first_run("track", console):
        report("naibu.a", False)
        report("naibu.a", True)
    report("naibu.b", False)
    assert len(printed(console)) == 1


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_compilation_within_two_seconds(number: signal.Signals, code: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "naibu", "identify", "ct_two_material_1", "--known", "hardness 5=222 kPa", "--element-size-mm", "25"]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "naibu", "--version"], check=True, capture_output=True)
    busy = time.monotonic() - began  # what starting and ending a process takes here and now
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "out")], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        while "compiling kernels for the first time" not in (line := process.stderr.readline()):
            assert line, "the verb ended without a compilation"
        time.sleep(2.0)
        sent = time.monotonic()
        process.send_signal(number)
        _, message = process.communicate(timeout=60)
        took = time.monotonic() - sent
    finally:
        process.kill()
    assert process.returncode == code and "Traceback" not in message, message
    assert took < 2.0 + busy
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert all(path.suffix in (".nbc", ".lock") for path in (tmp_path / "cache").rglob("*") if path.is_file())


@pytest.mark.parametrize(("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_a_signal_is_raised_once_the_compilation_has_ended(
    number: signal.Signals, kind: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """LLVM may crash where something is raised in its callbacks."""
    monkeypatch.setattr(cold_start, "PATIENCE_S", 600.0)
    reached = []
    with pytest.raises(kind), first_run("identify", Console(file=io.StringIO())):
        report("naibu.kernel", False)
        signal.raise_signal(number)
        time.sleep(0.1)
        reached.append("compiled")
        report("naibu.kernel", True)
        began = time.monotonic()
        try:
            time.sleep(60.0)
        finally:
            waited = time.monotonic() - began
        reached.append("too late")
    assert reached == ["compiled"]
    assert waited < 30.0  # the signal ends what the main thread waits for
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_doctor_compiles_everything_when_asked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", "doctor", "--warm"])
    monkeypatch.setattr(cli, "doctor_rows", list)
    monkeypatch.setattr(warm_up, "warm_up", lambda progress: warm_up.WarmUp(12, 34.2, ()))
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    assert "12 kernels compiled in 34 s" in capsys.readouterr().out
    monkeypatch.setattr(warm_up, "warm_up", lambda progress: warm_up.WarmUp(0, 3.0, ("track: no markers",)))
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    said = capsys.readouterr().out
    assert "All kernels were compiled already" in said and "not warmed up: track: no markers" in said
