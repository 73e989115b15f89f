"""From two tables of particles to a displacement field that the identification reads."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from notebooks import check_shown
from particle_gels import Cloud, particle_gel

from naibu.cli import main
from naibu.core.errors import InputError
from naibu.io.displacement_fields import read_field
from naibu.io.images import read_volume
from naibu.workflows.measurement.track_clouds import track_clouds

PIXEL = 0.01  # mm


@pytest.fixture(scope="module")
def gel() -> Cloud:
    return particle_gel(2500, 0, loss=0.3, press_px=10.0)


@pytest.fixture(scope="module")
def tables(gel: Cloud, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    place = tmp_path_factory.mktemp("gel")
    files = place / "free.csv", place / "pressed.npy"
    rows = "\n".join(f"{k},{x},{y},{z}" for k, (x, y, z) in enumerate((1000.0 * PIXEL * gel.reference).tolist()))
    files[0].write_text(f"id,x_um,y_um,z_um\n{rows}\n")
    np.save(files[1], PIXEL * gel.deformed)
    return files


def test_the_field_is_that_of_the_particles(gel: Cloud, tables: tuple[Path, Path], tmp_path: Path) -> None:
    run = track_clouds(*tables, out=tmp_path / "out")
    field = read_field(tmp_path / "out" / "field.h5")
    with (tmp_path / "out" / "links.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"field.h5", "links.csv", "mask.mha", "tracking.html", "tracking.json"}
    assert len(rows) == len(field.points) == len(run.motion.links)
    pairs = np.array([(int(r["reference_row"]) - 1, int(r["deformed_row"]) - 1) for r in rows])
    right, possible, wrong = gel.judged(pairs)
    assert right > 0.97 * possible
    assert wrong < 0.02 * len(pairs)
    np.testing.assert_allclose(field.points, PIXEL * gel.reference[pairs[:, 0]], atol=1e-9)
    moved = PIXEL * (gel.deformed[pairs[:, 1]] - gel.reference[pairs[:, 0]])
    np.testing.assert_allclose(field.vectors[field.valid], moved[field.valid], atol=1e-9)
    assert field.covariance is not None
    assert field.quality is not None
    assert (field.valid == (field.quality >= 0.5)).all()
    mask = read_volume(tmp_path / "out" / "mask.mha")
    size = PIXEL * np.ptp(gel.reference, axis=0)
    assert mask.values.sum() * np.prod(mask.spacing_mm) == pytest.approx(size.prod(), rel=0.25)
    summary = json.loads((tmp_path / "out" / "tracking.json").read_text())
    assert dict(summary["tables"][0]["rows"])["linked"] == len(rows)
    assert "SHA-256" in summary["settings"]["deformed"]
    assert run.page.read_text().startswith("<!DOCTYPE html>")
    assert [row["uz_mm"] for row in check_shown(run, run.page)] == [float(row["uz_mm"]) for row in rows]


def test_clouds_that_do_not_correspond_are_refused(gel: Cloud, tables: tuple[Path, Path], tmp_path: Path) -> None:
    other = tmp_path / "other.npy"
    for points, words in (
        (particle_gel(2500, 8).deformed, "no common structure"),
        (100.0 * gel.deformed, "no soft body|no common structure"),
        (gel.deformed * (-1.0, 1.0, 1.0), "mirror image|no common structure"),
        (gel.deformed[:, :2], "same dimension"),
    ):
        np.save(other, PIXEL * points)
        with pytest.raises(InputError, match=rf"other\.npy against free\.csv: .*({words})"):
            track_clouds(tables[0], other, out=tmp_path / "out")
    with pytest.raises(InputError, match=r"free\.csv against free\.csv: .*same positions.*given twice"):
        track_clouds(tables[0], tables[0], out=tmp_path / "out")
    assert not (tmp_path / "out" / "field.h5").exists()


def test_clouds_with_every_point_twice_are_linked(gel: Cloud, tables: tuple[Path, Path], tmp_path: Path) -> None:
    """They had been refused, for want of a structure in common."""
    files = tmp_path / "free.npy", tmp_path / "pressed.npy"
    for file, points in zip(files, (gel.reference, gel.deformed), strict=True):
        np.save(file, PIXEL * np.concatenate([points, points]))
    once, twice = track_clouds(*tables, out=tmp_path / "once"), track_clouds(*files, out=tmp_path / "twice")
    assert len(twice.motion.links) == len(once.motion.links)
    told = dict(twice.rows)
    assert told["copies of a point left out, reference"] == len(gel.reference) == told["particles, reference"]
    assert not any("copies" in name for name, _ in once.rows)


def test_the_verb(tables: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["naibu", "track", *map(str, tables), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    assert "expected wrong links" in capsys.readouterr().out
    assert (tmp_path / "out" / "field.h5").exists()
