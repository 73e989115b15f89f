"""Experiment folders: what is read, what is assumed and told, and every kind of mistake."""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from naibu import datasets
from naibu.core.errors import InputError
from naibu.io.experiment_folder.reader import read_experiment

META = """\
title = "Small cube"
units = "mm"

[coordinates]
axes = "x, y in the slice, z up"
z_step_mm = 0.5

[object]
shape = "cube"
size_mm = [30, 30, 30]

[markers]
nominal_spacing_mm = 10

[[layer]]
material = "soft"
from_base_mm = [0, 15]
[[layer]]
material = "hard"
from_base_mm = [15, 30]

[loading]
kind = "plate"
height_stated_mm = 25

[[state]]
name = "initial"

[[state]]
name = "pressed"
"""
HEADER = "marker,x_mm,y_mm,z_mm,status,note\n"
CORNERS = [(x, y, z) for z in (10, 20) for y in (10, 20) for x in (10, 20)]
INITIAL = HEADER + "".join(f"{n},{x},{y},{z},ok,\n" for n, (x, y, z) in enumerate(CORNERS, 1))
PRESSED = HEADER + "".join(f"{n},{x},{y},{z * 0.8},ok,\n" for n, (x, y, z) in enumerate(CORNERS, 1))
ADDED_KEYS = (
    r'^(kind = "(plate|bar|side_plates|cylinder)"|(bar_width_mm|bar_axis|joined_at_mm|up_axis|size_axes|straight_base_mm|loaded) = ).*\n'
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "small"
    root.mkdir()
    (root / "meta.toml").write_text(META)
    (root / "initial.csv").write_text(INITIAL)
    (root / "pressed.csv").write_text(PRESSED)
    return root


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def refusal(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_experiment(folder)
    return str(caught.value)


def original_copy(name: str, to: Path) -> Path:
    """Copy a bundled folder and take the added keys out of its meta.toml, as users bring it."""
    copied = Path(shutil.copytree(datasets.path(name), to / name))
    meta = (copied / "meta.toml").read_text(encoding="utf-8")
    (copied / "meta.toml").write_text(re.sub(ADDED_KEYS, "", meta, flags=re.MULTILINE), encoding="utf-8")
    return copied


def test_small_folder_is_read_as_written(folder: Path) -> None:
    e = read_experiment(folder)
    assert (e.name, e.title, e.shape.kind, e.shape.size_mm) == ("small", "Small cube", "box", (30.0, 30.0, 30.0))
    assert [(la.material, la.from_base_mm, la.to_base_mm) for la in e.layers] == [("soft", 0, 15), ("hard", 15, 30)]
    assert (e.loading.kind, e.loading.assumed, e.up_axis, e.height_mm) == ("plate", (), "z", 30.0)
    assert [(s.name, s.stated_mm, s.loaded) for s in e.states] == [("initial", None, False), ("pressed", 25.0, True)]
    np.testing.assert_array_equal(e.initial.points, np.array(CORNERS, float))
    assert e.initial.trusted.all()


def test_hashes_are_those_of_the_files(folder: Path) -> None:
    expected = {f: hashlib.sha256((folder / f).read_bytes()).hexdigest() for f in ("meta.toml", "initial.csv", "pressed.csv")}
    assert dict(read_experiment(folder).input_hashes) == expected


def test_windows_line_ends_and_byte_order_mark_are_read(folder: Path) -> None:
    for file in folder.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_text().replace("\n", "\r\n").encode())
    assert len(read_experiment(folder).initial) == 8


def test_status_and_note_columns_may_be_absent(folder: Path) -> None:
    (folder / "initial.csv").write_text(INITIAL.replace(",status,note", "").replace(",ok,", ""))
    assert read_experiment(folder).initial.trusted.all()


@pytest.mark.parametrize(
    ("row", "trusted"),
    [
        ("1,10,10,10,repaired,", True),
        ("1,10,10,10,renumbered,printed_no 7", True),
        ("1,10,10,10,suspect,", False),
        ("1,10,NaN,10,missing,y cell blank", True),
        ("1,10,NaN,10,missing,the coordinates given are suspect", False),
        ("1,10,,10,,", True),
    ],
)
def test_status_decides_what_may_be_used(folder: Path, row: str, trusted: bool) -> None:
    edit(folder / "initial.csv", "1,10,10,10,ok,", row)
    markers = read_experiment(folder).initial
    assert bool(markers.trusted[0]) is trusted
    assert np.isnan(markers.points[0, 1]) == (row.split(",")[2] in ("NaN", ""))


META_FAULTS = [
    ('units = "mm"', 'units = "cm"', ["units", "'cm'", 'units = "mm"']),
    ('units = "mm"\n', "", ["units is missing", 'units = "mm"']),
    ('title = "Small cube"\n', "", ["title is missing", "add a line"]),
    ("size_mm = [30, 30, 30]", "size_mm = [30, -30, 30]", ["[object] size_mm, entry 2", "-30", "positive"]),
    ("size_mm = [30, 30, 30]", "size_mm = [30, 30]", ["[object] size_mm", "[30, 30]", "three positive lengths"]),
    ("size_mm = [30, 30, 30]", "size_mm = [30, nan, 30]", ["size_mm, entry 2", "nan", "finite"]),
    ("size_mm = [30, 30, 30]", "size_mm = [30, inf, 30]", ["size_mm, entry 2", "inf", "finite"]),
    ("size_mm = [30, 30, 30]", 'size_mm = [30, "30", 30]', ["size_mm, entry 2", "'30'"]),
    ("size_mm", "size_m", ["[object] size_m", "did you mean 'size_mm'?"]),
    ('shape = "cube"', 'shape = "cubus"', ["shape", "'cubus'", "did you mean 'cube'?"]),
    ("nominal_spacing_mm", "nominal_spacing", ["[markers] nominal_spacing", "did you mean 'nominal_spacing_mm'?"]),
    ("[coordinates]", "[coordinate]", ["coordinate is not a known key", "did you mean 'coordinates'?"]),
    ('title = "Small cube"', 'title = "Small cube"\nweather = "fine"', ["weather is not a known key", "remove it"]),
    ("z_step_mm = 0.5", "z_step_mm = 0.5 mm", ["line 6", "'z_step_mm = 0.5 mm'", "not valid TOML"]),
    ("z_step_mm = 0.5", "z_step_mm = 0", ["[coordinates] z_step_mm = 0", "greater than 0"]),
    ("z_step_mm = 0.5", "xy_scale_probable = 1e-9", ["xy_scale_probable = 1e-09", "greater than or equal to 0.5", "true size of a pixel"]),
    ("z_step_mm = 0.5", "z_step_mm = 1e-9", ["z_step_mm = 1e-09", "between 1e-06 and 100000"]),
    ("z_step_mm = 0.5", "z_base_est_mm = 1e9", ["z_base_est_mm = 1000000000.0", "less than or equal to 100000"]),
    ("size_mm = [30, 30, 30]", "size_mm = [30, 30, 3e5]", ["size_mm, entry 3 = 300000.0", "between 1e-06 and 100000"]),
    ("nominal_spacing_mm = 10", "count = 0", ["[markers] count = 0", "greater than 0"]),
    ('name = "pressed"', 'name = "pressed"\nfile = "../pressed.csv"', ["'../pressed.csv' is outside the folder"]),
    ('name = "pressed"', 'name = "pressed"\nfile = "/etc/hostname"', ["'/etc/hostname' is outside the folder"]),
    ("from_base_mm = [15, 30]", "from_base_mm = [16, 30]", ["[[layer]] number 2", "gap above 15 mm", "0 to 30 mm"]),
    ("from_base_mm = [15, 30]", "from_base_mm = [14, 30]", ["[[layer]] number 2", "overlaps"]),
    ("from_base_mm = [15, 30]", "from_base_mm = [15, 29]", ["ends at 29 mm", "0 to 30 mm"]),
    ("from_base_mm = [0, 15]", "from_base_mm = [15, 0]", ["[[layer]] number 1", "upper height"]),
    ("from_base_mm = [0, 15]", "from_base_mm = [-1, 15]", ["[[layer]] number 1 from_base_mm, entry 1", "-1"]),
    ('kind = "plate"', 'kind = "hammer"', ["[loading] kind", "'hammer'", 'kind = "plate"']),
    ('kind = "plate"', 'indenter = "a hammer"', ["indenter", "'a hammer'", 'add kind = "plate"']),
    ('kind = "plate"', 'kind = "bar"\nbar_axis = "x"', ["bar_width_mm of the bar is missing", "bar_width_mm = 13"]),
    ('kind = "plate"', 'kind = "bar"\nbar_width_mm = 13', ["bar_axis of the bar is missing", 'bar_axis = "x"']),
    ('kind = "plate"', 'kind = "bar"\nbar_width_mm = 13\nbar_axis = "z"', ["bar_axis = 'z'", "vertical"]),
    ("height_stated_mm = 25", "height_stated_mm = [25, 20]", ["height_stated_mm", "2 values for 1 loaded states (pressed)"]),
    ("height_stated_mm = 25", "height_stated_mm = -25", ["height_stated_mm", "-25", "greater than 0"]),
    ("height_stated_mm = 25", "width_stated_mm = 25", ["width_stated_mm = [25.0]", "height_stated_mm"]),
    ('shape = "cube"', 'shape = "cube"\njoined_at_mm = [30]', ["joined_at_mm = 30", "between 0 and 30 mm"]),
    ('shape = "cube"', 'shape = "cube"\nstraight_base_mm = 5', ["straight_base_mm", "below a half ellipsoid; leave it out for a cube"]),
    ('shape = "cube"', 'shape = "half ellipsoid"\nstraight_base_mm = -5', ["straight_base_mm", "-5"]),
    ('shape = "cube"', 'shape = "cube"\nsize_axes = ["x", "x", "z"]', ["size_axes", "twice"]),
    ('name = "pressed"', 'name = "initial"', ["name = 'initial'", "2 times", "its own"]),
    ('name = "pressed"', 'name = "pressed hard"', ["[[state]] number 2 name", "'pressed hard'", "letters"]),
    ('name = "pressed"', "", ["[[state]] number 2 name is missing"]),
    ('name = "pressed"', 'name = "pressed"\nheldout = true', ["[[state]] number 2 heldout", "did you mean 'held_out'?"]),
    ('name = "pressed"', 'name = "squeezed"', ["squeezed.csv", "no such file", "held_out = true"]),
    ('name = "initial"', 'name = "free"\nheld_out = true', ["free.csv", "no such file", "add it"]),
]


@pytest.mark.parametrize(("old", "new", "told"), META_FAULTS, ids=[new[:40] or "without " + old[:30] for old, new, _ in META_FAULTS])
def test_mistake_in_meta_is_named(folder: Path, old: str, new: str, told: list[str]) -> None:
    edit(folder / "meta.toml", old, new)
    message = refusal(folder)
    assert str(folder) in message
    for part in told:
        assert part in message


def test_no_state_is_named(folder: Path) -> None:
    (folder / "meta.toml").write_text(META[: META.index("[[state]]")])
    assert "state is missing; add a [[state]] table" in refusal(folder)


def test_all_mistakes_in_meta_are_told_at_once(folder: Path) -> None:
    edit(folder / "meta.toml", "size_mm", "size_m")
    edit(folder / "meta.toml", 'units = "mm"\n', "")
    message = refusal(folder)
    assert "size_m" in message and "units is missing" in message


def test_missing_folder_and_missing_meta_are_named(tmp_path: Path) -> None:
    assert "meta.toml" in refusal(tmp_path / "nowhere")
    assert "an experiment is a folder with a meta.toml in it" in refusal(tmp_path)


def test_meta_that_is_not_text_is_named(folder: Path) -> None:
    (folder / "meta.toml").write_bytes(b'title = "\xff\xfe"')
    assert "not UTF-8" in refusal(folder)


CSV_FAULTS = [
    ("z_mm,status", "status", ["column 'z_mm' is missing"]),
    ("x_mm", "x_cm", ["'x_cm' is not in mm", "'x_mm'", "naibu import"]),
    ("x_mm", "x", ["'x'", "'x_mm'", "millimetres"]),
    ("x_mm", "X [cm]", ["'X [cm]' is not in mm"]),
    ("status", "stauts", ["unknown column 'stauts'", "did you mean 'status'?"]),
    ("note", "marker", ["'marker' appears 2 times"]),
    ("2,20,10,10,ok,", "1,20,10,10,ok,", ["marker 1 is in lines 2 and 3", "keep one"]),
    ("2,20,10,10,ok,", "two,20,10,10,ok,", ["line 3", "'two'", "whole number"]),
    ("2,20,10,10,ok,", "99999999999999999999,20,10,10,ok,", ["line 3", "whole number"]),
    ("2,20,10,10,ok,", "2,abc,10,10,ok,", ["line 3, marker 2", "x_mm = 'abc'", "not a number"]),
    ("2,20,10,10,ok,", "2,1_0,10,10,ok,", ["x_mm = '1_0'", "not a number"]),
    ("2,20,10,10,ok,", '2,"20,5",10,10,ok,', ["x_mm = '20,5'", "decimal point"]),
    ("2,20,10,10,ok,", "2,inf,10,10,ok,", ["line 3, marker 2", "x_mm = 'inf'", "infinite", "NaN"]),
    ("2,20,10,10,ok,", "2,NaN,10,10,ok,", ["marker 2", "x_mm is NaN", "set status to missing"]),
    ("2,20,10,10,ok,", "2,NaN,10,10,repaired,", ["x_mm is NaN", "'repaired'"]),
    ("2,20,10,10,ok,", "2,20,10,10,missing,", ["marker 2", "'missing'", "no coordinate is"]),
    ("2,20,10,10,ok,", "2,20,10,10,fine,", ["marker 2", "unknown status 'fine'"]),
    ("2,20,10,10,ok,", "2,20,10,10,Suspct,", ["did you mean 'suspect'?"]),
    ("2,20,10,10,ok,", "2,20", ["line 3 has 2 cells", "commas"]),
    ("2,20,10,10,ok,", "2,20,10,10,ok,,,", ["line 3 has 8 cells"]),
    ("2,20,10,10,ok,", '2,20,10,10,ok,"open', ["not readable CSV", "quotation mark"]),
    ("2,20,10,10,ok,", "2,200,10,10,ok,", ["x_mm spans 190.0 mm", "marker 2", "x_mm = 200", "unit (mm)"]),
]


@pytest.mark.parametrize(("old", "new", "told"), CSV_FAULTS, ids=[new for _, new, _ in CSV_FAULTS])
def test_mistake_in_a_marker_table_is_named(folder: Path, old: str, new: str, told: list[str]) -> None:
    edit(folder / "initial.csv", old, new)
    message = refusal(folder)
    assert str(folder / "initial.csv") in message
    for part in told:
        assert part in message


@pytest.mark.parametrize(
    ("content", "told"), [("", "empty"), (HEADER, "no marker has all its coordinates"), (INITIAL.replace(",", ";"), "naibu import")]
)
def test_table_without_rows_is_named(folder: Path, content: str, told: str) -> None:
    (folder / "initial.csv").write_text(content)
    assert told in refusal(folder)


def test_state_without_any_position_is_named(folder: Path) -> None:
    (folder / "pressed.csv").write_text(HEADER + "".join(f"{n},NaN,NaN,NaN,missing,\n" for n in range(1, 9)))
    message = refusal(folder)
    assert "pressed.csv" in message and "held_out = true" in message


def test_states_without_common_markers_are_named(folder: Path) -> None:
    (folder / "pressed.csv").write_text(re.sub(r"^(\d)", r"10\1", PRESSED, flags=re.MULTILINE))
    message = refusal(folder)
    assert "pressed.csv: only 0 markers" in message and "initial.csv" in message and "same number" in message


def test_suspect_markers_do_not_count_as_common(folder: Path) -> None:
    text = PRESSED
    for n in range(1, 6):
        text = re.sub(rf"^({n},.*),ok,$", r"\1,suspect,", text, flags=re.MULTILINE)
    (folder / "pressed.csv").write_text(text)
    assert "only 3 markers" in refusal(folder)


def test_slipped_decimal_point_in_a_loaded_state_is_named(folder: Path) -> None:
    edit(folder / "pressed.csv", "2,20,", "2,2000,")
    message = refusal(folder)
    assert "pressed.csv" in message and "marker 2" in message and "2000" in message


def test_centimetres_called_millimetres_are_named(folder: Path) -> None:
    rows = "".join(f"{n},{x / 10},{y / 10},{z / 10},ok,\n" for n, (x, y, z) in enumerate(CORNERS, 1))
    (folder / "initial.csv").write_text(HEADER + rows)
    message = refusal(folder)
    assert "1 mm apart" in message and "nominal_spacing_mm = 10" in message and "unit" in message


def test_a_scan_upside_down_is_named_where_layers_tell_their_markers(folder: Path) -> None:
    edit(folder / "meta.toml", "from_base_mm = [0, 15]", "from_base_mm = [0, 15]\nmarkers = [1, 4]")
    edit(folder / "meta.toml", "from_base_mm = [15, 30]", "from_base_mm = [15, 30]\nmarkers = [5, 8]")
    read_experiment(folder)
    upside_down = HEADER + "".join(f"{n},{x},{y},{-z},ok,\n" for n, (x, y, z) in enumerate(CORNERS, 1))
    (folder / "initial.csv").write_text(upside_down)
    message = refusal(folder)
    assert "number 2 has markers 5 to 8" in message and "-20.0 and -10.0 mm" in message and "z must" in message


def test_table_that_is_a_folder_is_named(folder: Path) -> None:
    (folder / "pressed.csv").unlink()
    (folder / "pressed.csv").mkdir()
    assert "pressed.csv: cannot be read" in refusal(folder)


def test_held_out_state_without_table_has_no_markers(folder: Path) -> None:
    (folder / "pressed.csv").unlink()
    edit(folder / "meta.toml", 'name = "pressed"', 'name = "pressed"\nheld_out = true')
    e = read_experiment(folder)
    assert e.state("pressed").markers is None and e.loaded_states == () and e.state("pressed").stated_mm == 25.0


def test_held_out_state_with_table_is_read(folder: Path) -> None:
    edit(folder / "meta.toml", 'name = "pressed"', 'name = "pressed"\nheld_out = true')
    assert len(read_experiment(folder).loaded_states) == 1


def test_one_height_for_two_loaded_states_is_refused_but_one_estimate_is_not(folder: Path) -> None:
    shutil.copy(folder / "pressed.csv", folder / "more.csv")
    with (folder / "meta.toml").open("a") as meta:
        meta.write('\n[[state]]\nname = "more"\n')
    assert "1 values for 2 loaded states (pressed, more)" in refusal(folder)
    edit(folder / "meta.toml", "height_stated_mm = 25", "height_stated_mm = [25, 20]\nheight_est_mm = 26")
    assert [(s.stated_mm, s.estimated_mm) for s in read_experiment(folder).loaded_states] == [(25.0, 26.0), (20.0, None)]


def test_height_may_stand_with_its_state(folder: Path) -> None:
    edit(folder / "meta.toml", "height_stated_mm = 25\n", "")
    edit(folder / "meta.toml", 'name = "pressed"', 'name = "pressed"\nheight_stated_mm = 24')
    assert read_experiment(folder).state("pressed").stated_mm == 24.0


def test_without_layers_the_object_is_one_layer(folder: Path) -> None:
    text = (folder / "meta.toml").read_text()
    (folder / "meta.toml").write_text(text[: text.index("[[layer]]")] + text[text.index("[loading]") :])
    assert [(la.material, la.from_base_mm, la.to_base_mm) for la in read_experiment(folder).layers] == [("gel", 0.0, 30.0)]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(junk=st.binary(max_size=80), at=st.integers(0, len(META)), table=st.booleans())
def test_no_junk_in_the_files_gives_anything_but_an_input_error(folder: Path, junk: bytes, at: int, table: bool) -> None:
    file, whole = ("initial.csv", INITIAL.encode()) if table else ("meta.toml", META.encode())
    at = min(at, len(whole))
    (folder / file).write_bytes(whole[:at] + junk + whole[at:])
    try:
        read_experiment(folder)
    except InputError as error:
        assert str(folder) in str(error)
    finally:
        (folder / file).write_bytes(whole)


@pytest.mark.parametrize("name", datasets.names())
def test_original_format_reads_the_same_and_tells_what_it_assumed(name: str, tmp_path: Path) -> None:
    bundled, original = datasets.load(name), read_experiment(original_copy(name, tmp_path))
    assert original.loading.assumed and not bundled.loading.assumed
    for field in ("kind", "bar_width_mm", "bar_axis", "counter_material", "base_material"):
        assert getattr(original.loading, field) == getattr(bundled.loading, field)
    for field in ("name", "layers", "joined_at_mm", "up_axis", "xy_scale", "xy_step_mm", "z_step_mm", "known_problems"):
        assert getattr(original, field) == getattr(bundled, field)
    assert original.shape == replace(bundled.shape, straight_base_mm=None)  # which no words of the file tell
    for ours, theirs in zip(bundled.states, original.states, strict=True):
        assert (ours.name, ours.loaded, ours.stated_mm, ours.estimated_mm) == (
            theirs.name,
            theirs.loaded,
            theirs.stated_mm,
            theirs.estimated_mm,
        )


def test_assumptions_are_plain_sentences(tmp_path: Path) -> None:
    said = read_experiment(original_copy("ct_two_material_1", tmp_path)).loading.assumed
    assert "The bar is taken to lie along y, because indenter says 'lies along y'." in said
    assert any("at 30 mm" in s and "halves lie on each other" in s for s in said)


@pytest.mark.parametrize("announced", ["held_out = true", 'file = "deformed.csv"', ""])
def test_released_state_of_two_material_4_is_read(announced: str, tmp_path: Path) -> None:
    folder = original_copy("ct_two_material_4", tmp_path)
    shutil.copy(folder / "initial.csv", folder / "deformed.csv")
    edit(folder / "meta.toml", "held_out = true", announced)
    e = read_experiment(folder)
    assert e.loading.kind == "plate" and len(e.loaded_states) == 1
    assert any("as condition 3" in s for s in e.loading.assumed)
