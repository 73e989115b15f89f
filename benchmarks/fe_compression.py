"""A soft cube with a stiff ball, squeezed by 25 %: naibu beside other finite-element programs, with the same direct solver.

``python benchmarks/fe_compression.py [--cells 20] [--repeats 3] [--peers naibu,scikit-fem,...]`` (mm, kPa, mN). Every peer runs in a
process of its own, one after the other, round after round. A run begins with the arrays of the mesh and ends with the displacement;
imports, compilation and a small warm-up problem come before it. See ``benchmarks/README.md``.
"""

from __future__ import annotations

import argparse
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

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from naibu.core.mesh import Mesh
from naibu.mechanics.assembly import Assembler
from naibu.mechanics.elements import elements
from naibu.mechanics.linear_solvers import Factorization, LinearSolver, MultigridSolver, PardisoSolver, SuperLUSolver
from naibu.mechanics.materials import lame_parameters, material
from naibu.mechanics.newton import Problem, SolverSettings, constrained
from naibu.mechanics.statics import solve
from naibu.mechanics.supports import Prescribed
from naibu.meshing.generation import box
from naibu.meshing.splitting import to_tetra

Array = NDArray[np.float64]
SIDE, DEPTH, RADIUS = 60.0, 15.0, 15.0
SOFT, STIFF, POISSON = 10.0, 30.0, 0.45
STEPS, TOLERANCE = 5, 1e-8


@dataclass(frozen=True)
class Case:
    """The mesh, its Lame parameters (mu, lambda) for every cell, and the nodes below and above."""

    mesh: Mesh
    shear: Array
    lame: Array
    bottom: NDArray[np.int64]
    top: NDArray[np.int64]


@dataclass(frozen=True)
class Result:
    """Displacement (n, 3), mm, force on the top, mN, and number of linearisations."""

    displacement: Array
    force: Array
    iterations: int


def make_case(cells: int) -> Case:
    """Return the cube of ``6 cells^3`` tetrahedra."""
    mesh = to_tetra(box((SIDE,) * 3, (cells,) * 3))
    points = mesh.points - mesh.points.min(axis=0)
    inside = np.linalg.norm(points[mesh.cells].mean(axis=1) - SIDE / 2, axis=1) < RADIUS
    values = np.array([lame_parameters(young, POISSON) for young in (SOFT, STIFF)])[inside.astype(int)]
    mesh = Mesh(points, mesh.cells, "tetra", inside.astype(np.int64), ("soft", "stiff"))
    below, above = (np.flatnonzero(np.abs(points[:, 2] - level) < 1e-9) for level in (0.0, SIDE))
    return Case(mesh, values[:, 1].copy(), values[:, 0].copy(), below, above)


def prescribed(case: Case) -> Prescribed:
    nothing = Prescribed.nothing(case.mesh.n_points)
    return nothing.and_also(case.bottom, (0.0, 0.0, 0.0)).and_also(case.top, (0.0, 0.0, -DEPTH))


def pardiso(matrix: sp.bsr_matrix) -> LinearSolver:
    return PardisoSolver(matrix, symmetric=True)


class Cholesky:
    """Naibu's direct solver for peers; analyses anew only where entries that vanish in the free state have joined the pattern."""

    def __init__(self) -> None:
        self._solver: LinearSolver | None = None
        self._indices = np.empty(0, dtype=np.int32)

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        if self._solver is None or not np.array_equal(self._indices, matrix.indices):
            self._solver, self._indices = pardiso(matrix), matrix.indices.copy()
        return self._solver.factorize(matrix)


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


def newton(case: Case, forces: Callable[[Array], Array], tangent: Callable[[Array], sp.bsr_matrix], solver: str) -> Result:
    """Full Newton's method for a peer that assembles but does not iterate, with naibu's criterion; held nodes move by the first tangent."""
    support, u, count = prescribed(case), np.zeros_like(case.mesh.points), 0
    linear = SuperLUSolver() if solver == "superlu" else Cholesky()
    for step in range(1, STEPS + 1):
        jump = np.where(support.held, step / STEPS * support.values - u, 0.0)
        r = forces(u)
        for _ in range(20):
            matrix = tangent(u)
            rhs = r + (matrix @ jump.ravel()).reshape(-1, 3)
            rhs[support.held] = 0.0
            matrix = constrained(matrix, support.held)
            u = u + jump - linear.factorize(matrix).solve(rhs.ravel()).reshape(-1, 3)
            jump[:] = 0.0
            count += 1
            r = forces(u)
            if np.abs(r[~support.held]).sum() <= TOLERANCE * np.abs(r[support.held]).sum():
                break
    return Result(u, forces(u)[case.top].sum(axis=0), count)


