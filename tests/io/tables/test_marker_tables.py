"""Tables of other programs, naibu's own tables, and whole folders made of them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu import datasets
from naibu.core.errors import InputError, MissingDependencyError
from naibu.core.experiment import Layer, Loading, Shape
from naibu.core.markers import Markers
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.files.atomic import write_atomically
from naibu.io.tables.marker_tables import import_markers, write_experiment_folder, write_markers

EXPECTED = np.array([[12.5, 10.0, 3.0], [22.5, 10.25, 3.5]])


def table(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "marker,x_mm,y_mm,z_mm\n1,12.5,10,3\n2,22.5,10.25,3.5\n",
        "No.,X,Y,Z\n1,12.5,10,3\n2,22.5,10.25,3.5\n",
        "No.;X [mm];Y [mm];Z [mm]\n1;12,5;10;3\n2;22,5;10,25;3,5\n",
        'id,x,y,z\n1,"12,5","10,0","3,0"\n2,"22,5","10,25","3,5"\n',
        "Point ID\tPosition X\tPosition Y\tPosition Z\n1\t12.5\t10\t3\n2\t22.5\t10.25\t3.5\n",
        "id,x_cm,y_cm,z_cm\n1,1.25,1.0,0.3\n2,2.25,1.025,0.35\n",
        "Nr.;X (m);Y (m);Z (m)\n1;0,0125;0,010;0,003\n2;0,0225;0,01025;0,0035\n",
        "Marker,x_mm,y_cm,z_um\n1.0,12.5,1,3000\n2.0,22.5,1.025,3500\n",
        "Export of 3 May; operator: A, B\n\nLabel,x/mm,y/mm,z/mm,comment\n2,22.5,10.25,3.5,a; b\n1,12.5,10,3,\n",
        "#,x,y,z\n1,12.5,10,3\n2,2.25e1,10.25,3.5\n",
    ],
)
def test_obvious_columns_units_and_decimal_commas_are_understood(text: str, tmp_path: Path) -> None:
    markers = import_markers(table(tmp_path, text))
    np.testing.assert_array_equal(markers.ids, [1, 2])
    np.testing.assert_allclose(markers.points, EXPECTED, atol=1e-12)


def test_named_columns_and_unit(tmp_path: Path) -> None:
    path = table(tmp_path, "bead|links|tief|hoch|x\n1|1.25|1|.3|0\n2|2.25|1.025|.35|0\n")
    columns = {"marker": "bead", "x_mm": "links", "y_mm": "tief", "z_mm": "hoch"}
    np.testing.assert_allclose(import_markers(path, columns, unit="cm", delimiter="|").points, EXPECTED)


def test_plane_table_has_no_z(tmp_path: Path) -> None:
    path = table(tmp_path, "id,x,y\n1,12.5,10\n")
    assert np.isnan(import_markers(path, {"marker": "id", "x_mm": "x", "y_mm": "y"}).points[0, 2])


def test_thousands_are_understood_where_the_decimal_mark_is_known(tmp_path: Path) -> None:
    points = import_markers(table(tmp_path, "id;x;y;z\n1;1.234,5;2,5;3,0\n")).points
    np.testing.assert_array_equal(points, [[1234.5, 2.5, 3.0]])


def test_labels_of_one_prefix_are_their_numbers(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text("label,x_mm,y_mm,z_mm\nM010,1,2,3\nM002,4,5,6\n", encoding="utf-8")
    markers = import_markers(table)
    assert dict(zip(markers.ids.tolist(), markers.points.tolist(), strict=True)) == {10: [1.0, 2.0, 3.0], 2: [4.0, 5.0, 6.0]}
    table.write_text("label,x_mm,y_mm,z_mm\nA1,1,2,3\nB2,4,5,6\n", encoding="utf-8")  # A1 and B1 may be two markers
    with pytest.raises(InputError, match=r"'A1' is not a whole number.*the same letters in all rows"):
        import_markers(table)


def test_blank_cells_are_missing_and_status_is_kept(tmp_path: Path) -> None:
    markers = import_markers(table(tmp_path, "id,x,y,z,status\n1,1,,3,missing\n2,1,2,3,suspect\n3,−1,n/a,3,\n"))
    np.testing.assert_array_equal(np.isnan(markers.points[:, 1]), [True, False, True])
    np.testing.assert_array_equal(markers.trusted, [True, False, True])
    assert markers.points[2, 0] == -1.0


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_encodings_of_spreadsheets_are_read(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes("id;x [µm];y [µm];z [µm]\r\n1;12500;10000;3000\r\n2;22500;10250;3500\r\n".encode(encoding))
    np.testing.assert_allclose(import_markers(path).points, EXPECTED)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", ["empty"]),
        ("a,b,c\n1,2,3\n", ["cannot recognise the columns", "a, b, c", "columns="]),
        ("marker,x,y\n1,2,3\n", ["cannot recognise the columns of z among marker, x, y; call them z_mm"]),
        ("x,y,z\n1,2,3\n", ["columns of the marker's number among x, y, z", "naibu track"]),
        ("id,x,y,z\n", ["no rows follow"]),
        ("id,x,y,z\n1,abc,2,3\n", ["line 2, column 'x' = 'abc'", "not a number"]),
        ("id,x,y,z\n1,inf,2,3\n", ["column 'x' = 'inf'"]),
        ("id;x;y;z\n1;12,5;1.5;3\n", ["'12,5'", "decimal mark is '.'"]),
        ("id,x,y,z\none,1,2,3\n", ["column 'id' = 'one'", "whole number"]),
        ("id,x,y,z\n1.5,1,2,3\n", ["column 'id' = '1.5'"]),
        ("id,x,y,z\n1,1,2,3\n1,1,2,3\n", ["table.csv: marker 1 appears more than once"]),
        ("id,label,x,y,z\n1,1,1,2,3\n", ["both 'id' and 'label'", "say which"]),
        ("id,x,y,z,status\n1,1,2,3,lost\n", ["line 2", "'lost'", "without status"]),
    ],
)
def test_mistake_in_a_foreign_table_is_named(text: str, told: list[str], tmp_path: Path) -> None:
    path = table(tmp_path, text)
    with pytest.raises(InputError) as caught:
        import_markers(path)
    for part in ["table.csv", *told]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "options", "told"),
    [
        ({"marker": "id", "x_mm": "X", "y_mm": "y_cm"}, {}, "no column 'X'"),
        ({"marker": "id", "x_mm": "x_cn", "y_mm": "y_cm"}, {}, "did you mean 'x_cm'?"),
        ({"marker": "id", "x_mm": "x_cm"}, {}, "does not name 'y_mm'"),
        ({"marker": "id", "x": "x_cm", "y_mm": "y_cm"}, {}, "columns names 'x'"),
        (None, {"unit": "mm"}, "says cm, but unit = 'mm'"),
        (None, {"unit": "furlong"}, "'furlong' is not known"),
        (None, {"delimiter": "::"}, "one character"),
    ],
)
def test_mistake_in_the_call_is_named(columns: dict[str, str] | None, options: dict[str, str], told: str, tmp_path: Path) -> None:
    path = table(tmp_path, "id,x_cm,y_cm,z_cm\n1,1,1,1\n")
    with pytest.raises(InputError) as caught:
        import_markers(path, columns, **options)
    assert told in str(caught.value)


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        import_markers(tmp_path / "none.csv")
    (tmp_path / "old.xls").write_bytes(b"\xd0\xcf\x11\xe0\0\0")
    with pytest.raises(InputError, match=r"old.xls: is not a text table; save it as CSV"):
        import_markers(tmp_path / "old.xls")


def test_excel_without_openpyxl_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(MissingDependencyError, match=r'pip install "naibu\[excel\]"'):
        import_markers(tmp_path / "table.xlsx")


def test_excel_table_is_read(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Exported"], [], ["No.", "X [cm]", "Y [cm]", "Z [cm]"], [1, 1.25, 1, 0.3], [2, 2.25, 1.025, 0.35]):
        book.active.append(row)
    book.create_sheet("empty")
    book.save(tmp_path / "table.xlsx")
    np.testing.assert_allclose(import_markers(tmp_path / "table.xlsx").points, EXPECTED)
    with pytest.raises(InputError, match="there is no sheet 'two'; it has Sheet, empty"):
        import_markers(tmp_path / "table.xlsx", sheet="two")
    with pytest.raises(InputError, match="the table is empty"):
        import_markers(tmp_path / "table.xlsx", sheet="empty")
    (tmp_path / "broken.xlsx").write_text("no zip")
    with pytest.raises(InputError, match=r"cannot be read as \.xlsx"):
        import_markers(tmp_path / "broken.xlsx")


coordinate = st.floats(-1e4, 1e4) | st.just(float("nan"))


@settings(max_examples=50, deadline=None)
@given(points=st.lists(st.tuples(coordinate, coordinate, coordinate, st.booleans()), min_size=1, max_size=12))
def test_written_markers_come_back(points: list[tuple[float, float, float, bool]], tmp_path_factory: pytest.TempPathFactory) -> None:
    written = Markers.from_arrays(range(1, len(points) + 1), [p[:3] for p in points], [p[3] for p in points])
    read = import_markers(write_markers(tmp_path_factory.mktemp("t") / "m.csv", written))
    np.testing.assert_array_equal(read.ids, written.ids)
    np.testing.assert_allclose(read.points, written.points, rtol=1e-11, atol=1e-9)
    np.testing.assert_array_equal(read.trusted, written.trusted)


def test_bundled_table_imports_as_it_loads() -> None:
    for name in ("ct_two_material_2", "ct_half_ellipsoid"):
        read, loaded = import_markers(datasets.path(name) / "initial.csv"), datasets.load(name).initial
        np.testing.assert_array_equal(read.points, loaded.points)
        np.testing.assert_array_equal(read.trusted, loaded.trusted)


@pytest.mark.parametrize("name", datasets.names())
def test_folder_written_from_an_experiment_reads_back(name: str, tmp_path: Path) -> None:
    e = datasets.load(name)
    states = {s.name: s.markers for s in e.loaded_states if s.markers is not None}
    stated = {s.name: s.stated_mm for s in e.loaded_states if s.stated_mm is not None}
    given_as = {"title": e.title, "source": e.source, "shape": e.shape, "loading": e.loading, "layers": e.layers, "up_axis": e.up_axis}
    if len(stated) < len(states):
        stated = {}
    made = write_experiment_folder(tmp_path / "made", e.initial, states, **given_as, joined_at_mm=e.joined_at_mm, stated_mm=stated)
    back = read_experiment(made)
    for field in ("title", "source", "shape", "layers", "joined_at_mm", "up_axis", "dimensions", "loading"):
        assert getattr(back, field) == getattr(e, field)
    assert {s.name: s.stated_mm for s in back.loaded_states if s.stated_mm is not None} == stated
    np.testing.assert_array_equal(back.initial.points, e.initial.points)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["made"]


def small(count: int = 8) -> Markers:
    corners = [(x, y, z) for z in (10.0, 20.0) for y in (10.0, 20.0) for x in (10.0, 20.0)]
    return Markers.from_arrays(range(count), corners[:count])


def test_folder_that_would_not_be_valid_is_not_left_behind(tmp_path: Path) -> None:
    common = {"title": "t", "shape": Shape("box", (30.0, 30.0, 30.0)), "loading": Loading("plate")}
    with pytest.raises(InputError, match=r"bad/pressed\.csv: only 3 markers"):
        write_experiment_folder(tmp_path / "bad", small(), {"pressed": small(3)}, **common)
    with pytest.raises(InputError, match="ends at 20 mm"):
        write_experiment_folder(tmp_path / "bad", small(), {"pressed": small()}, layers=[Layer("gel", 0.0, 20.0)], **common)
    with pytest.raises(InputError, match="names the state 'presed'"):
        write_experiment_folder(tmp_path / "bad", small(), {"pressed": small()}, stated_mm={"presed": 20.0}, **common)
    assert list(tmp_path.iterdir()) == []


def test_folder_in_use_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "used.txt").write_text("mine")
    with pytest.raises(InputError, match="exists and is not empty"):
        write_experiment_folder(
            tmp_path, small(), {"pressed": small()}, title="t", shape=Shape("box", (30.0, 30.0, 30.0)), loading=Loading("plate")
        )
    assert [p.name for p in tmp_path.iterdir()] == ["used.txt"]


def test_atomic_writer_replaces_whole_files_and_leaves_nothing_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_atomically(tmp_path / "new" / "file.txt", "first ä\n")
    write_atomically(path, b"second\r\n")
    assert path.read_bytes() == b"second\r\n"

    def fail(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(InputError, match=r"file\.txt: cannot be written \(No space left on device\)"):
        write_atomically(path, "third")
    assert path.read_bytes() == b"second\r\n"
    assert [p.name for p in path.parent.iterdir()] == ["file.txt"]
