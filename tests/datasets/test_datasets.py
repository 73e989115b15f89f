"""The bundled measurements against what their own README and meta.toml say of them."""

from __future__ import annotations

import csv
import itertools
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import InputError

# the table of the data's README
MARKERS = {
    "us_agar": 5,
    "mr_agar": 9,
    "ct_two_material_1": 100,
    "ct_two_material_2": 100,
    "ct_two_material_3": 100,
    "ct_two_material_4": 100,
    "ct_cube_plate": 125,
    "ct_half_ellipsoid": 286,
    "ct_test_piece": 6,
    "ct_cube_bar": 125,
}
HELD_OUT = {("ct_two_material_4", "deformed"), ("ct_half_ellipsoid", "width_80"), ("ct_cube_bar", "height_35")}


def meta(name: str) -> dict:
    return tomllib.loads((datasets.path(name) / "meta.toml").read_text(encoding="utf-8"))


def test_names_are_those_of_the_readme() -> None:
    assert datasets.names() == tuple(sorted(MARKERS))


@pytest.mark.parametrize("name", sorted(MARKERS))
def test_counts_are_those_of_meta(name: str) -> None:
    e = datasets.load(name)
    for state, table in zip(e.states, meta(name)["state"], strict=True):
        assert (state.markers is None) == ((name, state.name) in HELD_OUT)
        if state.markers is None:
            continue
        count = table["count"]
        assert len(state.markers) == MARKERS[name] == sum(count.values())
        incomplete = np.isnan(state.markers.points[:, : e.dimensions]).any(axis=1)
        assert incomplete.sum() == count["missing"]
        assert (~state.markers.trusted & ~incomplete).sum() == count["suspect"]


@pytest.mark.parametrize("name", sorted(MARKERS))
def test_status_column_agrees_with_meta(name: str) -> None:
    for table in meta(name)["state"]:
        if "file" in table:
            with (datasets.path(name) / table["file"]).open(newline="", encoding="utf-8") as stream:
                found = Counter(row["status"] for row in csv.DictReader(stream))
            assert {k: v for k, v in table["count"].items() if v} == dict(found)


def test_damaged_state_of_the_half_ellipsoid() -> None:
    # README: 15 suspect rows; 80 lost in whole or part, in seven of which the note calls the rest suspect
    state = datasets.load("ct_half_ellipsoid").state("width_100")
    assert state.markers is not None
    assert (~state.markers.trusted).sum() == 15 + 7
    assert not state.markers.trusted[state.markers.ids == 20].any()


@pytest.mark.parametrize("name", [n for n in sorted(MARKERS) if n.startswith("ct_")])
def test_z_is_a_whole_number_of_slices(name: str) -> None:
    e = datasets.load(name)
    for state in (e.states[0], *e.loaded_states):
        assert state.markers is not None
        slices = state.markers.points[:, 2] / e.z_step_mm
        np.testing.assert_allclose(slices, np.round(slices), atol=1e-9)


@pytest.mark.parametrize("name", ["ct_cube_plate", "ct_cube_bar"])
def test_scale_turns_printed_pixels_into_pixels(name: str) -> None:
    # printed as whole pixels times 0.29 with two decimals, so a pixel number is known to .01 / .29
    e = datasets.load(name)
    pixels = e.initial.points[:, :2] * e.xy_scale / e.xy_step_mm
    np.testing.assert_allclose(pixels, np.round(pixels), atol=0.04)


@pytest.mark.parametrize("state", ["height_45", "height_35"])
def test_cells_of_eight_markers_keep_their_volume(state: str) -> None:
    # README: the volume of cells of eight markers stays within 2-3 % on average; labels run 5 x 5 x 5
    e = datasets.load("ct_cube_plate")
    volumes = []
    for markers in (e.initial, e.state(state).markers):
        assert markers is not None
        grid = markers.points.reshape(5, 5, 5, 3)
        edges = [np.diff(grid, axis=a) for a in (2, 1, 0)]
        mean = [sum(np.roll(d, 0)[s] for s in slices) / 4 for d, slices in zip(edges, _corners(), strict=True)]
        volumes.append(np.abs(np.einsum("...i,...i", mean[0], np.cross(mean[1], mean[2]))))
    assert np.mean(volumes[1] / volumes[0]) == pytest.approx(1.0, abs=0.03)


def _corners() -> list[list[tuple[slice, ...]]]:
    """For each direction, the four slices that pick the parallel edges of every cell."""
    low, high, whole = slice(None, -1), slice(1, None), slice(None)
    pairs = list(itertools.product((low, high), repeat=2))
    return [[(a, b, whole) for a, b in pairs], [(a, whole, b) for a, b in pairs], [(whole, a, b) for a, b in pairs]]


def test_facts_of_single_experiments() -> None:
    bar, plate, ends = (datasets.load(n) for n in ("ct_two_material_1", "ct_cube_plate", "ct_half_ellipsoid"))
    assert (bar.loading.kind, bar.loading.bar_width_mm, bar.loading.bar_axis) == ("bar", 13.0, "y")
    assert (bar.loaded_states[0].stated_mm, bar.loaded_states[0].estimated_mm, bar.joined_at_mm) == (40.0, 30.0, (30.0,))
    assert bar.materials == ("hardness 0", "hardness 5")
    assert [(s.stated_mm, s.estimated_mm) for s in plate.loaded_states] == [(45.0, 46.0), (35.0, 36.0)]
    assert (ends.shape.kind, ends.loading.kind, ends.loading.bar_axis) == ("half_ellipsoid", "side_plates", "y")
    assert [s.stated_mm for s in ends.states] == [None, 100.0, 80.0]


def test_agar_blocks_stand_on_y_and_tell_which_states_bear_no_load() -> None:
    plane, block = datasets.load("us_agar"), datasets.load("mr_agar")
    assert (plane.up_axis, plane.dimensions, plane.height_mm, plane.loading.kind) == ("y", 2, 30.0, "cylinder")
    assert (block.up_axis, block.dimensions, block.height_mm, block.loading.bar_axis) == ("y", 3, 25.0, "z")
    assert [s.name for s in plane.loaded_states] == ["trial1_deformed", "trial2_deformed"]
    assert [s.name for s in block.loaded_states] == ["deformed"]


def test_unknown_name_lists_the_names_and_the_closest() -> None:
    with pytest.raises(InputError, match=r"did you mean 'ct_cube_plate'\?.*us_agar"):
        datasets.load("ct_cube_plat")
    with pytest.raises(InputError, match="no bundled experiment"):
        datasets.path("../data/us_agar")


def test_path_is_a_folder_with_its_tables() -> None:
    assert (Path(datasets.path("us_agar")) / "trial1_initial.csv").is_file()


def test_paper_tables() -> None:
    tables = {t["id"]: t for t in datasets.paper_tables()["tables"]}
    assert tables["3.1"]["rows"] == [[32, 20]]
    assert all(len(row) == len(t["columns"]) for t in tables.values() for row in t["rows"])
