"""Nearly incompressible blocks between sticking plates: averaged dilatation stays near a fine reference, plain elements lock.

The octant of a cube is pressed by 40 %, so that its edges fold towards the plates. Measured force over that of 8^3 averaged hexahedra:

=============================  =====  =====  =====
4^3 cells (2^3 split), nu =    .45    .49    .499
=============================  =====  =====  =====
hexahedra, averaged            1.039  1.045  1.046
tetrahedra, patches            1.049  1.051  1.055
tetrahedra, plain              1.14   1.48   3.90
hexahedra, plain               1.19   1.60   4.49
quadratic tetra, averaged      0.95   0.92   0.91
quadratic tetra, plain         1.00   0.99   1.01
=============================  =====  =====  =====
"""

import functools

import numpy as np
import pytest
from builders import as_kind, of, problem

from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box
from naibu.meshing.surface import side_nodes

RATIOS = (0.45, 0.49, 0.499)


@functools.cache
def force(nu: float, kind: str, formulation: str, n: int = 4) -> float:
    """Force, mN, that presses the octant of a 20 mm cube by 40 % between plates to which it sticks."""
    mesh = as_kind(box((10, 10, 10), (n, n, n), centred=False), kind)
    constrained = PrescribedDisplacement.none(mesh.n_points)
    for axis in range(3):
        constrained = constrained.and_also(np.flatnonzero(mesh.points[:, axis] < 1e-9), (0, 0, 0), tuple(axis == k for k in range(3)))
    top = side_nodes(mesh, "z+")
    body = problem(mesh, of("neo_hookean", nu), prescribed=constrained.and_also(top, (0, 0, -4)), formulation=formulation)
    solution = solve(body, settings=SolverSettings(tolerance=1e-6))
    return -float(body.assembler.forces(solution.displacement)[1][top, 2].sum())


@pytest.mark.parametrize("nu", RATIOS)
@pytest.mark.parametrize("kind", ["hexahedron", "tetra"])
def test_averaged_dilatation_does_not_lock(kind, nu):
    ratio = force(nu, kind, "mean_dilatation") / force(nu, "hexahedron", "mean_dilatation", 8)
    assert 1.0 < ratio < 1.065


@pytest.mark.parametrize(("nu", "least"), [(0.45, 1.10), (0.49, 1.40), (0.499, 3.5)])
@pytest.mark.parametrize("kind", ["hexahedron", "tetra"])
def test_standard_elements_lock(kind, nu, least):
    assert force(nu, kind, "standard") / force(nu, "hexahedron", "mean_dilatation", 8) > least


def test_quadratic_tetrahedra_do_not_lock_either_way():
    for formulation in ("mean_dilatation", "standard"):
        for nu in RATIOS:
            assert 0.85 < force(nu, "tetra10", formulation, 2) / force(nu, "hexahedron", "mean_dilatation", 8) < 1.06


@pytest.mark.parametrize("kind", ["hexahedron", "tetra"])
def test_force_settles_as_the_gel_becomes_incompressible(kind):
    """From nu = .49 to .499 the true force rises by 2.4 %; locking elements would follow the bulk modulus."""
    assert force(0.499, kind, "mean_dilatation") / force(0.49, kind, "mean_dilatation") == pytest.approx(1.024, abs=0.01)
