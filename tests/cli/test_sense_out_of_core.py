"""``naibu sense`` of scans that do not fit into the memory that may be taken: block by block, from the command line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from naibu import cli
from naibu.core.volume import Volume
from naibu.imaging.displacement.strain import green_lagrange_strain
from naibu.io.images import read_volume, write_volume
from naibu.validation.specimens.textured_sphere import squeezed_ball

zarr = pytest.importorskip("zarr")
GIGABYTES = "0.36"  # of which the measurement in memory would take more


def naibu(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["naibu", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = capsys.readouterr()
    return int(end.value.code or 0), said.out, " ".join(said.err.split())


def test_scans_larger_than_the_memory_are_measured_block_by_block(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    before, after, truth, _ = squeezed_ball(seed=1)
    for name, volume in (("before", before), ("after", after)):
        fine = ndimage.zoom(volume.values.astype(float), [2 - 1 / n for n in volume.shape], order=3).astype(np.float32)
        write_volume(Path(f"{name}.zarr"), Volume.from_array(fine, spacing_mm=volume.spacing_mm / 2.0))
    scans = "before.zarr", "after.zarr", "--memory-gb", GIGABYTES, "-o", "moved"
    code, _, said = naibu(monkeypatch, capsys, "sense", *scans, "--resume")
    assert code == 2 and "--resume" in said and "nothing to resume" in said
    code, _, said = naibu(monkeypatch, capsys, "sense", *scans, "--truth", "before.zarr")
    assert code == 2 and "--truth" in said
    code, out, said = naibu(monkeypatch, capsys, "sense", *scans, "--multiscale", "--json")
    assert code == 0, said
    assert "block by block" in said
    told = json.loads(out)
    assert {Path(file).name for file in told["files"]} >= {"report.html", "displacement.zarr", "standard_deviation.zarr", "mask.zarr"}
    facts = json.loads(Path("moved/sense.json").read_text())["diagnostics"]
    assert facts["blocks"] > 1
    mask = read_volume("moved/mask.zarr").values > 0
    displacement = np.asarray(zarr.open_group("moved/displacement.zarr", mode="r")["values"][:])
    assert displacement.shape == (*(2 * n - 1 for n in before.shape), 3)
    assert np.median(np.linalg.norm(displacement[::2, ::2, ::2] - truth, axis=-1)[mask[::2, ::2, ::2]]) < 0.15
    # a viewer finds all resolutions of the displacement
    levels = zarr.open_group("moved/displacement.ome.zarr", mode="r")
    (scales,) = dict(levels.attrs)["ome"]["multiscales"] if "ome" in levels.attrs else levels.attrs["multiscales"]
    assert np.array_equal(np.moveaxis(np.asarray(levels[scales["datasets"][0]["path"]][:]), 0, -1), displacement, equal_nan=True)
    strain = np.moveaxis(np.asarray(zarr.open_group("moved/strain.ome.zarr", mode="r")["0"][:]), 0, -1)
    wanted = green_lagrange_strain(displacement, read_volume("moved/mask.zarr"))
    np.testing.assert_array_equal(strain[..., 2], wanted[..., 2, 2].astype(np.float32))
    np.testing.assert_array_equal(strain[..., 4], wanted[..., 0, 2].astype(np.float32))


def test_bad_scans_are_refused_and_leave_nothing_to_resume(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    shape, rng = (70, 72, 74), np.random.default_rng(2)
    scan = rng.standard_normal(shape).astype(np.float32)
    holed, small = scan.copy(), np.zeros(shape, np.uint8)
    holed[40, 20, 60], small[:3] = np.nan, 1
    volumes = {
        "scan": scan, "moved": np.roll(scan, 1, 2), "holed": holed, "unknown": np.full(shape, np.nan, np.float32), "lower": scan[:60],
        "constant": np.full(shape, 7, np.int16), "zero": np.zeros(shape, np.uint8), "small": small, "slice": scan[:1],
    }  # fmt: skip
    for name, values in volumes.items():
        write_volume(Path(f"{name}.zarr"), Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0), missing=True))
    write_volume(Path("wider.zarr"), Volume.from_array(scan, spacing_mm=(1.0, 1.0, 1.2)))
    for words, expected in (
        ("constant scan", ("reference", "constant", "7")),
        ("scan unknown", ("deformed", "every voxel is NaN")),
        ("holed moved", ("a voxel near", "reference", "NaN")),
        ("scan lower", ("no common content", "lies on another grid", "70")),
        ("scan wider", ("deformed", "as many voxels", "wrong spacing")),
        ("slice slice", ("74 x 72 x 1 voxels", "lucas-kanade")),
        ("scan moved --mask zero", ("--mask", "empty")),
        ("scan moved --mask small", ("mask spans [37, 36, 3] voxels",)),
        ("scan moved --mask lower", ("mask", "different grids", "60")),
    ):
        files = [word if word.startswith("-") else f"{word}.zarr" for word in words.split()]
        code, _, said = naibu(monkeypatch, capsys, "sense", *files, "--memory-gb", GIGABYTES, "-o", "out")
        assert code == 2 and all(part in said for part in expected), said
        assert not [path for path in Path("out").rglob("*") if path.is_file()]
