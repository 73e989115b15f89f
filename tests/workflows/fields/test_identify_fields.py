"""From files of a field and of zones to volumes of moduli, on data of other code, by function and by command line."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from notebooks import check_shown

from naibu.cli import main
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.progress import ProgressReport
from naibu.core.volume import Volume
from naibu.identification.from_fields.estimate import NO_REGIONS, identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_fields.uncertainty import Uncertainty
from naibu.identification.verdict import Explanation
from naibu.io.displacement_fields import read_field, write_field
from naibu.io.images import read_volume, write_volume
from naibu.validation.specimens.quadratic_body import UNKNOWN, QuadraticBody, Solved
from naibu.workflows.fields import cells_of_map
from naibu.workflows.fields.block_mesh import block_mesh, blurred, misplaced, moved_borders, sizes_of_voxels
from naibu.workflows.fields.identify_fields import FieldIdentification, identify_fields, table_of_assumptions, table_of_zones
from naibu.workflows.fields.known_zones import parse_known_zones
from naibu.workflows.fields.object_on_cubes import ScannedObject

SD_MM = 0.04
TEXTS = ("identification.json", "model.json", "report.html")


@cache
def solved() -> Solved:
    return QuadraticBody("cube").solved((0.0, 0.0, -4.0), divisions=4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A cube of two gels in a scan whose axes are those of the table, turned and shifted: labels 1 below and 2 above."""
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[2:12, 2:22, 2:22], labels[12:22, 2:22, 2:22] = 1, 2
    volume = Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0), origin_mm=(100.0, 50.0, 20.0), direction=turned)
    write_volume(tmp_path / "labels.mha", volume)
    rng = np.random.default_rng(0)
    points, u = solved().at(rng.uniform(0.02, 0.98, (1500, 3)))
    u = u + SD_MM * rng.standard_normal(u.shape)
    corner = volume.to_physical(np.array([1.5, 1.5, 1.5]))
    write_field(tmp_path / "field.h5", DisplacementField.from_arrays(corner + points @ turned.T, u @ turned.T, sd_mm=SD_MM))
    return tmp_path


def test_a_zone_is_identified_on_the_grid_of_the_scan(folder: Path) -> None:
    names = {1: "gel", 2: "pad"}
    run = identify_fields(
        folder / "field.h5", zones=folder / "labels.mha", zone_names=names, known=["pad=10 kPa, 0.4"], law="linear", element_size_mm=6.7,
        out=folder / "out",
    )  # fmt: skip
    (young,), (poisson,) = run.estimate.intervals()
    assert young[0] < 5.0 < young[1] and poisson[0] < 0.45 < poisson[1]
    assert {p.name for p in run.files} == {p.name for p in (folder / "out").iterdir()}
    labels, modulus, sd = (read_volume(folder / p) for p in ("labels.mha", "out/young_modulus.mha", "out/young_modulus_sd.mha"))
    assert modulus.same_grid(labels)
    assert np.unique(modulus.values[labels.values == 2]) == pytest.approx(10.0, rel=1e-5)
    assert np.unique(modulus.values[labels.values == 1]) == pytest.approx(run.estimate.young_modulus[0], rel=1e-5)
    assert (sd.values[labels.values == 1] > 0.0).all() and not modulus.values[labels.values == 0].any()
    numbers = json.loads((folder / "out" / "identification.json").read_text())
    assert numbers["verdict"]["explanation"] == "explained" and numbers["zones"][0]["zone"] == "gel"
    page = (folder / "out" / "report.html").read_text()
    assert "Young&#x27;s modulus" in page and "Moduli under other assumptions" in page
    assert check_shown(run, folder / "out" / "report.html") == numbers["zones"]
    determined = numbers["zones"][0]["Young's modulus is"]
    assert f", {determined}</span>" in page  # with the number at the top, too


