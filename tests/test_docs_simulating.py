"""What docs/simulating.rst says of studies is what the reader of study files does, and its examples run."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from naibu.io.study_schemas import lattice_study_schema
from naibu.workflows.studies.lattice_study import NAMED

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "simulating.rst").read_text(encoding="utf-8")
TABLES = [name for name in dir(lattice_study_schema) if name.endswith("Table") and not name.startswith("_")]


def block(language: str) -> str:
    found = re.findall(rf"^\.\. code-block:: {language}\n\n((?:   .*\n|\n)+)", PAGE, re.MULTILINE)
    return re.sub("^   ", "", found[0], flags=re.MULTILINE)


@pytest.mark.parametrize("name", TABLES)
def test_every_key_is_told_in_the_page(name: str) -> None:
    key = name.removesuffix("Table").lower()
    heading = "[[indenter]]" if key == "indenter" else f"[{key}]"
    assert f"``{heading}``" in PAGE
    for field, told in getattr(lattice_study_schema, name).model_fields.items():
        assert f"**{field}**" in PAGE if told.is_required() else re.search(rf"\*\*{field}\*\*|``{field}\b", PAGE), f"{heading} {field}"


def test_studies_are_told() -> None:
    for name in NAMED:
        assert f"``{re.sub('-octree-.', '', name)}``" in PAGE


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_study.toml").write_text(block("toml"), encoding="utf-8")
    exec(block("python"), {})
    assert "20 of 20 frames" in capsys.readouterr().out
    told = json.loads(Path("results/my_study.json").read_text(encoding="utf-8"))
    # under the cylinder, the floor carries more than the weight
    weight = 1.1e-3 * 24.0 * 9810.0
    assert np.array(told["forces_mN"]["floor"])[:, 2].max() > weight
    assert told["mass_kg"] == pytest.approx(1.1e-3 * 24.0)
    for name in ("html", "vtkhdf", "json"):
        assert f"``NAME.{name}``" in PAGE and Path(f"results/my_study.{name}").is_file()
