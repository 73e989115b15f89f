"""Clouds of points in the files of other programs."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pytest
from scipy.io import savemat

from naibu.core.errors import InputError
from naibu.io.tables.point_clouds import read_point_cloud

POINTS = np.random.default_rng(0).uniform(0.0, 9.0, (7, 3)).round(4)


def written(path: Path, points: np.ndarray = POINTS) -> Path:
    """Write a file of the kind that its name says."""
    ending = path.suffix
    if ending == ".npy":
        np.save(path, points)
    elif ending == ".npz":
        np.savez(path, points=points, weight=np.ones(7))
    elif ending == ".mat":
        savemat(path, {"found": points, "note": "text", "radius": np.ones((7, 1))})
    elif ending == ".xlsx":
        book = openpyxl.Workbook()
        for row in [("Pos X [mm]", "Pos Y [mm]", "Pos Z [mm]"), *points.tolist()]:
            book.active.append(row)
        book.save(path)
    else:
        mark = "\t" if ending == ".tsv" else ","
        path.write_text("\n".join(mark.join(f"{v:.4f}" for v in row) for row in points) + "\n")
    return path


@pytest.mark.parametrize("name", ["a.csv", "a.tsv", "a.txt", "a.xlsx", "a.npy", "a.npz", "a.mat"])
def test_every_kind_of_file_gives_the_same_points(tmp_path: Path, name: str) -> None:
    cloud = read_point_cloud(written(tmp_path / name))
    np.testing.assert_allclose(cloud.points, POINTS)
    assert cloud.rows.tolist() == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    "header",
    ["id,x_um,y_um,z_um,radius", "frame,X [um],Y [um],Z [um],v", "label,POSITION_X (um),POSITION_Y (um),POSITION_Z (um),QUALITY"],
)
def test_columns_and_units_are_recognised_by_their_names(tmp_path: Path, header: str) -> None:
    rows = "\n".join(f"{k},{x},{y},{z},1" for k, (x, y, z) in enumerate(POINTS.tolist()))
    (tmp_path / "a.csv").write_text(f"{header}\n{rows}\n5,,1,1,1\n")
    cloud = read_point_cloud(tmp_path / "a.csv")
    np.testing.assert_allclose(cloud.points, 1e-3 * POINTS)


def test_decimal_commas_voxels_units_and_deviations(tmp_path: Path) -> None:
    rows = "\n".join(";".join(f"{v:.4f}".replace(".", ",") for v in (*row, 0.1, 0.1, 0.4)) for row in POINTS)
    (tmp_path / "a.csv").write_text(f"x;y;z;sd_x;sd_y;sd_z\n{rows}\n")
    cloud = read_point_cloud(tmp_path / "a.csv", spacing_mm=(0.5, 0.5, 2.0))
    np.testing.assert_allclose(cloud.points, POINTS * (0.5, 0.5, 2.0))
    assert cloud.sd is not None
    np.testing.assert_allclose(cloud.sd[0], (0.05, 0.05, 0.8))
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.csv", unit="cm").points, 10.0 * POINTS)


def test_cells_structures_and_version_73_of_matlab(tmp_path: Path) -> None:
    cell = np.empty((2, 1), dtype=object)
    cell[0, 0], cell[1, 0] = POINTS, 2.0 * POINTS
    savemat(tmp_path / "cell.mat", {"x": cell})
    with pytest.raises(InputError, match=r"x\{1\}, x\{2\}\): name one as `variable`"):
        read_point_cloud(tmp_path / "cell.mat")
    np.testing.assert_allclose(read_point_cloud(tmp_path / "cell.mat", variable="x{2}").points, 2.0 * POINTS)
    savemat(tmp_path / "struct.mat", {"found": {"position": POINTS, "time": 3.0}})
    np.testing.assert_allclose(read_point_cloud(tmp_path / "struct.mat").points, POINTS)
    savemat(tmp_path / "axes.mat", {axis: POINTS[:, k] for k, axis in enumerate("xyz")})
    np.testing.assert_allclose(read_point_cloud(tmp_path / "axes.mat").points, POINTS)
    with h5py.File(tmp_path / "new.mat", "w") as root:
        root["p"] = POINTS.T  # MATLAB stores the first axis last
    np.testing.assert_allclose(read_point_cloud(tmp_path / "new.mat").points, POINTS)


def test_what_is_no_cloud_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "wide.npy", POINTS.T)
    np.save(tmp_path / "object.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "none.npz", a=np.ones(4))
    (tmp_path / "four.csv").write_text("1,2,3,4\n5,6,7,8\n")
    (tmp_path / "far.csv").write_text("x,y,z\n1,2,3e9\n1,2,3\n")
    for name, arguments, words in (
        ("wide.npy", {}, "transpose it"),
        ("object.npy", {}, r"object\.npy: cannot be read"),
        ("none.npz", {}, r"none of shape \(n, 2\)"),
        ("none.npz", {"variable": "b"}, "has no array 'b'; it has a"),
        ("four.csv", {}, "name them in the first line"),
        ("far.csv", {}, "no object is so large"),
        ("far.csv", {"unit": "px"}, "unit = 'px' is not known"),
        ("a.mha", {}, "no file of points"),
    ):
        with pytest.raises(InputError, match=words):
            read_point_cloud(tmp_path / name, **arguments)  # type: ignore[arg-type]


def test_copies_of_a_point_are_left_out_and_counted(tmp_path: Path) -> None:
    twice = np.concatenate([POINTS[:2], POINTS])
    cloud = read_point_cloud(written(tmp_path / "twice.csv", twice))
    assert cloud.copies == 2
    np.testing.assert_array_equal(cloud.points, POINTS[[0, 1, 2, 3, 4, 5, 6]])
    np.testing.assert_array_equal(cloud.rows, [1, 2, 5, 6, 7, 8, 9])
    assert read_point_cloud(written(tmp_path / "once.csv")).copies == 0


TRACKMATE = """LABEL,ID,TRACK_ID,QUALITY,POSITION_X,POSITION_Y,POSITION_Z,POSITION_T,FRAME,RADIUS
Label,Spot ID,Track ID,Quality,X,Y,Z,T,Frame,Radius
Label,Spot ID,Track ID,Quality,X,Y,Z,T,Frame,R
,,,(quality),(micron),(micron),(micron),(sec),,(micron)
ID7,7,,5.1,120.5,44.25,3.0,0,0,2.5
ID8,8,,4.9,80.0,12.75,9.5,0,0,2.5
"""
IMARIS = """Position
====================
Position X,Position Y,Position Z,Unit,Category,Collection,Time,TrackID,ID
120.5,44.25,3.0,um,Spot,Position,1,,7
80.0,12.75,9.5,um,Spot,Position,1,,8
"""
NAMED = "X (microns),Y (microns),Z (microns)\n120.5,44.25,3.0\n80.0,12.75,9.5\n"


@pytest.mark.parametrize("text", [TRACKMATE, IMARIS, NAMED], ids=["TrackMate", "Imaris", "microns"])
def test_units_are_read_where_microscopy_programs_state_them(tmp_path: Path, text: str) -> None:
    path = tmp_path / "spots.csv"
    path.write_text(text)
    found = read_point_cloud(path)
    np.testing.assert_allclose(found.points, np.array([[120.5, 44.25, 3.0], [80.0, 12.75, 9.5]]) / 1e3)
    with pytest.raises(InputError, match="says um, but unit = 'mm'"):
        read_point_cloud(path, unit="mm")


def test_a_word_in_a_row_of_numbers_and_mixed_units_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "spots.csv"
    path.write_text(TRACKMATE.replace("120.5,44.25", "far,44.25"))
    with pytest.raises(InputError, match=r"line 5, column .*'far' is not a number"):
        read_point_cloud(path)
    path.write_text(IMARIS.replace("9.5,um", "9.5,mm"))
    with pytest.raises(InputError, match="several units"):
        read_point_cloud(path)


def test_pixels_need_their_size_and_names_come_before_columns_of_units(tmp_path: Path) -> None:
    path = tmp_path / "spots.csv"
    path.write_text(TRACKMATE.replace("micron", "pixel"))
    with pytest.raises(InputError, match="in voxels; give the size"):
        read_point_cloud(path)
    np.testing.assert_allclose(read_point_cloud(path, spacing_mm=(0.1, 0.1, 0.4)).points, [[12.05, 4.425, 1.2], [8.0, 1.275, 3.8]])
    path.write_text("x_mm,y_mm,z_mm,Unit\n1,2,3,um\n2,3,4,um\n")
    np.testing.assert_allclose(read_point_cloud(path).points, [[1, 2, 3], [2, 3, 4]])
    path.write_text("x,y,z\ninf,inf,inf\n1,2,3\n")
    with pytest.raises(InputError, match="not finite"):
        read_point_cloud(path)
