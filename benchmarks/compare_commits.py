"""Whether a commit is slower than another: both run the same benchmark on this machine, in turn, and every ratio gets an interval.

Run: ``python benchmarks/compare_commits.py A B [--rounds 6] [--only linear lattice] [--limit 1.1] [--json FILE]``

A and B are commits, branches or tags. Each is checked out in a temporary folder; the program that measures is the ``speed.py`` beside this
one, in a process of its own for every run, whose processor time counts. Rounds alternate A B and B A, so that what the machine does
meanwhile meets both. The ratio of B to A is the geometric mean over rounds, with an interval of 95 % by Student's t of the paired
logarithms :cite:p:`student1908`. Exit code 1 if an interval lies wholly above ``--limit``: then B is slower, not the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

PLACE = Path(__file__).resolve().parent
Times = dict[str, float]


def paired_ratio(first: Sequence[float], second: Sequence[float]) -> tuple[float, float, float]:
    """Return the geometric mean of second / first over pairs, and the ends of its 95 % interval."""
    logs: NDArray[np.float64] = np.log(np.asarray(second, dtype=float) / np.asarray(first, dtype=float))
    middle, half = float(logs.mean()), float("inf")
    if len(logs) > 1:
        half = float(stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs)))
    return float(np.exp(middle)), float(np.exp(middle - half)), float(np.exp(middle + half))


def verdict(low: float, high: float, limit: float) -> str:
    """Return what an interval of the ratio says."""
    if low > limit:
        return "SLOWER"
    return "faster" if high < 1.0 else "no slower" if high <= limit else "not decided: more rounds"


def measured(tree: Path, only: Sequence[str], out: Path) -> Times:
    """Run the benchmark on a tree, and return the times of its rows."""
    environment = os.environ | {"PYTHONPATH": str(tree / "src")}
    command = [sys.executable, str(PLACE / "speed.py"), "--quick", "--repeats", "1", "--only", *only, "--json", str(out)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if run.returncode:
        sys.exit(f"{tree.name}: speed.py failed: {(run.stderr.strip() or 'killed').splitlines()[-1]}")
    tables = json.loads(out.read_text(encoding="utf-8"))
    return {f"{name}: {row[0]}, {row[1]}": float(row[2]) for name, table in tables.items() for row in table["rows"]}


def checked_out(commit: str, folder: Path, name: str) -> Path:
    """Return the tree of a commit, as files."""
    tree = folder / name
    made = subprocess.run(["git", "worktree", "add", "--detach", str(tree), commit], cwd=PLACE, capture_output=True, text=True, check=False)
    if made.returncode:
        sys.exit(f"{commit}: cannot be checked out ({made.stderr.strip().splitlines()[-1]})")
    return tree


def main() -> None:
    """Measure both commits and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first")
    parser.add_argument("second")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--only", nargs="+", choices=("linear", "lattice", "sensing"), default=["linear", "lattice"])
    parser.add_argument("--limit", type=float, default=1.1, help="ratio that counts as slower")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    if chosen.rounds < 2:
        parser.error("--rounds must be 2 at least: one pair has no interval")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trees = []
        try:
            for commit, label in ((chosen.first, "A"), (chosen.second, "B")):
                trees.append(checked_out(commit, folder, label))
            for tree in trees:
                measured(tree, chosen.only, folder / "warm.json")  # compiles
            runs: list[list[Times]] = [[], []]
            for k in range(chosen.rounds):
                for which in (0, 1) if k % 2 == 0 else (1, 0):
                    runs[which].append(measured(trees[which], chosen.only, folder / "run.json"))
                print(f"round {k + 1} of {chosen.rounds}", file=sys.stderr, flush=True)
        finally:
            for tree in trees:
                subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=PLACE, capture_output=True, check=False)
    rows = []
    for key in (key for key in runs[0][0] if key in runs[1][0]):
        ratio, low, high = paired_ratio([run[key] for run in runs[0]], [run[key] for run in runs[1]])
        rows.append({"what": key, "ratio": ratio, "low": low, "high": high, "verdict": verdict(low, high, chosen.limit)})
        print(f"{key:44s} {ratio:6.3f}   {low:6.3f} to {high:6.3f}   {rows[-1]['verdict']}")
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    sys.exit(any(row["verdict"] == "SLOWER" for row in rows))


if __name__ == "__main__":
    main()
