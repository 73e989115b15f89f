"""Quasi-static solves: patch tests, closed forms, manufactured solutions with their rates, and what failure says."""

from dataclasses import replace

import numpy as np
import pytest
from builders import GEL, KINDS, distorted, of, problem, relative

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.core.status import Status
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import plane_geometry
from naibu.mechanics.finite_elements.assembly import body_force
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import LAWS
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import AHEAD, solve
from naibu.mechanics.linear_algebra.direct import SuperLUSolver
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import MultigridSolver
from naibu.meshing.element_conversion import to_quadratic, to_tetra
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes, faces_towards, side_nodes
from naibu.validation.analytic.finite_strain import ThickShell, confined, first_piola, self_weight_settlement, uniaxial

ZERO = (0.0, 0.0, 0.0)


def roller(mesh: Mesh, *, base=True) -> PrescribedDisplacement:
    """Symmetry planes x = 0 and y = 0 of a mesh in the first octant, and z = 0."""
    constrained = PrescribedDisplacement.none(mesh.n_points)
    for axis in range(3 if base else 2):
        constrained = constrained.and_also(np.flatnonzero(np.abs(mesh.points[:, axis]) < 1e-9), ZERO, tuple(axis == k for k in range(3)))
    return constrained


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("kind", KINDS)
def test_patch_prescribed_on_the_boundary_fills_the_inside(kind, law):
    mesh = distorted(kind, divisions=2)
    move = np.array([[0.1, 0.15, -0.05], [0.0, -0.1, 0.1], [-0.1, 0.05, 0.15]])
    outside = boundary_nodes(mesh)
    support = PrescribedDisplacement.none(mesh.n_points).and_also(outside, mesh.points[outside] @ move.T)
    solution = solve(problem(mesh, of(law), prescribed=support), settings=SolverSettings(tolerance=1e-10))
    np.testing.assert_allclose(solution.displacement, mesh.points @ move.T, atol=1e-8)
    assert solution.status is Status.CONVERGED
    assert solution.residual < 1e-10


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("stretch", [0.7, 1.3])
def test_uniaxial_and_confined_states(law, stretch):
    mesh, m = box((4, 5, 6), (2, 2, 2), centred=False), of(law, 0.4)
    support = roller(mesh).and_also(side_nodes(mesh, "z+"), (0, 0, 6 * (stretch - 1)), (False, False, True))
    free = solve(problem(mesh, m, prescribed=support))
    expected = uniaxial(m, stretch)
    np.testing.assert_allclose(free.displacement, mesh.points * (expected.stretches - 1), atol=1e-6)
    top = side_nodes(mesh, "z+")
    force = problem(mesh, m).assembler.forces(free.displacement)[1][top].sum(axis=0)
    assert force[2] == pytest.approx(20 * expected.nominal_stress[2], rel=1e-6)
    walls = support.and_also(side_nodes(mesh, "x+"), ZERO, (True, False, False)).and_also(
        side_nodes(mesh, "y+"), ZERO, (False, True, False)
    )
    force = problem(mesh, m).assembler.forces(solve(problem(mesh, m, prescribed=walls)).displacement)[1][top].sum(axis=0)
    assert force[2] == pytest.approx(20 * confined(m, stretch).nominal_stress[2], rel=1e-6)


def test_confined_column_settles_under_its_weight():
    mesh = box((4, 4, 50), (1, 1, 10), centred=False)
    support = (
        roller(mesh)
        .and_also(side_nodes(mesh, "x+"), ZERO, (True, False, False))
        .and_also(side_nodes(mesh, "y+"), ZERO, (False, True, False))
    )
    weight = body_force(elements(mesh), np.full(mesh.n_cells, 1e-6), np.array([0.0, 0.0, -9.81]))  # a thousandth: small strain
    solution = solve(problem(mesh, prescribed=support, force=weight))
    settled = self_weight_settlement(mesh.points[:, 2], column_mm=50, density=1e-6, gravity=9.81, young_modulus=20, poisson_ratio=0.45)
    np.testing.assert_allclose(solution.displacement[:, 2], settled, atol=1e-4 * np.abs(settled).max())
    assert solution.reactions["prescribed"][2] == pytest.approx(-weight[:, 2].sum(), rel=1e-6)


