"""Bad inputs of every verb, as tables: each is refused with exit code 2 and one message that names what is wrong; nothing is written."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import signal
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from bad_keys import bad_descriptions, bad_studies, document
from bad_options import bad_options
from lattice_studies import study_file
from virtual_press import Press

from naibu import cli
from naibu._numba.reports import reported_compilation
from naibu.core.displacement_field import DisplacementField
from naibu.core.volume import Volume
from naibu.io.displacement_fields import write_field
from naibu.io.images import write_volume
from naibu.io.study_schemas.fingertip_schema import DECODER
from naibu.io.vtk_files import write_vtu
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box

BY_HAND = tomllib.loads((Path(__file__).parent / "bad_inputs.toml").read_text(encoding="utf-8"))["input"]
FAST = 5  # every fifth row of the generated tables; the others are slow
PATIENCE_S = 60  # for a command that must be refused at once, on a machine with much else to do
Files = dict[str, Path]
Run = Callable[[list[str]], tuple[int, str]]


@pytest.fixture(scope="module")
def files(press: Press, tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Good inputs of every verb."""
    root = tmp_path_factory.mktemp("good")
    rng = np.random.default_rng(0)
    for name, shape in (("scan", (10, 12, 14)), ("scan2", (10, 12, 14)), ("frames", (5, 20, 24))):
        write_volume(root / f"{name}.mha", Volume.from_array(rng.random(shape).astype(np.float32), spacing_mm=(1.0, 1.0, 1.0)))
    for name, shape, ones in (("scan3", (10, 12, 13), 0), ("zero", (10, 12, 14), 0), ("voxel", (10, 12, 14), 1)):
        values = np.zeros(shape, dtype=np.uint8)
        values.flat[:ones] = 1
        write_volume(root / f"{name}.mha", Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0)))
    named = {**damaged_scans(root), **touched_bodies(root), **views(root), **measured_field(root), **recorded_readings(root)}
    scans = {name: root / f"{name}.mha" for name in ("scan", "scan2", "scan3", "frames", "zero", "voxel")}
    tables = {"table": press.folder / "initial.csv", "table2": press.folder / "pressed.csv"}
    records = {"cloud": "t,x,y,z\n0,10,10,20\n0,20,10,20\n", "sensor": "t,fx,fy,fz\n" + "".join(f"0.0{k},0,0,-{k}\n" for k in range(1, 9))}
    for name, text in records.items():
        (root / f"{name}.csv").write_text(text, encoding="utf-8")
        named[name] = root / f"{name}.csv"
    return {**named, **scans, **tables, "press": press.folder, "model": press.results / "model.json", "study": study_file(root)}


def damaged_scans(root: Path) -> Files:
    """Scans on the grid of the good ones, or on others, that show nothing, or not the same, and a label where nothing can be matched."""
    rng, shape = np.random.default_rng(1), (10, 12, 14)
    scan = rng.random(shape).astype(np.float32)
    upper, lower, holed, steep = (scan.copy() for _ in range(4))
    upper[:5], lower[5:], holed[4, 5, 6], steep[4, 5, 6] = np.nan, np.nan, np.nan, 1e30
    small = np.zeros(shape, dtype=np.uint8)
    small[:3] = 1
    volumes = {
        "unknown": np.full(shape, np.nan, np.float32), "constant": np.full(shape, 7, np.int16), "upper": upper, "lower": lower,
        "holed": holed, "steep": steep, "slice": scan[:1], "thin": scan[:3], "small": small, "stretched": scan, "shifted_scan": scan,
    }  # fmt: skip
    for name, values in volumes.items():
        spacing, origin = (1.0, 1.0, 1.0 + 0.2 * (name == "stretched")), (3.0 * (name == "shifted_scan"), 0.0, 0.0)
        write_volume(root / f"{name}.mha", Volume.from_array(values, spacing_mm=spacing, origin_mm=origin, missing=True))
    flat = (root / "slice.mha").read_bytes()
    (root / "spaceless.mha").write_bytes(flat.replace(b"ElementSpacing = 1.0 1.0 1.0", b"ElementSpacing = 0.0 1.0 1.0"))
    return {name: root / f"{name}.mha" for name in (*volumes, "spaceless")}


def touched_bodies(root: Path) -> Files:
    """A block and a sheet, both 20 mm wide, and paths of a blade and a tip through them."""
    write_vtu(root / "solid.vtu", to_tetra(box((20.0, 20.0, 10.0), (2, 2, 1))))
    corners = [(x, y) for x in (0, 10, 20) for y in (0, 10, 20)]
    faces = [(k, k + 3, k + 4) for k in (1, 2, 4, 5)] + [(k, k + 4, k + 1) for k in (1, 2, 4, 5)]
    sheet = "".join(f"v {x} {y} 0\n" for x, y in corners) + "".join(f"f {a} {b} {c}\n" for a, b, c in faces)
    texts = {"sheet.obj": sheet, "blade.csv": "-12,-12,4,-12,12,4\n12,-12,4,12,12,4\n", "tip.csv": "3,8,0\n17,9,0\n"}
    for name, text in texts.items():
        (root / name).write_text(text, encoding="utf-8")
    return {
        name: root / file for name, file in (("solid", "solid.vtu"), ("sheet", "sheet.obj"), ("blade", "blade.csv"), ("tip", "tip.csv"))
    }


