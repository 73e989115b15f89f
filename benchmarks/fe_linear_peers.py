"""Other finite-element programs on the linear-elastic problem of ``fe_linear.py``; each imports its program where it runs.

Each has its own linear-elastic form where it ships one. ``solver`` is ``"pardiso"`` for naibu's direct solver, or ``"own"`` for the one
that the program takes by default.
"""

# mypy: disable-error-code="import-untyped,import-not-found", allow-subclassing-any

from __future__ import annotations

import functools
import logging
from typing import Any

import fe_peers
import numpy as np
from fe_case import LOWERED, POISSON, SIDE, SOFT, STIFF, Array, Case, Cholesky, Result, largest_residual, prescribed

from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows


def cholesky(matrix: Any, b: Any) -> Array:
    """Solve by naibu's direct solver, for programs that take a function of a SciPy matrix and a right side."""
    return Cholesky().factorize(matrix.sorted_indices().tobsr((1, 1))).solve(np.asarray(b).ravel())


def run_scikit_fem(case: Case, solver: str) -> Result:
    """scikit-fem: its model of linear elasticity, constrained unknowns condensed."""
    import skfem
    from skfem.models.elasticity import linear_elasticity

    basis = skfem.Basis(skfem.MeshTet(case.mesh.points.T, case.mesh.cells.T), skfem.ElementVector(skfem.ElementTetP1()), intorder=0)
    stiffness = linear_elasticity(case.lame[:, None], case.shear[:, None]).assemble(basis)
    support = prescribed(case, LOWERED)
    system = skfem.condense(stiffness, x=support.values.ravel(), D=np.flatnonzero(support.constrained))
    return Result(skfem.solve(*system, **({"solver": cholesky} if solver == "pardiso" else {})).reshape(-1, 3))


def run_felupe(case: Case, solver: str) -> Result:
    """FElupe: a solid body of its linear-elastic material, partitioned."""
    import felupe as fem

    field = fem.FieldContainer([fem.Field(fem.RegionTetra(fem.Mesh(case.mesh.points, case.mesh.cells, "tetra")), dim=3)])
    young = np.where(case.mesh.regions == 0, SOFT, STIFF)[None, :]
    body = fem.SolidBody(fem.LinearElastic(E=young, nu=POISSON), field)
    bounds = {
        "fixed": fem.Boundary(field[0], fz=0.0),
        "sides": fem.Boundary(field[0], fz=SIDE, skip=(False, False, True)),
        "moved": fem.Boundary(field[0], fz=SIDE, skip=(True, True, False), value=-LOWERED),
    }
    dof0, dof1 = fem.dof.partition(field, bounds)
    ext0 = fem.dof.apply(field, bounds, dof0)
    system = fem.solve.partition(field, body.assemble.matrix(), dof1, dof0)
    field += fem.solve.solve(*system, ext0=ext0, **({"solver": cholesky} if solver == "pardiso" else {}))
    return Result(field[0].values.copy())


def run_ngsolve(case: Case) -> Result:
    """NGSolve: a symmetric bilinear form, assembled and solved by its sparse Cholesky on all cores."""
    import ngsolve as ng

    mesh, mu, lame = fe_peers.ngsolve_mesh(case)
    space = ng.H1(mesh, order=1, dim=3)  # with blocks for unknowns, its Cholesky was faster than with those of VectorH1
    u, v = space.TnT()
    strain, virtual = ng.Sym(ng.Grad(u)), ng.Sym(ng.Grad(v))
    form = ng.BilinearForm(space, symmetric=True)
    form += (2 * mu * ng.InnerProduct(strain, virtual) + lame * ng.Trace(strain) * ng.Trace(virtual)) * ng.dx
    support = prescribed(case, LOWERED)
    free = fe_peers.ngsolve_free(support.constrained.all(axis=1))
    solution = ng.GridFunction(space).vec
    solution.FV().NumPy()[:] = support.values.ravel()
    with ng.TaskManager():
        form.Assemble()
        residual = (form.mat * solution).Evaluate()
        solution.data -= form.mat.Inverse(free, inverse="sparsecholesky") * residual
    return Result(np.array(solution.FV().NumPy()).reshape(-1, 3))


