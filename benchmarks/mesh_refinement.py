"""Bisection and adaptive models: cells a second, unknowns and time for an indentation force, and a motion, beside uniform meshes.

``rate``: 1000 marked tetrahedra, near each other or scattered, of meshes of Kuhn's cubes of growing size; new cells, and cells that are
joined again, a second (best of some repeats, wall time).

``indentation``: a block of 100 x 100 x 50 mm, fixed below, under a sphere of radius 20 mm that is pushed 2 mm into it without friction; a
quarter of it, linear elastic, Poisson's ratio 0.3. Its force on meshes refined for the error of that force, as it is and less its estimated
error (``corrected``), and on uniform ones. The reference is extrapolated from the last four adaptive meshes, without correction. Processor
time, that of all coarser meshes and of the estimates included; equilibria of coarser meshes are initial guesses.

``uniform``: the same force on uniform meshes of other numbers of cubes.

``dynamics``: the cuboid of the report's chapter 4.2 with neo-Hookean elements, bent by a force for 40 ms and released; implicit steps. Its
corner path on 1000 nodes (9 x 9 x 9 cubes), and on a mesh that begins with 125 and follows the error of the stress.

Run: ``MKL_NUM_THREADS=1 OMP_NUM_THREADS=1 python benchmarks/mesh_refinement.py [rate] [indentation] [uniform] [dynamics]``.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from naibu.core.mesh import Mesh
from naibu.mechanics.contact.rigid_indenters import spherical_indenter
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.meshing.primitives import box
from naibu.meshing.refinement.forest import BisectionForest
from naibu.simulation.adaptive.body import AdaptiveBody
from naibu.simulation.adaptive.conditions import Conditions, face_force
from naibu.simulation.adaptive.error_criterion import StressError
from naibu.simulation.adaptive.hyperelastic_dynamics import HyperelasticDynamics
from naibu.simulation.adaptive.statics import StaticResult, StaticSolve, hyperelastic_static, pressed_by, solve_adaptively

MARKED, REPEATS = 1000, 7
RADIUS_MM, DEPTH_MM, HEIGHT_MM = 20.0, 2.0, 50.0
UNIFORM_CUBES = (18, 20, 21, 22, 24, 27)
SIDE_MM, FORCE_MN, DENSITY, STEP_S, STEPS, TRIAL_STEPS = 100.0, 6e3, 1e-7, 2e-3, 40, 2


def rate() -> None:
    print(f"{MARKED} marked tetrahedra: million cells a second")
    print(f"{'mesh':>10s} {'marked':>10s} {'new':>7s} {'bisected':>9s} {'joined':>9s}")
    for n in (12, 26, 56):
        mesh = box((1, 1, 1), (n, n, n), cell_type="tetra", centred=False)
        forest = BisectionForest.of(mesh)
        centres = mesh.points[mesh.cells].mean(axis=1)
        near = np.argsort(np.linalg.norm(centres - 0.3, axis=1))[:MARKED]
        scattered = np.random.default_rng(0).choice(mesh.n_cells, MARKED, replace=False)
        for name, marked in (("near", near), ("scattered", scattered)):
            new, refining, coarsening = timed(forest, marked)
            print(f"{mesh.n_cells:10d} {name:>10s} {new:7d} {new / refining / 1e6:9.1f} {new / coarsening / 1e6:9.1f}", flush=True)


def timed(forest: BisectionForest, marked: np.ndarray) -> tuple[int, float, float]:
    """Return the number of new cells, and the least times in which they are made and joined again, s."""
    refining = coarsening = np.inf
    for _ in range(REPEATS):
        began = time.perf_counter()
        change = forest.refine(marked)
        refining = min(refining, time.perf_counter() - began)
        new = change.children.ravel()
        spent, count = 0.0, 0
        while True:  # the closure bisects some cells twice
            began = time.perf_counter()
            back = forest.coarsen(new)
            spent += time.perf_counter() - began
            if not back:
                break
            count += back.children.size
        assert count == len(new) and forest.n_cells == forest.n_roots
        coarsening = min(coarsening, spent)
    return len(new), refining, coarsening


def block(n: int) -> Mesh:
    """Return a quarter of the block, of n cubes along a side, below the middle of its upper face."""
    return box((50.0, 50.0, HEIGHT_MM), (n, n, n), cell_type="tetra", centred=False)


def forces(solve_on: StaticSolve, n: int, limit: int, **settings: float) -> tuple[np.ndarray, ...]:
    """Return unknowns, forces, forces less their errors, N, and times up to each of a sequence of meshes, s."""
    began, times = time.process_time(), []

    def clocked(mesh: Mesh, start: np.ndarray | None) -> StaticResult:
        found = solve_on(mesh, start)
        times.append(time.process_time() - began)
        return found

    found = solve_adaptively(block(n), clocked, tolerance=0.0, max_unknowns=limit, **settings)  # type: ignore[arg-type]
    name = "indenter 0"
    plain = np.array([-4.0 * r.reactions[name][2] / 1e3 for r in found.rounds])
    corrected = np.array([-4.0 * r.corrected_force(name)[2] / 1e3 for r in found.rounds])
    return np.array(found.unknowns, dtype=float), plain, corrected, np.array(times)


def pressing() -> StaticSolve:
    """Return what solves the indentation on a mesh, compiled."""
    law = material("linear_elastic", young_modulus=10.0, poisson_ratio=0.3)
    planes = tuple((lambda p, axis=axis: p[:, axis] < 1e-9, axis) for axis in range(2))
    sphere = spherical_indenter((0.0, 0.0, HEIGHT_MM + RADIUS_MM), RADIUS_MM)
    contacts = pressed_by([sphere], (0.0, 0.0, -DEPTH_MM), faces=lambda p: p[:, 2] > HEIGHT_MM - 1e-9)
    held = Conditions(lambda p: p[:, 2] < 1e-9, rollers=planes)
    solve_on = hyperelastic_static(held, [law], contacts=contacts, goal="force")
    solve_on(block(4), None)
    return solve_on


def uniform() -> None:
    solve_on = pressing()
    print("uniform meshes, each solved by itself")
    print(f"{'cubes':>6s} {'unknowns':>9s} {'force, N':>9s} {'corrected, N':>13s} {'time, s':>8s}")
    for n in UNIFORM_CUBES:
        began = time.process_time()
        found = solve_on(block(n), None)
        spent = time.process_time() - began
        plain, corrected = (-4.0 * f[2] / 1e3 for f in (found.reactions["indenter 0"], found.corrected_force("indenter 0")))
        print(f"{n:6d} {found.displacement.size:9d} {plain:9.4f} {corrected:13.4f} {spent:8.1f}", flush=True)


def indentation(limit: int = 20_000, uniform_limit: int = 100_000) -> None:
    solve_on = pressing()
    adaptive = forces(solve_on, 4, limit, fraction=0.6)
    uniform = forces(solve_on, 9, uniform_limit, fraction=1.0, bisections=3)
    reference = np.polyfit(adaptive[0][-4:] ** (-2.0 / 3.0), adaptive[1][-4:], 1)[1]
    print(f"force of the sphere, reference {reference:.4f} N")
    print(f"{'mesh':>10s} {'unknowns':>9s} {'force, N':>9s} {'error, %':>9s} {'corrected, N':>13s} {'error, %':>9s} {'time, s':>8s}")
    for name, rows in (("adaptive", adaptive), ("uniform", uniform)):
        for unknowns, plain, corrected, spent in zip(*rows, strict=True):
            print(
                f"{name:>10s} {unknowns:9.0f} {plain:9.4f} {100 * (plain / reference - 1):9.2f} {corrected:13.4f} "
                f"{100 * (corrected / reference - 1):9.2f} {spent:8.2f}"
            )
    for unknowns, plain, _, spent in list(zip(*uniform, strict=True))[1:]:
        for name, column in (("adaptive", 1), ("adaptive, corrected", 2)):
            worse = np.abs(adaptive[column] - reference) > abs(plain - reference)
            first = int(np.flatnonzero(worse)[-1]) + 1  # all finer meshes are as good
            print(
                f"as good as {unknowns:.0f} uniform unknowns: {name} {adaptive[0][first]:.0f}, 1/{unknowns / adaptive[0][first]:.0f}, "
                f"in 1/{spent / adaptive[3][first]:.0f} of the time"
            )


def path(n: int, criterion: StressError | None) -> tuple[np.ndarray, list[int], float]:
    """Return the path of the corners of the free end (steps, 3), mm, the numbers of nodes, and the time, s."""

    def fixed(p: np.ndarray) -> np.ndarray:
        return p[:, 0] < 1e-6

    def end(p: np.ndarray) -> np.ndarray:
        return p[:, 0] > SIDE_MM - 1e-6

    def corners(p: np.ndarray) -> np.ndarray:
        return end(p) & ~((p[:, 1:] > 1e-6) & (p[:, 1:] < SIDE_MM - 1e-6)).any(axis=1)

    law = material("neo_hookean", young_modulus=50.0, poisson_ratio=0.3)
    dynamics = HyperelasticDynamics((law,), DENSITY, STEP_S, retardation_s=2e-3)
    loaded = Conditions(fixed, loads=(face_force(end, (0.0, 0.0, -FORCE_MN)),))
    mesh = box((SIDE_MM,) * 3, (n, n, n), cell_type="tetra", centred=False)
    body = AdaptiveBody.of(mesh, dynamics, loaded, criterion, max_level=6, bisections=2, interval=1)
    places, nodes, began = [], [], time.process_time()
    if criterion is not None:  # the first steps are taken again, on the mesh that they call for
        body.step(TRIAL_STEPS)
        body.state = body.prepared.at_rest()
    for k in range(STEPS):
        if k == STEPS // 2:
            body.constrain(Conditions(fixed))
        body.step(1)
        points = body.mesh.leaf.mesh.points
        places.append(body.state.displacement[corners(points)].mean(axis=0))
        nodes.append(len(points))
    return np.array(places), nodes, time.process_time() - began


def dynamics() -> None:
    criterion = StressError(50.0, 0.3, 0.017, 0.1 * 0.017, least=80.0)
    path(4, criterion)  # compiles
    reference, nodes, time_9 = path(9, None)
    largest = np.abs(reference).max()
    print(f"corner path, largest deflection {largest:.2f} mm")
    print(f"{'mesh':>22s} {'nodes, mean (most)':>20s} {'difference, %':>14s} {'of the time':>12s}")
    print(f"{'uniform, 9 cubes':>22s} {nodes[0]:20d} {0:14.2f} {1:12.2f}")
    for name, n, rule in (("uniform, 4 cubes", 4, None), ("adaptive", 4, criterion)):
        found, nodes, spent = path(n, rule)
        told = f"{np.mean(nodes):.0f} ({max(nodes)})"
        print(f"{name:>22s} {told:>20s} {100 * np.abs(found - reference).max() / largest:14.2f} {spent / time_9:12.2f}", flush=True)


if __name__ == "__main__":
    parts = {"rate": rate, "indentation": indentation, "uniform": uniform, "dynamics": dynamics}
    for chosen in sys.argv[1:] or parts:
        parts[chosen]()
