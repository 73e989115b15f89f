"""A soft cube with a stiff ball, squeezed by 25 %: naibu beside other finite-element programs, with the same direct solver.

``python benchmarks/fe_compression.py [--cells 20] [--repeats 3] [--peers naibu,scikit-fem,...]`` (mm, kPa, mN). Every peer runs in a
process of its own, one after the other, round after round. A run begins with the arrays of the mesh and ends with the displacement;
imports, compilation and a warm-up come before it. The warm-up is a small problem, but for programs that JAX compiles it is the same one,
since JAX compiles anew for other sizes: of these the second run counts. A peer that is not installed or that fails is named and left out.
See ``benchmarks/README.md``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fe_peers
import numpy as np
from fe_case import POISSON, SOFT, STEPS, STIFF, TOLERANCE, Case, Result, make_case, pardiso, prescribed

from naibu.mechanics.assembly import Assembler
from naibu.mechanics.elements import elements
from naibu.mechanics.linear_solvers import MultigridSolver
from naibu.mechanics.materials import material
from naibu.mechanics.newton import Problem, SolverSettings
from naibu.mechanics.statics import solve


def run_naibu(case: Case, *, load_steps: int | None = STEPS, solver: str = "default") -> Result:
    """Naibu, in given load steps or by its default step control (None)."""
    young = [material(young_modulus=e, poisson_ratio=POISSON) for e in (SOFT, STIFF)]
    body = Assembler.from_materials(elements(case.mesh, "standard"), case.mesh.regions, young)
    problem = Problem(case.mesh.points, body, (), prescribed(case), np.zeros_like(case.mesh.points))
    settings = SolverSettings(tolerance=TOLERANCE)
    if load_steps is not None:
        settings = SolverSettings(first_step=1 / load_steps, largest_step=1 / load_steps, tolerance=TOLERANCE)
    linear = None
    if solver == "direct":
        linear = pardiso(body.pattern.matrix(np.zeros((body.pattern.n_blocks, 3, 3))))
    elif solver == "multigrid":
        linear = MultigridSolver(case.mesh.points, problem.prescribed.held.ravel())
    solution = solve(problem, settings=settings, solver=linear)
    u = solution.displacement
    return Result(u, body.forces(u)[1][case.top].sum(axis=0), solution.iterations)


@dataclass(frozen=True)
class Peer:
    """A row of the table: what stands there, how it runs, the modules it needs, and the cells of its warm-up (None: those of the run)."""

    label: str
    run: Callable[[Case], Result]
    modules: tuple[str, ...] = ()
    warm_up: int | None = 3

    def missing(self) -> list[str]:
        """Return the modules that are not installed."""
        return [name for name in self.modules if importlib.util.find_spec(name) is None]


WITH_KERNELS = 10  # cells of naibu's warm-up, which also compiles the kernels of many cells
JAX_FEM = ("jax", "jax_fem", "petsc4py", "basix", "gmsh", "meshio", "pyfiglet")  # the wheel of jax-fem names no requirements
PEERS = {
    "naibu": Peer("naibu, 5 steps", run_naibu, warm_up=WITH_KERNELS),
    "naibu-adaptive": Peer("naibu, default steps", lambda case: run_naibu(case, load_steps=None), warm_up=WITH_KERNELS),
    "naibu-once": Peer("naibu, 1 step", lambda case: run_naibu(case, load_steps=1), warm_up=WITH_KERNELS),
    "naibu-direct": Peer("naibu, 5 steps, Cholesky at each iteration", lambda case: run_naibu(case, solver="direct"), warm_up=WITH_KERNELS),
    "naibu-multigrid": Peer("naibu, 5 steps, multigrid", lambda case: run_naibu(case, solver="multigrid"), warm_up=WITH_KERNELS),
    "felupe": Peer("FElupe, 5 steps, same Cholesky", fe_peers.run_felupe, ("felupe",)),
    "ngsolve": Peer("NGSolve, 5 steps, its sparse Cholesky", fe_peers.run_ngsolve, ("ngsolve", "netgen")),
    "scikit-fem": Peer("scikit-fem, 5 steps, same Cholesky", fe_peers.run_scikit_fem, ("skfem",)),
    "scikit-fem-superlu": Peer("scikit-fem, 5 steps, SuperLU", lambda case: fe_peers.run_scikit_fem(case, "superlu"), ("skfem",)),
    "sfepy": Peer("SfePy, 5 steps, same Cholesky", fe_peers.run_sfepy, ("sfepy",)),
    "tatva": Peer("tatva, 5 steps, same Cholesky", fe_peers.run_tatva, ("jax", "tatva"), warm_up=None),
    "jax-fem": Peer("JAX-FEM, 5 steps, same Cholesky", fe_peers.run_jax_fem, JAX_FEM, warm_up=None),
    "torch-fem": Peer("torch-fem, 6 steps, its CG with multigrid", lambda case: fe_peers.run_torch_fem(case, "cg"), ("torch", "torchfem")),
    "torch-fem-direct": Peer(
        "torch-fem, 6 steps, its direct solver", lambda case: fe_peers.run_torch_fem(case, "direct"), ("torch", "torchfem")
    ),
}
DEFAULT = "naibu,naibu-adaptive,naibu-once,naibu-direct,felupe,sfepy,tatva,ngsolve,jax-fem,scikit-fem,torch-fem"


def measure(peer: Peer, cells: int, out: Path) -> None:
    """Run one peer once in this process and write what came out."""
    peer.run(make_case(cells if peer.warm_up is None else peer.warm_up))
    case = make_case(cells)
    start = time.perf_counter()
    result = peer.run(case)
    seconds = time.perf_counter() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 1024**2)
    np.savez(out, u=result.displacement, force=result.force, numbers=[seconds, memory, result.iterations])


def measured(peers: list[str], cells: int, repeats: int) -> tuple[dict[str, list[Any]], dict[str, str]]:
    """Return the runs of every peer, and why others have none."""
    found: dict[str, list[Any]] = {}
    absent = {peer: f"not installed ({', '.join(PEERS[peer].missing())})" for peer in peers if PEERS[peer].missing()}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.npz"
        for _ in range(repeats):
            for peer in (peer for peer in peers if peer not in absent):
                command = [sys.executable, __file__, "--cells", str(cells), "--one", peer, str(out)]
                run = subprocess.run(command, env=os.environ | {"FELUPE_VERBOSE": "false"}, capture_output=True, text=True, check=False)
                if run.returncode:
                    found.pop(peer, None)
                    absent[peer] = f"failed: {(run.stderr.strip() or 'killed').splitlines()[-1]}"
                    continue
                with np.load(out) as arrays:
                    found.setdefault(peer, []).append(dict(arrays))
    return found, absent


def table(found: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Rows of the report; differences are relative to the first peer."""
    first = next(iter(found.values()))[0]
    best = min(run["numbers"][0] for run in next(iter(found.values())))
    rows = []
    for peer, runs in found.items():
        seconds = min(run["numbers"][0] for run in runs)
        rows.append(
            {
                "peer": PEERS[peer].label,
                "linearisations": int(runs[0]["numbers"][2]),
                "seconds": round(seconds, 2),
                "ratio": round(seconds / best, 2),
                "displacement": float(np.linalg.norm(runs[0]["u"] - first["u"]) / np.linalg.norm(first["u"])),
                "force": float(np.linalg.norm(runs[0]["force"] - first["force"]) / np.linalg.norm(first["force"])),
                "MB": round(max(run["numbers"][1] for run in runs)),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cells", type=int, default=20, help="cells along an edge; 20 gives 27 783 unknowns")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--peers", default=DEFAULT, help=f"among {', '.join(PEERS)}")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    parser.add_argument("--one", nargs=2, metavar=("PEER", "FILE"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        measure(PEERS[chosen.one[0]], chosen.cells, Path(chosen.one[1]))
        return
    found, absent = measured(chosen.peers.split(","), chosen.cells, chosen.repeats)
    rows = table(found) if found else []
    print("| program | linearisations | s (best) | ratio | difference of u | of the force | peak MB |\n" + "| --- " * 7 + "|")
    for row in rows:
        cells = (
            row["peer"],
            row["linearisations"],
            row["seconds"],
            row["ratio"],
            f"{row['displacement']:.1e}",
            f"{row['force']:.1e}",
            row["MB"],
        )
        print("| " + " | ".join(str(cell) for cell in cells) + " |")
    for peer, reason in absent.items():
        print(f"{PEERS[peer].label}: {reason}")
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    sys.exit(any(reason.startswith("failed") for reason in absent.values()))


if __name__ == "__main__":
    main()
