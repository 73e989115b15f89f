"""A run that fails before it has written anything leaves no folder for results, whatever its verb; one that was there stays."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from naibu import cli
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.workflows.results.output_folder import output_folder


def code_of(monkeypatch: pytest.MonkeyPatch, *command: str) -> int:
    monkeypatch.setattr(sys, "argv", ["naibu", *command])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0)


@pytest.mark.parametrize("verb", ["sense", "track", "compare-methods"])
def test_scans_of_which_nothing_can_be_told_leave_no_folder(verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    x = np.stack(np.meshgrid(*(np.arange(20) - 9.5,) * 3, indexing="ij"))
    ball = np.linalg.norm(x, axis=0) < 7.0
    values = ball * (100.0 + 10.0 * np.random.default_rng(3).standard_normal(ball.shape))
    write_volume("scan.mha", Volume.from_array(values.astype(np.float32), spacing_mm=(1.0,) * 3))
    write_volume("flat.mha", Volume.from_array(np.zeros(ball.shape, np.float32), spacing_mm=(1.0,) * 3))
    scan = "scan.mha" if verb == "sense" else "flat.mha"  # given twice: nothing moved, no marker, no contrast
    assert code_of(monkeypatch, verb, scan, scan, "--out", "deep/results") == cli.BAD_INPUT
    assert not Path("deep").exists()
    Path("deep").mkdir()
    assert code_of(monkeypatch, verb, scan, scan, "--out", "deep/results") == cli.BAD_INPUT
    assert not list(Path("deep").iterdir())


@pytest.mark.parametrize("error", [InputError("useless"), ConvergenceError("lost"), KeyboardInterrupt(), MemoryError(), RuntimeError()])
def test_however_a_verb_ends(error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run() -> None:
        output_folder(tmp_path / "a" / "empty")
        (output_folder(tmp_path / "b" / "kept") / "half.csv").write_text("1", encoding="utf-8")
        raise error

    monkeypatch.setattr(cli, "_run", run)
    assert code_of(monkeypatch, "any") != 0
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")) == ["b", "b/kept", "b/kept/half.csv"]
