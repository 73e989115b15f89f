"""Do random specimens converge, or fail with a reason? ``random_specimens.py [--count COUNT] [--seed SEED] [--all]``.

Boxes of two gels under a plate, a bar or between side plates: random edges, moduli, Poisson's ratios, friction and compression
(`naibu.validation.specimens.random_specimens` has the ranges). Prints how many converged, why the others did not, the deepest penetration
of a rigid body into an element as a fraction of its edge, and the processor time of a solution.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np

from naibu.core.errors import ConvergenceError
from naibu.validation import virtual_specimen
from naibu.validation.specimens.random_specimens import random_specimen


def main() -> None:
    """Solve the specimens and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="specimens")
    parser.add_argument("--seed", type=int, default=0, help="number of the first specimen")
    parser.add_argument("--all", action="store_true", help="print a line for every specimen")
    options = parser.parse_args()
    reasons: Counter[str] = Counter()
    depth, seconds = [], []
    for seed in range(options.seed, options.seed + options.count):
        drawn = random_specimen(seed)
        begin, told = time.process_time(), "converged"
        try:
            made = virtual_specimen(drawn.experiment, drawn.truth, settings=drawn.settings)
            solution = made.solutions["pressed"]
            depth.append(solution.relative_penetration)
            told += f", penetration {100 * depth[-1]:.3f} % of an edge, {solution.iterations} iterations"
            reasons["converged"] += 1
        except ConvergenceError as error:
            told = str(error)
            reasons[told.partition(". ")[2]] += 1
        seconds.append(time.process_time() - begin)
        if options.all or told.startswith("stopped"):
            print(f"{seed}: {drawn.description}: {told}, {seconds[-1]:.1f} s", flush=True)
    print("\n| specimens | how they ended |\n| --- | --- |")
    for reason, count in reasons.most_common():
        print(f"| {count} | {reason} |")
    deepest = f"deepest penetration {100 * max(depth):.3f} % of an element's edge; " if depth else ""
    print(f"\n{deepest}processor time of a solution: median {np.median(seconds):.1f} s, longest {max(seconds):.1f} s")


if __name__ == "__main__":
    main()
