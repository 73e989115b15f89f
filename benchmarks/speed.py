"""Processor time of the main computations against their size, beside references on the same arrays, and error against time of sensing.

Run: ``python benchmarks/speed.py [--quick] [--only NAME ...] [--repeats 2] [--json FILE] [--record]``

Parts are ``linear`` (a linear-elastic cube with a stiff ball by every solver), ``hyperelastic`` (the same of neo-Hookean material, squeezed
by a quarter, and the gradient of an identification with an unknown in every element; up to three million tetrahedra), ``lattice``
(explicit steps beside NumPy and a plain Numba loop) and ``sensing`` (a textured ball with known displacement, by every dense method). Every
time is the least of the repeats, of the processor (all threads), so that other work on the machine counts little; each computation runs
once before, on a small case, to compile.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import fe_compression
import fe_gradient
import numpy as np
from ball_case import ball_case
from fe_case import make_case, prescribed
from fe_driver import measured
from fe_linear_peers import LOWERED
from lattice_steps import GENTLE, MASS_KG, SIDE_MM, STEP_S, numpy_steps, plain_loop, pushed
from records import Cell, ResultTable, write_record

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.measure_displacement import Method, measure_displacement
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.linear_algebra.direct import pardiso_library
from naibu.mechanics.linear_algebra.solver_selection import SolverName
from naibu.mechanics.small_strain.linear_elasticity import LinearBody

Rows = list[tuple[Cell, ...]]
CELLS, MORE_CELLS = (6, 10, 14, 20, 30), (40,)
HYPERELASTIC, MORE_HYPERELASTIC = (14, 20, 28), (40, 56, 80)
GRADIENT_MOST = 56  # cells an edge
SUPERLU_MOST = 14  # cells an edge; beyond, it takes minutes
VOXELS, MORE_VOXELS = (8, 16), (32,)  # an edge of the lattice
WARM_UP, SCANS, MORE_SCANS = 32, (64, 88), (120,)  # voxels an edge
METHODS: tuple[Method, ...] = ("default", "ssd-blocks", "ncc-blocks", "horn-schunck", "lucas-kanade", "rigid")
COLUMNS = {
    "linear": ("solver", "unknowns", "processor time, s", "ratio to SciPy's SuperLU"),
    "hyperelastic": (
        "computation",
        "tetrahedra",
        "processor time, s",
        "time, s",
        "peak memory, MB",
        "exponent of growth from the size before",
        "memory of an unknown more than that size has, kB",
    ),
    "lattice": ("program", "elements", "processor time of a step, ms", "ratio to the plain loop"),
    "sensing": ("method", "voxels", "processor time, s", "mean error, voxel"),
}


def least(action: Callable[[], object], repeats: int) -> float:
    """Return the least processor time of an action, s."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times)


def linear(quick: bool, repeats: int) -> Rows:
    """Assembly and solution, from the arrays of the mesh to the displacement."""
    solvers: list[SolverName] = ["superlu", "multigrid", "automatic"]
    solvers += ["pardiso", "recycled_cholesky"] if pardiso_library() is not None else []
    rows: Rows = []
    for cells in (4, *CELLS, *(() if quick else MORE_CELLS)):
        case, times = make_case(cells), {}
        support = prescribed(case, LOWERED)

        def solved(solver: SolverName, case=case, support=support) -> None:  # type: ignore[no-untyped-def]
            LinearBody.of(case.mesh).solve(case.lame, case.shear, support, solver=solver)

        for solver in solvers:
            if solver != "superlu" or cells <= SUPERLU_MOST:
                times[solver] = least(lambda solver=solver: solved(solver), repeats)  # type: ignore[misc]
        if cells > 4:  # the smallest compiles
            unknowns = case.mesh.points.size
            rows += [(s, unknowns, t, t / times["superlu"] if "superlu" in times else "") for s, t in times.items()]
    return rows


def hyperelastic(quick: bool, repeats: int) -> Rows:
    """Each size in a process of its own, so that its peak of memory is its own."""
    rows: Rows = []
    for label, script, cells_most in (("compression by 25 %", fe_compression, 80), ("gradient", fe_gradient, GRADIENT_MOST)):
        before: tuple[int, float, float, int] | None = None
        for cells in (*HYPERELASTIC, *(() if quick else MORE_HYPERELASTIC)):
            if cells > cells_most:
                continue
            found, absent = measured(script.__file__, {"naibu": script.PEERS["naibu"]}, cells, repeats)
            if absent:
                raise RuntimeError(f"{label}, {cells} cells an edge: {absent['naibu']}")
            seconds, memory, _, busy = np.min([run["numbers"] for run in found["naibu"]], axis=0)
            unknowns = 3 * (cells + 1) ** 3
            growth: Cell = ""
            each: Cell = ""
            if before is not None:
                growth = float(np.log(busy / before[1]) / np.log((cells / before[0]) ** 3))
                each = 1024.0 * (memory - before[2]) / (unknowns - before[3])
            rows.append((label, 6 * cells**3, busy, seconds, memory, growth, each))
            before = cells, busy, memory, unknowns
    return rows


