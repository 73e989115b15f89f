"""From two clouds of particles in a gel to its stiffness, by the command line: a cube of two gels that other code solved."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from naibu.cli import main
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.validation.specimens.quadratic_body import KNOWN, SIDE_MM, UNKNOWN, QuadraticBody

PARTICLES, LOST, SPURIOUS = 3000, 0.15, 100
SD_MM = np.array([0.01, 0.01, 0.03])


def naibu(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        assert not end.code


def written_clouds(folder: Path) -> None:
    """Write the particles that were seen before and after, each time others lost and invented, in another order, and the zones."""
    rng = np.random.default_rng(0)
    body = QuadraticBody("cube").solved((0.0, 0.0, -0.6), divisions=4)  # small strain, as the code that solves it takes it
    points, u = body.at(rng.uniform(0.02, 0.98, (PARTICLES, 3)))
    points = points - body.points.min(axis=0)
    for name, there in (("before", points), ("after", points + u)):
        seen = there[rng.uniform(size=PARTICLES) > LOST] + 0.0
        seen += SD_MM * rng.standard_normal(seen.shape)
        cloud = rng.permutation(np.concatenate([seen, rng.uniform(0.0, SIDE_MM, (SPURIOUS, 3))]))
        np.savetxt(folder / f"{name}.csv", cloud, fmt="%.4f", delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    n = 20
    labels = np.ones((n, n, n), dtype=np.uint8)
    labels[n // 2 :] = 2
    size = SIDE_MM / n
    write_volume(folder / "labels.mha", Volume.from_array(labels, spacing_mm=(size,) * 3, origin_mm=(0.5 * size,) * 3))


def test_stiffness_of_a_gel_with_particles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written_clouds(tmp_path)
    naibu(monkeypatch, "track", tmp_path / "before.csv", tmp_path / "after.csv", "--out", tmp_path / "tracked")
    naibu(
        monkeypatch, "identify", tmp_path / "tracked" / "field.h5", "--zones", tmp_path / "labels.mha", "--zone-name", "gel=1",
        "--zone-name", "cap=2", "--known", f"cap={KNOWN[0]:g} kPa, {KNOWN[1]:g}", "--loaded", "z-", "--loaded", "z+",
        "--element-size-mm", "6.7", "--out", tmp_path / "found",
    )  # fmt: skip
    told = json.loads((tmp_path / "found" / "identification.json").read_text())
    gel = told["zones"][0]
    assert gel["95 % from"] < UNKNOWN[0] < gel["to"]
    assert gel["Young's modulus, kPa"] == pytest.approx(UNKNOWN[0], rel=0.1)
    assert told["noise_factor"] < 1.5
