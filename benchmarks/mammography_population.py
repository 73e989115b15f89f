"""Mammography on virtual breasts: ``python benchmarks/mammography_population.py --out FOLDER [--breasts 60] [--models geometric]``.

Breasts are pressed by other finite elements and another law than those that predict. They and their errors are kept in the folder, one file
each: an interrupted run goes on where it stopped (delete the files of errors after a change of the predictor). Each prediction knows the
outlines, the stated plate distances and the stated angle, nothing else. How often swapped views are told is printed, too. The standard
deviations behind bands and intervals were chosen on
breasts with even seeds below 60; rows tell those and others apart. With ``--pressed-only`` breasts that the folder lacks are left out.
A breast takes some ten seconds of processor time. ``--record`` writes ``results/mammography_population.json``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from records import ResultTable, write_record

from naibu.applications.mammography.breast_outline import breast_outline
from naibu.applications.mammography.epipolar import Model, ModelUncertainty
from naibu.applications.mammography.pair_construction import mammographic_pair
from naibu.applications.mammography.view_order import may_be_swapped
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.validation.specimens.virtual_breasts import PressedBreast, press_breast, random_breast

UNCERTAINTY = ModelUncertainty(
    volume_ratio=0.005, along_share=0.025, bending=0.03, angle_deg=1.0, thickness_mm=1.0, unresolved_mm=0.9, unloaded_mm=4.0
)
POINTS, DRAWS = 12, 40  # of each breast
MODELS: tuple[Model, ...] = ("geometric", "mechanical")
COLUMNS = (
    "model", "breasts", "distance, mean mm", "worst breast, mm", "95 % of the points, mm", "in the band, %", "in 3-D, mean mm",
    "coordinates in intervals, %", "processor s",
)  # fmt: skip


def pressed(seed: int, folder: Path) -> PressedBreast | None:
    """Return a virtual breast from the folder, pressed and kept there if it is not; None where no equilibrium was found."""
    path = folder / f"breast_{seed:03d}.npz"
    if not path.exists():
        try:
            found = press_breast(random_breast(seed))
        except ConvergenceError as error:
            print(f"breast {seed}: {error}", flush=True)
            return None
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, cc=found.outlines[0], mlo=found.outlines[1], points=found.points, places=found.places)
        part.replace(path)
    kept = np.load(path)
    return PressedBreast((kept["cc"], kept["mlo"]), kept["points"], kept["places"])


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors of one model on one breast, mm: distances from the curve (k,), in the band, 3-D errors, coordinates (k, 3) in intervals."""

    distance: FloatArray
    held: BoolArray
    space: FloatArray
    inside: BoolArray
    refused: int
    seconds: float


def kept_errors(seed: int, breast: PressedBreast, model: Model, folder: Path) -> Errors:
    """Return the errors of one model on one breast, from the folder if they are there."""
    path = folder / f"{model}_{seed:03d}.npz"
    if not path.exists():
        found = errors(seed, breast, model)
        part = path.with_suffix(".part.npz")
        np.savez(part, **{name: getattr(found, name) for name in Errors.__dataclass_fields__})
        part.replace(path)
    kept = np.load(path)
    return Errors(kept["distance"], kept["held"], kept["space"], kept["inside"], int(kept["refused"]), float(kept["seconds"]))


def errors(seed: int, pressed: PressedBreast, model: Model) -> Errors:
    """Predict every point of a breast from its other view, and from both."""
    breast = random_breast(seed)
    outlines = breast_outline(pressed.outlines[0]), breast_outline(pressed.outlines[1])
    start = time.process_time()
    pair = mammographic_pair(
        *outlines, breast.stated_thickness_mm, breast.stated_angle_deg, model=model,
        uncertainty=UNCERTAINTY, draws=DRAWS, seed=seed,
    )  # fmt: skip
    seconds, rows, refused = 0.0, [], 0
    for truth, cc, mlo in zip(pressed.points[:POINTS], *pressed.places[:, :POINTS], strict=True):
        if min(cc[0], mlo[0]) < 0.0:  # not in the image
            continue
        places = outlines[0].from_image(cc), outlines[1].from_image(mlo)
        try:
            curve = pair.epipolar_curve(places[0])
            seconds = seconds or time.process_time() - start
            lesion = pair.lesion(*places)
        except InputError:
            refused += 1
            continue
        within = (lesion.low <= truth) & (truth <= lesion.high)
        rows.append((curve.distance(places[1]), curve.in_band(places[1]), np.linalg.norm(lesion.position - truth), *within))
    table = np.array(rows, dtype=float)
    return Errors(table[:, 0], table[:, 1] > 0.5, table[:, 2], table[:, 3:] > 0.5, refused, seconds)


