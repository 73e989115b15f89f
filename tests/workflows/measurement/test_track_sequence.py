"""From a cine loop of a virtual ultrasound scanner, whose motion is known, to tables of tracks: `naibu track-sequence` end to end."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from naibu.cli import main
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.core.volume import Volume
from naibu.imaging.markers.settings import SequenceSettings
from naibu.io.images import write_volume
from naibu.validation.scanners.ct_mr import MarkerKind, VirtualObject, empty_grid
from naibu.validation.scanners.motions import FormulaMotion
from naibu.validation.scanners.ultrasound import Ghost, Scatterers, UltrasoundDevice, ultrasound_sequence
from naibu.workflows.measurement.track_sequence import COLUMNS, track_sequence_file

PIXEL_MM, RATE_HZ, FRAMES = 0.3, 24.6, 40
ECHO_MM = (3.0, 2.0)  # size of a marker in the image
MARKERS = np.column_stack([[8.0, 16.0, 24.0, 32.0, 40.0], [17.5, 18.4, 17.9, 18.6, 17.2], np.zeros(5)])
REVERBERATION = Ghost((0.0, -9.0, 0.0), 0.4)
DEVICE = UltrasoundDevice(spread_mm=(0.7, 0.45, 1.0), white=25.0, range_db=40.0, ghosts=(REVERBERATION,))
BELOW_GHOSTS = (0.0, 48.0, 13.5, 34.0)  # x from, x to, y from, y to, mm


def motion(frame: int) -> FormulaMotion:
    """Material pressed down by about 4 mm with a tremor; it bulges sideways; about frame 22 its middle leaves the image plane by 6 mm."""
    push = 4.0 * (1.0 - np.exp(-4.0 * frame / (FRAMES - 1))) + 0.7 * np.sin(2.0 * np.pi * frame / 12.0)
    out = 6.0 * np.exp(-0.5 * ((frame - 22.0) / 3.0) ** 4)

    def forward(x: FloatArray) -> FloatArray:
        depth = x[:, 1] / 34.0
        aside = np.exp(-(((x[:, 0] - 24.0) / 4.0) ** 2))
        return x + np.column_stack([0.04 * push * (x[:, 0] - 24.0) * depth, push * (1.0 - depth), out * aside])

    return FormulaMotion(forward)


@dataclass(frozen=True)
class Cine:
    """The file of a cine loop (t, ny, nx) with the true positions (t, n, 2), mm, and which markers lie within the image plane (t, n)."""

    path: Path
    frames: np.ndarray
    truth: FloatArray
    in_plane: BoolArray


@pytest.fixture(scope="module")
def cine(tmp_path_factory: pytest.TempPathFactory) -> Cine:
    grid = empty_grid([0.0, 0.0, -0.5], [48.0, 34.0, 0.5], (PIXEL_MM, PIXEL_MM, 3.0))
    grid = Volume.from_array(grid.values, spacing_mm=grid.spacing_mm, origin_mm=(0.0, 0.0, 0.0))
    gel = Scatterers.drawn(lambda x: np.ones(len(x)), [-3, -3, -3], [51, 37, 3], per_mm3=12.0 / DEVICE.cell_mm3, seed=1)
    body = VirtualObject.of(lambda x: np.ones(len(x)), MARKERS, MarkerKind(1.5, intensity=20.0))
    motions = [motion(frame) for frame in range(FRAMES)]
    scans = list(ultrasound_sequence(body, gel, motions, grid, DEVICE, seed=3))
    frames = np.concatenate([scan.volume.values for scan in scans])
    path = tmp_path_factory.mktemp("cine") / "cine.mha"
    write_volume(path, Volume.from_array(frames, spacing_mm=(1.0, 1.0, 1.0)))
    truth = np.stack([m.to_space(MARKERS)[:, :2] for m in motions])
    return Cine(path, frames, truth, np.stack([np.isin(body.ids, scan.markers.ids) for scan in scans]))


@dataclass(frozen=True)
class Tracks:
    """``tracks.csv`` as arrays: positions (t, n, 2) and standard deviations (t, n), mm, whether seen (t, n), times (t,), s."""

    points: FloatArray
    sd: FloatArray
    seen: BoolArray
    times: FloatArray


def tracks_in(folder: Path, markers: int = 5) -> Tracks:
    with (folder / "tracks.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    values = {name: np.array([float(row[name]) for row in rows]).reshape(-1, markers) for name in COLUMNS}
    np.testing.assert_array_equal(values["marker"], np.tile(np.arange(1, markers + 1), (len(values["frame"]), 1)))
    np.testing.assert_array_equal(values["frame"], np.arange(len(values["frame"]))[:, None].repeat(markers, axis=1))
    return Tracks(np.stack([values["x_mm"], values["y_mm"]], axis=2), values["sd_mm"], values["seen"] == 1.0, values["time_s"][:, 0])


@pytest.fixture(scope="module")
def folder(cine: Cine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tracks")
    track_sequence_file(cine.path, out=out, pixel_mm=PIXEL_MM, diameter_mm=ECHO_MM, frame_rate_hz=RATE_HZ)
    return out


def test_tracks_follow_the_known_motion_to_a_fraction_of_a_pixel(cine: Cine, folder: Path) -> None:
    found = tracks_in(folder)
    error = np.linalg.norm(found.points - cine.truth, axis=2)
    assert error[found.seen].max() < 0.5 * PIXEL_MM
    assert np.median(error) < 0.2 * PIXEL_MM
    # of a displacement, speckle that interferes with the echo biases both ends
    moved = np.linalg.norm((found.points - found.points[0]) - (cine.truth - cine.truth[0]), axis=2)
    assert np.median(moved) < 0.4 * PIXEL_MM
    assert np.linalg.norm(cine.truth[-1] - cine.truth[0], axis=1).max() > 6.0 * PIXEL_MM
    np.testing.assert_allclose(found.times, np.arange(FRAMES) / RATE_HZ, rtol=1e-5)


def test_a_marker_out_of_the_image_plane_is_bridged_and_says_so(cine: Cine, folder: Path) -> None:
    found = tracks_in(folder)
    others = [0, 1, 3, 4]
    assert found.seen[:, others].all() and cine.in_plane[:, others].all()
    hidden = ~found.seen[:, 2]
    gap = np.flatnonzero(hidden)
    # an echo fades to exp(-2) of its amplitude 2 mm beside the plane
    aside = np.abs(np.array([motion(f).to_space(MARKERS)[2, 2] for f in range(FRAMES)]))
    assert hidden[aside > 2.0].all() and not hidden[aside < 1.0].any()
    np.testing.assert_array_equal(gap, np.arange(gap[0], gap[-1] + 1))
    # the further from the ends of the gap, the less certain
    before, middle = gap[0] - 1, gap[len(gap) // 2]
    assert found.sd[middle, 2] > found.sd[gap[0], 2] > found.sd[before, 2]


def test_a_gap_is_filled_by_the_motion_that_the_markers_share(cine: Cine, tmp_path: Path) -> None:
    """One load drives all markers here, so that one principal motion is the truth; a line over the gap misses the tremor."""
    errors = []
    for motions in (1, 0):
        track_sequence_file(
            cine.path,
            out=tmp_path / str(motions),
            pixel_mm=PIXEL_MM,
            diameter_mm=ECHO_MM,
            settings=SequenceSettings(shared_motions=motions),
        )
        found = tracks_in(tmp_path / str(motions))
        gap = np.flatnonzero(~found.seen[:, 2])
        errors.append(np.linalg.norm(found.points[gap, 2] - cine.truth[gap, 2], axis=1))
        if motions == 0:
            ends = [gap[0] - 1, gap[-1] + 1]
            line = np.stack([np.interp(gap, ends, found.points[ends, 2, a]) for a in range(2)], axis=1)
            np.testing.assert_allclose(found.points[gap, 2], line, atol=1e-3)
    assert errors[0].max() < 0.5 * PIXEL_MM < PIXEL_MM < errors[1].max()


def test_reverberation_is_rejected_and_a_region_keeps_it_out(cine: Cine, folder: Path, tmp_path: Path) -> None:
    note = json.loads((folder / "tracks.json").read_text())["tables"][0]["note"]
    assert "5 ghost of a stronger one" in note
    assert (tracks_in(folder).points[..., 1] > 15.0).all()  # ghosts lie 9 mm above
    track_sequence_file(cine.path, out=tmp_path, pixel_mm=PIXEL_MM, diameter_mm=ECHO_MM, region_mm=BELOW_GHOSTS, count=5)
    assert "ghost" not in json.loads((tmp_path / "tracks.json").read_text())["tables"][0]["note"]
    np.testing.assert_allclose(tracks_in(tmp_path).points, tracks_in(folder).points, atol=0.02)


def test_the_page_and_the_numbers_hold_what_was_found_and_from_what(cine: Cine, folder: Path) -> None:
    assert {p.name for p in folder.iterdir()} == {"tracks.csv", "tracks.html", "tracks.json"}
    page, numbers = (folder / "tracks.html").read_text(), json.loads((folder / "tracks.json").read_text())
    assert page.startswith("<!DOCTYPE html>") and page.count("<img") == 1
    assert numbers["settings"]["frames"] == FRAMES and numbers["settings"]["frame rate, Hz"] == RATE_HZ
    assert "SHA-256" in numbers["settings"]["images"]
    table, found = numbers["tables"][0], tracks_in(folder)
    rows = {name: [row[i] for row in table["rows"]] for i, name in enumerate(table["columns"])}
    assert rows["marker"] == [1, 2, 3, 4, 5]
    assert rows["seen in frames"] == found.seen.sum(axis=0).tolist()
    longest = np.linalg.norm(found.points - found.points[0], axis=2).max(axis=0)
    np.testing.assert_allclose(rows["largest displacement, mm"], longest, atol=2e-3)
    truth = np.linalg.norm(cine.truth - cine.truth[0], axis=2).max(axis=0)
    np.testing.assert_allclose(longest, truth, atol=0.5 * PIXEL_MM)


def test_the_same_frames_give_the_same_files(cine: Cine, folder: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        track_sequence_file(cine.path, out=tmp_path / name, pixel_mm=PIXEL_MM, diameter_mm=ECHO_MM, frame_rate_hz=RATE_HZ)
    for file in ("tracks.csv", "tracks.json"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes() == (folder / file).read_bytes()


@pytest.mark.parametrize("ending", ["nrrd", "tif", "nii.gz"])
def test_every_format_of_stacks_gives_the_same_tracks(cine: Cine, folder: Path, tmp_path: Path, ending: str) -> None:
    stack = write_volume(tmp_path / f"cine.{ending}", Volume.from_array(cine.frames, spacing_mm=(1.0, 1.0, 1.0)))
    run = track_sequence_file(stack, out=tmp_path / "out", pixel_mm=PIXEL_MM, diameter_mm=ECHO_MM, frame_rate_hz=RATE_HZ)
    assert run.table.read_bytes() == (folder / "tracks.csv").read_bytes()


def test_pixels_may_be_higher_than_wide_and_markers_dark(cine: Cine, tmp_path: Path) -> None:
    thinned = Volume.from_array(255 - cine.frames[:, ::2], spacing_mm=(1.0, 1.0, 1.0))
    stack = write_volume(tmp_path / "negative.mha", thinned)
    track_sequence_file(
        stack, out=tmp_path / "t", pixel_mm=(PIXEL_MM, 2.0 * PIXEL_MM), diameter_mm=ECHO_MM, region_mm=BELOW_GHOSTS, polarity="dark"
    )
    found = tracks_in(tmp_path / "t")
    assert np.linalg.norm(found.points - cine.truth, axis=2)[found.seen].max() < PIXEL_MM


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"frames": "missing.mha"}, r"missing\.mha"),
        ({"frames": "broken.mha"}, r"broken\.mha"),
        ({"pixel_mm": 0.0}, "pixel_mm is 0; give"),
        ({"pixel_mm": (0.3, 0.3, 0.3)}, "pixel_mm must be"),
        ({"pixel_mm": float("nan")}, "pixel_mm is nan; give"),
        ({"diameter_mm": -2.0}, "diameter_mm is -2; give"),
        ({"diameter_mm": 0.3}, "diameter_mm is .* must exceed 1.2 pixels"),
        ({"diameter_mm": 300.0}, "diameter_mm is .* must be smaller than the image"),
        ({"frame_rate_hz": 0.0}, "frame_rate_hz is 0; give"),
        ({"frame_rate_hz": float("inf")}, "frame_rate_hz is inf; give"),
        ({"region_mm": (0.0, 48.0, 13.5)}, "region_mm must be"),
        ({"region_mm": (48.0, 0.0, 13.5, 34.0)}, "region_mm must be"),
        ({"region_mm": (0.0, 48.0, 13.5, float("nan"))}, "region_mm must be"),
        ({"region_mm": (90.0, 99.0, 0.0, 9.0)}, "no pixel lies in region_mm"),
        ({"count": 0}, "count is 0"),
        ({"count": 40}, "40 asked for"),
        ({"polarity": "auto"}, "polarity must be 'bright' or 'dark', not 'auto'"),
    ],
)
def test_wrong_input_is_named_before_anything_is_written(cine: Cine, tmp_path: Path, arguments: dict[str, Any], words: str) -> None:
    (tmp_path / "broken.mha").write_bytes(cine.path.read_bytes()[:400])
    settings: dict[str, Any] = {"frames": cine.path, "pixel_mm": PIXEL_MM, "diameter_mm": ECHO_MM} | arguments
    settings["frames"] = tmp_path / settings["frames"]
    with pytest.raises(InputError, match=words):
        track_sequence_file(**settings, out=tmp_path / "out")
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_progress_is_reported_stage_by_stage(cine: Cine, tmp_path: Path) -> None:
    reports: list[ProgressReport] = []
    track_sequence_file(cine.path, out=tmp_path, pixel_mm=PIXEL_MM, diameter_mm=ECHO_MM, progress=reports.append)
    assert [r.stage for r in reports] == ["reading", "finding echoes", "linking echoes", "filling gaps", "filling gaps", "writing"]
    fractions = [r.fraction for r in reports if r.fraction is not None]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0


def test_a_folder_that_cannot_be_used_is_named_before_the_frames_are_read(cine: Cine, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match="taken: cannot be used as a folder"):
        track_sequence_file(tmp_path / "missing.mha", out=tmp_path / "taken", pixel_mm=PIXEL_MM, diameter_mm=ECHO_MM)


def run_verb(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["naibu", "track-sequence", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    return int(end.value.code or 0)


def test_the_verb_does_what_the_function_does(
    cine: Cine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--pixel-mm", PIXEL_MM, "--diameter-mm", 2.5, "--frame-rate-hz", RATE_HZ, "--count", 5, "--polarity", "bright")
    region = ("--region-mm", *BELOW_GHOSTS)
    assert run_verb(monkeypatch, cine.path, *options, *region, "--out", tmp_path / "verb") == 0
    message = capsys.readouterr().out
    assert "tracks.csv" in message and "tracks.html" in message
    run = track_sequence_file(
        cine.path, out=tmp_path / "function", pixel_mm=PIXEL_MM, diameter_mm=2.5, frame_rate_hz=RATE_HZ, region_mm=BELOW_GHOSTS, count=5
    )
    assert run.table.read_bytes() == (tmp_path / "verb" / "tracks.csv").read_bytes()
    assert len(run.rows) == 5 and run.page == tmp_path / "function" / "tracks.html"
    found = tracks_in(tmp_path / "verb")
    assert np.linalg.norm(found.points - cine.truth, axis=2)[found.seen].max() < 0.5 * PIXEL_MM


def test_the_verb_ends_with_code_two_and_a_line_on_what_is_wrong(
    cine: Cine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes = ("--pixel-mm", PIXEL_MM, "--diameter-mm", 2.5)
    for arguments, words in (
        ((tmp_path / "missing.mha", *sizes), "missing.mha"),
        ((cine.path, *sizes, "--count", 40), "40 asked for"),
        ((cine.path, *sizes, "--frame-rate-hz", 0), "frame"),
        ((cine.path, "--pixel-mm", -1, "--diameter-mm", 2.5), "pixel"),
    ):
        assert run_verb(monkeypatch, *arguments, "--out", tmp_path / "out") == 2
        assert words in capsys.readouterr().err
