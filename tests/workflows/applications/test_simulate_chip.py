"""Studies of sensing chips as files: what they write, and which ones are refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from naibu.core.errors import InputError
from naibu.io.meshes import read_mesh
from naibu.workflows.applications.simulate_chip import describes_chip, prepared_chip
from naibu.workflows.studies.simulate import example_text, named_studies, simulate

SMALL = {
    "along = 10": "along = 6",
    "across = 2": "across = 1",
    "through = 3": "through = 2",
    "below = 3": "below = 1",
    "frame = 4": "frame = 2",
}
PAGE = (Path(__file__).resolve().parents[3] / "docs" / "applications" / "sensing_chip.rst").read_text(encoding="utf-8")


def written(folder: Path, changes: dict[str, str]) -> Path:
    text = example_text("chip")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "my_chip.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_chip_is_written_as_page_numbers_and_solution(tmp_path: Path) -> None:
    study = written(tmp_path, SMALL)
    text = study.read_text(encoding="utf-8")
    study.write_text(text[: text.index("[study]")] + text[text.index("[mesh]") :], encoding="utf-8")
    run = simulate(study, out=tmp_path / "out")
    assert run.finished
    page, numbers, solution = run.files
    assert (page.name == "my_chip.html" and "Pareto front" in page.read_text(encoding="utf-8")) or page.stat().st_size > 100_000
    tables = {t["title"]: t for t in json.loads(numbers.read_text(encoding="utf-8"))["tables"]}
    force, moment_x, moment_y = tables["Sensitivity"]["rows"]
    assert force[-1] == pytest.approx(0.2, rel=0.1)
    touch = {c: v for name in ("Loads", "Outputs") for c, v in zip(tables[name]["columns"], tables[name]["rows"][0], strict=True)}
    assert touch["bridge F_z, mV"] == pytest.approx(20.0 * force[-1], rel=1e-9)
    assert touch["amplified M_x, V"] == pytest.approx(500e-3 * 2.0 * moment_x[-1], rel=1e-3)
    assert touch["amplified M_y, V"] == pytest.approx(-500e-3 * moment_y[-1], rel=1e-3)
    assert touch["saturated"] == "none"
    assert read_mesh(solution).region_names == ("A", "B", "C", "D", "block", "frame")


def test_the_study_that_comes_along_is_listed_and_is_its_example() -> None:
    assert any(s.name == "chip" and s.model == "sensing chip" for s in named_studies())
    assert describes_chip("chip") and not describes_chip("elastic-square") and not describes_chip("nowhere.toml")
    assert prepared_chip("chip").design.beam_length_mm == pytest.approx(0.325)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"force_z_mN = 20.0": "force_z_mN = 5000", "moment_y_Num = -1.0": "moment_y_Num = 800"}, r"stresses the beams to 3\.68 GPa"),
        ({"beam_length_um = 325.0": "beam_length_um = -325.0"}, r"\[chip\] beam_length_um = -325\.0: must be greater than 0"),
        ({'beam_direction = "110"': 'beam_direction = "north"'}, r"\[silicon\] beam_direction: 'north' is no crystal direction"),
        ({'beam_direction = "110"': 'beam_direction = "111"'}, "not perpendicular"),
        ({"beam_thickness_um = 74.0": "beam_thickness_mm = 0.074"}, "did you mean 'beam_thickness_um'"),
        ({"supply_V = 5.0": 'supply_V = "5"'}, r"\[readout\] supply_V = '5': must be a valid number"),
        ({"moment_x_Num = 2.0": "moment_x_Num = nan"}, r"\[\[load\]\] number 1 moment_x_Num = nan: must be a finite number"),
        ({"beam_width_um = [40.0, 240.0]": "beam_width_um = [240.0, 40.0]"}, r"\[study\] beam_width_um = .*must grow"),
        ({"along = 10": "along = 0"}, r"\[mesh\] along = 0"),
        ({"force_from_end_um = 113.0": "force_from_end_um = 300.0"}, r"\[resistors\] force_from_end_um is 0\.3; .*in mm"),
        ({"block_width_um = 325.0": "block_width_um = 100.0"}, r"\[chip\] beam_width_um is 0\.121, more than the block"),
        ({"beam_length_um = 325.0": "# none"}, r"\[chip\] beam_length_um is missing"),
        ({"gains = [2000.0, 500.0, 500.0]": "gains = [2000.0, 500.0]"}, r"\[readout\] gains"),
        ({"[readout]": "[readouts]"}, "did you mean 'readout'"),
    ],
)
def test_files_that_cannot_be_used_are_refused_and_nothing_is_written(tmp_path: Path, changes: dict[str, str], told: str) -> None:
    study = written(tmp_path, changes)
    with pytest.raises(InputError, match=told) as refused:
        simulate(study, out=tmp_path / "out")
    assert str(study) in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_what_a_chip_has_no_use_for_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="resume"):
        simulate("chip", out=tmp_path, resume=True)
    with pytest.raises(InputError, match="device"):
        simulate("chip", out=tmp_path, device="cuda")


def test_every_key_is_told_in_the_page_and_in_the_example() -> None:
    keys = set(re.findall(r"^#? ?(\w+) = ", example_text("chip"), re.MULTILINE))
    assert len(keys) > 30
    assert not [key for key in keys if f"``{key}``" not in PAGE]