def views(root: Path) -> Files:
    """Half ellipses as the outlines of a breast."""
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61)
    for name, depth, width in (("cc", 80.0, 60.0), ("mlo", 85.0, 70.0)):
        np.savetxt(root / f"{name}.csv", np.stack([depth * np.cos(turn), width * np.sin(turn)], axis=1), delimiter=",")
    return {name: root / f"{name}.csv" for name in ("cc", "mlo")}


def measured_field(root: Path) -> Files:
    """Fields at points, one of them of a shift and one without sense, and two zones on a grid around them."""
    labels = np.zeros((12, 12, 12), dtype=np.uint8)
    labels[1:6, 1:11, 1:11], labels[6:11, 1:11, 1:11] = 1, 2
    write_volume(root / "labels.mha", Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0)))
    points = np.random.default_rng(0).uniform(3.0, 19.0, (400, 3))
    fields = {"field": 0.02 * points, "shifted": np.full_like(points, 5.0), "torn": 40.0 * np.sin(9.0 * points)}
    for name, vectors in fields.items():
        write_field(root / f"{name}.h5", DisplacementField.from_arrays(points, vectors, sd_mm=0.01))
    return {"labels": root / "labels.mha", **{name: root / f"{name}.h5" for name in fields}}


def recorded_readings(root: Path) -> Files:
    """A decoder of forces and readings that it decodes."""
    coefficients = [[6.3, *8 * [0.0]], [1.0, *8 * [0.0]], [1.0, *8 * [0.0]]]
    stored = {
        "kind": DECODER, "naibu": "0.2.0", "study": "finger.toml", "radius_mm": 10.0, "volts_per_load": [0.4, 1.2, 1.2],
        "noise": [0.16, 0.014, 0.014], "coefficients": coefficients, "unit": [3.3, 0.9], "spread": [0.04, 0.03, 0.04],
        "limits": [1.2, 8.4, 0.6], "model_error": 0.02,
        "slip": {"coefficients": [1.0, *8 * [0.0]], "spread": 0.01, "sensitivity_mm": 0.27, "sensitivity_error": 0.1},
    }  # fmt: skip
    (root / "decoder.json").write_text(json.dumps(stored), encoding="utf-8")
    (root / "readings.csv").write_text("".join(f"{0.01 * k},{2.0 * (k > 20)},0.1,0\n" for k in range(40)), encoding="utf-8")
    return {"decoder": root / "decoder.json", "readings": root / "readings.csv"}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Run]:
    """Run a command in this process, in a folder of its own; return the exit code and the message."""

    def too_long(number: int, frame: FrameType | None) -> None:
        raise TimeoutError("not refused, or not at once")

    def wait_from_now(*_: object) -> None:
        signal.alarm(PATIENCE_S)

    place = tmp_path / "place"
    place.mkdir()
    monkeypatch.chdir(place)
    before = signal.signal(signal.SIGALRM, too_long)

    def command(words: list[str]) -> tuple[int, str]:
        said = io.StringIO()
        # both consoles write to the streams of the time; a console whose file is set and "restored" keeps this test's stream for ever
        monkeypatch.setattr(sys, "stderr", said)
        monkeypatch.setattr(sys, "stdout", io.StringIO())
        monkeypatch.setattr(sys, "argv", ["naibu", *words])
        wait_from_now()
        try:
            with reported_compilation(wait_from_now):  # kernels that are compiled for the first time take longer
                cli.main()
            code = 0
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            signal.alarm(0)
        return code, said.getvalue()

    yield command
    signal.signal(signal.SIGALRM, before)


def faults(run: Run, words: list[str], expected: Iterable[str | set[str]]) -> list[str]:
    """Return what is wrong with the answer to a bad input: nothing, if it was refused in words, and nothing was written."""
    code, message = run(words)
    told = re.compile(r"compiling kernels|preparing the simulation|(?!error).*, \d+ s(, about .* left)?$")  # progress, on a slow machine
    message = "".join(line for line in message.splitlines(keepends=True) if not told.match(line))
    found = []
    if code != cli.BAD_INPUT or not message.startswith("error: ") or "Traceback" in message or "error of its own" in message:
        found.append(f"exit code {code}: {message[:200]!r}")
    for word in expected:
        if not any(w in message for w in ({word} if isinstance(word, str) else word)):
            found.append(f"{word!r} is not in {message[:300]!r}")
    if left := [str(p) for p in Path("out").rglob("*") if p.is_file()]:
        found.append(f"wrote {left}")
    shutil.rmtree("out", ignore_errors=True)
    return [f"{' '.join(words)[:200]}: {fault}" for fault in found]


