"""Whether a haptic device is served at 1 kHz: gaps between answers, delays, force steps and energy with lost and reordered packets.

A simulated device in a process of its own leads the sphere of a live lattice by UDP on the loopback interface: down into the body, then to
and fro in it. Answers and poses are lost and overtaken, both ways. Percentiles are over all answers; a gap is the time between two answers
that the device applied. What of it is the device's own is told apart: a pause is the time between two answers as they reached the machine's
side of the line, lost ones among them, whenever the device read them; and lateness is by how much the device itself was late. Both threads
ask to be scheduled first, which a system permits or not.

Run: ``OMP_NUM_THREADS=1 python benchmarks/haptics.py [--seconds 60] [--loss 0.01] [--reordering 0.01] [--nodes 9] [--gel]``; ``--gel``
takes a cube of finite elements in place of the lattice, which is felt between its steps of 1/60 s.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import socket
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, LatticeEngine, box_mask, classic_lattice, elements, lattice_mesh, lattice_parameters, material
from naibu.meshing import boundary_faces, box, to_tetra
from naibu.simulation import FiniteElementBody, ForceLimits, LatticeBody, SimulatedDevice
from naibu.simulation.haptics.thread_priority import scheduled_first
from naibu.workflows import DeviceRecord, TouchableModel, drive_live_simulation, touched_loop
from naibu.workflows.interactive.touchable_models import LATTICE_STEP_S, LATTICE_TOLERANCE

EDGE_MM = 80.0


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
    engine = LatticeEngine.of(lattice, parameters, step=LATTICE_STEP_S, tolerance=LATTICE_TOLERANCE)
    return LatticeBody(engine, boundary_faces(tetra).faces, tetra.cells, lowest)


def gel(nodes: int) -> FiniteElementBody:
    """A cube of finite elements whose floor is held."""
    mesh = to_tetra(box((EDGE_MM,) * 3, (nodes - 1,) * 3))
    law = material(young_modulus=10.0, poisson_ratio=0.45)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    return FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(mesh.points[:, 2] < 1e-9).astype(np.int64))


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def stolen_s() -> float:
    """Return the time of processors that the machine below a virtual one has taken so far, s; 0 where the system does not tell."""
    told = Path("/proc/stat")
    return int(told.read_text().split()[8]) / os.sysconf("SC_CLK_TCK") if told.exists() else 0.0


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
    parser.add_argument("--gel", action="store_true")
    given = parser.parse_args()
    body = gel(given.nodes) if given.gel else cube(given.nodes)
    model, port, limits = TouchableModel("Cube", (), body, "strain, %"), free_port(), ForceLimits()
    with multiprocessing.get_context("spawn").Pool(1) as pool, touched_loop(model, port) as loop:
        pool.apply(os.getpid)  # imported
        pool.apply(driven, (port, 1.0, 0.0, 0.0))  # compiled
        stolen = stolen_s()
        record = pool.apply(driven, (port, given.seconds, given.loss, given.reordering))
        stolen = stolen_s() - stolen
        steps = loop.latest()[1].steps_per_s
    with scheduled_first() as permitted:
        pass
    shares = (50.0, 99.0, 99.9, 100.0)
    print(f"{given.nodes}^3 nodes, {given.seconds:g} s, {record.sent} poses, {len(record.heard_s)} answers applied, {os.cpu_count()} cores")
    print(f"lost {given.loss:.1%}, reordered {given.reordering:.1%} each way; {record.overtaken} answers overtaken")
    print(f"steps a second at the end: {steps:.0f}")
    for name, values in (
        ("gap, ms", 1e3 * record.gaps_s),
        ("pause, ms", 1e3 * record.arrival_gaps_s),
        ("lateness, ms", 1e3 * record.late_s),
        ("pose to force, ms", 1e3 * record.delays_s),
        ("force step, mN", record.steps_mn),
    ):
        found = "   ".join(f"{share:g} % {value:.3f}" for share, value in zip(shares, np.percentile(values, shares), strict=True))
        print(f"{name:18s} {found}")
    above = [int((values > 5e-3).sum()) for values in (record.gaps_s, record.arrival_gaps_s, record.late_s)]
    print(f"above 5 ms: {above[0]} gaps, {above[1]} pauses of the simulation, {above[2]} times the device was late")
    told = f"scheduled first: {'yes' if permitted else 'no'}; taken by the machine below a virtual one: {stolen:.2f} s"
    print(f"load {os.getloadavg()[0]:.1f}; {told}")
    print(f"answers that found no pose for 100 ms: {int(record.stale.sum())}")
    print(f"limit of a step {limits.step_mn:g} mN; steps above it: {int((record.steps_mn > limits.step_mn * (1 + 1e-9)).sum())}")
    print(f"largest force {np.linalg.norm(record.forces, axis=1).max():.0f} mN, limit {limits.force_mn:g}")
    print(f"energy to the device: at most {record.most_work:.1f} mN mm (bound {limits.energy_mn_mm:g}), {record.work:.0f} in the end")


if __name__ == "__main__":
    main()
