"""Time steps of a tool that cuts surfaces of growing size: topology and update of the springs; prints a table of processor times.

Usage: python benchmarks/surface_cutting.py [TRIANGLES ...]
"""

from __future__ import annotations

import sys
import time

import numpy as np

from naibu.meshing import SurfaceCutter
from naibu.simulation import CutSprings

STEPS = 4000
D = 1.0  # mm; the edges of the plate are about 0.9 mm at all sizes


def plate(triangles: int):
    """Return a wavy plate whose triangles have the same size whatever their number."""
    n = round((triangles / 2) ** 0.5)
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.sin(0.1 * x.ravel())], axis=1)
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]), n


def measured(triangles: int) -> tuple[float, ...]:
    """Return microseconds of a movement of the tool by a quarter of the distance: median, 99th percentile, and of those that cut."""
    points, cells, n = plate(triangles)
    cutter = SurfaceCutter(points, cells, D)
    springs = CutSprings(cutter, membrane_modulus=50.0, area_density=1e-6)
    turn = np.cumsum(np.random.default_rng(0).normal(0.0, 0.05, STEPS)) * 0.2
    heading = np.linspace(0.0, 14.0 * np.pi, STEPS) + turn
    radius = np.linspace(0.1 * n, 0.4 * n, STEPS)
    ring = np.stack([0.5 * n + radius * np.cos(heading), 0.5 * n + radius * np.sin(heading)], axis=1)
    way = np.cumsum(
        np.concatenate([[ring[0]], 0.25 * D * np.diff(ring, axis=0) / np.linalg.norm(np.diff(ring, axis=0), axis=1)[:, None]]), axis=0
    )
    way += 0.5 * n - 0.5 * (way.min(axis=0) + way.max(axis=0))
    spent, cutting = [], []
    for x, y in way:
        tip, before = (x, y, np.sin(0.1 * x)), cutter.n_steps
        began = time.thread_time()
        springs.move(tip)
        spent.append(1e6 * (time.thread_time() - began))
        if cutter.n_steps > before:
            cutting.append(spent[-1])
    return (*np.percentile(spent[10:], [50, 99]), *np.percentile(cutting[2:], [50, 99]), len(cutting))


if __name__ == "__main__":
    measured(2000)  # compiles
    print("triangles  all: median, us      p99, us  cutting: median, us      p99, us  steps that cut")
    for size in [int(a) for a in sys.argv[1:]] or [10_000, 100_000, 1_000_000]:
        print("{:9d}  {:15.1f}  {:11.1f}  {:19.1f}  {:11.1f}  {:14d}".format(size, *measured(size)))
