"""Errors that are nobody's input end with one message, a log and the right exit code; never with a traceback."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from naibu import cli
from naibu.cli import installation
from naibu.workflows.installation import self_test


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["naibu", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0), capsys.readouterr().err


def test_an_error_of_its_own_names_the_verb_and_keeps_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(cli, "doctor_rows", lambda: 1 // 0)
    code, said = run(monkeypatch, capsys, "doctor")
    assert code == 1
    assert "naibu doctor" in said and "ZeroDivisionError" in said and "Traceback" not in said
    log = Path(re.search(r"details are in (\S+\.log)", said)[1])  # type: ignore[index]
    assert log.parent == tmp_path and "ZeroDivisionError" in log.read_text() and "command: naibu doctor" in log.read_text()


def test_running_out_of_memory_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def greedy() -> list[installation.DoctorRow]:
        raise MemoryError("Unable to allocate 70 TiB")

    monkeypatch.setattr(cli, "doctor_rows", greedy)
    code, said = run(monkeypatch, capsys, "doctor")
    assert code == 1 and "more memory than there is (Unable to allocate 70 TiB)" in said


@pytest.mark.parametrize("output", ["closed", "full"])
def test_output_that_nobody_takes_is_no_traceback(output: str) -> None:
    if output == "full" and not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    to = ">&-" if output == "closed" else "> /dev/full"
    command = f"{sys.executable} -m naibu --version {to}"
    done = subprocess.run(["bash", "-c", command], env=os.environ, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr and "standard output" in done.stderr and "log" not in done.stderr


@pytest.mark.parametrize("passes", [True, False])
def test_the_self_test_says_pass_or_fail(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], passes: bool) -> None:
    checks = (self_test.SelfCheck("mean error, mm", 0.01 if passes else 5.0, 0.0, 0.1, 1.0),)
    monkeypatch.setattr(self_test, "self_test", lambda progress: checks)
    monkeypatch.setattr(cli, "doctor_rows", list)
    monkeypatch.setattr(sys, "argv", ["naibu", "doctor", "--self-test"])
    code: object = 0
    try:
        cli.main()
    except SystemExit as ended:
        code = ended.code
    out = capsys.readouterr().out
    assert "mean error, mm" in out and ("All 1 checks passed" in out if passes else "FAIL" in out and "1 of 1 checks failed" in out)
    assert code == (0 if passes else cli.FAILED)


@pytest.mark.parametrize("to", ["2>&-", "2>/dev/full", ">&- 2>&-"])
@pytest.mark.parametrize(("words", "code"), [("simulate", 0), ("report nowhere", 2)])
def test_messages_that_nobody_takes_change_nothing(to: str, words: str, code: int) -> None:
    if "full" in to and not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    done = subprocess.run(["bash", "-c", f"{sys.executable} -m naibu {words} {to}"], capture_output=True, text=True, check=False)
    assert done.returncode == (1 if code == 0 and to.startswith(">") else code)
