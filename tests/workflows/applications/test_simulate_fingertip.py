"""Studies of a fingertip as files: what they write, how they resume, what is decoded of their readings, and which ones are refused."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from notebooks import check_shown
from vtkmodules.vtkIOHDF import vtkHDFReader

from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.io.tables.number_table import read_numbers
from naibu.workflows.applications.decode_forces import decode_forces
from naibu.workflows.applications.fingertip_study import describes_fingertip, prepared_fingertip
from naibu.workflows.studies.simulate import example_text, named_studies, simulate

STUDY = """
[fingertip]
diameter_mm = 20.0
young_modulus_kPa = 220.0
[[press]]
name = "first"
tilt_deg = 0.0
force_N = 1.0
[[press]]
name = "tilted"
tilt_deg = 15.0
azimuth_deg = 90.0
force_N = 1.5
speed_mm_min = 3.0
[decoder]
tilts_deg = [0.0, 10.0, 20.0, 30.0]
frictions = [0.5]
young_modulus_kPa = [200.0, 240.0]
force_N = [0.3, 1.7]
[mesh]
around = 3
upwards = 2
shells = 8
"""
CHIP = "[readings]\nchip_file = 'chip.toml'\n"


def written(folder: Path, text: str = STUDY) -> Path:
    chip = example_text("chip").replace("along = 10", "along = 6").replace("across = 2", "across = 1").replace("through = 3", "through = 2")
    (folder / "chip.toml").write_text(chip, encoding="utf-8")
    path = folder / "my_finger.toml"
    path.write_text(text + CHIP, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("finger")
    stopped = simulate(written(place), out=place / "out", progress=stop_at(2))
    assert not stopped.finished and (stopped.frames, stopped.of, stopped.parts) == (2, 8, "presses")
    run = simulate(place / "my_finger.toml", out=place / "out", resume=True)
    assert run.finished and not (place / "out" / "my_finger.checkpoint.json").exists()
    return place


def stop_at(press: int) -> Callable[[ProgressReport], None]:
    def stop(report: ProgressReport) -> None:
        if report.done is not None and report.done >= press:
            raise KeyboardInterrupt

    return stop


def test_a_resumed_study_is_the_same_as_one_without_interruption(folder: Path) -> None:
    simulate(folder / "my_finger.toml", out=folder / "again")
    for name in ("my_finger.json", "my_finger-decoder.json", "my_finger-readings.csv"):
        words, numbers = taken_apart(folder / "again" / name)
        same_words, same_numbers = taken_apart(folder / "out" / name)
        assert words == same_words, name
        np.testing.assert_allclose(numbers, same_numbers, rtol=1e-5, atol=1e-9)  # oneMKL sums in an order of its own on some machines


def taken_apart(file: Path) -> tuple[list[str], list[float]]:
    """The text of a file between its numbers, and the numbers."""
    text, number = file.read_text(encoding="utf-8"), r"-?\d+\.?\d*(?:[eE][-+]?\d+)?"
    return re.split(number, text), [float(found) for found in re.findall(number, text)]


def test_page_and_numbers_tell_what_was_pressed_and_decoded(folder: Path) -> None:
    tables = {t["title"]: t for t in json.loads((folder / "out" / "my_finger.json").read_text(encoding="utf-8"))["tables"]}
    tilted = {c: v for name in ("Presses", "On the chip") for c, v in zip(tables[name]["columns"], tables[name]["rows"][1], strict=True)}
    assert tilted["force along the rod, N"] == pytest.approx(1.5, rel=0.01) and tilted["saturated"] == "none"
    # pressed from y: the lateral force turns the chip about x only
    assert tilted["M_x, N µm"] > 0.5 and tilted["M_y, N µm"] == 0.0
    decoded = tables["Decoded presses"]["rows"]
    assert [row[0] for row in decoded] == ["first", "tilted"]
    page = (folder / "out" / "my_finger.html").read_text(encoding="utf-8")
    assert "Theories of soft contact" in page and "presses towards the centre" in page


def test_the_series_shows_the_last_press(folder: Path) -> None:
    reader = vtkHDFReader()
    reader.SetFileName(str(folder / "out" / "my_finger.vtkhdf"))
    reader.Update()
    assert reader.GetNumberOfSteps() > 4 and reader.GetOutput().GetNumberOfPoints() > 200


def test_recorded_readings_are_decoded(folder: Path, tmp_path: Path) -> None:
    out = folder / "out"
    record = decode_forces(out / "my_finger-decoder.json", out / "my_finger-readings.csv", out=tmp_path, noise_share=0.23)
    with record.files[2].open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["force_N"] == "" and rows[-1]["force_N"] == ""  # nothing touches
    best = max((row for row in rows if row["force_N"]), key=lambda row: float(row["force_N"]))
    assert float(best["force_low_N"]) < 1.5 < float(best["force_high_N"])
    shown = check_shown(record, record.files[0])
    assert len(shown) == len(rows) and float(best["force_N"]) in [row["force_N"] for row in shown]
    assert float(best["azimuth_deg"]) == pytest.approx(90.0, abs=3.0) and 11.0 < float(best["tilt_deg"]) < 17.0
    with pytest.raises(InputError, match=r"already holds forces\.html"):
        decode_forces(out / "my_finger-decoder.json", out / "my_finger-readings.csv", out=tmp_path)


def test_the_study_that_comes_along_is_listed_and_is_its_example() -> None:
    assert any(s.name == "fingertip" and s.model == "fingertip" for s in named_studies())
    assert describes_fingertip("fingertip") and not describes_fingertip("chip") and not describes_fingertip("nowhere.toml")
    prepared = prepared_fingertip("fingertip")
    assert prepared.training is not None and [p.tilt_deg for p in prepared.presses] == [0.0, 10.0, 20.0, 30.0]


def test_a_jig_tilts_and_turns_every_press(tmp_path: Path) -> None:
    study = prepared_fingertip(written(tmp_path, STUDY + "[jig]\ntilt_error_deg = -2.0\nazimuth_error_deg = 3.0\n"))
    assert [p.tilt_deg for p in study.presses] == [2.0, 13.0]
    assert [study.azimuth_deg(k) for k in range(2)] == [183.0, 93.0]  # the first now tilts to the other side


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (("tilt_deg = 15.0", "tilt_deg = 60.0"), r"\[\[press\]\] number 2 tilt_deg = 60.0"),
        (("force_N = 1.5", "force_mN = 1.5"), r"\[\[press\]\] number 2 force_mN is not a known key; did you mean 'force_N'"),
        (("diameter_mm = 20.0", "diameter_mm = 20.0\npackage_height_mm = 8.0"), r"\[fingertip\] package_height_mm is 8, too much"),
        (("diameter_mm = 20.0", "diameter_mm = 20.0\nlaw = 'hooke'"), "law 'hooke' is not known"),
        (("[200.0, 240.0]", "[240.0, 260.0]"), r"\[decoder\] young_modulus_kPa is \[240.0, 260.0\], without the fingertip's 220"),
        (("[0.0, 10.0, 20.0, 30.0]", "[5.0, 10.0, 20.0, 30.0]"), r"\[decoder\] tilts_deg are \[5.0, 10.0, 20.0, 30.0\]; begin with 0"),
        (("[0.0, 10.0, 20.0, 30.0]", "[0.0, 10.0, 10.0, 30.0]"), "must grow"),
        (("[mesh]", "[jig]\ntilt_error_deg = 44.0\n[mesh]"), "tilt_error_deg"),
        (("around = 3", "around = 100"), r"\[mesh\] around = 100"),
    ],
)
def test_bad_studies_are_refused_and_nothing_is_written(change: tuple[str, str], what: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=what):
        simulate(written(tmp_path, STUDY.replace(*change)), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_presses_that_the_gel_or_the_chip_does_not_bear_are_refused(tmp_path: Path) -> None:
    one = STUDY[: STUDY.index('[[press]]\nname = "tilted"')] + STUDY[STUDY.index("[mesh]") :]
    for force, what in ((500.0, "more than 69.1 N"), (65.0, "at a depth of")):
        with pytest.raises(InputError, match=rf"\[\[press\]\] force_N is {force:g}.*{what}"):
            simulate(written(tmp_path, one.replace("force_N = 1.0", f"force_N = {force}")), out=tmp_path / "out")
    stiff = one.replace("young_modulus_kPa = 220.0", "young_modulus_kPa = 40000.0").replace("diameter_mm = 20.0", "diameter_mm = 20.0")
    with pytest.raises(InputError, match=r"\[\[press\]\] number 1, on the chip: load F_z = .* make the load at most"):
        simulate(written(tmp_path, stiff.replace("force_N = 1.0", "force_N = 1800.0")), out=tmp_path / "out")
    assert not list((tmp_path / "out").glob("my_finger*"))


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("decoder", "{", "is no decoder of a fingertip"),
        ("decoder", "[]", "is no decoder of a fingertip"),
        ("decoder", '{"kind": "naibu fingertip decoder"}', "naibu cannot be used"),
        ("readings", "0,1,2\n", "it needs rows of 4"),
        ("readings", "0,1,2,3\n0,1,2,3\n", "row 2 is not later than the one before"),
        ("readings", "0,1000,2,3\n1,1,2,3\n", "Are its readings in V"),
        ("readings", "0,1,2,3\n1,1,2,3\n", "free_rows is 20, and .* has 2 rows"),
    ],
)
def test_bad_decoders_and_readings_are_refused(folder: Path, tmp_path: Path, name: str, content: str, what: str) -> None:
    paths = {"decoder": folder / "out" / "my_finger-decoder.json", "readings": folder / "out" / "my_finger-readings.csv"}
    paths[name] = tmp_path / "bad"
    paths[name].write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=what):
        decode_forces(paths["decoder"], paths["readings"], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_readings_in_millivolts_are_told_by_the_training_of_the_decoder(folder: Path, tmp_path: Path) -> None:
    """Readings of less than 0.1 V stay below 100 in mV, a thousand times what the chip gives under these forces."""
    out = folder / "out"
    names = ("time, s", "F_z, V", "M_x, V", "M_y, V")
    times, *volts = read_numbers(out / "my_finger-readings.csv", names, units=("s", "V", "V", "V")).T
    for factor in (1.0, 1000.0):
        scaled = factor * 0.05 * np.column_stack(volts) / np.abs(volts).max()
        np.savetxt(tmp_path / f"{factor:g}.csv", np.column_stack([times, scaled]), delimiter=",")
    decode_forces(out / "my_finger-decoder.json", tmp_path / "1.csv", out=tmp_path / "forces")
    with pytest.raises(InputError, match=r"row \d+: F_z of .* times the largest reading .* are the readings in V"):
        decode_forces(out / "my_finger-decoder.json", tmp_path / "1000.csv", out=tmp_path / "more")


def test_a_record_in_which_nothing_touches_shows_no_empty_axes(folder: Path, tmp_path: Path) -> None:
    """The page drew axes without a curve, a table without a row, and said that every reading lay beyond the training."""
    np.savetxt(tmp_path / "free.csv", np.column_stack([0.01 * np.arange(60), np.zeros((60, 3))]), delimiter=",")
    run = decode_forces(folder / "out" / "my_finger-decoder.json", tmp_path / "free.csv", out=tmp_path / "forces", friction=0.5)
    (said,) = (value for name, value in run.rows if name == "readings answered")
    assert said.startswith("0 of 60: nothing touches")
    page = (tmp_path / "forces" / "forces.html").read_text(encoding="utf-8")
    assert "<figure" not in page and "No contact was found" in page


def test_a_checkpoint_of_another_study_is_refused(folder: Path, tmp_path: Path) -> None:
    study = written(tmp_path)
    with pytest.raises(InputError, match="nothing to resume"):
        simulate(study, out=tmp_path / "out", resume=True)
    simulate(study, out=tmp_path / "out", progress=stop_at(1))
    other = written(tmp_path, STUDY.replace("force_N = 1.0", "force_N = 0.9"))
    with pytest.raises(InputError, match="was kept with other settings"):
        simulate(other, out=tmp_path / "out", resume=True)
    (tmp_path / "out" / "my_finger.checkpoint.json").write_text('{"fingerprint": 1, "presses": [5]}', encoding="utf-8")
    with pytest.raises(InputError, match="is damaged"):
        simulate(other, out=tmp_path / "out", resume=True)
