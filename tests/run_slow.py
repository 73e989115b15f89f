"""Run the slow studies and note when, on what, and with what outcome in slow_last_run.txt, which `.ci/run` prints.

.venv/bin/python tests/run_slow.py [options of pytest]
"""

from __future__ import annotations

import datetime
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parent.parent
NOTE = Path(__file__).resolve().parent / "slow_last_run.txt"


def main(options: list[str]) -> int:
    """Run the slow studies, write the note, and return the exit status of pytest."""
    start = time.monotonic()
    with TemporaryDirectory() as folder:
        outcome = Path(folder) / "outcome.xml"
        command = [sys.executable, "-m", "pytest", "-m", "slow", f"--junitxml={outcome}", *options]
        status = subprocess.run(command, cwd=ROOT, check=False).returncode
        if not outcome.exists():
            return status
        NOTE.write_text(note(outcome, commit(), time.monotonic() - start), encoding="utf-8")
    print(NOTE.read_text(encoding="utf-8"), end="")
    return status


def note(outcome: Path, commit: str, seconds: float) -> str:
    """Return one line on a run, and one on each test that failed."""
    cases = list(ElementTree.parse(outcome).iter("testcase"))
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    skipped = [case for case in cases if case.find("skipped") is not None]
    passed = len(cases) - len(failed) - len(skipped)
    counts = f"{passed} passed, {len(failed)} failed, {len(skipped)} skipped"
    lines = [f"slow tests last ran on {datetime.date.today()} at {commit}: {counts}, {seconds / 60:.0f} min"]
    lines += [f"  failed: {case.get('classname')}::{case.get('name')}" for case in failed]
    return "\n".join(lines) + "\n"


def commit() -> str:
    """Return the commit that is checked out, with a mark where files differ from it."""
    command = ["git", "describe", "--always", "--dirty=+changes", "--exclude=*"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "an unknown commit"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
