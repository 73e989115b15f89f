"""Tables that a hurried user gives in the wrong order, in another unit or twice are told of before a folder is made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.experiment import Loading, Shape
from naibu.workflows.markers.experiments import load_experiment, load_experiments
from naibu.workflows.markers.import_tables import import_tables

CUBE = {"shape": Shape("box", (60.0, 60.0, 60.0)), "loading": Loading("plate"), "title": "gel"}


@pytest.fixture
def tables(tmp_path: Path) -> tuple[Path, Path]:
    """A cube with a lattice of markers, free and compressed to three quarters without change of volume."""
    grid = np.stack(np.meshgrid(*[np.arange(10.0, 51.0, 10.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    paths = (tmp_path / "Würfel frei.csv", tmp_path / "gedrückt.csv")
    for path, points in zip(paths, (grid, grid * [np.sqrt(4 / 3), np.sqrt(4 / 3), 0.75]), strict=True):
        lines = [";".join([str(i), *(f"{v:.3f}".replace(".", ",") for v in p)]) for i, p in enumerate(points, start=1)]
        path.write_text("\n".join(["Marker;x [mm];y [mm];z [mm]", *lines]), encoding="utf-8")
    return paths


def test_the_tables_of_a_german_spreadsheet_become_an_experiment(tables: tuple[Path, Path], tmp_path: Path) -> None:
    free, pressed = tables
    assert import_tables(free, [pressed], out=tmp_path / "gel", stated_mm={"gedrückt": 45.0}, **CUBE) == ()
    experiment = load_experiment(tmp_path / "gel")
    np.testing.assert_allclose(np.ptp(experiment.initial.points, axis=0), 40.0)


def test_exchanged_tables_are_told(tables: tuple[Path, Path], tmp_path: Path) -> None:
    free, pressed = tables
    (note,) = import_tables(pressed, [free], out=tmp_path / "gel", **CUBE)
    assert "naibu identify will refuse this: gel/Würfel_frei: " in note
    assert "reference configuration and the loaded state exchanged?" in note


def test_one_table_twice_is_told(tables: tuple[Path, Path], tmp_path: Path) -> None:
    free, _ = tables
    (note,) = import_tables(free, [free], out=tmp_path / "gel", **CUBE)
    assert "no deformation beyond the noise" in note
    (note,) = import_tables(free, [free], out=tmp_path / "other", stated_mm={free.stem: 45.0}, **CUBE)  # named as the file, with a space
    assert "did not move against each other" in note


def test_what_is_wrong_with_a_table_names_its_file(tables: tuple[Path, Path], tmp_path: Path) -> None:
    free, pressed = tables
    small = CUBE | {"shape": Shape("box", (30.0, 30.0, 30.0))}
    with pytest.raises(InputError, match=r"Würfel frei.csv: x_mm spans 40") as refused:
        import_tables(free, [pressed], out=tmp_path / "gel", **small)
    assert "meta.toml" not in str(refused.value)


def test_one_measurement_under_two_names_is_refused(tables: tuple[Path, Path], tmp_path: Path) -> None:
    for name in ("gel", "copy"):
        import_tables(tables[0], [tables[1]], out=tmp_path / name, **CUBE)
    with pytest.raises(InputError, match="gel/gedrückt and copy/gedrückt hold the same positions, which would count twice"):
        load_experiments([tmp_path / "gel", tmp_path / "copy"])


def test_a_file_of_an_experiment_leads_to_its_folder(tables: tuple[Path, Path], tmp_path: Path) -> None:
    import_tables(tables[0], [tables[1]], out=tmp_path / "gel", **CUBE)
    with pytest.raises(InputError, match=r"is a file, but an experiment is a folder with a meta.toml in it; give the folder, .*gel$"):
        load_experiment(tmp_path / "gel" / "meta.toml")
