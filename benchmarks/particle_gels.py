"""Links between particles in a gel under an indenter, half of which may be lost with depth: precision, recall, confidence and time.

Run: python benchmarks/particle_gels.py [--particles 35000] [--seeds 0 1 2] [--losses 0.1 0.3 0.5]

Particles lie 12 px apart on average in a block of 2 x 2 x 1. An indenter presses 36 px deep, and everything is shifted by 30 px. Noise is
0.2, 0.2 and 0.8 px along x, y and z, half of that at the surface and half as much again at the floor; one particle in ten of each state is
false. The probability to be lost in the second state rises linearly with depth; its mean is the loss of the first column. Precision is the
fraction of links that are right, recall the fraction of particles in both states that are linked rightly. The first call compiles.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from naibu.core.errors import InputError
from naibu.imaging.markers.linking.point_matching import link_markers

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from particle_gels import particle_gel


def row(loss: float, seed: int, particles: int) -> str:
    """Link one cloud, and return a row of the table."""
    cloud = particle_gel(particles, seed, loss=loss)
    start, used = time.perf_counter(), time.process_time()
    try:
        links = link_markers(cloud.reference, cloud.deformed)
    except InputError as error:
        return f"| {loss:.0%} | {seed} | refused: {error} |"
    seconds, used = time.perf_counter() - start, time.process_time() - used
    right, possible, wrong = cloud.judged(links.pairs)
    sure = links.confidence >= 0.9
    bad = cloud.truth[links.pairs[:, 0]] != links.pairs[:, 1]
    return (
        f"| {loss:.0%} | {seed} | {right / (right + wrong):.4f} | {right / possible:.4f} | {links.confidence.mean():.4f} | "
        f"{np.mean(~bad[sure]):.4f} | {seconds:.1f} | {used:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=35_000)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--losses", nargs="*", type=float, default=[0.1, 0.3, 0.5])
    arguments = parser.parse_args()
    row(0.1, 0, 2000)
    print("| lost | seed | precision | recall | mean confidence | precision of confidence >= 0.9 | s | s of all threads |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for loss in arguments.losses:
        for seed in arguments.seeds:
            print(row(loss, seed, arguments.particles), flush=True)


if __name__ == "__main__":
    main()
