"""Tables of a tilted scan: refused or told, turned when asked to, and identified as if the scan had been upright."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Loading, Shape
from naibu.core.markers import Markers
from naibu.core.rigid_transform import registration, rotation_matrix
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.tables.marker_tables import write_markers
from naibu.workflows.markers.import_tables import import_tables, preview_tables

GEL = datasets.load("ct_cube_plate")
TURN = rotation_matrix(np.array([0.35, -0.2, 0.1]))
CUBE = {"shape": Shape("box", (60.0, 60.0, 60.0)), "loading": Loading("plate")}


@pytest.fixture
def tilted(tmp_path: Path) -> list[Path]:
    """Tables of a bundled measurement, free and pressed, as a scanner with tilted axes would give them."""
    states = {"free": GEL.initial, "pressed": GEL.loaded_states[0].markers}
    return [
        write_markers(tmp_path / f"{name}.csv", Markers(m.ids, m.points @ TURN.T, m.trusted)) for name, m in states.items() if m is not None
    ]


@pytest.mark.parametrize(("vertical", "spacing", "within_mm"), [("found", 10.0, 0.2), ("found", None, 0.3), (TURN[:, 2], None, 1e-3)])
def test_turned_tables_are_those_of_the_upright_scan(
    tilted: list[Path], tmp_path: Path, vertical: object, spacing: float | None, within_mm: float
) -> None:
    notes = import_tables(tilted[0], tilted[1:], out=tmp_path / "gel", title="gel", vertical=vertical, spacing_mm=spacing, **CUBE)
    assert notes == ()
    read = read_experiment(tmp_path / "gel")
    for state, truth in ((read.initial, GEL.initial), (read.loaded_states[0].markers, GEL.loaded_states[0].markers)):
        assert state is not None and truth is not None
        heights, known = state.aligned(truth.ids)[:, 2], truth.aligned(truth.ids)[:, 2]
        assert np.nanstd(heights - known) < within_mm
    # both states are turned alike: the motion between them is the measured one
    back = registration(GEL.initial.aligned(GEL.initial.ids), read.initial.aligned(GEL.initial.ids))
    pressed = GEL.loaded_states[0].markers.aligned(GEL.initial.ids)
    assert np.nanmax(np.abs(back.applied(pressed) - read.loaded_states[0].markers.aligned(GEL.initial.ids))) < 1e-4


def test_a_tilt_is_told_or_refused(tilted: list[Path], tmp_path: Path) -> None:
    (note,) = import_tables(tilted[0], tilted[1:], out=tmp_path / "gel", title="gel", spacing_mm=10.0, **CUBE)
    assert "tilted" in note and "23.2 degrees" in note and "marker lattice" in note
    flat = {**CUBE, "shape": Shape("box", (60.0, 60.0, 45.0))}
    with pytest.raises(InputError, match="stands tilted in the scan") as refused:
        import_tables(tilted[0], tilted[1:], out=tmp_path / "flat", title="gel", spacing_mm=10.0, **flat)
    assert "`vertical`" in str(refused.value) and not (tmp_path / "flat").exists()
    upright = [datasets.path("ct_cube_plate") / f"{name}.csv" for name in ("initial", "height_45")]
    assert import_tables(upright[0], upright[1:], out=tmp_path / "upright", title="gel", spacing_mm=10.0, **CUBE) == ()


def test_the_preview_is_turned_and_says_so(tilted: list[Path]) -> None:
    table = preview_tables(tilted[0], tilted[1:], vertical="found", spacing_mm=10.0, **CUBE)
    assert [row[5] for row in table.rows] == pytest.approx([39.6, 30.1], abs=0.3)  # z of the lattice, and pressed by the plate
    assert "Turned, vertical along (-0.178" in table.note


def test_resolution_is_turned_too_and_side_plates_have_no_vertical(tilted: list[Path], tmp_path: Path) -> None:
    import_tables(tilted[0], tilted[1:], out=tmp_path / "gel", title="gel", vertical=(1.0, 0.0, 0.0), xy_step_mm=0.3, z_step_mm=0.5, **CUBE)
    read = read_experiment(tmp_path / "gel")  # x of the scan is the vertical; z of the scan one of two horizontal axes
    assert (read.xy_step_mm, read.z_step_mm) == pytest.approx((np.sqrt(0.5 * (0.3**2 + 0.5**2)), 0.3), abs=1e-5)
    side = {**CUBE, "loading": Loading("side_plates")}
    with pytest.raises(InputError, match="side plates"):
        import_tables(tilted[0], tilted[1:], out=tmp_path / "side", title="gel", vertical="found", **side)


def test_markers_with_a_missing_coordinate_are_named(tilted: list[Path], tmp_path: Path) -> None:
    lines = tilted[1].read_text().splitlines()
    cells = lines[1].split(",")
    lines[1] = ",".join([cells[0], "NaN", *cells[2:4], "missing", "x not legible"])
    tilted[1].write_text("\n".join(lines))
    notes = import_tables(tilted[0], tilted[1:], out=tmp_path / "gel", title="gel", vertical="found", spacing_mm=10.0, **CUBE)
    assert any("pressed: 1 markers have a missing coordinate" in note for note in notes)
