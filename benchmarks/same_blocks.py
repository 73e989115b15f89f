"""Which halves of the two-material cubes are the same block of gel: ``python benchmarks/same_blocks.py``.

Prints, for every two halves, how far apart their markers lie after the best registration.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from naibu import datasets
from naibu.validation.specimens.specimen_matching import block_match


def half(number: int, upper: bool) -> np.ndarray:
    """Markers (2, 5, 5, 3), mm, of the lower or upper half of an unloaded cube."""
    markers = datasets.load(f"ct_two_material_{number}").initial
    wanted = np.arange(51, 101) if upper else np.arange(1, 51)
    return markers.aligned(wanted).reshape(2, 5, 5, 3)


def main() -> None:
    """Compare all halves."""
    halves = {f"cube {n}, {'upper' if upper else 'lower'} half": half(n, upper) for n in (1, 2, 3, 4) for upper in (False, True)}
    rows = [(block_match(halves[a], halves[b]), a, b) for a, b in combinations(halves, 2)]
    for match, a, b in sorted(rows, key=lambda row: row[0].distance_mm):
        how = f"{90 * match.quarter_turns} degrees{', upside down' if match.upside_down else ''}"
        print(f"{match.distance_mm:.3f} mm  {match.marker_count:2d} markers  {a} | {b}  ({how})")


if __name__ == "__main__":
    main()
