"""Markers and a displacement field together, by the command line: two bodies of the same gels, each solved by code of its own."""

from __future__ import annotations

import json
import re
import sys
from html import escape, unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from virtual_press import TRUTH, Press

from naibu.cli import main
from naibu.cli.shell.console import NOT_EXPLAINED
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.joint_estimate import NormalEstimate, joint_estimate
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import QuadraticBody
from naibu.workflows.interactive.touchable_models import touchable
from naibu.workflows.joint_identification import JointIdentification, identify_jointly, table_of_moduli
from naibu.workflows.joint_model import told_by_markers
from naibu.workflows.results.result_folder import read_identified_body, read_model

SOFT, FIRM = (TRUTH["soft: young_modulus"], TRUTH["soft: poisson_ratio"]), (TRUTH["firm: young_modulus"], TRUTH["firm: poisson_ratio"])
SD_MM = 0.02
_ENDS = (("estimate", ""), ("from", "_lower"), ("to", "_upper"))


def written_field(folder: Path, soft: tuple[float, float] = SOFT) -> None:
    """Write the field in a cube of both gels, and its zones; the soft one may have another Young's modulus and Poisson's ratio."""
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[2:12, 2:22, 2:22], labels[12:22, 2:22, 2:22] = 1, 2
    write_volume(folder / "labels.mha", Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0), origin_mm=(0.0, 0.0, 0.0)))
    rng = np.random.default_rng(0)
    body = QuadraticBody("cube", soft, FIRM).solved((0.0, 0.0, -1.0), divisions=4)
    points, u = body.at(rng.uniform(0.02, 0.98, (800, 3)))
    corner = np.array([3.0, 3.0, 3.0]) - body.points.min(axis=0)
    field = DisplacementField.from_arrays(points + corner, u + SD_MM * rng.standard_normal(u.shape), sd_mm=SD_MM)
    write_field(folder / "field.h5", field)


def naibu(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path, code: int = 0) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    assert (end.value.code or 0) == code