def run_sfepy(case: Case, solver: str) -> Result:
    """SfePy: its term of linear elasticity, one step of its Newton method."""
    from sfepy.base.base import output
    from sfepy.mechanics.matcoefs import stiffness_from_lame
    from sfepy.solvers.auto_fallback import AutoDirect
    from sfepy.solvers.nls import Newton

    output.set_output(quiet=True)
    problem = fe_peers.sfepy_problem(case, "dw_lin_elastic", stiffness_from_lame(3, case.lame, case.shear), lambda ts: LOWERED)
    linear = fe_peers.sfepy_linear() if solver == "pardiso" else AutoDirect({})
    problem.set_solver(Newton({"i_max": 1, "is_linear": True, "eps_a": largest_residual(case)}, lin_solver=linear))
    return Result(problem.solve(save_results=False)().reshape(-1, 3))


@functools.cache
def tatva_forces() -> Any:
    """Return the gradient of the energy, one and the same function for all runs so that JAX compiles it once."""
    import jax
    import jax.numpy as jnp
    from jax_autovmap import autovmap

    def density(gradient: Any, mu: Any, lame: Any) -> Any:
        strain = (gradient + gradient.T) / 2
        return mu * jnp.sum(strain * strain) + lame / 2 * jnp.trace(strain) ** 2

    everywhere = autovmap(gradient=2, mu=0, lame=0)(density)

    def energy(u: Any, operator: Any, mu: Any, lame: Any) -> Any:
        return operator.integrate(everywhere(operator.grad(u.reshape(-1, 3)), mu, lame))

    return jax.jit(jax.grad(energy))


def run_tatva(case: Case) -> Result:
    """tatva: the coloured sparse derivative of the forces, by automatic differentiation."""
    import jax.numpy as jnp

    stiffness, data = fe_peers.tatva_tangent(case, tatva_forces())
    support = prescribed(case, LOWERED)
    matrix = stiffness(jnp.zeros(support.values.size), *data).to_csr().tobsr((3, 3))
    rhs = -(matrix @ support.values.ravel())
    rhs[support.constrained.ravel()] = 0.0
    return Result(support.values + Cholesky().factorize(with_dirichlet_rows(matrix, support.constrained)).solve(rhs).reshape(-1, 3))


def run_jax_fem(case: Case, solver: str) -> Result:
    """JAX-FEM's `Problem` and `solver`, which assembles again to see that one step of Newton's method was enough."""
    import jax.numpy as jnp
    from jax_fem.generate_mesh import Mesh
    from jax_fem.problem import Problem
    from jax_fem.solver import solver as solve

    logging.getLogger("jax_fem").setLevel(logging.WARNING)
    fe_peers.compiled_once()

    def stress(gradient: Any, mu: Any, lame: Any) -> Any:
        strain = (gradient + gradient.T) / 2
        return lame * jnp.trace(strain) * jnp.eye(3) + 2 * mu * strain

    class Compression(Problem):
        def custom_init(self, mu: Array, lame: Array) -> None:
            self.internal_vars = [mu[:, None], lame[:, None]]

        def get_tensor_map(self) -> Any:
            return stress

    mesh, ends = Mesh(case.mesh.points, case.mesh.cells, "TET4"), fe_peers.jax_fem_ends(LOWERED)
    problem = Compression(mesh, vec=3, dim=3, ele_type="TET4", dirichlet_bc_info=ends, additional_info=(case.shear, case.lame))
    linear = {"custom_solver": fe_peers.jax_fem_linear(case)} if solver == "pardiso" else {}
    return Result(np.asarray(solve(problem, linear)[0]))


def run_torch_fem(case: Case, method: str) -> Result:
    """torch-fem: its isotropic elasticity, and one of the linear solvers that it ships."""
    import torch
    from torchfem import Solid
    from torchfem.materials import IsotropicElasticity3D

    torch.set_default_dtype(torch.float64)
    young = torch.as_tensor(np.where(case.mesh.regions == 0, SOFT, STIFF))
    law = IsotropicElasticity3D(young, torch.full_like(young, POISSON))
    body = Solid(torch.as_tensor(case.mesh.points), torch.as_tensor(case.mesh.cells), law)
    support = prescribed(case, LOWERED)
    body.constraints, body.displacements = torch.as_tensor(support.constrained), torch.as_tensor(support.values)
    return Result(body.solve(method=method, aggregate_integration_points=False)[0].numpy())
