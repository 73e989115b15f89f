"""A textured ball in air before and after a smooth motion, with exactly known displacement.

Run: python benchmarks/ball_case.py OUT.npz [--size 160] [--seed 1]

OUT.npz is a case of sense_volumes.py of size^3 voxels of 1 mm. The motion is a shift, waves of 2 to 3 mm, and a compression by 5 %.
Intensities are functions of the material point, read at where a voxel came from, so that no interpolation couples the scans.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[Any]
NOISE = 5.0


def moved(x: Array, size: int) -> Array:
    """Return the displacement (n, 3), mm."""
    middle, wave = 0.5 * (size - 1), 2.0 * np.pi * 1.5 / size
    u = 2.5 * np.sin(wave * x[:, [1, 2, 0]] + np.array([0.4, 1.3, 2.1])) + np.array([3.0, -2.0, 1.5])
    u[:, 2] -= 0.05 * (x[:, 2] - middle)
    return np.asarray(u)


def ball_case(size: int, seed: int) -> dict[str, Array]:
    """Return a case as sense_volumes.py reads it."""
    rng = np.random.default_rng(seed)
    splines = []
    for length in (2.5, 6.0):
        values = ndimage.gaussian_filter(rng.standard_normal((64, 64, 64)), 0.7, mode="wrap")
        splines.append((ndimage.spline_filter(values / values.std(), 3, mode="grid-wrap"), 0.7 * length))

    def intensity(x: Array) -> Array:
        texture = sum(ndimage.map_coordinates(c, x.T / step, order=3, prefilter=False, mode="grid-wrap") for c, step in splines)
        depth = 0.4 * size - np.linalg.norm(x - 0.5 * (size - 1), axis=1)
        return np.asarray((400.0 + 50.0 * texture) / (1.0 + np.exp(-3.0 * depth)))

    shape = (size, size, size)
    x = np.stack(np.meshgrid(*(np.arange(size, dtype=float),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    back = x - moved(x, size)
    for _ in range(100):
        off = x - back - moved(back, size)
        back = back + off
        if np.abs(off).max() < 1e-6:
            break
    scans = [(intensity(at).reshape(shape) + NOISE * rng.standard_normal(shape)).astype(np.float32) for at in (x, back)]
    mask = (np.linalg.norm(x - 0.5 * (size - 1), axis=1) < 0.4 * size).reshape(shape)
    meta = {"kind": "ball", "size": f"{size}^3", "seed": seed, "noise": NOISE}
    return {
        "ref": scans[0], "deformed": scans[1], "spacing": np.ones(3), "u": moved(x, size).T.reshape(3, *shape).astype(np.float32),
        "labels": mask.astype(np.uint8), "mask": mask, "meta": np.array(json.dumps(meta)),
    }  # fmt: skip


def main() -> None:
    """Make a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--size", type=int, default=160)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    np.savez_compressed(chosen.out, **ball_case(chosen.size, chosen.seed))


if __name__ == "__main__":
    main()
