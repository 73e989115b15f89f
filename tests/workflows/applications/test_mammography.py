"""The verb ``naibu mammography``: from outlines in files to page and numbers, and what it refuses."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import tifffile
from notebooks import check_shown
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

from naibu import cli
from naibu.applications.mammography.breast_shape import half_ellipsoid_shape
from naibu.applications.mammography.geometric_model import compressed
from naibu.core.arrays import BoolArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.workflows.applications.mammogram_inputs import positioner_angle, read_views
from naibu.workflows.applications.mammography import NOTICE, relate_views

TURN = np.linspace(-np.pi / 2, np.pi / 2, 121)


def written(folder: Path) -> tuple[Path, Path]:
    paths = folder / "cc.csv", folder / "mlo.csv"
    for path, (depth, width) in zip(paths, ((110.0, 80.0), (112.0, 85.0)), strict=True):
        np.savetxt(path, np.column_stack([depth * np.cos(TURN), 90.0 + width * np.sin(TURN)]), delimiter=",")
    return paths


def test_page_and_numbers_from_tables_and_from_masks(tmp_path: Path) -> None:
    cc, mlo = written(tmp_path)
    common = {"thickness_mm": (60.0,), "angle_deg": 45.0, "draws": 20}
    run = relate_views(cc, mlo, point_cc=(50.0, 110.0), point_mlo=(50.0, 100.0), out=tmp_path / "tables", **common)  # type: ignore[arg-type]
    numbers = json.loads(run.files[1].read_text(encoding="utf-8"))
    assert numbers["notice"] == NOTICE
    assert NOTICE in run.files[0].read_text(encoding="utf-8")
    assert numbers["lesion"]["agrees"]
    assert [(row["quantity"], row["value"]) for row in check_shown(run, run.files[0])] == list(run.rows)
    rows, columns = np.mgrid[:360, :260]
    for name, (depth, width) in (("cc", (110.0, 80.0)), ("mlo", (112.0, 85.0))):
        mask = ((columns + 0.5) / (2 * depth)) ** 2 + ((rows + 0.5 - 180.0) / (2 * width)) ** 2 < 1.0
        tifffile.imwrite(tmp_path / f"{name}.tif", mask.astype(np.uint8))
    masks = relate_views(tmp_path / "cc.tif", tmp_path / "mlo.tif", point_cc=(50.0, 110.0), pixel_mm=0.5, out=tmp_path / "m", **common)  # type: ignore[arg-type]
    again = json.loads(masks.files[1].read_text(encoding="utf-8"))
    np.testing.assert_allclose(again["curve_in_mlo_mm"], numbers["curve_in_mlo_mm"], atol=1.5)
    curve, band = (np.array(again[name]) for name in ("curve_in_mlo_mm", "band_in_mlo_mm"))
    page = masks.files[0].read_text(encoding="utf-8")
    assert f"{curve[:, 0].min():.0f} to {curve[:, 0].max():.0f} mm" in page
    told = float(re.search(r"band reaches (\d+) mm to either side", page)[1])  # type: ignore[index]
    across = np.ptp(band[np.abs(band[:, 1] - np.median(curve[:, 1])) < 5.0][:, 0])  # the curve runs along the chest wall
    assert told == pytest.approx(0.5 * across, abs=2.0)


def test_outlines_under_neutral_names_that_may_be_swapped_are_told(tmp_path: Path) -> None:
    straight, hanging = tmp_path / "first.csv", tmp_path / "second.csv"
    for path, upper, lower in ((straight, 80.0, 80.0), (hanging, 95.0, 75.0)):
        along = np.where(TURN > 0.0, upper, lower) * np.sin(TURN)
        np.savetxt(path, np.column_stack([110.0 * np.cos(TURN), along]), delimiter=",")
    common = {"thickness_mm": (60.0,), "angle_deg": 45.0, "point_cc": (50.0, 10.0), "draws": 20}
    runs = [
        relate_views(cc, mlo, out=tmp_path / str(k), **common) for k, (cc, mlo) in enumerate(((straight, hanging), (hanging, straight)))
    ]  # type: ignore[arg-type]
    told = [any("views are swapped" in w for w in run.warnings) for run in runs]
    assert told == [False, True]
    assert "views are swapped" in runs[1].files[0].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"point_cc": None}, "point_cc is missing"),
        ({"thickness_mm": (300.0,)}, "thickness_mm"),
        ({"thickness_mm": (60.0, 60.0, 60.0)}, "thickness_mm has 3 values"),
        ({"angle_deg": 0.0}, "angle_deg is 0"),
        ({"point_cc": (50.0, 400.0)}, "outside of the outline of CC"),
        ({"point_cc": (50.0,)}, "needs two finite coordinates"),
        ({"cc": "nowhere.csv"}, "nowhere.csv"),
        ({"cc": "image.png"}, "pixel_mm is missing"),
        ({"cc": "image.png", "pixel_mm": 0.5}, "image.png"),
        ({"cc": None}, "cc is missing"),
        ({"cc": None, "mlo": None}, "`cc` and `mlo` are missing"),
        ({"angle_deg": None}, "angle_deg is missing"),
        ({"thickness_mm": None}, "thickness_mm is missing"),
        ({"model": "other"}, "model is 'other'"),
        ({"unresolved_mm": -1.0}, "unresolved_mm"),
        ({"cc": "mask.tif"}, "pixel_mm is missing"),
    ],
)
def test_what_cannot_be_used_is_refused_and_nothing_is_written(tmp_path: Path, changes: dict[str, object], told: str) -> None:
    cc, mlo = written(tmp_path)
    given: dict[str, object] = {"cc": cc, "mlo": mlo, "thickness_mm": (60.0,), "angle_deg": 45.0, "point_cc": (50.0, 110.0), "draws": 20}
    with pytest.raises(InputError, match=told):
        relate_views(out=tmp_path / "out", **{**given, **changes})  # type: ignore[arg-type]
    assert not list((tmp_path / "out").glob("*"))


def test_a_point_of_the_other_view_is_told(tmp_path: Path) -> None:
    cc, mlo = written(tmp_path)
    with pytest.raises(InputError, match="are the views swapped"):
        relate_views(cc, mlo, thickness_mm=(60.0,), angle_deg=45.0, point_cc=(10.0, 173.0), draws=20, out=tmp_path / "out")


def ellipse(depth: float, width: float, pixel: float = 0.5) -> BoolArray:
    """Return a mask of 180 x 130 mm with the half ellipse of a breast at its left side."""
    rows, columns = np.mgrid[: round(180 / pixel), : round(130 / pixel)]
    inside: BoolArray = (pixel * (columns + 0.5) / depth) ** 2 + ((pixel * (rows + 0.5) - 90.0) / width) ** 2 < 1.0
    return inside


def written_mammogram(path: Path, view: str, mask: BoolArray, *, flipped: bool = False, **tags: object) -> Path:
    """Write a mammogram of the left breast: grey tissue that thins towards the skin, air with noise, and a label."""
    random = np.random.default_rng(3)
    rows, columns = mask.shape
    grey = 100.0 + 3.0 * random.standard_normal(mask.shape)
    grey[mask] = 1200.0 + 300.0 * random.standard_normal(int(mask.sum()))
    grey[10:30, columns - 60 : columns - 10] = 4000.0
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.1.2"
    data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    data.Modality, data.ViewPosition, data.ImageLaterality = "MG", view, "L"
    data.PatientOrientation = ["A", "L" if view == "CC" else "H"] if flipped else ["A", "R" if view == "CC" else "F"]
    data.ImagerPixelSpacing, data.BodyPartThickness, data.PositionerPrimaryAngle = [0.5, 0.5], 60, 0 if view == "CC" else 45
    data.Rows, data.Columns, data.SamplesPerPixel, data.PhotometricInterpretation = rows, columns, 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.PixelData = np.clip(grey[::-1] if flipped else grey, 0, 65535).astype("<u2").tobytes()
    for name, value in tags.items():
        if value is None:
            delattr(data, name)
        else:
            setattr(data, name, value)
    data.save_as(path, enforce_file_format=True)
    return path


@pytest.fixture(scope="module")
def mammograms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("mammograms")
    cc = written_mammogram(folder / "cc.dcm", "CC", ellipse(110.0, 80.0))
    return cc, written_mammogram(folder / "mlo.dcm", "MLO", ellipse(112.0, 85.0), flipped=True)


def test_mammograms_give_thickness_angle_spacing_and_outline(tmp_path: Path, mammograms: tuple[Path, Path]) -> None:
    cc, mlo = written(tmp_path)
    tables = relate_views(cc, mlo, thickness_mm=(60.0,), angle_deg=45.0, point_cc=(50.0, 110.0), draws=20, out=tmp_path / "tables")
    run = relate_views(*mammograms, point_cc=(50.0, 110.0), draws=20, out=tmp_path / "dicom")
    numbers, expected = (json.loads(r.files[1].read_text(encoding="utf-8")) for r in (run, tables))
    assert numbers["settings"]["thickness_mm"] == "60, 60"
    assert numbers["settings"]["angle_deg"] == 45.0
    np.testing.assert_allclose(numbers["curve_in_mlo_mm"], expected["curve_in_mlo_mm"], atol=2.5)
    assert NOTICE in run.files[2].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("tags", "told"),
    [
        ({"ViewPosition": None}, "no ViewPosition"),
        ({"ViewPosition": "ML"}, "is a ML view"),
        ({"ViewPosition": "MLO"}, "are the views swapped"),
        ({"ImageLaterality": None}, "no ImageLaterality"),
        ({"ImageLaterality": "R"}, "left and the right breast"),
        ({"ImagerPixelSpacing": None}, "no ImagerPixelSpacing"),
        ({"BodyPartThickness": None}, "no BodyPartThickness"),
        ({"BodyPartThickness": 6}, "thickness_mm is 6"),
    ],
)
def test_tags_that_are_missing_or_cannot_be_are_told(
    tmp_path: Path, mammograms: tuple[Path, Path], tags: dict[str, object], told: str
) -> None:
    cc = written_mammogram(tmp_path / "cc.dcm", "CC", ellipse(110.0, 80.0), **tags)
    with pytest.raises(InputError, match=told):
        relate_views(cc, mammograms[1], point_cc=(50.0, 110.0), draws=20, out=tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize(
    ("of_cc", "of_mlo", "between"), [(0, -45, 45.0), (0, 315, 45.0), (-3, 47, 50.0), (None, 50, 50.0), (358, 43, 45.0)]
)
def test_the_angle_between_the_views_is_told_from_both_tags(tmp_path: Path, of_cc: int | None, of_mlo: int, between: float) -> None:
    cc = written_mammogram(tmp_path / "cc.dcm", "CC", ellipse(110.0, 80.0), PositionerPrimaryAngle=of_cc)
    mlo = written_mammogram(tmp_path / "mlo.dcm", "MLO", ellipse(112.0, 85.0), PositionerPrimaryAngle=of_mlo)
    assert positioner_angle(read_views(cc, mlo, None), None) == between


def test_mammograms_given_as_the_other_view_and_empty_ones_are_told(tmp_path: Path, mammograms: tuple[Path, Path]) -> None:
    with pytest.raises(InputError, match="are the views swapped"):
        relate_views(mammograms[1], mammograms[0], point_cc=(50.0, 110.0), draws=20, out=tmp_path / "out")
    empty = written_mammogram(tmp_path / "cc.dcm", "CC", np.zeros((360, 260), dtype=bool))
    with pytest.raises(InputError, match="look like a breast"):
        relate_views(empty, mammograms[1], point_cc=(50.0, 110.0), draws=20, out=tmp_path / "out")


def test_a_png_mask_is_read_as_a_table(tmp_path: Path) -> None:
    cc, mlo = written(tmp_path)
    matplotlib.image.imsave(tmp_path / "cc.png", ellipse(110.0, 80.0), cmap="gray")
    common = {"thickness_mm": (60.0,), "angle_deg": 45.0, "draws": 20, "point_cc": (50.0, 110.0), "pixel_mm": 0.5}
    run = relate_views(tmp_path / "cc.png", mlo, out=tmp_path / "png", **common)  # type: ignore[arg-type]
    tables = relate_views(cc, mlo, out=tmp_path / "tables", **common)  # type: ignore[arg-type]
    numbers, expected = (json.loads(r.files[1].read_text(encoding="utf-8")) for r in (run, tables))
    np.testing.assert_allclose(numbers["curve_in_mlo_mm"], expected["curve_in_mlo_mm"], atol=1.5)


def test_a_point_of_a_scan_is_shown_in_both_views(tmp_path: Path) -> None:
    """Mask of a half ellipsoid, 120 x 130 x 80 mm, of the right breast, in LPS."""
    z, y, x = np.mgrid[-66:67:3.0, -4:84:2.0, -62:63:2.5]
    inside = (x / 60.0) ** 2 + (z / 65.0) ** 2 + ((80.0 - y) / 80.0) ** 2 < 1.0
    mask = (inside & (y < 80.0)).astype(np.uint8)
    write_volume(tmp_path / "mask.nii", Volume(mask, np.array([2.5, 2.0, 3.0]), np.array([-62.0, -4.0, -66.0]), np.eye(3)))
    common = {"mr": tmp_path / "mask.nii", "thickness_mm": (65.0,), "angle_deg": 45.0, "draws": 20, "point_mr": (-12.0, 40.0, 20.0)}
    run = relate_views(side="right", out=tmp_path / "out", **common)  # type: ignore[arg-type]
    numbers = json.loads(run.files[1].read_text(encoding="utf-8"))
    known = compressed(half_ellipsoid_shape((120.0, 130.0, 80.0)), 0.0, 65.0)
    np.testing.assert_allclose(numbers["point_of_scan_in_cc_mm"], known.project([12.0, 20.0, 40.0]), atol=2.0)
    with pytest.raises(InputError, match="side is None"):
        relate_views(out=tmp_path / "other", **common)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="outside of the unloaded breast"):
        relate_views(side="right", out=tmp_path / "other", **{**common, "point_mr": (-12.0, -40.0, 20.0)})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="point_mr is given without `mr`"):
        relate_views(*written(tmp_path), point_mr=(0.0, 0.0, 0.0), out=tmp_path / "other")


def test_a_point_of_projections_is_shown_in_both_views(tmp_path: Path) -> None:
    """A half ellipsoid, 120 x 130 x 80 mm, from above and from the side; the chest wall at x = 5."""
    for name, half, middle in (("axial", 60.0, 30.0), ("sagittal", 65.0, -20.0)):
        curve = np.column_stack([5.0 + 80.0 * np.cos(TURN), middle + half * np.sin(TURN)])
        np.savetxt(tmp_path / f"{name}.csv", curve, delimiter=",")
    paths = {"mr_axial": tmp_path / "axial.csv", "mr_sagittal": tmp_path / "sagittal.csv"}
    common = {**paths, "thickness_mm": (65.0,), "angle_deg": 45.0, "draws": 20, "point_mr": (45.0, 42.0, 0.0)}
    run = relate_views(out=tmp_path / "out", **common)  # type: ignore[arg-type]
    numbers = json.loads(run.files[1].read_text(encoding="utf-8"))
    known = compressed(half_ellipsoid_shape((120.0, 130.0, 80.0)), 0.0, 65.0)
    np.testing.assert_allclose(numbers["point_of_scan_in_cc_mm"], known.project([12.0, 20.0, 40.0]), atol=0.5)
    np.savetxt(tmp_path / "shallow.csv", 0.8 * np.loadtxt(tmp_path / "axial.csv", delimiter=","), delimiter=",")
    for changes, told in (
        ({"mr_axial": None}, "mr_axial is missing"),
        ({"mr": tmp_path / "mask.nii"}, "give the mask or the projections"),
        ({"side": "left"}, "side is 'left', but there is no scan"),
        ({"mr_axial": tmp_path / "shallow.csv"}, "64 mm deep in the axial projection and 80 mm in the sagittal one"),
        ({"constrain_outlines": True}, "constrain_outlines needs"),
    ):
        with pytest.raises(InputError, match=told):
            relate_views(out=tmp_path / "other", **{**common, **changes})  # type: ignore[arg-type]
        assert not (tmp_path / "other" / "mammography.html").exists()


def test_the_verb_with_the_mechanical_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    cc, mlo = written(tmp_path)
    words = ["mammography", "--cc", str(cc), "--mlo", str(mlo), "--thickness-mm", "60,58", "--angle-deg", "45", "--point-cc", "50,110"]
    monkeypatch.setattr(sys, "argv", ["naibu", *words, "--draws", "20", "--model", "mechanical", "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    numbers = json.loads((tmp_path / "out" / "mammography.json").read_text(encoding="utf-8"))
    assert numbers["settings"]["model"] == "mechanical"
    assert len(numbers["curve_in_mlo_mm"]) > 50
    monkeypatch.setattr(sys, "argv", ["naibu", "mammography", "--cc", str(cc), "--point-cc", "50,110", "--out", str(tmp_path / "none")])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert "--mlo is missing" in capsys.readouterr().err
