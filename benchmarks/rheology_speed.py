"""Speed of time integration of a three-element block of 6 000 tetrahedra: the default method against the classical Runge-Kutta method.

A cube of 50 mm, E = 10 kPa, C2 = 300 kPa s, nu = 0.4, is pressed and sheared by its top for 0.5 s, one full swing, with C1 = 0.1, 1 and
100 kPa s, which is the agar of the 2008 report. Errors are differences of displacement at five times from a reference, relative to its
largest displacement; the reference is Richardson's extrapolation of the default method at 4 000 and 8 000 steps. Runge-Kutta takes the
longest steps at which it is stable, found by trial: longer ones, which would make its error as large as that of the implicit method, are
unstable. Where that takes more than 20 000 steps, 2 000 are timed and scaled, and their error is not known. Times are processor times of
one thread, as the machine may have other work.

Run: ``MKL_NUM_THREADS=1 OMP_NUM_THREADS=1 python benchmarks/rheology_speed.py``.
"""

from __future__ import annotations

import os
import time

import numpy as np

from naibu.core.errors import ConvergenceError
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain.dynamics import Series, explicit_step_limit, simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import Rheology, three_element
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.primitives import box

SIDE_MM, CELLS, DENSITY = 50.0, 10, 1.1e-6
SPAN_S, STEPS, COARSE, WHOLE = 0.5, 1000, 50, 20_000


def swing(t: float) -> tuple[float, float, float]:
    rate = 2.0 * np.pi / SPAN_S
    return 2.0 * np.sin(rate * t) ** 2, 0.0, -1.5 * (1.0 - np.cos(rate * t))


def press(body: LinearBody, material: Rheology, method: str, span: float, step: float) -> tuple[Series, float]:
    z = body.points[:, 2]
    supports = [
        Support("floor", np.flatnonzero(z < 1e-9)),
        Support("plate", np.flatnonzero(z > SIDE_MM - 1e-9), motion=PrescribedMotion.of(swing)),
    ]
    start = time.process_time()
    series = simulate_motion(body, material, DENSITY, supports, np.linspace(0.0, span, 6), step=step, method=method)
    return series, time.process_time() - start


def largest_stable_step(body: LinearBody, material: Rheology) -> float:
    """Longest step, within 5 %, at which Runge-Kutta does not blow up in 400 steps, from the bound of the fastest cell upwards."""
    step = explicit_step_limit(body, material, DENSITY)
    while True:
        try:
            series, _ = press(body, material, "rk4", 400 * 1.05 * step, 1.05 * step)
        except ConvergenceError:
            return step
        if np.abs(series.velocity).max() > 1e3:
            return step
        step *= 1.05


def error(series: Series, reference: np.ndarray) -> float:
    return float(np.abs(series.displacement - reference).max() / np.abs(reference).max())


def compare(body: LinearBody, viscosity: float) -> None:
    gel = three_element(10.0, viscosity, 300.0, 0.4)
    coarse, fine = (press(body, gel, "sdirk2", SPAN_S, SPAN_S / n)[0].displacement for n in (4 * STEPS, 8 * STEPS))
    reference = fine + (fine - coarse) / 3.0
    print(f"C1 = {viscosity:g} kPa s")
    seconds = {}
    for method, steps in (("sdirk2", COARSE), ("sdirk2", STEPS), ("generalized_alpha", STEPS), ("backward_euler", STEPS)):
        series, seconds[method, steps] = press(body, gel, method, SPAN_S, SPAN_S / steps)
        note = f"{series.factorizations} factorization"
        row(method, series.steps, seconds[method, steps], f"{error(series, reference):.1e}", note)
    step = largest_stable_step(body, gel)
    while True:
        count = int(np.ceil(SPAN_S / step))
        whole = count <= WHOLE
        try:
            series, explicit = press(body, gel, "rk4", SPAN_S if whole else 2000 * step, step)
            break
        except ConvergenceError:  # it grew too slowly to be seen in the trial
            step *= 0.95
    explicit *= 1.0 if whole else count / 2000
    row("rk4", count, explicit, f"{error(series, reference):.1e}" if whole else "-", "whole" if whole else "2 000 steps timed, scaled")
    ratios = [f"{explicit / seconds['sdirk2', n]:.3g} (sdirk2 in {n} steps)" for n in (STEPS, COARSE)]
    print(f"  rk4 over sdirk2: {', '.join(ratios)}", flush=True)


def row(method: str, steps: int, seconds: float, wrong: str, note: str) -> None:
    print(f"  {method:18s} {steps:9d} steps {seconds:11.2f} s {1e3 * seconds / steps:7.2f} ms a step   error {wrong:8s} {note}", flush=True)


def main() -> None:
    mesh = box((SIDE_MM,) * 3, (CELLS,) * 3, cell_type="tetra")
    body = LinearBody.of(mesh)
    threads = os.environ.get("MKL_NUM_THREADS")
    print(f"{mesh.n_cells} tetrahedra, {mesh.points.size} unknowns, {os.cpu_count()} cores, MKL_NUM_THREADS={threads}; processor time")
    for method in ("sdirk2", "backward_euler", "generalized_alpha", "rk4"):
        press(body, three_element(10.0, 0.1, 300.0, 0.4), method, 1e-5, 5e-6)  # compile
    for viscosity in (0.1, 1.0, 100.0):
        compare(body, viscosity)


if __name__ == "__main__":
    main()
