"""How long a step of a lattice takes on a device of Warp, beside the engine of the processor, and how far their results differ.

A cube of 80 mm and 630 g, its floor constrained, a stamp pressing on its top. Steps are those of one call on a state that stays on the
device; compilation, and the way of the state to the device and back, are not counted. Explicit steps are half as long as
`explicit_step_limit` allows. Bytes are those that an explicit step cannot avoid to move: the lists of neighbours with their rows of
coefficients and extensions, and the nodes once each.

Implicit steps on the device are also taken without the coarse levels of their preconditioner.

Run: ``python benchmarks/lattice_gpu.py [--device cuda:0] [--sizes 8,16,32,64,128] [--steps 100] [--no-cpu] [--no-implicit] [--record]``;
128 is the lattice of 129^3 nodes and 27 million elements, which takes a minute to build; the processor is left out from there on.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import warp
from records import Cell, ResultTable, write_record

from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.gpu.engine import WarpLatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, Motion, explicit_step_limit

SIDE_MM, MASS_KG = 80.0, 0.63
GENTLE = (0.03, 0.002, 0.003)  # K, C1, C2 at 9^3 nodes
STIFF = (10.0, 5.0, 10.0)
COLUMNS = ("nodes", "elements", "step", "where", "a step, ms", "iterations a step", "moved, GB/s")
LARGEST_ON_PROCESSOR = 64  # voxels an edge
ROWS: list[tuple[Cell, ...]] = []


def clocked(action: Callable[[], Any]) -> tuple[float, Any]:
    """Return the seconds that an action takes, and its result."""
    start = time.perf_counter()
    result = action()
    warp.synchronize()
    return time.perf_counter() - start, result


def least(action: Callable[[], Any], repeats: int) -> float:
    return min(clocked(action)[0] for _ in range(repeats))


def peak_gb() -> float:
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 2**20


def pushed(lattice: Lattice) -> tuple[ConstrainedNodes, np.ndarray]:
    """Return a floor and a stamp of 20 mm on the top, and their velocities."""
    x, y, z = lattice.points.T
    stamp = (z > SIDE_MM - 0.1) & (np.abs(x - 40.0) < 10.1) & (np.abs(y - 40.0) < 10.1)
    return ConstrainedNodes.of(np.flatnonzero(z < 0.1), 0) + ConstrainedNodes.of(np.flatnonzero(stamp), 1), np.array(
        [[0, 0, 0], [0, 0, -20.0]]
    )


def differences(one: Motion, other: Motion) -> str:
    moved = np.abs(other.state.position - other.state.position[0]).max()
    position = np.abs(one.state.position - other.state.position).max() / moved
    reaction = np.abs(one.reaction - other.reaction).max() / np.abs(other.reaction).max()
    return f"position {position:.1e}, reaction {reaction:.1e}"


def row(lattice: Lattice, kind: str, where: str, seconds: float, told: str, iterations: Cell = "", speed: Cell = "") -> None:
    print(f"  {where + ', ' + kind:58s} {1e3 * seconds:10.4f} ms a step   {told}", flush=True)
    ROWS.append((lattice.n_nodes, lattice.n_elements, kind, where, 1e3 * seconds, iterations, speed))


def explicit(lattice: Lattice, n: int, device: str, steps: int, repeats: int, cpu: bool) -> None:
    parameters = lattice_parameters(lattice, *(p * 8.0 / n for p in GENTLE))
    step = 0.5 * explicit_step_limit(lattice, parameters)
    constrained, velocity = pushed(lattice)
    for precision in ("double", "single"):
        options: dict[str, Any] = {"step": step, "method": "euler", "precision": precision}
        built, engine = clocked(lambda options=options: WarpLatticeEngine.of(lattice, parameters, device=device, **options))
        session = engine.session(None, constrained)
        session.step(velocity, steps=32)
        taken = least(lambda session=session: session.step(velocity, steps=steps), repeats) / steps
        entries, size = 2 * lattice.n_elements, 8 if precision == "double" else 4
        moved = entries * (4 + warp.types.type_size_in_bytes(engine.row.dtype) + 2 * size)
        moved += lattice.n_nodes * size * (6 + 3 + 3 + 1 + 12)
        speed = moved / taken / 1e9
        told = f"{moved / 1e9:.3f} GB, {speed:.1f} GB/s; prepared in {built:.1f} s"
        row(lattice, f"explicit, {precision}", device_name(device), taken, told, speed=speed)
        if not cpu:
            continue
        built, reference = clocked(lambda options=options: LatticeEngine.of(lattice, parameters, **options))
        start = reference.rest()
        least(lambda reference=reference, start=start: reference.run(start, 1, constrained, velocity), 1)
        call = least(lambda reference=reference, start=start: reference.run(start, 0, constrained, velocity), repeats)
        whole = least(lambda reference=reference, start=start: reference.run(start, steps, constrained, velocity), repeats)
        expected = reference.run(start, steps, constrained, velocity)
        told = f"{differences(engine.run(engine.rest(), steps, constrained, velocity), expected)} apart; prepared in {built:.1f} s"
        row(lattice, f"explicit, {precision}", f"processor, {reference.threads} thread(s)", (whole - call) / steps, told)


def implicit(lattice: Lattice, device: str, steps: int, repeats: int, cpu: bool) -> None:
    parameters = lattice_parameters(lattice, *STIFF)
    constrained, velocity = pushed(lattice)
    built, engine = clocked(lambda: WarpLatticeEngine.of(lattice, parameters, device=device))
    for levels in (engine, replace(engine, coarse=None)) if engine.coarse else (engine,):
        session = levels.session(None, constrained)
        session.step(velocity, steps=2)
        before = session.iterations
        taken = least(lambda session=session: session.step(velocity, steps=steps), repeats) / steps
        count = (session.iterations - before) / (steps * repeats)
        kind = f"implicit, {len(levels.coarse.levels) if levels.coarse else 'no'} coarse levels"
        row(lattice, kind, device_name(device), taken, f"{count:.1f} iterations; prepared in {built:.1f} s", count)
    if cpu:
        reference = LatticeEngine.of(lattice, parameters)
        start = reference.run(reference.rest(), 2, constrained, velocity).state
        call = least(lambda: reference.run(start, 0, constrained, velocity), repeats)
        whole = least(lambda: reference.run(start, steps, constrained, velocity), repeats)
        count = reference.run(start, steps, constrained, velocity).iterations
        row(lattice, "implicit", f"processor, {reference.threads} thread(s)", (whole - call) / steps, f"{count:.1f} iterations", count)


def device_name(device: str) -> str:
    return f"Warp {warp.__version__}, {warp.get_device(device).name}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--device", help="by default the first CUDA device, else the processor")
    parser.add_argument("--sizes", default="8,16,32", help="voxels an edge")
    parser.add_argument("--steps", type=int, default=96)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--no-cpu", action="store_true", help="leave out the engine of the processor")
    parser.add_argument("--no-implicit", action="store_true")
    parser.add_argument("--record", action="store_true")
    asked = parser.parse_args()
    warp.config.log_level = warp.LOG_WARNING
    cards = [f"{d.alias} {d.name}" for d in warp.get_cuda_devices()]
    print("CUDA devices: " + (", ".join(cards) or "none. What follows is Warp on the processor and says nothing about a GPU."))
    device = asked.device or ("cuda:0" if cards else "cpu")
    if asked.record and not device.startswith("cuda"):
        parser.error("--record keeps times of a GPU, and there is no CUDA device")
    cores = f"{os.cpu_count()} cores, Numba threads {numba.get_num_threads()}"
    print(f"Warp {warp.__version__}, {cores}, load {os.getloadavg()[0]:.1f} at the start")
    for n in (int(size) for size in asked.sizes.split(",")):
        built, lattice = clocked(lambda n=n: classic_lattice(box_mask((n,) * 3), SIDE_MM / n, total_mass_kg=MASS_KG))
        print(f"{n + 1}^3 nodes, {lattice.n_elements} elements, built in {built:.1f} s, peak {peak_gb():.2f} GB", flush=True)
        cpu = not asked.no_cpu and n <= LARGEST_ON_PROCESSOR
        explicit(lattice, n, device, asked.steps, asked.repeats, cpu)
        if not asked.no_implicit:
            implicit(lattice, device, max(asked.steps // 10, 2), asked.repeats, cpu)
        print(f"  peak {peak_gb():.2f} GB", flush=True)
        if asked.record:
            write_record("lattice_gpu", [ResultTable("steps", COLUMNS, tuple(ROWS))])


if __name__ == "__main__":
    main()
