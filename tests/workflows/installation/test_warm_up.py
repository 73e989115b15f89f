"""The problems that compile all kernels can be solved, and compile them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from naibu._numba.reports import report
from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.workflows.installation import warm_up as module
from naibu.workflows.installation.warm_up import warm_up


def test_every_problem_is_solved() -> None:
    stages: list[str] = []
    done = warm_up(lambda progress: stages.append(progress.stage.split(":")[0]))
    assert done.failed == ()
    wanted = {"identify", "predict", "track", "track-sequence", "sense, default", "simulate, implicit", "simulate, explicit", "live"}
    assert wanted <= set(stages)


def test_kernels_are_counted_and_problems_that_fail_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def compiles() -> None:
        for _ in range(2):
            report("naibu.kernel", False)
            report("naibu.kernel", True)

    def fails() -> None:
        raise InputError("no such file")

    monkeypatch.setattr(module, "_problems", lambda folder: {"first": fails, "second": compiles})
    reports: list[ProgressReport] = []
    done = warm_up(reports.append)
    assert (done.kernels, done.failed) == (2, ("first: no such file",))
    assert reports[-1] == ProgressReport("second: naibu.kernel", 2)


@pytest.mark.slow
def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from naibu.workflows.installation.warm_up import warm_up; print(warm_up().kernels)"]
    counts = []
    for _ in range(2):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        counts.append(int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout))
    assert counts[0] > 100 and counts[1] == 0
