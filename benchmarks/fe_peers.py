"""Other finite-element programs on the compression of ``fe_case.py``; each imports its program where it runs.

Every law is ``mu/2 (tr C - 3) - mu ln J + lambda/2 ln^2 J``. A program's own Newton method is used where it has one, and it gets naibu's
direct solver where it takes one.
"""

# mypy: disable-error-code="import-untyped,import-not-found", allow-subclassing-any

from __future__ import annotations

import functools
import logging
import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from fe_case import DEPTH, LOWERED, SIDE, STEPS, TOLERANCE, Array, Case, Cholesky, Result, largest_residual, newton, prescribed

from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows

DOLFINX = ("dolfinx", "petsc4py", "mpi4py")
SYSTEM_PYTHON = os.environ.get("DOLFINX_PYTHON", "/usr/bin/python3")  # DOLFINx comes with systems, not as a wheel
SMALL = 750  # cells of its warm-up


@functools.cache
def compiled_once() -> tempfile.TemporaryDirectory[str]:
    """Let JAX keep what it has compiled, in double precision, for as long as the folder returned lives."""
    import jax

    folder = tempfile.TemporaryDirectory()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", folder.name)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


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


def ngsolve_mesh(case: Case) -> tuple[Any, Any, Any]:
    """Return NGSolve's mesh and its coefficients mu and lambda."""
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
    return mesh, mu, lame


def ngsolve_free(constrained: Any) -> Any:
    """Return the unconstrained unknowns, for NGSolve."""
    import ngsolve as ng

    free = ng.BitArray(constrained.size)
    for dof, fixed in enumerate(constrained):
        free[dof] = not fixed
    return free


def run_ngsolve(case: Case) -> Result:
    """NGSolve: its compiled energy, its assembly and its sparse Cholesky on all cores, iterated like the others."""
    import ngsolve as ng

    mesh, mu, lame = ngsolve_mesh(case)
    space = ng.VectorH1(mesh, order=1)
    gradient = ng.Id(3) + ng.Grad(space.TrialFunction())
    volume = ng.Det(gradient)
    energy = mu / 2 * (ng.InnerProduct(gradient, gradient) - 3) - mu * ng.log(volume) + lame / 2 * ng.log(volume) ** 2
    form = ng.BilinearForm(space, symmetric=True)
    form += ng.Variation(energy.Compile() * ng.dx)
    support, count = prescribed(case), 0
    constrained = support.constrained.T.ravel()  # unknowns stand component after component
    free = ngsolve_free(constrained)
    u, r, jump = (ng.GridFunction(space).vec for _ in range(3))

    def residual() -> Array:
        form.Apply(u, r)
        return np.asarray(r.FV().NumPy())

    with ng.TaskManager():
        for step in range(1, STEPS + 1):
            target = step / STEPS * support.values.T.ravel()
            jump.FV().NumPy()[:] = np.where(constrained, target - u.FV().NumPy(), 0.0)
            force = residual()
            for _ in range(20):
                form.AssembleLinearization(u)
                r.data += form.mat * jump
                u.data += jump - form.mat.Inverse(free, inverse="sparsecholesky") * r
                jump[:] = 0.0
                count += 1
                force = residual()
                if np.abs(force[~constrained]).sum() <= TOLERANCE * np.abs(force[constrained]).sum():
                    break
    displacement = np.array(u.FV().NumPy()).reshape(3, -1).T
    return Result(displacement, np.array(force).reshape(3, -1).T[case.top].sum(axis=0), count)


def jax_fem_ends(depth: float) -> list[Any]:
    """Return JAX-FEM's conditions: the base fixed, the top lowered by `depth`, mm."""
    import jax.numpy as jnp

    def below(point: Any) -> Any:
        return jnp.isclose(point[2], 0.0)

    def above(point: Any) -> Any:
        return jnp.isclose(point[2], SIDE)

    return [[below] * 3 + [above] * 3, [0, 1, 2] * 2, [lambda _: 0.0] * 5 + [lambda _: -depth]]


def jax_fem_linear(case: Case) -> Callable[..., Array]:
    """Return naibu's direct solver for JAX-FEM; the rows of constrained nodes, which it replaces, are made symmetric again."""
    constrained, cholesky = prescribed(case).constrained, Cholesky()

    def linear(matrix: Any, b: Any, start: Any, _: Any) -> Array:
        indptr, indices, data = matrix.getValuesCSR()
        square, moved = sp.csr_matrix((data, indices, indptr), shape=matrix.getSize()), np.asarray(start)
        rhs = np.asarray(b) - square @ moved
        rhs[constrained.ravel()] = 0.0
        return moved + cholesky.factorize(with_dirichlet_rows(square.tobsr((3, 3)), constrained)).solve(rhs)

    return linear