def run_scikit_fem(case: Case, solver: str = "pardiso") -> Result:
    """scikit-fem assembles; Newton's method is `newton`."""
    import skfem
    from skfem.helpers import ddot, det, grad, identity, inv, mul, transpose

    basis = skfem.Basis(skfem.MeshTet(case.mesh.points.T, case.mesh.cells.T), skfem.ElementVector(skfem.ElementTetP1()), intorder=0)
    data = {"mu": case.shear[:, None], "lame": case.lame[:, None]}

    def kinematics(w: Any) -> tuple[Any, Any, Any]:
        f = w["du"] + identity(w["du"])
        return f, transpose(inv(f)), np.log(det(f))

    @skfem.LinearForm  # type: ignore[untyped-decorator]
    def internal(v: Any, w: Any) -> Any:
        f, g, log_j = kinematics(w)
        return ddot(w["mu"] * (f - g) + w["lame"] * log_j * g, grad(v))

    @skfem.BilinearForm  # type: ignore[untyped-decorator]
    def stiffness(u: Any, v: Any, w: Any) -> Any:
        _, g, log_j = kinematics(w)
        turned = mul(mul(g, transpose(grad(u))), g)
        return ddot(w["mu"] * grad(u) + (w["mu"] - w["lame"] * log_j) * turned + w["lame"] * ddot(g, grad(u)) * g, grad(v))

    def gradient(u: Array) -> dict[str, Any]:
        return {"du": basis.interpolate(u.ravel()).grad, **data}

    def forces(u: Array) -> Array:
        return np.asarray(internal.assemble(basis, **gradient(u))).reshape(-1, 3)

    return newton(case, forces, lambda u: stiffness.assemble(basis, **gradient(u)).tobsr((3, 3)), solver)


def run_felupe(case: Case) -> Result:
    """FElupe with its own Newton's method; only the linear solver is given to it."""
    import felupe as fem

    field = fem.FieldContainer([fem.Field(fem.RegionTetra(fem.Mesh(case.mesh.points, case.mesh.cells, "tetra")), dim=3)])
    law = fem.NeoHookeCompressible(mu=case.shear[None, :], lmbda=case.lame[None, :])
    law.chunksize = None  # its chunks do not divide parameters that vary from cell to cell; two bodies were slower
    body = fem.SolidBody(law, field)
    fixed = fem.Boundary(field[0], fz=0.0)
    sides = fem.Boundary(field[0], fz=SIDE, skip=(False, False, True))
    cholesky = Cholesky()

    def linear(matrix: Any, b: Any) -> Array:
        return cholesky.factorize(matrix.sorted_indices().tobsr((1, 1))).solve(np.asarray(b).ravel())

    count = 0
    for step in range(1, STEPS + 1):
        moved = fem.Boundary(field[0], fz=SIDE, skip=(True, True, False), value=-DEPTH * step / STEPS)
        bounds = {"fixed": fixed, "sides": sides, "moved": moved}
        dof0, dof1 = fem.dof.partition(field, bounds)
        ext0 = fem.dof.apply(field, bounds, dof0)
        done = fem.newtonraphson(items=[body], dof0=dof0, dof1=dof1, ext0=ext0, solver=linear, tol=TOLERANCE, verbose=0)
        count += done.iterations
    force = np.asarray(body.assemble.vector(field).toarray()).reshape(-1, 3)
    return Result(field[0].values.copy(), force[case.top].sum(axis=0), count)


