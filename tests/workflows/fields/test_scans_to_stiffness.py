"""From CT scans before and after to the stiffness inside, by the command line: a virtual liver with a lump, solved on another mesh."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from naibu.cli import main
from naibu.io.images import read_volume, write_volume
from naibu.validation.specimens.scanned_liver import LIVER, LUMP, Lump, ScannedLiver, scanned_liver


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


@pytest.mark.slow
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


def mapped(monkeypatch: pytest.MonkeyPatch, folder: Path, scans: ScannedLiver) -> tuple[list[dict[str, float]], float]:
    """Return the zones of a map of the liver, and Dice's coefficient of the second one and the lumps, 0 where there is no second."""
    written(folder, scans)
    naibu(
        monkeypatch, "sense", folder / "before.mha", folder / "after.mha", "--mask", folder / "labels.mha", "--out", folder / "sensed",
    )  # fmt: skip
    naibu(
        monkeypatch, "identify", folder / "sensed" / "field.h5", "--zones", folder / "labels.mha", "--zone-name", "pad=1",
        "--zone-name", "liver=2", "--known", "pad=10 kPa, 0.45", "--map", "--out", folder / "found",
    )  # fmt: skip
    found = read_volume(folder / "found" / "zones.mha").values == 2
    both = int(found.sum() + scans.lump.sum())
    return zones_of(folder / "found"), 2.0 * float((found & scans.lump).sum()) / max(both, 1)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "lump_within"), [(0, 0.15), (1, 0.15)])
def test_a_lump_is_found_in_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, lump_within: float) -> None:
    """Size and stiffness of a small lump can be told from each other roughly: its interval holds the truth, and nothing else is found."""
    zones, dice = mapped(monkeypatch, tmp_path, scanned_liver(seed=seed))
    assert len(zones) == 2 and dice > 0.85
    for zone, (young, _), within in zip(zones, (LIVER, LUMP), (0.15, lump_within), strict=True):
        assert zone["95 % from"] < young < zone["to"]
        assert zone["Young's modulus, kPa"] == pytest.approx(young, rel=within)


@pytest.mark.slow
def test_a_liver_without_a_lump_is_not_given_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (zone,), _ = mapped(monkeypatch, tmp_path, scanned_liver(seed=21, lumps=()))
    assert zone["95 % from"] < LIVER[0] < zone["to"]


@pytest.mark.slow
@pytest.mark.parametrize(("young", "seed"), [(2.0, 23), (10.0, 21), (25.0, 22)])
def test_softer_and_stiffer_lumps_lie_in_their_intervals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, young: float, seed: int) -> None:
    """Of .4, 2 and 5 times the modulus of the liver; where the contrast is low, size and stiffness are told apart less well."""
    zones, dice = mapped(monkeypatch, tmp_path, scanned_liver(seed=seed, lumps=[Lump(young_modulus=young)]))
    assert len(zones) == 2 and dice > 0.75
    for zone, truth in zip(zones, (LIVER[0], young), strict=True):
        assert zone["95 % from"] < truth < zone["to"]


@pytest.mark.slow
def test_two_lumps_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lumps = [Lump((-11.0, 3.0, 15.0)), Lump((11.0, -4.0, 16.0), young_modulus=12.0)]
    zones, dice = mapped(monkeypatch, tmp_path, scanned_liver(seed=22, lumps=lumps))
    assert len(zones) == 2 and dice > 0.75  # as one material
    assert zones[1]["95 % from"] < 12.0 and zones[1]["to"] > 15.0
