"""From CT scans before and after to the stiffness inside, by the command line: a virtual liver with a lump, solved on another mesh."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from naibu.cli import main
from naibu.io.images import read_volume, write_volume
from naibu.validation.specimens.scanned_liver import LIVER, LUMP, ScannedLiver, scanned_liver


def naibu(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        assert not end.code


def written(folder: Path, scans: ScannedLiver) -> None:
    for name, volume in (("before", scans.before), ("after", scans.after), ("labels", scans.labels)):
        write_volume(folder / f"{name}.mha", volume)


def zones_of(folder: Path) -> list[dict[str, float]]:
    return list(json.loads((folder / "identification.json").read_text())["zones"])


def test_moduli_of_outlined_zones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = scanned_liver(voxel_mm=0.8, element_size_mm=2.2, seed=2)
    written(tmp_path, scans)
    labels = np.where(scans.lump, 3, scans.labels.values).astype(np.uint8)
    write_volume(tmp_path / "outlined.mha", scans.labels.with_values(labels))
    naibu(
        monkeypatch, "sense", tmp_path / "before.mha", tmp_path / "after.mha", "--mask", tmp_path / "labels.mha",
        "--out", tmp_path / "sensed",
    )  # fmt: skip
    naibu(
        monkeypatch, "identify", tmp_path / "sensed" / "field.h5", "--zones", tmp_path / "outlined.mha", "--zone-name", "pad=1",
        "--zone-name", "liver=2", "--zone-name", "lump=3", "--known", "pad=10 kPa, 0.45", "--out", tmp_path / "found",
    )  # fmt: skip
    for zone, (young, _) in zip(zones_of(tmp_path / "found"), (LIVER, LUMP), strict=True):
        assert zone["95 % from"] < young < zone["to"]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "lump_within"), [(0, 0.15), (1, 0.15)])
def test_a_lump_is_found_in_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, lump_within: float) -> None:
    """Size and stiffness of a small lump can be told from each other roughly: its interval holds the truth, and nothing else is found."""
    scans = scanned_liver(seed=seed)
    written(tmp_path, scans)
    naibu(
        monkeypatch, "sense", tmp_path / "before.mha", tmp_path / "after.mha", "--mask", tmp_path / "labels.mha",
        "--out", tmp_path / "sensed",
    )  # fmt: skip
    naibu(
        monkeypatch, "identify", tmp_path / "sensed" / "field.h5", "--zones", tmp_path / "labels.mha", "--zone-name", "pad=1",
        "--zone-name", "liver=2", "--known", "pad=10 kPa, 0.45", "--map", "--out", tmp_path / "found",
    )  # fmt: skip
    zones = zones_of(tmp_path / "found")
    assert len(zones) == 2
    found = read_volume(tmp_path / "found" / "zones.mha").values == 2
    assert 2.0 * (found & scans.lump).sum() / (found.sum() + scans.lump.sum()) > 0.85
    for zone, (young, _), within in zip(zones, (LIVER, LUMP), (0.15, lump_within), strict=True):
        assert zone["95 % from"] < young < zone["to"]
        assert zone["Young's modulus, kPa"] == pytest.approx(young, rel=within)
