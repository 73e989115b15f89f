"""Steps of a blade that cuts solids of growing size, 60 a second: the cut, and the body made of it; prints a table of processor times.

Usage: python benchmarks/volume_cutting.py [DIVISIONS ...]
"""

from __future__ import annotations

import functools
import operator
import sys
import time
from contextlib import redirect_stdout
from io import StringIO

import numpy as np

from naibu.mechanics import LatticeEngine, box_mask, classic_lattice, lattice_parameters
from naibu.meshing import BisectionForest, box, cut_forest, cut_volume, swept_blade
from naibu.simulation import cut_engine, cut_lattice

EDGE = 4.0  # mm, of the cubes at all sizes
STEP = 1.0  # mm of the blade in a step: 60 mm/s


def steps(size: float):
    """Return the surfaces that a blade sweeps in successive steps, on a wavy way through a cube, to half of its depth."""
    y = np.arange(-STEP, size + 2.0 * STEP, STEP)
    x = 0.51 * size + 0.1 * size * np.sin(20.0 * y / size)
    edges = np.stack([np.stack([x, y, 0.5 * size + 0 * y], axis=1), np.stack([x, y, size + EDGE + 0 * y], axis=1)], axis=1)
    return [swept_blade(edges[k : k + 2]) for k in range(len(y) - 1)]


def before(blades, k: int):
    """Return what the blade swept before its step k, as far back as a cell reaches."""
    return functools.reduce(operator.add, blades[max(0, k - 2 * round(EDGE / STEP)) : k]) if k else None


def row(name: str, first: int, last: int, spent: list[float]) -> None:
    """Print a row of the table."""
    print(f"| {name} | {first} | {last} | {np.median(spent):.1f} | {np.quantile(spent, 0.99):.1f} | {max(spent):.1f} |", flush=True)


def forests(divisions: int) -> None:
    """Cut a kept forest, as adaptive bodies do."""
    mesh = box((EDGE * divisions,) * 3, (divisions,) * 3, cell_type="tetra", centred=False)
    forest = BisectionForest.of(mesh)
    spent = []
    blades = steps(EDGE * divisions)
    for k, blade in enumerate(blades):
        began = time.thread_time()
        cut_forest(forest, blade, EDGE, earlier=before(blades, k))
        spent.append(1e3 * (time.thread_time() - began))
    row("cut_forest", mesh.n_cells, forest.n_cells, spent)


def meshes(divisions: int, keep: bool) -> None:
    """Cut meshes, with the forest of the cut before or a new one each time."""
    mesh = box((EDGE * divisions,) * 3, (divisions,) * 3, cell_type="tetra", centred=False)
    now, forest, spent = mesh, None, []
    blades = steps(EDGE * divisions)
    for k, blade in enumerate(blades):
        began = time.thread_time()
        found = cut_volume(now, blade, EDGE, forest=forest, earlier=before(blades, k))
        spent.append(1e3 * (time.thread_time() - began))
        now, forest = found.mesh, found.forest if keep else None
    row("cut_volume, forest kept" if keep else "cut_volume, new forest", mesh.n_cells, now.n_cells, spent)


def lattices(divisions: int, engine: bool) -> None:
    """Cut lattices of the same cubes, with or without the engine that steps them."""
    lattice = classic_lattice(box_mask((divisions,) * 3), EDGE, density=1e-6)
    now, parameters, spent = lattice, lattice_parameters(lattice, 10.0, 0.1, 5.0), []
    whole = LatticeEngine.of(now, parameters, step=1e-3)
    for blade in steps(EDGE * divisions):
        began = time.thread_time()
        found = cut_lattice(now, parameters, blade)
        if engine:
            whole = cut_engine(whole, found)
        spent.append(1e3 * (time.thread_time() - began))
        now, parameters = found.lattice, found.parameters
    row("cut_lattice, with its engine" if engine else "cut_lattice", len(lattice.cells), now.n_nodes, spent)


def table(divisions: int) -> None:
    """Print the rows of one size."""
    forests(divisions)
    meshes(divisions, keep=True)
    meshes(divisions, keep=False)
    lattices(divisions, engine=False)
    lattices(divisions, engine=True)


if __name__ == "__main__":
    with redirect_stdout(StringIO()):
        table(4)  # compiles
    print("| step | cells before | cells, or nodes of the lattice, after | median, ms | 99th percentile, ms | longest, ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    for n in [int(arg) for arg in sys.argv[1:]] or [15]:
        table(n)
