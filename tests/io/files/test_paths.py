"""Paths that cannot be stored or opened are refused before anything is read or computed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.files.atomic import write_atomically
from naibu.io.files.paths import require_usable_path
from naibu.io.images import read_volume
from naibu.io.meshes import read_surface
from naibu.io.tables.marker_tables import import_markers, write_markers
from naibu.workflows.results.output_folder import output_folder

NOT_TEXT = os.fsdecode(b"scan-\xff\xfe")
MARKERS = Markers.from_arrays([1], np.zeros((1, 3)))
USES: list[Callable[[str], object]] = [
    lambda stem: read_volume(f"{stem}.mha"),
    lambda stem: read_surface(f"{stem}.stl"),
    lambda stem: import_markers(f"{stem}.csv"),
    lambda stem: read_experiment(stem),
    lambda stem: write_markers(f"{stem}.csv", MARKERS),
    lambda stem: write_atomically(f"{stem}.txt", "a"),
    lambda stem: output_folder(stem),
]


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize(
    ("name", "words"),
    [
        (NOT_TEXT, "not UTF-8 text"),
        ("a" * 300, "a name of 30[0-9] bytes, 2[0-9]+ are possible"),
        ("\u00e9" * 140, None),
        ("/".join(["folder"] * 700), "has [45][0-9]{3} bytes"),
        ("zero\0byte", "zero byte"),
    ],
)
def test_what_cannot_be_a_path_is_refused(tmp_path: Path, use: Callable[[str], object], name: str, words: str | None) -> None:
    with pytest.raises(InputError, match=words or "28[0-9] bytes"):
        use(f"{tmp_path}/{name}")
    assert list(tmp_path.iterdir()) == []


def test_messages_about_paths_can_be_printed(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        require_usable_path(tmp_path / NOT_TEXT)
    str(caught.value).encode("utf-8")


def test_usable_paths_are_returned(tmp_path: Path) -> None:
    for name in ("plain", "\u00e9t\u00e9 \u6e2c\u5b9a", "a" * 255):
        assert require_usable_path(tmp_path / name) == tmp_path / name
    # beside a result stands its temporary file, whose name is longer
    assert write_atomically(tmp_path / ("a" * 231), "x").read_text() == "x"
    with pytest.raises(InputError, match="a name of 232 bytes, 231 are possible"):
        write_atomically(tmp_path / ("a" * 232), "x")
