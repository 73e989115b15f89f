"""The chapters that can be reproduced, by name."""

from __future__ import annotations

from collections.abc import Callable

from naibu.pages.chapter import Chapter
from naibu.reproduction.chapter1 import chapter1
from naibu.reproduction.chapter2 import chapter2
from naibu.reproduction.chapter3 import chapter3
from naibu.reproduction.chapter4_cube import chapter4_cube
from naibu.reproduction.chapter4_lattice import chapter4_lattice
from naibu.reproduction.chapter4_octree import chapter4_octree

CHAPTERS: dict[str, Callable[[int], Chapter]] = {
    "ch1": chapter1,
    "ch2": chapter2,
    "ch3": chapter3,
    "ch4-lattice": chapter4_lattice,
    "ch4-cube": chapter4_cube,
    "ch4-octree": chapter4_octree,
}
