"""Records of benchmarks are whole, the pages that show them exist, and the README says what they say."""

from __future__ import annotations

import datetime
import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
RECORDS = sorted((ROOT / "benchmarks" / "results").glob("*.json"))
SHOWN = re.compile(r"^\.\. benchmark-results:: (\S+)$", re.MULTILINE)


def module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = loaded  # dataclasses look their module up
    try:
        spec.loader.exec_module(loaded)
    finally:
        del sys.modules[path.stem]
    return loaded


def record(name: str) -> dict[str, object]:
    return dict(json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_tells_what_was_run_when_and_on_what(path: Path) -> None:
    told = json.loads(path.read_text(encoding="utf-8"))
    program = re.fullmatch(r"python (benchmarks/\w+\.py)( .*)?", told["command"])
    assert program is not None and (ROOT / program[1]).is_file()
    assert "--record" in (ROOT / program[1]).read_text(encoding="utf-8")
    assert datetime.date(2026, 1, 1) <= datetime.date.fromisoformat(told["date"]) and told["version"] and told["machine"]
    for table in told["tables"]:
        assert table["rows"] and {len(row) for row in table["rows"]} == {len(table["columns"])}


def test_every_record_is_shown_and_every_shown_one_exists() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("**/*.rst") if "_build" not in page.parts]
    assert {name for page in pages for name in SHOWN.findall(page)} == {path.stem for path in RECORDS}


def test_a_written_record_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    records = module(ROOT / "benchmarks" / "records.py")
    monkeypatch.setattr(records, "FOLDER", tmp_path / "results")
    monkeypatch.setattr(sys, "argv", ["/elsewhere/sense_volumes.py", "3", "--record"])
    path = records.write_record("legs", [records.ResultTable("legs", ("leg", "error, mm"), (("left", 0.125),))])
    told = json.loads(path.read_text(encoding="utf-8"))
    assert told["command"] == "python benchmarks/sense_volumes.py 3" and told["date"] == datetime.date.today().isoformat()
    assert told["tables"] == [{"name": "legs", "columns": ["leg", "error, mm"], "rows": [["left", 0.125]]}]
    assert str(path) in capsys.readouterr().out


def test_the_readme_says_what_the_records_say() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    reach = readme[readme.index("## What it reaches") : readme.index("## What it does")]
    (distances, _) = record("accuracy")["tables"]  # type: ignore[misc]
    told = {float(value) for line in reach.splitlines() if line.startswith("| ") for value in re.findall(r"\d\.\d\d", line)}
    assert told == {round(row[2], 2) for row in distances["rows"]}
    values = {row[0]: row[1] for row in record("interval_coverage")["tables"][0]["rows"]}  # type: ignore[index]
    assert f"{values['RMS error of the ratio of moduli, %']:.1f} %" in reach
    assert f"{values[next(name for name in values if 'held the truth' in name)]:.0f} % of cases" in reach
    assert f"in {values['the same with the law taken for right, %']:.0f} %" in reach
