"""Run the slow studies file by file, and keep in slow_last_run.txt when each ran, on what, and with what outcome; `.ci/run` prints it.

.venv/bin/python tests/run_slow.py [--missing] [FILE ...]

Every file with a slow study is run, or those that are named, or with ``--missing`` those that are not on record. The record is written
after every file: a run that was interrupted loses nothing, and one file can be run again by itself.
"""

from __future__ import annotations

import argparse
import datetime
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parent.parent
NOTE = Path(__file__).resolve().parent / "slow_last_run.txt"
USAGE_ERROR = 4  # pytest's exit status where it cannot even load its settings, for example where naibu is not installed
MARK = "pytest.mark." + "slow"
LINE = re.compile(r"^(?P<file>tests/\S+\.py): (?P<outcome>\d+ passed, (?P<failed>\d+) failed, \d+ skipped, .*)$")


def main(arguments: list[str]) -> int:
    """Run the slow studies, write the record, and return 1 where one of them failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", help="files to run, relative to the root; all by default")
    parser.add_argument("--missing", action="store_true", help="only files that are not on record")
    chosen = parser.parse_args(arguments)
    files = slow_files()
    if unknown := sorted(set(chosen.files) - set(files)):
        parser.error(f"{unknown[0]} has no slow study; those that have are {', '.join(files)}")
    record = read_record(NOTE)
    failed = False
    for file in chosen.files or files:
        if chosen.missing and file in record:
            continue
        record[file] = run(file)
        failed |= re.search(r" [1-9]\d* failed", record[file]) is not None
        NOTE.write_text(note(files, record), encoding="utf-8")
        print(f"{file}: {record[file]}", flush=True)
    return int(failed)


def slow_files() -> list[str]:
    """Return the files of tests that have a slow study, in order."""
    found = (p for p in sorted((ROOT / "tests").rglob("test_*.py")) if MARK in p.read_text(encoding="utf-8"))
    return [p.relative_to(ROOT).as_posix() for p in found]


def run(file: str) -> str:
    """Run the slow studies of a file in a process of their own, and return what the record says of them."""
    begin = time.monotonic()
    with TemporaryDirectory() as folder:
        outcome = Path(folder) / "outcome.xml"
        command = [sys.executable, "-m", "pytest", "-n", "0", "-q", "-m", "slow", f"--junitxml={outcome}", file]
        status = subprocess.run(command, cwd=ROOT, check=False).returncode
        if status == USAGE_ERROR:
            sys.exit(f"pytest could not begin with {file} (its message is above); nothing is recorded of it")
        if not outcome.exists():
            return f"0 passed, 1 failed, 0 skipped, pytest ended with {status}"
        cases = list(ElementTree.parse(outcome).iter("testcase"))
    return told(cases, time.monotonic() - begin, commit())


def told(cases: Iterable[ElementTree.Element], seconds: float, commit: str) -> str:
    """Return what the record says of the cases of one file."""
    cases = list(cases)
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    skipped = [case for case in cases if case.find("skipped") is not None]
    counts = f"{len(cases) - len(failed) - len(skipped)} passed, {len(failed)} failed, {len(skipped)} skipped"
    names = f" ({', '.join(str(case.get('name')) for case in failed)})" if failed else ""
    return f"{counts}, {seconds:.0f} s, {datetime.date.today()} at {commit}{names}"


def read_record(note: Path) -> dict[str, str]:
    """Return what the record says of each file."""
    lines = note.read_text(encoding="utf-8").splitlines() if note.exists() else []
    return {match["file"]: match["outcome"] for match in map(LINE.match, lines) if match is not None}


def note(files: Iterable[str], record: Mapping[str, str]) -> str:
    """Return the record: how many files ran and failed, and one line for each of them."""
    files = list(files)
    lines = [f"{file}: {record.get(file, 'not run yet')}" for file in files]
    there = [match for match in map(LINE.match, lines) if match is not None]
    failed = sum(match["failed"] != "0" for match in there)
    return "\n".join([f"slow tests: {len(there)} of {len(files)} files on record, {failed} with failures", *lines]) + "\n"


def commit() -> str:
    """Return the commit that is checked out, with a mark where files other than the record differ from it."""

    def told_by_git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()

    changed = told_by_git("status", "--porcelain", "--untracked-files=no", "--", ".", f":!{NOTE.relative_to(ROOT).as_posix()}")
    return (told_by_git("rev-parse", "--short", "HEAD") or "an unknown commit") + "+changes" * bool(changed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