def row(name: str, found: list[Errors]) -> tuple[str | float, ...]:
    """Return one row of the table: means over the breasts, as each breast counts once; refused points stand in its name."""
    mean = [float(np.mean(e.distance)) for e in found]
    refused = sum(e.refused for e in found)
    return (
        name + (f", {refused} points refused" if refused else ""), len(found), round(float(np.mean(mean)), 2), round(max(mean), 2),
        round(float(np.percentile(np.concatenate([e.distance for e in found]), 95)), 2),
        round(100.0 * float(np.mean(np.concatenate([e.held for e in found]))), 1),
        round(float(np.mean([e.space.mean() for e in found])), 2),
        round(100.0 * float(np.mean(np.concatenate([e.inside for e in found]))), 1),
        round(float(np.median([e.seconds for e in found])), 1),
    )  # fmt: skip


def chosen_on(seed: int) -> bool:
    """Return whether the standard deviations were chosen with the breast of this seed in view."""
    return seed < 60 and seed % 2 == 0


def rows_of(model: Model, found: dict[int, Errors]) -> list[tuple[str | float, ...]]:
    """Return the rows of a model: all breasts, and those that bands were chosen on apart from others, where there are both."""
    parts = {
        f"{model}, bands chosen on these": [e for seed, e in found.items() if chosen_on(seed)],
        f"{model}, others": [e for seed, e in found.items() if not chosen_on(seed)],
    }
    return [row(model, list(found.values()))] + ([row(name, part) for name, part in parts.items()] if all(parts.values()) else [])


def swapped_views(breasts: list[PressedBreast]) -> ResultTable:
    """Return in how many breasts the views are taken to be swapped where they are, and where they are not."""
    pairs = [(breast_outline(b.outlines[0]), breast_outline(b.outlines[1])) for b in breasts]
    told, alarms = sum(may_be_swapped(mlo, cc) for cc, mlo in pairs), sum(may_be_swapped(cc, mlo) for cc, mlo in pairs)
    rows = (("swapped", len(pairs), told), ("in order", len(pairs), alarms))
    return ResultTable("view-order", ("views", "breasts", "taken to be swapped"), rows)


def main() -> None:
    """Press the breasts that are missing, predict, and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--breasts", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS)
    parser.add_argument("--pressed-only", action="store_true", help="leave out breasts that the folder does not hold yet")
    parser.add_argument("--record", action="store_true", help="write results/mammography_population.json")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    found: dict[Model, dict[int, Errors]] = {model: {} for model in asked.models}
    breasts: list[PressedBreast] = []
    for seed in range(asked.first, asked.first + asked.breasts):
        if asked.pressed_only and not (asked.out / f"breast_{seed:03d}.npz").exists():
            continue
        breast = pressed(seed, asked.out)
        if breast is None:
            continue
        breasts.append(breast)
        for model, of_model in found.items():
            of_model[seed] = kept_errors(seed, breast, model, asked.out)
            print(seed, model, f"{of_model[seed].distance.mean():.2f} mm", flush=True)
    if not breasts:
        raise SystemExit("no breast: press some first, without --pressed-only")
    rows = [each for model, of_model in found.items() for each in rows_of(model, of_model)]
    order = swapped_views(breasts)
    tables = ResultTable("population", COLUMNS, tuple(rows)), order
    for table in tables:
        print("\n" + "  ".join(table.columns))
        for cells in table.rows:
            print("  ".join(f"{cell:{len(name)}}" for cell, name in zip(cells, table.columns, strict=True)))
    if asked.record:
        write_record("mammography_population", tables)


if __name__ == "__main__":
    main()
