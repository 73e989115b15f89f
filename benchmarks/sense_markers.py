"""Marker tracking benchmark: washers in CT, particles, the states of the report, ultrasound echoes; right, wrong, error, seconds.

Run: python benchmarks/sense_markers.py [CASE.npz ...] [--seeds 0 1 2] [--particles 35000]

CASE.npz holds ref and deformed (nx, ny, nz), spacing (3,), and the true centres markers_ref and markers_def (n, 3), mm; the outer diameter
of the washers (2.8 mm) is the only setting. Particles are compressed to 0.7 or 0.58 of their height, rotated and shifted by several
spacings, and a tenth vanish or appear; noise is 2 % of a spacing. The states of the report are linked again without their labels. trackpy
is run on the same points where it is installed. The first call compiles; seconds are those of the second.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from naibu import datasets
from naibu.core.volume import Volume
from naibu.imaging.markers.linking.point_matching import link_markers
from naibu.imaging.markers.sequences.sequence_tracking import track_sequence
from naibu.imaging.markers.tracking import track_markers

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from marker_scenes import Cloud, particle_cloud, ultrasound

T = TypeVar("T")
Array = NDArray[Any]
WASHER_MM = 2.8


def timed(run: Callable[[], T]) -> tuple[T, str]:
    """Return the result of a call and its time; on a busy machine the CPU time of all threads is more reliable."""
    start, used = time.perf_counter(), time.process_time()
    out = run()
    return out, f"{time.perf_counter() - start:.1f} s ({time.process_time() - used:.1f} s of all threads)"


def gel(path: Path) -> str:
    """Track the washers of two volumes with default settings."""
    case = dict(np.load(path))
    volumes = [Volume.from_array(np.ascontiguousarray(case[k].T), spacing_mm=case["spacing"]) for k in ("ref", "deformed")]
    tracked, seconds = timed(lambda: track_markers(volumes, diameter_mm=WASHER_MM))
    which = cKDTree(case["markers_ref"]).query(tracked.points[0])[1]
    error = np.linalg.norm(tracked.points - np.stack([case["markers_ref"][which], case["markers_def"][which]]), axis=2)
    linked = (tracked.flags == "ok").all(axis=0)
    right = linked & (error < 1.0).all(axis=0)
    inside = np.abs(tracked.points - np.stack([case["markers_ref"][which], case["markers_def"][which]])) < 2.0 * tracked.sd_mm
    return (
        f"{len(case['markers_ref'])} washers: {right.sum()} right, {(linked & ~right).sum()} wrong; median centre error "
        f"{np.median(error[:, right]):.3f} mm ({', '.join(f'{v:.3f}' for v in np.median(error[:, right], axis=1))}), 95 % "
        f"{np.percentile(error[:, right], 95.0):.3f}; {inside[:, right].mean():.0%} within two stated deviations; {seconds}"
    )


def particles(seed: int, n: int, stretch: float, degrees: float) -> str:
    cloud = particle_cloud(n, seed, stretch=stretch, degrees=degrees, vanish=0.1, appear=0.1)
    links, seconds = timed(lambda: link_markers(cloud.reference, cloud.deformed))
    right, possible, wrong = cloud.judged(links.pairs)
    moved = np.median(cloud.displacement)
    return f"{n} particles, moved {moved:.1f} spacings: {right / possible:.2%} right, {wrong} wrong of {len(links)}; {seconds}" + peer(
        cloud
    )


def peer(cloud: Cloud) -> str:
    """Link the same particles with trackpy, with a search range of one spacing and no motion model."""
    try:
        import trackpy
    except ImportError:
        return "; trackpy: not installed"
    trackpy.quiet()
    if len(cloud.reference) > 5000:
        return "; trackpy: not tried on so many"
    try:
        levels, seconds = timed(lambda: list(trackpy.link_iter([cloud.reference, cloud.deformed], search_range=1.0)))
    except trackpy.SubnetOversizeException:
        return "; trackpy: gives up (sub-network too large)"
    first, second = (dict(zip(ids, range(len(ids)), strict=True)) for _, ids in levels)
    pairs = np.array([(first[k], second[k]) for k in first.keys() & second.keys()]).reshape(-1, 2)
    right, possible, wrong = cloud.judged(pairs)
    return f"; trackpy {right / possible:.2%} right, {wrong} wrong; {seconds}"


def report_states(seed: int) -> list[str]:
    """Link every measured state to the reference state without their labels."""
    rng, rows = np.random.default_rng(seed), []
    for name in datasets.names():
        experiment = datasets.load(name)
        seen = slice(0, experiment.dimensions)
        for state in experiment.states[1:]:
            if state.markers is None:
                continue
            here, there = (np.isfinite(m.points[:, seen]).all(axis=1) for m in (experiment.initial, state.markers))
            order = rng.permutation(int(there.sum()))
            ids, a = state.markers.ids[there][order], experiment.initial.points[here][:, seen]
            b = state.markers.points[there][order][:, seen]
            links, seconds = timed(lambda a=a, b=b: link_markers(a, b))  # type: ignore[misc]
            right = int((ids[links.pairs[:, 1]] == experiment.initial.ids[here][links.pairs[:, 0]]).sum())
            both = len(np.intersect1d(ids, experiment.initial.ids[here]))
            rows.append(
                f"{name} {state.name}: {len(a)} and {len(b)} markers, {right} of {both} right, {len(links) - right} wrong; {seconds}"
            )
    return rows


def echoes(seed: int) -> str:
    scene = ultrasound(seed)
    found, seconds = timed(lambda: track_sequence(scene.frames, pixel_mm=scene.pixel_mm, diameter_mm=(3.0, 2.0)))
    if len(found) != scene.truth.shape[1]:
        return f"{len(found)} markers found, {scene.truth.shape[1]} are there; {seconds}"
    error = np.linalg.norm(found.points - scene.truth, axis=2)
    return (
        f"{len(found)} markers, {len(scene.frames)} frames: largest error {error.max():.3f} mm, median {np.median(error):.3f}, in gaps "
        f"{error[~found.seen].max():.3f}; {(error < 0.3).mean():.2%} within 0.3 mm; {seconds}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", type=Path)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--particles", type=int, default=35_000)
    arguments = parser.parse_args()
    particles(0, 2000, 0.8, 5.0)
    for number, path in enumerate(arguments.cases):
        if number == 0:
            gel(path)
        print(f"{path.stem}: {gel(path)}", flush=True)
    for seed in arguments.seeds:
        for stretch, degrees in ((0.7, 10.0), (0.58, 20.0)):
            print(
                f"seed {seed}, {1.0 - stretch:.0%} strain, {degrees:g} degrees: {particles(seed, arguments.particles, stretch, degrees)}",
                flush=True,
            )
        print(f"seed {seed}: {particles(seed, 2000, 0.7, 10.0)}", flush=True)
    for row in report_states(0):
        print(row, flush=True)
    for seed in arguments.seeds:
        print(f"ultrasound, seed {seed}: {echoes(seed)}", flush=True)


if __name__ == "__main__":
    main()
