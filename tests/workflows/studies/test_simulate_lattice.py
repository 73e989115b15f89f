"""Studies of lattices as files: what they hold, what an interruption leaves, and going on."""

from __future__ import annotations

import base64
import gzip
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np
import pytest
from lattice_studies import STUDY, study_file

from naibu import cli
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.progress import ProgressReport
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.viewer.motion_page import STEPS, ColourField, MotionPage, RigidShape, motion_html
from naibu.workflows.studies import simulate_lattice as workflow
from naibu.workflows.studies.lattice_study import prepared_study
from naibu.workflows.studies.simulate_lattice import PAGE_BYTES, simulate_lattice

FRAMES = 10


def run_until(path: Path, out: Path, frame: int | None = None, **options: bool) -> object:
    """Run a study, and interrupt it when a frame is kept."""

    def progress(report: ProgressReport) -> None:
        if report.done == frame and report.total == FRAMES:
            raise KeyboardInterrupt

    return simulate_lattice(path, out, progress=progress, **options)


def series_of(path: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[:]}) if isinstance(item, h5py.Dataset) else None)
        found["steps"] = np.array(file["VTKHDF/Steps"].attrs["NSteps"])
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    run = simulate_lattice(study_file(folder), folder / "out")
    assert run.finished and [p.name for p in run.files] == ["mine.html", "mine.vtkhdf", "mine.json"]
    return folder


def test_a_ball_smaller_than_the_faces_is_doubted_on_the_page_and_in_the_numbers(whole: Path, tmp_path: Path) -> None:
    told = json.loads((whole / "out" / "mine.json").read_text())["warnings"]
    assert len(told) == 1 and "radius of ball is 0.8 of the edge" in told[0]
    assert told[0] in (whole / "out" / "mine.html").read_text()
    larger = STUDY.replace("radius_mm = 8.0", "radius_mm = 10.0").replace("28.5", "30.5")
    assert simulate_lattice(study_file(tmp_path, larger), tmp_path / "out").warnings == ()


def test_forces_are_a_table_and_a_figure(whole: Path) -> None:
    files = tuple(whole / "out" / name for name in ("mine.html", "mine.vtkhdf", "mine.json"))
    run = workflow.SimulationRun(files, FRAMES, FRAMES)
    told = json.loads(files[2].read_text(encoding="utf-8"))
    ball = np.array([[r["time_s"], r["x_mN"], r["y_mN"], r["z_mN"]] for r in run.to_records() if r["indenter"] == "ball"])
    np.testing.assert_array_equal(ball, np.column_stack([told["force_times_s"], told["forces_mN"]["ball"]]))
    figure = run.plot()
    (axes,) = figure.axes
    unit = axes.get_ylabel()[-4:-1].strip("( ")
    top = {"mN": 1.0, "N": 1e-3}[unit] * max(np.linalg.norm(f, axis=1).max() for f in map(np.array, told["forces_mN"].values()))
    assert max(line.get_ydata().max() for line in axes.lines) == pytest.approx(top)
    plt.close(figure)
    assert run.page_html() == files[0].read_text(encoding="utf-8")
    with pytest.raises(InputError, match=r"the run has no \.html file"):
        workflow.SimulationRun(files[1:], 1, FRAMES).page_html()


def test_the_series_holds_every_frame(whole: Path) -> None:
    study = prepared_study(whole / "mine.toml").study
    found, told = series_of(whole / "out" / "mine.vtkhdf"), json.loads((whole / "out" / "mine.json").read_text(encoding="utf-8"))
    n = study.lattice.n_nodes
    np.testing.assert_allclose(found["VTKHDF/Steps/Values"], 0.02 * np.arange(FRAMES + 1))
    assert found["steps"] == FRAMES + 1 and told["times_s"] == found["VTKHDF/Steps/Values"].tolist() and told["finished"]
    moved = found["VTKHDF/PointData/displacement_mm"].reshape(FRAMES + 1, n, 3)
    assert (moved[0] == 0.0).all() and moved[5, :, 2].min() < -1.0
    # the sphere moves on its path, and no node is inside of it
    place = np.array(told["positions_mm"]["ball"])
    np.testing.assert_allclose(place[5], [10.0, 10.0, 25.5], atol=1e-9)
    distance = np.linalg.norm(study.lattice.points + moved[5] - place[5], axis=1)
    assert 6.5 < distance.min() < 8.1
    # mean stretch of the elements at a node, by hand
    i, j = study.lattice.elements.T
    x = study.lattice.points + moved[5]
    strain = np.linalg.norm(x[j] - x[i], axis=1) / study.lattice.lengths - 1.0
    mine = (i == 3) | (j == 3)
    assert found["VTKHDF/PointData/stretch"].reshape(FRAMES + 1, n)[5, 3] == pytest.approx(strain[mine].mean(), abs=1e-5)