def test_what_nothing_determines_is_null_in_the_file_of_numbers(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The interval of a modulus on which there is no information ends at infinity, which JSON does not have and which was written."""

    def without_information(*of: Any, **options: Any) -> FieldEstimate:
        return replace(identify_field(*of, **options), uncertainty=Uncertainty.of(np.zeros((2, 2))))

    monkeypatch.setattr(f"{ScannedObject.__module__}.identify_field", without_information)
    options = {"zones": folder / "labels.mha", "known": ["label 2=10 kPa, 0.4"], "element_size_mm": 10.0, "law": "linear"}
    identify_fields(folder / "field.h5", out=folder / "out", **options)  # type: ignore[arg-type]
    text = (folder / "out" / "identification.json").read_text()
    (zone,) = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))["zones"]
    assert zone["95 % from"] == 0.0 and zone["to"] is None and (zone["of which 95 % from"], zone["up to"]) == (-1.0, 0.5)


def test_volumes_hold_no_number_where_none_is_determined(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The best fit of what the measurement leaves open was there, to be averaged over a segment as if it had been measured."""

    def uncertain(sd: float, of_ratio: float) -> dict[str, Volume]:
        def identified(*of: Any, **options: Any) -> FieldEstimate:
            return replace(identify_field(*of, **options), uncertainty=Uncertainty(np.eye(2), np.diag([sd, of_ratio]) ** 2))

        monkeypatch.setattr(f"{ScannedObject.__module__}.identify_field", identified)
        options = {"zones": folder / "labels.mha", "known": ["label 2=10 kPa, 0.4"], "element_size_mm": 10.0, "law": "linear"}
        run = identify_fields(folder / "field.h5", out=folder / "out", overwrite=True, **options)  # type: ignore[arg-type]
        return {p.stem: read_volume(p, missing=True) for p in run.files if p.suffix == ".mha"}

    labels = read_volume(folder / "labels.mha").values
    gel, pad = labels == 1, labels == 2
    names = ("young_modulus", "young_modulus_sd", "poisson_ratio")
    for sd, of_ratio, expected in ((1.5, 0.2, (0, 0, 0)), (0.1, 0.2, (1, 1, 1)), (0.1, 9.0, (1, 1, 0))):
        found = uncertain(sd, of_ratio)
        there = [np.isfinite(found[name].values[gel]) for name in names]
        assert [bool(one.any()) for one in there] == [bool(one.all()) for one in there] == [bool(e) for e in expected]
        assert all(np.isfinite(found[name].values[~gel]).all() and not found[name].values[labels == 0].any() for name in names)
        assert found["young_modulus"].values[pad] == pytest.approx(10.0) and (found["zones"].values[gel] == 1).all()


def test_what_the_other_law_would_give_stands_next_to_the_moduli(folder: Path) -> None:
    """To first order what the other law gives when it is used: within four tenths of the difference."""
    options = {"zones": folder / "labels.mha", "known": ["label 2=10 kPa, 0.4"], "element_size_mm": 10.0}
    linear = identify_fields(folder / "field.h5", law="linear", **options)  # type: ignore[arg-type]
    finite = identify_fields(folder / "field.h5", law="neo_hookean", **options)  # type: ignore[arg-type]
    told = {row[0]: row for row in table_of_assumptions(linear).rows}["with a neo-Hookean law at finite strain"]
    young, other = float(linear.estimate.young_modulus[0]), float(finite.estimate.young_modulus[0])
    assert told[2] == pytest.approx(other, abs=0.4 * abs(other - young))
    low, high = linear.estimate.intervals()[0][0]
    assert told[4] == ("yes" if low <= float(str(told[2])) <= high else "no")
    assert ("label 1 would leave the interval" in " ".join(linear.notes)) == any(
        row[4] == "no" for row in table_of_assumptions(linear).rows
    )


def test_the_command_line_takes_fields(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*more: str) -> int:
        options = ["--zones", str(folder / "labels.mha"), "--zone-name", "gel=1", "--element-size-mm", "10", "--out", str(folder / "out")]
        monkeypatch.setattr(sys, "argv", ["naibu", "identify", str(folder / "field.h5"), *options, *more])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    assert run("--zone-name", "pad=2", "--known", "pad=10 kPa, 0.4") == 0
    said = capsys.readouterr().out
    assert "other assumptions" in said and "Explained" in said and "gel: Young's modulus" in " ".join(said.split())
    assert (folder / "out" / "report.html").exists()
    assert run("--zone-name", "pad=7", "--known", "pad=10 kPa", "--overwrite") == 2
    assert "--zone-name names label 7" in " ".join(capsys.readouterr().err.split())


def test_a_map_finds_one_gel_where_there_is_one(folder: Path) -> None:
    run = identify_fields(
        folder / "field.h5", zones=folder / "labels.mha", known=["label 2=10 kPa, 0.4"], each_cell=True, law="linear", element_size_mm=10.0,
        out=folder / "map",
    )  # fmt: skip
    assert run.estimate.weights is not None and run.estimate.zones.count == 1
    (young,), _ = run.estimate.intervals()
    assert young[0] < 5.0 < young[1]
    assert "too coarse" in " ".join(run.notes)  # four cells a side


def test_cells_end_where_zones_meet_in_a_plane(folder: Path) -> None:
    """Twenty voxels of 2 mm, the border after 10 of them or after 7: no size of cells misses it, and cells stay near that size."""
    labels = read_volume(folder / "labels.mha")
    inside, names = labels.with_values((labels.values > 0).astype(np.uint8)), {1: "gel", 2: "pad"}
    for first in (12, 9):
        numbers = labels.values.astype(np.int64)
        numbers[2:first, 2:22, 2:22], numbers[first:22, 2:22, 2:22] = 1, 2
        for size in (5.0, 6.7, 8.0, 13.0):
            mesh, cells = block_mesh(inside, numbers, names, size)
            assert misplaced(mesh, cells, inside, numbers, names) == (0.0, 0.0)
            heights = np.unique(mesh.points[:, 2].round(6))
            assert labels.to_physical(np.array([0.0, 0.0, first - 0.5]))[2] in heights
            assert 0.5 * size < np.diff(heights).min() and np.diff(heights).max() < 1.6 * size
            assert (cells >= 0).sum() == inside.values.sum()


@pytest.mark.slow
def test_plane_borders_may_lie_anywhere_within_a_voxel(folder: Path) -> None:
    """What half a voxel is foretold to change is what labels with the border elsewhere give, and is part of the interval."""
    labels = read_volume(folder / "labels.mha")
    points, u = solved().at(np.random.default_rng(0).uniform(0.02, 0.98, (1500, 3)))
    turned, corner = np.asarray(labels.direction), labels.to_physical(np.array([1.5, 1.5, 1.5]))
    write_field(folder / "exact.h5", DisplacementField.from_arrays(corner + points @ turned.T, u @ turned.T, sd_mm=SD_MM))
    found = []
    for first in (11, 12, 13):
        numbers = labels.values.copy()
        numbers[2:first, 2:22, 2:22], numbers[first:22, 2:22, 2:22] = 1, 2
        write_volume(folder / "moved.mha", labels.with_values(numbers))
        run = identify_fields(
            folder / "exact.h5", zones=folder / "moved.mha", zone_names={1: "gel", 2: "pad"}, known=["pad=10 kPa, 0.4"], law="linear",
            element_size_mm=5.0,
        )  # fmt: skip
        found.append(run.estimate)
    half = next(a for a in found[1].assumptions if "border" in a.text)
    assert half.text == "with the border of 'gel' and 'pad' half a voxel (1 mm) further along z of the grid"
    assert all(e.mesh_shift is not None and e.surface_bias is not None for e in found)
    below, _, above = (float((e.theta - e.mesh_shift + e.surface_bias)[0]) for e in found)  # that fit best
    assert half.theta[0] == pytest.approx((above - below) / 4.0, rel=0.2)
    assert found[1].budget is not None
    assert found[1].budget.known[0] == pytest.approx(abs(half.theta[0]) / np.sqrt(3.0), rel=1e-6)


def test_a_step_of_the_surface_in_the_plane_of_a_border_stays(folder: Path) -> None:
    labels = read_volume(folder / "labels.mha")
    numbers = labels.values.astype(np.int64)
    numbers[12:, :, 16:] = 0  # the pad is narrower than the gel
    inside = labels.with_values((numbers > 0).astype(np.uint8))
    mesh, _ = block_mesh(inside, numbers, {1: "gel", 2: "pad"}, 6.7)
    (border,) = moved_borders(mesh, inside, numbers)
    way = np.linalg.norm(border.points - mesh.points, axis=1)
    x, _, z = inside.to_index(mesh.points).T
    plane = np.isclose(z, 11.5)
    np.testing.assert_allclose(way[plane & (x < 12.0)], 1.0)
    assert not way[~plane].any() and not way[x > 12.0].any() and (plane & (x > 12.0)).any()


def test_zones_that_end_inside_of_cubes_are_told(folder: Path) -> None:
    """A border that falls by half a voxel a voxel cuts cubes; one cell a voxel leaves nothing out."""
    labels = read_volume(folder / "labels.mha")
    inside, names = labels.with_values((labels.values > 0).astype(np.uint8)), {1: "gel", 2: "pad"}
    z, _, x = np.indices(labels.shape)
    numbers = np.where(inside.values > 0, np.where(z + 0.5 * x < 18.0, 1, 2), 0).astype(np.int64)
    for size, told in ((8.0, True), (2.0, False)):
        mesh, cells = block_mesh(inside, numbers, names, size)
        left_out, wrong = misplaced(mesh, cells, inside, numbers, names)
        assert left_out == 0.0 and (wrong > 0.01) == told
        for corrected, words in ((False, "not in the intervals"), (True, "part of their standard deviations")):
            assert [words in sentence for sentence in blurred(left_out, wrong, {}, corrected=corrected)] == [True] * told
    assert "at its surface" in blurred(0.02, 0.0, {}, corrected=True)[0]


def test_blocks_fill_the_object_along_its_own_axes() -> None:
    rng = np.random.default_rng(1)
    direction = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    for axes in (direction, -direction):
        inside = np.zeros((12, 14, 16))
        inside[2:10, 3:11, 4:12] = 1
        volume = Volume.from_array(inside, spacing_mm=(1.0, 1.5, 2.0), direction=axes)
        mesh, of_voxel = block_mesh(volume, np.ones(inside.shape, dtype=np.int64), {1: "body"}, 3.0)
        assert (of_voxel >= 0).sum() == inside.sum() and np.unique(of_voxel[of_voxel >= 0]).tolist() == list(range(mesh.n_cells))
        box = volume.to_index(mesh.points)
        assert box.min(axis=0) == pytest.approx([3.5, 2.5, 1.5]) and box.max(axis=0) == pytest.approx([11.5, 10.5, 9.5])


def test_elements_smaller_than_voxels_are_refused_and_slices_thicker_than_elements_told(folder: Path) -> None:
    """Cells are made of whole voxels: a size below them was taken for theirs without a word."""
    with pytest.raises(InputError, match=r"element_size_mm is 1.5 mm, less than the voxels .*\(2 x 2 x 2 mm\).*at least 2 mm"):
        identify_fields(folder / "field.h5", zones=folder / "labels.mha", known=["label 2=10 kPa"], element_size_mm=1.5)
    thick = Volume.from_array(np.ones((4, 10, 10), np.uint8), spacing_mm=(2.0, 2.0, 5.0))
    assert sizes_of_voxels(thick, 5.0) == ()
    (told,) = sizes_of_voxels(thick, 3.0)
    assert told.startswith("Along z") and "5 mm long" in told and "not 3 mm" in told
    with pytest.raises(InputError, match="element_size_mm"):
        sizes_of_voxels(thick, -3.0)


def test_what_is_rigid_hardly_bends() -> None:
    """A bone held at both ends of a scan of 51 mm, across which muscle of 11 kPa is pressed by 30 %: the beam in closed form."""
    young = parse_known_zones(["bone=rigid", "fat=5 kPa"], ["bone", "fat", "muscle"]).values["bone"][0]
    radius_mm, length_mm = 5.5, 51.0
    load = 0.3 * 11.0 * 2.0 * radius_mm  # mN/mm
    bent = load * length_mm**4 / (384.0 * young * 0.25 * np.pi * radius_mm**4)
    assert bent < 0.01


def test_known_values_and_what_is_wrong_with_them() -> None:
    names = ["gel", "bone", "pad"]
    read = parse_known_zones(["gel=12 kPa", "bone=rigid"], names)
    assert read.values["gel"] == (12.0, 0.45) and read.doubts["gel"][1] > 0.0 and read.values["bone"][0] > 1000.0 and not read.relative
    assert parse_known_zones(["pad"], names).relative
    assert parse_known_zones(["pad=10 kPa, 0.5"], names).values == parse_known_zones(["pad=10 kPa, 0.4999"], names).values
    for known, message in (
        (["skin=3 kPa"], "no zone 'skin'"),
        (["bone=rigid"], "nothing sets the scale"),
        ([], "nothing sets the scale"),
        (["gel=soft"], "write 'gel=12 kPa'"),
        (["gel=12 kPa, 0.6"], "between 0 and 0.5, not 0.6"),
        (["gel=12 kPa", "pad"], "state all, or name one"),
        (["gel=12 kPa", "gel=10 kPa"], "zone 'gel' is stated twice"),
        (["gel=12 kPa", "gel=rigid"], "zone 'gel' is stated twice"),
    ):
        with pytest.raises(InputError, match=message):
            parse_known_zones(known, names)


def test_a_rigid_zone_neither_has_other_values_nor_dwarfs_the_colours_of_soft_ones(folder: Path) -> None:
    labels = read_volume(folder / "labels.mha")
    values = labels.values.copy()
    values[12:18, 7:17, 7:17] = 3
    write_volume(folder / "cored.mha", labels.with_values(values))
    options = {"zones": folder / "cored.mha", "known": ["label 2=10 kPa, 0.4", "label 3=rigid"], "element_size_mm": 10.0}
    run = identify_fields(folder / "field.h5", law="linear", out=folder / "out", **options)  # type: ignore[arg-type]
    others = [str(row[0]) for row in table_of_assumptions(run).rows]
    assert any("'label 2'" in one for one in others) and not any("'label 3'" in one for one in others)
    (top,) = re.findall(r"\"Young's modulus, kPa\",\"low\":[-\d.e]+,\"high\":([\d.e]+)", run.page_html())
    assert float(top) < 100.0
    modulus = read_volume(folder / "out" / "young_modulus.mha", missing=True)
    assert modulus.values[values == 3].max() == pytest.approx(3e5)


def test_files_that_do_not_belong_together_are_told(folder: Path) -> None:
    far = DisplacementField.from_arrays(np.random.default_rng(0).random((100, 3)), np.ones((100, 3)), sd_mm=0.1)
    write_field(folder / "far.h5", far)
    with pytest.raises(InputError, match="from one reference scan"):
        identify_fields(folder / "far.h5", zones=folder / "labels.mha", known=["label 2=10 kPa"])
    with pytest.raises(InputError, match="give `mask`"):
        identify_fields(folder / "field.h5", known=["body=10 kPa"])


def test_a_map_without_a_known_zone_is_relative_to_its_largest_region(folder: Path) -> None:
    """A gel of 5 kPa under one of 10 kPa: 2 is found for what is above, or 1/2 for what is below."""
    run = identify_fields(
        folder / "field.h5", mask=folder / "labels.mha", each_cell=True, law="linear", element_size_mm=10.0, out=folder / "map"
    )
    found = run.estimate
    count, zones = np.bincount(found.zones.of_cell), found.zones
    assert 2 <= zones.count <= 4 and not zones.known and len(count) == zones.count and zones.of_cell.min() == 0
    height = run.body.mesh.points[found.mesh.cells].mean(axis=1)[:, 2] - found.mesh.points[:, 2].min()
    young, _ = found.intervals()
    below = np.bincount(zones.of_cell, height) / count < 20.0
    largest = int(np.argmin(np.ptp(young, axis=1)))  # the halves are equal but for where their border is found
    assert found.young_modulus[largest] == pytest.approx(1.0) and young[largest] == pytest.approx([1.0, 1.0])
    truth = np.where(below, 5.0, 10.0) / (5.0 if below[largest] else 10.0)
    assert below.any() and not below.all() and ((young[:, 0] <= truth + 1e-9) & (truth <= young[:, 1] + 1e-9)).all()
    other = below != below[largest]
    assert not ((young[other, 0] <= 1.0) & (young[other, 1] >= 1.0)).any()
    assert run.relative and run.unit == "multiples of the largest region" and "kPa" not in " ".join(run.notes)
    assert ">1 × the largest region<" in run.page_html()
    assert "largest region" in (folder / "map" / "report.html").read_text() and run.body.unit == run.unit
    assert not [name for name in TEXTS if "kPa" in (folder / "map" / name).read_text()]


def test_a_map_of_few_points_has_fewer_cells(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2500 cells, whatever the points, 500 particles took minutes for a map that shows nothing finer than they are apart."""
    monkeypatch.setattr(cells_of_map, "LEAST_OF_MAP", 200)  # of a map as small as the field
    field = read_field(folder / "field.h5")
    write_field(folder / "few.h5", DisplacementField.from_arrays(field.points[:100], field.vectors[:100], sd_mm=SD_MM))
    told: list[ProgressReport] = []
    run = identify_fields(folder / "few.h5", mask=folder / "labels.mha", each_cell=True, law="linear", progress=told.append)
    assert run.body.mesh.n_cells == 216
    tried = [r for r in told if "clusters made" in r.stage and r.done is not None]
    assert len(tried) == 1  # one region explains as much as the map: fewer clusters make no more
    assert run.estimate.zones.count == 1 and "no difference of stiffness can be told" in " ".join(run.notes)
    _, ((low, high),) = run.estimate.intervals()
    assert low <= -1.0 and UNKNOWN[1] < high  # 0.4984 to 0.4998 was told of a gel of 0.45 with 501 particles
    assert "fewer points than elements" in " ".join(run.notes)
    judged = run.estimate.verdict
    assert judged is not None and judged.ok and "but 100 points for 216 cells" in judged.sentence  # multiples can be used, moduli could not


def test_multiples_of_a_zone_are_nowhere_told_in_kilopascals(folder: Path) -> None:
    """Steps and the model said kPa; models that were written so are still read."""
    run = identify_fields(
        folder / "field.h5", zones=folder / "labels.mha", known=["label 2"], law="linear", element_size_mm=10.0, out=folder / "multiples"
    )
    (young,), _ = run.estimate.intervals()
    assert run.unit == "multiples of the known zone" and young[0] < 0.5 < young[1]
    assert not [name for name in TEXTS if "kPa" in (folder / "multiples" / name).read_text()]
    model = json.loads((folder / "multiples" / "model.json").read_text())
    former = IdentifiedBody.from_dict(model | {"units": "mm, kg, s, mN, kPa"})
    np.testing.assert_array_equal(former.theta, run.body.theta)
    with pytest.raises(InputError, match="units"):
        IdentifiedBody.from_dict(model | {"relative": False})


def with_stated_noise(folder: Path, sd_mm: float | None) -> Path:
    """Return the file of the field with another noise stated, or none."""
    field = read_field(folder / "field.h5")
    write_field(folder / "stated.h5", DisplacementField.from_arrays(field.points, field.vectors, sd_mm=sd_mm))
    return folder / "stated.h5"


@pytest.mark.parametrize(
    ("sd_mm", "told", "true"), [(0.2 * SD_MM, r"scatter (\S+) times as much", 5.0), (None, r"measurements scatter by (\S+) mm", SD_MM)]
)
def test_noise_that_is_stated_too_small_or_not_at_all_makes_no_structure(folder: Path, sd_mm: float | None, told: str, true: float) -> None:
    """The map finds one gel, as with the noise stated right; cells of 10 mm do not follow all of the displacement, which counts as well."""
    options: dict[str, Any] = {"zones": folder / "labels.mha", "known": ["label 2=10 kPa, 0.4"], "law": "linear", "element_size_mm": 10.0}
    run = identify_fields(with_stated_noise(folder, sd_mm), each_cell=True, **options)
    right = identify_fields(folder / "field.h5", each_cell=True, **options)
    found = re.search(told, " ".join(run.cautions))
    assert found is not None and true < float(found[1]) < 1.3 * true
    assert run.estimate.zones.count == 1
    np.testing.assert_allclose(run.estimate.young_modulus, right.estimate.young_modulus, rtol=0.02)
    assert run.estimate.budget is not None and right.estimate.budget is not None
    ratio = run.estimate.budget.noise / right.estimate.budget.noise
    assert (ratio > 0.95).all() and (ratio < 1.4).all()


def test_outliers_and_understated_noise_neither_bend_moduli_nor_blame_the_model(folder: Path) -> None:
    """One vector in fifty is anything, and a third of the noise is stated: the answer is that of the field without either."""
    options: dict[str, Any] = {"zones": folder / "labels.mha", "known": ["label 2=10 kPa, 0.4"], "law": "linear", "element_size_mm": 6.7}
    field, rng = read_field(folder / "field.h5"), np.random.default_rng(3)
    wrong = rng.random(len(field.points)) < 0.02
    vectors = field.vectors + np.where(wrong[:, None], rng.uniform(-4.0, 4.0, field.vectors.shape), 0.0)
    write_field(folder / "stated.h5", DisplacementField.from_arrays(field.points, vectors, sd_mm=SD_MM / 3.0))
    run, right = identify_fields(folder / "stated.h5", **options), identify_fields(folder / "field.h5", **options)
    told = re.search(r"(\d+) of 1500 measurements in the object are left out as outliers", " ".join(run.cautions))
    assert told is not None and 0.9 * wrong.sum() < int(told[1]) <= wrong.sum() + 2
    scatter = re.search(r"scatter (\S+) times as much", " ".join(run.cautions))
    assert scatter is not None and 2.8 < float(scatter[1]) < 3.5
    assert run.estimate.verdict is not None and run.estimate.verdict.explanation is Explanation.EXPLAINED
    (young,), (other,) = run.estimate.intervals()[0], right.estimate.intervals()[0]
    assert young[0] < 5.0 < young[1]
    assert np.ptp(young) == pytest.approx(np.ptp(other), rel=0.25)
    assert not {"outliers", "scatter"} & set(" ".join(right.notes).split())


def map_of_doubtful_noise(folder: Path, monkeypatch: pytest.MonkeyPatch) -> FieldIdentification:
    """Return the map of a body on few cells, where noise counts as a fifth of what it is: what regions leave is beyond it."""
    monkeypatch.setattr(f"{ScannedObject.__module__}.with_noise_of_neighbours", lambda _, case: (case, 1.0))
    with_stated_noise(folder, 0.2 * SD_MM)
    return identify_fields(folder / "stated.h5", mask=folder / "labels.mha", each_cell=True, law="linear", element_size_mm=10.0)


def test_a_map_that_no_regions_explain_says_so_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The map under the penalty has no intervals; smaller cells, on which regions are judged besides, there are none here."""
    monkeypatch.setattr("naibu.identification.from_fields.estimate.misfit_on_finer_mesh", lambda *_: None)
    run = map_of_doubtful_noise(folder, monkeypatch)
    assert run.estimate.uncertainty is None and run.notes[0].startswith(f"{NO_REGIONS} The map takes the law for right")
    assert run.unit == "multiples of the median" and "multiples of the median" in run.notes[1]
    volume = np.ones(run.estimate.zones.count)
    above = (run.estimate.young_modulus > 1.0) @ volume / volume.sum()
    assert 0.4 < above < 0.6


def test_regions_that_explain_as_much_as_the_map_on_smaller_cells_are_given(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a map of large cells explains better than the two gels do is errors of the cells."""
    run = map_of_doubtful_noise(folder, monkeypatch)
    assert run.estimate.verdict is not None and run.estimate.verdict.explanation is not Explanation.EXPLAINED
    assert run.estimate.zones.count == 2
    low, high = run.estimate.intervals()[0][int(np.argmin(run.estimate.young_modulus))]
    assert low < 0.5 < high


def test_a_surface_that_noise_folds_is_told_as_such(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise of 3 mm that counts as nearly none, in cubes of 4 mm: advice to refine them and to round off an indenter would mislead.

    A smoother motion of the surface that a body does follow is not tried: from there on the field is not explained.
    """
    monkeypatch.setattr("naibu.identification.from_fields.inversion.gauss_newton.SMOOTHER", ())
    monkeypatch.setattr("naibu.workflows.fields.object_on_cubes.with_noise_of_neighbours", lambda _, case: (case, 1.0))
    field = read_field(folder / "field.h5")
    noise = 3.0 * np.random.default_rng(5).standard_normal(field.vectors.shape)
    write_field(folder / "noisy.h5", DisplacementField.from_arrays(field.points, field.vectors + noise))
    with pytest.raises(ConvergenceError, match=r"errors of the measurement there are too large.* Use larger elements") as told:
        identify_fields(folder / "noisy.h5", zones=folder / "labels.mha", known=["label 2=10 kPa, 0.4"], element_size_mm=4.0)
    assert "indenter" not in str(told.value)


def test_a_map_whose_regions_find_no_equilibrium_is_the_result(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The map that was found before is not lost, as it was, to an error."""

    def inverted(*_: Any) -> None:
        raise ConvergenceError("a cell is inverted")

    monkeypatch.setattr("naibu.identification.from_fields.estimate.segment", inverted)
    run = identify_fields(folder / "field.h5", mask=folder / "labels.mha", each_cell=True, law="linear", element_size_mm=10.0)
    assert run.estimate.uncertainty is None and run.notes[0].startswith(f"{NO_REGIONS} The map takes the law for right")
    assert "a cell is inverted" in run.estimate.steps[-1]


@pytest.mark.parametrize(
    ("known", "each_cell", "told"), [(["body=10 kPa"], True, "leave one out; without it a map"), (["body"], False, "leave one out$")]
)
def test_what_leaves_nothing_to_be_identified_is_refused_and_leaves_no_folder(
    folder: Path, known: list[str], each_cell: bool, told: str
) -> None:
    with pytest.raises(InputError, match=told):
        identify_fields(folder / "field.h5", mask=folder / "labels.mha", known=known, each_cell=each_cell, out=folder / "nothing")
    assert not (folder / "nothing").exists()


@pytest.mark.parametrize(("high", "told"), [(20.0, "roughly determined"), (np.inf, "not determined")])
def test_a_modulus_without_an_upper_bound_is_not_determined_in_the_table_either(high: float, told: str) -> None:
    """Its standard deviation may be small all the same: errors of elements near incompressibility had one of 0.26."""
    bounds = np.array([[8.0, high]]), np.array([[-1.0, 0.5]])
    uncertainty = SimpleNamespace(of_young_and_poisson=lambda theta: np.array([[0.26], [0.1]]))
    estimate: Any = SimpleNamespace(
        uncertainty=uncertainty, verdict=None, theta=np.zeros(2), identifiability=(), zones=SimpleNamespace(names=("soft",)),
        intervals=lambda law_exact=False: bounds, young_modulus=np.array([12.0]), poisson_ratio=np.array([0.45]),
    )  # fmt: skip
    result: Any = SimpleNamespace(estimate=estimate, unit="kPa", left_out=())
    table = table_of_zones(result)
    assert table.rows[0][table.columns.index("Young's modulus is")] == told
