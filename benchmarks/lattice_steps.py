"""How long a step of a lattice takes: explicit and implicit, classic and octree, beside a plain loop and NumPy; jitter; gradients.

A cube of 80 mm and 630 g with 9^3, 17^3 and 33^3 nodes. The references take the explicit Euler step of the same elements: one in
NumPy, one as a plain Numba loop over the elements on one thread, as one would write it first. Each time is the least over many repeats,
and that of a step in a long call, without what the call itself costs; `cpu` is the time of the processor (all threads), `wall` that of
the clock, which on a shared machine counts what others do. Rows of sessions are single steps, called one by one, with all that a call
costs. Jitter is that of a session's single steps while another process keeps a core busy, one after the other or a thousand in a second.

Run: ``MKL_NUM_THREADS=1 OMP_NUM_THREADS=2 python benchmarks/lattice_steps.py [--sizes 8,16,32] [--repeats 20]
[--construction] [--octrees]``.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numba
import numpy as np

from naibu.mechanics.lattices.cpu.element_blocks import Blocks
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.session import LatticeSession
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.simulation.adjoint import push_gradient, recorded_push

SIDE_MM, MASS_KG, STEP_S = 80.0, 0.63, 2e-3
STEPS = {8: 500, 16: 100}  # in a call, by voxels an edge; 20 of larger ones
GENTLE = (0.03, 0.002, 0.003)  # K, C1, C2 for which explicit steps of 2 ms are stable
STIFF = (10.0, 5.0, 10.0)  # within the printed ranges, read in g/s^2 and g/s; far beyond what explicit steps of 2 ms allow


def least(action: Callable[[], object], steps: int, repeats: int) -> tuple[float, float]:
    """Return the least processor and wall time of a step, ms."""
    action()
    cpu = wall = np.inf
    for _ in range(repeats):
        start, began = time.process_time(), time.perf_counter()
        action()
        cpu, wall = min(cpu, time.process_time() - start), min(wall, time.perf_counter() - began)
    return 1e3 * cpu / steps, 1e3 * wall / steps


def row(name: str, cpu: float, wall: float, told: str = "") -> None:
    print(f"  {name:42s} cpu {cpu:9.4f}   wall {wall:9.4f} ms   {told}", flush=True)


@numba.njit(cache=True)
def plain_loop(i, j, a, b, d, g, mass, x, v, y, step, steps):  # type: ignore[no-untyped-def]
    force = np.zeros_like(x)
    for _ in range(steps):
        force[:] = 0.0
        for e in range(len(i)):
            p, q = i[e], j[e]
            d0, d1, d2 = x[q, 0] - x[p, 0], x[q, 1] - x[p, 1], x[q, 2] - x[p, 2]
            length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            rate = ((v[q, 0] - v[p, 0]) * d0 + (v[q, 1] - v[p, 1]) * d1 + (v[q, 2] - v[p, 2]) * d2) / length
            tension = (a[e] * rate + b[e] * y[e]) / length
            y[e] += step * (d[e] * rate - g[e] * y[e])
            for axis, along in ((0, d0), (1, d1), (2, d2)):
                force[p, axis] += tension * along
                force[q, axis] -= tension * along
        for k in range(len(x)):
            for axis in range(3):
                x[k, axis] += step * v[k, axis]
                v[k, axis] += step * force[k, axis] / mass[k]


def numpy_steps(lattice: Lattice, coefficients: tuple[np.ndarray, ...], steps: int) -> None:
    i, j = lattice.elements.T
    a, b, d, g = coefficients
    x, v, y = lattice.points.copy(), np.zeros_like(lattice.points), np.zeros(len(i))
    for _ in range(steps):
        along = x[j] - x[i]
        length = np.linalg.norm(along, axis=1)
        along /= length[:, None]
        rate = ((v[j] - v[i]) * along).sum(axis=1)
        pull = (a * rate + b * y)[:, None] * along
        y += STEP_S * (d * rate - g * y)
        force = [np.bincount(i, pull[:, k], lattice.n_nodes) - np.bincount(j, pull[:, k], lattice.n_nodes) for k in range(3)]
        x, v = x + STEP_S * v, v + STEP_S * np.stack(force, axis=1) / lattice.node_mass[:, None]


def pushed(lattice: Lattice) -> tuple[ConstrainedNodes, np.ndarray]:
    """Return a floor that holds the lowest nodes and a stamp of 20 mm on the top, and their velocities."""
    x, y, z = lattice.points.T
    stamp = (z > SIDE_MM - 0.1) & (np.abs(x - 40.0) < 10.1) & (np.abs(y - 40.0) < 10.1)
    return ConstrainedNodes.of(np.flatnonzero(z < 0.1), 0) + ConstrainedNodes.of(np.flatnonzero(stamp), 1), np.array(
        [[0, 0, 0], [0, 0, -20.0]]
    )


def timed(lattice: Lattice, parameters: LatticeParameters, steps: int, repeats: int, **options: object) -> tuple[float, float, float]:
    engine = LatticeEngine.of(lattice, parameters, step=STEP_S, **options)  # type: ignore[arg-type]
    constrained, velocity = pushed(lattice)
    start = engine.rest()
    start = engine.run(start, steps, constrained, velocity).state  # not from rest
    iterations = engine.run(start, steps, constrained, velocity).iterations
    call = least(lambda: engine.run(start, 0, constrained, velocity), 1, repeats)
    whole = least(lambda: engine.run(start, steps, constrained, velocity), 1, repeats)
    return (whole[0] - call[0]) / steps, (whole[1] - call[1]) / steps, iterations


def in_session(lattice: Lattice, parameters: LatticeParameters, steps: int, repeats: int, **options: object) -> tuple[float, float]:
    constrained, velocity = pushed(lattice)
    with LatticeSession.of(LatticeEngine.of(lattice, parameters, step=STEP_S, **options), constrained=constrained) as session:  # type: ignore[arg-type]

        def one_by_one() -> None:
            for _ in range(steps):
                session.step(velocity)

        return least(one_by_one, steps, repeats)


def references(lattice: Lattice, parameters: LatticeParameters, steps: int, repeats: int) -> tuple[float, float]:
    """Print the rows of NumPy and of a plain loop, and return the latter's times."""
    c = explicit_coefficients(parameters)
    few = max(2, 1600 // round(lattice.n_nodes ** (1 / 3)) // 8)
    row("NumPy, explicit", *least(lambda: numpy_steps(lattice, c, few), few, max(2, repeats // 6)))
    i, j = (np.ascontiguousarray(e) for e in lattice.elements.T)

    def loop() -> None:
        x, y = lattice.points.copy(), np.zeros(lattice.n_elements)
        plain_loop(i, j, *c, lattice.node_mass, x, np.zeros_like(x), y, STEP_S, steps)

    found = least(loop, steps, repeats)
    row("plain Numba loop, explicit, double", *found)
    return found


def sizes(n: int, repeats: int) -> None:
    lattice = classic_lattice(box_mask((n,) * 3), SIDE_MM / n, total_mass_kg=MASS_KG)
    gentle, stiff = lattice_parameters(lattice, *(p * 8.0 / n for p in GENTLE)), lattice_parameters(lattice, *STIFF)
    steps = STEPS.get(n, 20)
    print(f"{n + 1}^3 nodes, {lattice.n_elements} elements")
    reference = references(lattice, gentle, steps, repeats)
    thread_counts = (1, 2) if lattice.n_elements >= 20_000 else (1,)
    for precision in ("double", "single"):
        for threads in thread_counts:
            cpu, wall, _ = timed(lattice, gentle, steps, repeats, method="euler", precision=precision, threads=threads)
            told = f"plain loop over this: {reference[threads > 1] / (cpu, wall)[threads > 1]:.2f}"
            row(f"explicit, {precision}, {threads} thread(s)", cpu, wall, told)
    for threads in thread_counts:
        row(f"explicit, session, {threads} thread(s)", *in_session(lattice, gentle, steps, repeats, method="euler", threads=threads))
    constrained, velocity = pushed(lattice)
    engine = LatticeEngine.of(lattice, gentle, method="euler", threads=1)
    state = engine.rest()
    row(
        "run without steps",
        *least(lambda: engine.run(state, 0, constrained, velocity), 1, repeats),
        "conversion of the state, not in the rows",
    )
    few = max(5, steps // 5)
    for threads in thread_counts:
        cpu, wall, iterations = timed(lattice, stiff, few, max(2, repeats // 4), threads=threads)
        row(f"implicit, {threads} thread(s)", cpu, wall, f"{iterations:.1f} iterations")
    row("implicit, session, 1 thread", *in_session(lattice, stiff, few, max(2, repeats // 4), threads=1))
    octrees(n, lattice, steps, repeats)


def construction(n: int) -> None:
    """Print the processor time of a classic lattice, its parameters and an explicit engine, and the memory after it."""

    def built(n: int) -> list[float]:
        times = [time.process_time()]
        lattice = classic_lattice(box_mask((n,) * 3), SIDE_MM / n, total_mass_kg=MASS_KG)
        times.append(time.process_time())
        parameters = lattice_parameters(lattice, *(p * 8.0 / n for p in GENTLE))
        times.append(time.process_time())
        LatticeEngine.of(lattice, parameters, method="euler")
        return [*times, time.process_time()]

    built(4)  # compiles
    found = np.diff(built(n))
    print(
        f"construction of {n + 1}^3: lattice {found[0]:.2f}, parameters {found[1]:.2f}, engine {found[2]:.2f}, all {found.sum():.2f} s",
        end="",
    )
    print(f", most memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GB", flush=True)


def octrees(n: int, lattice: Lattice, steps: int, repeats: int) -> None:
    def gentle(of: Lattice) -> LatticeParameters:
        return lattice_parameters(of, *(p * 8.0 / n for p in GENTLE))

    classic, wall, _ = timed(lattice, gentle(lattice), steps, repeats, method="euler", threads=1)
    regular = Blocks.of(lattice).n_blocks
    told = f"{classic / regular * 1e6:.1f} ns a block, of whose eight places {lattice.n_elements / (8 * regular):.2f} are filled"
    row(f"classic {n + 1}^3, explicit, 1 thread", classic, wall, told)
    for kind in (0, 1, 2):
        octree = octree_lattice(box_mask((n,) * 3), SIDE_MM / n, kind, total_mass_kg=MASS_KG)
        cpu, wall, _ = timed(octree, gentle(octree), steps, repeats, method="euler", threads=1)
        blocks = Blocks.of(octree).n_blocks
        told = f"of classic: time {cpu / classic:.3f}, elements {octree.n_elements / lattice.n_elements:.3f}, "
        told += f"blocks {blocks / regular:.3f}, of whose eight places {octree.n_elements / (8 * blocks):.2f} are filled"
        row(f"octree type {kind}, explicit, 1 thread", cpu, wall, told)


def jitter(n: int, rate: float, **options: object) -> None:
    """Print how much single steps of a session differ while a core is busy, in a tight loop or at a rate, Hz."""
    lattice = classic_lattice(box_mask((n,) * 3), SIDE_MM / n, total_mass_kg=MASS_KG)
    factors = STIFF if options["method"] == "implicit" else tuple(p * 8.0 / n for p in GENTLE)
    constrained, velocity = pushed(lattice)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, *factors), step=STEP_S, **options)  # type: ignore[arg-type]
    with LatticeSession.of(engine, constrained=constrained) as session:
        session.step(velocity, steps=5)
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        try:
            taken, due = [], time.perf_counter()
            for _ in range(3000 if n < 32 else 600):
                due = max(due + 1.0 / rate, time.perf_counter()) if rate else 0.0
                time.sleep(max(due - time.perf_counter(), 0.0)) if rate else None
                start = time.perf_counter()
                session.step(velocity)
                taken.append(time.perf_counter() - start)
        finally:
            busy.kill()
            busy.wait()
    middle, late, worst = 1e3 * np.quantile(taken, (0.5, 0.99, 1.0))
    told = ", ".join(f"{key} {value}" for key, value in options.items())
    loop = f"{rate:g} Hz" if rate else "tight loop"
    print(f"  jitter {n + 1}^3, {told}, {loop}: median {middle:.3f}, p99 - median {late - middle:.3f}, worst {worst:.3f} ms", flush=True)


def gradients(repeats: int) -> None:
    lattice = classic_lattice(box_mask((8, 8, 8)), 10.0, total_mass_kg=MASS_KG)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, *GENTLE), step=STEP_S, method="symplectic_euler")
    constrained, velocity = pushed(lattice)
    path = np.zeros((2500, 2, 3))
    path[:500] = velocity

    def gradient() -> float:
        push = recorded_push(engine, engine.rest(), [500, 1000, 1500, 2000, 2500], constrained, path)
        push_gradient(push, push.positions - lattice.points, push.reaction)
        return push.memory_mb

    cpu, wall = least(gradient, 1, max(3, repeats // 3))
    print(f"gradient of 2500 steps at 9^3: cpu {cpu / 1e3:.3f}, wall {wall / 1e3:.3f} s, states {gradient():.1f} MB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sizes", default="8,16,32", help="voxels an edge")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--construction", action="store_true", help="only how long lattices and engines take to be made")
    parser.add_argument("--octrees", action="store_true", help="only explicit steps of octrees beside those of the regular lattice")
    asked = parser.parse_args()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(f"{os.cpu_count()} cores, Numba threads {numba.get_num_threads()}, load {load:.1f} at the start")
    chosen = [int(n) for n in asked.sizes.split(",")]
    if asked.construction:
        for n in chosen:
            construction(n)
        return
    if asked.octrees:
        for n in chosen:
            lattice = classic_lattice(box_mask((n,) * 3), SIDE_MM / n, total_mass_kg=MASS_KG)
            octrees(n, lattice, STEPS.get(n, 20), asked.repeats)
        return
    for n in chosen:
        sizes(n, asked.repeats)
    gradients(asked.repeats)
    for n in chosen:
        for rate in (0.0, 1000.0):
            for threads in (1, 2) if n > 8 else (1,):
                jitter(n, rate, method="euler", threads=threads)
            if n < 32:
                jitter(n, rate, method="implicit", threads=1)
    print(
        f"load {os.getloadavg()[0] if hasattr(os, 'getloadavg') else float('nan'):.1f} at the end, the busy process of the jitter included"
    )


if __name__ == "__main__":
    main()
