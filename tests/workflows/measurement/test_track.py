"""From scans with beads to an experiment folder that the main job reads."""

from __future__ import annotations

import base64
import gzip
import json
import re
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from naibu.cli import main
from naibu.core.errors import InputError
from naibu.core.experiment import Layer, Loading, Shape
from naibu.core.volume import Volume
from naibu.identification.from_markers.observations import NoiseModel
from naibu.imaging.preprocessing.resampling import positions
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.images import write_volume
from naibu.workflows.measurement.track import ObjectDescription, track

DIAMETER = 3.0
LATTICE = np.stack(np.meshgrid(*[6.0 + 8.0 * np.arange(n) for n in (4, 4, 3)], indexing="ij"), axis=-1).reshape(-1, 3)
SQUEEZE = np.diag([1.08, 1.08, 0.8])


def beads(where: np.ndarray, seed: int) -> Volume:
    """Bright beads, blurred by a voxel, in a noisy body."""
    frame = Volume.from_array(np.zeros((28, 44, 44)), spacing_mm=(0.9, 0.9, 1.0))
    x = positions(frame)
    intensity = 100.0 + np.random.default_rng(seed).normal(0.0, 8.0, frame.shape)
    for p in where:
        intensity += 250.0 / (1.0 + np.exp((np.linalg.norm(x - p, axis=-1) - 0.5 * DIAMETER) / 0.35))
    return frame.with_values(intensity)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    place = tmp_path_factory.mktemp("beads")
    jitter = np.random.default_rng(0).uniform(-0.8, 0.8, LATTICE.shape)
    files = []
    for name, where in (("free", LATTICE + jitter), ("pressed", (LATTICE + jitter) @ SQUEEZE)):
        np.save(place / f"{name}.npy", where)
        volume = beads(where, len(files))
        files.append(write_volume(place / f"{name}.nii.gz", volume.with_values(volume.values.astype(np.float32))))
    return files


def test_an_experiment_folder_comes_out(scans: list[Path], tmp_path: Path) -> None:
    layers = (Layer("soft", 0.0, 14.0), Layer("firm", 14.0, 28.0))
    described = ObjectDescription(Shape("box", (36.0, 36.0, 28.0)), Loading("plate"), layers, {"pressed": 22.0})
    run = track(scans, out=tmp_path / "mine", diameter_mm=DIAMETER, description=described)
    experiment = read_experiment(tmp_path / "mine")
    assert experiment.layers == layers
    assert experiment.loaded_states[0].stated_mm == 22.0
    before, after = experiment.initial.points, experiment.loaded_states[0].markers.points
    truth = np.load(scans[0].with_name("free.npy"))
    nearest = np.linalg.norm(before[:, None] - truth[None], axis=-1)
    assert len(before) == len(LATTICE)
    assert nearest.min(axis=1).max() < 0.15
    # the same number is the same bead
    assert np.abs(after - truth[nearest.argmin(axis=1)] @ SQUEEZE).max() < 0.2
    summary = json.loads((tmp_path / "mine" / "tracking.json").read_text())
    assert [row[2] for row in summary["tables"][0]["rows"]] == [len(LATTICE)] * 2
    assert set(summary["settings"]) >= {"scan of initial", "scan of pressed"}
    assert "SHA-256" in summary["settings"]["scan of pressed"]
    assert run.page.read_text().startswith("<!DOCTYPE html>")
    # the identification learns how certain the positions are
    assert experiment.sd_mm is not None
    assert (experiment.sd_mm[0], experiment.sd_mm[2]) == pytest.approx(run.tracked.typical_sd_mm)
    error = np.stack([before - truth[nearest.argmin(axis=1)], after - truth[nearest.argmin(axis=1)] @ SQUEEZE])
    ratio = np.sqrt(np.mean(error**2, axis=(0, 1))) / experiment.sd_mm
    assert (ratio > 1 / 1.5).all() and (ratio < 1.5).all(), ratio
    np.testing.assert_allclose(NoiseModel(model_mm=0.0).of_experiment(experiment), experiment.sd_mm)


