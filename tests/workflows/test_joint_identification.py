"""Markers and a displacement field together, by the command line: two bodies of the same gels, each solved by code of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from virtual_press import TRUTH, Press

from naibu.cli import main
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.identification.joint_estimate import NormalEstimate, joint_estimate
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import QuadraticBody
from naibu.workflows.joint_identification import JointIdentification, identify_jointly, table_of_moduli, told_by_markers
from naibu.workflows.results.result_folder import read_model

SOFT, FIRM = (TRUTH["soft: young_modulus"], TRUTH["soft: poisson_ratio"]), (TRUTH["firm: young_modulus"], TRUTH["firm: poisson_ratio"])
SD_MM = 0.02


def written_field(folder: Path) -> None:
    """Write the field in a cube of both gels, and its zones."""
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[2:12, 2:22, 2:22], labels[12:22, 2:22, 2:22] = 1, 2
    write_volume(folder / "labels.mha", Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0), origin_mm=(0.0, 0.0, 0.0)))
    rng = np.random.default_rng(0)
    body = QuadraticBody("cube", SOFT, FIRM).solved((0.0, 0.0, -1.0), divisions=4)
    points, u = body.at(rng.uniform(0.02, 0.98, (800, 3)))
    corner = np.array([3.0, 3.0, 3.0]) - body.points.min(axis=0)
    field = DisplacementField.from_arrays(points + corner, u + SD_MM * rng.standard_normal(u.shape), sd_mm=SD_MM)
    write_field(folder / "field.h5", field)


def naibu(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        assert not end.code


def test_one_material_in_markers_and_in_a_field(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written_field(tmp_path)
    naibu(
        monkeypatch, "identify", press.folder, tmp_path / "field.h5", "--zones", tmp_path / "labels.mha", "--zone-name", "soft=1",
        "--zone-name", "firm=2", "--known", "firm=200 kPa", "--state", "press/pressed", "--element-size-mm", "10",
        "--out", tmp_path / "out",
    )  # fmt: skip
    told = json.loads((tmp_path / "out" / "joint.json").read_text())
    assert told["usable"]
    assert "soft: young_modulus" in told["shared"]
    young = next(row for row in told["moduli"] if row["parameter"] == "soft, Young's modulus")
    assert young["both"]["from"] < SOFT[0] < young["both"]["to"]
    width = {kind: np.log(young[kind]["to"] / young[kind]["from"]) for kind in ("markers", "fields", "both")}
    assert width["both"] <= told["widened"] * min(width["markers"], width["fields"])
    apart = json.loads((tmp_path / "out" / "fields" / "identification.json").read_text())["zones"][0]
    assert young["fields"]["estimate"] == pytest.approx(apart["Young's modulus, kPa"], rel=1e-9)
    assert young["fields"]["from"] == pytest.approx(apart["95 % from"], rel=1e-6)
    model = read_model(tmp_path / "out" / "markers")
    assert (young["markers"]["from"], young["markers"]["to"]) == pytest.approx(model.interval("soft: young_modulus"), rel=1e-3)
    page = (tmp_path / "out" / "report.html").read_text()
    assert told["in_words"][0] in page


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
    shown = JointIdentification(press.identification, None, joint, table, ())  # type: ignore[arg-type]
    (row,) = shown.to_records()
    assert (row["markers"], row["fields"]) == pytest.approx((10.0, 11.0))
    assert row["both"] == pytest.approx(np.sqrt(110.0))
    assert np.log(row["both_upper"] / row["both_lower"]) == pytest.approx(2.0 * 1.959964 * np.sqrt(0.005))


def test_a_known_name_in_neither_kind_is_refused(press: Press, tmp_path: Path) -> None:
    written_field(tmp_path)
    with pytest.raises(InputError, match="'lead', which is neither a material of the experiments"):
        identify_jointly([press.folder], [tmp_path / "field.h5"], zones=tmp_path / "labels.mha", known=["lead=2 kPa"], out=tmp_path / "out")
