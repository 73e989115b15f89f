"""Registry of the chapters of the report that can be reproduced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from naibu.reproduction.agreement import calf_and_agar, gels, lattices, skin_and_chip
from naibu.reproduction.agreement.read_tables import Tables
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
from naibu.viewer.chapters.chapter import Chapter
from naibu.viewer.chapters.comparisons import Comparison


def _compared(chapter: Callable[[int], Chapter], agreement: Callable[[Tables], tuple[Comparison, ...]]) -> Callable[[int], Chapter]:
    """Return a chapter that opens with what agrees."""

    def with_agreement(seed: int) -> Chapter:
        content = chapter(seed)
        return replace(content, comparisons=agreement(Tables(content.sections)))

    return with_agreement


@dataclass(frozen=True, slots=True)
class _ChapterEntry:
    """How a chapter is computed, what it agrees on with the report, and how long it takes, to say so beforehand.

    Seconds are those of the processor that ``naibu reproduce CHAPTER`` took, user and system, with kernels that were compiled before.
    """

    content: Callable[[int], Chapter]
    agreement: Callable[[Tables], tuple[Comparison, ...]]
    processor_s: float


_ENTRIES = {
    "ch1": _ChapterEntry(chapter1, calf_and_agar.of_chapter1, 97.0),
    "ch2": _ChapterEntry(chapter2, calf_and_agar.of_chapter2, 19.0),
    "ch3": _ChapterEntry(chapter3, gels.of_chapter3, 33.0),
    "ch4-adaptive": _ChapterEntry(chapter4_adaptive, lattices.of_adaptive, 14.0),
    "ch4-cut": _ChapterEntry(chapter4_cut, lattices.of_cutting, 8.0),
    "ch4-lattice": _ChapterEntry(chapter4_lattice, lattices.of_lattice, 406.0),
    "ch4-cube": _ChapterEntry(chapter4_cube, lattices.of_cube, 619.0),
    "ch4-octree": _ChapterEntry(chapter4_octree, lattices.of_octree, 4.0),
    "ch5": _ChapterEntry(chapter5, skin_and_chip.of_chapter5, 28.0),
    "ch6": _ChapterEntry(chapter6, skin_and_chip.of_chapter6, 32.0),
}
CHAPTERS = {name: _compared(entry.content, entry.agreement) for name, entry in _ENTRIES.items()}
AGREEMENT = {name: entry.agreement for name, entry in _ENTRIES.items()}
PROCESSOR_S = {name: entry.processor_s for name, entry in _ENTRIES.items()}
