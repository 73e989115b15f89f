"""A body identified from one loading predicts another, which other code solved, within its standard deviations; it can be touched."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from notebooks import check_shown

from naibu.cli import main
from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.io.displacement_fields import read_field, write_field
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import QuadraticBody, Solved
from naibu.workflows.fields.identify_fields import identify_fields
from naibu.workflows.fields.predict_field import FieldPredictionRun, predict_field
from naibu.workflows.interactive.touchable_models import touchable
from naibu.workflows.results.result_folder import read_any_model, read_model

SD_MM = 0.04
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
CORNER = np.array([97.0, 53.0, 23.0])  # of the cube in the scan, mm
PRESSED, SHEARED = (0.0, 0.0, -2.0), (1.5, 0.0, -0.5)


@cache
def solved(push: tuple[float, float, float]) -> Solved:
    return QuadraticBody("cube").solved(push, divisions=4)


def in_scan(points: FloatArray) -> FloatArray:
    return CORNER + points @ TURNED.T


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model of a pressed cube of two gels in a scan whose axes are turned, and the field of the same cube when it is sheared."""
    place = tmp_path_factory.mktemp("identified")
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[2:12, 2:22, 2:22], labels[12:22, 2:22, 2:22] = 1, 2
    scan = Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0), origin_mm=(100.0, 50.0, 20.0), direction=TURNED)
    write_volume(place / "labels.mha", scan)
    for seed, (name, push) in enumerate({"pressed": PRESSED, "sheared": SHEARED}.items()):
        rng = np.random.default_rng(seed)
        points, u = solved(push).at(rng.uniform(0.02, 0.98, (1200, 3)))
        u = u + SD_MM * rng.standard_normal(u.shape)
        write_field(place / f"{name}.h5", DisplacementField.from_arrays(in_scan(points), u @ TURNED.T, sd_mm=SD_MM))
    identify_fields(
        place / "pressed.h5", zones=place / "labels.mha", zone_names={1: "gel", 2: "pad"}, known=["pad=10 kPa, 0.4"], element_size_mm=6.7,
        out=place / "model",
    )  # fmt: skip
    return place


def against_truth(run: FieldPredictionRun, push: tuple[float, float, float]) -> tuple[float, float]:
    """Return the RMS error in standard deviations inside of the body, and the part of components within 1.96 of them."""
    points, true = solved(push).at(np.random.default_rng(7).uniform(0.2, 0.8, (400, 3)))
    u, covariance = run.prediction.at(in_scan(points))
    error = (u - true @ TURNED.T) / np.sqrt(np.einsum("kii->ki", covariance))
    return float(np.sqrt((error**2).mean())), float((np.abs(error) < 1.96).mean())


def test_the_inside_follows_from_the_surface(folder: Path) -> None:
    run = predict_field(folder / "model", folder / "sheared.h5")
    rms, within = against_truth(run, SHEARED)
    assert rms < 1.0 and within > 0.93
    assert run.comparison is not None and 200 < len(run.comparison.points) < 800
    assert run.comparison.within is not None and run.comparison.within > 0.93
    assert float(np.linalg.norm(run.comparison.rms_mm)) < 1.2 * np.sqrt(3.0) * SD_MM


def test_plates_that_stick_move_the_body(folder: Path, tmp_path: Path) -> None:
    """The frame of the scan is turned: what pushes along x of the cube pushes along y of the scan."""
    run = predict_field(folder / "model", folder / "sheared.h5", held=["z-"], moved=["z+=0,1.5,-0.5"], out=tmp_path)
    rms, within = against_truth(run, SHEARED)
    assert rms < 1.3 and within > 0.9
    assert run.comparison is not None and len(run.comparison.points) > 1000
    assert {p.name for p in run.files} == {p.name for p in tmp_path.iterdir()}
    field, points = read_field(tmp_path / "field.h5"), in_scan(solved(SHEARED).at(np.full((1, 3), 0.5))[0])
    voxel = tuple(np.round(field.grid.to_index(points)[0]).astype(int)[::-1])
    assert field.vectors[voxel] == pytest.approx(run.prediction.at(field.grid.to_physical(np.array([voxel[::-1]])))[0][0], abs=1e-9)
    assert "Predicted displacement" in (tmp_path / "predicted.html").read_text()
    assert json.loads((tmp_path / "summary.json").read_text())["comparison"]["points"] == len(run.comparison.points)
    nodes = check_shown(run, tmp_path / "predicted.html")
    assert [nodes[-1][f"u{axis}_mm"] for axis in "xyz"] == run.prediction.displacement[-1].tolist()


