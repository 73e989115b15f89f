"""How long a step of a lattice in contact takes, and how smooth and how independent of the mesh the force of a sphere is.

A cube of dough of 80 mm on a held floor; a sphere goes down into it and then to and fro, with friction, in a session of steps of 1 ms that
are called one by one. Percentiles are over single steps, beside those of the same lattice without a sphere; `cpu` is the time of the
processor, `wall` that of the clock, which on a shared machine counts what others do. The curves are those of a sphere that goes 5 mm deep
in 1 s, at several places over a face of 9^3 nodes, and with several radii: the largest change of the force in one of 250 steps, and the
largest difference from 17^3 nodes, as fractions of the range; the force of the first step, which is that of the dashpots, is told by
itself. With a given pressure (Hertz's, of several radii) in place of a sphere there is no contact to be found: how much the two lattices
differ then is due to the lattices alone, and how much they differ with the foundations of the contact shows what these make up for.

Run: ``OMP_NUM_THREADS=1 python benchmarks/contact_steps.py [--sizes 8,16] [--steps 1500] [--curves] [--given]``.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterable

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from naibu.core.arrays import FloatArray
from naibu.mechanics import IndenterVelocity, LatticeEngine, box_mask, classic_lattice, lattice_parameters, spherical_indenter
from naibu.mechanics.lattices.model.contact_surface import PER_RADIUS, SHARED, THINNEST
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.workflows.interactive.touchable_models import LATTICE_TOLERANCE

SIDE_MM, MASS_KG, STEP_S = 80.0, 0.63, 1e-3
CLASSES = ("short", "normal", "long")
PLACES = (("node", (40.0, 40.0)), ("edge", (40.0, 45.0)), ("quarter", (42.5, 42.5)), ("middle", (45.0, 45.0)))
PLACES += tuple((f"{x}, {y}", (x, y)) for x, y in ((41.3, 43.7), (43.3, 46.1), (44.0, 42.0)))
DOUGH = ((60.0, 40.0, 25.0), (30.0, 18.0, 12.0), (2000.0, 1500.0, 1000.0))  # of the bundled studies, at a spacing of 10 mm


def dough(n: int, step: float, tolerance: float) -> LatticeEngine:
    """Return a cube of n^3 voxels whose elements are as stiff as their length asks for."""
    spacing = SIDE_MM / n
    lattice = classic_lattice(box_mask((n,) * 3), spacing, total_mass_kg=MASS_KG)
    values = [dict(zip(CLASSES, (v * spacing / 10.0 for v in row), strict=True)) for row in DOUGH]
    return LatticeEngine.of(lattice, lattice_parameters(lattice, *values), step=step, tolerance=tolerance)


def held(engine: LatticeEngine) -> ConstrainedNodes:
    return ConstrainedNodes.of(np.flatnonzero(engine.lattice.points[:, 2] < 1e-9))


def hand(t: float) -> FloatArray:
    """Velocity of the sphere, mm/s: down 5 mm in half a second, then to and fro."""
    return np.array([0.0, 0.0, -10.0]) if t < 0.5 else np.array([40.0 * np.cos(5.0 * t), 30.0 * np.sin(4.0 * t), 10.0 * np.sin(9.0 * t)])


def timed(step: Callable[[int], object], steps: int) -> FloatArray:
    """Return times of the processor and of the clock (2, steps), ms."""
    taken = np.empty((2, steps))
    for n in range(steps):
        start, began = time.thread_time(), time.perf_counter()
        step(n)
        taken[:, n] = time.thread_time() - start, time.perf_counter() - began
    return 1e3 * taken


def row(name: str, taken: FloatArray, told: str = "") -> None:
    found = [f"{unit}: least {a:.3f}, median {b:.3f}, p99 {c:.3f}" for unit, (a, b, c) in _quantiles(taken)]
    print(f"  {name:24s} {'   '.join(found)} ms   {told}", flush=True)


def _quantiles(taken: FloatArray) -> Iterable[tuple[str, FloatArray]]:
    return zip(("cpu", "wall"), np.quantile(taken, (0.0, 0.5, 0.99), axis=1).T, strict=True)


def sessions(n: int, steps: int, radius: float, tolerance: float) -> None:
    engine = dough(n, STEP_S, tolerance)
    print(f"{n + 1}^3 nodes, sphere of {radius:g} mm, tolerance of the solver {tolerance:g}")
    with engine.session(constrained=held(engine)) as free:
        free.step(steps=5)
        row("no sphere", timed(lambda k: free.step(), steps))
    taken, forces, told = pushed(engine, steps, radius)
    row("sphere, with friction", taken, told)
    exact = pushed(dough(n, STEP_S, 1e-4), steps, radius)[1]
    apart = np.linalg.norm(forces - exact, axis=1) / np.linalg.norm(exact, axis=1).max()
    root, most = np.sqrt((apart**2).mean()), apart.max()
    print(
        f"  forces beside those of tolerance 0.0001, of the largest: {root:.1e} (rms), p99 {np.quantile(apart, 0.99):.1e}, most {most:.1e}"
    )


def pushed(engine: LatticeEngine, steps: int, radius: float) -> tuple[FloatArray, FloatArray, str]:
    """Return the times of steps (2, steps), ms, the forces of the sphere (steps, 3), mN, and what is told of the solver."""
    ball = spherical_indenter((40.0, 40.0, SIDE_MM + radius), radius, static_friction=0.3, kinetic_friction=0.3)
    forces = np.empty((steps, 3))
    with engine.session(constrained=held(engine), indenters=[ball]) as session:
        session.step(motions=[IndenterVelocity()], steps=5)
        before = session.iterations

        def step(k: int) -> None:
            forces[k] = session.step(motions=[IndenterVelocity(hand(k * STEP_S))]).indenters[0, 0]

        taken = timed(step, steps)
        return taken, forces, f"{(session.iterations - before) / steps:.1f} iterations, {session.unsettled} unsettled"


def curve(n: int, radius: float, place: tuple[float, float], steps: int = 250) -> FloatArray:
    engine = dough(n, 1.0 / steps, 1e-3)
    ball = spherical_indenter((*place, SIDE_MM + radius), radius)
    with engine.session(constrained=held(engine), indenters=[ball]) as session:
        return -np.array([session.step(motions=[IndenterVelocity((0.0, 0.0, -5.0))]).indenters[0, 0, 2] for _ in range(steps)])


def curves() -> None:
    print("force of a sphere that goes 5 mm deep: largest step, and difference from a mesh twice as fine, % of the range")
    for radius in (10.0, 5.0, 7.0, 15.0, 25.0):
        for name, place in PLACES if radius <= 10.0 else PLACES[:4]:
            coarse, fine = curve(8, radius, place), curve(16, radius, place)
            step, apart = np.abs(np.diff(coarse)).max() / np.ptp(coarse), (coarse - fine) / np.ptp(fine)
            between = f"{100 * apart.min():6.2f} .. {100 * apart.max():5.2f}   first step {100 * coarse[0] / np.ptp(coarse):5.2f}"
            print(f"  radius {radius:4g} mm over {name:10s} step {100 * step:5.2f}   difference {between}", flush=True)


def given() -> None:
    """Print how much less 9^3 nodes yield to a given pressure than 17^3, without and with the foundations."""
    print("yield of 9^3 nodes to Hertz's pressure, % from that of 17^3: lattices alone, and with their foundations")
    bodies = [(n, *_elastic(n)) for n in (8, 16)]
    for name, place in PLACES[:4]:
        row = []
        for radius in (3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0):
            alone, standing = np.array([_yields(n, inverse, stiffness, place, radius) for n, inverse, stiffness in bodies]).T
            row.append(f"{radius:g} mm {100 * (alone[0] / alone[1] - 1):5.1f} {100 * (standing[0] / standing[1] - 1):4.1f}")
        print(f"  {name:8s} {'   '.join(row)}", flush=True)


def _elastic(n: int) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """Return what solves for the displacements of the top under forces upon it, without dashpots, and the stiffness of a foundation."""
    engine = dough(n, STEP_S, 1e-3)
    lattice, stiffness = engine.lattice, engine.parameters.stiffness
    i, j = lattice.elements.T
    along = lattice.points[j] - lattice.points[i]
    along /= np.linalg.norm(along, axis=1)[:, None]
    columns = np.concatenate([3 * end[:, None] + np.arange(3) for end in (j, i)], axis=1)
    rows = np.repeat(np.arange(len(i)), 6)
    lengthening = sp.csr_matrix((np.hstack([along, -along]).ravel(), (rows, columns.ravel())), shape=(len(i), 3 * lattice.n_nodes))
    free = np.flatnonzero(np.repeat(lattice.points[:, 2] > 1e-9, 3))
    factors = splu((lengthening.T @ sp.diags(stiffness) @ lengthening)[free][:, free].tocsc())
    height = np.searchsorted(free, 3 * np.flatnonzero(lattice.points[:, 2] > SIDE_MM - 1e-9) + 2)

    def solved(force: FloatArray) -> FloatArray:
        whole = np.zeros(len(free))
        whole[height] = force
        return np.asarray(factors.solve(whole)[height])

    surface = engine.surface()
    middle = np.abs(surface.points[surface.faces].mean(axis=1) - [SIDE_MM / 2, SIDE_MM / 2, SIDE_MM]).max(axis=1)
    return solved, float(surface.parameters.stiffness[np.argmin(middle)])


def _yields(
    n: int, solved: Callable[[FloatArray], FloatArray], stiffness: float, place: tuple[float, float], radius: float
) -> tuple[float, float]:
    """Return how far Hertz's pressure sinks in on average, per force, mm/mN: alone, and with the foundations."""
    edge = SIDE_MM / n
    nodes, weights = np.polynomial.legendre.leggauss(24)
    r, angle = np.meshgrid(0.5 * radius * (nodes + 1.0), (np.arange(64) + 0.5) * np.pi / 32, indexing="ij")
    area = (r * 0.5 * radius * weights[:, None] * np.pi / 32).ravel()
    pressure = 1.5 / (np.pi * radius**2) * np.sqrt(1.0 - (r.ravel() / radius) ** 2)
    at = (np.stack([r * np.cos(angle), r * np.sin(angle)], axis=2).reshape(-1, 2) + place) / edge
    cell = at.astype(np.int64)
    s, t = (at - cell).T
    shape = np.stack([(1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t], axis=1)
    node = (cell[:, :1] + [0, 0, 1, 1]) * (n + 1) + cell[:, 1:] + [0, 1, 0, 1]
    count = (n + 1) ** 2
    force = np.bincount(node.ravel(), (shape * (pressure * area)[:, None]).ravel(), count)
    covered = np.bincount(node.ravel(), (shape * area[:, None]).ravel(), count)
    both = np.zeros((count, count))
    for a in range(4):
        for b in range(4):
            np.add.at(both, (node[:, a], node[:, b]), shape[:, a] * shape[:, b] * area)
    carried = np.linalg.solve((1.0 - SHARED) * np.eye(count) + SHARED * both / edge**2, SHARED * force / edge**2)
    thickness = np.sqrt(THINNEST**2 + PER_RADIUS**2 * covered[node].sum(axis=1) / np.pi / edge**2)
    own = pressure - (shape * carried[node]).sum(axis=1)
    alone = float(force @ solved(force))
    return alone, alone + float((pressure * area * thickness * own).sum()) / stiffness


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sizes", default="8,16", help="voxels an edge")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--radius", type=float, default=10.0)
    parser.add_argument("--tolerance", type=float, default=LATTICE_TOLERANCE, help="of the solver; by default that of naibu live")
    parser.add_argument("--curves", action="store_true")
    parser.add_argument("--given", action="store_true", help="a given pressure instead of a sphere; no steps are timed")
    chosen = parser.parse_args()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(f"{os.cpu_count()} cores, load {load:.1f} at the start")
    if chosen.given:
        given()
        return
    for n in [int(size) for size in chosen.sizes.split(",")]:
        sessions(n, chosen.steps, chosen.radius, chosen.tolerance)
    if chosen.curves:
        curves()


if __name__ == "__main__":
    main()
