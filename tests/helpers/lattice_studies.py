"""A small study of a lattice as a file."""

from __future__ import annotations

from pathlib import Path

STUDY = """
[object]
size_mm = [30, 20, 20]
mass_g = 12.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 40.0
C1 = 10.0
C2 = 100.0
[simulation]
duration_s = 0.2
[floor]
contact = "friction"
static_friction = 0.5
[[indenter]]
name = "ball"
shape = "sphere"
radius_mm = 8.0
centre_mm = [10.0, 10.0, 28.5]
path = [[0.0, 0, 0, 0], [0.1, 0, 0, -3]]
[output]
every_s = 0.02
"""


def study_file(folder: Path, text: str = STUDY) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path
