"""Cutting of scanned surfaces from files: what is written, that the cut opens, and what is refused."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from notebooks import check_shown

from naibu import cli
from naibu.core.errors import InputError
from naibu.io.tables.blade_table import read_tip_path
from naibu.meshing import boundary_faces, box
from naibu.workflows import cut_surface_file
from naibu.workflows.interactive.cut_surface import places_text

SIZE = 40.0


def sheet(n: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Return an open sheet of a wave."""
    g = np.linspace(0.0, SIZE, n + 1)
    x, y = np.meshgrid(g, g, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 2.0 * np.sin(0.15 * x.ravel())], axis=1)
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def area(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def stl(points: np.ndarray, triangles: np.ndarray) -> bytes:
    corners = points[triangles].astype("<f4").reshape(-1, 9)
    rows = b"".join(struct.pack("<12fH", 0.0, 0.0, 0.0, *row, 0) for row in corners)
    return bytes(80) + struct.pack("<I", len(triangles)) + rows


def ply(points: np.ndarray, triangles: np.ndarray) -> bytes:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    return (head + "".join(f"{x} {y} {z}\n" for x, y, z in points) + "".join(f"3 {a} {b} {c}\n" for a, b, c in triangles)).encode()


def obj(points: np.ndarray, triangles: np.ndarray) -> bytes:
    return ("".join(f"v {x} {y} {z}\n" for x, y, z in points) + "".join(f"f {a} {b} {c}\n" for a, b, c in triangles + 1)).encode()


def wrl(points: np.ndarray, triangles: np.ndarray) -> bytes:
    at, index = ", ".join(f"{x} {y} {z}" for x, y, z in points), ", ".join(f"{a}, {b}, {c}, -1" for a, b, c in triangles)
    text = "#VRML V2.0 utf8\nShape { geometry IndexedFaceSet { coord Coordinate { point [ %s ] } coordIndex [ %s ] } }\n"
    return (text % (at, index)).encode()


FORMATS = {"stl": stl, "ply": ply, "obj": obj, "wrl": wrl}


def surface_file(folder: Path, ending: str = "ply", shape: tuple[np.ndarray, np.ndarray] | None = None) -> Path:
    path = folder / f"scan.{ending}"
    path.write_bytes(FORMATS[ending](*(shape or sheet())))
    return path


def path_file(folder: Path, below: float = 0.0, text: str = "") -> Path:
    path = folder / "tool.csv"
    x = np.linspace(10.0, 30.0, 21)
    rows = [f"{a},{0.2 * a + 14.0},{2.0 * np.sin(0.15 * a) - below}" for a in x]
    path.write_text(text or "x,y,z\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("ending", FORMATS)
def test_a_scan_of_any_format_is_cut_and_opens(tmp_path: Path, ending: str) -> None:
    done = cut_surface_file(surface_file(tmp_path, ending), path_file(tmp_path), out=tmp_path / "out", distance_mm=2.0)
    assert [file.name for file in done.files] == ["cut.html", "cut.vtu", "cut.vtkhdf", "cut.json"]
    numbers = json.loads((tmp_path / "out" / "cut.json").read_text())
    assert numbers["pieces"] == 1
    assert numbers["area_before_mm2"] == pytest.approx(area(*sheet()), rel=1e-6)
    assert numbers["relative_change_of_area"] < 1e-6  # of the single precision that STL has
    assert 0.0 < numbers["mean_distance_from_the_path_mm"] < numbers["largest_distance_from_the_path_mm"] <= 1.0
    assert numbers["area_of_the_groove_mm2"] == 0.0
    assert numbers["length_of_the_cut_mm"] == pytest.approx(20.4, rel=0.1)
    assert 0.3 < numbers["largest_opening_mm"] < 4.0
    steps = np.linalg.norm(np.diff(done.displacement, axis=0), axis=2).max(axis=1)
    assert steps[0] > 0.0  # it opens behind the tool
    assert "opens by" in (tmp_path / "out" / "cut.html").read_text()
    assert {row["quantity"]: row["value"] for row in check_shown(done, done.files[0])} == numbers


def test_without_tension_nothing_moves_and_without_refinement_nothing_is_refined(tmp_path: Path) -> None:
    scan, path = surface_file(tmp_path), path_file(tmp_path)
    done = cut_surface_file(scan, path, out=tmp_path / "out", distance_mm=1.0, tension_percent=0.0, refine=False)
    assert not done.displacement.any() and done.numbers["largest_opening_mm"] == 0.0
    assert done.numbers["triangles"] == done.numbers["triangles_before"]
    fine = cut_surface_file(scan, path, out=tmp_path / "fine", distance_mm=1.0, tension_percent=0.0)
    assert fine.cut.deviation_mm <= 0.5 < done.cut.deviation_mm


def test_a_groove_is_as_deep_as_the_tips_or_as_stated(tmp_path: Path) -> None:
    scan, settings = surface_file(tmp_path), {"distance_mm": 2.0, "tension_percent": 0.0}
    deep = cut_surface_file(scan, path_file(tmp_path, below=2.5), out=tmp_path / "a", **settings)
    assert deep.numbers["area_of_the_groove_mm2"] == pytest.approx(2 * 2.5 * 20.4, rel=0.2)
    stated = cut_surface_file(scan, path_file(tmp_path), out=tmp_path / "b", groove_depth_mm=1.0, **settings)
    assert stated.numbers["area_of_the_groove_mm2"] == pytest.approx(2 * 1.0 * 20.4, rel=0.2)
    none = cut_surface_file(scan, path_file(tmp_path, below=2.5), out=tmp_path / "c", groove_depth_mm=0.0, **settings)
    assert none.numbers["area_of_the_groove_mm2"] == 0.0


def test_a_loop_falls_out_and_contracts_to_the_length_of_its_springs(tmp_path: Path) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    rows = [f"{20 + 8 * np.cos(a)},{20 + 8 * np.sin(a)},{2.0 * np.sin(0.15 * (20 + 8 * np.cos(a)))}" for a in angle]
    done = cut_surface_file(surface_file(tmp_path), path_file(tmp_path, text="\n".join(rows)), out=tmp_path / "out", distance_mm=1.5)
    assert done.cut.n_pieces == 2
    assert done.cut.areas_mm2[1] == pytest.approx(np.pi * 64.0, rel=0.1)
    own = done.cut.triangles[done.cut.piece == 1]
    moved = done.cut.points + done.displacement[-1]
    assert area(moved, own) == pytest.approx(0.95**2 * area(done.cut.points, own), rel=1e-9)


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("1,2,3,4,5,6\n4,5,6,7,8,9\n", {}, "the path of a blade, which cuts solids"),
        ("1,2,3\n", {}, "at least two rows"),
        ("1,2\n3,4\n", {}, "x, y, z"),
        ("1,2,3\n1,2,nan\n", {}, "row 2 has 'nan'"),
        ("100,0,0\n100,9,0\n", {}, r"tool\.csv: the tip stays more than"),
        ("5,5,0\n5,5,0\n", {}, "path has no length"),
        ("20,20,0\n20,20.01,0\n", {"distance_mm": 3.0}, "too short to cut"),
        ("", {"distance_mm": 0.0}, "distance_mm"),
        ("", {"distance_mm": 90.0}, "larger than the surface"),
        ("", {"tension_percent": 95.0}, "tension_percent"),
        ("", {"groove_depth_mm": -1.0}, "groove_depth_mm"),
        ("", {"unit_mm": 0.0}, "unit_mm"),
    ],
)
def test_what_cannot_be_cut_is_refused(tmp_path: Path, text: str, options: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        cut_surface_file(surface_file(tmp_path), path_file(tmp_path, text=text), out=tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_the_page_of_a_large_surface_shows_what_is_near_the_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("naibu.workflows.interactive.cut_surface.PAGE_TRIANGLES", 300)
    done = cut_surface_file(surface_file(tmp_path), path_file(tmp_path), out=tmp_path / "out", distance_mm=2.0, tension_percent=0.0)
    assert done.numbers["triangles"] > 512
    text = (tmp_path / "out" / "cut.html").read_text()
    assert "the 300 triangles nearest to the cut" in text
    frames = json.loads(text.split('id="naibu-frames">')[1].split("</script>")[0])
    assert len(frames["faces"]) == 900
    at = np.array(frames["reference"]).reshape(-1, 3)
    away = [np.linalg.norm(p[:, None] - done.cut.cut_edges.mean(axis=1), axis=2).min(axis=1).max() for p in (at, done.cut.points)]
    assert away[0] < 0.75 * away[1]


def test_edges_of_three_triangles_are_opened_and_said(tmp_path: Path) -> None:
    points, triangles = sheet()
    fin = np.concatenate([points, [[20.0, 20.0, 30.0]]]), np.concatenate([triangles, [[20, 21, len(points)]]])
    done = cut_surface_file(surface_file(tmp_path, "obj", fin), path_file(tmp_path), out=tmp_path / "out", distance_mm=2.0)
    assert "more than two triangles share" in done.numbers["repairs"][0]
    assert "more than two triangles share" in (tmp_path / "out" / "cut.html").read_text()


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Run ``naibu cut``; return its exit code, and its output and messages."""

    def run(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["naibu", "cut", *map(str, words)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr()
        return code, said.out + said.err

    return run


def test_the_verb_tells_solids_from_surfaces(tmp_path: Path, verb: Callable[..., tuple[int, str]]) -> None:
    solid = box((SIZE, SIZE, 10.0), (8, 8, 2), cell_type="tetra")
    closed = surface_file(tmp_path, "stl", (solid.points, boundary_faces(solid).faces))
    tips, blade = path_file(tmp_path, text="-5,20,10.5\n45,21,10.5\n"), tmp_path / "blade.csv"
    blade.write_text("1,2,3,4,5,6\n4,5,6,7,8,9\n")
    out = ("--out", tmp_path / "out")
    assert "--pull-percent goes with solids" in verb(closed, "--path", tips, "--pull-percent", 3, *out)[1]
    assert "name a mesh of tetrahedra" in verb(closed, "--path", blade, *out)[1]
    assert "--tension-percent goes with surfaces" in verb("gel.vtu", "--path", blade, "--tension-percent", 3, *out)[1]
    code, said = verb(closed, "--path", tips, "--distance-mm", 2, "--no-refine", "--tension-percent", 0, *out)
    assert code == 0
    assert "1 piece of" in said and "deviates from the path" in said


def test_tips_are_read_with_and_without_names(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_tip_path(path_file(tmp_path, text="# mm\nx,y,z\n1,2,3\n4,5,6\n")), [[1, 2, 3], [4, 5, 6]])


def by_hand(folder: Path) -> list[Path]:
    """One wavy sheet as others write it: Windows' line ends, quadrilaterals, normals, colours, names, vertices again for every facet."""
    n, end = 8, "\r\n"
    points = [(5.0 * x, 5.0 * y, np.sin(x)) for y in range(n + 1) for x in range(n + 1)]
    quads = [(k := y * (n + 1) + x, k + 1, k + n + 2, k + n + 1) for y in range(n) for x in range(n)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    rows = [" ".join(f"{v:.7f}" for v in p) for p in points]
    wavefront = ["# by hand", "mtllib none.mtl", "o sheet", *[f"v {r} 1.0 0.5 0.5" for r in rows]]
    wavefront += ["vt 0 0", "vn 0 0 1", "s off", "usemtl a b"]
    for k, q in enumerate(quads):
        wavefront.append("f " + " ".join(f"{i + 1}/1/1" if k % 2 else f"{i - len(points)}//-1" for i in q))
    facets = ["solid my part 1"]
    for t in triangles:
        facets += ["facet normal 0.0 0.0 1.0E+00", " outer loop", *[f"  vertex {rows[i]}" for i in t], " endloop", "endfacet"]
    ply = ["ply", "format ascii 1.0", "comment by hand", f"element vertex {len(points)}"]
    ply += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")] + ["property uchar red", f"element face {len(quads)}"]
    ply += ["property list uchar int vertex_index", "property uchar flag", "element edge 1", "property int vertex1", "property int vertex2"]
    ply += ["end_header", *[f"{r} 0 0 1 10" for r in rows], *["4 " + " ".join(map(str, q)) + " 7" for q in quads], "0 1"]
    vrml = ["#VRML V2.0 utf8", "DEF Scene Transform {", " translation 0 0 0", " children [ Shape {"]
    vrml += [" geometry DEF G IndexedFaceSet {", "  solid FALSE creaseAngle 0.5 # scanner", "  coord Coordinate { point ["]
    vrml += [*[f"  {r}," for r in rows], "  ] }", " normal Normal { vector [ 0 0 1 ] }", "  coordIndex ["]
    vrml += [*["  " + " ".join(map(str, q)) + " -1" for q in quads], "  ] } } ] }"]
    texts = {"sheet.obj": wavefront, "sheet.stl": [*facets, "endsolid my part 1"], "sheet.ply": ply, "sheet.wrl": vrml}
    for name, lines in texts.items():
        (folder / name).write_bytes((end.join(lines) + end).encode())
    return [folder / name for name in texts]


def test_surfaces_that_others_wrote_are_cut_alike(tmp_path: Path) -> None:
    x = np.linspace(6.0, 34.0, 15)
    z = np.interp(x, np.arange(0.0, 41.0, 5.0), np.sin(np.arange(9.0)))  # on the sheet
    tip = path_file(tmp_path, text="x,y,z\r\n" + "".join(f"{a:.4f},20,{b:.4f}\r\n" for a, b in zip(x, z, strict=True)))
    fine = np.linspace(6.0, 34.0, 20_001)
    arc = float(np.hypot(np.diff(fine), np.diff(np.interp(fine, np.arange(0.0, 41.0, 5.0), np.sin(np.arange(9.0))))).sum())
    found = [cut_surface_file(file, tip, out=tmp_path / file.suffix[1:]) for file in by_hand(tmp_path)]
    for run in found:
        assert run.cut.areas_mm2.sum() == pytest.approx(found[0].cut.areas_mm2.sum(), rel=1e-6)
        assert run.numbers["largest_opening_mm"] == pytest.approx(found[0].numbers["largest_opening_mm"], rel=1e-3)
        # at either end it may stop, or go on, within what is allowed
        assert run.numbers["length_of_the_cut_mm"] == pytest.approx(arc, abs=2.0 * run.numbers["allowed_distance_mm"])
    vrml = (tmp_path / "sheet.wrl").read_text()
    (tmp_path / "moved.wrl").write_text(vrml.replace("translation 0 0 0", "translation 0 0 5"))
    (tmp_path / "old.wrl").write_text(vrml.replace("V2.0 utf8", "V1.0 ascii"))
    for name, said in (("moved", "apply transforms"), ("old", r"export the surface as VRML 2\.0")):
        with pytest.raises(InputError, match=said):
            cut_surface_file(tmp_path / f"{name}.wrl", tip, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_cut_whose_sides_still_hang_together_is_told(tmp_path: Path, verb: Callable[..., tuple[int, str]]) -> None:
    """Without refinement no edge of this coarse sheet leads on near its middle, and the cut goes on behind."""
    x = np.linspace(-2.0, SIZE + 2.0, 200)
    rows = [f"{a},{b},{2.0 * np.sin(0.15 * a)}" for a, b in zip(x, np.linspace(5.0, 38.0, 200), strict=True)]
    path, out = path_file(tmp_path, text="\n".join(rows)), tmp_path / "out"
    code, said = verb(surface_file(tmp_path, shape=sheet(6)), "--path", path, "--distance-mm", 2, "--no-refine", "--out", out)
    places = np.array(json.loads((out / "cut.json").read_text())["places_where_the_sides_hang_together_mm"])
    sentence = "its two sides still hang together"
    assert code == 0 and sentence in " ".join(said.split()) and sentence in (out / "cut.html").read_text()
    gaps = [np.hypot(*(np.array([a, b]) - places[0, :2])) for a, b in zip(x, np.linspace(5.0, 38.0, 200), strict=True)]
    assert len(places) == 2 and min(gaps) < SIZE / 6


def test_places_are_told_without_rounding() -> None:
    """Middles of boxes came out as 1.776e-15 mm."""
    assert places_text(np.array([[1.7763568394002505e-15, -8.0, 20.004]])) == "one place (near 0, -8, 20 mm)"
    assert places_text(np.array([[-1e-12, 1e-5, 1234.56]])) == "one place (near 0, 1e-05, 1235 mm)"
