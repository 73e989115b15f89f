"""Mammography on virtual breasts: ``python benchmarks/mammography_population.py --out FOLDER [--breasts 60] [--model geometric]``.

Breasts are pressed by other finite elements and another law than those that predict. They and their errors are kept in the folder, one file
each: an interrupted run goes on where it stopped (delete the files of errors after a change of the predictor). Each prediction knows the
outlines, the stated plate distances and the stated angle, nothing else. The standard deviations behind bands and intervals were chosen on
breasts with even seeds; rows tell even and odd seeds apart. With ``--pressed-only`` breasts that the folder lacks are left out.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from naibu.applications.mammography.breast_outline import breast_outline
from naibu.applications.mammography.epipolar import Model, ModelUncertainty
from naibu.applications.mammography.pair_construction import mammographic_pair
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.validation.specimens.virtual_breasts import PressedBreast, press_breast, random_breast

UNCERTAINTY = ModelUncertainty(
    volume_ratio=0.005, along_share=0.025, bending=0.03, angle_deg=1.0, thickness_mm=1.0, unresolved_mm=0.9, unloaded_mm=4.0
)
POINTS, DRAWS = 12, 40  # of each breast


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


def row(name: str, found: list[Errors]) -> str:
    """Return one line of the table: means over the breasts, as each breast counts once."""
    mean = [float(np.mean(e.distance)) for e in found]
    every = np.concatenate([e.distance for e in found])
    return (
        f"{name:32s}{len(found):8d}{np.mean(mean):10.2f}{max(mean):10.2f}{np.percentile(every, 95):10.2f}"
        f"{100 * np.mean(np.concatenate([e.held for e in found])):10.1f}{np.mean([e.space.mean() for e in found]):10.2f}"
        f"{100 * np.mean(np.concatenate([e.inside for e in found])):10.1f}{np.median([e.seconds for e in found]):10.1f}"
        f"{sum(e.refused for e in found):10d}"
    )


def main() -> None:
    """Press the breasts that are missing, predict, and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--breasts", type=int, default=60)
    parser.add_argument("--model", choices=("geometric", "mechanical"), default="geometric")
    parser.add_argument("--pressed-only", action="store_true", help="leave out breasts that the folder does not hold yet")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    found: dict[int, Errors] = {}
    for seed in range(asked.breasts):
        if asked.pressed_only and not (asked.out / f"breast_{seed:03d}.npz").exists():
            continue
        breast = pressed(seed, asked.out)
        if breast is not None:
            found[seed] = kept_errors(seed, breast, asked.model, asked.out)
            print(seed, f"{found[seed].distance.mean():.2f} mm", flush=True)
    print(f"{asked.model}, {POINTS} points of each breast")
    print(f"{'':32s} breasts   mean mm  worst mm   95 % mm    band %    3-D mm  inside %   seconds   refused")
    for name, part in (("all", (0, 1)), ("even seeds (bands chosen here)", (0,)), ("odd seeds", (1,))):
        print(row(name, [e for seed, e in found.items() if seed % 2 in part]))


if __name__ == "__main__":
    main()
