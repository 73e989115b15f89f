"""From two scans to fields, numbers and a page."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from naibu.cli import main
from naibu.core.errors import InputError, NaibuError
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.imaging.measure_displacement import METHODS, matched_rigidly, measure_displacement
from naibu.io.displacement_fields import read_field
from naibu.io.images import read_displacement, read_volume, write_displacement, write_volume
from naibu.io.meshes import read_mesh
from naibu.io.tables.marker_tables import import_markers
from naibu.validation.specimens.textured_sphere import squeezed_ball
from naibu.viewer.slices import slices_html
from naibu.workflows.measurement.compare_methods import compare_methods
from naibu.workflows.measurement.sense import Pair, read_pair, sense_pair
from naibu.workflows.measurement.sense_page import slice_view

Array = np.ndarray


def at(grid: Volume, points: Array) -> tuple[Array, ...]:
    """Indices of the voxels at points."""
    return tuple(np.round(grid.to_index(points)).astype(int).T[::-1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scans")
    before, after, truth, mask = squeezed_ball(seed=3)
    write_volume(path / "before.mha", before)
    write_volume(path / "after.nrrd", after)
    write_volume(path / "mask.nii.gz", before.with_values(mask.astype(np.uint8)))
    write_displacement(path / "truth.mha", truth, before)
    return path


# what classic methods reach on this pair; the rigid motion alone leaves a bump of 1.5 mm
@pytest.mark.parametrize(
    ("method", "most_mm"),
    [("default", 0.15), ("features", 1.0), ("horn-schunck", 0.3), ("lucas-kanade", 0.4), ("ncc-blocks", 0.6), ("rigid", 0.6)],
)
def test_every_method_finds_the_motion(method: str, most_mm: float) -> None:
    before, after, truth, mask = squeezed_ball(seed=3)
    sensed = measure_displacement(before, after, method=method, mask=mask)  # type: ignore[arg-type]
    error = np.linalg.norm(sensed.displacement.vectors - truth, axis=-1)[mask & sensed.displacement.valid]
    assert np.median(error) < most_mm
    assert np.isnan(sensed.displacement.vectors[~mask]).all()


def test_the_default_states_a_covariance_that_holds_the_truth() -> None:
    before, after, truth, _ = squeezed_ball(seed=3)
    found = measure_displacement(before, after)
    field = found.displacement.at_points(step=3)
    error = field.vectors - truth[at(before, field.points)]
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(field.covariance), error)
    assert 0.8 < np.mean(squared < 7.81) <= 1.0  # chi-squared of three degrees of freedom, 95 %


def test_matched_points_register_rotation_and_shift() -> None:
    before, after, _, mask = squeezed_ball(seed=3)
    matches, rigid = matched_rigidly(before, after, mask)
    assert len(matches) > 30
    assert rigid.angle_deg == pytest.approx(3.0, abs=0.7)


def test_files_are_what_other_programs_read(folder: Path, tmp_path: Path) -> None:
    pair = read_pair(folder / "before.mha", folder / "after.nrrd", mask=folder / "mask.nii.gz", truth=folder / "truth.mha")
    run = sense_pair(pair, out=tmp_path)
    vectors, grid = read_displacement(tmp_path / "displacement.mha")
    assert grid.same_grid(pair.reference)
    assert np.allclose(vectors, run.measured.displacement.vectors, atol=1e-5, equal_nan=True)
    assert_one_hexahedron_between_eight_voxels(read_mesh(tmp_path / "displacement.vtu"), run.measured.displacement.valid, grid)
    field = read_field(tmp_path / "field.h5")
    assert len(field.points) > 500 and field.covariance is not None  # blocks of voxels
    before, after = (import_markers(tmp_path / f"{name}.csv") for name in ("initial", "pressed"))
    assert 100 < len(before) < 400
    assert np.abs(after.points - before.points - run.measured.displacement.vectors[at(pair.reference, before.points)]).max() < 1e-6
    numbers = json.loads((tmp_path / "sense.json").read_text())
    assert numbers["figures"]["median_error_mm"] < 0.15
    assert set(numbers["inputs"]) == {"reference", "deformed", "mask", "truth"}
    assert numbers["inputs"]["deformed"] == f"after.nrrd, SHA-256 {hashlib.sha256((folder / 'after.nrrd').read_bytes()).hexdigest()}"
    page = (tmp_path / "report.html").read_text()
    assert "standard deviation of the displacement" in page
    assert not re.search(r"(?:src|href)=\"https?:", page)


def assert_one_hexahedron_between_eight_voxels(mesh: Mesh, known: Array, grid: Volume) -> None:
    """Cells are those of the grid, and there is one wherever the displacement is known at all corners; of voxels (nz, ny, nx)."""
    corners = grid.to_index(mesh.points)[mesh.cells]
    np.testing.assert_allclose(np.ptp(corners, axis=1), 1.0, atol=1e-4)
    lowest = np.rint(corners.min(axis=1)).astype(int)[:, ::-1]
    assert (np.abs(np.sort(corners - lowest[:, None, ::-1], axis=1) - np.repeat([[0.0], [1.0]], 4, axis=0)) < 1e-4).all()
    full = np.all([np.roll(known, (-z, -y, -x), (0, 1, 2)) for z in (0, 1) for y in (0, 1) for x in (0, 1)], axis=0)
    assert np.array_equal(lowest[np.lexsort(lowest.T[::-1])], np.argwhere(full))


def test_the_same_scans_give_the_same_files(folder: Path, tmp_path: Path) -> None:
    pair = read_pair(folder / "before.mha", folder / "after.nrrd")
    for name in ("a", "b"):
        sense_pair(pair, out=tmp_path / name)
    for file in ("displacement.mha", "field.h5"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_scans_of_one_name_in_two_folders_are_both_recorded(folder: Path, tmp_path: Path) -> None:
    for part, file in (("a", "before.mha"), ("b", "mask.nii.gz")):
        (tmp_path / part).mkdir()
        write_volume(tmp_path / part / "scan.mha", read_volume(folder / file))
    inputs = read_pair(tmp_path / "a" / "scan.mha", tmp_path / "b" / "scan.mha").inputs
    assert inputs["reference"] != inputs["deformed"]


def test_a_single_slice_has_all_files_but_the_mesh(folder: Path, tmp_path: Path) -> None:
    for name in ("before.mha", "after.nrrd"):
        volume = read_volume(folder / name)
        middle = Volume.from_array(volume.values[11:12], spacing_mm=volume.spacing_mm)
        write_volume(tmp_path / name, middle)
    run = sense_pair(read_pair(tmp_path / "before.mha", tmp_path / "after.nrrd"), method="horn-schunck", out=tmp_path / "out")
    assert {p.name for p in run.files} == {p.name for p in (tmp_path / "out").iterdir()}
    assert {"report.html", "displacement.mha", "field.h5", "sense.json"} <= {p.name for p in run.files}
    assert not (tmp_path / "out" / "displacement.vtu").exists()


def test_a_field_that_folds_is_named_on_the_page(folder: Path) -> None:
    pair = read_pair(folder / "before.mha", folder / "after.nrrd")
    run = sense_pair(pair, method="rigid")
    assert not any("folds" in sentence for sentence in slice_view(pair, run).sentences)
    assert run.page_html() == slices_html(slice_view(pair, run)) and run.to_records()[0]["quantity"] == "measured fraction of the object"
    figure = run.plot()
    z = int(np.argmax(run.measured.mask.sum(axis=(1, 2))))
    np.testing.assert_allclose(
        figure.axes[0].images[0].get_array()[run.measured.mask[z]],
        np.linalg.norm(run.measured.displacement.vectors[z], axis=-1)[run.measured.mask[z]],
    )
    plt.close(figure)
    folded = replace(run, figures=run.figures | {"folded_fraction": 0.125})
    assert any("folds at 12.50 %" in sentence for sentence in slice_view(pair, folded).sentences)


def test_the_page_states_positions_of_the_scan_and_the_part_that_was_not_measured() -> None:
    before, after, _, mask = squeezed_ball(seed=3)
    pair = Pair(before, after, mask, {}, ("before", "after"))
    run = sense_pair(pair, method="rigid")
    view = slice_view(pair, run)
    first = np.array([at.min() for at in np.nonzero(mask)])[::-1] - 4  # voxels around the object
    np.testing.assert_allclose(view.origin_mm, before.to_physical(np.maximum(first, 0)), atol=1e-9)
    assert not any("not measured" in sentence for sentence in view.sentences)
    part = replace(run, figures={**run.figures, "measured_fraction": 0.75})
    assert any("25.0 % of the object was not measured" in sentence for sentence in slice_view(pair, part).sentences)


def test_both_scans_may_have_a_mask_and_doubts_are_on_every_page(folder: Path, tmp_path: Path) -> None:
    volume = read_volume(folder / "mask.nii.gz")
    stepped = np.array(volume.values)
    write_volume(tmp_path / "late.mha", volume.with_values(np.roll(stepped, 1, 2)))
    pair = read_pair(folder / "before.mha", folder / "after.nrrd", mask=folder / "mask.nii.gz", deformed_mask=tmp_path / "late.mha")
    assert np.array_equal(pair.deformed_mask, np.roll(stepped, 1, 2) != 0)
    assert set(pair.inputs) == {"reference", "deformed", "mask", "deformed_mask"}
    run = sense_pair(pair, method="rigid")
    doubtful = replace(run, measured=replace(run.measured, warnings=("The `mask` jumps.",)))
    assert "The mask jumps." in slice_view(pair, doubtful).sentences


def test_a_mask_that_jumps_is_named_and_padding_is_not_in_it() -> None:
    before, after, _, _ = squeezed_ball(seed=3)
    lost = np.array(before.values)
    lost[7:17] = lost.min()
    lost[7:17, 16:26, 18:28] = before.values[7:17, 16:26, 18:28]
    found = measure_displacement(before.with_values(lost), after, method="rigid")
    assert any("jumps between neighbouring slices" in text for text in found.warnings)
    padded = np.array(before.values, dtype=np.float32)
    padded[:, :, :20] = -3000.0
    found = measure_displacement(before.with_values(padded), after, method="rigid")
    assert not found.mask[:, :, :20].any() and found.mask[:, :, 20:].any()


def test_methods_that_all_fail_say_why(folder: Path, tmp_path: Path) -> None:
    tiny = write_volume(tmp_path / "tiny.mha", Volume.from_array(np.zeros((6, 6, 6)), spacing_mm=(1, 1, 1)))
    with pytest.raises(NaibuError):
        compare_methods(read_pair(tiny, tiny), ["features", "features"], out=tmp_path / "out")


def test_scans_that_no_method_can_compare_are_told_once(folder: Path, tmp_path: Path) -> None:
    """Every method said the same sentence."""
    said: list[str] = []
    values = np.random.default_rng(0).random((6, 7, 8))
    for name, other in (("spacing", 10.0), ("same", 1.0)):
        scans = [
            write_volume(tmp_path / f"{name}{k}.mha", Volume.from_array(v, spacing_mm=3 * [s]))
            for k, (v, s) in enumerate(((values, 1.0), (values if other > 1.0 else 0.0 * values, other)))
        ]
        with pytest.raises(InputError, match=r"other units\?" if other > 1.0 else "constant"):
            compare_methods(read_pair(*scans), ["rigid", "features"], out=tmp_path / "out", told=said.append)
    assert not said and not (tmp_path / "out").exists()


def test_scans_on_different_grids_are_refused(folder: Path) -> None:
    before, after, *_ = squeezed_ball(seed=3)
    tenfold = Volume.from_array(after.values, spacing_mm=10.0 * np.array([1.5, 1.5, 2.0]))
    with pytest.raises(InputError, match=r"other units\?"):
        measure_displacement(before, tenfold)
    other = Volume.from_array(after.values, spacing_mm=(1.5, 1.5, 1.9))
    with pytest.raises(InputError, match=r"different grids: their voxel spacings differ: \[1\.5, 1\.5, 2\.0\] and"):
        measure_displacement(before, other)
    elsewhere = Volume.from_array(after.values, spacing_mm=before.spacing_mm, origin_mm=before.origin_mm + np.array([3.0, 0.0, 4.0]))
    with pytest.raises(InputError, match=r"agree in size and spacing, but their origins lie 5 mm apart"):
        measure_displacement(before, elsewhere)
    with pytest.raises(InputError, match="not 'best'"):
        measure_displacement(before, after, method="best")  # type: ignore[arg-type]


def test_one_scan_given_twice_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r"hold the same intensities at every voxel.*given twice"):
        sense_pair(read_pair(folder / "before.mha", folder / "before.mha"), method="rigid")


def test_a_mask_of_another_scan_is_refused(folder: Path, tmp_path: Path) -> None:
    write_volume(tmp_path / "mask.mha", Volume.from_array(np.ones((3, 3, 3), np.uint8), spacing_mm=(1, 1, 1)))
    with pytest.raises(InputError, match=r"mask\.mha does not lie on the grid of before\.mha: their sizes differ"):
        read_pair(folder / "before.mha", folder / "after.nrrd", mask=tmp_path / "mask.mha")


def test_a_scan_that_was_not_measured_everywhere_is_read_and_left_out_there(tmp_path: Path) -> None:
    before, after, truth, mask = squeezed_ball(seed=3)
    lost = after.values.astype(np.float32)
    lost[:, :, : lost.shape[2] // 4] = np.nan
    write_volume(tmp_path / "before.mha", before)
    write_volume(tmp_path / "after.nrrd", after.with_values(lost))
    pair = read_pair(tmp_path / "before.mha", tmp_path / "after.nrrd")
    assert np.isnan(pair.deformed.values).sum() == np.isnan(lost).sum()
    found = measure_displacement(pair.reference, pair.deformed, mask=mask).displacement
    answered = mask & found.valid
    nz, ny, nx = lost.shape
    index = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), np.arange(nz), indexing="ij"), axis=-1).transpose(2, 1, 0, 3)
    goes_to = index[..., 0] + truth[..., 0] / before.spacing_mm[0]  # voxel of the deformed scan along x
    assert not answered[goes_to < nx // 4 - 2].any()
    assert answered[mask & (goes_to > nx // 4 + 4)].mean() > 0.95
    assert np.median(np.linalg.norm(found.vectors - truth, axis=-1)[answered]) < 0.15
    with pytest.raises(InputError, match="NaN, which only digital volume correlation leaves out"):
        measure_displacement(pair.reference, pair.deformed, method="ncc-blocks", mask=mask)
    with pytest.raises(InputError, match="is nan; mask or repair it"):
        read_volume(tmp_path / "after.nrrd")


def test_the_verbs(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        return int(end.value.code or 0)

    scanned = (folder / "before.mha", folder / "after.nrrd")
    assert run("sense", *scanned, "--out", tmp_path / "s", "--method", "horn-schunck") == 0
    assert (tmp_path / "s" / "report.html").exists()
    chosen = ("--method", "rigid", "--method", "horn-schunck", "--truth", folder / "truth.mha")
    assert run("compare-methods", *scanned, *chosen, "--out", tmp_path / "c") == 0
    rows = json.loads((tmp_path / "c" / "methods.json").read_text())["tables"][0]["rows"]
    assert [r[0] for r in rows] == ["rigid", "horn-schunck"]
    assert run("sense", tmp_path / "nothing.mha", scanned[1]) == 2
    assert "nothing.mha" in capsys.readouterr().err


def test_every_method_has_a_place_on_the_command_line() -> None:
    from typing import get_args

    from naibu.cli.imaging import Method

    assert get_args(Method) == METHODS


def test_methods_are_told_and_written_one_after_the_other(folder: Path, tmp_path: Path) -> None:
    pair = read_pair(folder / "before.mha", folder / "after.nrrd", mask=folder / "mask.nii.gz", truth=folder / "truth.mha")
    seen: list[tuple[str, int]] = []
    shares: list[float] = []

    def told(sentence: str) -> None:
        table = json.loads((tmp_path / "methods.json").read_text())["tables"][0]
        seen.append((sentence.partition(":")[0], len(table["rows"])))

    result = compare_methods(
        pair, ["rigid", "sad-blocks"], out=tmp_path, told=told, progress=lambda report: shares.append(report.fraction or 0.0)
    )
    assert seen == [("rigid", 1), ("sad-blocks", 2)]
    assert shares == sorted(shares) and set(shares) == {0.0, 0.5}
    error = {row[0]: dict(zip(result.columns, row, strict=True))["95th percentile of the error, mm"] for row in result.rows}
    assert f"Nearest to the truth by the 95th percentile of the error: {min(error, key=error.get)}" in result.page.read_text(
        encoding="utf-8"
    )


def _textured(points: Array) -> Array:
    """Density at points (..., 3), mm, of a soft-edged ball of radius 18 mm with texture, in closed form."""
    waves = np.random.default_rng(5).normal(0.0, 0.45, (40, 3))
    phases = np.random.default_rng(6).uniform(0.0, 2.0 * np.pi, 40)
    texture = np.cos(points @ waves.T + phases).sum(axis=-1) / np.sqrt(40.0)
    return np.asarray((1000.0 + 300.0 * texture) / (1.0 + np.exp((np.linalg.norm(points, axis=-1) - 18.0) / 0.6)))


def test_a_deformed_scan_on_another_grid_is_resampled_and_said(tmp_path: Path) -> None:
    stretch, shift = np.diag([0.02, 0.01, -0.05]), np.array([1.0, -0.7, 1.5])
    before = Volume.from_array(np.zeros((30, 40, 44)), spacing_mm=(1.2, 1.2, 1.8), origin_mm=(-26.0, -24.0, -26.0))
    flipped = Volume.from_array(
        np.zeros((40, 44, 46)), spacing_mm=(1.1, 1.25, 1.3), origin_mm=(27.0, 26.0, -25.0), direction=np.diag([-1.0, -1.0, 1.0])
    )
    write_volume(tmp_path / "before.mha", before.with_values(_textured(before.positions()).astype(np.float32)))
    back = np.linalg.inv(np.eye(3) + stretch)
    write_volume(tmp_path / "after.nii.gz", flipped.with_values(_textured((flipped.positions() - shift) @ back).astype(np.float32)))
    pair = read_pair(tmp_path / "before.mha", tmp_path / "after.nii.gz")
    run = sense_pair(pair)
    field = run.measured.displacement
    answered = run.measured.mask & field.valid
    error = np.linalg.norm(field.vectors - before.positions() @ stretch - shift, axis=-1)[answered]
    assert answered.sum() > 0.9 * run.measured.mask.sum() and np.median(error) < 0.1
    assert "resampled to the grid of the reference" in run.measured.warnings[0]


def test_values_of_coinciding_voxels_are_those_that_were_stored(tmp_path: Path) -> None:
    before, after, *_ = squeezed_ball(seed=3)
    write_volume(tmp_path / "before.mha", before)
    turned = replace(
        after, values=np.ascontiguousarray(after.values[3:, ::-1, ::-1]), direction=np.diag([-1.0, -1.0, 1.0]),
        origin_mm=after.to_physical([after.shape[2] - 1, after.shape[1] - 1, 3]),
    )  # fmt: skip
    write_volume(tmp_path / "turned.mha", turned)
    pair = read_pair(tmp_path / "before.mha", tmp_path / "turned.mha")
    np.testing.assert_array_equal(pair.deformed.values[3:], after.values[3:])
    assert np.isnan(pair.deformed.values[:3]).all() and "of its voxels lie outside" in pair.notes[0]
    stretched = Volume.from_array(after.values, spacing_mm=before.spacing_mm * [1.0, 1.0, 0.9])
    write_volume(tmp_path / "stretched.mha", stretched)
    with pytest.raises(InputError, match="as many voxels, but their voxel spacings differ"):
        read_pair(tmp_path / "before.mha", tmp_path / "stretched.mha")