def test_exchanged_scans_are_told(scans: list[Path], tmp_path: Path) -> None:
    described = ObjectDescription(Shape("box", (36.0, 36.0, 28.0)), Loading("plate"), (), {})
    run = track(scans[::-1], out=tmp_path / "mine", diameter_mm=DIAMETER, description=described)
    assert any("the reference configuration and the loaded state exchanged?" in note for note in run.notes)


def test_the_page_shows_markers_in_3_d_and_over_the_scans(scans: list[Path], tmp_path: Path) -> None:
    run = track(scans, out=tmp_path / "page", diameter_mm=DIAMETER)
    page = run.page.read_text(encoding="utf-8")
    found = re.search(r'id="naibu-scenes">([^<]*)</script>', page)
    assert found
    (scene,) = json.loads(gzip.decompress(base64.b64decode(found[1])))["scenes"]
    shift = np.array(scene["markers"][1]).reshape(-1, 3) * scene["quantum_mm"]["marker"]
    before = np.array(scene["measured"]).reshape(-1, 3) * scene["quantum_mm"]["marker"]
    # the arrows are the known motion of the beads
    assert np.abs(before + shift - before @ SQUEEZE).max() < 0.2
    records = run.to_records()
    assert len(records) == 2 * len(LATTICE) and {r["state"] for r in records} == {"initial", "pressed"}
    positions = np.array([[r["x_mm"], r["y_mm"], r["z_mm"]] for r in records if r["state"] == "pressed"])
    np.testing.assert_array_equal(positions, run.tracked.points[1])
    assert run.page_html() == page
    plt.close(run.plot())
    assert f"{len(LATTICE)} of {len(LATTICE)}" in page and page.count("<figure>") == 2


def test_tables_alone_where_the_object_is_not_described(scans: list[Path], tmp_path: Path) -> None:
    track(scans, out=tmp_path / "tables", diameter_mm=DIAMETER)
    assert {p.name for p in (tmp_path / "tables").iterdir()} == {"initial.csv", "pressed.csv", "tracking.html", "tracking.json"}


def test_blobs_that_may_be_bubbles_are_not_taken_for_markers(tmp_path: Path) -> None:
    four = LATTICE[[0, 13, 30, 47]]
    files = [write_volume(tmp_path / f"{n}.mha", beads(where, n)) for n, where in enumerate((four, four @ SQUEEZE))]
    with pytest.raises(InputError, match="4 markers were followed, but only 0 of them are trusted, 4 are needed"):
        track(files, out=tmp_path / "out", diameter_mm=DIAMETER)
    assert not (tmp_path / "out").exists()
    assert (track(files, out=tmp_path / "out", diameter_mm=DIAMETER, count=4).tracked.flags == "ok").all()


def test_mistakes_are_named(scans: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two scans would both be the state 'pressed'"):
        track([*scans, scans[1]], out=tmp_path / "a", diameter_mm=DIAMETER)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="is not an empty folder"):
        track(scans, out=tmp_path / "full", diameter_mm=DIAMETER)
    small = write_volume(tmp_path / "small.mha", Volume.from_array(np.ones((3, 3, 3), np.uint8), spacing_mm=(1, 1, 1)))
    with pytest.raises(InputError, match=r"small\.mha does not lie on the grid of free\.nii\.gz"):
        track(scans, out=tmp_path / "b", diameter_mm=DIAMETER, mask=small)
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()


def test_the_verb(scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["naibu", "track", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        return int(end.value.code or 0)

    options = ("--diameter-mm", DIAMETER, "--size-mm", 36, 36, 28, "--layer", "gel=0..28", "--stated-mm", "pressed=22")
    assert run(*scans, *options, "--out", tmp_path / "exp") == 0
    assert f"naibu identify {tmp_path / 'exp'}" in capsys.readouterr().out
    assert read_experiment(tmp_path / "exp").materials == ("gel",)
    assert run(*scans, "--diameter-mm", DIAMETER, "--layer", "gel=0..28", "--out", tmp_path / "no") == 2
    assert "--size-mm" in capsys.readouterr().err
