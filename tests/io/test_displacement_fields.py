"""Displacement fields come back from files as they were, and files that hold none are told."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.displacement_fields import read_field, write_field
from naibu.io.images import write_displacement

COLUMNS = "x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,sd_x_mm,sd_y_mm,sd_z_mm"


def at_points() -> DisplacementField:
    rng = np.random.default_rng(0)
    points, vectors = rng.random((50, 3)), rng.random((50, 3))
    half = rng.random((50, 3, 3))
    valid = rng.random(50) > 0.2
    return DisplacementField.from_arrays(points, vectors, covariance=half @ np.swapaxes(half, 1, 2), valid=valid)


def on_grid() -> DisplacementField:
    rng = np.random.default_rng(1)
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    grid = Volume.from_array(np.zeros((4, 5, 6)), spacing_mm=(0.5, 0.6, 2.0), origin_mm=(1.0, 2.0, 3.0), direction=turned)
    return DisplacementField.on_grid(grid, rng.random((4, 5, 6, 3)), valid=rng.random((4, 5, 6)) > 0.5, quality=rng.random((4, 5, 6)))


@pytest.mark.parametrize("make", [at_points, on_grid])
def test_a_field_comes_back_as_it_was(make, tmp_path: Path) -> None:
    field = make()
    write_field(tmp_path / "a.h5", field, provenance={"inputs": {"reference": "a.mha"}})
    back = read_field(tmp_path / "a.h5")
    for name in ("points", "vectors", "covariance", "valid", "quality"):
        stored, given = getattr(back, name), getattr(field, name)
        assert (stored is None) == (given is None)
        if given is not None:
            np.testing.assert_array_equal(stored, given)
    if isinstance(field.support, Volume):
        assert back.grid.same_grid(field.grid)
    write_field(tmp_path / "b.h5", field, provenance={"inputs": {"reference": "a.mha"}})
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_images_and_tables_of_other_programs(tmp_path: Path) -> None:
    field = on_grid()
    write_displacement(tmp_path / "u.mha", field.vectors, field.grid)
    image = read_field(tmp_path / "u.mha")
    assert image.covariance is None and image.points == pytest.approx(field.points)
    (tmp_path / "t.csv").write_text(f"{COLUMNS}\n1,2,3,.1,.2,.3,.01,.01,.02\n4,5,6,0,0,0,.01,.01,.02\n")
    table = read_field(tmp_path / "t.csv")
    assert table.points.tolist() == [[1, 2, 3], [4, 5, 6]] and table.standard_deviation is not None
    assert table.vectors[0] == pytest.approx([0.1, 0.2, 0.3]) and table.standard_deviation[0] == pytest.approx([0.01, 0.01, 0.02])


def test_files_without_a_field_are_told(tmp_path: Path) -> None:
    write_field(tmp_path / "good.h5", at_points())
    (tmp_path / "cut.h5").write_bytes((tmp_path / "good.h5").read_bytes()[:1500])
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["values"] = np.zeros(3)
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file.attrs["format"] = "naibu displacement field 1"
        file["vectors"] = h5py.ExternalLink("good.h5", "vectors")
    (tmp_path / "t.csv").write_text("x,y\n1,2\n")
    messages = {
        "cut.h5": "cut.h5",
        "other.h5": "no displacement field",
        "linked.h5": "another file",
        "t.csv": "ux_mm",
        "none.h5": "none.h5",
    }
    for name, message in messages.items():
        with pytest.raises(InputError, match=message):
            read_field(tmp_path / name)
    with pytest.raises(InputError, match=r"written as \.h5"):
        write_field(tmp_path / "a.npz", at_points())


def test_a_folder_with_a_field_leads_to_the_field(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.0, 10.0, (5, 3))
    write_field(tmp_path / "field.h5", DisplacementField.from_arrays(points, 0.1 * points))
    with pytest.raises(InputError, match=r"is a folder; give the displacement field in it, .*field\.h5$"):
        read_field(tmp_path)