def test_the_field_that_identified_the_model_is_no_test_of_it(folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "again.h5"
    copied.write_bytes((folder / "pressed.h5").read_bytes())
    said = {f: " ".join(predict_field(folder / "model", f).notes) for f in (copied, folder / "sheared.h5")}
    assert "identified: no test of it" in said[copied] and "not used" not in said[copied]
    assert "that were not used" in said[folder / "sheared.h5"]


def test_displacements_in_micrometres_are_not_taken_for_errors_of_the_measurement(folder: Path, tmp_path: Path) -> None:
    points, u = solved(SHEARED).at(np.random.default_rng(3).uniform(0.02, 0.98, (400, 3)))
    write_field(tmp_path / "um.h5", DisplacementField.from_arrays(in_scan(points), 1e3 * u @ TURNED.T))
    with pytest.raises(InputError, match=r"times its size.*are they in mm"):
        predict_field(folder / "model", tmp_path / "um.h5")
    page = predict_field(folder / "model", folder / "sheared.h5", out=tmp_path / "out")
    sd = json.loads((tmp_path / "out" / "summary.json").read_text())["median_sd_mm"]  # the page had told another one in its card
    html = (tmp_path / "out" / "predicted.html").read_text()
    assert f"{sd:.2g} mm" in page.notes[-1] + page.notes[-2] and html.count(f"{sd:.2g} mm") >= 2


def test_a_larger_load_is_called_an_extrapolation(folder: Path) -> None:
    notes = [" ".join(predict_field(folder / "model", held=["z-"], moved=[f"z+=0,0,{z}"]).notes) for z in (-2.0, -5.0)]
    assert ["extrapolation" in n for n in notes] == [False, True]


def test_uncertain_moduli_widen_the_prediction(folder: Path) -> None:
    """Ten times the standard deviation of the moduli, ten times their part of the prediction's."""
    body = read_any_model(folder / "model")
    assert isinstance(body, IdentifiedBody)
    data = body.to_dict()
    sds = []
    for factor in (0.0, 1.0, 10.0):
        data["covariance"] = (factor**2 * np.asarray(body.to_dict()["covariance"])).tolist()
        sds.append(predict_field(IdentifiedBody.from_dict(data), held=["z-"], moved=["z+=0,0,-2"]).prediction.standard_deviation ** 2)
    assert sds[2] - sds[0] == pytest.approx(100.0 * (sds[1] - sds[0]), rel=1e-6, abs=1e-12)


def test_a_modulus_that_is_left_open_is_told_of_the_standard_deviation(folder: Path) -> None:
    body = read_any_model(folder / "model")
    assert isinstance(body, IdentifiedBody)
    loading: dict[str, Any] = {"held": ["z-"], "moved": ["z+=0,0,-1"]}
    assert not any("leaves open" in note for note in predict_field(body, **loading).notes)
    data = copy.deepcopy(body.to_dict())
    data["covariance"][0][0] = 1.0  # of the logarithm: a factor of 7 either way
    assert any("too small where those of gel" in note for note in predict_field(IdentifiedBody.from_dict(data), **loading).notes)


def test_the_command_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["naibu", "predict", str(folder / "model"), *words, "--out", str(tmp_path / "out")])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    assert run(str(folder / "sheared.h5")) == 0
    assert "95 % interval" in " ".join(capsys.readouterr().out.split()) and (tmp_path / "out" / "predicted.html").exists()
    for words, expected in (
        ([], "give --move"),
        (["--hold", "top"], "side 'top' is not known"),
        (["--hold", "z-"], "no side moves"),
        (["--hold", "z-", "--move", "z+=1,2"], "must name a side and its displacement"),
        (["--hold", "z-", "--move", "x+=1,0,0"], "shares nodes"),
        (["--hold", "z-", "--move", "z-=1,0,0"], "named twice"),
        ([str(folder / "sheared.h5"), "--state", "a"], "--state goes with models of markers"),
    ):
        assert run(*words, "--overwrite") == 2
        assert expected in " ".join(capsys.readouterr().err.split())


