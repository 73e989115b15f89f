"""Models of mammography on the measured half ellipsoid between plates: ``python benchmarks/mammography.py``.

Interior markers at a plate distance of 100 mm are predicted from the shape and the distance, with stated parameters; no displacement of
a marker is used. Only the body's frame comes from the markers: its axes in the unloaded state, and its position on the table. The
shape is a half ellipsoid of 110 x 130 x 49 mm, as the rows of markers show, on a straight part of 21 mm, which makes up the printed
height of 70 mm; the measured unloaded state bears its weight on the table. Distances are root mean squares in 3-D: after the best rigid
motion, along the table only, and on the table, where a motion along the table is removed only. ``--record`` writes
``results/mammography.json``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from records import ResultTable, write_record

from naibu.applications.mammography.geometric_model import CompressionParameters, compressed
from naibu.core.arrays import FloatArray
from naibu.reproduction.chapter5.half_ellipsoid import (
    DISTANCE_MM,
    TESTED_KPA,
    distances_mm,
    hardness_modulus,
    mechanical_model,
    phantom_markers,
    phantom_shape,
)


def geometric(free_base: bool, parameters: CompressionParameters | None = None) -> Callable[[FloatArray], FloatArray]:
    """Return the geometric model's map from the unloaded to the compressed body."""
    chosen = parameters or CompressionParameters()
    return compressed(phantom_shape(), 0.0, DISTANCE_MM, chosen, free_base=free_base).compress


def models() -> dict[str, Callable[[FloatArray], FloatArray]]:
    """Return every model's map from the unloaded to the compressed body."""
    found = {
        "geometric, base free to arch": geometric(True),
        "geometric, base held": geometric(False),
        "geometric, base free, no bending": geometric(True, CompressionParameters(bending=0.0)),
    }
    for hardness, tested in TESTED_KPA.items():
        by_hardness = hardness_modulus(hardness)
        found[f"mechanical, {by_hardness:.0f} kPa (durometer hardness {hardness})"] = mechanical_model(by_hardness)
        found[f"mechanical, {tested:.0f} kPa (compression test, hardness {hardness})"] = mechanical_model(tested)
    return found


def main() -> None:
    """Print one line for each model."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--record", action="store_true", help="write results/mammography.json")
    record = parser.parse_args().record
    before, after = phantom_markers()
    columns = ("model", "markers", "rigid motion removed, mm", "along x and y, mm", "on the table, mm", "without a model, mm")
    print("  ".join(columns))
    unmoved = round(distances_mm(before, after)[0], 2)
    rows = []
    for name, model in models().items():
        found = tuple(round(value, 2) for value in distances_mm(model(before), after))
        rows.append((name, len(before), *found, unmoved))
        print(f"{name:50s}{len(before):7d}" + "".join(f"{value:14.2f}" for value in (*found, unmoved)), flush=True)
    if record:
        write_record("mammography", (ResultTable("phantom", columns, tuple(rows)),))


if __name__ == "__main__":
    main()
