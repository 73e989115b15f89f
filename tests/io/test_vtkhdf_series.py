"""Series that grow: whole at any time, cut and continued."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.vtk_files import write_vtkhdf_series
from naibu.io.vtkhdf_series import SeriesFile

MESH = Mesh.from_arrays(np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]), [[0, 1, 3, 2, 4, 5, 7, 6]], "hexahedron")
RNG = np.random.default_rng(0)
VALUES = RNG.standard_normal((6, 8, 3)).astype(np.float32)


def filled(path: Path, steps: range, series: SeriesFile | None = None) -> SeriesFile:
    found = series or SeriesFile.begun(path, MESH)
    for k in steps:
        found.append(0.5 * k, {"u": VALUES[k], "level": VALUES[k, :, 0]}, {"mean": VALUES[k].mean(axis=0)[None]})
        found.append_rows("force", VALUES[k, :2], 2 * k)
    return found


def contents(path: Path) -> dict[str, object]:
    found: dict[str, object] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[:].tolist()}) if isinstance(item, h5py.Dataset) else None)
        found["steps"] = int(file["VTKHDF/Steps"].attrs["NSteps"])
    return found


def test_a_series_that_grew_holds_what_one_that_is_written_at_once_does(tmp_path: Path) -> None:
    with filled(tmp_path / "grown.vtkhdf", range(6)) as series:
        series.finish()
    cells = VALUES.mean(axis=1)[:, None, :]
    write_vtkhdf_series(tmp_path / "whole.vtkhdf", MESH, 0.5 * np.arange(6), {"u": VALUES, "level": VALUES[..., 0]}, {"mean": cells})
    grown, whole = contents(tmp_path / "grown.vtkhdf"), contents(tmp_path / "whole.vtkhdf")
    np.testing.assert_array_equal(grown.pop("naibu/force"), VALUES[:, :2].reshape(-1, 3))
    assert grown == whole
    # every step's values begin where VTK is told to look for them
    with h5py.File(tmp_path / "grown.vtkhdf") as file:
        root = file["VTKHDF"]
        for k, at in enumerate(root["Steps/PointDataOffsets/u"][:]):
            np.testing.assert_array_equal(root["PointData/u"][at : at + 8], VALUES[k])


def test_a_series_cut_and_continued_is_the_same(tmp_path: Path) -> None:
    with filled(tmp_path / "a.vtkhdf", range(6)) as series:
        series.finish()
    with filled(tmp_path / "b.vtkhdf", range(4)) as series:
        series.truncate(3)
        series.finish()
    with SeriesFile.continued(tmp_path / "b.vtkhdf", MESH, 2) as series:
        assert series.steps == 2
        filled(tmp_path / "b.vtkhdf", range(2, 6), series).finish()
    assert contents(tmp_path / "a.vtkhdf") == contents(tmp_path / "b.vtkhdf")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.vtkhdf", "b.vtkhdf"]


def test_what_is_not_finished_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.vtkhdf"
    with filled(path, range(2)) as series:
        series.finish()
    before = path.read_bytes()
    with pytest.raises(RuntimeError, match="stop"), filled(path, range(4)):
        raise RuntimeError("stop")
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_continued_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.vtkhdf"
    with pytest.raises(InputError, match="cannot be read"):
        SeriesFile.continued(path, MESH, 1)
    with filled(path, range(2)) as series:
        series.finish()
    with pytest.raises(InputError, match="contains 2 steps"):
        SeriesFile.continued(path, MESH, 3)
    other = Mesh.from_arrays(MESH.points, MESH.cells[:, ::-1], "hexahedron")
    with pytest.raises(InputError, match="another mesh"):
        SeriesFile.continued(path, other, 2)
    path.write_bytes(b"no HDF5")
    with pytest.raises(InputError, match="damaged"):
        SeriesFile.continued(path, MESH, 1)
    assert list(tmp_path.iterdir()) == [path]


def test_arrays_that_change_their_shape_are_refused(tmp_path: Path) -> None:
    with filled(tmp_path / "a.vtkhdf", range(1)) as series:
        with pytest.raises(InputError, match="shape"):
            series.append(1.0, {"u": VALUES[0, :, :2]})
        with pytest.raises(InputError, match="not in the earlier steps"):
            series.append(1.0, {"w": VALUES[0]})
        with pytest.raises(InputError, match="8 points"):
            series.append(1.0, {"u": VALUES[0, :3]})