def pipe(n: int, kind: str) -> Mesh:
    """A quarter of a tube of radii 10 and 25 mm, one mm long."""
    flat = box((15, np.pi / 2, 1), (n, n, 1), centred=False)
    radius, angle = flat.points[:, 0] + 10, flat.points[:, 1]
    bent = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), flat.points[:, 2]])
    mesh = Mesh.from_arrays(bent, flat.cells, "hexahedron")
    return {"hexahedron": lambda m: m, "tetra": to_tetra, "tetra10": lambda m: to_quadratic(to_tetra(m))}[kind](mesh)


@pytest.mark.parametrize(
    ("kind", "formulation", "rate"),
    [
        ("hexahedron", "mean_dilatation", 1.8),
        ("hexahedron", "standard", 1.8),
        ("tetra", "standard", 1.6),
        ("tetra", "mean_dilatation", 1.2),
    ],
)
def test_pressurised_tube_converges_to_lame(kind, formulation, rate):
    shell = ThickShell(10, 25, 1e-4, 0, 20, 0.45, "cylinder")
    errors = []
    for n in (4, 8, 16):
        mesh = pipe(n, kind)
        radius = np.hypot(mesh.points[:, 0], mesh.points[:, 1])
        radial = shell.displacement(radius)[:, None] * mesh.points * [1, 1, 0] / radius[:, None]
        inner = np.flatnonzero(radius < 10.001)
        support = PrescribedDisplacement.none(mesh.n_points).and_also(np.arange(mesh.n_points), ZERO, (False, False, True))
        support = support.and_also(np.flatnonzero(mesh.points[:, 0] < 1e-9), ZERO, (True, False, False))
        support = support.and_also(np.flatnonzero(mesh.points[:, 1] < 1e-9), ZERO, (False, True, False)).and_also(inner, radial[inner])
        solution = solve(
            problem(mesh, prescribed=support, formulation=formulation), settings=SolverSettings(first_step=1.0, largest_step=1.0)
        )
        errors.append(np.sqrt(((solution.displacement - radial) ** 2).mean()) / np.abs(radial).max())
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates[-1] > rate, errors
    assert errors[-1] < 2e-3, errors


def manufactured(x: np.ndarray) -> np.ndarray:
    """A smooth displacement of a 10 mm cube with stretches up to about 25 %."""
    s = np.pi * x / 10
    return 0.6 * np.stack(
        [np.sin(s[..., 1]) * np.cos(s[..., 2]), 0.8 * np.sin(s[..., 2] + s[..., 0]), np.cos(s[..., 0]) * np.sin(s[..., 1])], axis=-1
    )


def manufactured_force(m, x: np.ndarray) -> np.ndarray:
    """Body force -Div P, mN/mm3, by central differences of the closed-form stress."""
    h, k = 1e-3, 1e-4
    eye = np.eye(3)

    def stress(at):
        gradient = np.stack([(manufactured(at + h * e) - manufactured(at - h * e)) / (2 * h) for e in eye], axis=-1)
        return first_piola(m, gradient + eye)

    return -sum((stress(x + k * eye[j])[..., :, j] - stress(x - k * eye[j])[..., :, j]) / (2 * k) for j in range(3))


def nodal_load(mesh: Mesh, m) -> np.ndarray:
    """The body force integrated with trilinear shape functions at 2 x 2 x 2 Gauss points."""
    corners = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    shape = np.prod(1 + corners[:, None] / np.sqrt(3) * corners[None], axis=2) / 8
    density = manufactured_force(m, np.einsum("qa,mai->mqi", shape, mesh.points[mesh.cells]))
    local = np.einsum("mq,qa,mqi->mai", elements(mesh).weights, shape, density)
    out = np.zeros(mesh.points.shape)
    np.add.at(out, mesh.cells, local)
    return out


@pytest.mark.parametrize("law", ["neo_hookean", "mooney_rivlin"])
def test_manufactured_finite_deformation_converges_with_order_two(law):
    m, errors = of(law, 0.4), []
    for n in (3, 6, 12):
        mesh = box((10, 10, 10), (n, n, n), centred=False)
        exact, outside = manufactured(mesh.points), boundary_nodes(mesh)
        support = PrescribedDisplacement.none(mesh.n_points).and_also(outside, exact[outside])
        body = problem(mesh, m, prescribed=support, force=nodal_load(mesh, m))
        newton = Newton(body, SolverSettings())
        found = newton.solve(exact, (), 1.0)
        assert found is not None
        errors.append(np.sqrt(((found[0] - exact) ** 2).mean()))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates[-1] > 1.8, errors


