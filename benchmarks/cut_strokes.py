"""Cuts of tetrahedra in two strokes, of which the second knows nothing but the mesh: how many part the body as one stroke does.

Cells are Kuhn's or Delaunay's, blades cross a cube of 20 mm at random, on planes or waves. The second stroke begins where the first ended,
or within it; or the first ends on the plane of the second, which crosses it.

Usage: python benchmarks/cut_strokes.py [CASES]
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np
from scipy.spatial import Delaunay

from naibu.core.mesh import Mesh
from naibu.meshing import box, cut_volume, signed_volumes, swept_blade

SIZE = 20.0
MIDDLE = np.array([0.0, 0.0, 0.5 * SIZE])


def cells(seed: int, rng: np.random.Generator) -> Mesh:
    """Return Kuhn's cells of cubes, or, of an even seed, Delaunay's of random points."""
    if seed % 2:
        return box((SIZE, SIZE, SIZE), (4, 4, 4), cell_type="tetra")
    grid = box((SIZE, SIZE, SIZE), (3, 3, 3), cell_type="tetra").points - MIDDLE
    moved = grid + np.where(np.abs(grid) < 0.5 * SIZE - 0.1, rng.uniform(-2.0, 2.0, grid.shape), 0.0)
    points = np.concatenate([moved, rng.uniform(-9.0, 9.0, (20, 3))]) + MIDDLE
    found = Delaunay(points).simplices
    volumes = np.linalg.det(points[found[:, 1:]] - points[found[:, :1]])
    found[volumes < 0.0] = found[volumes < 0.0][:, [0, 1, 3, 2]]
    return Mesh.from_arrays(points, found[np.abs(volumes) > 1e-6], "tetra")


def sizes(cut) -> np.ndarray:
    """Return the volumes of the pieces, the largest first, and 0 for a second where there is none."""
    return np.append(np.bincount(cut.piece, signed_volumes(cut.mesh)), 0.0)


def going_on(seed: int, overlap: float) -> tuple[bool, bool]:
    """Whether two strokes on one way leave the two large pieces of a single one, and whether it is said that they do not meet."""
    rng = np.random.default_rng(seed)
    mesh = cells(seed, rng)
    edge, way, bulge = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    centre, height, distance = MIDDLE + rng.uniform(-3.0, 3.0, 3), rng.choice([0.0, 2.0]), float(rng.choice([2.0, 3.0, 5.0]))
    pause = rng.uniform(-5.0, 5.0)

    def swept(first, last):
        s = np.linspace(first, last, 17 if last - first == 48.0 else 9)[:, None]
        line = centre + s * way + height * np.sin(0.15 * s) * bulge
        return swept_blade(line[:, None] + np.array([[-40.0], [40.0]]) * edge)

    once = cut_volume(mesh, swept(-24.0, pause), distance)
    twice = cut_volume(once.mesh, swept(pause - overlap * distance, 24.0), distance)
    whole = sizes(cut_volume(mesh, swept(-24.0, 24.0), distance))
    return bool(np.allclose(sizes(twice)[:2], whole[:2], rtol=0.05, atol=0.01 * SIZE**3)), len(twice.bridges) > 0


def running_into(seed: int) -> tuple[bool, bool]:
    """Whether a stroke along the end of another leaves pieces as if that went on beyond, and whether it is said that they do not meet."""
    rng = np.random.default_rng(seed)
    mesh = cells(seed, rng)
    u, v, w = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    centre, distance = MIDDLE + rng.uniform(-2.0, 2.0, 3), float(rng.choice([2.0, 3.0]))

    def swept(across, first, last):
        return swept_blade([[centre - 40.0 * u + b * across, centre + 40.0 * u + b * across] for b in np.linspace(first, last, 4)])

    along = swept(w, -40.0, 40.0)
    twice, beyond = (cut_volume(cut_volume(mesh, swept(v, -40.0, end), distance).mesh, along, distance) for end in (0.0, 2.0 * distance))
    return bool(np.allclose(sizes(twice)[:3], sizes(beyond)[:3], rtol=0.05, atol=0.02 * SIZE**3)), len(twice.bridges) > 0


def row(name: str, cases: list[tuple[bool, bool]]) -> None:
    """Print a row of the table."""
    count = Counter(cases)
    print(f"| {name} | {len(cases)} | {count[True, False] + count[True, True]} | {count[True, True]} | {count[False, True]} |", flush=True)


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    print("| second stroke | cases | part as one | of these, told not to meet | told not to meet, and do not |")
    print("| --- | --- | --- | --- | --- |")
    for overlap in (0.0, 0.25, 1.0):
        row(f"begins {overlap:g} distances within the first", [going_on(seed, overlap) for seed in range(number)])
    row("along the end of the first", [running_into(seed) for seed in range(number)])
