"""A soft cube with a stiff ball, squeezed by 25 %: naibu beside other finite-element programs, with the same direct solver.

``python benchmarks/fe_compression.py [--cells 20] [--repeats 3] [--peers naibu,scikit-fem,...]`` (mm, kPa, mN). Every peer runs in a
process of its own, without its start (see ``fe_driver.py`` and ``benchmarks/README.md``).
"""

from __future__ import annotations

from dataclasses import replace

import fe_peers
import numpy as np
from fe_case import POISSON, SOFT, STEPS, STIFF, TOLERANCE, Case, Result, prescribed
from fe_driver import JAX_FEM, Peer, main

from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.solver_selection import SolverName


def run_naibu(case: Case, *, load_steps: int | None = STEPS, solver: SolverName = "automatic") -> Result:
    """Naibu, in given load steps or by its default step control (None)."""
    young = [material(young_modulus=e, poisson_ratio=POISSON) for e in (SOFT, STIFF)]
    body = Assembler.from_materials(elements(case.mesh, "standard"), case.mesh.regions, young)
    problem = Problem(case.mesh.points, body, (), prescribed(case), np.zeros_like(case.mesh.points))
    settings = SolverSettings(tolerance=TOLERANCE, linear_solver=solver)
    if load_steps is not None:
        settings = replace(settings, first_step=1 / load_steps, largest_step=1 / load_steps)
    solution = solve(problem, settings=settings)
    u = solution.displacement
    return Result(u, body.forces(u)[1][case.top].sum(axis=0), solution.iterations)


WITH_KERNELS = 20  # cells of naibu's warm-up, from which it chooses the solver of large systems
PEERS = {
    "naibu": Peer("naibu, 5 steps", run_naibu, warm_up=WITH_KERNELS),
    "naibu-adaptive": Peer("naibu, default steps", lambda case: run_naibu(case, load_steps=None), warm_up=WITH_KERNELS),
    "naibu-once": Peer("naibu, 1 step", lambda case: run_naibu(case, load_steps=1), warm_up=WITH_KERNELS),
    "naibu-direct": Peer(
        "naibu, 5 steps, Cholesky at each iteration", lambda case: run_naibu(case, solver="pardiso"), warm_up=WITH_KERNELS
    ),
    "naibu-multigrid": Peer("naibu, 5 steps, multigrid", lambda case: run_naibu(case, solver="multigrid"), warm_up=WITH_KERNELS),
    "naibu-recycled": Peer(
        "naibu, 5 steps, recycled Cholesky", lambda case: run_naibu(case, solver="recycled_cholesky"), warm_up=WITH_KERNELS
    ),
    "felupe": Peer("FElupe, 5 steps, same Cholesky", fe_peers.run_felupe, ("felupe",)),
    "ngsolve": Peer("NGSolve, 5 steps, its sparse Cholesky", fe_peers.run_ngsolve, ("ngsolve", "netgen")),
    "scikit-fem": Peer("scikit-fem, 5 steps, same Cholesky", fe_peers.run_scikit_fem, ("skfem",)),
    "scikit-fem-superlu": Peer("scikit-fem, 5 steps, SuperLU", lambda case: fe_peers.run_scikit_fem(case, "superlu"), ("skfem",)),
    "sfepy": Peer("SfePy, 5 steps, same Cholesky", fe_peers.run_sfepy, ("sfepy",)),
    "tatva": Peer("tatva, 5 steps, same Cholesky", fe_peers.run_tatva, ("jax", "tatva"), warm_up=None),
    "jax-fem": Peer("JAX-FEM, 5 steps, same Cholesky", fe_peers.run_jax_fem, JAX_FEM, warm_up=None),
    "dolfinx": Peer(
        "DOLFINx, 5 steps, GAMG, one process",
        lambda case: fe_peers.run_dolfinx(case, "neo_hookean", "gamg"),
        fe_peers.DOLFINX,
        interpreter=fe_peers.SYSTEM_PYTHON,
    ),
    "dolfinx-2": Peer(
        "DOLFINx, 5 steps, GAMG, two processes",
        lambda case: fe_peers.run_dolfinx(case, "neo_hookean", "gamg", 2),
        fe_peers.DOLFINX,
        interpreter=fe_peers.SYSTEM_PYTHON,
    ),
    "dolfinx-mumps": Peer(
        "DOLFINx, 5 steps, MUMPS, one process",
        lambda case: fe_peers.run_dolfinx(case, "neo_hookean", "mumps"),
        fe_peers.DOLFINX,
        interpreter=fe_peers.SYSTEM_PYTHON,
    ),
    "torch-fem": Peer("torch-fem, 6 steps, its CG with multigrid", lambda case: fe_peers.run_torch_fem(case, "cg"), ("torch", "torchfem")),
    "torch-fem-direct": Peer(
        "torch-fem, 6 steps, its direct solver", lambda case: fe_peers.run_torch_fem(case, "direct"), ("torch", "torchfem")
    ),
}
DEFAULT = "naibu,naibu-adaptive,naibu-once,naibu-direct,felupe,sfepy,tatva,ngsolve,jax-fem,scikit-fem,torch-fem"


if __name__ == "__main__":
    main(__file__, __doc__, PEERS, DEFAULT)
