"""Volumes larger than memory: a textured ball generated chunk by chunk, measured block by block; time, memory, error.

Run: python benchmarks/large_volumes.py [--sizes 160 256] [--memory-gb 4] [--workers 1] [--in-memory] [--peers] [--limit 300] [--record]

The radius of the ball is two fifths of the edge of its box, ``size`` voxels. Its texture, with details of 2.5 and 6 voxels, is a function
of the material point, and both scans are evaluated where a voxel came from: no interpolation couples them. They are written to Zarr
chunk by chunk and read block by block. Errors are those of the written displacement at voxels in the ball, in voxels. Each measurement runs
in a process of its own, whose peak memory and processor time are told, compilation excluded by a small pair before. With ``--in-memory``
the same scans are measured in memory, with ``--peers`` by SimpleITK's demons and B-splines (8 cells an edge), where it is
installed; one of these ends after ``--limit`` seconds of processor time. SimpleITK has as many threads
as ``OMP_NUM_THREADS`` says, by default 2.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from ball_case import NOISE, moved
from ball_kernels import ball_intensities
from numpy.typing import NDArray
from records import ResultTable, write_record
from scipy import ndimage

from naibu.core.volume import Volume
from naibu.io.image_formats.zarr_store import create_chunked, open_array
from naibu.io.images import read_volume

Array = NDArray[Any]
CHUNK = 64
SAMPLED = 4  # every so many voxels along every axis an error is evaluated
PEERS = ("demons", "B-splines")
COLUMNS = ("size", "method", "mean error, voxel", "95 % error, voxel", "stated SD, median, voxel", "processor, s", "wall, s", "peak, MB")


@cache
def texture() -> list[tuple[Array, float]]:
    """Return periodic splines and the distance of their points, voxels."""
    rng, out = np.random.default_rng(1), []
    for length in (2.5, 6.0):
        values = ndimage.gaussian_filter(rng.standard_normal((64, 64, 64)), 0.7, mode="wrap")
        out.append((ndimage.spline_filter(values / values.std(), 3, mode="grid-wrap"), 0.7 * length))
    return out


def ball(box: tuple[slice, ...], size: int, deformed: bool) -> Array:
    """Return the intensities of a box of voxels (z, y, x), before or after the motion."""
    (fine, fine_step), (coarse, coarse_step) = texture()
    out = np.empty(tuple(s.stop - s.start for s in box))
    ball_intensities(np.array([s.start for s in box]), size, deformed, fine, fine_step, coarse, coarse_step, out)
    return out


def write_scans(folder: Path, size: int) -> None:
    """Write both scans as Zarr of 16-bit intensities, chunk by chunk."""
    grid = Volume(np.broadcast_to(np.float32(0), (size,) * 3), np.ones(3), np.zeros(3), np.eye(3))
    arrays = [create_chunked(folder / f"{name}.zarr", grid, dtype=np.uint16, chunk=CHUNK) for name in ("reference", "deformed")]
    for number, corner in enumerate(product(range(0, size, CHUNK), repeat=3)):
        box = tuple(slice(a, min(a + CHUNK, size)) for a in corner)
        for k, array in enumerate(arrays):
            values = ball(box, size, bool(k))
            values += NOISE * np.random.default_rng((2, k, number)).standard_normal(values.shape, dtype=np.float32)
            array[box] = np.clip(np.rint(100.0 + values), 0, 65535).astype(np.uint16)


def errors(displacement: Any, sd: Any, size: int) -> tuple[float, float, float]:
    """Return mean and 95th percentile of the errors, and the median standard deviation, slab by slab."""
    found, stated = [], []
    for z in range(0, size, CHUNK):
        part = np.asarray(displacement[z : z + CHUNK])[::SAMPLED, ::SAMPLED, ::SAMPLED]
        at = np.stack(np.meshgrid(*(np.arange(n) * SAMPLED for n in part.shape[:3]), indexing="ij"), axis=-1)[..., ::-1] + [0, 0, z]
        inside = (np.linalg.norm(at - 0.5 * (size - 1), axis=-1) < 0.4 * size) & np.isfinite(part).all(axis=-1)
        found.append(np.linalg.norm(part[inside] - moved(at[inside].astype(float), size), axis=1))
        if sd is not None:
            stated.append(np.asarray(sd[z : z + CHUNK])[::SAMPLED, ::SAMPLED, ::SAMPLED][inside])
    e = np.concatenate(found)
    return float(e.mean()), float(np.percentile(e, 95)), float(np.median(np.concatenate(stated))) if stated else float("nan")


def measure(method: str, folder: Path, size: int, memory_gb: float, workers: int) -> dict[str, float]:
    """Measure the scans in a folder, in this process, and return what it took and found."""
    paths = folder / "reference.zarr", folder / "deformed.zarr"
    before, began = _processor(), time.perf_counter()
    if method == "by blocks":
        from naibu.workflows.measurement.sense_blocks import MemoryPlan, sense_blocks

        plan = MemoryPlan.of((size,) * 3, memory_gb, workers)
        out = folder / f"moved-{workers}"
        sense_blocks(*paths, out=out, plan=plan, workers=workers, overwrite=True)
        displacement, sd = (open_array(out / f"{name}.zarr") for name in ("displacement", "standard_deviation"))
    elif method == "in memory":
        from naibu.imaging.measure_displacement import measure_displacement

        found = measure_displacement(*(read_volume(path) for path in paths)).displacement
        displacement, sd = found.vectors, found.largest_sd_mm
    else:
        displacement, sd = _peer(method, [read_volume(path).values.astype(np.float32) for path in paths]), None
    busy, wall = _processor() - before, time.perf_counter() - began
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024.0
    mean, most, stated = errors(displacement, sd, size)
    return {"mean": mean, "p95": most, "sd": stated, "processor": busy, "wall": wall, "peak": peak}


def _peer(method: str, scans: list[Array]) -> Array:
    """Return the displacement (nz, ny, nx, 3) by a method of SimpleITK."""
    import SimpleITK as sitk

    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(int(os.environ.get("OMP_NUM_THREADS", "2")))
    fixed, moving = (sitk.GetImageFromArray(scan) for scan in scans)
    field = None
    if method == "demons":
        for shrink, steps in ((4, 50), (2, 30), (1, 20)):
            demons = sitk.DiffeomorphicDemonsRegistrationFilter()
            demons.SetNumberOfIterations(steps)
            demons.SetStandardDeviations(1.5)
            small = [
                sitk.Shrink(sitk.SmoothingRecursiveGaussian(v, 0.5 * shrink), [shrink] * 3) if shrink > 1 else v for v in (fixed, moving)
            ]
            start = (
                None if field is None else sitk.Resample(field, small[0], sitk.Transform(), sitk.sitkLinear, 0.0, sitk.sitkVectorFloat64)
            )
            field = demons.Execute(*small) if start is None else demons.Execute(*small, start)
    else:
        start = sitk.BSplineTransformInitializer(fixed, [8, 8, 8], order=3)
        registration = sitk.ImageRegistrationMethod()
        registration.SetMetricAsMeanSquares()
        registration.SetMetricSamplingStrategy(registration.RANDOM)
        registration.SetMetricSamplingPercentage(0.1, seed=1)
        registration.SetInterpolator(sitk.sitkLinear)
        registration.SetOptimizerAsLBFGSB(numberOfIterations=50)
        registration.SetShrinkFactorsPerLevel([4, 2, 1])
        registration.SetSmoothingSigmasPerLevel([2.0, 1.0, 0.0])
        registration.SetInitialTransform(start, inPlace=False)
        field = sitk.TransformToDisplacementField(registration.Execute(fixed, moving), sitk.sitkVectorFloat64, fixed.GetSize())
    return np.asarray(sitk.GetArrayFromImage(field))


def _processor() -> float:
    use = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in use)


def main() -> None:
    """Measure all sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[160])
    parser.add_argument("--memory-gb", type=float, default=4.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--in-memory", action="store_true")
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--limit", type=int, default=300, help="seconds of processor time of a peer")
    parser.add_argument("--folder", type=Path, help="where the scans are kept; by default a temporary folder")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--one", nargs=2, metavar=("METHOD", "FOLDER"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        print(json.dumps(measure(chosen.one[0], Path(chosen.one[1]), chosen.sizes[0], chosen.memory_gb, chosen.workers)))
        return
    methods = ["by blocks", *(["in memory"] if chosen.in_memory else []), *(PEERS if chosen.peers else [])]
    rows: list[tuple[str | float | int, ...]] = []
    with tempfile.TemporaryDirectory(prefix="naibu-large-") as temporary:
        for size in (64, *chosen.sizes):  # the first compiles everything
            folder = (chosen.folder or Path(temporary)) / str(size)
            if not (folder / "deformed.zarr").exists():
                write_scans(folder, size)
            for method in methods:
                command = [sys.executable, __file__, "--sizes", str(size), "--memory-gb", str(chosen.memory_gb)]
                command += ["--workers", str(chosen.workers), "--one", method, str(folder)]
                limit = chosen.limit if method in PEERS else None
                done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, preexec_fn=partial(_limit, limit))
                if size == 64:
                    continue
                rows.append((size, method, *_cells(done, limit)))
                print("  ".join(f"{name} {value}" for name, value in zip(COLUMNS, rows[-1], strict=True)), flush=True)
                if chosen.record:
                    write_record("large_volumes", [ResultTable("large_volumes", COLUMNS, tuple(rows))])


def _limit(seconds: int | None) -> None:
    if seconds is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))


def _cells(done: subprocess.CompletedProcess[str], limit: int | None) -> tuple[str | float | int, ...]:
    """Return what a process measured, as cells of the table."""
    if done.returncode:
        ended = limit is not None and -done.returncode in (signal.SIGXCPU, signal.SIGKILL)
        return ("not done" if ended else "failed", "", "", f"> {limit}" if ended else "", "", "")
    f = json.loads(done.stdout.splitlines()[-1])
    return (
        *("" if np.isnan(f[k]) else round(f[k], 4) for k in ("mean", "p95", "sd")),
        *(round(f[k]) for k in ("processor", "wall", "peak")),
    )


if __name__ == "__main__":
    main()
