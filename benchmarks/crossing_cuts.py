"""Cuts of a live body that cross earlier ones: frames and steps until each has opened, and behind it, as `naibu live` takes them.

A straight cut is followed by one across it, an oblique one, one along the first, a loop, or one that frees a piece. Times are those of the
processor: a frame's are those of the thread that steps, a step's those of all frames that worked on it and of the threads beside them.

Run on idle cores: ``OMP_NUM_THREADS=1 python benchmarks/crossing_cuts.py [--body demo|15] [--friction 0.0]``; a number N is a box of 6 N^3
tetrahedra, nu 0.499, held at its floor.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace

import numpy as np
from live_bodies import body_named

from naibu.simulation import FiniteElementBody, InteractiveSimulation
from naibu.workflows import tools_for
from naibu.workflows.interactive.cut_kernels import compile_for_cuts
from naibu.workflows.interactive.live import BUDGET_S, DELAY_S

FRAME_S = 1.0 / 60.0
SETTLE, BEHIND = 60, 90  # frames before the first cut, and behind each
MARGIN = 5.0  # mm by which blades reach beyond the body
ORDERS = ("straight across oblique along", "straight across loop", "straight piece", "straight across piece")
Blade = list[list[list[float]]]


@dataclass(slots=True)
class Times:
    """Of frames and steps, ms."""

    frames: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)  # of all threads
    own: list[float] = field(default_factory=list)  # steps of the thread that takes them
    left: list[float] = field(default_factory=list)  # out of balance, %
    failed: int = 0
    under_way: bool = False

    def __str__(self) -> str:
        """The times in a line."""
        ms, steps, own = np.array(self.frames), np.array(self.steps), np.array(self.own)
        return (
            f"frames p99 {np.quantile(ms, 0.99):.0f}, worst {ms.max():.0f} ms; steps median {np.median(steps):.0f}, p99 "
            f"{np.quantile(steps, 0.99):.0f}, worst {steps.max():.0f} ms, {np.count_nonzero(steps > 100.0)} of {len(steps)} above 100 ms, "
            f"of the thread that steps p99 {np.quantile(own, 0.99):.0f}, worst {own.max():.0f} ms, {np.count_nonzero(own > 100.0)} above; "
            f"out of balance at most {max(self.left):.0f} %, failed {self.failed}"
        )


def blades(body: FiniteElementBody) -> dict[str, Blade]:
    """The edges of the blades, for a body in the shape of a block."""
    low, high = body.points.min(axis=0) - MARGIN, body.points.max(axis=0) + MARGIN
    middle, size = 0.5 * (low + high), high - low - 2.0 * MARGIN
    x, y, z = middle + np.array([0.02, -0.035, 0.0]) * size
    around = [middle + 0.28 * size * [np.cos(w), np.sin(w), 0.0] for w in np.linspace(0.0, 2.0 * np.pi, 25)]
    high_cut, low_cut, behind = z + 0.3 * size[2], z + 0.25 * size[2], y - 0.07 * size[1]
    return {
        "straight": [[[x, end, high[2]], [x, end, z]] for end in (low[1], high[1])],
        "across": [[[end, y, high[2]], [end, y, z]] for end in (low[0], high[0])],
        "oblique": [
            [[low[0], low[1], z + 0.35 * size[2]], [low[0], low[1], z]],
            [[high[0], high[1], z + 0.55 * size[2]], [high[0], high[1], z - 0.1 * size[2]]],
        ],
        "along": [[[x + by * size[0], end, high[2]], [x + by * size[0], end, z]] for by, end in ((0.01, low[1]), (-0.01, high[1]))],
        "loop": [[[*at[:2], high[2]], [*at[:2], z - 0.1 * size[2]]] for at in around],
        "piece": [[[end, at, height] for end in (low[0], high[0])] for at, height in ((behind, high_cut), (high[1], low_cut))],
    }


def frame(simulation: InteractiveSimulation, times: Times) -> bool:
    """Take a frame when it is due, and say whether a cut has opened in it."""
    began, own, whole = time.perf_counter(), time.thread_time(), time.process_time()
    opened = simulation.finish_cut()
    taken = simulation.advance()
    times.frames.append(1e3 * (time.thread_time() - own))
    spent = 1e3 * (time.process_time() - whole)
    for steps, more in ((times.steps, spent), (times.own, times.frames[-1])):
        steps[-1:] = [steps[-1] + more] if times.under_way else [*steps[-1:], more]
    times.left.append(100.0 * taken.unbalanced)
    times.failed += bool(taken.failed)
    times.under_way = taken.under_way
    time.sleep(max(0.0, FRAME_S - (time.perf_counter() - began)))
    return opened


def cut_in_order(body: FiniteElementBody, order: list[str]) -> None:
    """Cut a body, one cut after the other, and print the times."""
    simulation, edges = InteractiveSimulation(body, tools_for(body), budget_s=BUDGET_S, delay_s=DELAY_S), blades(body)
    times = Times()
    for _ in range(SETTLE):
        frame(simulation, times)
    for name in order:
        times, whole, began = Times(), time.process_time(), time.perf_counter()
        simulation.begin_cut(edges[name])
        while not frame(simulation, times):
            pass
        print(
            f"  {name}: {len(simulation.body.cells)} cells, opens after {time.perf_counter() - began:.1f} s "
            f"({time.process_time() - whole:.1f} s of the processor); frames until then p99 {np.quantile(times.frames, 0.99):.0f}, "
            f"worst {max(times.frames):.0f} ms",
            flush=True,
        )
        times = Times()
        for _ in range(BEHIND):
            frame(simulation, times)
        print(f"    behind it: {times}", flush=True)
    simulation.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--body", default="demo")
    parser.add_argument("--friction", type=float, default=0.0, help="between the sides of cuts")
    parser.add_argument("--order", choices=ORDERS, help="one order of cuts; by default all of them")
    given = parser.parse_args()
    body = replace(body_named(given.body), lips_friction=given.friction, gravity=np.array([0.0, 0.0, -9810.0]))
    compile_for_cuts()
    print(f"{given.body}: {body.mesh.n_cells} cells, {body.mesh.n_points} nodes")
    for order in [given.order] if given.order else ORDERS:
        print(order)
        cut_in_order(body, order.split())


if __name__ == "__main__":
    main()