def test_forces_momentum_and_mass_balance(whole: Path) -> None:
    """What is written obeys Newton: the impulses of floor and ball are the momentum of all nodes."""
    told = json.loads((whole / "out" / "mine.json").read_text(encoding="utf-8"))
    found = series_of(whole / "out" / "mine.vtkhdf")
    study = prepared_study(whole / "mine.toml").study
    assert told["mass_kg"] == pytest.approx(0.012) and told["nodes"] == study.lattice.n_nodes
    force = np.array([told["forces_mN"]["floor"], told["forces_mN"]["ball"]])
    times = np.array(told["force_times_s"])
    assert len(times) == force.shape[1] and times[-1] == pytest.approx(0.2)
    speed = found["VTKHDF/PointData/velocity_mm_per_s"].reshape(FRAMES + 1, -1, 3)
    for frame in (3, 5, FRAMES):
        momentum = study.lattice.node_mass @ speed[frame]
        np.testing.assert_allclose(momentum, told["momentum_kg_mm_per_s"][frame], rtol=1e-4, atol=1e-6)
        until = times < 0.02 * frame + 1e-9
        impulse = force[:, until].sum(axis=(0, 1)) * times[0]
        np.testing.assert_allclose(momentum, impulse, atol=2e-3 * np.abs(force[:, until]).sum() * times[0])
    assert force[1, :, 2].min() < -100.0 and force[0, :, 2].max() > 100.0
    work = told["work_mN_mm"]["ball"][5]
    assert work > told["kinetic_mN_mm"][5] + told["springs_mN_mm"][5] > 0.0


def test_an_interruption_leaves_what_is_done_and_goes_on_to_the_same(whole: Path, tmp_path: Path) -> None:
    path, out = whole / "mine.toml", tmp_path / "out"
    run = run_until(path, out, 4)
    assert not run.finished and (run.frames, run.of) == (4, FRAMES)
    assert sorted(p.name for p in out.iterdir()) == ["mine.checkpoint.npz", "mine.html", "mine.json", "mine.vtkhdf"]
    part, full = series_of(out / "mine.vtkhdf"), series_of(whole / "out" / "mine.vtkhdf")
    assert part["steps"] == run.frames + 1
    for name, values in part.items():
        if name != "steps":
            assert np.array_equal(values, full[name][: len(values)]), name
    assert json.loads((out / "mine.json").read_text(encoding="utf-8"))["finished"] is False
    assert "was interrupted" in (out / "mine.html").read_text(encoding="utf-8")
    again = run_until(path, out, 7, resume=True)
    assert not again.finished and again.frames == 7
    assert run_until(path, out, resume=True).finished
    resumed = series_of(out / "mine.vtkhdf")
    assert resumed.keys() == full.keys() and all(np.array_equal(resumed[name], full[name]) for name in full)
    for name in ("mine.json", "mine.html"):
        assert (out / name).read_text(encoding="utf-8") == (whole / "out" / name).read_text(encoding="utf-8")
    assert not (out / "mine.checkpoint.npz").exists()


