"""Registry of the chapters of the report that can be reproduced."""

from __future__ import annotations

from collections.abc import Callable

from naibu.reproduction.chapter1.tables import chapter1
from naibu.reproduction.chapter2.tables import chapter2
from naibu.reproduction.chapter3.tables import chapter3
from naibu.reproduction.chapter4.adaptive import chapter4_adaptive
from naibu.reproduction.chapter4.cube import chapter4_cube
from naibu.reproduction.chapter4.cutting import chapter4_cut
from naibu.reproduction.chapter4.lattice import chapter4_lattice
from naibu.reproduction.chapter4.octree import chapter4_octree
from naibu.reproduction.chapter5.tables import chapter5
from naibu.reproduction.chapter6.tables import chapter6
from naibu.viewer.chapter import Chapter

CHAPTERS: dict[str, Callable[[int], Chapter]] = {
    "ch1": chapter1,
    "ch2": chapter2,
    "ch3": chapter3,
    "ch4-adaptive": chapter4_adaptive,
    "ch4-cut": chapter4_cut,
    "ch4-lattice": chapter4_lattice,
    "ch4-cube": chapter4_cube,
    "ch4-octree": chapter4_octree,
    "ch5": chapter5,
    "ch6": chapter6,
}

# processor seconds, to say beforehand how long all of them take
PROCESSOR_S: dict[str, float] = {
    "ch1": 70.0,
    "ch2": 25.0,
    "ch3": 36.0,
    "ch4-adaptive": 9.0,
    "ch4-cut": 7.0,
    "ch4-lattice": 170.0,
    "ch4-cube": 60.0,
    "ch4-octree": 60.0,
    "ch5": 18.0,
    "ch6": 85.0,
}
