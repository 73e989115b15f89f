"""From MR scans of a leg of four layers to the stiffness of muscle and skin, by the command line; solved on a mesh of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from naibu.cli import main
from naibu.io.images import write_volume
from naibu.validation.specimens.scanned_leg import MUSCLE, SKIN, LegShape, leg_mesh, pressed, scanned_leg

OTHER = LegShape((41.0, 39.0), 5.0, 7.5, ((-9.0, 4.0, 9.5), (14.0, 6.0, 6.0)), (14.0, 14.0), (1.0, 8.0, -1.0))


def naibu(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        assert not end.code


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "seed", "element_size_mm"), [(LegShape(), 4, 0.0), (OTHER, 5, 0.0), (OTHER, 5, 4.5)])
def test_no_modulus_of_a_layered_leg_is_wrong_with_a_small_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: LegShape, seed: int, element_size_mm: float
) -> None:
    """Cells as large as its layers are thick do not determine a leg well: where the verdict stands, intervals hold the truth."""
    leg = scanned_leg(shape=shape, element_size_mm=4.2, seed=seed)
    for name, volume in (("before", leg.before), ("after", leg.after), ("labels", leg.labels)):
        write_volume(tmp_path / f"{name}.mha", volume)
    naibu(monkeypatch, "sense", tmp_path / "before.mha", tmp_path / "after.mha", "--out", tmp_path / "sensed")
    size = ["--element-size-mm", str(element_size_mm)] if element_size_mm else []
    names = [part for k, name in enumerate(("bone", "muscle", "fat", "skin"), start=1) for part in ("--zone-name", f"{name}={k}")]
    naibu(
        monkeypatch, "identify", tmp_path / "sensed" / "field.h5", "--zones", tmp_path / "labels.mha", *names, "--known", "bone=rigid",
        "--known", "fat=5 kPa, 0.45", *size, "--out", tmp_path / "found",
    )  # fmt: skip
    found = json.loads((tmp_path / "found" / "identification.json").read_text())
    zones = {zone["zone"]: zone for zone in found["zones"]}
    assert set(zones) == {"muscle", "skin"}
    words = " ".join(found["in_words"])
    if found["verdict"]["explanation"] != "not_explained":
        for name, (young, _) in (("muscle", MUSCLE), ("skin", SKIN)):
            assert zones[name]["95 % from"] < young < zones[name]["to"]
    assert "not to be used" in words or "One element thick in a large part: " in words


def test_the_mesh_of_the_leg_has_the_sections_of_its_tissues() -> None:
    """Areas of ellipses and circles: curved edges leave a few parts in a thousand, straight ones cut five per cent off a bone."""
    shape, mesh = LegShape(), leg_mesh(element_size_mm=7.0)
    barycentric = 0.1381966 + 0.4472136 * np.eye(4)  # integrates squares exactly
    slopes = np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    edges = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
    volume = np.zeros(mesh.n_cells)
    for at in barycentric:
        d = [(4.0 * at[i] - 1.0) * slopes[i] for i in range(4)] + [4.0 * (at[i] * slopes[j] + at[j] * slopes[i]) for i, j in edges]
        volume += np.linalg.det(np.einsum("ai,maj->mij", np.array(d), mesh.points[mesh.cells])) / 24.0
    area = np.bincount(mesh.regions, volume) / float(np.ptp(mesh.points[:, 2]))
    assert area[0] == pytest.approx(sum(np.pi * r**2 for _, _, r in shape.bones), rel=5e-3)
    assert area.sum() == pytest.approx(np.pi * np.prod(shape.half_axes_mm), rel=5e-3)


def test_the_plate_moves_and_bones_stay() -> None:
    mesh = leg_mesh(element_size_mm=9.0)
    u = pressed(mesh, LegShape(push_mm=(0.5, 2.0, 0.0)))
    assert np.abs(u[np.unique(mesh.cells[mesh.regions == 0])]).max() == 0.0
    moved = np.isclose(u, (0.5, 2.0, 0.0), atol=1e-9).all(axis=1)
    assert moved.sum() > 8 and (mesh.points[moved, 1] < -30.0).all()
