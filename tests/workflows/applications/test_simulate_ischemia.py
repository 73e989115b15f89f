"""Studies of active ischemia as files: what they write, what they identify, and which ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import VTK_HEXAHEDRON
from vtkmodules.vtkIOHDF import vtkHDFReader

from naibu.core.errors import InputError
from naibu.workflows.applications.simulate_ischemia import describes_ischemia, prepared_ischemia
from naibu.workflows.studies.simulate import example_text, named_studies, simulate

SMALL = {"across = 20 ": "across = 8 ", "upwards = 14": "upwards = 6"}
RECORDED = {
    "# [record] ": "[record] ",
    '# file = "indentation.csv"': 'file = "indentation.csv"',
    "# noise_mm = 0.02 ": "noise_mm = 0.02 ",
    '# known = ["series_viscosity"]   # with [record]: parameters that keep their values': 'known = ["series_viscosity"]',
    "series_viscosity_kPa_s = 30.0    # and": "# and",
}


def written(folder: Path, changes: dict[str, str]) -> Path:
    text = example_text("ischemia")
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / "my_skin.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_study_is_written_as_page_numbers_and_motion(tmp_path: Path) -> None:
    run = simulate(written(tmp_path, SMALL), out=tmp_path / "out")
    page, numbers, series = run.files
    assert run.finished and "Pale area".lower() in page.read_text(encoding="utf-8").lower()
    tables = {t["title"]: t for t in json.loads(numbers.read_text(encoding="utf-8"))["tables"]}
    indentation = dict(zip(tables["Response"]["columns"], tables["Response"]["rows"][0], strict=True))
    # the upper layer alone would rise within 3 C1 / E; the soft one makes it slow
    assert indentation["rise 10-90 %, s"] > 0.2 > 3.0 * 0.03 / 3.8
    assert indentation["at release"] > indentation["at the end"] > 0.0
    assert "does not hold in amplitude" in page.read_text(encoding="utf-8")
    assert series.stat().st_size > 10_000


def test_the_layers_of_a_record_are_identified(tmp_path: Path) -> None:
    truth = prepared_ischemia(written(tmp_path, SMALL | {"series_viscosity_kPa_s = 30.0    # and": "# and"}))
    from naibu.applications import LayeredModes, meshed, simulate_skin

    times = np.concatenate([np.linspace(0.01, 0.47, 40), np.linspace(0.48, 3.0, 40)])
    modes = LayeredModes.of(meshed(truth.patch, 0.5, across=12, upwards=10))
    values = simulate_skin(modes, truth.materials, truth.load, times).indentation + 0.02 * np.random.default_rng(3).standard_normal(80)
    rows = "\n".join(f"{t:.6g},{v:.6g}" for t, v in zip(times, values, strict=True))
    (tmp_path / "indentation.csv").write_text(f"time_s,indentation_mm\n{rows}\n", encoding="utf-8")
    run = simulate(written(tmp_path, SMALL | RECORDED | {"young_modulus_kPa = 3.8": "young_modulus_kPa = 2.0"}), out=tmp_path / "out")
    tables = {t["title"]: t for t in json.loads(run.files[1].read_text(encoding="utf-8"))["tables"]}
    found = {(row[0], row[1]): row for row in tables["Identified layers"]["rows"]}
    assert set(found) == {(n, p) for n in ("dermis", "epidermis") for p in ("young_modulus, kPa", "voigt_viscosity, kPa s")}
    for key, value in {("epidermis", "young_modulus, kPa"): 3.8, ("dermis", "voigt_viscosity, kPa s"): 1.0}.items():
        assert found[key][3] < value < found[key][4] and found[key][5] == "yes"


def test_the_study_that_comes_along_is_listed_and_is_its_example() -> None:
    assert any(s.name == "ischemia" and s.model == "layered skin" for s in named_studies())
    assert describes_ischemia("ischemia") and not describes_ischemia("chip") and not describes_ischemia("nowhere.toml")
    assert prepared_ischemia("ischemia").patch.height_mm == pytest.approx(1.0)


def test_the_series_holds_the_layers(tmp_path: Path) -> None:
    study = written(
        tmp_path,
        SMALL
        | {'geometry = "axisymmetric" ': 'geometry = "three_dimensional" ', "across = 20 ": "across = 3 ", "upwards = 14": "upwards = 4"},
    )
    series = simulate(study, out=tmp_path / "out").files[2]
    reader = vtkHDFReader()
    reader.SetFileName(str(series))
    reader.SetStep(30)
    reader.Update()
    solid = reader.GetOutput()
    assert solid.GetNumberOfCells() == 6 * 6 * 4 and solid.GetCellType(0) == VTK_HEXAHEDRON
    moved = vtk_to_numpy(solid.GetPointData().GetArray("displacement_mm"))
    assert moved[:, 2].min() < -1.0 and np.abs(moved[:, 0].sum()) < 1e-6 * np.abs(moved).sum()


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"width_mm = 4.0": "width_mm = -4.0"}, r"\[skin\] width_mm = -4.0"),
        ({"force_mN": "force_N"}, r"\[load\] force_N is not a known key; did you mean 'force_mN'"),
        ({"thickness_mm = 0.5": "thickness_mm = 'thin'"}, r"\[\[layer\]\] number 1 thickness_mm = 'thin'"),
        ({"end_s = 3.0": "end_s = 0.3"}, "must come after the load, which lasts 0.47 s"),
        (
            {"radius_mm = 0.5 ": "radius_mm = 2.5 "},
            r"\[load\] radius_mm must be smaller than half of the width of the patch, 2 mm, not 2.5",
        ),
        ({"range_Hz = [0.1, 100.0]": "range_Hz = [100.0, 0.1]"}, "must grow"),
        ({"poisson_ratio = 0.49": "poisson_ratio = 0.5"}, r"\[\[layer\]\] number 1 poisson_ratio = 0.5"),
        ({"force_mN = 50.0\n": ""}, r"\[load\] force_mN is missing; add it; the example of the study 'ischemia'"),
    ],
)
def test_bad_studies_are_refused_and_nothing_is_written(changes: dict[str, str], what: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=what):
        simulate(written(tmp_path, SMALL | changes), out=tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.*")) if (tmp_path / "out").exists() else True


@pytest.mark.parametrize(
    ("text", "what"),
    [("0.1,1,2\n", "rows of 3 numbers; it needs rows of 2: time, s; indentation, mm"), ("0.1,x\n0.2,1\n", "'x' where a number")],
)
def test_bad_records_are_refused(text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "indentation.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=what):
        simulate(written(tmp_path, SMALL | RECORDED), out=tmp_path / "out")


def test_a_record_with_too_few_rows_is_named(tmp_path: Path) -> None:
    (tmp_path / "indentation.csv").write_text("0.1,1\n0.2,1.5\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"\[record\] file has 2 values for 4 parameters"):
        simulate(written(tmp_path, SMALL | RECORDED), out=tmp_path / "out")


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("1,0.2\n", "instants after the load began"),
        ("0.1,0\n-0.2,0.1\n", "times from -0.2"),
        ("0.1,0.1\n0.1,0.2\n", "times from 0.1 to 0.1"),
        ("0.1,0.1\n0.2,1e300\n", "in skin of 1 mm"),
        ("0.1,0.1\n0.2,0.11\n0.3,0.1\n", "noise_mm = 0.02"),
        ("0.1,nan\n", "nan"),
        ("10,1\n20,1.5\n470,2\n3000,0.2\n", "begins at 10 s, when the load of 0.47 s is over"),
        ("0.1,-1\n0.2,-1.5\n", "an indentation of -1.5 mm"),
    ],
)
def test_records_that_cannot_be_are_refused_before_the_work(tmp_path: Path, rows: str, said: str) -> None:
    (tmp_path / "indentation.csv").write_text(rows, encoding="utf-8")
    with pytest.raises(InputError, match=said) as refused:
        prepared_ischemia(written(tmp_path, SMALL | RECORDED))
    assert "indentation.csv" in str(refused.value)


@pytest.mark.parametrize("elsewhere", ["../indentation.csv", "/etc/hosts"])
def test_records_outside_of_the_folder_of_the_study_are_not_read(tmp_path: Path, elsewhere: str) -> None:
    changes = RECORDED | {'# file = "indentation.csv"': f'file = "{elsewhere}"'}
    with pytest.raises(InputError, match="outside the folder"):
        prepared_ischemia(written(tmp_path, SMALL | changes))


def test_two_layers_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'dermis' stands twice"):
        prepared_ischemia(written(tmp_path, SMALL | {'name = "epidermis"': 'name = "dermis"'}))
