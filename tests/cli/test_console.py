"""Progress on the terminal and in a pipe."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from naibu.cli import console
from naibu.core.progress import report_progress


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


def test_a_terminal_gets_a_bar_for_each_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(console, "errors", Console(file=out, width=120, force_terminal=True, color_system=None))
    with console.progress_display() as progress:
        report_progress(progress, "solving", done=1, total=2, objective=5.0)
        report_progress(progress, "writing [bold]")
    shown = out.getvalue()
    assert "solving" in shown and "1 of 2, objective 5" in shown and "writing [bold]" in shown
