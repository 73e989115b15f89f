"""Whether a haptic device is served at 1 kHz: gaps between answers, delays, force steps and energy with lost and reordered packets.

A simulated device in a process of its own leads the sphere of a live lattice by UDP on the loopback interface: down into the body, then to
and fro in it. Answers and poses are lost and overtaken, both ways. Percentiles are over all answers; a gap is the time between two answers
that the device applied.

Run: ``OMP_NUM_THREADS=1 python benchmarks/haptics.py [--seconds 60] [--loss 0.01] [--reordering 0.01] [--nodes 9]``.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics import LatticeEngine, box_mask, classic_lattice, lattice_mesh, lattice_parameters
from naibu.meshing import boundary_faces, to_tetra
from naibu.simulation import LatticeBody, SimulatedDevice
from naibu.workflows import DeviceRecord, TouchableModel, drive_live_simulation, touched_loop

EDGE_MM = 80.0
STEP_S = 1e-3


def hand(t: float) -> FloatArray:
    """Where the hand is led, mm, from where the tool waits."""
    down = 0.28 * EDGE_MM * min(t, 1.0)
    return np.array([8.0 * np.sin(2.0 * t), 6.0 * np.sin(3.1 * t), -down - 6.0 * np.sin(5.0 * t)])


def cube(nodes: int) -> LatticeBody:
    """A cube of 630 g whose floor is held."""
    lattice = classic_lattice(box_mask((nodes - 1,) * 3), EDGE_MM / (nodes - 1), total_mass_kg=0.63)
    classes = ("short", "normal", "long")
    parameters = lattice_parameters(lattice, dict.fromkeys(classes, 10.0), dict.fromkeys(classes, 5.0), dict.fromkeys(classes, 10.0))
    tetra = to_tetra(lattice_mesh(lattice))
    lowest = np.flatnonzero(lattice.points[:, 2] < 1e-9)
    return LatticeBody(LatticeEngine.of(lattice, parameters, step=STEP_S), boundary_faces(tetra).faces, tetra.cells, lowest)


def driven(port: int, seconds: float, loss: float, reordering: float) -> DeviceRecord:
    """Lead the tool, in a process of its own."""
    gc.disable()
    return drive_live_simulation(SimulatedDevice(hand), port, seconds, loss=loss, reordering=reordering, seed=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--loss", type=float, default=0.01)
    parser.add_argument("--reordering", type=float, default=0.01)
    parser.add_argument("--nodes", type=int, default=9)
    given = parser.parse_args()
    model = TouchableModel("Cube", (), cube(given.nodes), "mean elongation, %")
    with multiprocessing.get_context("spawn").Pool(1) as pool, touched_loop(model, 0) as loop:
        pool.apply(os.getpid)  # imported
        assert loop.hand is not None
        limits, channel = loop.hand.limits, loop.hand.channel
        pool.apply(driven, (channel.port, 1.0, 0.0, 0.0))  # compiled
        record = pool.apply(driven, (channel.port, given.seconds, given.loss, given.reordering))
        steps, dropped = loop.latest()[1].steps_per_s, channel.datagrams.dropped
    shares = (50.0, 99.0, 99.9, 100.0)
    print(f"{given.nodes}^3 nodes, {given.seconds:g} s, {record.sent} poses, {len(record.heard_s)} answers applied, {os.cpu_count()} cores")
    print(
        f"lost {given.loss:.1%}, reordered {given.reordering:.1%} each way; {dropped['old']} poses and {record.overtaken} answers overtaken"
    )
    print(f"steps a second at the end: {steps:.0f}")
    for name, values in (
        ("gap, ms", 1e3 * record.gaps_s),
        ("pose to force, ms", 1e3 * record.delays_s),
        ("force step, mN", record.steps_mn),
    ):
        found = "   ".join(f"{share:g} % {value:.3f}" for share, value in zip(shares, np.percentile(values, shares), strict=True))
        print(f"{name:18s} {found}")
    print(f"gaps above 5 ms: {int((record.gaps_s > 5e-3).sum())}; answers that found no pose for 100 ms: {int(record.stale.sum())}")
    print(f"limit of a step {limits.step_mn:g} mN; steps above it: {int((record.steps_mn > limits.step_mn * (1 + 1e-9)).sum())}")
    print(f"largest force {np.linalg.norm(record.forces, axis=1).max():.0f} mN, limit {limits.force_mn:g}")
    print(f"energy to the device: at most {record.most_work:.1f} mN mm (bound {limits.energy_mn_mm:g}), {record.work:.0f} in the end")


if __name__ == "__main__":
    main()
