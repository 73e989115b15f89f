"""Captured points from CSV and PLY: times, units, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.tables.captured_shapes import read_captured_shapes

PLY = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n4 5 6\n"


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_instants_of_one_table_in_other_units_and_a_ply_file_beside(tmp_path: Path) -> None:
    table = written(tmp_path, "a.csv", "# stereo\nTime (ms);X [cm];Y [cm];Z [cm];quality\n500;1;2;3;.9\n0;0.1;0.2;0.3;.8\n500;4;5;6;.7\n")
    cloud = written(tmp_path, "b.ply", PLY)
    found = read_captured_shapes([table, f"0.25={cloud}"])
    assert [shape.time_s for shape in found] == [0.0, 0.25, 0.5]
    np.testing.assert_allclose(found[0].points, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(found[1].points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_allclose(found[2].points, [[10.0, 20.0, 30.0], [40.0, 50.0, 60.0]])


@pytest.mark.parametrize(
    ("name", "text", "prefix", "told"),
    [
        ("a.csv", "x,y,z\n1,2,3\n", "", "time_s"),
        ("a.csv", "t,x,y,z\n0,1,2,3\n", "0.5=", "both|as well"),
        ("a.csv", "t,x,y\n0,1,2\n", "", "no column z"),
        ("a.csv", "t,x_inch,y,z\n0,1,2,3\n", "", "'inch'"),
        ("a.csv", "t,x,y,z\n0,1,nan,3\n", "", "row 2 has 'nan'"),
        ("a.csv", "t,x,y,z\n0,1,2\n", "", "row 2 has ''"),
        ("a.csv", "t,x,x_mm,y,z\n0,1,2,3,4\n", "", "are both x"),
        ("a.csv", "t,x,y,z\n-1,1,2,3\n", "", "-1 s"),
        ("a.csv", "t,x,y,z\n0,1e9,2,3\n", "", "point 1"),
        ("a.csv", "", "", "0 lines"),
        ("a.ply", PLY, "", "states no time"),
        ("a.ply", PLY, "soon=", "'soon'"),
        ("a.ply", PLY[:-6], "1=", "truncated"),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path: Path, name: str, text: str, prefix: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_captured_shapes([f"{prefix}{written(tmp_path, name, text)}"])
