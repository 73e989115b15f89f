"""Accuracy of classic methods on a volume pair with known displacement, and their speed compared with loops in NumPy.

Run: python benchmarks/sense_classic.py CASE.npz [--loops]

CASE.npz holds ref and deformed (nx, ny, nz), spacing (3,), the true displacement u (3, nx, ny, nz), mm, the mask of the object, and the
rigid part of the motion (4, 4). The rigid registration is found from the bones where SimpleITK is installed and the case has bones, and is
taken from the case elsewhere. Errors are mean / median / 95th percentile of the end-point error in the object, mm, counting voxels without
a displacement as displaced by the rigid motion alone.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import MissingDependencyError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import block_matching
from naibu.imaging.dense_matching.hybrid import hybrid_flow
from naibu.imaging.dense_matching.optical_flow import AS_REPORTED, horn_schunck, lucas_kanade
from naibu.imaging.displacement.accuracy import end_point_error, intensity_rms
from naibu.imaging.displacement.strain import folded_fraction
from naibu.imaging.feature_matching.correlation_matching import Candidates, candidate_matches
from naibu.imaging.feature_matching.harris import interest_points
from naibu.imaging.feature_matching.relaxation_labelling import STRENGTHS, relaxed
from naibu.imaging.feature_matching.scattered_interpolation import dense_from_sparse, sparse_displacement, triangulated
from naibu.imaging.preprocessing.bone_mask import bone_mask
from naibu.imaging.preprocessing.resampling import positions, resampled_to_grid
from naibu.imaging.preprocessing.rigid_registration import register_rigid, total_displacement

Array = NDArray[Any]
T = TypeVar("T")
BLOCK, SEARCH = (3, 3, 3), (15, 15, 1)


@dataclass(frozen=True)
class Case:
    """Pair of volumes, its true displacement, and its rigid motion."""

    reference: Volume
    deformed: Volume
    truth: Array
    mask: Array
    rigid: RigidTransform
    rigid_from: str

    @property
    def registered(self) -> Volume:
        """The deformed volume in the frame of the reference."""
        return resampled_to_grid(self.deformed, self.reference, through=self.rigid.applied)


def read_case(path: str) -> Case:
    data = np.load(path)
    reference, deformed = (
        Volume.from_array(np.ascontiguousarray(data[name].transpose(2, 1, 0)), spacing_mm=data["spacing"]) for name in ("ref", "deformed")
    )
    rigid, source = RigidTransform.from_matrix(data["rigid"]), "the case"
    if json.loads(str(data["meta"]))["kind"] == "limb":
        try:
            seconds, found = timed(lambda: register_rigid(reference, deformed, bone_mask(reference, appearance="dark", count=2)))
            rigid = found.transform
            source = f"SimpleITK on two bones, {seconds:.1f} s"
        except MissingDependencyError:
            pass
    mask = np.ascontiguousarray(data["mask"].transpose(2, 1, 0))
    return Case(reference, deformed, np.ascontiguousarray(data["u"].transpose(3, 2, 1, 0), dtype=float), mask, rigid, source)


def timed(work: Callable[[], T], repeat: int = 1) -> tuple[float, T]:
    best = np.inf
    for _ in range(repeat):
        start = time.perf_counter()
        result = work()
        best = min(best, time.perf_counter() - start)
    return best, result


def show(case: Case, name: str, seconds: float, vectors: Array, valid: Array) -> None:
    whole = total_displacement(np.where(np.isfinite(vectors), vectors, 0.0), case.rigid, case.reference)
    error = end_point_error(whole, case.truth, case.mask)
    shown = f"{error.mean_mm:5.2f} / {error.median_mm:4.2f} / {error.p95_mm:5.2f}"
    fraction = (valid & case.mask).sum() / case.mask.sum()
    rms = intensity_rms(case.reference, case.deformed, whole, region=case.mask, frame="reference")
    print(
        f"{name:44s} {shown}   {fraction:5.0%}   {folded_fraction(whole, case.reference, case.mask):6.1%}   {rms:6.1f}   {seconds:7.2f} s",
        flush=True,
    )


def features_and_relaxation(case: Case) -> None:
    def points() -> tuple[Array, Array]:
        return interest_points(case.reference, count=1000).points_mm, interest_points(case.deformed, count=5000).points_mm

    points()
    seconds_points, (x1, x2) = timed(points, 3)
    options: dict[str, Any] = {"rigid": case.rigid, "search": (8, 8, 3), "match": (4, 4, 2), "least_score": 0.5}
    matched = lambda: candidate_matches(case.reference, case.deformed, x1, x2, **options)  # noqa: E731
    matched()
    seconds_match, candidates = timed(matched, 3)
    print(f"\n{len(x1)} and {len(x2)} interest points in {seconds_points:.2f} s, {len(candidates)} candidates in {seconds_match:.2f} s")
    truth = {tuple(np.round(x, 6)): u for x, u in zip(x1, at_points(case, x1), strict=True)}
    print("strength      matches  right (< 2 mm)  iterations  tetrahedra  residual   error of the dense field, mm       all steps")
    for strength in STRENGTHS:
        relaxed(candidates, strength=strength)
        seconds, found = timed(lambda kind=strength: relaxed(candidates, strength=kind), 3)
        sparse = sparse_displacement(found)
        seconds_dense, dense = timed(lambda field=sparse: dense_from_sparse(field, case.reference, outside="affine"))
        off = np.linalg.norm(sparse.vectors - [truth[tuple(np.round(x, 6))] for x in sparse.points], axis=1)
        error = end_point_error(dense.vectors, case.truth, case.mask)
        shown = f"{error.mean_mm:5.2f} / {error.median_mm:4.2f} / {error.p95_mm:5.2f}"
        rms = intensity_rms(case.reference, case.deformed, dense.vectors, region=case.mask, frame="reference")
        simplices = len(triangulated(sparse.points, case.reference).simplices)
        total = seconds_points + seconds_match + seconds
        print(
            f"{strength:12s} {len(found):8d} {np.mean(off < 2.0):14.0%} {len(found.energies):11d} {simplices:11d} {rms:9.1f}   {shown}     "
            f"{total:.2f} + {seconds_dense:.2f} s dense",
            flush=True,
        )
    print("'all steps': interest points of both volumes, first matching and relaxation; then tetrahedra and the dense field")


def at_points(case: Case, points: Array) -> Array:
    index = np.rint(case.reference.to_index(points)).astype(int)
    return case.truth[index[:, 2], index[:, 1], index[:, 0]]


def dense_methods(case: Case) -> None:
    back = case.registered
    a, b = case.reference, back
    methods: dict[str, Callable[[], DisplacementField]] = {
        "block matching SAD 3x3x3 in 31x31x3": lambda: block_matching(a, b, block=BLOCK, search=SEARCH),
        "block matching SSD 7x7x5 in 17x17x9": lambda: block_matching(a, b, block=(7, 7, 5), search=(8, 8, 4), measure="ssd"),
        "block matching NCC 7x7x5 in 17x17x9": lambda: block_matching(a, b, block=(7, 7, 5), search=(8, 8, 4), measure="ncc"),
        "Horn-Schunck as reported": lambda: horn_schunck(a, b, **AS_REPORTED),
        "Horn-Schunck, pyramid": lambda: horn_schunck(a, b),
        "Lucas-Kanade, one grid": lambda: lucas_kanade(a, b, levels=1, warps=1, damping=0.0, median_filter=False),
        "Lucas-Kanade, pyramid": lambda: lucas_kanade(a, b),
        "hybrid as reported": lambda: hybrid_flow(
            a, b, block=BLOCK, search=SEARCH, **{k: v for k, v in AS_REPORTED.items() if k in HYBRID}
        ),
        "hybrid, pyramid": lambda: hybrid_flow(a, b, block=(7, 7, 5), search=(8, 8, 4), least_range=400.0),
    }
    print("\nafter the rigid registration                 mean / median / 95 %, mm   measured   folded   residual   time")
    show(case, "rigid motion alone", 0.0, np.zeros_like(case.truth), np.ones(a.shape, dtype=bool))
    for name, work in methods.items():
        warm_up(a, name)
        seconds, found = timed(work, 2)
        show(case, name, seconds, found.vectors, found.valid)


HYBRID = ("data_weight", "iterations", "warps", "levels")


def warm_up(a: Volume, name: str) -> None:
    """Compile on a corner of the volumes, so that times are those of a second run."""
    rng = np.random.default_rng(0)
    grid = a.cropped((0, 0, 0), (24, 24, 24))
    x, y = (grid.with_values(rng.uniform(0, 9, grid.shape).astype(np.float32)) for _ in range(2))
    if "block" in name or "hybrid" in name:
        block_matching(x, y, search=(1, 1, 1), measure="ncc" if "NCC" in name else "sad")
    (lucas_kanade if "Lucas" in name else horn_schunck)(x, y, warps=1)


def against_loops(case: Case) -> None:
    """Print times and those of equivalent loops in NumPy and SciPy on one thread.

    The loops do a part (200 voxels, 27 of 2883 displacements, 4 of 40 steps, 1 iteration), and their time is scaled to the whole.
    """
    a, b = (np.nan_to_num(v.values.astype(np.float32)) for v in (case.reference, case.registered))
    volume, other = case.reference, case.reference.with_values(b)
    print("\nthe same in NumPy                              NumPy s (of CPU)     naibu s (of CPU)     ratio (of CPU)")
    blocks = lambda: block_matching(volume, other, block=BLOCK, search=SEARCH, sub_voxel=False)  # noqa: E731
    displacements = int(np.prod([2 * s + 1 for s in SEARCH]))
    compare("full-volume block matching, loop over voxels", lambda: loop_voxels(a, b, 200), a.size / 200, blocks)
    compare("the same, NumPy loop over displacements", lambda: loop_block_matching(a, b, (1, 1, 1), (1, 1, 1)), displacements / 27, blocks)
    compare("Horn-Schunck, 40 steps, 4 of them", lambda: loop_horn_schunck(a, b, 4), 10, lambda: horn_schunck(volume, other, **AS_REPORTED))
    rng = np.random.default_rng(0)
    points = positions(volume)[case.mask][rng.integers(0, case.mask.sum(), 800)]
    field = DisplacementField.from_arrays(points, rng.standard_normal(points.shape))
    everywhere = positions(volume)
    compare(
        "dense field of 800 points (SciPy)",
        lambda: LinearNDInterpolator(points, field.vectors)(everywhere),
        1,
        lambda: dense_from_sparse(field, volume),
    )
    candidates = many_candidates(volume, other)
    found = relaxed(candidates, radius_mm=15.0, max_iterations=10)
    name = f"relaxation, {len(candidates)} pairs, 1 iteration of {len(found.energies)}"
    steps = len(found.energies)
    compare(name, lambda: loop_strengths(candidates), steps, lambda: relaxed(candidates, radius_mm=15.0, max_iterations=10))


def compare(name: str, slow: Callable[[], object], scale: float, fast: Callable[[], object]) -> None:
    """Print the wall and processor time of two ways, the slow one scaled."""
    fast()
    times = []
    for work, factor in ((slow, scale), (fast, 1.0)):
        wall, busy = time.perf_counter(), time.process_time()
        work()
        times.append(((time.perf_counter() - wall) * factor, (time.process_time() - busy) * factor))
    (wall_slow, busy_slow), (wall_fast, busy_fast) = times
    ratio = f"{wall_slow / wall_fast:6.0f} ({busy_slow / busy_fast:.0f})"
    print(f"{name:46s} {wall_slow:8.1f} ({busy_slow:.1f})   {wall_fast:10.3f} ({busy_fast:.3f})   {ratio}", flush=True)


def many_candidates(a: Volume, b: Volume) -> Candidates:
    x1, x2 = interest_points(a, count=1000).points_mm, interest_points(a, count=5000).points_mm
    return candidate_matches(a, b, x1, x2, search=(8, 8, 3), match=(3, 3, 2), least_score=0.2)


def loop_block_matching(a: Array, b: Array, half: tuple[int, ...], reach: tuple[int, ...]) -> Array:
    best, which, number = np.full(a.shape, np.inf, dtype=np.float32), np.zeros(a.shape, dtype=np.int32), 0
    for dz in range(-reach[2], reach[2] + 1):
        for dy in range(-reach[1], reach[1] + 1):
            for dx in range(-reach[0], reach[0] + 1):
                cost = np.abs(a - np.roll(b, (-dz, -dy, -dx), (0, 1, 2)))
                for axis, h in zip((2, 1, 0), half, strict=True):
                    cost = sum(np.roll(cost, i, axis) for i in range(-h, h + 1))
                better = cost < best
                best[better], which[better] = cost[better], number
                number += 1
    return which


def loop_voxels(a: Array, b: Array, n: int) -> Array:
    rng, out = np.random.default_rng(0), []
    hz, hy, hx = 1, 15, 15
    for _ in range(n):
        z, y, x = (int(rng.integers(h + 1, s - h - 1)) for h, s in zip((hz, hy, hx), a.shape, strict=True))
        block, best, at = a[z - 1 : z + 2, y - 1 : y + 2, x - 1 : x + 2], np.inf, (0, 0, 0)
        for dz in range(-hz, hz + 1):
            for dy in range(-hy, hy + 1):
                for dx in range(-hx, hx + 1):
                    other = b[z + dz - 1 : z + dz + 2, y + dy - 1 : y + dy + 2, x + dx - 1 : x + dx + 2]
                    if other.shape == block.shape and (cost := np.abs(block - other).sum()) < best:
                        best, at = cost, (dx, dy, dz)
        out.append(at)
    return np.array(out)


def loop_horn_schunck(a: Array, b: Array, steps: int) -> Array:
    gradient = np.gradient(0.5 * (a + b))
    change, squares = b - a, sum(g * g for g in gradient)
    u = [np.zeros_like(a) for _ in range(3)]
    for _ in range(steps):
        mean = [sum(np.roll(c, s, axis) for axis in range(3) for s in (-1, 1)) / 6.0 for c in u]
        factor = 4.0 * (sum(g * m for g, m in zip(gradient, mean, strict=True)) + change) / (1.0 + 4.0 * squares)
        u = [m - g * factor for g, m in zip(gradient, mean, strict=True)]
    return np.stack(u)


def loop_strengths(c: Candidates, radius: float = 15.0) -> Array:
    """Return strengths of all pairs in one iteration, NumPy over the neighbours of each."""
    moves = c.deformed_mm[c.pairs[:, 1]] - c.projected_mm[c.pairs[:, 0]]
    first, second = c.projected_mm[c.pairs[:, 0]], c.deformed_mm[c.pairs[:, 1]]
    out = np.empty(len(c))
    for p in range(len(c)):
        d1, d2 = np.linalg.norm(first - first[p], axis=1), np.linalg.norm(second - second[p], axis=1)
        near = (d1 <= radius) & (d2 <= radius) & (d1 > 0) & (d2 > 0)
        difference = np.abs(d1[near] - d2[near]) / (0.5 * (d1[near] + d2[near]))
        angle = moves[near] @ moves[p]
        out[p] = c.scores[p] + np.sum(c.scores[near] * np.exp(-np.where(angle > 0, 1, 3) / 3.0 * difference))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case")
    parser.add_argument("--loops", action="store_true", help="compare with loops in NumPy (a minute or two)")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    case = read_case(arguments.case)
    shape, spacing = case.reference.shape[::-1], np.round(case.reference.spacing_mm, 3)
    print(f"{shape} voxels of {spacing} mm; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; rigid motion from {case.rigid_from}")
    features_and_relaxation(case)
    dense_methods(case)
    if arguments.loops:
        against_loops(case)


if __name__ == "__main__":
    main()
