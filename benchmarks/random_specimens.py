"""Do random specimens converge, or fail with a reason? ``random_specimens.py [--count COUNT] [--seed SEED] [--limit-s S] [--out FILE]``.

Boxes of two gels under a plate, a bar or between side plates: random edges, moduli, Poisson's ratios, friction and compression
(`naibu.validation.specimens.random_specimens` has the ranges). Prints how many converged, why the others did not, the deepest penetration
of a rigid body into an element as a fraction of its edge, and the processor time of a solution. A specimen that takes more than the limit
is stopped and counted as too slow. With ``--out`` every specimen is a line of that file, and those in it are not solved again.
"""

from __future__ import annotations

import argparse
import json
import signal
import time
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from naibu.core.errors import ConvergenceError
from naibu.core.status import Status
from naibu.validation import virtual_specimen
from naibu.validation.specimens.random_specimens import random_specimen


class TooSlowError(Exception):
    """A specimen took more processor time than the limit."""


def main() -> None:
    """Solve the specimens and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="specimens")
    parser.add_argument("--seed", type=int, default=0, help="number of the first specimen")
    parser.add_argument("--limit-s", type=float, default=60.0, help="processor time of a specimen, s")
    parser.add_argument("--out", type=Path, help="file of results, one JSON object a line; it is continued")
    options = parser.parse_args()
    signal.signal(signal.SIGPROF, _stop)
    done = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out and options.out.exists() else []
    wanted = range(options.seed, options.seed + options.count)
    rows = [row for row in done if row["specimen"] in wanted]
    for seed in sorted(set(wanted) - {row["specimen"] for row in rows}):
        rows.append(solved(seed, options.limit_s))
        print(json.dumps(rows[-1]), flush=True)
        if options.out:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


def solved(seed: int, limit_s: float) -> dict[str, Any]:
    """Solve a specimen and tell how that ended: the name of a status, or TOO_SLOW."""
    drawn = random_specimen(seed)
    row: dict[str, Any] = {"specimen": seed, "description": drawn.description, "ended": Status.CONVERGED.name}
    begin = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        made = virtual_specimen(drawn.experiment, drawn.truth, settings=drawn.settings)
        solution = made.solutions["pressed"]
        row |= {"nodes": made.model.mesh.n_points, "penetration": solution.relative_penetration, "iterations": solution.iterations}
    except ConvergenceError as error:
        row |= {"ended": next((s.name for s in Status if s.value in str(error)), "WITHOUT_A_REASON"), "message": str(error)}
    except TooSlowError:
        row["ended"] = "TOO_SLOW"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return row | {"seconds": round(time.process_time() - begin, 1)}


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooSlowError


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table, in Markdown."""
    lines = ["", "| specimens | how they ended |", "| --- | --- |"]
    lines += [f"| {count} | {ended} |" for ended, count in Counter(row["ended"] for row in rows).most_common()]
    depth = [row["penetration"] for row in rows if "penetration" in row]
    seconds = [row["seconds"] for row in rows]
    deepest = f"deepest penetration {100 * max(depth):.3f} % of an element's edge; " if depth else ""
    slowest = max(rows, key=lambda row: row["seconds"])["specimen"]
    times = f"processor time of a solution: median {np.median(seconds):.1f} s, longest {max(seconds):.1f} s (specimen {slowest})"
    return "\n".join([*lines, "", deepest + times])


if __name__ == "__main__":
    main()