def run_jax_fem(case: Case) -> Result:
    """JAX-FEM's `Problem` and `solver`."""
    import jax
    import jax.numpy as jnp
    from jax_fem.generate_mesh import Mesh
    from jax_fem.problem import Problem
    from jax_fem.solver import solver

    logging.getLogger("jax_fem").setLevel(logging.WARNING)
    compiled_once()

    def energy(f: Any, mu: Any, lame: Any) -> Any:
        log_j = jnp.log(jnp.linalg.det(f))
        return mu / 2 * (jnp.sum(f * f) - 3) - mu * log_j + lame / 2 * log_j**2

    class Compression(Problem):
        def custom_init(self, mu: Array, lame: Array) -> None:
            self.internal_vars = [mu[:, None], lame[:, None]]

        def get_tensor_map(self) -> Any:
            return lambda gradient, mu, lame: jax.grad(energy)(gradient + jnp.eye(3), mu, lame)

    linear, count = jax_fem_linear(case), 0

    def counted(*arguments: Any) -> Array:
        nonlocal count
        count += 1
        return linear(*arguments)

    mesh = Mesh(case.mesh.points, case.mesh.cells, "TET4")
    problem = Compression(mesh, vec=3, dim=3, ele_type="TET4", dirichlet_bc_info=jax_fem_ends(0.0), additional_info=(case.shear, case.lame))
    options = {"custom_solver": counted, "tol": largest_residual(case), "rel_tol": 0.0}
    solution = [jnp.zeros((case.mesh.n_points, 3))]
    for step in range(1, STEPS + 1):
        problem.fes[0].update_Dirichlet_boundary_conditions(jax_fem_ends(DEPTH * step / STEPS))
        solution = solver(problem, options | {"initial_guess": solution})
    force = np.asarray(problem.compute_residual(solution)[0])
    return Result(np.asarray(solution[0]), force[case.top].sum(axis=0), count)


@functools.cache
def tatva_forces() -> Any:
    """Return the gradient of the energy, one and the same function for all runs so that JAX compiles it once."""
    import jax
    import jax.numpy as jnp
    from jax_autovmap import autovmap
    from tatva import linalg

    def density(gradient: Any, mu: Any, lame: Any) -> Any:
        f = gradient + jnp.eye(3)
        log_j = jnp.log(linalg.det(f))
        return mu / 2 * (jnp.sum(f * f) - 3) - mu * log_j + lame / 2 * log_j**2

    everywhere = autovmap(gradient=2, mu=0, lame=0)(density)

    def energy(u: Any, operator: Any, mu: Any, lame: Any) -> Any:
        return operator.integrate(everywhere(operator.grad(u.reshape(-1, 3)), mu, lame))

    return jax.jit(jax.grad(energy))


