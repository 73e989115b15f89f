"""Scans of which one shows what the other does not: what volume correlation measures there, and which part its 95 % regions hold.

Run: python benchmarks/intruded_body.py [--seeds 31] [--cases NAME ...]

The body is that of `naibu.validation.specimens.intruded_body`, in voxels of 1 mm. "Hidden" are voxels of it that a scan does not show,
"near" those within 4 mm of them, "rest" all others: printed are the part that was measured, and of it the part that the regions hold, then
the root mean square error of a component of the displacement in the whole body, the median of its stated standard deviation, mm, and the
processor time. The last cases hide nothing: weak texture, or noise as large as most of it.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.validation.specimens.intruded_body import Intruder, bent, intruded_body
from naibu.validation.specimens.swollen_body import AIR, TEXTURE, TISSUE

Array = NDArray[Any]
CHI_SQUARED_95 = 7.815  # three degrees of freedom
HERE = (44.0, 26.0, 28.0)
THERE = tuple(bent(np.array(HERE)))
RISEN = (THERE[0], THERE[1] + 3.0, THERE[2])
# what is put into the scans, the noise, and the standard deviation of the texture
CASES: dict[str, tuple[tuple[Intruder, ...], float, float]] = {
    "bubble comes, 4 mm": ((Intruder(4.0, AIR, None, THERE),), 8.0, TEXTURE),
    "bubble rises by 3 mm": ((Intruder(5.0, AIR, HERE, RISEN),), 10.0, TEXTURE),
    "needle goes": ((Intruder(1.2, 400.0, HERE, None, 8.0),), 15.0, TEXTURE),
    "other tissue, 7 mm": ((Intruder(7.0, None, HERE),), 15.0, TEXTURE),
    "smooth tissue, 6 mm": ((Intruder(6.0, TISSUE, None, THERE),), 20.0, TEXTURE),
    "nothing, much noise": ((), 20.0, TEXTURE),
    "texture of a quarter": ((), 2.5, TEXTURE / 4.0),
    "the same, more noise": ((), 5.0, TEXTURE / 4.0),
}


def told(name: str, seed: int) -> None:
    """Measure a case and print its row."""
    intruders, noise, texture = CASES[name]
    body = intruded_body(intruders, seed=seed, noise=noise, texture=texture)
    began = time.process_time()
    found = correlate_volumes(body.before, body.after, mask=body.mask)
    busy = time.process_time() - began
    valid = found.valid & body.mask
    error = (found.displacement.vectors - body.displacement)[valid]
    covariance = found.covariance_at(np.argwhere(valid)[:, ::-1].astype(float))
    held = np.zeros(valid.shape, dtype=bool)
    held[valid] = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95
    away = ndimage.distance_transform_edt(~body.hidden) if body.hidden.any() else np.full(valid.shape, np.inf)
    zones = {"hidden": away == 0.0, "near": (away > 0.0) & (away < 4.0), "rest": away >= 4.0}
    rows = ", ".join(f"{zone} {_part(valid, where & body.mask)} held {_part(held, where & valid)}" for zone, where in zones.items())
    sd = np.median(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0))
    print(f"{name:22s} seed {seed}: {rows}; error {np.sqrt((error**2).mean()):.3f}, stated {sd:.3f} mm, {busy:.1f} s", flush=True)


def _part(which: Array, of: Array) -> str:
    return f"{which[of].mean():4.0%}" if of.any() else "   -"


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[31], help="of textures and noise")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    chosen = parser.parse_args()
    for seed in chosen.seeds:
        for name in chosen.cases:
            told(name, seed)


if __name__ == "__main__":
    main()
