"""Accuracy of digital volume correlation on pairs with known displacement, with and without each of its parts.

Run: python benchmarks/sense_volumes.py CASE.npz [CASE.npz ...] [--ablation] [--progress]

CASE.npz holds ref and deformed (nx, ny, nz), spacing (3,), the true displacement u (3, nx, ny, nz), mm, labels of tissues, the mask of the
object, and meta, which names the kind of the case. Errors are mean / median / 95th percentile of the end-point error in the object, mm,
over voxels with a displacement; "measured" is their fraction. "gradient" is the root mean square error of the displacement gradient by
central differences of the voxels' displacement, "covered" the fraction of voxels whose true displacement lies in the 95 % ellipsoid of the
stated covariance. A first pair of small volumes compiles everything; times are wall and processor time of one run, the peak is that of the
process so far.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from naibu.core.volume import Volume
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.result import CorrelationResult
from naibu.imaging.volume_correlation.settings import CorrelationSettings

Array = NDArray[Any]
TISSUES = {
    "limb": {"skin+fat": (1, 2), "muscle": (3, 6), "bone": (4, 5)},
    "gel": {"soft": (1,), "hard": (2,)},
}
CHI_SQUARED_95 = 7.815  # three degrees of freedom
ABLATION = {
    "default": CorrelationSettings(),
    "no local gain": CorrelationSettings(local_gain=False),
    "not robust": CorrelationSettings(robust=np.inf),
    "no dilatation penalty": CorrelationSettings(dilatation_penalty=False),
    "fixed weights": CorrelationSettings(adaptive_weight=False),
    "no rigid inclusions": CorrelationSettings(rigid_inclusions=False),
    "gradients of both": CorrelationSettings(gradients="mean"),
    "gradients of the deformed": CorrelationSettings(gradients="deformed"),
    "no sub-voxel jitter": CorrelationSettings(jitter_sd_voxels=0.0),
}


def zyx(values: Array) -> Array:
    return np.ascontiguousarray(np.moveaxis(values, (-3, -2, -1), (-1, -2, -3)))


def compile_all() -> None:
    rng = np.random.default_rng(0)
    values = 100.0 + 50.0 * ndimage.gaussian_filter(rng.standard_normal((20, 24, 28)), 1.5) / 0.1
    grid = Volume.from_array(values.astype(np.float32), spacing_mm=(1.0, 1.0, 1.0))
    inner = np.zeros(values.shape, dtype=bool)
    inner[4:-4, 4:-4, 4:-4] = True
    correlate_volumes(grid, grid.with_values(np.roll(values, 1, 2).astype(np.float32)), mask=np.ones_like(inner), rigid_mask=inner)


def score(case: dict[str, Array], found: CorrelationResult) -> dict[str, Any]:
    truth, mask, labels = np.moveaxis(zyx(case["u"]), 0, -1), zyx(case["mask"]), zyx(case["labels"])
    measured = mask & found.valid
    off = np.where(measured[..., None], found.displacement.vectors - truth, 0.0)
    length = np.linalg.norm(off, axis=-1)
    kind = json.loads(str(case["meta"]))["kind"]
    out: dict[str, Any] = {"measured": measured.sum() / mask.sum(), "mm": (length[measured].mean(), np.median(length[measured]))}
    out["mm"] += (np.percentile(length[measured], 95),)
    out["tissues"] = {name: length[measured & np.isin(labels, which)].mean() for name, which in TISSUES[kind].items()}
    core = ndimage.binary_erosion(measured, border_value=0)
    gradients = [np.gradient(off, s, axis=axis)[core] for axis, s in zip((2, 1, 0), case["spacing"], strict=True)]
    out["gradient"] = float(np.sqrt(np.mean(np.square(gradients))))
    some = np.argwhere(measured)
    some = some[np.random.default_rng(0).choice(len(some), min(len(some), 20000), replace=False)]
    covariance = found.covariance_at(found.volume.to_physical(some[:, ::-1]))
    error = off[tuple(some.T)]
    distance = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    out["covered"] = float(np.mean(distance < CHI_SQUARED_95))
    return out


def show(name: str, case: dict[str, Array], settings: CorrelationSettings, progress: bool) -> None:
    reference, deformed = (Volume.from_array(zyx(case[key]), spacing_mm=case["spacing"]) for key in ("ref", "deformed"))
    wall, busy = time.perf_counter(), time.process_time()
    found = correlate_volumes(
        reference, deformed, settings=settings, progress=(lambda report: print("   ", report, flush=True)) if progress else None
    )
    wall, busy = time.perf_counter() - wall, time.process_time() - busy
    s = score(case, found)
    shown = " / ".join(f"{v:.3f}" for v in s["mm"])
    tissues = "  ".join(f"{tissue} {v:.3f}" for tissue, v in s["tissues"].items())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name:26s} {shown}   {tissues}   {s['gradient']:.4f}   {s['covered']:6.1%}   {s['measured']:6.1%}   {wall:6.1f} ({busy:.1f}) s"
        f"   {peak:.0f} MB",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+")
    parser.add_argument("--ablation", action="store_true", help="also without each of the parts")
    parser.add_argument("--progress", action="store_true", help="print every step")
    arguments = parser.parse_args()
    compile_all()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print("                           mean / median / 95 %, mm   tissues, mm   gradient   covered   measured   wall (processor)   peak")
    for path in arguments.cases:
        case = dict(np.load(path))
        meta = json.loads(str(case["meta"]))
        print(f"{meta['kind']}, {meta['size']}, seed {meta['seed']}")
        for name, settings in (ABLATION if arguments.ablation else {"default": ABLATION["default"]}).items():
            show(name, case, settings, arguments.progress)


if __name__ == "__main__":
    main()