def tatva_tangent(case: Case, forces: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the coloured sparse derivative of forces, and what they take besides the displacement."""
    import jax.numpy as jnp
    from tatva import Mesh, Operator, element, sparse

    compiled_once()
    mesh = Mesh(jnp.asarray(case.mesh.points), jnp.asarray(case.mesh.cells))
    operator = Operator(mesh, element.Tetrahedron4(), cache_weights=True)
    data = operator, jnp.asarray(case.shear[:, None]), jnp.asarray(case.lame[:, None])
    pattern = sparse.ColoredMatrix.from_csr(sparse.pattern_from_mesh(mesh, 3))
    return sparse.jacfwd(forces, pattern, color_batch_size=1), data  # all colours at once took longer


def run_tatva(case: Case) -> Result:
    """tatva: energy, automatic differentiation and coloured sparse tangent; Newton's method is `newton`."""
    import jax.numpy as jnp

    gradient = tatva_forces()
    stiffness, data = tatva_tangent(case, gradient)

    def forces(u: Array) -> Array:
        return np.array(gradient(jnp.asarray(u.ravel()), *data)).reshape(-1, 3)

    return newton(case, forces, lambda u: stiffness(jnp.asarray(u.ravel()), *data).to_csr().tobsr((3, 3)), "pardiso")


def run_torch_fem(case: Case, method: str) -> Result:
    """torch-fem with its own Newton method and load increments, and one of the linear solvers that it ships.

    It begins a step with the increment of the last one, but with constrained nodes displaced. The first of 5 steps would flatten the
    uppermost of 20 layers of cells to nothing, from where it does not converge; that step is therefore taken in two, of 1 and 2 mm.
    """
    import torch
    from torchfem import Solid
    from torchfem.materials import Hyperelastic3D

    torch.set_default_dtype(torch.float64)

    def energy(f: Any, parameters: Any) -> Any:
        c = f.transpose(-1, -2) @ f
        log_j = torch.logdet(c) / 2
        return parameters[0] / 2 * (torch.trace(c) - 3) - parameters[0] * log_j + parameters[1] / 2 * log_j**2

    tangents = 0

    class Counted(Solid):
        def assemble_matrix(self, *arguments: Any) -> Any:
            nonlocal tangents
            tangents += 1
            return super().assemble_matrix(*arguments)

    law = Hyperelastic3D(energy, torch.as_tensor(np.stack([case.shear, case.lame], axis=1)))
    body = Counted(torch.as_tensor(case.mesh.points), torch.as_tensor(case.mesh.cells), law)
    support = prescribed(case)
    body.constraints = torch.as_tensor(support.constrained)
    body.displacements = torch.as_tensor(support.values)
    levels = torch.tensor([0.0, 1 / 3, *range(1, STEPS + 1)]) / STEPS
    u, force, *_ = body.solve(increments=levels, rtol=0.0, atol=largest_residual(case), method=method, aggregate_integration_points=False)
    return Result(u.numpy(), force.numpy()[case.top].sum(axis=0), tangents - (len(levels) - 1))


@functools.cache
def register_sfepy_law() -> str:
    """Add the law, which SfePy does not ship, to its terms of hyperelasticity, and return its name; assembly stays SfePy's."""
    from sfepy.terms import register_term
    from sfepy.terms.terms_hyperelastic_tl import HyperElasticTLBase

    rows, columns = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])  # of the six components of a symmetric tensor
    i, j, k, m = rows[:, None], columns[:, None], rows[None, :], columns[None, :]

    def stress(out: Array, parameters: Array, det_f: Array, inverse: Array) -> None:
        mu, lame = parameters[:, :, :1], parameters[:, :, 1:]
        out[:] = (lame * np.log(det_f) - mu) * inverse
        out[:, :, :3] += mu

    def tangent(out: Array, parameters: Array, det_f: Array, inverse: Array) -> None:
        mu, lame = parameters[:, :, :1], parameters[:, :, 1:]
        full = np.empty((*inverse.shape[:2], 3, 3))
        full[:, :, rows, columns] = full[:, :, columns, rows] = inverse[..., 0]
        swapped = full[:, :, i, k] * full[:, :, j, m] + full[:, :, i, m] * full[:, :, j, k]
        out[:] = lame * inverse * inverse.swapaxes(2, 3) + (mu - lame * np.log(det_f)) * swapped

    class NeoHookean(HyperElasticTLBase):
        name = "dw_tl_he_neohook_log"
        arg_shapes: ClassVar = {"material": "2, 1", "virtual": ("D", "state"), "state": "D"}
        family_data_names: ClassVar = ["det_f", "sym_inv_c"]
        stress_function, tan_mod_function = staticmethod(stress), staticmethod(tangent)

    register_term(NeoHookean)
    return NeoHookean.name


def sfepy_problem(case: Case, term: str, parameters: Array, depth: Callable[[Any], float]) -> Any:
    """Return SfePy's problem for a term with parameters (m, r, c); the top is lowered by a depth, mm, that may depend on the time step."""
    from sfepy.discrete import Equation, Equations, FieldVariable, Function, Integral, Material, Problem
    from sfepy.discrete.conditions import Conditions, EssentialBC
    from sfepy.discrete.fem import FEDomain, Field, Mesh
    from sfepy.terms import Term

    cells, regions = case.mesh.cells.astype(np.int32), case.mesh.regions.astype(np.int32)
    domain = FEDomain("cube", Mesh.from_data("cube", case.mesh.points, None, [cells], [regions], ["3_4"]))
    everything = domain.create_region("Omega", "all")
    below = domain.create_region("Below", f"vertices in (z < {1e-6})", "facet")
    above = domain.create_region("Above", f"vertices in (z > {SIDE - 1e-6})", "facet")
    field = Field.from_args("displacement", np.float64, "vector", everything, approx_order=1)
    u, v = FieldVariable("u", "unknown", field), FieldVariable("v", "test", field, primary_var_name="u")
    data = Material("m", function=lambda ts, coors, mode=None, **_: {"p": parameters} if mode == "qp" else None)
    integral = Integral("i", order=1)
    field.get_mapping(everything, integral, "cell")
    field.save_mappings()  # or it would be computed anew at every iteration
    law = Term.new(f"{term}(m.p, v, u)", integral, everything, m=data, v=v, u=u)
    problem = Problem("compression", equations=Equations([Equation("balance", law)]))
    lowered = Function("lowered", lambda ts, coors, **_: np.full(len(coors), -depth(ts)))
    fixed = EssentialBC("fixed", below, {"u.all": 0.0})
    moved = EssentialBC("moved", above, {"u.[0,1]": 0.0, "u.2": lowered})
    problem.set_bcs(ebcs=Conditions([fixed, moved]))
    problem.set_ics(ics=Conditions([]))
    return problem


