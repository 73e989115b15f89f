"""Accuracy of digital volume correlation on pairs with known displacement, with and without each of its parts.

Run: python benchmarks/sense_volumes.py CASE.npz [CASE.npz ...] [--ablation] [--conditions [NAME ...]] [--progress]

CASE.npz holds ref and deformed (nx, ny, nz), spacing (3,), the true displacement u (3, nx, ny, nz), mm, labels of tissues, the mask of the
object, and meta, which names the kind of the case. Errors are mean / median / 95th percentile of the end-point error in the object, mm,
over voxels with a displacement; "measured" is their fraction. "gradient" is the root mean square error of the displacement gradient by
central differences of the voxels' displacement, "covered" the fraction of voxels whose true displacement lies in the 95 % ellipsoid of the
stated covariance. A first pair of small volumes compiles everything; times are wall and processor time of one run, the peak is that of the
process so far. With --conditions the scans are damaged or replaced (see `CONDITIONS`), and what is refused says why.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.settings import CorrelationSettings

Array = NDArray[Any]
TISSUES = {
    "limb": {"skin+fat": (1, 2), "muscle": (3, 6), "bone": (4, 5)},
    "gel": {"soft": (1,), "hard": (2,)},
    "ball": {"ball": (1,)},
    "thorax": {"soft": (1,), "lung": (2,), "bone": (3,)},
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


def noisier(case: dict[str, Array]) -> dict[str, Array]:
    """Three times the noise of both scans."""
    rng, sd = np.random.default_rng(5), json.loads(str(case["meta"]))["noise"] * np.sqrt(8.0)
    return case | {key: (case[key] + sd * rng.standard_normal(case[key].shape)).astype(np.float32) for key in ("ref", "deformed")}


def biased(case: dict[str, Array]) -> dict[str, Array]:
    """The second scan brighter and darker by up to 30 % from place to place."""
    x, y, z = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in case["ref"].shape), indexing="ij")
    return case | {"deformed": (case["deformed"] * (1.0 + 0.3 * np.sin(1.3 * x + 0.4) * np.cos(1.1 * y - 0.3 * z))).astype(np.float32)}


def cropped(axis: int, fill: float, key: str = "deformed", end: int = 1) -> Callable[[dict[str, Array]], dict[str, Array]]:
    """A fifth of the object, at an end of an axis, missing in a scan and filled."""

    def made(case: dict[str, Array]) -> dict[str, Array]:
        where = np.argwhere(case["mask"])[:, axis]
        low, high = int(where.min()), int(where.max()) + 1
        lost = round(0.2 * (high - low))
        values = case[key].astype(np.float32)
        values[(slice(None),) * axis + (slice(high - lost, None) if end else slice(0, low + lost),)] = fill
        return case | {key: values}

    return made


def thick(case: dict[str, Array]) -> dict[str, Array]:
    """The means of three slices as one."""
    n = case["ref"].shape[2] // 3 * 3
    scans = {key: case[key][..., :n].reshape(*case[key].shape[:2], -1, 3).mean(axis=-1) for key in ("ref", "deformed")}
    rest = {key: case[key][..., 1:n:3] for key in ("u", "mask", "labels")}
    return case | scans | rest | {"spacing": case["spacing"] * [1.0, 1.0, 3.0]}


def second_body(case: dict[str, Array]) -> dict[str, Array]:
    """A textured cylinder beside the object, which moves by itself."""
    texture = ndimage.gaussian_filter(np.random.default_rng(9).standard_normal(case["ref"].shape), 1.5)
    x, y = (np.arange(n) * s for n, s in zip(case["ref"].shape[:2], case["spacing"], strict=False))
    inside = np.hypot(x[:, None] - 0.08 * x[-1], y - 0.1 * y[-1]) < 14.0
    body = np.where(inside[..., None], 0.8 * np.percentile(case["ref"], 90) + 50.0 * texture / texture.std(), 0.0)
    return case | {key: np.maximum(case[key], np.roll(body, shift, 0)) for key, shift in (("ref", 0), ("deformed", 4))}


def dark_background(case: dict[str, Array]) -> dict[str, Array]:
    """A fifth of z zero, as the air about the object in both scans is, without noise."""
    air = {key: np.where(ndimage.gaussian_filter(case[key].astype(np.float32), 1.0) < 80.0, 0.0, case[key]) for key in ("ref", "deformed")}
    return cropped(2, 0.0)(case | air)


def blurred_noise(case: dict[str, Array]) -> dict[str, Array]:
    """Two textures that have nothing to do with each other, in the outline of the object."""
    rng = np.random.default_rng(4)

    def texture() -> Array:
        values = ndimage.gaussian_filter(rng.standard_normal(case["ref"].shape), 1.5)
        return np.where(case["mask"], 500.0 + 80.0 * values / values.std(), 0.0) + 12.0 * rng.standard_normal(values.shape)

    return case | {key: texture().astype(np.float32) for key in ("ref", "deformed")}


def noise_alone(case: dict[str, Array]) -> dict[str, Array]:
    """Two volumes of noise."""
    rng = np.random.default_rng(3)
    return case | {key: 500.0 + 50.0 * rng.standard_normal(case[key].shape) for key in ("ref", "deformed")}


# what is done to a case; "another object" takes the second scan of the next case
CONDITIONS: dict[str, Callable[[dict[str, Array]], dict[str, Array]]] = {
    "as it is": dict,
    "3x noise": noisier,
    "bias 30 %": biased,
    **{
        f"20 % of {axis} {fill}, {scan} scan": cropped("xyz".index(axis), value, key, end)
        for scan, key, ends in (("2nd", "deformed", (1, 0, 1)), ("1st", "ref", (0, 1, 0)))
        for axis, end in zip("xyz", ends, strict=True)
        for fill, value in (("zero", 0.0), ("NaN", np.nan))
    },
    "20 % of z zero, as the air is": dark_background,
    "thick slices": thick,
    "second body": second_body,
    "noise alone": noise_alone,
    "unrelated textures": blurred_noise,
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
    grid = Volume.from_array(np.zeros(case["ref"].shape[::-1]), spacing_mm=case["spacing"])
    reference, deformed = (grid.with_values(zyx(case[key])) for key in ("ref", "deformed"))
    wall, busy = time.perf_counter(), time.process_time()
    try:
        found = correlate_volumes(
            reference, deformed, settings=settings, progress=(lambda report: print("   ", report, flush=True)) if progress else None
        )
    except InputError as error:
        print(f"{name:30s} refused: {error}", flush=True)
        return
    wall, busy = time.perf_counter() - wall, time.process_time() - busy
    s = score(case, found)
    shown = " / ".join(f"{v:.3f}" for v in s["mm"])
    tissues = "  ".join(f"{tissue} {v:.3f}" for tissue, v in s["tissues"].items())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name:30s} {shown}   {tissues}   {s['gradient']:.4f}   {s['covered']:6.1%}   {s['measured']:6.1%}   {wall:6.1f} ({busy:.1f}) s"
        f"   {peak:.0f} MB",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+")
    parser.add_argument("--ablation", action="store_true", help="also without each of the parts")
    parser.add_argument("--conditions", nargs="*", metavar="NAME", help="also damaged or replaced scans: " + ", ".join(CONDITIONS))
    parser.add_argument("--progress", action="store_true", help="print every step")
    arguments = parser.parse_args()
    compile_all()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print("                               mean / median / 95 %, mm   tissues, mm   gradient   covered   measured   wall (processor)   peak")
    cases = [dict(np.load(path)) for path in arguments.cases]
    for k, case in enumerate(cases):
        meta = json.loads(str(case["meta"]))
        print(f"{meta['kind']}, {meta['size']}, seed {meta['seed']}")
        if arguments.conditions is not None:
            for name in arguments.conditions or CONDITIONS:
                show(name, CONDITIONS[name](case), ABLATION["default"], arguments.progress)
            other = cases[(k + 1) % len(cases)]["deformed"]
            if len(cases) > 1 and other.shape == case["ref"].shape:
                show("another object", case | {"deformed": other}, ABLATION["default"], False)
            continue
        for name, settings in (ABLATION if arguments.ablation else {"default": ABLATION["default"]}).items():
            show(name, case, settings, arguments.progress)


if __name__ == "__main__":
    main()
