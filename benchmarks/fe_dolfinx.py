"""DOLFINx on the problems of ``fe_linear.py`` and ``fe_compression.py``, run by the Python for which it is installed.

``mpirun -n RANKS python3 fe_dolfinx.py IN.npz OUT.npz``. IN holds points, cells, Lame parameters and prescribed displacements of the mesh;
OUT gets the displacement, and seconds and MB of all ranks. Solvers: conjugate gradients with GAMG, the rigid-body modes and Chebyshev
smoothing, as in DOLFINx's own demonstration of elasticity, to a relative residual of 1e-8 (1e-6 in Newton's method), or MUMPS. What is
timed begins when DOLFINx has its mesh, which favours it, and forms are compiled before. Debian and Ubuntu have it as the package
python3-dolfinx (0.5.2 here); this script imports nothing of naibu.
"""

# mypy: ignore-errors

from __future__ import annotations

import resource
import sys
import time

import dolfinx
import numpy as np
import ufl
from dolfinx import fem, la
from dolfinx.fem.petsc import apply_lifting, assemble_matrix, assemble_vector, create_matrix, set_bc
from mpi4py import MPI
from petsc4py import PETSc

GAMG = {
    "ksp_type": "cg",
    "pc_type": "gamg",
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "jacobi",
    "mg_levels_ksp_chebyshev_esteig_steps": 20,
}
MUMPS = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
SOLVERS = {"gamg": GAMG, "mumps": MUMPS}