def sfepy_linear() -> Any:
    """Return naibu's direct solver for SfePy, which counts the systems that it has solved."""
    from sfepy.solvers.ls import LinearSolver

    class Direct(LinearSolver):
        name = "ls.naibu"
        count, cholesky = 0, Cholesky()

        def __call__(self, rhs: Array, mtx: Any = None, status: Any = None, **_: Any) -> Array:
            self.count += 1
            if status is not None:
                status["n_iter"] = 1
            matrix = sp.csr_matrix(mtx).sorted_indices().tobsr((1, 1))
            return np.asarray(self.cholesky.factorize(matrix).solve(rhs))

    return Direct({})


def run_sfepy(case: Case) -> Result:
    """SfePy with its Newton method and time stepping; only the linear solver is given to it.

    It begins a step with constrained nodes displaced, which flattens the uppermost cells; a step is therefore begun with all nodes moved
    in proportion to their height.
    """
    from sfepy.base.base import output
    from sfepy.solvers.nls import Newton
    from sfepy.solvers.ts_solvers import SimpleTimeSteppingSolver

    output.set_output(quiet=True)
    direct = sfepy_linear()

    class Steps(SimpleTimeSteppingSolver):
        def solve_step(self, ts: Any, nls: Any, vec: Array, prestep_fun: Any = None) -> Any:
            return super().solve_step(ts, nls, vec + move, prestep_fun)

    parameters = np.stack([case.shear, case.lame], axis=1)[:, :, None]
    problem = sfepy_problem(case, register_sfepy_law(), parameters, lambda ts: DEPTH * ts.time)
    settings = {"i_max": 20, "eps_a": largest_residual(case), "eps_r": 1.0, "lin_red": None}
    problem.set_solver(Steps({"t0": 0.0, "t1": 1.0, "n_step": STEPS + 1}, nls=Newton(settings, lin_solver=direct), context=problem))
    guess = np.zeros_like(case.mesh.points)
    guess[:, 2] = -DEPTH / STEPS * case.mesh.points[:, 2] / SIDE
    problem.time_update()
    move = problem.equations.variables.reduce_vec(guess.ravel())
    variables = problem.solve(save_results=False)
    u = variables()
    problem.remove_bcs()
    force = np.asarray(problem.evaluator.eval_residual(u)).reshape(-1, 3)
    return Result(u.reshape(-1, 3), force[case.top].sum(axis=0), direct.count)


def run_dolfinx(case: Case, law: str, solver: str, processes: int = 1) -> Result:
    """DOLFINx: see ``fe_dolfinx.py``, which measures itself."""
    support = prescribed(case, DEPTH if law == "neo_hookean" else LOWERED)
    problem: dict[str, Any] = {"law": law, "solver": solver, "steps": STEPS, "tolerance": TOLERANCE}
    mesh: dict[str, Any] = {
        "points": case.mesh.points,
        "cells": case.mesh.cells,
        "small": case.mesh.cells[:SMALL],
        "shear": case.shear,
        "lame": case.lame,
    }
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        np.savez(given, values=support.values, constrained=support.constrained, **mesh, **problem)
        script = Path(__file__).with_name("fe_dolfinx.py")
        command = ["mpirun", "--allow-run-as-root", "-n", str(processes), SYSTEM_PYTHON, str(script), str(given), str(found)]
        clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
        subprocess.run(command, check=True, env=clean | {"OMP_NUM_THREADS": "1"})
        with np.load(found) as arrays:
            seconds, memory, count = arrays["numbers"]
            force = arrays["force"][case.top].sum(axis=0) if law == "neo_hookean" else np.empty(0)
            return Result(arrays["u"], force, int(count), (float(seconds), float(memory)))