def crushed(fraction: float) -> tuple:
    mesh = box((10, 10, 10), (3, 3, 3))
    support = (
        PrescribedDisplacement.none(mesh.n_points)
        .and_also(side_nodes(mesh, "z-"), ZERO)
        .and_also(side_nodes(mesh, "z+"), (0, 0, -10 * fraction))
    )
    return mesh, problem(mesh, prescribed=support)


def test_a_load_that_must_invert_elements_is_told():
    _, body = crushed(1.2)
    settings = SolverSettings(smallest_step=0.02)
    solution = solve(body, settings=settings, throw=False)
    assert solution.status is Status.INVERSION
    assert not solution.status.ok
    assert 0.2 < solution.states[-1].load < 1 / 1.2
    assert body.assembler.forces(solution.displacement)[2] > 0
    residual, scale, _ = Newton(body, settings).residual(solution.displacement, (), solution.states[-1].load)
    assert np.abs(residual).sum() < 1e-6 * scale  # what is returned is in equilibrium
    with pytest.raises(ConvergenceError, match=r"stopped at \d+\.\d % of the load\. An element is about to turn inside out.* near \(-?\d"):
        solve(body, settings=settings)


def test_a_floating_body_is_not_taken_for_solved():
    mesh = box((10, 10, 10), (2, 2, 2))
    weight = body_force(elements(mesh), np.full(mesh.n_cells, 1e-6), np.array([0.0, 0.0, -9810.0]))
    assert not solve(problem(mesh, force=weight), throw=False).status.ok


def test_a_body_that_nothing_loads_stays():
    mesh = box((10, 10, 10), (2, 2, 2))
    base = rigid_contact(
        "base",
        mesh.points,
        faces_towards(mesh, (0, 0, -1)),
        plane_geometry((0, 0, 1)),
        start=ZERO,
        stop=ZERO,
        friction=Friction(),
        normal_stiffness=1e3,
    )
    solution = solve(problem(mesh, contacts=(base,)))
    assert not solution.displacement.any()
    assert solution.reactions["base"].tolist() == [0, 0, 0]


def test_forces_that_are_not_numbers_are_refused():
    mesh, body = crushed(0.1)
    force = np.zeros(mesh.points.shape)
    force[3, 1] = np.nan
    with pytest.raises(InputError, match="finite"):
        solve(problem(mesh, prescribed=body.prescribed, force=force))


def pressed(n=4) -> tuple:
    """A block under a plate with Coulomb friction."""
    mesh = box((20, 20, 20), (n, n, n))
    bodies = [
        rigid_contact(
            name,
            mesh.points,
            faces_towards(mesh, (0, 0, side)),
            plane_geometry((0, 0, -side)),
            start=(0, 0, 10 + 10 * side),
            stop=stop,
            friction=Friction(0.2),
            normal_stiffness=5e3,
        )
        for name, side, stop in (("base", -1, ZERO), ("top", 1, (0.5, 0, 15)))
    ]
    return mesh, problem(mesh, contacts=bodies)


def test_the_same_problem_gives_the_same_bits():
    one, two = solve(pressed()[1]), solve(pressed()[1])
    assert np.array_equal(one.displacement, two.displacement)
    assert [s.load for s in one.states] == [s.load for s in two.states]
    assert one.iterations == two.iterations
    assert np.array_equal(one.reactions["top"], two.reactions["top"])


def test_linear_solvers_lead_to_the_same_state():
    _, body = pressed()
    assert relative(solve(body, solver=SuperLUSolver()).displacement, solve(body).displacement) < 1e-6
    mesh, stuck = crushed(0.3)
    reference = solve(stuck)
    multigrid = solve(stuck, solver=MultigridSolver(mesh.points, stuck.prescribed.constrained))
    assert relative(multigrid.displacement, reference.displacement) < 1e-6
    assert multigrid.linear_solver == MultigridSolver.name
    assert solve(stuck, settings=SolverSettings(linear_solver="multigrid")).linear_solver == MultigridSolver.name


def test_states_follow_the_load_and_are_reported():
    _, body = crushed(0.3)
    seen = []
    solution = solve(body, callback=seen.append)
    assert seen == [s.load for s in solution.states[1:]]
    assert seen[-1] == 1.0
    assert (np.diff([0.0, *seen]) > 0).all()
    for state in solution.states:
        np.testing.assert_allclose(
            state.displacement[body.prescribed.constrained], state.load * body.prescribed.values[body.prescribed.constrained], atol=1e-14
        )


