"""What is planned is what an identification of data from other code then states; pushes, points and noise count as they should."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from naibu.cli import main
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.experiment import Layer
from naibu.core.volume import Volume
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import KNOWN, SIDE_MM, UNKNOWN, QuadraticBody
from naibu.workflows.fields.design import design
from naibu.workflows.fields.identify_fields import identify_fields

SIZE, EDGE_MM, SD_MM = (SIDE_MM, SIDE_MM, SIDE_MM), 10.0, 0.04
LAYERS = (Layer("gel", 0.0, 0.5 * SIDE_MM), Layer("pad", 0.5 * SIDE_MM, SIDE_MM))
MATERIALS = {"known": [f"pad={KNOWN[0]} kPa, {KNOWN[1]}"], "expected": [f"gel={UNKNOWN[0]} kPa, {UNKNOWN[1]}"]}
PUSHES = {"z+=0,0,-4": (0.0, 0.0, -4.0), "z+=3,0,0": (3.0, 0.0, 0.0)}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube of two gels that other code pressed and sheared, in a scan."""
    place = tmp_path_factory.mktemp("measured")
    labels = np.ones((20, 20, 20), dtype=np.uint8)
    labels[10:] = 2
    write_volume(place / "labels.mha", Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0), origin_mm=(1.0, 1.0, 1.0)))
    for seed, push in enumerate(PUSHES.values()):
        rng = np.random.default_rng(seed)
        points, u = QuadraticBody("cube").solved(push, divisions=4).at(rng.uniform(0.0, 1.0, (800, 3)))
        field = DisplacementField.from_arrays(points, u + SD_MM * rng.standard_normal(u.shape), sd_mm=SD_MM)
        write_field(place / f"push{seed}.h5", field)
    return place


@pytest.mark.parametrize("plates_only", [True, False])
def test_the_plan_is_what_the_identification_then_states(measured: Path, plates_only: bool) -> None:
    """Standard deviations of noise, from measurements of another mesh and code; the realised one also holds an estimate of the noise."""
    plan = design(
        size_mm=SIZE, layers=LAYERS, **MATERIALS, pushes=list(PUSHES), points=[800], noise_mm=[SD_MM], plates_only=plates_only,
        law="linear", element_size_mm=EDGE_MM,
    )  # fmt: skip
    alone, together = plan.rows[0], plan.rows[2]
    for planned, names in ((alone, ["push0.h5"]), (together, ["push0.h5", "push1.h5"])):
        found = identify_fields(
            [measured / name for name in names], zones=measured / "labels.mha", zone_names={1: "gel", 2: "pad"}, known=MATERIALS["known"],
            loaded=["z-", "z+"] if plates_only else [], law="linear", element_size_mm=EDGE_MM,
        ).estimate  # fmt: skip
        assert found.budget is not None
        noise = found.budget.noise[0] / np.sqrt(found.budget.shared) / max(found.noise_factor, 1.0)
        assert planned.noise_sd == pytest.approx(noise, rel=0.35)
        (low, high), *_ = found.intervals()[0]
        assert low < UNKNOWN[0] < high
    assert together.noise_sd < 0.95 * alone.noise_sd


def test_markers_in_a_table_and_a_field_are_identified_together(measured: Path) -> None:
    """Two loads of one cube, one measured as a field and one by sixty markers: one modulus, better known than from the field alone."""
    rng = np.random.default_rng(5)
    points, u = QuadraticBody("cube").solved(PUSHES["z+=3,0,0"], divisions=4).at(rng.uniform(0.05, 0.95, (60, 3)))
    rows = np.hstack([points, u + 0.02 * rng.standard_normal(u.shape), np.full((60, 3), 0.02)])
    header = ",".join(f"{name}{axis}_mm" for name in ("", "u", "sd_") for axis in "xyz")
    np.savetxt(measured / "markers.csv", rows, delimiter=",", header=header, comments="")
    sds = []
    for names in (["push0.h5"], ["push0.h5", "markers.csv"]):
        found = identify_fields(
            [measured / name for name in names], zones=measured / "labels.mha", zone_names={1: "gel", 2: "pad"}, known=MATERIALS["known"],
            loaded=["z-", "z+"], law="linear", element_size_mm=EDGE_MM,
        ).estimate  # fmt: skip
        (low, high), *_ = found.intervals()[0]
        assert low < UNKNOWN[0] < high and found.budget is not None
        sds.append(found.budget.noise[0] / np.sqrt(found.budget.shared))
    assert sds[1] < sds[0]