def test_an_interruption_before_the_first_frame_leaves_the_old_files(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, "run_study", stopped)
    with pytest.raises(KeyboardInterrupt):
        simulate_lattice(whole / "mine.toml", tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_interruption_amid_writing_a_frame_keeps_those_before(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values are there, the step is not yet counted: it is cut off, and computed again."""
    append = workflow.SeriesFile._append_values
    calls = []

    def cut(self: object, *arguments: object) -> None:
        append(self, *arguments)
        calls.append(arguments[1])
        if calls.count("velocity_mm_per_s") == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(workflow.SeriesFile, "_append_values", cut)
    assert simulate_lattice(whole / "mine.toml", tmp_path).frames == 3
    assert len(series_of(tmp_path / "mine.vtkhdf")["naibu/energy_mN_mm"]) >= 4
    monkeypatch.undo()
    simulate_lattice(whole / "mine.toml", tmp_path, resume=True)
    found, full = series_of(tmp_path / "mine.vtkhdf"), series_of(whole / "out" / "mine.vtkhdf")
    assert found.keys() == full.keys() and all(np.array_equal(found[name], full[name]) for name in full)


class PowerCut(Exception):
    """What no part of naibu expects."""


def assert_resumed(whole: Path, out: Path) -> None:
    """Resume, and find what an undisturbed run found, and nothing else."""
    assert run_until(whole / "mine.toml", out, resume=True).finished
    found, full = series_of(out / "mine.vtkhdf"), series_of(whole / "out" / "mine.vtkhdf")
    assert found.keys() == full.keys() and all(np.array_equal(found[name], full[name]) for name in full)
    assert sorted(p.name for p in out.iterdir()) == ["mine.html", "mine.json", "mine.vtkhdf"]
    assert (out / "mine.json").read_text(encoding="utf-8") == (whole / "out" / "mine.json").read_text(encoding="utf-8")


KILLED = """
import os, sys
from naibu.workflows.studies.simulate_lattice import simulate_lattice
last = int(sys.argv[3])
simulate_lattice(sys.argv[1], sys.argv[2], checkpoint_every=3, progress=lambda r: os.kill(os.getpid(), 9) if r.done == last else None)
"""


def test_a_killed_run_goes_on_from_its_last_checkpoint(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = subprocess.run([sys.executable, "-c", KILLED, str(whole / "mine.toml"), str(out), "8"], capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    left = sorted(p.name for p in out.iterdir())
    assert [name for name in left if not name.startswith(".")] == ["mine.checkpoint.npz"] and len(left) == 3
    with pytest.raises(InputError, match=r"can be resumed from; continue it with `resume`"):
        simulate_lattice(whole / "mine.toml", out)
    seen: list[float | None] = []
    with pytest.raises(PowerCut):  # and again, in the same process, before the next checkpoint

        def progress(report: ProgressReport) -> None:
            seen.append(report.done)
            if report.done == 8:
                raise PowerCut

        simulate_lattice(whole / "mine.toml", out, resume=True, checkpoint_every=5, progress=progress)
    assert seen == [7, 8]  # frames 1 to 6 were kept
    assert_resumed(whole, out)


def test_any_failure_keeps_the_frames_of_the_last_checkpoint(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def progress(report: ProgressReport) -> None:
        if report.done == 5:
            raise PowerCut

    with pytest.raises(PowerCut):
        simulate_lattice(whole / "mine.toml", out, checkpoint_every=2, progress=progress)
    assert_resumed(whole, out)


@pytest.mark.parametrize("error", [InputError("the page is too large"), PowerCut("amid the page")])
def test_frames_survive_a_failure_of_the_page(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(*_: object) -> str:
        raise error

    out = tmp_path / "out"
    monkeypatch.setattr(workflow, "motion_html", fails)
    with pytest.raises(type(error)):
        simulate_lattice(whole / "mine.toml", out)
    assert series_of(out / "mine.vtkhdf")["steps"] == FRAMES + 1
    monkeypatch.undo()
    monkeypatch.setattr(workflow, "_append", None)  # no frame is computed again
    assert_resumed(whole, out)


def test_results_are_not_replaced_unasked(whole: Path, tmp_path: Path) -> None:
    path, out = whole / "mine.toml", tmp_path / "out"
    out.mkdir()
    (out / "mine.json").write_text("mine")
    with pytest.raises(InputError, match=r"already holds mine\.json.*`overwrite`"):
        simulate_lattice(path, out)
    assert (out / "mine.json").read_text() == "mine"
    run_until(path, out, 3, overwrite=True)
    assert run_until(path, out, overwrite=True).finished  # anew, though it could be resumed
    assert not (out / "mine.checkpoint.npz").exists()
    with pytest.raises(InputError, match=r"already holds mine\.html, mine\.vtkhdf, mine\.json"):
        simulate_lattice(path, out)


@pytest.mark.parametrize("every", [0, -3, 2.5, True])
def test_checkpoints_are_counted_in_frames(whole: Path, tmp_path: Path, every: object) -> None:
    with pytest.raises(InputError, match=r"checkpoint_every is .*whole number of at least 1"):
        simulate_lattice(whole / "mine.toml", tmp_path, checkpoint_every=every)  # type: ignore[arg-type]


def test_other_settings_are_not_resumed(tmp_path: Path) -> None:
    path, out = study_file(tmp_path), tmp_path / "out"
    with pytest.raises(InputError, match="nothing to resume"):
        simulate_lattice(path, out, resume=True)
    run_until(path, out, 2)
    study_file(tmp_path, STUDY.replace("K = 40.0", "K = 50.0"))
    with pytest.raises(InputError, match="other settings"):
        simulate_lattice(path, out, resume=True)
    checkpoint = out / "mine.checkpoint.npz"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-40])
    with pytest.raises(InputError, match="damaged"):
        simulate_lattice(path, out, resume=True)


def test_steps_that_blow_up_leave_the_frames_before(tmp_path: Path) -> None:
    tie = STUDY.replace('contact = "friction"\nstatic_friction = 0.5', "").replace("[lattice]", '[lattice]\nmasses = "equal"')
    tie = tie.replace("centre_mm = [10.0, 10.0, 28.5]", "centre_mm = [10.0, 10.0, 28.0]").replace(
        'name = "ball"', 'name = "ball"\ncontact = "tied"'
    )
    text = tie.replace("duration_s = 0.2", 'duration_s = 0.2\nmethod = "euler"').replace(
        "[0.1, 0, 0, -3]", "[0.05, 0, 0, 0], [0.1, 0, 0, -3]"
    )
    path = study_file(tmp_path, text)
    with pytest.raises(ConvergenceError, match=r"diverged.*The first 0\.0[24] s are kept"):
        simulate_lattice(path, tmp_path / "out")
    assert series_of(tmp_path / "out" / "mine.vtkhdf")["steps"] in (2, 3)


def test_the_page_is_complete_and_small_and_holds_the_motion(whole: Path) -> None:
    page = (whole / "out" / "mine.html").read_text(encoding="utf-8")
    assert len(page.encode()) < PAGE_BYTES and "default-src 'none'" in page
    head = page[: page.index("<script")]
    links = re.findall(r"""(?:src|href)\s*=\s*["']([^"']*)""", head)
    assert all(link.startswith(("data:", "#")) for link in links) and "@import" not in head and "url(" not in head
    packed = json.loads(re.search(r'id="naibu-frames">(.*?)</script>', page, re.DOTALL)[1])
    moved = unpacked(packed)
    found = series_of(whole / "out" / "mine.vtkhdf")
    full = found["VTKHDF/PointData/displacement_mm"].reshape(FRAMES + 1, -1, 3)
    rest = np.array(packed["reference"]).reshape(-1, 3)
    points = found["VTKHDF/Points"]
    nodes = [int(np.argmin(np.linalg.norm(points - p, axis=1))) for p in rest]
    np.testing.assert_allclose(moved, full[:, nodes], atol=np.abs(full).max() / STEPS)
    assert packed["fields"][0]["high"] == pytest.approx(np.linalg.norm(full[:, nodes], axis=2).max())
    forces = json.loads((whole / "out" / "mine.json").read_text(encoding="utf-8"))["forces_mN"].values()
    unit = "N" if np.abs(np.array(list(forces))).max() >= 500.0 else "mN"
    assert "ball, along −z" in page and f"force on the object ({unit})" in page


def unpacked(packed: dict) -> np.ndarray:
    """Undo the packing as the page's script does."""
    raw = np.frombuffer(gzip.decompress(base64.b64decode(packed["displacement"])), np.uint8)
    rows = np.ascontiguousarray(raw.reshape(2, -1).T).view("<i2").reshape(len(packed["times"]), -1).copy()
    for i in range(1, len(rows)):
        rows[i] += rows[i - 1] if i == 1 else 2 * rows[i - 1] - rows[i - 2]
    return rows.reshape(len(rows), -1, 3) * packed["quantum"]


def test_frames_are_left_out_of_a_page_that_would_be_too_large() -> None:
    rng = np.random.default_rng(0)
    s, n = 33, 400
    moved = rng.standard_normal((s, n, 3))
    page = MotionPage(
        "A </script> title", ("A sentence.",), np.arange(s) * 0.1, np.arange(n - n % 3).reshape(-1, 3), rng.standard_normal((n, 3)), moved,
        (ColourField("displacement, mm", np.linalg.norm(moved, axis=2)),), (RigidShape("plate", "box", np.ones(3), np.eye(3)),),
        np.zeros((s, 1, 3)), np.arange(1, 2001) * 0.0016, rng.standard_normal((2000, 1, 3)),
    )  # fmt: skip
    full = motion_html(page, 5_000_000)
    assert "A &lt;/script&gt; title" in full
    small = motion_html(page, len(full.encode()) - 20_000)
    packed = json.loads(re.search(r'id="naibu-frames">(.*?)</script>', small, re.DOTALL)[1])
    assert packed["times"] == pytest.approx([0.2 * k for k in range(17)])
    np.testing.assert_allclose(unpacked(packed), moved[::2], atol=np.abs(moved).max() / STEPS)
    with pytest.raises(InputError, match=r"limit is 0\.1 MB"):
        motion_html(page, 100_000)
    with pytest.raises(InputError, match="positions must have shape"):
        MotionPage(**{name: getattr(page, name) for name in page.__slots__} | {"positions": np.zeros((s, 2, 3))})


def verb(*arguments: object) -> list[str]:
    return [sys.executable, "-c", "from naibu.cli import main; main()", "simulate", *map(str, arguments)]


def test_the_verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)

    def naibu(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["naibu", "simulate", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr()
        return code, said.out, said.err

    code, out, _ = naibu()
    assert code == 0 and "agar-block" in out and "cube-pushing-octree-2" in out
    code, out, _ = naibu("--example")
    assert code == 0
    text = out.replace("duration_s = 2.0", "duration_s = 0.04")
    code, out, _ = naibu(study_file(tmp_path, text).name, "--out", "here")
    assert code == 0 and sorted(os.listdir("here")) == ["mine.html", "mine.json", "mine.vtkhdf"]
    code, _, message = naibu("no-such-study")
    assert code == cli.BAD_INPUT and "no-such-study" in message and "dough-first-pushing" in message
    code, _, message = naibu("agar-block", "--resume")
    assert code == cli.BAD_INPUT and "without --resume" in message


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_end_of_a_job_keeps_frames(tmp_path: Path, number: signal.Signals) -> None:
    """Ctrl-C and the end of a job end with the exit code of an interruption and files that are whole."""
    path, out = study_file(tmp_path, STUDY.replace("duration_s = 0.2", "duration_s = 2000.0")), tmp_path / "out"
    with subprocess.Popen(verb(path, "--out", out), stderr=subprocess.PIPE, text=True) as process:
        try:
            deadline = time.monotonic() + 120.0
            while time.monotonic() < deadline and not any(p.stat().st_size > 400_000 for p in out.glob(".mine.vtkhdf.*.part")):
                time.sleep(0.1)
            process.send_signal(number)
            _, said = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert process.returncode == cli.INTERRUPTED and "--resume" in said
    found = series_of(out / "mine.vtkhdf")
    assert found["steps"] > 1 and len(found["VTKHDF/Steps/Values"]) == found["steps"]
    assert not list(out.glob(".*"))


TIED = (
    STUDY.replace('contact = "friction"\nstatic_friction = 0.5', 'contact = "sticking"')
    .replace('name = "ball"', 'name = "ball"\ncontact = "tied"\nuntil_s = 0.06')
    .replace("centre_mm = [10.0, 10.0, 28.5]", "centre_mm = [10.0, 10.0, 28.0]")
)


def test_a_study_runs_on_the_kernels_of_the_gpu(tmp_path: Path) -> None:
    """The kernels of Warp, compiled for the processor, give what the default engine gives, to its tolerance."""
    pytest.importorskip("warp")
    study = study_file(tmp_path, TIED.replace("duration_s = 0.2", "duration_s = 0.2\ntolerance = 1e-8"))
    found = []
    for device in ("cpu", "warp-cpu"):
        simulate_lattice(study, tmp_path / device, device=device)
        numbers = json.loads((tmp_path / device / "mine.json").read_text(encoding="utf-8"))
        moved = series_of(tmp_path / device / "mine.vtkhdf")["VTKHDF/PointData/displacement_mm"]
        found.append((moved, np.array(numbers["forces_mN"]["ball"]), np.array(numbers["forces_mN"]["floor"])))
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * np.abs(theirs).max())
    assert np.abs(found[0][1]).max() > 1.0 and not found[0][1][-1].any()  # tied, then let go


def test_devices_are_named_in_messages(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="device must be one of cpu, cuda, warp-cpu, or a numbered GPU such as cuda:1, not 'gpu'"):
        simulate_lattice(study_file(tmp_path, TIED), tmp_path / "out", device="gpu")
    pytest.importorskip("warp")
    with pytest.raises(InputError, match="contact with friction is computed on 'cpu' only"):
        simulate_lattice(study_file(tmp_path), tmp_path / "out", device="warp-cpu")


ROTATED = rotation_matrix(np.array([0.2, -0.4, 0.3]))


@pytest.mark.parametrize("direction", [ROTATED, ROTATED @ np.diag([1.0, 1.0, -1.0])], ids=["right-handed", "left-handed"])
def test_results_overlay_the_scan(tmp_path: Path, direction: np.ndarray) -> None:
    """Of a rotated, shifted label volume: hexahedra lie on the labelled voxels, and what moves up does so along its third axis."""
    labels = np.zeros((6, 7, 8), dtype=np.uint8)  # z, y, x
    labels[2:4, 1:5, 3:7] = 7
    labels[2, 1, 3] = 0
    volume = Volume.from_array(labels, spacing_mm=(4.0, 4.0, 4.0), origin_mm=(-120.0, 35.0, 900.0), direction=direction)
    write_volume(tmp_path / "scan.nrrd", volume)
    text = TIED.replace("size_mm = [30, 20, 20]", 'labels = "scan.nrrd"').replace("spacing_mm = 10.0", "spacing_mm = 4.0")
    text = text.replace("centre_mm = [10.0, 10.0, 28.0]", "centre_mm = [8.0, 8.0, 16.0]").replace(
        "path = [[0.0, 0, 0, 0], [0.1, 0, 0, -3]]", "path = [[0.0, 0, 0, 0], [0.05, 0, 0, 0.5], [0.1, 0, 0, 0.5]]"
    )
    simulate_lattice(study_file(tmp_path, text), tmp_path / "out")
    found = series_of(tmp_path / "out" / "mine.vtkhdf")
    points, n = found["VTKHDF/Points"], prepared_study(tmp_path / "mine.toml").study.lattice.n_nodes
    index = volume.to_index(points[:n])
    np.testing.assert_allclose(index - 0.5, np.rint(index - 0.5), atol=1e-4)  # nodes are corners of voxels
    cells = found["VTKHDF/Connectivity"].reshape(-1, 8)[: int((labels == 7).sum())]
    centres = np.rint(volume.to_index(points[cells].mean(axis=1))).astype(int)
    assert {tuple(c) for c in centres} == {tuple(v) for v in np.argwhere(labels.T == 7)}
    edges = points[cells][:, [1, 3, 4]] - points[cells][:, [0]]
    assert (np.linalg.det(edges) > 0.0).all()
    moved = found["VTKHDF/PointData/displacement_mm"].reshape(-1, n, 3)[3]
    tied = int(np.argmax(np.linalg.norm(moved, axis=1)))
    np.testing.assert_allclose(moved[tied], 0.5 * direction[:, 2], atol=1e-4)
    frame = json.loads((tmp_path / "out" / "mine.json").read_text(encoding="utf-8"))["scanner_frame"]
    np.testing.assert_allclose(frame["direction"], direction, atol=1e-6)
    np.testing.assert_allclose(frame["origin_mm"], volume.to_physical([2.5, 0.5, 1.5]), atol=1e-4)
