"""The result page: complete in itself, small, and true to what it was given."""

from __future__ import annotations

import base64
import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.viewer.json_values import jsonable
from naibu.viewer.page_frame import asset
from naibu.viewer.result_page.estimates import diverging_colour, parameter_table
from naibu.viewer.result_page.packing import packed_scene, packed_scenes, thinned
from naibu.viewer.result_page.page import MAX_BYTES, report_html, write_report
from naibu.viewer.result_page.payload import (
    Box,
    Correlation,
    ParameterRow,
    Report,
    ResidualSet,
    Scene,
    Step,
    report_json,
)
from naibu.viewer.tables import Table, cell_text

SIDE_MM = 60.0


def cube_surface(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (mm) and outward triangles of a cube's faces with n cells a side."""
    points: dict[tuple[int, int, int], int] = {}
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for at, outward in ((0, False), (n, True)):
            for i in range(n):
                for j in range(n):
                    quad = []
                    for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        key = [0, 0, 0]
                        key[axis], key[u], key[v] = at, i + di, j + dj
                        quad.append(points.setdefault((key[0], key[1], key[2]), len(points)))
                    a, b, c, d = quad if outward else quad[::-1]
                    faces += [(a, b, c), (a, c, d)]
    return SIDE_MM * np.array(list(points), dtype=float) / n, np.array(faces, dtype=np.int64)


def pressed(points: np.ndarray, height_mm: float) -> np.ndarray:
    """Volume-conserving compression with bulging sides, fixed at base and top."""
    stretch = height_mm / SIDE_MM
    z = points[:, 2] / SIDE_MM
    wide = 1 + (1 / np.sqrt(stretch) - 1) * (0.25 + 5 * z * (1 - z) * 0.75)
    centre = SIDE_MM / 2
    return np.column_stack(
        [centre + (points[:, :2] - centre) * wide[:, None], points[:, 2] * (stretch + 0.06 * (1 - stretch) * np.sin(2 * np.pi * z))]
    )


def fake_scene(
    name: str, height_mm: float, seed: int, *, cells: int = 20, n_steps: int = 11, role: str = "fitted", known: bool = True
) -> Scene:
    rng = np.random.default_rng(seed)
    free, faces = cube_surface(cells)
    lattice = np.stack(np.meshgrid(*[np.arange(10.0, 51.0, 10.0)] * 2, np.array([12.0, 24.0, 36.0, 48.0]), indexing="ij"), axis=-1)
    initial = lattice.transpose(2, 1, 0, 3).reshape(-1, 3) + rng.normal(0, 0.5, (100, 3))
    steps = []
    for t in np.linspace(0, 1, n_steps):
        height = SIDE_MM + t * (height_mm - SIDE_MM)
        plate = Box((SIDE_MM / 2, SIDE_MM / 2, height + 2.0), (42.0, 42.0, 2.0))
        steps.append(Step(f"plate at {height:.1f} mm", float(SIDE_MM - height), pressed(free, height), pressed(initial, height), (plate,)))
    measured = steps[-1].markers + rng.normal(0, 0.17, (100, 3)) + 0.25 * np.sin(initial / 17.0 + seed)
    measured[7] = np.nan
    measured[42, 2] = np.nan
    if not known:
        measured[:] = np.nan
    return Scene(
        name=name,
        experiment=name,
        state=f"plate at {height_mm:.0f} mm",
        faces=faces,
        reference_surface=free,
        steps=tuple(steps),
        marker_ids=np.arange(1, 101),
        initial_markers=initial,
        measured=measured,
        sd_mm=np.full(100, 0.16),
        layer=np.repeat(np.arange(4), 25),
        role=role,
    )


def fake_parameters() -> tuple[ParameterRow, ...]:
    return (
        ParameterRow(
            "mu_ratio", "Stiffness of the upper gel over the lower", 1.83, 1.71, 1.96, "", "the only stiffness that shapes alone can tell"
        ),
        ParameterRow("poisson", "Poisson ratio, both gels", 0.4957, 0.4931, 0.4976, "", ""),
        ParameterRow("friction_top", "Friction at the plate", 0.41, 0.22, float("inf"), "", "above 0.22 the plate holds the gel"),
        ParameterRow("friction_base", "Friction at the base", 0.63, float("nan"), float("nan"), "", "not determined"),
        ParameterRow("height_45", "Plate height, first load", 45.62, 45.41, 45.83, "mm", "stated 45"),
        ParameterRow("height_35", "Plate height, second load", 36.04, 35.88, 36.20, "mm", "stated 35"),
        ParameterRow("mu_soft", "Shear modulus of the soft gel", 41.5, 33.1, 52.0, "kPa", "scale from the compression test"),
        ParameterRow("mu_hard", "Shear modulus of the hard gel", 1760.0, 1490.0, 2080.0, "kPa", "scale from the compression test"),
    )


def fake_accuracy() -> Table:
    columns = (
        "Experiment",
        "State",
        "Markers",
        "RMS x (mm)",
        "RMS y (mm)",
        "RMS z (mm)",
        "RMS 3-D (mm)",
        "RMS 3-D (noise units)",
        "No model (mm)",
        "Affine (mm)",
    )
    rows = (
        ("two_material_2", "plate at 45 mm", 98, 0.241, 0.232, 0.198, 0.388, 1.40, 8.12, 1.31),
        ("cube_plate", "plate at 35 mm", 98, 0.262, float("nan"), 0.207, 0.402, 1.45, 14.9, 2.08),
    )
    return Table(
        "Distance between predicted and measured markers", columns, rows, note="Noise unit: what measurement noise alone would give."
    )


def fake_report(scenes: tuple[Scene, ...] | None = None) -> Report:
    if scenes is None:
        scenes = (fake_scene("two_material_2", 45.0, 1), fake_scene("cube_plate", 40.0, 2, role="predicted unseen"))
    matrix = np.eye(8)
    for i in range(8):
        for j in range(i):
            matrix[i, j] = matrix[j, i] = np.round(0.95 * np.sin(3.7 * i + 1.9 * j), 2)
    rows = fake_parameters()
    return Report(
        title="Gel blocks pressed by a plate: what the markers say",
        headline=(
            "The model puts the markers within 0.40 mm (RMS) of where the CT saw them, 1.4 times what measurement noise alone would give.",
            "In the state that was never used for fitting the distance is 0.40 mm; without a model it would be 14.9 mm.",
        ),
        scenes=scenes,
        accuracy=fake_accuracy(),
        residuals=tuple(ResidualSet.from_scene(s) for s in scenes),
        parameters=rows,
        correlation=Correlation(tuple(r.label for r in rows), matrix),
        undetermined=(
            "The absolute stiffness: no force was measured, so every modulus scales with the one taken from the compression test.",
            "Friction at the base: any value from 0 to 1 explains the markers equally well.",
        ),
        tables=(
            Table(
                "Comparison of models",
                ("Model", "Parameters", "RMS 3-D (mm)", "chi² per degree of freedom", "BIC"),
                (
                    ("neo-Hookean, sticking", 6, 0.402, 1.96, -312.4),
                    ("neo-Hookean, friction", 8, 0.388, 1.83, -330.1),
                    ("linear", 6, 1.12, 15.2, None),
                ),
            ),
        ),
        provenance={
            "naibu": "0.1.0",
            "seed": 20240611,
            "settings": {"law": "neo-Hookean", "steps": 10, "tolerance": 1e-8},
            "inputs (sha256)": {"two_material_2/initial.csv": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"},
        },
    )


@pytest.fixture(scope="module")
def report() -> Report:
    return fake_report()


@pytest.fixture(scope="module")
def page(report: Report) -> str:
    return report_html(report)


def scenes_in(page: str) -> list[dict]:
    found = re.search(r'id="naibu-scenes">([^<]*)</script>', page)
    assert found
    return json.loads(gzip.decompress(base64.b64decode(found[1])))["scenes"]


def unpacked(packed: dict, start: str, series: str, quantum: float) -> list[np.ndarray]:
    """The inverse that viewer-src/src/decode.js implements."""
    out: list[np.ndarray] = []
    for i, difference in enumerate(packed[series]):
        d = np.array(difference)
        out.append(d + (np.array(packed[start]) if i == 0 else out[0] if i == 1 else 2 * out[-1] - out[-2]))
    return [quantum * p.reshape(-1, 3) for p in out]


def test_page_is_small_and_asks_for_nothing(page: str) -> None:
    assert len(page.encode()) < MAX_BYTES
    markup = re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    assert "http://" not in markup and "https://" not in markup
    assert not re.search(r"""<(?:script|link|img|iframe|object|embed)[^>]*\b(?:src|href)=["'](?!data:)""", markup)
    assert not re.search(r"@import|url\((?!data:)", markup)
    assert all(target.startswith("#") for target in re.findall(r'<a href="([^"]*)"', markup))
    assert "default-src 'none'" in page
    assert page.count("<script>") == page.count("</script>") - 1 == 1


def test_bundle_is_small_and_loads_nothing() -> None:
    script, style = asset("report.js"), asset("report.css")
    assert len(script) < 700_000
    assert not re.search(r"\bfetch\(|XMLHttpRequest|importScripts|sendBeacon|new WebSocket", script)
    assert "url(" not in style and "@import" not in style
    assert "Permission is hereby granted" in script


def test_page_names_every_part(page: str, report: Report) -> None:
    for key in ("view", "accuracy", "residuals", "parameters", "limits", "tables", "provenance"):
        assert f'<section id="{key}"' in page
    for sentence in (*report.headline, *report.undetermined):
        assert sentence in page
    assert "NaN" not in re.sub(r"<script.*?</script>", "", page, flags=re.S)


def test_scenes_survive_the_page(page: str, report: Report) -> None:
    packed = scenes_in(page)
    assert [p["name"] for p in packed] == ["two_material_2", "cube_plate"]
    for p, scene in zip(packed, report.scenes, strict=True):
        assert np.array_equal(np.cumsum(p["faces"]).reshape(-1, 3), scene.faces)
        for got, step in zip(unpacked(p, "reference_surface", "surfaces", 0.01), scene.steps, strict=True):
            assert np.abs(got - step.surface).max() <= 0.00501
        for got, step in zip(unpacked(p, "initial_markers", "markers", 0.001), scene.steps, strict=True):
            assert np.abs(got - step.markers).max() <= 0.000501
        measured = np.array([np.nan if v is None else v for v in p["measured"]]).reshape(-1, 3) * 0.001
        assert np.array_equal(np.isnan(measured), np.isnan(scene.measured))
        assert np.nanmax(np.abs(measured - scene.measured)) <= 0.000501


def test_report_json_round_trip(report: Report) -> None:
    back = json.loads(report_json(report), parse_constant=pytest.fail)
    assert back["title"] == report.title
    assert back["scenes"][0]["measured"][7] == [None, None, None]
    assert back["accuracy"]["rows"][1][4] is None
    assert back["parameters"][2]["upper"] is None
    assert np.allclose(back["correlation"]["matrix"], report.correlation.matrix)  # type: ignore[union-attr]
    assert back == jsonable(report)


def test_jsonable_rounds_and_knows_arrays() -> None:
    assert jsonable({"a": np.float64(1.23456789), "b": np.array([1, 2]), 3: (np.inf, None, True, Path("x"))}, digits=3) == {
        "a": 1.23,
        "b": [1, 2],
        "3": [None, None, True, "x"],
    }


def test_same_report_same_bytes(page: str) -> None:
    assert report_html(fake_report()) == page


def test_write_is_atomic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: Report, page: str) -> None:
    target = tmp_path / "report.html"
    assert write_report(target, report) == target
    assert target.read_text(encoding="utf-8") == page
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]

    def refuse(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(Path, "replace", refuse)
    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises((OSError, InputError)):
        write_report(target, Report("other", ("text",)))
    assert target.read_text(encoding="utf-8") == page
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_large_reports_lose_steps_first(report: Report, page: str) -> None:
    limit = len(page.encode()) - 5_000
    small = report_html(report, max_bytes=limit)
    assert len(small.encode()) <= limit
    packed = scenes_in(small)
    assert 2 <= len(packed[0]["steps"]) < 11
    assert packed[0]["steps"][0]["label"] == "plate at 60.0 mm"
    assert packed[0]["steps"][-1]["label"] == "plate at 45.0 mm"
    with pytest.raises(InputError, match="fewer scenes"):
        report_html(report, max_bytes=100_000)


def test_ten_scenes_stay_below_the_limit() -> None:
    scenes = tuple(fake_scene(f"cube_{i}", 50.0 - i, i) for i in range(10))
    assert len(report_html(fake_report(scenes)).encode()) < MAX_BYTES


def test_minimal_and_unmeasured_reports() -> None:
    bare = report_html(Report("only words", ("Nothing to show yet.",)))
    assert "Nothing to show yet." in bare and "naibu-scenes" not in bare and len(bare) < 30_000
    rotation_limited = fake_scene("held_back", 45.0, 3, cells=4, known=False, role="held back")
    shown = report_html(fake_report((rotation_limited,)))
    assert scenes_in(shown)[0]["measured"] == [None] * 300
    assert '<section id="residuals"' not in shown


def test_text_is_escaped() -> None:
    page = report_html(Report("<b>&", ("a < b",), undetermined=("<script>x",), tables=(Table("<i>", ("<u>",), (("<s>",),)),)))
    for raw in ("<b>", "<i>", "<u>", "<s>", "<script>x"):
        assert raw not in page
    assert "a &lt; b" in page


def test_wrong_shapes_are_named() -> None:
    scene = fake_scene("x", 45.0, 1, cells=2, n_steps=2)
    with pytest.raises(InputError, match=r"measured must have shape \(100, 3\)"):
        Scene(**{**{f: getattr(scene, f) for f in scene.__slots__}, "measured": np.zeros((3, 3))})
    with pytest.raises(InputError, match="faces refer to nodes"):
        Scene(**{**{f: getattr(scene, f) for f in scene.__slots__}, "faces": np.array([[0, 1, 999]])})
    with pytest.raises(InputError, match="no steps"):
        Scene(**{**{f: getattr(scene, f) for f in scene.__slots__}, "steps": ()})
    with pytest.raises(InputError, match="row 0 has 1 cells"):
        Table("t", ("a", "b"), ((1,),))
    with pytest.raises(InputError, match="needs a"):
        Correlation(("a", "b"), np.eye(3))


def test_thinned_keeps_both_ends() -> None:
    scene = fake_scene("x", 45.0, 1, cells=2, n_steps=6)
    assert [s.label for s in thinned(scene).steps] == [scene.steps[i].label for i in (0, 2, 4, 5)]


def test_packing_is_deterministic_and_compact() -> None:
    scene = fake_scene("x", 45.0, 1)
    assert packed_scenes([scene]) == packed_scenes([scene])
    assert len(packed_scenes([scene])) < 0.35 * len(json.dumps(packed_scene(scene)))


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (-0.1234, "−0.123"), (2.0, "2.00"), (45.62, "45.6"), (1760.4, "1760"), (7, "7"), ("a<b", "a&lt;b")],
)
def test_cells_read_well(value: object, text: str) -> None:
    assert cell_text(value) == text  # type: ignore[arg-type]


def test_correlation_text_has_contrast() -> None:
    def luminance(hex_colour: str) -> float:
        full = hex_colour if len(hex_colour) == 7 else "#" + "".join(2 * c for c in hex_colour[1:])
        c = np.array([int(full[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    for value in np.linspace(-1, 1, 41):
        high, low = sorted((luminance(c) for c in diverging_colour(float(value))), reverse=True)
        assert (high + 0.05) / (low + 0.05) > 4.5


def test_open_intervals_are_drawn_inside() -> None:
    html = parameter_table(fake_parameters())
    assert html.count("interval-open") == 3
    percents = [float(p) for p in re.findall(r'c?x[12]?="([-\d.]+)%"', html)]
    assert min(percents) >= 0 and max(percents) <= 100
