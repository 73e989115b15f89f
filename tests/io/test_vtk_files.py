"""Written results: read back with our own reader, with h5py, and with VTK and meshio where they are installed."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.meshes import read_mesh
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
CUBE = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float)
ENDS = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
MESHES = {
    "tetra": Mesh.from_arrays(POINTS, [[0, 1, 2, 3], [1, 2, 3, 4]], "tetra", regions=[0, 1], region_names=["gel", "棒 & <bar>"]),
    "hexahedron": Mesh.from_arrays(CUBE, [np.arange(8)], "hexahedron"),
    "tetra10": Mesh.from_arrays(np.vstack([POINTS[:4], POINTS[ENDS].mean(axis=1)]), [np.arange(10)], "tetra10"),
}


def data_of(mesh: Mesh) -> dict[str, np.ndarray]:
    return {
        "displacement_mm": 0.1 * mesh.points,
        "F": np.tile(np.eye(3), (mesh.n_points, 1, 1)),
        "fixed": mesh.points[:, 2] == 0,
        'quote " & <x>': np.arange(mesh.n_points, dtype=np.float32),
    }


@pytest.mark.parametrize("kind", MESHES)
def test_vtu_round_trip(tmp_path, kind):
    mesh = MESHES[kind]
    write_vtu(tmp_path / "a.vtu", mesh, data_of(mesh), {"E_kPa": np.ones(mesh.n_cells)})
    again = read_mesh(tmp_path / "a.vtu")
    np.testing.assert_array_equal(again.points, mesh.points)
    np.testing.assert_array_equal(again.cells, mesh.cells)
    np.testing.assert_array_equal(again.regions, mesh.regions)
    assert (again.cell_type, again.region_names) == (mesh.cell_type, mesh.region_names)


@pytest.mark.parametrize("kind", MESHES)
def test_vtu_opens_in_vtk(tmp_path, kind):
    pytest.importorskip("vtk")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    mesh = MESHES[kind]
    write_vtu(tmp_path / "a.vtu", mesh, data_of(mesh))
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "a.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    np.testing.assert_array_equal(vtk_to_numpy(grid.GetPoints().GetData()), mesh.points)
    np.testing.assert_array_equal(vtk_to_numpy(grid.GetPointData().GetArray("displacement_mm")), 0.1 * mesh.points)
    np.testing.assert_array_equal(vtk_to_numpy(grid.GetCellData().GetArray("region")), mesh.regions)


@pytest.mark.parametrize("kind", MESHES)
def test_vtu_opens_in_meshio(tmp_path, kind):
    meshio = pytest.importorskip("meshio")
    mesh = MESHES[kind]
    write_vtu(tmp_path / "a.vtu", mesh, data_of(mesh))
    again = meshio.read(tmp_path / "a.vtu")
    np.testing.assert_array_equal(again.cells[0].data, mesh.cells)
    np.testing.assert_array_equal(again.cell_data["region"][0], mesh.regions)


def series_of(mesh: Mesh) -> tuple[list[float], dict, dict]:
    times = [0.0, 0.5, 2.0]
    displacement = np.stack([t * mesh.points for t in times])
    return times, {"u_mm": displacement, "t": [np.full(mesh.n_points, t) for t in times]}, {"J": np.ones((3, mesh.n_cells))}


@pytest.mark.parametrize("kind", MESHES)
def test_series_follows_the_vtkhdf_layout(tmp_path, kind):
    mesh = MESHES[kind]
    times, points, cells = series_of(mesh)
    write_vtkhdf_series(tmp_path / "a.vtkhdf", mesh, times, points, cells)
    with h5py.File(tmp_path / "a.vtkhdf") as file:
        root = file["VTKHDF"]
        assert root.attrs["Type"] == b"UnstructuredGrid"
        assert root.attrs["Version"].tolist() == [2, 0]
        assert list(root.attrs["region_names"]) == list(mesh.region_names)
        assert root["Steps"].attrs["NSteps"] == 3
        np.testing.assert_array_equal(root["Steps/Values"], times)
        np.testing.assert_array_equal(root["Connectivity"][:].reshape(mesh.cells.shape), mesh.cells)
        start = root["Steps/PointDataOffsets/u_mm"][2]
        np.testing.assert_array_equal(root["PointData/u_mm"][start : start + mesh.n_points], 2 * mesh.points)
        assert root["NumberOfPoints"].shape == (1,)


@pytest.mark.parametrize("kind", MESHES)
def test_series_opens_in_vtk(tmp_path, kind):
    pytest.importorskip("vtk")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    mesh = MESHES[kind]
    times, points, cells = series_of(mesh)
    write_vtkhdf_series(tmp_path / "a.vtkhdf", mesh, times, points, cells)
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "a.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 3
    for step, time in enumerate(times):
        reader.SetStep(step)
        reader.Update()
        grid = reader.GetOutputDataObject(0)
        assert reader.GetTimeValue() == time
        np.testing.assert_array_equal(vtk_to_numpy(grid.GetPointData().GetArray("u_mm")), time * mesh.points)
        np.testing.assert_array_equal(vtk_to_numpy(grid.GetCellData().GetArray("region")), mesh.regions)


@pytest.mark.parametrize(
    ("points", "cells", "told"),
    [
        ({"u": np.zeros((4, 3))}, {}, r"'u' has shape \(4, 3\), but the mesh has 5 points"),
        ({}, {"E": np.zeros(3)}, "2 cells"),
        ({"u": np.array(["a"] * 5)}, {}, "real numbers"),
        ({"u": np.zeros(5, dtype=complex)}, {}, "real numbers"),
    ],
)
def test_values_that_do_not_fit_are_named_and_nothing_is_written(tmp_path, points, cells, told):
    with pytest.raises(InputError, match=told):
        write_vtu(tmp_path / "a.vtu", MESHES["tetra"], points, cells)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("times", "points", "told"),
    [
        ([0, 0], {}, "times"),
        ([], {}, "times"),
        ([0, 1], {"u": np.zeros((3, 5))}, "3 steps"),
        ([0, 1], {"u": [np.zeros(5), np.zeros(4)]}, "5 points"),
        ([0, 1], {"u": [np.zeros(5), np.zeros((5, 3))]}, "step 1"),
        ([0], {"a/b": np.zeros((1, 5))}, "a/b"),
    ],
)
def test_a_failed_series_leaves_the_old_file(tmp_path, times, points, told):
    path: Path = tmp_path / "a.vtkhdf"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match=told):
        write_vtkhdf_series(path, MESHES["tetra"], times, points)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_plane_meshes_are_written_in_space(tmp_path):
    mesh = Mesh.from_arrays([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 1, 2]], "triangle")
    motion = np.arange(12.0).reshape(2, 3, 2)
    write_vtkhdf_series(tmp_path / "a.vtkhdf", mesh, [0.0, 1.0], {"u_mm": motion})
    with h5py.File(tmp_path / "a.vtkhdf") as file:
        root = file["VTKHDF"]
        np.testing.assert_array_equal(root["Points"][:], np.pad(mesh.points, ((0, 0), (0, 1))))
        np.testing.assert_array_equal(root["PointData/u_mm"][:], np.pad(motion.reshape(6, 2), ((0, 0), (0, 1))))
        assert root["Types"][:].tolist() == [5]
    write_vtu(tmp_path / "a.vtu", mesh, {"u_mm": motion[0]})
    assert b'Name="u_mm" NumberOfComponents="3"' in (tmp_path / "a.vtu").read_bytes()
