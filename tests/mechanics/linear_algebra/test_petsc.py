"""PETSc on one rank and on two finds what a direct solver finds; in processes of their own, for MPI cannot be begun twice in one."""

import os
import shutil
import subprocess
import sys

import pytest

loaded = subprocess.run([sys.executable, "-c", "from petsc4py import PETSc"], capture_output=True, text=True, check=False)
if loaded.returncode != 0:
    pytest.skip(f"petsc4py cannot be loaded: {loaded.stderr.strip().splitlines()[-1]}", allow_module_level=True)

PROGRAM = """
import numpy as np
from petsc4py import PETSc
from naibu.core.errors import ConvergenceError
from naibu.mechanics import LinearBody, PrescribedDisplacement, choose_solver, lame_parameters
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.petsc import PetscSolver
from naibu.meshing import box, side_nodes, to_tetra

mesh = to_tetra(box((8.0, 8.0, 8.0), (7, 7, 7)))
support = PrescribedDisplacement.none(mesh.n_points)
support = support.and_also(side_nodes(mesh, "z-"), (0, 0, 0)).and_also(side_nodes(mesh, "z+"), (0.3, -0.2, -0.5))
lam, mu = lame_parameters(20.0, 0.4)
exact = LinearBody.of(mesh).solve(lam, mu, support, solver="superlu")
found = LinearBody.of(mesh).solve(lam, mu, support, solver="petsc")
assert np.abs(found - exact).max() < 1e-6, np.abs(found - exact).max()

matrix = with_dirichlet_rows(LinearBody.of(mesh).stiffness(lam, mu), support.constrained)
b = np.random.default_rng(0).normal(size=(matrix.shape[0], 2)) * ~support.constrained.reshape(-1, 1)
factorization = PetscSolver(mesh.points, support.constrained).factorize(matrix)
for x, right, tolerance in ((factorization.solve(b), b, 1e-8), (factorization.solve(b[:, 0], 1e-3), b[:, 0], 1e-3)):
    assert np.linalg.norm(matrix @ x - right) <= 2.0 * tolerance * np.linalg.norm(right)
try:
    PetscSolver(mesh.points, support.constrained, max_iterations=2).factorize(matrix).solve(b)
except ConvergenceError as error:
    assert "in 2 iterations of PETSc" in str(error)
else:
    raise AssertionError("two iterations were enough")
print(f"rank {PETSc.COMM_WORLD.getRank()} of {PETSc.COMM_WORLD.getSize()}", flush=True)
"""


@pytest.mark.parametrize("ranks", [1, 2, 4])
def test_all_ranks_get_the_solution_of_a_direct_solver(ranks):
    command = [sys.executable, "-c", PROGRAM]
    if ranks > 1:
        if shutil.which("mpirun") is None:
            pytest.skip("mpirun is not installed")
        command = ["mpirun", "-n", str(ranks), *command]
    allowed = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMPI_MCA_rmaps_base_oversubscribe": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=os.environ | allowed, check=False)
    assert done.returncode == 0, done.stderr
    assert all(f"rank {k} of {ranks}" in done.stdout for k in range(ranks))  # without order, perhaps on one line
