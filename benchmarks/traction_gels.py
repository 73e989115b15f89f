"""Particles around cells that pull at a hydrogel: links, and whether stated deviations of displacement and gradient hold, near and far.

Run: python benchmarks/traction_gels.py [--particles 35000] [--seeds 0 1] [--losses 0.5] [--cases 0 1 2 3]

Cells with three adhesions at each end pull at an elastic space (Kelvin's solution of forces that are spread over `decay` spacings); the
largest displacement is `peak` spacings, in the last case after a rotation by 20 degrees. Noise, losses and false particles are those of
particle_gels.py. Near are particles that cells move by more than half a spacing. Wrong links are compared with their number by the stated
confidences. Held are the fractions of coordinates of the displacement, and of components of its gradient, within 1.96 stated standard
deviations of the truth; seconds are those of all threads. The first call compiles.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from naibu.core.errors import InputError
from naibu.imaging.markers.linking.particle_motion import ParticleMotion, particle_motion

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from traction_gels import TractionGel, traction_gel

CASES: tuple[dict[str, float], ...] = (
    {"peak": 3.0, "decay": 4.0},
    {"peak": 2.5, "decay": 1.5},
    {"peak": 4.0, "decay": 2.5},
    {"peak": 3.0, "decay": 2.0, "degrees": 20.0},
)


def held(gel: TractionGel, motion: ParticleMotion, some: np.ndarray) -> tuple[float, float]:
    """Return the fractions of displacements and gradients whose truth is within the stated bounds of 95 %."""
    at, sd = motion.field.points[some], motion.field.standard_deviation
    assert sd is not None
    u = np.abs(motion.field.vectors[some] - (gel.moved(at) - at)) < 1.96 * sd[some]
    slope = np.abs(motion.gradient[some] - gel.gradient(at)) < 1.96 * motion.gradient_sd[some]
    return float(u.mean()), float(slope.mean())


def rows(case: dict[str, float], loss: float, seed: int, particles: int) -> list[str]:
    """Link one cloud, and return rows of the table: all particles, and those near cells."""
    gel = traction_gel(particles, seed, cells=max(2, particles * 8 // 35_000), loss=loss, **case)
    words = f"| {case['peak']:g}, {case['decay']:g}{', turned' if 'degrees' in case else ''} | {loss:.0%} | {seed} |"
    used = time.process_time()
    try:
        motion = particle_motion(gel.cloud.reference, gel.cloud.deformed)
    except InputError as error:
        return [f"{words} refused: {error} |"]
    used = time.process_time() - used
    here, there = motion.links.pairs.T
    truth, near, out = gel.cloud.truth, gel.cloud.displacement > 0.5, []
    right = truth[here] == there
    for name, among in (("all", np.ones(len(truth), dtype=bool)), ("near", near)):
        mine = among[here]
        u, slope = held(gel, motion, mine & motion.field.valid)
        out.append(
            f"{words} {name} | {right[mine].mean():.4f} | {right[mine].sum() / (truth[among] >= 0).sum():.4f} | {(~right[mine]).sum()} | "
            f"{np.sum(1.0 - motion.links.confidence[mine]):.0f} | {u:.1%} | {slope:.1%} | {used:.1f} |"
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=35_000)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1])
    parser.add_argument("--losses", nargs="*", type=float, default=[0.5])
    parser.add_argument("--cases", nargs="*", type=int, default=list(range(len(CASES))))
    arguments = parser.parse_args()
    rows(CASES[0], 0.1, 0, 2000)
    print("| peak, decay | lost | seed | particles | precision | recall | wrong | as stated | displacement held | gradient held | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for case in arguments.cases:
        for loss in arguments.losses:
            for seed in arguments.seeds:
                print("\n".join(rows(CASES[case], loss, seed, arguments.particles)), flush=True)


if __name__ == "__main__":
    main()