def lattice(quick: bool, repeats: int) -> Rows:
    """Explicit steps of a pushed cube, all programs on one thread: threads that wait for each other take processor time."""
    rows: Rows = []
    for n in (*VOXELS, *(() if quick else MORE_VOXELS)):
        body = classic_lattice(box_mask((n,) * 3), SIDE_MM / n, total_mass_kg=MASS_KG)
        parameters = lattice_parameters(body, *(p * 8.0 / n for p in GENTLE))
        steps = max(20, 4_000_000 // body.n_elements)  # many: what a call costs besides, the conversion of the state, is shared by them
        c = explicit_coefficients(parameters)
        i, j = (np.ascontiguousarray(e) for e in body.elements.T)
        engine = LatticeEngine.of(body, parameters, step=STEP_S, method="euler", threads=1)
        constrained, velocity = pushed(body)
        start = engine.run(engine.rest(), 2, constrained, velocity).state

        def loop(body=body, c=c, i=i, j=j, steps=steps) -> None:  # type: ignore[no-untyped-def]
            x, y = body.points.copy(), np.zeros(body.n_elements)
            plain_loop(i, j, *c, body.node_mass, x, np.zeros_like(x), y, STEP_S, steps)

        loop()
        plain = least(loop, 3 * repeats) / steps
        few = max(2, steps // 200)
        own = least(lambda e=engine, s=start, k=constrained, v=velocity, n=steps: e.run(s, n, k, v), 3 * repeats) / steps  # type: ignore[misc]
        with_numpy = least(lambda b=body, c=c, n=few: numpy_steps(b, c, n), repeats) / few  # type: ignore[misc]
        for name, seconds in (("naibu", own), ("plain Numba loop", plain), ("NumPy", with_numpy)):
            rows.append((name, body.n_elements, 1e3 * seconds, seconds / plain))
    return rows


def sensing(quick: bool, repeats: int) -> Rows:
    """Displacement between two scans of a textured ball; the error is that in the ball, where the method has a displacement."""
    rows: Rows = []
    for size in (WARM_UP, *SCANS, *(() if quick else MORE_SCANS)):
        case = ball_case(size, 1)
        grid = Volume.from_array(np.zeros((size,) * 3), spacing_mm=case["spacing"])
        reference, deformed = (grid.with_values(np.ascontiguousarray(case[key].T)) for key in ("ref", "deformed"))
        mask, truth = np.ascontiguousarray(case["mask"].T), np.moveaxis(case["u"], 0, -1).transpose(2, 1, 0, 3)
        for method in METHODS:
            start = time.process_time()
            try:
                found = measure_displacement(reference, deformed, method=method, mask=mask).displacement
            except InputError as error:  # such a method refuses what it cannot match
                print(f"{method}, {size}^3: refused: {error}", flush=True)
                continue
            seconds = time.process_time() - start
            inside = mask & found.valid
            if size > WARM_UP:
                error = float(np.linalg.norm(found.vectors[inside] - truth[inside], axis=1).mean())
                rows.append((method, size**3, seconds, error))
    return rows


PARTS: dict[str, Callable[[bool, int], Rows]] = {"linear": linear, "hyperelastic": hyperelastic, "lattice": lattice, "sensing": sensing}


def main() -> None:
    """Measure the parts, print their tables, and write the record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smaller sizes only")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--json", type=Path, help="write the tables to this file as well")
    parser.add_argument("--record", action="store_true", help="write results/speed.json, or results/speed_PART.json of some parts")
    chosen = parser.parse_args()
    tables = []
    for name in chosen.only:
        rows = PARTS[name](chosen.quick, chosen.repeats)
        print("   ".join(COLUMNS[name]))
        for row in rows:
            print("   ".join(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row), flush=True)
        tables.append(ResultTable(name, COLUMNS[name], tuple(rows)))
    if chosen.json:
        told = {table.name: {"columns": table.columns, "rows": table.rows} for table in tables}
        chosen.json.write_text(json.dumps(told, default=float) + "\n", encoding="utf-8")
    if chosen.record:
        write_record("speed" if set(chosen.only) == set(PARTS) else f"speed_{'_'.join(chosen.only)}", tables)


if __name__ == "__main__":
    main()
