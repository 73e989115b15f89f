"""Runs programs on one problem, each in a process of its own, one after the other, round after round, and prints what they took.

A run begins with the arrays of the mesh and ends with the displacement; imports, compilation and a warm-up come before it. The warm-up is
a small problem, but for programs that JAX compiles it is the same one, since JAX compiles anew for other sizes: of these the second run
counts. A peer that is not installed or that fails is named and left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fe_case import Case, Result, make_case
from peak_memory import peak_memory_mb

JAX_FEM = ("jax", "jax_fem", "petsc4py", "basix", "gmsh", "meshio", "pyfiglet")  # the wheel of jax-fem names no requirements
HEADINGS = {
    "peer": "program",
    "linearisations": "linearisations",
    "seconds": "s (best)",
    "ratio": "ratio",
    "displacement": "difference of u",
    "force": "of the force",
    "MB": "peak MB",
}


@dataclass(frozen=True)
class Peer:
    """A row of the table: what stands there, how it runs, the modules it needs, and the cells of its warm-up (None: those of the run).

    A peer with an interpreter runs in processes of that Python, and its modules are sought there.
    """

    label: str
    run: Callable[[Case], Result]
    modules: tuple[str, ...] = ()
    warm_up: int | None = 3
    interpreter: str = ""

    def missing(self) -> list[str]:
        """Return the modules that are not installed."""
        if not self.interpreter:
            return [name for name in self.modules if importlib.util.find_spec(name) is None]
        known = "import importlib.util, sys; sys.exit(importlib.util.find_spec(sys.argv[1]) is None)"
        return [name for name in self.modules if subprocess.run([self.interpreter, "-c", known, name], check=False).returncode]


def measure(peer: Peer, cells: int, out: Path) -> None:
    """Run one peer once in this process and write what came out."""
    peer.run(make_case(cells if peer.warm_up is None else peer.warm_up))
    case = make_case(cells)
    start, busy = time.perf_counter(), time.process_time()
    result = peer.run(case)
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    seconds, memory = result.measured or (seconds, peak_memory_mb())
    np.savez(out, u=result.displacement, force=result.force, numbers=[seconds, memory, result.iterations, busy])


def measured(script: str, peers: dict[str, Peer], cells: int, repeats: int) -> tuple[dict[str, list[Any]], dict[str, str]]:
    """Return the runs of every peer, and why others have none."""
    found: dict[str, list[Any]] = {}
    absent = {name: f"not installed ({', '.join(peer.missing())})" for name, peer in peers.items() if peer.missing()}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.npz"
        for _ in range(repeats):
            for name in (name for name in peers if name not in absent):
                command = [sys.executable, script, "--cells", str(cells), "--one", name, str(out)]
                run = subprocess.run(command, env=os.environ | {"FELUPE_VERBOSE": "false"}, capture_output=True, text=True, check=False)
                if run.returncode:
                    found.pop(name, None)
                    absent[name] = f"failed: {(run.stderr.strip() or 'killed').splitlines()[-1]}"
                    continue
                with np.load(out) as arrays:
                    found.setdefault(name, []).append(dict(arrays))
    return found, absent


def difference(values: Any, reference: Any) -> float:
    """Return the Euclidean norm of a difference, relative to the reference."""
    return float(np.linalg.norm(values - reference) / np.linalg.norm(reference))


def table(found: dict[str, list[Any]], peers: dict[str, Peer]) -> list[dict[str, Any]]:
    """Rows of the report; differences are relative to the first peer."""
    first = next(iter(found.values()))[0]
    best = min(run["numbers"][0] for run in next(iter(found.values())))
    rows = []
    for name, runs in found.items():
        seconds = min(run["numbers"][0] for run in runs)
        row: dict[str, Any] = {"peer": peers[name].label, "seconds": round(seconds, 2), "ratio": round(seconds / best, 2)}
        row["displacement"] = difference(runs[0]["u"], first["u"])
        row["MB"] = round(max(run["numbers"][1] for run in runs))
        if first["force"].size:
            row |= {"linearisations": int(runs[0]["numbers"][2]), "force": difference(runs[0]["force"], first["force"])}
        rows.append(row)
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the rows as a table of Markdown."""
    keys = [key for key in HEADINGS if rows and key in rows[0]]
    print("| " + " | ".join(HEADINGS[key] for key in keys) + " |\n" + "| --- " * len(keys) + "|")
    for row in rows:
        cells = [f"{row[key]:.1e}" if key in ("displacement", "force") else str(row[key]) for key in keys]
        print("| " + " | ".join(cells) + " |")


def main(script: str, description: str | None, peers: dict[str, Peer], default: str) -> None:
    """Read the command line of a script, run its peers and print the table; ends the process."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0] if description else None)
    parser.add_argument("--cells", type=int, default=20, help="cells along an edge; 20 gives 27 783 unknowns")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--peers", default=default, help=f"among {', '.join(peers)}")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    parser.add_argument("--one", nargs=2, metavar=("PEER", "FILE"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        measure(peers[chosen.one[0]], chosen.cells, Path(chosen.one[1]))
        return
    found, absent = measured(script, {name: peers[name] for name in chosen.peers.split(",")}, chosen.cells, chosen.repeats)
    rows = table(found, peers) if found else []
    show(rows)
    for name, reason in absent.items():
        print(f"{peers[name].label}: {reason}")
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    sys.exit(any(reason.startswith("failed") for reason in absent.values()))
