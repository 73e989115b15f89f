"""The verb ``naibu mammography``: from outlines in files to page and numbers, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from naibu.core.errors import InputError
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
    rows, columns = np.mgrid[:360, :260]
    for name, (depth, width) in (("cc", (110.0, 80.0)), ("mlo", (112.0, 85.0))):
        mask = ((columns + 0.5) / (2 * depth)) ** 2 + ((rows + 0.5 - 180.0) / (2 * width)) ** 2 < 1.0
        tifffile.imwrite(tmp_path / f"{name}.tif", mask.astype(np.uint8))
    masks = relate_views(tmp_path / "cc.tif", tmp_path / "mlo.tif", point_cc=(50.0, 110.0), pixel_mm=0.5, out=tmp_path / "m", **common)  # type: ignore[arg-type]
    again = json.loads(masks.files[1].read_text(encoding="utf-8"))
    np.testing.assert_allclose(again["curve_in_mlo_mm"], numbers["curve_in_mlo_mm"], atol=1.5)


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
        ({"cc": "image.png"}, "PNG"),
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
