"""How well the bundled measurements are matched and predicted, with default settings: ``python benchmarks/accuracy.py``.

Prints one line for each claim: RMS distance (3-D, mm) over the markers that were measured completely in both states; and for every
predicted state how many of its coordinates lie within 1.96 of their standard deviations (``sd_mm`` of ``predicted.csv``).
``--only left-out``, ``plate`` or ``single`` runs a part, ``--record`` writes ``results/accuracy.json``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field

import numpy as np
from records import ResultTable, write_record

import naibu
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.prediction.interval import per_axis
from naibu.identification.prediction.prediction import Prediction, rms

CUBES = ("ct_two_material_1", "ct_two_material_2", "ct_two_material_3")


def fitted(calibration: Calibration) -> dict[str, float]:
    """RMS of every load case of a calibration, mm."""
    out = {}
    for load_case, fit in zip(calibration.load_cases, calibration.match.fits, strict=True):
        whole = np.isfinite(fit.residual).all(axis=1) & ~load_case.specimen.marker_filled.any(axis=1)
        out[load_case.name] = float(np.sqrt((fit.residual[whole] ** 2).sum(axis=1).mean()))
    return out


@dataclass(slots=True)
class Rows:
    """Lines of the tables, printed as they come, and the coordinates that lay within their bounds."""

    distances: list[tuple[str, str, float, float]] = field(default_factory=list)
    bounds: list[tuple[str, str, float, int]] = field(default_factory=list)
    inside: list[np.ndarray] = field(default_factory=list)
    start: float = field(default_factory=time.perf_counter)

    def add(self, what: str, values: dict[str, float], goal: float) -> None:
        """Print distances."""
        for label, value in values.items():
            self.distances.append((label, what, round(value, 3), goal))
            seconds = time.perf_counter() - self.start
            print(f"{what:28s} {label:36s} {value:6.3f} mm   goal {goal:.2f}   {seconds:6.1f} s", flush=True)

    def cover(self, what: str, label: str, p: Prediction) -> None:
        """Print how many coordinates of a predicted state lie within their bounds."""
        whole = np.isfinite(p.residual).all(axis=1) & ~p.specimen.marker_filled.any(axis=1)
        inside = np.abs(p.residual[whole]) < 1.96 * per_axis(p.sd_mm)[whole, None]
        along = np.abs(p.residual[whole]) < 1.96 * p.sd_mm[whole]
        self.inside.append(inside.ravel())
        sd = f"sd_model_mm {np.median(per_axis(p.sd_model_mm)):.2f}, sd_mm {np.median(per_axis(p.sd_mm)):.2f}"
        print(f"{what:28s} {label:36s} {100 * inside.mean():5.1f} % within, {100 * along.mean():5.1f} % by axis; {sd}", flush=True)
        self.bounds.append((label, what, round(100.0 * float(inside.mean()), 1), inside.size))

    @property
    def tables(self) -> tuple[ResultTable, ResultTable]:
        """Distances and bounds, as a record holds them."""
        every = np.concatenate(self.inside)
        total = ("all", "", round(100.0 * float(every.mean()), 1), every.size)
        return (
            ResultTable("distances", ("experiment", "evaluation", "distance, mm", "goal, mm"), tuple(self.distances)),
            ResultTable("bounds", ("experiment", "prediction", "within 95 % bounds, %", "coordinates"), (*self.bounds, total)),
        )


def left_out(rows: Rows) -> None:
    """Two materials, jointly and each experiment from the others."""
    two = naibu.identify(CUBES, known=["hardness 5=222 kPa"], cross_validate=True)
    rows.add("fitted jointly", fitted(two.calibration), 0.35)
    rows.add("left out", {f"{r.experiment}/{r.state}": r.rms_mm for r in two.left_out}, 0.60)
    for r in two.left_out:
        rows.cover("left out", f"{r.experiment}/{r.state}", r.prediction)
    for p in two.model.parameters:
        if "ct_" not in p.name:
            print(p.name, p.value, two.model.interval(p.name))


def plate(rows: Rows) -> None:
    """Two heights of the uniform cube, jointly and each from the other."""
    values = fitted(naibu.identify(["ct_cube_plate"]).calibration)
    rows.add("both heights jointly", {"ct_cube_plate/height_45": values["ct_cube_plate/height_45"]}, 0.30)
    rows.add("both heights jointly", {"ct_cube_plate/height_35": values["ct_cube_plate/height_35"]}, 0.40)
    for seen, unseen, goal in (("height_45", "height_35", 0.50), ("height_35", "height_45", 0.50)):
        one = naibu.identify(["ct_cube_plate"], states={"ct_cube_plate": [seen]})
        for way, by_markers in (("", True), (", stated height", False)):
            p = naibu.predict(one.model, "ct_cube_plate", state=unseen, heights_from_markers=by_markers)
            if by_markers:
                rows.add(f"predicted from {seen}", {f"ct_cube_plate/{unseen}": rms(p.residual)}, goal)
            rows.cover(f"predicted from {seen}{way}", f"ct_cube_plate/{unseen}", p)


def main() -> None:
    """Run all cases and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--only", choices=("left-out", "plate", "single"), help="run one part")
    part.add_argument("--record", action="store_true", help="write results/accuracy.json")
    options = parser.parse_args()
    rows = Rows()
    if options.only in (None, "left-out"):
        left_out(rows)
    if options.only in (None, "plate"):
        plate(rows)
    if options.only in (None, "single"):
        rows.add("fitted", fitted(naibu.identify(["ct_cube_bar"]).calibration), 0.45)
        rows.add("fitted", fitted(naibu.identify(["ct_half_ellipsoid"]).calibration), 0.80)
    if rows.inside:
        inside = np.concatenate(rows.inside)
        print(f"{100 * inside.mean():.1f} % of {len(inside)} predicted coordinates lie within their bounds of 95 %")
    if options.record:
        write_record("accuracy", rows.tables)


if __name__ == "__main__":
    main()