def test_one_material_in_markers_and_in_a_field(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The soft gel of the field is more compressible than that around the markers, and these say so."""
    written_field(tmp_path, (SOFT[0], 0.4))
    naibu(
        monkeypatch, "identify", press.folder, tmp_path / "field.h5", "--zones", tmp_path / "labels.mha", "--zone-name", "soft=1",
        "--zone-name", "firm=2", "--known", "firm=200 kPa", "--state", "press/pressed", "--element-size-mm", "10",
        "--out", tmp_path / "out", code=NOT_EXPLAINED,
    )  # fmt: skip
    told = json.loads((tmp_path / "out" / "joint.json").read_text())
    assert not told["usable"]
    assert any("with the moduli from both, markers are met to" in line for line in told["in_words"])
    _agrees_with_its_parts(tmp_path / "out", told)
    read = read_model(tmp_path / "out")
    assert "with the moduli from both" in read.reservation
    naibu(monkeypatch, "predict", tmp_path / "out", press.folder, "--state", "pressed", "--out", tmp_path / "state")
    naibu(monkeypatch, "predict", tmp_path / "out", "--hold", "z-", "--move", "z+=0,0,-1", "--out", tmp_path / "cube")
    for folder in ("state", "cube"):
        assert "doubtful" in " ".join(json.loads((tmp_path / folder / "summary.json").read_text())["notes"])
    assert read.uncertainty.discrepancy_mm > 2.0 * read_model(tmp_path / "out" / "markers").uncertainty.discrepancy_mm
    _is_touched_and_cut(press, tmp_path / "out", monkeypatch)


def test_intervals_of_markers_of_the_field_and_of_both_hold_the_truth(
    press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On elements so coarse that they put Poisson's ratio of the field too low."""
    written_field(tmp_path)
    naibu(
        monkeypatch, "identify", press.folder, tmp_path / "field.h5", "--zones", tmp_path / "labels.mha", "--zone-name", "soft=1",
        "--zone-name", "firm=2", "--known", "firm=200 kPa", "--state", "press/pressed", "--element-size-mm", "10",
        "--out", tmp_path / "out",
    )  # fmt: skip
    told = json.loads((tmp_path / "out" / "joint.json").read_text())
    assert told["usable"]
    truths = {"soft, Young's modulus": SOFT[0], "soft, Poisson's ratio": SOFT[1], "firm, Poisson's ratio": FIRM[1]}
    rows = {row["parameter"]: row for row in told["moduli"]}
    assert rows.keys() == truths.keys()
    for name, truth in truths.items():
        for kind in ("markers", "fields", "both"):
            if rows[name][kind]["estimate"] is not None:
                assert rows[name][kind]["from"] < truth < rows[name][kind]["to"], (name, kind)


def _is_touched_and_cut(press: Press, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Touched is the body of the field, or that of the markers where the experiment is named; doubt is said, also where it is cut."""
    young = next(r for r in json.loads((out / "joint.json").read_text())["moduli"] if r["parameter"] == "soft, Young's modulus")["both"]
    of_field, of_markers = touchable(out), touchable(out, experiment=press.folder)
    shown = re.search(r"soft ([\d.]+), firm 200 \(kPa\)", of_field.sentences[0])
    assert shown is not None and shown[1] == f"{young['estimate']:.3g}"
    assert read_identified_body(out).moduli()[0][1] == pytest.approx(young["estimate"], rel=1e-9)
    assert "of the body of press" in of_markers.sentences[0]
    for model in (of_field, of_markers):
        assert "doubtful: with the moduli from both, markers are met to" in model.sentences[-1]
    path = out / "blade.csv"
    path.write_text("x1,y1,z1,x2,y2,z2\n" + "\n".join(f"13,{y},13,13,{y},60" for y in (-5, 13, 60)) + "\n")
    naibu(monkeypatch, "cut", out, "--path", path, "--pull-percent", "10", "--out", out / "cut")
    told = json.loads((out / "cut" / "cut.json").read_text())
    assert told["pieces"] == 1
    assert told["volume_before_mm3"] == pytest.approx(40.0**3)
    assert 0.0 < told["largest_opening_mm"] < 2.0 * 4.0  # the ends part by 4 mm
    assert told["doubt"] == of_field.doubt
    assert of_field.doubt in unescape((out / "cut" / "cut.html").read_text())


def _agrees_with_its_parts(out: Path, told: dict[str, Any]) -> None:
    assert "soft: young_modulus" in told["shared"]
    young = next(row for row in told["moduli"] if row["parameter"] == "soft, Young's modulus")
    width = {kind: np.log(young[kind]["to"] / young[kind]["from"]) for kind in ("markers", "fields", "both")}
    assert width["both"] <= told["widened"] * min(width["markers"], width["fields"])
    apart = json.loads((out / "fields" / "identification.json").read_text())["zones"][0]
    assert young["fields"]["estimate"] == pytest.approx(apart["Young's modulus, kPa"], rel=1e-9)
    assert young["fields"]["from"] == pytest.approx(apart["95 % from"], rel=1e-6)
    model = read_model(out / "markers")
    assert (young["markers"]["from"], young["markers"]["to"]) == pytest.approx(model.interval("soft: young_modulus"), rel=1e-3)
    page = (out / "report.html").read_text()
    assert escape(told["in_words"][0]) in page
    assert f"<strong>{young['both']['estimate']:.3g} kPa</strong>" in page.split("</header>")[0]


@pytest.mark.slow
def test_the_joint_model_predicts_both_bodies(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A state of the experiment, and the cube when it is sheared, which other code solves."""
    written_field(tmp_path)
    found = identify_jointly(
        [press.folder], [tmp_path / "field.h5"], zones=tmp_path / "labels.mha", zone_names={1: "soft", 2: "firm"},
        known=["firm=200 kPa"], states={"press": ["pressed"]}, settings=ModelSettings(element_size_mm=10.0), out=tmp_path / "out",
    )  # fmt: skip
    assert found.usable
    young = next(row for row in found.to_records() if row["parameter"] == "soft, Young's modulus")
    _predicts_both(press, tmp_path / "out", {end: young[f"both{name}"] for end, name in _ENDS}, monkeypatch)


def _predicts_both(press: Press, out: Path, young: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """The joint model predicts a state with more compression, and the cube when it is sheared, which other code solves."""
    of_markers, of_fields = read_model(out), read_identified_body(out)
    assert of_markers.parameters.values()["soft: young_modulus"] == pytest.approx(young["estimate"], rel=1e-9)
    assert of_markers.interval("soft: young_modulus") == pytest.approx((young["from"], young["to"]), rel=1e-6)
    assert of_fields.moduli()[0][1] == pytest.approx(young["estimate"], rel=1e-9)
    assert np.linalg.eigvalsh(of_markers.uncertainty.covariance).min() > 0.0
    alone = read_model(out / "markers")
    of_young = of_markers.uncertainty.names.index("soft: young_modulus")
    assert of_markers.uncertainty.covariance[of_young, of_young] < alone.uncertainty.covariance[of_young, of_young]
    naibu(monkeypatch, "predict", out, press.folder, "--state", "pressed", "--out", out / "state")
    told = json.loads((out / "state" / "summary.json").read_text())
    assert told["rms_3d_mm"] / np.sqrt(3.0) < 1.5 * told["median_sd_mm"]
    rng = np.random.default_rng(1)
    body = QuadraticBody("cube", SOFT, FIRM).solved((1.0, 0.0, 0.0), divisions=4)
    points, u = body.at(rng.uniform(0.02, 0.98, (800, 3)))
    field = DisplacementField.from_arrays(
        points + np.array([3.0, 3.0, 3.0]) - body.points.min(axis=0), u + SD_MM * rng.standard_normal(u.shape), sd_mm=SD_MM
    )
    write_field(out / "sheared.h5", field)
    naibu(monkeypatch, "predict", out, out / "sheared.h5", "--out", out / "sheared")
    compared = json.loads((out / "sheared" / "summary.json").read_text())["comparison"]
    assert compared["rms_in_standard_deviations"] < 1.5


def test_scales_of_moduli_agree_with_finite_differences(press: Press) -> None:
    """ln(1 - 2 nu) from ln(kappa / mu), and from the scale on which markers are fitted."""
    model = press.identification.model
    told = told_by_markers(model)
    p = next(q for q in model.parameters.free if q.name == "soft: poisson_ratio")
    at, step = p.inner(p.value), 1e-5
    slope = (np.log(1.0 - 2.0 * p.physical(at + step)) - np.log(1.0 - 2.0 * p.physical(at - step))) / (2.0 * step)
    assert told.standard_deviation(p.name) == pytest.approx(abs(slope) * model.standard_deviation(p.name), rel=1e-6)


def test_a_table_for_a_notebook_holds_what_each_kind_tells(press: Press) -> None:
    parts = [NormalEstimate(("soft: young_modulus",), np.log([e]), np.array([[0.01]])) for e in (10.0, 11.0)]
    joint = joint_estimate(parts)
    table = table_of_moduli(parts, joint, relative=False)
    shown = JointIdentification(press.identification, None, joint, None, table, ())  # type: ignore[arg-type]
    (row,) = shown.to_records()
    assert (row["markers"], row["fields"]) == pytest.approx((10.0, 11.0))
    assert row["both"] == pytest.approx(np.sqrt(110.0))
    assert np.log(row["both_upper"] / row["both_lower"]) == pytest.approx(2.0 * 1.959964 * np.sqrt(0.005))


def test_a_known_name_in_neither_kind_is_refused(press: Press, tmp_path: Path) -> None:
    written_field(tmp_path)
    with pytest.raises(InputError, match="'lead', which is neither a material of the experiments"):
        identify_jointly([press.folder], [tmp_path / "field.h5"], zones=tmp_path / "labels.mha", known=["lead=2 kPa"], out=tmp_path / "out")
