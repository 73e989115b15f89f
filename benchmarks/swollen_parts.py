"""Bodies of which parts swell or shrink, in closed form: what volume correlation measures of it, and which part its 95 % regions hold.

Run: python benchmarks/swollen_parts.py [--noise 5 10 20] [--seeds 1] [--cases NAME ...] [--no-penalty]

The body is that of `naibu.validation.specimens.swollen_body`, in voxels of 1 mm: two spheres of it, of 12 and of 6 mm, change volume,
and the medium about them keeps its own; or the body swells as a whole, or its inner half does, or nothing. The texture has a standard
deviation of 30, and both scans the noise that is told. Printed are, for every sphere, the mean ratio of volumes within .6 of its radius,
and for the voxels within 1.5 radii the mean displacement without the common shift and the mean error, mm, and the part that the regions
hold; then the mean error and the part held of the whole body, and the processor time.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.validation.specimens.swollen_body import MIDDLE_MM, SwollenSphere, swollen_body

Array = NDArray[Any]
CHI_SQUARED_95 = 7.815  # three degrees of freedom
SHIFT_MM = (0.6, -0.3, 0.4)


def spheres(ratio: float) -> tuple[SwollenSphere, ...]:
    """Return both spheres."""
    return SwollenSphere((24.0, 29.5, 25.5), 12.0, ratio), SwollenSphere((50.0, 29.5, 25.5), 6.0, ratio)


def around(radius_mm: float, ratio: float) -> tuple[SwollenSphere, ...]:
    """Return a sphere about the middle of the body."""
    return (SwollenSphere(tuple(MIDDLE_MM), radius_mm, ratio),)


CASES = {
    "swell by 15 %": spheres(1.15),
    "shrink by 15 %": spheres(0.85),
    "swell by 40 %": spheres(1.4),
    "shrink by 30 %": spheres(0.7),
    "whole swells by 20 %": around(100.0, 1.2),
    "whole shrinks by 20 %": around(100.0, 0.8),
    "inner half by 25 %": around(19.0, 1.25),
    "nothing": (),
}


def told(name: str, noise: float, seed: int, settings: CorrelationSettings) -> None:
    """Measure a case and print its rows."""
    parts = CASES[name]
    body = swollen_body(parts, seed=seed, noise=noise, shift_mm=SHIFT_MM)
    began = time.process_time()
    found = correlate_volumes(body.before, body.after, mask=body.mask, settings=settings)
    busy = time.process_time() - began
    valid = found.valid & body.mask
    off = np.linalg.norm(np.where(valid[..., None], found.displacement.vectors - body.displacement, 0.0), axis=-1)
    ratio = np.linalg.det(np.eye(3) + np.where(valid[..., None, None], found.gradient(), 0.0))
    held = np.zeros(valid.shape, dtype=bool)
    at = np.argwhere(valid)
    error, covariance = (found.displacement.vectors - body.displacement)[valid], found.covariance_at(at[:, ::-1].astype(float))
    held[valid] = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]) < CHI_SQUARED_95
    print(f"{name:22s} noise {noise:2g}, seed {seed}: error {off[valid].mean():.3f} mm, held {held[valid].mean():6.1%}, {busy:.1f} s")
    x = positions(body.before)
    for part in parts:
        r = np.linalg.norm(x - np.asarray(part.middle_mm), axis=-1) / part.radius_mm
        near, core = valid & (r < 1.5), valid & (r < 0.6)
        moved = np.linalg.norm(body.displacement[near] - SHIFT_MM, axis=-1).mean()
        print(
            f"   radius {part.radius_mm:3g} mm: volumes {ratio[core].mean():.3f} of {part.ratio:.2f}; moved by {moved:.3f} mm, "
            f"error {off[near].mean():.3f} mm, held {held[near].mean():6.1%}",
            flush=True,
        )


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", type=float, nargs="+", default=[5.0, 10.0, 20.0], help="standard deviations of the noise")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="of texture and noise")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--no-penalty", action="store_true", help="without the penalty of dilatation")
    chosen = parser.parse_args()
    settings = CorrelationSettings(dilatation_penalty=not chosen.no_penalty)
    compiled = swollen_body((), seed=0)
    correlate_volumes(compiled.before, compiled.after, mask=compiled.mask)
    for noise in chosen.noise:
        for seed in chosen.seeds:
            for name in chosen.cases:
                told(name, noise, seed, settings)


if __name__ == "__main__":
    main()
