"""The comparison of commits: ratios with intervals that cover, and what counts as slower; the list of all benchmarks is whole."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", BENCHMARKS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def test_intervals_of_paired_ratios_cover_and_do_not_feel_what_both_feel() -> None:
    guard = module("compare_commits")
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(400):
        load = np.exp(rng.normal(scale=0.7, size=6))  # what else the machine does
        times = load * np.exp(rng.normal(scale=0.05, size=(2, 6)))
        ratio, low, high = guard.paired_ratio(times[0], 1.2 * times[1])
        inside += low <= 1.2 <= high
        assert 0.9 < ratio / 1.2 < 1.1
    assert 0.92 <= inside / 400 <= 0.98


def test_a_commit_is_slower_only_if_the_whole_interval_says_so() -> None:
    guard = module("compare_commits")
    assert guard.verdict(1.12, 1.4, 1.1) == "SLOWER"
    assert guard.verdict(0.8, 0.95, 1.1) == "faster"
    assert guard.verdict(0.98, 1.05, 1.1) == "no slower"
    assert "not decided" in guard.verdict(0.9, 1.5, 1.1)
    assert guard.paired_ratio([1.0], [2.0]) == (2.0, 0.0, float("inf"))


def test_the_list_of_benchmarks_names_programs_that_exist() -> None:
    commands = module("all").COMMANDS
    for quick, whole in commands.values():
        for command in (quick, whole):
            assert command is None or (BENCHMARKS / command.split()[0]).is_file()
        assert quick is None or "--record" not in quick  # small sizes are no record
    recorded = {path.name for path in BENCHMARKS.glob("*.py") if 'add_argument("--record"' in path.read_text(encoding="utf-8")}
    assert recorded == {whole.split()[0] for _, whole in commands.values() if "--record" in whole}


def test_commits_that_do_not_exist_are_told() -> None:
    program = [sys.executable, str(BENCHMARKS / "compare_commits.py"), "no-such-commit", "HEAD", "--rounds", "2"]
    run = subprocess.run(program, capture_output=True, text=True, check=False)
    if "not a git repository" in run.stderr:
        pytest.skip("a copy without its history")
    assert run.returncode == 1 and "no-such-commit" in run.stderr and "Traceback" not in run.stderr
