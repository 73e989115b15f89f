"""Records of force sensors: units, sensors in one file or several, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.tables.force_records import read_force_records


def written(folder: Path, text: str, name: str = "f.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_two_sensors_of_six_axes_in_one_table(tmp_path: Path) -> None:
    rows = ["time_ms,sensor,Fx (N),Fy (N),Fz (N),Mx_Nmm,My_Nmm,Mz_Nmm", "0,left,1,2,3,4,5,6", "0,right,0,0,1,0,0,0", "2.5,left,1,1,1,0,0,1"]
    left, right = read_force_records([written(tmp_path, "\n".join([*rows, "5,right,0,0,2,0,0,0"]))])
    assert (left.indenter, right.indenter) == ("left", "right")
    np.testing.assert_allclose(left.times_s, [0.0, 0.0025])
    np.testing.assert_allclose(left.force, [[1e3, 2e3, 3e3], [1e3, 1e3, 1e3]])
    assert left.moment is not None
    np.testing.assert_allclose(left.moment[0], [4e3, 5e3, 6e3])
    np.testing.assert_allclose(right.times_s, [0.0, 0.005])


def test_a_file_of_three_axes_is_given_its_indenter(tmp_path: Path) -> None:
    file = written(tmp_path, "t,fx,fy,fz\n0,1,2,3\n1,4,5,6\n")
    (named,), (plain,) = read_force_records([f"stamp={file}"]), read_force_records([file])
    assert (named.indenter, plain.indenter) == ("stamp", "")
    assert named.moment is None
    np.testing.assert_allclose(named.force, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])


def test_a_spreadsheet_with_decimal_commas(tmp_path: Path) -> None:
    file = written(tmp_path, "Time (ms);sensor;Fx [N];Fy [N];Fz [N]\n0;left, front;1,5;-2,25;3\n2,5;left, front;1e0;,5;0\n")
    (found,) = read_force_records([file])
    np.testing.assert_allclose(found.times_s, [0.0, 0.0025])
    np.testing.assert_allclose(found.force, [[1500.0, -2250.0, 3000.0], [1000.0, 500.0, 0.0]])
    assert found.indenter == "left, front"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("t,fx,fy,fz\n0,1,2,3\n", "at least two"),
        ("t,fx,fy,fz\n0,1,2,3\n0,1,2,3\n", "do not grow"),
        ("t,fx,fy,fz\n0,1,2,3\n1,1,2,1e12\n", "unit"),
        ("t,fx_lb,fy,fz\n0,1,2,3\n1,1,2,3\n", "'lb'"),
        ("t,fx,fz\n0,1,3\n1,1,3\n", "fy"),
        ("t,fx,fy,fz\n0,1,2,x\n1,1,2,3\n", "row 2 has 'x'"),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_force_records([written(tmp_path, text)])


def test_an_indenter_has_one_record(tmp_path: Path) -> None:
    file = written(tmp_path, "t,fx,fy,fz\n0,1,2,3\n1,4,5,6\n")
    with pytest.raises(InputError, match="'stamp' has two records"):
        read_force_records([f"stamp={file}", f"stamp={file}"])
