"""The record of the slow tests tells what happened in each file, and keeps what it does not run again."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path

SPEC = importlib.util.spec_from_file_location("run_slow", Path(__file__).parent / "run_slow.py")
assert SPEC is not None and SPEC.loader is not None
run_slow = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(run_slow)

OUTCOME = """<testsuites><testsuite>
<testcase classname="tests.a" name="good"/><testcase classname="tests.a" name="also_good"/>
<testcase classname="tests.b" name="wrong"><failure/></testcase><testcase classname="tests.b" name="broken"><error/></testcase>
<testcase classname="tests.c" name="left_out"><skipped/></testcase>
</testsuite></testsuites>"""


def test_a_line_counts_and_names_failures() -> None:
    line = run_slow.told(ElementTree.fromstring(OUTCOME).iter("testcase"), 725.0, "abc1234")
    assert line.startswith("2 passed, 2 failed, 1 skipped, 725 s, ") and line.endswith(" at abc1234 (wrong, broken)")


def test_the_record_keeps_the_files_that_are_not_run_again(tmp_path: Path) -> None:
    files = ["tests/a/test_a.py", "tests/b/test_b.py", "tests/test_c.py"]
    record = {files[0]: "3 passed, 0 failed, 0 skipped, 41 s, 2026-01-02 at abc1234", files[1]: "0 passed, 1 failed, 0 skipped, 2 s (one)"}
    (tmp_path / "note.txt").write_text(run_slow.note(files, record), encoding="utf-8")
    first, *lines = (tmp_path / "note.txt").read_text(encoding="utf-8").splitlines()
    assert first == "slow tests: 2 of 3 files on record, 1 with failures" and lines[2] == "tests/test_c.py: not run yet"
    assert run_slow.read_record(tmp_path / "note.txt") == record


def test_every_file_with_a_slow_study_is_found() -> None:
    found = run_slow.slow_files()
    assert "tests/hostile/test_readers.py" in found and "tests/test_run_slow.py" not in found and found == sorted(found)