def test_noise_points_and_free_sides_count_as_they_should(tmp_path: Path) -> None:
    options = {"size_mm": SIZE, "layers": LAYERS, **MATERIALS, "pushes": ["z+=0,0,-4"], "law": "linear", "element_size_mm": EDGE_MM}
    plan = design(points=[400, 1600], noise_mm=[0.02, 0.04], plates_only=True, out=tmp_path, **options)  # type: ignore[arg-type]
    few, few_noisy, many, _ = (row.noise_sd for row in plan.rows)
    assert few_noisy == pytest.approx(2.0 * few, rel=0.1) and many == pytest.approx(0.5 * few, rel=0.25)
    anywhere = design(points=[400], noise_mm=[0.02], **options).rows[0]  # type: ignore[arg-type]
    assert anywhere.noise_sd > 3.0 * few
    assert "forces may act on the whole surface" not in plan.notes[-1] and plan.rows[0].zone == "gel"
    assert json.loads((tmp_path / "design.json").read_text())["rows"][0]["points"] == 400
    assert "Expected accuracy" in (tmp_path / "design.html").read_text()


def test_the_command_line_and_what_it_refuses(
    measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*words: str) -> int:
        options = ["--out", str(tmp_path / "out"), "--element-size-mm", "13"]
        monkeypatch.setattr(sys, "argv", ["naibu", "design", *words, *options])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    labels = ["--zones", str(measured / "labels.mha"), "--zone-name", "gel=1", "--zone-name", "pad=2"]
    stated = ["--known", "pad=10 kPa", "--expect", "gel=5 kPa", "--push", "z+=0,0,-2"]
    assert run(*labels, *stated, "--plates-only") == 0
    assert "Best: z+=0,0,-2" in capsys.readouterr().out and (tmp_path / "out" / "design.html").exists()
    (row,) = json.loads((tmp_path / "out" / "design.json").read_text(encoding="utf-8"))["rows"]
    expected = np.hypot(row["SD, %"], row["systematic error, %"])
    page = (tmp_path / "out" / "design.html").read_text(encoding="utf-8")
    assert f"to {expected:.2g} % (standard deviation {row['SD, %']:.2g} %, systematic error" in page


def test_a_push_that_shows_nothing_is_no_best_one(tmp_path: Path) -> None:
    """A push of 4 um, as of one that was given in metres, beside noise of 40 um."""
    plan = design(
        size_mm=SIZE, layers=LAYERS, **MATERIALS, pushes=["z+=0,0,-0.004"], points=[100], noise_mm=[SD_MM], law="linear",
        element_size_mm=EDGE_MM, out=tmp_path / "plan",
    )  # fmt: skip
    assert plan.notes[0].startswith("None of these pushes determines the modulus of gel") and "Best" not in "".join(plan.notes)

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    stored = json.loads((tmp_path / "plan" / "design.json").read_text(encoding="utf-8"), parse_constant=refuse)
    assert stored["rows"][0]["to, kPa"] is None


def test_what_is_missing_or_wrong_is_told() -> None:
    good = {"size_mm": SIZE, "layers": LAYERS, **MATERIALS, "pushes": ["z+=0,0,-1"]}
    for change, message in (
        ({"pushes": []}, "without .*pushes"),
        ({"pushes": ["z+=0,0"]}, "must name a side and its displacement"),
        ({"pushes": ["top=0,0,1"]}, "side 'top' is not known"),
        ({"points": [3]}, "points must lie between"),
        ({"noise_mm": [0.0]}, "noise_mm"),
        ({"expected": []}, "what the moduli of 'gel' may be"),
        ({"expected": ["skin=5 kPa"]}, "no unknown zone 'skin'"),
        ({"expected": ["gel=soft"]}, "write 'gel=12 kPa'"),
        ({"known": []}, "nothing sets the scale"),
        ({"layers": ()}, "needs `layers`"),
        ({"layers": LAYERS[:1]}, "must fill the height"),
        ({"layers": (LAYERS[0], replace(LAYERS[1], from_base_mm=LAYERS[0].to_base_mm + 1.5))}, "from 20 to 21.5 mm there is none"),
        ({"layers": (LAYERS[0], replace(LAYERS[1], from_base_mm=LAYERS[0].to_base_mm - 1.5))}, "from 18.5 to 20 mm there is more than one"),
        ({"pushes": ["z+=0,0,-40"]}, "z.=0,0,-40.*40 mm long along z.*push less far"),
        ({"pushes": ["x-=45,0,0"]}, "mm long along x"),
        ({"size_mm": None}, "give `zones`"),
    ):
        with pytest.raises(InputError, match=message):
            design(**{**good, **change})  # type: ignore[arg-type]
