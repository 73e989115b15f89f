"""The linear-elastic problem of a soft cube with a stiff ball, from the arrays of the mesh to the displacement: naibu beside others.

``python benchmarks/fe_linear.py [--cells 20] [--repeats 3] [--peers naibu,scikit-fem,...]`` (mm, kPa, mN). The base is fixed and the top
lowered by 3 mm; the stiffness is assembled and solved once. Every peer runs in a process of its own, without its start (see
``fe_driver.py`` and ``benchmarks/README.md``).
"""

from __future__ import annotations

import fe_linear_peers as peers
import numpy as np
from fe_case import LOWERED, Case, Result, pardiso, prescribed
from fe_driver import JAX_FEM, Peer, main
from fe_peers import DOLFINX, SYSTEM_PYTHON, run_dolfinx

from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.small_strain.linear_elasticity import LinearBody


def run_naibu(case: Case) -> Result:
    return Result(LinearBody.of(case.mesh).solve(case.lame, case.shear, prescribed(case, LOWERED)))


def run_naibu_direct(case: Case) -> Result:
    """Naibu's assembly with the solver that the peers are given."""
    support = prescribed(case, LOWERED)
    matrix = LinearBody.of(case.mesh).stiffness(case.lame, case.shear)
    rhs = np.where(support.constrained.ravel(), 0.0, -(matrix @ support.values.ravel()))
    matrix = with_dirichlet_rows(matrix, support.constrained)
    return Result(support.values + pardiso(matrix).factorize(matrix).solve(rhs).reshape(-1, 3))


WITH_RECYCLING = 12  # cells of naibu's warm-up, from which it chooses the solver of large systems
TORCH, SKFEM, FELUPE, SFEPY = ("torch", "torchfem"), ("skfem",), ("felupe",), ("sfepy",)
PEERS = {
    "naibu": Peer("naibu", run_naibu, warm_up=WITH_RECYCLING),
    "naibu-direct": Peer("naibu, same Cholesky", run_naibu_direct),
    "felupe": Peer("FElupe, same Cholesky", lambda case: peers.run_felupe(case, "pardiso"), FELUPE),
    "felupe-superlu": Peer("FElupe, its default SuperLU", lambda case: peers.run_felupe(case, "own"), FELUPE),
    "scikit-fem": Peer("scikit-fem, same Cholesky", lambda case: peers.run_scikit_fem(case, "pardiso"), SKFEM),
    "scikit-fem-superlu": Peer("scikit-fem, its default SuperLU", lambda case: peers.run_scikit_fem(case, "own"), SKFEM),
    "ngsolve": Peer("NGSolve, its sparse Cholesky", peers.run_ngsolve, ("ngsolve", "netgen")),
    "sfepy": Peer("SfePy, same Cholesky", lambda case: peers.run_sfepy(case, "pardiso"), SFEPY),
    "sfepy-auto": Peer("SfePy, its default direct solver", lambda case: peers.run_sfepy(case, "own"), SFEPY),
    "tatva": Peer("tatva, same Cholesky", peers.run_tatva, ("jax", "tatva"), warm_up=None),
    "jax-fem": Peer("JAX-FEM, same Cholesky", lambda case: peers.run_jax_fem(case, "pardiso"), JAX_FEM, warm_up=None),
    "jax-fem-bicgstab": Peer("JAX-FEM, its default BiCGSTAB", lambda case: peers.run_jax_fem(case, "own"), JAX_FEM, warm_up=None),
    "dolfinx": Peer("DOLFINx, GAMG, one process", lambda case: run_dolfinx(case, "linear", "gamg"), DOLFINX, interpreter=SYSTEM_PYTHON),
    "dolfinx-2": Peer(
        "DOLFINx, GAMG, two processes", lambda case: run_dolfinx(case, "linear", "gamg", 2), DOLFINX, interpreter=SYSTEM_PYTHON
    ),
    "torch-fem": Peer("torch-fem, its default CG with multigrid", lambda case: peers.run_torch_fem(case, "cg"), TORCH),
    "torch-fem-direct": Peer("torch-fem, its direct solver", lambda case: peers.run_torch_fem(case, "direct"), TORCH),
}


if __name__ == "__main__":
    main(__file__, __doc__, PEERS, ",".join(PEERS))