def test_a_touched_body_comes_to_rest_where_the_prediction_is(folder: Path) -> None:
    model = touchable(folder / "model")
    assert any("gel" in s for s in model.sentences)
    body = model.body
    session = body.session()
    body.grip(session, np.flatnonzero(body.points[:, 2] > body.points[:, 2].max() - 1e-6))
    down = body.grip_velocity(np.array([0.0, 0.0, -2.0]))
    for k in range(90):
        session.step(down if k < 30 else np.zeros_like(down), steps=1)
    pressed = session.positions() - body.points
    depth = float(pressed[:, 2].min())
    assert depth == pytest.approx(-60.0 * body.step_s)
    expected = predict_field(folder / "model", held=["z-"], moved=[f"z+=0,0,{depth}"]).prediction.displacement
    assert np.abs(pressed - expected).max() < 0.02 * abs(depth)


def test_models_are_taken_for_what_they_are(folder: Path) -> None:
    with pytest.raises(InputError, match="goes with a model of markers"):
        touchable(folder / "model", experiment="ct_two_material_1")
    with pytest.raises(InputError, match="from displacement fields"):
        read_model(folder / "model")


def test_a_model_comes_back(folder: Path) -> None:
    stored = json.loads((folder / "model" / "model.json").read_text())
    body = IdentifiedBody.from_dict(stored)
    assert json.loads(json.dumps(body.to_dict())) == stored
    young = {name: e for name, e, _ in body.moduli()}
    lame, shear = body.lame_of_cells()
    upper = body.mesh.points[body.mesh.cells][:, :, 2].mean(axis=1) > CORNER[2] + 20.0
    of_cells = shear * (3.0 * lame + 2.0 * shear) / (lame + shear)
    assert of_cells[upper] == pytest.approx(young["pad"]) and of_cells[~upper] == pytest.approx(young["gel"])


def put(*path: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change that sets the value at a path of keys."""

    def change(data: dict[str, Any]) -> None:
        inner: Any = data
        for key in path[:-2]:
            inner = inner[key]
        inner[path[-2]] = path[-1]

    return change


FAULTS = [
    (put("units", "SI"), "units = 'SI'"),
    (put("law", "hookean"), "law = 'hookean'"),
    (put("relative", 1), "relative = 1: must be true or false"),
    (put("cell_type", "tetra"), "cell_type = 'tetra'"),
    (put("noise_mm", float("nan")), "noise_mm = nan"),
    (put("noise_factor", -1.0), "noise_factor = -1.0"),
    (put("load_cases", [1]), "load_cases = [1]"),
    (put("zones", []), "zones = []: must not be empty"),
    (put("zones", [{}]), "must be tables with a name"),
    (put("known", 0, "poisson_ratio", 0.7), "poisson_ratio = 0.7"),
    (put("known", 0, "weather", "fine"), "weather"),
    (put("theta", [1.0]), "theta = 'a table of shape (1,)'"),
    (put("theta", 0, 700.0), "must lie within 60"),
    (put("theta", 0, None), "theta = 'not finite'"),
    (put("covariance", 0, 0, -1.0), "must not be negative"),
    (put("covariance", "much"), "must be a table of numbers"),
    (put("points", 0, 0, 1e9), "points = 'far away'"),
    (put("points", "none"), "must be a table of numbers"),
    (put("cells", 0, 0, 10**6), "must be whole numbers of the"),
    (put("cells", 0, 0, 0.5), "must be whole numbers of the"),
    (put("cells", []), "cells = []: must not be empty"),
    (put("axes", 0, 0, 2.0), "must be orthogonal"),
    (put("known_of_cell", 0, 9), "known_of_cell"),
    (put("parts", 0, 2, 0.3), "must sum to 1"),
    (put("parts", 0, 2, -1.0), "must not be negative"),
    (put("parts", 0, 1, 7), "must be rows of cell, zone and part"),
    (put("eighths", [[0, 0, 1.0]]), "eighths = 'cell 1': must sum to 1"),
    (put("format", "naibu field model 0"), "naibu field model 0"),
]


@pytest.mark.parametrize(("change", "words"), FAULTS, ids=[words for _, words in FAULTS])
def test_values_that_cannot_be_are_refused(folder: Path, tmp_path: Path, change: Callable[[dict[str, Any]], None], words: str) -> None:
    data = copy.deepcopy(json.loads((folder / "model" / "model.json").read_text()))
    change(data)
    (tmp_path / "model.json").write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        read_any_model(tmp_path)
    assert words in str(caught.value) and str(tmp_path / "model.json") in str(caught.value)
