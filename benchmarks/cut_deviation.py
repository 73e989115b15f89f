"""How far cuts stay from the way of the tool, in units of the distance d that they are asked for: the goal is a half at most.

Surfaces are plates of random triangles, cut along random straight lines or along a hand's way with tremor that goes on in many small moves.
Volumes are Kuhn's or Delaunay's cells of a cube that are deformed while they are cut, and a blade goes on in twelve steps through each,
with what it swept before, or from the mesh alone.

Usage: python benchmarks/cut_deviation.py [SURFACES] [VOLUMES]
"""

from __future__ import annotations

import sys

import numpy as np
from cut_strokes import cells
from scipy.spatial import Delaunay

from naibu.core.arrays import FloatArray
from naibu.meshing import SurfaceCutter, cut_volume, swept_blade

STEPS = 12  # of a blade


def hands_way(rng: np.random.Generator) -> FloatArray:
    """Return a smooth way over a plate of 100 mm with a tremor of 0.15 mm (n, 3)."""
    n, waves = int(rng.integers(60, 250)), np.arange(1, 5)
    size, phase = rng.normal(size=(2, 4, 1)) * 25.0 / waves[:, None], rng.uniform(0.0, 2.0 * np.pi, (2, 4, 1))
    way = 50.0 + (size * np.sin(np.pi * waves[:, None] * np.linspace(0.0, 1.0, n) + phase)).sum(axis=1).T
    return np.column_stack([way + rng.normal(0.0, 0.15, (n, 2)), rng.normal(0.0, 0.3, n)])


def of_surface(seed: int) -> float:
    """Return the largest distance of a cut of a surface over d."""
    rng = np.random.default_rng(seed)
    ring = np.array([[x, y] for x in (0.0, 50.0, 100.0) for y in (0.0, 50.0, 100.0)])
    plane = np.concatenate([ring, rng.uniform(1.0, 99.0, (int(rng.integers(10, 140)), 2))])
    d = float(rng.choice([3.0, 4.0, 6.0, 8.0]))
    lines = np.column_stack([rng.uniform(-10.0, 110.0, (6, 2)), np.zeros(6)])
    cutter = SurfaceCutter(np.column_stack([plane, np.zeros(len(plane))]), Delaunay(plane).simplices.astype(np.int64), d)
    for tip in hands_way(rng) if seed % 2 else lines:
        cutter.move(tip)
    return cutter.result().deviation_mm / d


def of_volume(seed: int, told: bool) -> list[float]:
    """Return the largest distance of the new surface of every step over d, where the cut is `told` what the blade swept before or not."""
    rng = np.random.default_rng(seed)
    mesh, forest, d = cells(seed, rng), None, float(rng.choice([2.0, 3.0, 4.0]))
    place, way = np.array([rng.uniform(-6.0, 6.0), -12.0, 0.0]), np.array([rng.normal(0.0, 0.2), 1.0, 0.0])
    poses = []
    for _ in range(STEPS + 1):
        poses.append([place - np.array([0.0, 0.0, 3.0]), place + rng.normal((0.0, 0.0, 25.0), 0.5)])
        place, way = place + 2.0 * way + rng.normal(0.0, 0.1, 3), way + rng.normal(0.0, 0.08, 3)
    u, found = 0.4 * np.sin(mesh.points / 7.0), []
    for k in range(1, STEPS + 1):
        before = swept_blade(poses[:k]) if told and k > 1 else None
        blade = swept_blade(poses[max(0, k - 2) : k + 1])
        cut = cut_volume(mesh, blade, d, positions=mesh.points + u, forest=forest, earlier=before)
        u, mesh, forest = cut.nodal(u), cut.mesh, cut.forest
        found.append(cut.deviation_mm / d)
    return found


def main() -> None:
    surfaces, volumes = [int(a) for a in sys.argv[1:]] or (400, 40)
    groups = {
        "surfaces, straight lines": [of_surface(2 * k) for k in range(surfaces // 2)],
        "surfaces, a hand's way": [of_surface(2 * k + 1) for k in range(surfaces // 2)],
        "volumes, told": [q for k in range(volumes) for q in of_volume(k, True)],
        "volumes, from the mesh": [q for k in range(volumes) for q in of_volume(k, False)],
    }
    for name, found in groups.items():
        q = np.array(found)
        print(f"{name:26s} {len(q):5d} cuts: median {np.median(q):.3f} d, largest {q.max():.4f} d, beyond d/2: {np.count_nonzero(q > 0.5)}")


if __name__ == "__main__":
    main()