def ways_to_say(value: str) -> set[str]:
    """Return the forms in which a message may quote a value, or a part of it."""
    said = {value, repr(value), *(part for part in re.split(r"[=/]", value) if part)}
    try:
        number = float(value)
    except ValueError:
        return said
    return said | {f"{number:g}", repr(number), *([str(int(number))] if math.isfinite(number) else [])}


@pytest.mark.parametrize("row", BY_HAND, ids=lambda row: f"{row['kind']}: {' '.join(row['command'])}"[:60])
def test_inputs_written_by_hand(run: Run, files: Files, tmp_path: Path, row: dict[str, object]) -> None:
    names, folder = dict(files), tmp_path / "folder"
    folder.mkdir()
    names["folder"] = folder
    if "file" in row:
        name, content = row["file"]
        names["file"] = folder / name
        (folder / name).write_text(content, encoding="utf-8")
    words = [word.format(**names) for word in row["command"]]
    if "--out" not in words and words[0] not in ("report", "nosuch", "live"):
        words += ["--out", "out"]
    assert not faults(run, words, row["expected"])
    assert "file" not in row or (folder / row["file"][0]).read_text(encoding="utf-8") == row["file"][1]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("kind", "x"), ("radius_mm", -5.0), ("radius_mm", 1e300), ("volts_per_load", [0.0, 1.0, 1.0]), ("volts_per_load", [1.0, 1.0]),
        ("noise", [-1.0, 1.0, 1.0]), ("noise", [0.0, 0.0, 0.0]), ("coefficients", [[1.0], [1.0], [1.0]]), ("coefficients", []),
        ("coefficients", [9 * [1e308]] * 3), ("unit", [0.0, 1.0]), ("spread", [-1.0, 0.0, 0.0]), ("limits", [5.0, 1.0, 1.0]),
        ("limits", [1.0, 5.0, -1.0]), ("model_error", 0.9), ("more", 5),
        ("slip", {}), ("slip", None), ("slip", {"coefficients": 9 * [0.0], "spread": 0.0, "sensitivity_mm": -1.0}),
    ],
)  # fmt: skip
def test_decoders_that_cannot_be_are_refused(run: Run, files: Files, tmp_path: Path, key: str, value: object) -> None:
    stored = json.loads(files["decoder"].read_text(encoding="utf-8"))
    (tmp_path / "decoder.json").write_text(json.dumps(stored | {key: value}), encoding="utf-8")
    words = ["decode-forces", str(tmp_path / "decoder.json"), str(files["readings"])]
    assert not faults(run, [*words, "--out", "out"], ["decoder" if key == "kind" else key, "simulate"])


def test_the_decoder_that_they_spoil_decodes(run: Run, files: Files) -> None:
    code, message = run(["decode-forces", str(files["decoder"]), str(files["readings"]), "--out", "out"])
    assert code == 0, message


def check_options(run: Run, files: Files, part: slice) -> int:
    found, rows = [], list(bad_options())[part]
    for row in rows:
        words = [word.format(**files) if re.fullmatch(r"\{\w+\}", word) else word for word in row.command]
        option = {row.option, row.option.removeprefix("--"), *({"is not loaded"} if row.option == "--state" else ())}
        values = set.union(*(ways_to_say(value) for value in row.values)) if all(row.values) else {""}
        found += faults(run, words if row.verb == "live" else [*words, "--out", "out"], [option, values])
    assert not found, "\n".join(found)
    return len(rows)


def check_studies(run: Run, tmp_path: Path, part: slice) -> int:
    found, rows, file = [], list(bad_studies())[part], tmp_path / "bad.toml"
    for row in rows:
        file.write_text(document(row.file), encoding="utf-8")
        found += faults(run, ["simulate", str(file), "--out", "out"], [row.key])
    assert not found, "\n".join(found)
    return len(rows)


def check_descriptions(run: Run, files: Files, folder: Path, part: slice) -> int:
    file = folder / "meta.toml"
    found, rows = [], list(bad_descriptions(file.read_text(encoding="utf-8")))[part]
    for row in rows:
        file.write_text(document(row.file), encoding="utf-8")
        # the state does not exist either: a mistake that is not noticed does not start a long computation
        found += faults(run, ["predict", str(files["model"]), str(folder), "--state", "nosuch", "--out", "out"], [row.key])
    assert not found, "\n".join(found)
    return len(rows)


def test_some_bad_values_of_every_option(run: Run, files: Files) -> None:
    assert check_options(run, files, slice(None, None, FAST)) > 150


def test_some_bad_values_of_every_key_of_a_study(run: Run, tmp_path: Path) -> None:
    assert check_studies(run, tmp_path, slice(None, None, FAST)) > 90


def test_some_bad_values_of_every_key_of_an_experiment(run: Run, files: Files, experiment_folder: Path) -> None:
    assert check_descriptions(run, files, experiment_folder, slice(None, None, FAST)) > 60


@pytest.mark.slow
def test_all_bad_values(run: Run, files: Files, experiment_folder: Path, tmp_path: Path) -> None:
    count = check_options(run, files, slice(None)) + check_studies(run, tmp_path, slice(None))
    count += check_descriptions(run, files, experiment_folder, slice(None))
    assert count + len(BY_HAND) >= 2800
