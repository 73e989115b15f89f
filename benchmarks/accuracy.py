"""How well the bundled measurements are matched and predicted, with default settings: ``python benchmarks/accuracy.py [OUT.json]``.

Prints one line for each claim: RMS distance (3-D, mm) over the markers that were measured completely in both states.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

import naibu
from naibu.identification.from_markers.calibration import Calibration

CUBES = ("ct_two_material_1", "ct_two_material_2", "ct_two_material_3")


def fitted(calibration: Calibration) -> dict[str, float]:
    """RMS of every load case of a calibration, mm."""
    out = {}
    for load_case, fit in zip(calibration.load_cases, calibration.match.fits, strict=True):
        whole = np.isfinite(fit.residual).all(axis=1) & ~load_case.specimen.marker_filled.any(axis=1)
        out[load_case.name] = float(np.sqrt((fit.residual[whole] ** 2).sum(axis=1).mean()))
    return out


def main() -> None:
    """Run all cases and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, help="also write the rows to this JSON file")
    out = parser.parse_args().out
    rows: list[tuple[str, str, float, float]] = []

    def add(what: str, values: dict[str, float], goal: float, start: float) -> None:
        for label, value in values.items():
            rows.append((what, label, value, goal))
            print(f"{what:28s} {label:36s} {value:6.3f} mm   goal {goal:.2f}   {time.perf_counter() - start:6.1f} s", flush=True)

    start = time.perf_counter()
    two = naibu.identify(CUBES, known=["hardness 5=222 kPa"], cross_validate=True)
    add("fitted jointly", fitted(two.calibration), 0.35, start)
    add("left out", {f"{r.experiment}/{r.state}": r.rms_mm for r in two.left_out}, 0.60, start)
    plate = naibu.identify(["ct_cube_plate"])
    values = fitted(plate.calibration)
    add("both heights jointly", {"ct_cube_plate/height_45": values["ct_cube_plate/height_45"]}, 0.30, start)
    add("both heights jointly", {"ct_cube_plate/height_35": values["ct_cube_plate/height_35"]}, 0.40, start)
    one = naibu.identify(["ct_cube_plate"], states={"ct_cube_plate": ["height_45"]})
    unseen = naibu.predict(one.model, "ct_cube_plate", state="height_35", heights_from_markers=True)
    add("predicted from height_45", {"ct_cube_plate/height_35": float(np.sqrt((unseen.residual**2).sum(axis=1).mean()))}, 0.50, start)
    add("fitted", fitted(naibu.identify(["ct_cube_bar"]).calibration), 0.45, start)
    add("fitted", fitted(naibu.identify(["ct_half_ellipsoid"]).calibration), 0.80, start)
    for p in two.model.parameters:
        if "ct_" not in p.name:
            print(p.name, p.value, two.model.interval(p.name))
    if out:
        out.write_text(json.dumps([list(r) for r in rows], indent=1))


if __name__ == "__main__":
    main()
