"""A run that is killed at any moment goes on, and gives what an undisturbed one gives."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from lattice_studies import STUDY, study_file
from virtual_press import KNOWN, Press

LONGER = STUDY.replace("duration_s = 0.2", "duration_s = 4.0")


def until(seen: Path, command: list[str], extra_s: float) -> None:
    """Start a run, and kill it some time after a file is there."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    waited = time.monotonic() + 300.0
    while not seen.exists() and process.poll() is None and time.monotonic() < waited:
        time.sleep(0.01)
    time.sleep(extra_s)
    process.send_signal(signal.SIGKILL)
    process.wait()


def naibu(*words: object) -> list[str]:
    return [sys.executable, "-m", "naibu", *map(str, words)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_simulations_killed_at_random_moments(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    study, out = study_file(tmp_path, LONGER), tmp_path / "out"
    assert subprocess.run(naibu("simulate", study, "--out", tmp_path / "whole"), check=False, capture_output=True).returncode == 0
    command = naibu("simulate", study, "--out", out, "--checkpoint-every", 3)
    checkpoint, finished = out / "mine.checkpoint.npz", out / "mine.html"
    for _ in range(6):
        until(checkpoint, [*command, *(["--resume"] if checkpoint.exists() else [])], float(rng.uniform(0.0, 3.0)))
        if finished.exists():
            break
    if not finished.exists():
        assert subprocess.run([*command, "--resume"], check=False, capture_output=True).returncode == 0
    with h5py.File(out / "mine.vtkhdf") as found, h5py.File(tmp_path / "whole" / "mine.vtkhdf") as whole:
        for name in ("VTKHDF/PointData/displacement_mm", "VTKHDF/Steps/Values", "naibu/force_mN"):
            assert np.array_equal(found[name][:], whole[name][:])
    assert json.loads((out / "mine.json").read_text()) == json.loads((tmp_path / "whole" / "mine.json").read_text())
    assert sorted(os.listdir(out)) == ["mine.html", "mine.json", "mine.vtkhdf"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_an_identification_killed_at_a_random_moment(press: Press, tmp_path: Path, seed: int) -> None:
    out = tmp_path / "out"
    command = naibu("identify", press.folder, "--known", KNOWN[0], "--state", "press/pressed", "--element-size-mm", 20, "--out", out)
    until(out / "checkpoint.json", command, float(np.random.default_rng(seed).uniform(0.0, 1.0)))
    if not (out / "report.html").exists():
        assert subprocess.run(command, check=False, capture_output=True).returncode == 0
    found = json.loads((out / "identification.json").read_text())
    whole = json.loads((press.results / "identification.json").read_text())
    assert found["load_cases"]["press/pressed"]["rms_3d_mm"] == pytest.approx(whole["load_cases"]["press/pressed"]["rms_3d_mm"], rel=0.02)
    assert not [name for name in os.listdir(out) if name.endswith(".part")]
