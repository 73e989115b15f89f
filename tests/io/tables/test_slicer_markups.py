"""Points of 3D Slicer: the same whichever frame a file states."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.tables.marker_tables import import_markers
from naibu.io.tables.point_tables import read_point_table

LPS = np.array([[10.5, 20.25, -3.0], [11.5, -21.25, -4.0], [12.0, 0.0, 5.0]])
FLIP = {"LPS": 1.0, "1": 1.0, "RAS": -1.0, "0": -1.0}


def fcsv(folder: Path, system: str, name: str = "F.fcsv") -> Path:
    points = LPS * [FLIP.get(system, 1.0), FLIP.get(system, 1.0), 1.0]
    stated = f"# CoordinateSystem = {system}\n" if system else ""
    rows = "".join(f"{k},{x},{y},{z},0,0,0,1,1,1,0,F-{k + 1},,\n" for k, (x, y, z) in enumerate(points))
    text = (
        f"# Markups fiducial file version = 4.11\n{stated}# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n{rows}"
    )
    (file := folder / name).write_text(text, encoding="utf-8")
    return file


def marked(folder: Path, system: str, **more: object) -> Path:
    points = LPS * [FLIP.get(system, 1.0), FLIP.get(system, 1.0), 1.0]
    listed = [{"id": str(k), "label": f"F-{k + 1}", "position": list(p), "positionStatus": "defined"} for k, p in enumerate(points)]
    listed.append({"id": "9", "label": "F-9", "position": [0, 0, 0], "positionStatus": "undefined"})
    only = {"type": "Fiducial", "coordinateSystem": system, "controlPoints": listed, **more}
    (file := folder / "F.mrk.json").write_text(json.dumps({"markups": [only]}), encoding="utf-8")
    return file


@pytest.mark.parametrize("system", FLIP)
@pytest.mark.parametrize("name", ["F.fcsv", "F.csv"])
def test_tables_of_slicer_are_in_lps(tmp_path: Path, system: str, name: str) -> None:
    file = fcsv(tmp_path, system, name)
    markers = import_markers(file)
    np.testing.assert_array_equal(markers.points, LPS)
    np.testing.assert_array_equal(markers.ids, [1, 2, 3])
    np.testing.assert_array_equal(read_point_table(file).points, LPS)


@pytest.mark.parametrize("system", ["LPS", "RAS"])
def test_lists_of_slicer_are_in_lps_without_points_that_were_not_placed(tmp_path: Path, system: str) -> None:
    np.testing.assert_array_equal(import_markers(marked(tmp_path, system)).points, LPS)


def test_files_that_do_not_tell_their_frame_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'not stated', and x and y have other signs"):
        import_markers(fcsv(tmp_path, ""))
    with pytest.raises(InputError, match="'IJK'"):
        import_markers(marked(tmp_path, "IJK"))
    with pytest.raises(InputError, match="in m; save them in mm"):
        import_markers(marked(tmp_path, "LPS", coordinateUnits="m"))
    (broken := tmp_path / "b.mrk.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="no list of points"):
        import_markers(broken)
