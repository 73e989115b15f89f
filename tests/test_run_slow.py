"""The note on the last run of the slow tests tells what happened in it."""

from __future__ import annotations

import importlib.util
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


def test_the_note_counts_and_names_failures(tmp_path: Path) -> None:
    (tmp_path / "outcome.xml").write_text(OUTCOME, encoding="utf-8")
    first, *failed = run_slow.note(tmp_path / "outcome.xml", "abc1234", 725.0).splitlines()
    assert first.endswith("at abc1234: 2 passed, 2 failed, 1 skipped, 12 min")
    assert failed == ["  failed: tests.b::wrong", "  failed: tests.b::broken"]