def rigid_body_modes(space):
    """Return PETSc's near null space of a vector space."""
    basis = [la.create_petsc_vector(space.dofmap.index_map, space.dofmap.index_map_bs) for _ in range(6)]
    x = space.tabulate_dof_coordinates()[: space.dofmap.index_map.size_local]
    for k, vector in enumerate(basis):
        with vector.localForm() as local:
            values = np.zeros((len(local.array) // 3, 3))
            own = values[: len(x)]
            if k < 3:
                own[:, k] = 1.0
            else:
                i, j = ((0, 1), (2, 0), (1, 2))[k - 3]
                own[:, i], own[:, j] = -x[:, j], x[:, i]
            local.array[:] = values.ravel()
    plain = [vector.array.copy() for vector in basis]
    for k in range(6):  # orthonormal, as PETSc demands
        for other in range(k):
            plain[k] -= MPI.COMM_WORLD.allreduce(float(plain[k] @ plain[other])) * plain[other]
        plain[k] /= np.sqrt(MPI.COMM_WORLD.allreduce(float(plain[k] @ plain[k])))
        basis[k].array[:] = plain[k]
    return PETSc.NullSpace().create(vectors=basis)


class Problem:
    """The mesh of this rank, with the moduli of its cells and the displacement that is prescribed."""

    def __init__(self, domain, arrays):
        self.domain, self.space = domain, fem.VectorFunctionSpace(domain, ("CG", 1))
        constants = fem.FunctionSpace(domain, ("DG", 0))
        self.mu, self.lame = fem.Function(constants), fem.Function(constants)
        of_cell = np.asarray(domain.topology.original_cell_index)
        for function, key in ((self.mu, "shear"), (self.lame, "lame")):
            function.x.array[: len(of_cell)] = arrays[key][of_cell]
        self.nodes = np.asarray(domain.geometry.input_global_indices)  # of the geometry, whose order linear spaces share
        self.values = arrays["values"][self.nodes].ravel()
        self.prescribed = fem.Function(self.space)
        at = np.flatnonzero(arrays["constrained"][self.nodes].all(axis=1)).astype(np.int32)
        self.support = fem.dirichletbc(self.prescribed, at)
        self.constrained = np.repeat(arrays["constrained"][self.nodes].all(axis=1), 3)

    def solver(self, matrix, kind, tolerance):
        """Return PETSc's solver with a matrix."""
        matrix.setNearNullSpace(rigid_body_modes(self.space))
        options, out = PETSc.Options(), PETSc.KSP().create(self.domain.comm)
        for name, setting in SOLVERS[kind].items():
            options[name] = setting
        out.setFromOptions()
        out.setTolerances(rtol=tolerance)
        out.setOperators(matrix)
        return out

    def own(self, u, force):
        """Return nodes, displacement and forces of this rank."""
        count = self.domain.geometry.index_map().size_local
        return self.nodes[:count], u.x.array.reshape(-1, 3)[:count], force.reshape(-1, 3)[:count]


def converged(solver):
    """Raise an error if PETSc has not solved."""
    if solver.getConvergedReason() <= 0:
        raise RuntimeError(f"PETSc did not converge: {solver.getConvergedReason()}")


def linear(problem, arrays):
    """Return the displacement of small strains, no forces, and the number of linear systems."""
    mu, lame = problem.mu, problem.lame
    u, v = ufl.TrialFunction(problem.space), ufl.TestFunction(problem.space)
    strain = 2.0 * mu * ufl.sym(ufl.grad(u)) + lame * ufl.tr(ufl.sym(ufl.grad(u))) * ufl.Identity(3)
    stiffness = fem.form(ufl.inner(strain, ufl.grad(v)) * ufl.dx)
    load = fem.form(ufl.inner(fem.Function(problem.space), v) * ufl.dx)
    problem.prescribed.x.array[:] = problem.values
    matrix = assemble_matrix(stiffness, bcs=[problem.support])
    matrix.assemble()
    b = assemble_vector(load)
    apply_lifting(b, [stiffness], bcs=[[problem.support]])
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    set_bc(b, [problem.support])
    out = fem.Function(problem.space)
    solver = problem.solver(matrix, str(arrays["solver"]), 1e-8)
    solver.solve(b, out.vector)
    converged(solver)
    return out, np.zeros(len(problem.values)), 1


def neo_hookean(problem, arrays):
    """Return the displacement of finite strains, nodal forces and the number of linear systems.

    Full Newton's method with the others' criterion. Constrained nodes move by the tangent of the state before, as in DOLFINx's own solver.
    """
    comm = problem.domain.comm
    u, v, du = fem.Function(problem.space), ufl.TestFunction(problem.space), ufl.TrialFunction(problem.space)
    gradient = ufl.Identity(3) + ufl.grad(u)
    volume = ufl.det(gradient)
    energy = problem.mu / 2 * (ufl.inner(gradient, gradient) - 3) - problem.mu * ufl.ln(volume) + problem.lame / 2 * ufl.ln(volume) ** 2
    force = ufl.derivative(energy * ufl.dx, u, v)
    forces, stiffness = fem.form(force), fem.form(ufl.derivative(force, u, du))
    matrix, count, change = create_matrix(stiffness), 0, fem.Function(problem.space)
    solver = problem.solver(matrix, str(arrays["solver"]), 1e-6)
    own = problem.space.dofmap.index_map.size_local * 3
    steps = int(arrays["steps"])
    for step in range(1, steps + 1):
        problem.prescribed.x.array[:] = step / steps * problem.values
        for _ in range(20):
            matrix.zeroEntries()
            assemble_matrix(matrix, stiffness, bcs=[problem.support])
            matrix.assemble()
            b = assemble_vector(forces)
            apply_lifting(b, [stiffness], bcs=[[problem.support]], x0=[u.vector], scale=-1.0)
            b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
            set_bc(b, [problem.support], u.vector, -1.0)
            solver.solve(b, change.vector)
            converged(solver)
            change.x.scatter_forward()
            u.x.array[:] -= change.x.array
            count += 1
            balance = assemble_vector(forces)
            balance.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
            size, held = np.abs(balance.array), problem.constrained[:own]
            if comm.allreduce(size[~held].sum()) <= float(arrays["tolerance"]) * comm.allreduce(size[held].sum()):
                break
    return u, balance.array, count


LAWS = {"linear": linear, "neo_hookean": neo_hookean}


def run(points, cells, arrays):
    """Return nodes, displacement and forces of this rank, the number of linear systems, and seconds."""
    comm = MPI.COMM_WORLD
    share = np.array_split(np.arange(len(cells)), comm.size)[comm.rank]
    nodes = np.array_split(points, comm.size)[comm.rank]
    element = ufl.Mesh(ufl.VectorElement("Lagrange", ufl.Cell("tetrahedron"), 1))
    domain = dolfinx.mesh.create_mesh(comm, cells[share], nodes, element)
    comm.barrier()
    start = time.perf_counter()
    problem = Problem(domain, arrays)
    u, force, count = LAWS[str(arrays["law"])](problem, arrays)
    comm.barrier()
    seconds = time.perf_counter() - start
    return *problem.own(u, force), count, seconds


def main():
    """Run a small problem, which compiles the forms, then that of the file."""
    with np.load(sys.argv[1]) as file:
        arrays = dict(file)
    comm = MPI.COMM_WORLD
    small = np.unique(arrays["small"])
    place = np.zeros(len(arrays["points"]), dtype=np.int64)
    place[small] = np.arange(len(small))
    cells = place[arrays["small"]]
    settings = {key: arrays[key] for key in ("law", "solver", "steps", "tolerance")}
    first = settings | {"shear": np.ones(len(cells)), "lame": np.ones(len(cells)), "values": np.zeros((len(small), 3))}
    run(arrays["points"][small], cells, first | {"constrained": np.arange(len(small))[:, None] < [len(small) // 2] * 3})
    nodes, u, force, count, seconds = run(arrays["points"], arrays["cells"], arrays)
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    gathered = comm.gather((nodes, u, force))
    if comm.rank == 0:
        whole = np.zeros((2, *arrays["points"].shape))
        for at, *values in gathered:
            whole[:, at] = values
        np.savez(sys.argv[2], u=whole[0], force=whole[1], numbers=[seconds, memory, count])


if __name__ == "__main__":
    main()
