"""The kernel of linear tetrahedra agrees with the general one, whatever the number of threads."""

from dataclasses import replace

import numpy as np
import pytest
from builders import assembler, distorted, of, problem, relative

from naibu.mechanics.finite_elements import assembly
from naibu.mechanics.finite_elements._tet4_kernels import partition
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import LAWS
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.surface import side_nodes


def general(fast):
    """The same assembler with the kernel for groups of any kind."""
    order, start = assembly._colours(fast.elements.connectivity, fast.elements.n_points)
    return replace(fast, _partition=None, _order=order, _colour_start=start)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("law", LAWS)
def test_agrees_with_the_general_kernel(law, count):
    mesh = distorted("tetra", divisions=4)
    made = assembler(mesh, of(law), formulation="standard")
    fast = replace(made, _partition=partition(made.elements.connectivity, made.pattern.indptr, made.pattern.indices, count))
    u = np.random.default_rng(1).normal(size=mesh.points.shape) * 0.1
    for a, b in zip(fast.evaluate(u), general(made).evaluate(u), strict=True):
        assert relative(a, b) < 1e-13
    assert relative(fast.forces(u)[1], general(made).forces(u)[1]) < 1e-13


def test_owners_share_all_nodes_and_visit_all_their_cells():
    made = assembler(distorted("tetra", divisions=6), formulation="standard")
    cells = made.elements.connectivity
    divided = partition(cells, made.pattern.indptr, made.pattern.indices, 3)
    assert np.ptp(np.bincount(divided.owner, minlength=3)) <= 1
    for p in range(3):
        visited = set(divided.cells[divided.start[p] : divided.start[p + 1]])
        assert visited == set(np.flatnonzero((divided.owner[cells] == p).any(axis=1)))
    assert len(divided.cells) < 2 * len(cells)


@pytest.mark.parametrize("divisions", [2, 10])  # one thread, all threads
@pytest.mark.parametrize("formulation", ["standard", "mean_dilatation"])
def test_a_flat_element_is_told_by_its_determinant(formulation, divisions):
    mesh = distorted("tetra", divisions=divisions, amount=0.0)
    flat = np.where(mesh.points[:, [2]] > mesh.points[:, 2].max() - 1e-9, [0.0, 0.0, -mesh.points[:, 2].max() / divisions], 0.0)
    assert assembler(mesh, formulation=formulation).forces(flat)[2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("formulation", ["standard", "mean_dilatation"])
def test_one_step_may_be_deeper_than_an_element(formulation):
    mesh = distorted("tetra", divisions=5, amount=0.0)
    prescribed = (
        PrescribedDisplacement.none(mesh.n_points)
        .and_also(side_nodes(mesh, "z-"), (0, 0, 0))
        .and_also(side_nodes(mesh, "z+"), (0, 0, -2.5))
    )
    body = problem(mesh, prescribed=prescribed, formulation=formulation)
    once = solve(body, settings=SolverSettings(first_step=1.0, largest_step=1.0))
    assert len(once.states) == 2
    assert relative(once.displacement, solve(body).displacement) < 1e-6