def run_ngsolve(case: Case) -> Result:
    """NGSolve: its compiled energy, its assembly and its sparse Cholesky on all cores, iterated like the others."""
    import netgen.meshing as netgen
    import ngsolve as ng

    grid = netgen.Mesh(dim=3)
    grid.AddPoints(np.ascontiguousarray(case.mesh.points))
    for region, name in enumerate(case.mesh.region_names):
        grid.SetMaterial(region + 1, name)
        grid.AddElements(dim=3, index=region + 1, data=case.mesh.cells[case.mesh.regions == region].astype(np.int32), base=0)
    mesh = ng.Mesh(grid)
    values = {name: int(np.flatnonzero(case.mesh.regions == region)[0]) for region, name in enumerate(case.mesh.region_names)}
    mu = mesh.MaterialCF({name: case.shear[cell] for name, cell in values.items()})
    lame = mesh.MaterialCF({name: case.lame[cell] for name, cell in values.items()})
    space = ng.VectorH1(mesh, order=1)
    gradient = ng.Id(3) + ng.Grad(space.TrialFunction())
    volume = ng.Det(gradient)
    energy = mu / 2 * (ng.InnerProduct(gradient, gradient) - 3) - mu * ng.log(volume) + lame / 2 * ng.log(volume) ** 2
    form = ng.BilinearForm(space, symmetric=True)
    form += ng.Variation(energy.Compile() * ng.dx)
    support, count = prescribed(case), 0
    held = support.held.T.ravel()  # unknowns stand component after component
    free = ng.BitArray(space.ndof)
    for dof, fixed in enumerate(held):
        free[dof] = not fixed
    u, r, jump = (ng.GridFunction(space).vec for _ in range(3))

    def residual() -> Array:
        form.Apply(u, r)
        return np.asarray(r.FV().NumPy())

    with ng.TaskManager():
        for step in range(1, STEPS + 1):
            target = step / STEPS * support.values.T.ravel()
            jump.FV().NumPy()[:] = np.where(held, target - u.FV().NumPy(), 0.0)
            force = residual()
            for _ in range(20):
                form.AssembleLinearization(u)
                r.data += form.mat * jump
                u.data += jump - form.mat.Inverse(free, inverse="sparsecholesky") * r
                jump[:] = 0.0
                count += 1
                force = residual()
                if np.abs(force[~held]).sum() <= TOLERANCE * np.abs(force[held]).sum():
                    break
    displacement = np.array(u.FV().NumPy()).reshape(3, -1).T
    return Result(displacement, np.array(force).reshape(3, -1).T[case.top].sum(axis=0), count)


PEERS: dict[str, tuple[str, Callable[[Case], Result]]] = {
    "naibu": ("naibu, 5 steps", run_naibu),
    "naibu-adaptive": ("naibu, default steps", lambda case: run_naibu(case, load_steps=None)),
    "naibu-once": ("naibu, 1 step", lambda case: run_naibu(case, load_steps=1)),
    "naibu-direct": ("naibu, 5 steps, Cholesky at each iteration", lambda case: run_naibu(case, solver="direct")),
    "naibu-multigrid": ("naibu, 5 steps, multigrid", lambda case: run_naibu(case, solver="multigrid")),
    "felupe": ("FElupe, 5 steps, same Cholesky", run_felupe),
    "ngsolve": ("NGSolve, 5 steps, its sparse Cholesky", run_ngsolve),
    "scikit-fem": ("scikit-fem, 5 steps, same Cholesky", run_scikit_fem),
    "scikit-fem-superlu": ("scikit-fem, 5 steps, SuperLU", lambda case: run_scikit_fem(case, "superlu")),
}


def measure(peer: str, cells: int, out: Path) -> None:
    """Run one peer once in this process and write what came out."""
    run = PEERS[peer][1]
    run(make_case(10 if peer.startswith("naibu") else 3))  # also compiles the kernels of many cells
    case = make_case(cells)
    start = time.perf_counter()
    result = run(case)
    seconds = time.perf_counter() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 1024**2)
    np.savez(out, u=result.displacement, force=result.force, numbers=[seconds, memory, result.iterations])


def table(found: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Rows of the report; differences are relative to the first peer."""
    first = next(iter(found.values()))[0]
    best = min(run["numbers"][0] for run in next(iter(found.values())))
    rows = []
    for peer, runs in found.items():
        seconds = min(run["numbers"][0] for run in runs)
        rows.append(
            {
                "peer": PEERS[peer][0],
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
    parser.add_argument(
        "--peers", default="naibu,naibu-adaptive,naibu-once,naibu-direct,felupe,ngsolve,scikit-fem", help=f"among {', '.join(PEERS)}"
    )
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    parser.add_argument("--one", nargs=2, metavar=("PEER", "FILE"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        measure(chosen.one[0], chosen.cells, Path(chosen.one[1]))
        return
    found: dict[str, list[Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run.npz"
        for _ in range(chosen.repeats):
            for peer in chosen.peers.split(","):
                command = [sys.executable, __file__, "--cells", str(chosen.cells), "--one", peer, str(out)]
                subprocess.run(command, check=True, env=os.environ | {"FELUPE_VERBOSE": "false"})
                found.setdefault(peer, []).append(dict(np.load(out)))
    rows = table(found)
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
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