def test_reaction_is_the_derivative_of_the_energy():
    """Castigliano: force on the plate = d(energy)/d(height)."""
    energies, heights = [], np.array([0.199, 0.2, 0.201])
    for fraction in heights:
        _, body = crushed(fraction)
        solution = solve(body, settings=SolverSettings(tolerance=1e-10))
        energies.append(body.assembler.forces(solution.displacement)[0])
    mesh, body = crushed(0.2)
    solution = solve(body)
    top = body.assembler.forces(solution.displacement)[1][side_nodes(mesh, "z+"), 2].sum()
    assert -top == pytest.approx((energies[2] - energies[0]) / (10 * 0.002), rel=1e-4)
    np.testing.assert_allclose(solution.reactions["prescribed"], 0, atol=1e-9 * abs(top))


def test_stiffer_gel_moves_alike_and_pushes_in_proportion():
    soft, hard = (
        solve(problem(mesh, m, prescribed=body.prescribed)) for m in (GEL, of("neo_hookean", 0.45, 60.0)) for mesh, body in [crushed(0.3)]
    )
    assert relative(hard.displacement, soft.displacement) < 1e-8


def test_forces_and_conditions_for_another_mesh_are_refused():
    mesh, body = pressed()
    with pytest.raises(InputError, match="external_force must have shape"):
        replace(body, external_force=np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"prescribed\.constrained must have shape"):
        replace(body, prescribed=PrescribedDisplacement.none(mesh.n_points + 1))


def test_a_solve_gives_up_after_the_iterations_it_is_allowed():
    mesh = box((4, 5, 6), (2, 2, 2), centred=False)
    support = roller(mesh).and_also(side_nodes(mesh, "z+"), (0, 0, -3.0), (False, False, True))
    whole = solve(problem(mesh, of("neo_hookean", 0.4), prescribed=support))
    allowed = whole.iterations // 2
    settings = SolverSettings(max_total_iterations=allowed)
    part = solve(problem(mesh, of("neo_hookean", 0.4), prescribed=support), settings=settings, throw=False)
    assert part.status is Status.ITERATION_LIMIT and part.states[-1].load < 1.0
    assert allowed <= part.iterations < allowed + settings.max_iterations


def test_a_solve_near_a_known_one_gives_up_where_it_spends_more_than_its_share():
    mesh = box((4, 5, 6), (2, 2, 2), centred=False)
    support = roller(mesh).and_also(side_nodes(mesh, "z+"), (0, 0, -3.0), (False, False, True))
    body = problem(mesh, of("neo_hookean", 0.4), prescribed=support)
    whole = solve(body)
    poor, allowed = [(state.load, 0.0 * state.displacement) for state in whole.states[1:]], whole.iterations // 2
    part = solve(body, settings=SolverSettings(max_total_iterations=allowed), warm_start=poor, throw=False)
    assert part.status is Status.ITERATION_LIMIT and part.states[-1].load > 0.0
    assert allowed * (part.states[-1].load + AHEAD) <= part.iterations < allowed


def test_a_loose_tolerance_on_the_way_moves_the_end_by_less_than_itself():
    mesh, body = pressed()
    loads = [(k / 8.0, np.zeros(mesh.points.shape)) for k in range(1, 9)]  # both ways in the same load steps
    exact = solve(body, settings=SolverSettings(tolerance=1e-9), warm_start=loads)
    quick = solve(body, settings=SolverSettings(tolerance=1e-9, path_tolerance=1e-3), warm_start=loads)
    assert [s.load for s in quick.states] == [s.load for s in exact.states]
    assert quick.residual <= 1e-9
    assert quick.iterations < exact.iterations
    assert relative(quick.displacement, exact.displacement) < 1e-3


def test_a_path_with_known_penalties_is_followed_again_without_raising_them():
    body = pressed()[1]
    soft = body.with_changes(contacts=tuple(replace(c, normal_stiffness=0.002 * c.normal_stiffness) for c in body.contacts))
    found = solve(soft, settings=SolverSettings(penetration=1e-3))
    known = {s.load: s.normal_stiffness for s in found.states[1:]}
    assert any((known[1.0][k] > c.normal_stiffness).any() for k, c in enumerate(soft.contacts))
    path = [(s.load, s.displacement) for s in found.states[1:]]
    again = solve(soft, settings=SolverSettings(penetration=1e-3), warm_start=path, stiffness=known)
    assert again.iterations <= len(path)
    np.testing.assert_allclose(again.displacement, found.displacement, atol=1e-5)
