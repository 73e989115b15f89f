"""Cutting from files: what is written, that the cut opens, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from notebooks import check_shown

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.io.meshes import read_mesh
from naibu.io.vtk_files import write_vtu
from naibu.meshing import VolumeCut, box, signed_volumes
from naibu.workflows import MeshMaterial, cut
from naibu.workflows.interactive.cut import joined_text

SIZE = 20.0


def mesh_file(folder: Path) -> Path:
    path = folder / "gel.vtu"
    write_vtu(path, box((SIZE, SIZE, SIZE), (4, 4, 4), cell_type="tetra"))
    return path


def path_file(folder: Path, lowest: float, text: str = "") -> Path:
    path = folder / "blade.csv"
    rows = [f"1,{y},{lowest},1,{y},{SIZE + 5}" for y in (-15, 0, 15)]
    path.write_text(text or "x1,y1,z1,x2,y2,z2\n" + "\n".join(rows) + "\n")
    return path


def test_a_notch_opens_when_the_body_is_pulled_apart(tmp_path: Path) -> None:
    done = cut(mesh_file(tmp_path), path_file(tmp_path, 10.0), out=tmp_path / "out", pull_percent=10.0)
    assert [file.name for file in done.files] == ["cut.html", "cut.vtu", "cut-surface.vtu", "cut.vtkhdf", "cut.json"]
    numbers = json.loads((tmp_path / "out" / "cut.json").read_text())
    assert numbers["pieces"] == 1
    assert numbers["pulled_along"] == "x"
    assert numbers["relative_change_of_volume"] < 1e-12
    assert 0.3 * 2.0 < done.opening_mm < 2.0 * 2.0  # the notch takes up much of the 2 mm that the ends part
    written = read_mesh(tmp_path / "out" / "cut.vtu")
    assert signed_volumes(written).sum() == pytest.approx(SIZE**3, rel=1e-6)
    assert "opens by" in (tmp_path / "out" / "cut.html").read_text()


def test_a_whole_cut_parts_the_pieces_by_the_pull(tmp_path: Path) -> None:
    done = cut(mesh_file(tmp_path), path_file(tmp_path, -5.0), out=tmp_path / "out", pull_percent=10.0)
    np.testing.assert_allclose(done.volumes_mm3.sum(), SIZE**3, rtol=1e-12)
    assert len(done.volumes_mm3) == 2
    assert done.opening_mm == pytest.approx(2.0, rel=0.05)
    assert sum(float(str(row["volume_mm3"])) for row in check_shown(done, done.files[0])) == pytest.approx(SIZE**3)


def test_a_gel_whose_forces_may_be_too_low_behind_the_cut_says_so(tmp_path: Path) -> None:
    rows = [f"1,{y},-5,6,{y},25" for y in (-15, 0, 15)]  # oblique: facets follow it in steps
    body, path = mesh_file(tmp_path), path_file(tmp_path, -5.0, "\n".join(["x1,y1,z1,x2,y2,z2", *rows, ""]))
    cut(body, path, out=tmp_path / "gel", pull_percent=0.0, material=MeshMaterial(poisson_ratio=0.495))
    said = json.loads((tmp_path / "gel" / "cut.json").read_text())["caution"]
    assert said.startswith("Behind the cut a force on the body may be up to") and said in (tmp_path / "gel" / "cut.html").read_text()
    cut(body, path, out=tmp_path / "soft", pull_percent=0.0, material=MeshMaterial(poisson_ratio=0.3))
    assert "caution" not in json.loads((tmp_path / "soft" / "cut.json").read_text())


def test_friction_does_not_hold_what_opens_and_is_refused_where_there_is_none(tmp_path: Path) -> None:
    body, path = mesh_file(tmp_path), path_file(tmp_path, 10.0)
    free = cut(body, path, out=tmp_path / "free", pull_percent=10.0)
    rubbed = cut(body, path, out=tmp_path / "rubbed", pull_percent=10.0, lips_friction=0.5)
    assert rubbed.opening_mm == pytest.approx(free.opening_mm, rel=0.02)  # live bodies end their steps sooner than Newton's method
    assert json.loads((tmp_path / "rubbed" / "cut.json").read_text())["lips_friction"] == 0.5
    page = (tmp_path / "rubbed" / "cut.html").read_text()
    assert "rub on each other with a friction coefficient of 0.5" in page
    assert "rub on each other" not in (tmp_path / "free" / "cut.html").read_text()
    assert "e-1" not in page[page.index("Largest distance from the blade") :][:200]  # rounding errors are no distance
    for wrong in (-0.1, np.nan, np.inf):
        with pytest.raises(InputError, match="lips_friction must be a finite number"):
            cut(body, path, out=tmp_path / "wrong", lips_friction=wrong)
    with pytest.raises(InputError, match="the sides of the cut of a lattice do not touch"):
        cut("dough-pressed-by-sphere", path, out=tmp_path / "wrong", lips_friction=0.3)
    assert not list((tmp_path / "wrong").glob("*"))


def test_a_second_run_goes_on_from_the_mesh_of_the_first_and_says_so(tmp_path: Path) -> None:
    for k, (first, last) in enumerate([(-15, 1), (1, 15)]):
        blade = path_file(tmp_path, 0.0, "\n".join(f"1,{y},-5,1,{y},{SIZE + 5}" for y in (first, last)) + "\n")
        done = cut(mesh_file(tmp_path) if k == 0 else tmp_path / "0" / "cut.vtu", blade, out=tmp_path / str(k), pull_percent=0.0)
        numbers = json.loads((tmp_path / str(k) / "cut.json").read_text())
        assert (len(done.volumes_mm3), numbers["length_of_earlier_cuts_that_it_goes_on_from_mm"] > SIZE - 5.0) == ((1, False), (2, True))[k]
        assert numbers["places_where_the_sides_hang_together_mm"] == []
        assert ("It goes on from earlier cuts" in (tmp_path / str(k) / "cut.html").read_text()) == bool(k)


def test_where_an_earlier_cut_is_not_met_is_told(tmp_path: Path) -> None:
    found = cut(mesh_file(tmp_path), path_file(tmp_path, 10.0), out=tmp_path / "out").cut
    assert joined_text(found) == ""
    assert isinstance(found, VolumeCut)
    missed = replace(found, bridges=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert "At 2 places (near 1, 2, 3; 4, 5, 6 mm) an earlier cut ends without meeting this one" in joined_text(missed)


LATTICE = """
[object]
labels = "body.nrrd"
mass_g = 10.0
[lattice]
spacing_mm = 2.0
[parameters]
K = 60.0
C1 = 6.0
C2 = 1e6
[simulation]
duration_s = 1.0
[floor]
contact = "sticking"
"""


def study_file(folder: Path) -> Path:
    """A block of 16 x 8 x 8 mm whose long edge lies along y of the scan, where it begins at 100 mm."""
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    labels = Volume.from_array(np.ones((4, 4, 8), np.uint8), spacing_mm=(2.0, 2.0, 2.0), origin_mm=(3.0, 101.0, 1.0), direction=turned)
    write_volume(folder / "body.nrrd", labels)
    (folder / "block.toml").write_text(LATTICE)
    return folder / "block.toml"


def test_a_lattice_is_cut_in_the_frame_of_its_scan(tmp_path: Path) -> None:
    rows = [f"{x},108,-5,{x},108,20" for x in (-20, 20)]
    done = cut(study_file(tmp_path), path_file(tmp_path, 0.0, "\n".join(rows) + "\n"), out=tmp_path / "out", pull_percent=10.0)
    numbers = json.loads((tmp_path / "out" / "cut.json").read_text())
    np.testing.assert_allclose(done.volumes_mm3, 512.0)
    assert numbers["pulled_along"] == "y"
    assert numbers["area_of_the_cut_mm2"] == pytest.approx(64.0)
    assert done.opening_mm == pytest.approx(1.6, rel=0.02)
    meshio = pytest.importorskip("meshio")
    surface = meshio.read(tmp_path / "out" / "cut-surface.vtu")
    a, b, c = surface.points[surface.cells_dict["triangle"]].transpose(1, 0, 2)
    np.testing.assert_array_equal(np.bincount(surface.cell_data_dict["piece"]["triangle"].astype(int)), [32, 32])
    normals = 0.5 * np.cross(b - a, c - a)
    np.testing.assert_allclose(surface.points[:, 1], 108.0, atol=1e-4)  # both sides, which look at each other
    np.testing.assert_allclose([normals.sum(axis=0), np.abs(normals).sum(axis=0)], [[0.0] * 3, [0.0, 128.0, 0.0]], atol=1e-3)
    written = read_mesh(tmp_path / "out" / "cut.vtu")
    np.testing.assert_allclose(written.points.min(axis=0), [-4.0, 100.0, 0.0], atol=1e-4)
    assert signed_volumes(written).sum() == pytest.approx(1024.0, rel=1e-6)


def test_a_lattice_is_not_cut_nearer_to_the_blade_than_its_cubes_let_it(tmp_path: Path) -> None:
    rows = [f"{x},108.9,-5,{x},108.9,20" for x in (-20, 20)]
    with pytest.raises(InputError, match=r"distance_mm is 1 mm.*choose 1\.8 mm"):
        cut(study_file(tmp_path), path_file(tmp_path, 0.0, "\n".join(rows) + "\n"), out=tmp_path / "out", distance_mm=1.0)


def test_a_blade_within_the_outer_cubes_of_a_lattice_is_refused_with_the_reason(tmp_path: Path) -> None:
    rows = [f"{x},100.6,-5,{x},100.6,20" for x in (-20, 20)]  # no face lies beyond the centres of these cubes
    with pytest.raises(InputError, match=r"y from 100 to 116 mm.*or only grazes it, whose cuts follow the faces of its cubes"):
        cut(study_file(tmp_path), path_file(tmp_path, 0.0, "\n".join(rows) + "\n"), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1,2,3\n4,5,6\n", "at least two vertices"),
        ("1,2,3,4,5,6\n", "at least two poses"),
        ("1,2,3,4,5,6\n1,2,3,4,5\n", "row 2 has 5 numbers"),
        ("1,2,3,4,5,6\n1,2,3,4,5,x\n", "row 2 has 'x'"),
        ("1,2,3,4,5,nan\n1,2,3,4,5,6\n", "row 1 has 'nan'"),
        ("100,0,0,100,0,9\n100,9,0,100,9,9\n", "passes beside the body"),
        ("1,0,0,1,0,9\n1,0,0,1,0,9\n", "sweeps no area"),
    ],
)
def test_paths_that_cannot_be_used_are_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        cut(mesh_file(tmp_path), path_file(tmp_path, 0.0, text), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()  # no empty folder is left


def test_what_cannot_be_cut_is_refused(tmp_path: Path) -> None:
    path = path_file(tmp_path, 0.0)
    with pytest.raises(InputError, match="pull_percent"):
        cut(mesh_file(tmp_path), path, out=tmp_path / "out", pull_percent=80.0)
    with pytest.raises(InputError, match=r"blade\.csv: is not UTF-8"):
        path.write_bytes(b"1,2,3,4,5,\xff")
        cut(mesh_file(tmp_path), path, out=tmp_path / "out")
