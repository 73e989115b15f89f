"""Progress on the terminal and in a pipe."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from threading import Thread

import pytest
from rich.console import Console

from naibu.cli.shell import console
from naibu.cli.shell.run_record import recorded_run
from naibu.core.errors import NaibuWarning
from naibu.core.progress import ProgressReport, report_progress


class Clock:
    """Seconds that pass when the test says so."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What is written to stderr where it is a pipe."""
    out = io.StringIO()
    monkeypatch.setattr(console, "errors", Console(file=out, width=160, force_terminal=False))
    return out


def test_a_pipe_gets_a_line_for_each_stage_and_then_at_intervals(stream: io.StringIO) -> None:
    clock = Clock()
    with console.progress_display(clock) as progress:
        report_progress(progress, "reading")
        assert not stream.getvalue()  # what fails at once prints its message alone
        clock.now += 2.0
        report_progress(progress, "identify [1]", done=3, objective=1234.56)
        clock.now += console.INTERVAL_S / 2
        report_progress(progress, "identify [1]", done=4, objective=1000.0)
        clock.now += console.INTERVAL_S
        report_progress(progress, "identify [1]", done=5, objective=999.0)
        report_progress(progress, "writing", done=1, total=4)
    assert stream.getvalue().splitlines() == [
        "identify [1], 3, objective 1235, 2 s",
        "identify [1], 5, objective 999, 10 s",
        "writing, 1 of 4, 25 %, 10 s",
    ]


def test_progress_of_other_threads_obeys_quiet_and_is_logged(stream: io.StringIO, tmp_path: Path) -> None:
    clock = Clock()
    with recorded_run(["demo"]) as run:
        run.quiet = True
        run.log_to(tmp_path / "run.log")
        with console.progress_display(clock) as progress:
            clock.now += 2.0
            thread = Thread(target=report_progress, args=(progress, "without the first experiment"))
            thread.start()
            thread.join()
    assert not stream.getvalue()
    assert "without the first experiment" in (tmp_path / "run.log").read_text(encoding="utf-8")


def test_a_terminal_gets_a_bar_for_each_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(console, "errors", Console(file=out, width=120, force_terminal=True, color_system=None))
    with console.progress_display() as progress:
        report_progress(progress, "solving", done=1, total=2, objective=5.0)
        report_progress(progress, "writing [bold]")
    shown = out.getvalue()
    assert "solving" in shown and "1 of 2, 50 %, objective 5" in shown and "writing [bold]" in shown


def test_the_time_left_follows_from_the_share_done_since_the_stage_began() -> None:
    left = console.TimeLeft()
    stages = [("a", 0.2, 10.0), ("a", 0.4, 20.0), ("b", 0.0, 21.0), ("b", None, 22.0), ("b", 0.1, 121.0)]
    told = [left.after(ProgressReport(stage, share, None if share is None else 1.0), now) for stage, share, now in stages]
    assert told == ["", "about 30 s left", "", "", "about 15 min left"]


def test_warnings_are_told_without_their_place_in_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    out, others = io.StringIO(), []
    monkeypatch.setattr(console, "console", Console(file=out, width=160, force_terminal=False))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", lambda message, *_: others.append(str(message)))
        with console.told_warnings():
            warnings.warn("a.nii: its forms [0] contradict each other", NaibuWarning, stacklevel=1)
            warnings.warn("of another package", RuntimeWarning, stacklevel=1)
        warnings.warn("told outside", NaibuWarning, stacklevel=1)
    assert out.getvalue() == "a.nii: its forms [0] contradict each other\n"
    assert others == ["of another package", "told outside"]
