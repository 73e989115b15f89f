"""A chest before and after breathing in, with exactly known displacement, and how much of its lungs the default mask keeps.

Run: python benchmarks/thorax_case.py OUT.npz [--slice-mm 3] [--pixel-mm 3] [--closed] [--sliding] [--seed 1]

OUT.npz is a case of sense_volumes.py of 357 x 267 mm: fat, muscle, spine, ribs, and lungs (-850 HU) with vessels. A trachea
joins them to the air at the top of the scan and, unless --closed, a slit 16 mm wide and 100 mm high in front of each opens it. A table
lies below. Intensities are functions of the material point, read at where a voxel came from, so that no interpolation couples the
scans. Printed are the shares of lungs and body that `naibu.imaging.object_mask` keeps, and between which slices it jumps.

With --sliding (and closed lungs) each lung slides along its wall, too, by up to 17 mm at its outer side: it flows along ellipsoids about
its middle and stays at rest at the mediastinum, so that the displacement jumps at the wall but nothing overlaps or gapes. What breathing
in draws into a lung makes it darker, by 15 to 30 per cent of its density. Scans of ``--sliding --pixel-mm 1.4 --slice-mm 2.5`` are as
large as clinical ones.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.object_mask import mask_jumps, object_mask

Array = NDArray[Any]
EXTENT = np.array([357.0, 267.0, 228.0])
MIDDLE = np.array([178.0, 120.0, 114.0])
AIR, LUNG, FAT, MUSCLE, BONE, TABLE, VESSEL = -1000.0, -850.0, -100.0, 40.0, 500.0, -100.0, 20.0
NOISE = 25.0
FAT_MM = 14.0
LUNG_HALF_AXES = np.array([58.0, 74.0, 112.0])
SLIDING, FLOW_STEPS = 0.16, 8  # turn of a lung at its outer side, radians, in the coordinates of `in_lung`


class Texture:
    """A random field of unit variance with a correlation length, mm, periodic."""

    def __init__(self, rng: np.random.Generator, length_mm: float) -> None:
        self.step = 0.7 * length_mm
        values = ndimage.gaussian_filter(rng.standard_normal((48, 48, 48)), 0.7, mode="wrap")
        self.spline = ndimage.spline_filter(values / values.std(), 3, mode="grid-wrap")

    def __call__(self, x: Array) -> Array:
        return np.asarray(ndimage.map_coordinates(self.spline, x.T / self.step, order=3, prefilter=False, mode="grid-wrap"))


def inside(distance: Array, width: float = 2.0) -> Array:
    """Return a smooth step: 1 where a distance is positive."""
    return np.asarray(0.5 * (1.0 + np.tanh(2.0 * distance / width)))


class Chest:
    """Intensities and labels (0 outside, 1 fat and muscle, 2 lung and airways, 3 bone) of a chest at material points (n, 3), mm."""

    def __init__(self, seed: int, closed: bool) -> None:
        rng = np.random.default_rng(seed)
        self.closed, self.soft, self.fine, self.vessels = closed, Texture(rng, 9.0), Texture(rng, 5.0), Texture(rng, 7.0)

    def __call__(self, x: Array, dilution: Array | float = 0.0) -> tuple[Array, Array]:
        p = x - MIDDLE
        depth = 108.0 * (1.0 - np.hypot(p[:, 0] / 165.0, p[:, 1] / 108.0))
        value = AIR + inside(depth) * (FAT - AIR + 12.0 * self.soft(x))
        value += inside(depth - FAT_MM) * (MUSCLE - FAT + 12.0 * self.fine(x))
        spine = 20.0 - np.hypot(p[:, 0], p[:, 1] - 68.0)
        ribs = np.minimum(5.0 - np.abs(depth - 22.0), 12.0 * np.cos(2.0 * np.pi * (p[:, 2] - 0.25 * p[:, 1]) / 26.0) - 6.0)
        bone = np.maximum(spine, ribs)
        value += inside(bone) * inside(depth - FAT_MM) * (BONE - value)
        lung = 60.0 * (1.0 - np.linalg.norm(in_lung(x), axis=1))
        inner = AIR + (1.0 - dilution) * (LUNG - AIR + 25.0 * self.soft(x))
        inner += (VESSEL - AIR - (1.0 - dilution) * (LUNG - AIR)) * inside(9.0 * (self.vessels(x) - 1.25), 4.0)
        value += inside(lung) * (inner - value)
        airway = self._airways(p)
        value += inside(airway) * (AIR - value)
        value = np.maximum(value, AIR + (TABLE - AIR) * inside(4.0 - np.abs(p[:, 1] - 124.0)) * inside(150.0 - np.abs(p[:, 0])))
        labels = np.select([depth < 0.0, (lung > 0.0) | (airway > 0.0), (bone > 0.0) & (depth > FAT_MM)], [0, 2, 3], 1)
        return value, labels.astype(np.uint8)

    def _airways(self, p: Array) -> Array:
        trachea = np.minimum(9.0 - np.hypot(p[:, 0], p[:, 1] + 8.0), p[:, 2] + 5.0)
        bronchi = np.minimum(6.0 - np.hypot(p[:, 1] + 8.0, p[:, 2] + 0.25 * np.abs(p[:, 0])), 60.0 - np.abs(p[:, 0]))
        found = np.maximum(trachea, bronchi)
        if self.closed:
            return found
        slit = np.minimum(8.0 - np.abs(np.abs(p[:, 0]) - 78.0), np.minimum(50.0 - np.abs(p[:, 2]), -p[:, 1] - 40.0))
        return np.maximum(found, slit)


def breathed(x: Array) -> Array:
    """Return the displacement (n, 3), mm: the diaphragm goes down by 14 mm, ribs go up and out."""
    p = (x - MIDDLE) / np.array([165.0, 108.0, 114.0])
    low = 0.5 * (1.0 - np.tanh(1.5 * (p[:, 2] + 0.2)))
    core = np.exp(-1.2 * (p[:, 0] ** 2 + p[:, 1] ** 2))
    u = np.empty_like(x)
    u[:, 0] = 5.0 * np.sin(0.5 * np.pi * np.clip(p[:, 0], -1.5, 1.5)) * np.exp(-0.5 * p[:, 2] ** 2)
    u[:, 1] = -6.0 * (0.5 - 0.5 * np.tanh(1.5 * p[:, 1])) * np.exp(-0.5 * p[:, 2] ** 2)
    u[:, 2] = -14.0 * low * core + 3.0 * (1.0 - core)
    return u


def in_lung(x: Array) -> Array:
    """Return coordinates (n, 3) from the middle of the nearer lung, outwards, backwards and up, in which its surface is a unit sphere."""
    p = x - MIDDLE
    return np.asarray(np.stack([np.abs(p[:, 0]) - 78.0, p[:, 1] + 6.0, p[:, 2] + 10.0], axis=1) / LUNG_HALF_AXES)


def slid(x: Array, sign: float = 1.0) -> Array:
    """Return where points (n, 3), mm, in a lung slide to, or with -1 came from; others stay: a flow of unit time by Runge and Kutta."""
    s, h = in_lung(x), sign / FLOW_STEPS
    within = np.linalg.norm(s, axis=1) < 1.0
    now = s[within]

    def velocity(s: Array) -> Array:
        speed = SLIDING * (0.5 + 0.5 * np.tanh(2.5 * (s[:, 0] + 0.1)))
        return np.stack([speed * s[:, 2], np.zeros(len(s)), -speed * s[:, 0]], axis=1)

    for _ in range(FLOW_STEPS):
        a = velocity(now)
        b = velocity(now + 0.5 * h * a)
        c = velocity(now + 0.5 * h * b)
        now = now + h / 6.0 * (a + 2.0 * b + 2.0 * c + velocity(now + h * c))
    change = (now - s[within]) * LUNG_HALF_AXES
    change[:, 0] *= np.sign(x[within, 0] - MIDDLE[0])
    out = x.copy()
    out[within] += change
    return out


def diluted(x: Array) -> Array:
    """Return by which part (n,) the density of the lung falls at material points (n, 3), mm: most at the diaphragm."""
    return np.asarray(0.15 + 0.15 * inside(-40.0 - (x - MIDDLE)[:, 2], 120.0))


def came_from(y: Array) -> Array:
    """Return the material points that the motion brings to y, by fixed-point iteration to 1e-6 mm."""
    x = y - breathed(y)
    for _ in range(200):
        off = y - x - breathed(x)
        x = x + 0.9 * off
        if np.abs(off).max() < 1e-6:
            break
    return x


def chest_case(seed: int, slice_mm: float, closed: bool, pixel_mm: float = 3.0, *, sliding: bool = False) -> dict[str, Array]:
    """Return a case as sense_volumes.py reads it."""
    spacing = np.array([pixel_mm, pixel_mm, slice_mm])
    shape = tuple(int(n) for n in np.round(EXTENT / spacing) + 1)
    chest, rng = Chest(seed, closed or sliding), np.random.default_rng([seed, 1])
    x = np.stack(np.meshgrid(*(np.arange(n) * s for n, s in zip(shape, spacing, strict=True)), indexing="ij"), axis=-1).reshape(-1, 3)
    # a slice is the mean over its thickness, at a third of it
    thirds = [np.array([0.0, 0.0, k * slice_mm / 3.0]) for k in (-1, 0, 1)]

    def breathed_in(y: Array) -> Array:
        at = came_from(y)
        if not sliding:
            return chest(at)[0]
        at = slid(at, -1.0)
        return chest(at, diluted(at))[0]

    before = np.mean([chest(x + t)[0] for t in thirds], axis=0)
    after = np.mean([breathed_in(x + t) for t in thirds], axis=0)
    at = slid(x) if sliding else x
    labels, u = chest(x)[1].reshape(shape), at + breathed(at) - x
    lands = ((x + u >= 0.0) & (x + u <= (np.array(shape) - 1) * spacing)).all(axis=1).reshape(shape)
    scans = [(v.reshape(shape) + NOISE * rng.standard_normal(shape)).astype(np.float32) for v in (before, after)]
    size = f"{slice_mm:g} mm slices" + ", sliding" * sliding
    meta = {"kind": "thorax", "size": size, "seed": seed, "noise": NOISE}
    return {
        "ref": scans[0], "deformed": scans[1], "spacing": spacing, "u": u.T.reshape(3, *shape).astype(np.float32), "labels": labels,
        "mask": (labels > 0) & lands, "meta": np.array(json.dumps(meta)),
    }  # fmt: skip


def main() -> None:
    """Make a case, and say what the default mask keeps of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--slice-mm", type=float, default=3.0)
    parser.add_argument("--pixel-mm", type=float, default=3.0)
    parser.add_argument("--sliding", action="store_true", help="lungs, closed in front, slide along the wall and grow darker")
    parser.add_argument("--closed", action="store_true", help="no slits in front of the lungs")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    case = chest_case(chosen.seed, chosen.slice_mm, chosen.closed, chosen.pixel_mm, sliding=chosen.sliding)
    np.savez_compressed(chosen.out, **case)
    scan = Volume.from_array(np.ascontiguousarray(case["ref"].T), spacing_mm=case["spacing"])
    kept, labels = object_mask(scan).T, case["labels"]
    jumps = mask_jumps(kept.T)
    beside = (kept & (labels == 0)).sum() / kept.sum()
    print(f"lungs {kept[labels == 2].mean():.1%}, body {kept[labels > 0].mean():.1%} kept; {beside:.1%} of the mask outside of the body")
    print("jumps between slices: " + (", ".join(f"{k - 1} and {k}" for k in jumps) or "none"))


if __name__ == "__main__":
    main()
