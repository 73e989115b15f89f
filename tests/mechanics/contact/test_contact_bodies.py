"""Whole bodies in contact: closed forms, Coulomb's limit, balance of reactions, joints, and lift-off."""

from dataclasses import replace

import numpy as np
import pytest
from builders import GEL, problem, relative
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from naibu.core.errors import ConvergenceError
from naibu.core.status import Status
from naibu.mechanics.contact.contact_surfaces import Friction, interface, rigid_contact
from naibu.mechanics.contact.indenter_geometry import bar_geometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import RAMP_MM, STICK, Contact
from naibu.mechanics.finite_elements.assembly import body_force
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.interfaces import split_at_plane
from naibu.meshing.primitives import box
from naibu.meshing.surface import faces_among, faces_towards, node_areas, side_nodes
from naibu.validation.analytic.finite_strain import critical_slope, plate_penetration, uniaxial

K_N, K_T = 2e4, 200.0
FLAT = plane_geometry((0.0, 0.0, -1.0))
TILT = Rotation.from_rotvec([0.1, -0.15, 0.05]).as_matrix()
SIZE = 20.0


def plates(mesh, *, stop, mu_base=STICK, mu_top=STICK, surface=FLAT, start=None, rotation=None, stiffness=K_T) -> tuple[Contact, Contact]:
    """A table under, and a plate or bar over a block."""
    start = np.array([0.0, 0.0, SIZE]) if start is None else np.asarray(start, dtype=float)
    base = rigid_contact(
        "base",
        mesh.points,
        faces_towards(mesh, (0, 0, -1)),
        plane_geometry((0, 0, 1)),
        start=(0, 0, 0),
        stop=(0, 0, 0),
        friction=Friction(mu_base, stiffness),
        normal_stiffness=K_N,
    )
    top = rigid_contact(
        "top",
        mesh.points,
        faces_towards(mesh, (0, 0, 1)),
        surface,
        start=start,
        stop=stop,
        friction=Friction(mu_top, stiffness),
        normal_stiffness=K_N,
        rotation=rotation,
    )
    return base, top


def block(n=4, **options):
    return box((SIZE,) * 3, (n,) * 3, **options)


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra"])
def test_frictionless_compression_is_uniaxial(cell_type):
    mesh = block(cell_type=cell_type)
    zero = (0.0, 0.0, 0.0)
    constrained = PrescribedDisplacement.none(mesh.n_points)
    constrained = constrained.and_also(np.flatnonzero(mesh.points[:, 0] == 0), zero, (True, False, False))
    constrained = constrained.and_also(np.flatnonzero(mesh.points[:, 1] == 0), zero, (False, True, False))
    base, top = plates(mesh, stop=(0, 0, 0.6 * SIZE), mu_base=0.0, mu_top=0.0)
    solution = solve(problem(mesh, contacts=(base, top), prescribed=constrained))

    def mismatch(stretch):
        pressure = -uniaxial(GEL, stretch).nominal_stress[2]
        return stretch * SIZE - 0.6 * SIZE - 2 * plate_penetration(pressure, K_N, RAMP_MM)

    state = uniaxial(GEL, brentq(mismatch, 0.55, 0.7))
    np.testing.assert_allclose(solution.displacement[:, :2], mesh.points[:, :2] * (state.stretches[0] - 1), atol=1e-5)
    assert solution.reactions["top"][2] == pytest.approx(state.nominal_stress[2] * SIZE**2, rel=1e-6)
    assert solution.penetration_mm == pytest.approx(plate_penetration(-state.nominal_stress[2], K_N, RAMP_MM), rel=1e-5)


@pytest.mark.parametrize("surface", [FLAT, bar_geometry("y", 10.0)], ids=["plate", "bar"])
@pytest.mark.parametrize("mu", [0.15, STICK], ids=["coulomb", "stick"])
def test_reactions_balance(surface, mu):
    mesh = block()
    contacts = plates(mesh, stop=(1.0, 0.5, 0.75 * SIZE), mu_base=STICK, mu_top=mu, surface=surface, rotation=TILT, start=(0, 0, SIZE + 4))
    solution = solve(problem(mesh, contacts=contacts))
    down = solution.reactions["top"]
    assert down[2] < -1000
    np.testing.assert_allclose(sum(solution.reactions.values()), 0, atol=2e-6 * np.abs(down).max())
    # moments too: of the contact forces at their deformed places
    state, before = solution.states[-1], solution.states[-2]
    moment, size = np.zeros(3), 0.0
    for c, anchors in zip(contacts, before.anchors, strict=True):
        response = c.evaluate(state.displacement, anchors, 1.0)
        nodal = c.scattered(response.force, mesh.n_points, response.orientation)
        each = np.cross(mesh.points + state.displacement, nodal)
        moment, size = moment + each.sum(axis=0), size + np.abs(each).sum()
    np.testing.assert_allclose(moment, 0, atol=1e-6 * size)


def test_a_body_that_nothing_holds_is_told():
    mesh = block(2)
    weight = np.tile([0.0, 0.0, -1.0], (mesh.n_points, 1))
    assert solve(problem(mesh, force=weight), throw=False).status is Status.SINGULAR
    with pytest.raises(ConvergenceError, match="can move freely"):
        solve(problem(mesh, force=weight))


def test_relaxation_ends_in_the_same_equilibrium():
    mesh = block()
    contacts = plates(mesh, stop=(0.5, 0.0, 0.8 * SIZE), mu_top=0.2, surface=bar_geometry("y", 10.0), rotation=TILT, start=(0, 0, SIZE + 2))
    body = problem(mesh, contacts=contacts)
    solution = solve(body)
    before, after = solution.states[-2:]
    found = Newton(body, SolverSettings()).pseudo_transient(before.displacement, before.anchors, after.load)
    assert found is not None
    np.testing.assert_allclose(found[0], after.displacement, atol=1e-5)


def test_dragged_block_slips_at_coulombs_limit():
    mesh = block(3)
    contacts = plates(mesh, stop=(12.0, 0.0, 0.9 * SIZE), mu_top=0.3)
    force = solve(problem(mesh, contacts=contacts)).reactions["top"]
    assert np.hypot(force[0], force[1]) <= 0.3 * -force[2] * (1 + 1e-9)
    assert force[0] == pytest.approx(0.3 * -force[2], rel=5e-3)


def test_gently_dragged_block_sticks():
    mesh = block(3)
    loose, fast = (
        solve(problem(mesh, contacts=plates(mesh, stop=(0.3, 0.0, 0.9 * SIZE), mu_base=mu, mu_top=mu, stiffness=2e3))).reactions["top"]
        for mu in (3.0, STICK)
    )
    assert relative(loose, fast) < 1e-6
    assert 0 < fast[0] < 3.0 * -fast[2]


def test_friction_stiffens_a_compressed_block_monotonically():
    mesh = block()
    force = [
        -solve(problem(mesh, contacts=plates(mesh, stop=(0, 0, 0.8 * SIZE), mu_base=mu, mu_top=mu))).reactions["top"][2]
        for mu in (0.01, 0.1, 0.3, STICK)
    ]
    free = -uniaxial(GEL, 0.8).nominal_stress[2] * SIZE**2
    assert (np.diff([free, *force]) > 0).all()
    assert force[0] < 1.02 * free


def on_a_slope(share: float, lift: float, mu=0.3):
    """A slab lying on a plane that is tilted by a share of the critical angle (its weight is turned), with the plane `lift` mm inside."""
    mesh = box((SIZE, SIZE, 4.0), (3, 3, 1))
    angle = share * critical_slope(mu)
    gravity = 9810 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    weight = body_force(elements(mesh), np.full(mesh.n_cells, 1e-5), gravity)
    base = plates(mesh, stop=(0, 0, 99), mu_base=mu)[0].with_path((0, 0, lift), (0, 0, lift))
    settings = SolverSettings(first_step=0.5, largest_step=0.5, smallest_step=0.1)
    return solve(problem(mesh, contacts=(base,), force=weight), settings=settings, throw=False), weight.sum(axis=0)


@pytest.mark.parametrize(("share", "holds"), [(0.95, True), (1.05, False)])
def test_block_on_a_slope_slides_beyond_the_critical_angle(share, holds):
    solution, weight = on_a_slope(share, 1e-4)
    assert (solution.status is Status.CONVERGED) == holds
    if holds:
        np.testing.assert_allclose(solution.reactions["base"], -weight, atol=1e-6 * np.abs(weight).sum())


def test_block_resting_exactly_on_the_table_carries_its_weight():
    solution, weight = on_a_slope(0.0, 0.0)
    np.testing.assert_allclose(solution.reactions["base"], -weight, atol=1e-6 * np.abs(weight).sum())


def test_departing_plate_releases_the_block():
    mesh = block(3)
    base, top = plates(mesh, start=(0, 0, 0.9 * SIZE), stop=(0, 0, 1.1 * SIZE), mu_top=0.2)
    tied = rigid_contact(
        "base",
        mesh.points,
        base.nodes[::9],
        base.surface,
        start=(0, 0, 0),
        stop=(0, 0, 0),
        friction=Friction(),
        normal_stiffness=K_N,
        tied=True,
    )
    pressed = []
    solution = solve(problem(mesh, contacts=(tied, top)), callback=pressed.append)
    assert pressed[-len(solution.states) + 1 :] == [state.load for state in solution.states[1:]]  # after those of a first attempt
    early = -solution.states[1].displacement[:, 2].min()
    assert early > 1
    assert not solution.reactions["top"].any()
    np.testing.assert_allclose(solution.displacement, 0, atol=1e-6 * early)


def joined(mu=0.0, *, tied=False):
    """A block of two halves, and the contact between them."""
    mesh = block(layers=[("low", SIZE / 2), ("high", SIZE / 2)])
    areas = node_areas(mesh, faces_among(*_lower_half(mesh)))
    split, pairs = split_at_plane(mesh, SIZE / 2)
    joint = interface("joint", split.points, pairs, areas[pairs[:, 0]], friction=Friction(mu, 2e4), normal_stiffness=1e6, tied=tied)
    return mesh, split, joint


def _lower_half(mesh):
    below = mesh.regions == 0
    lower = replace(mesh, cells=mesh.cells[below], regions=mesh.regions[below])
    return lower, np.flatnonzero(np.abs(mesh.points[:, 2] - SIZE / 2) < 1e-9)


def moved_top(mesh, shift):
    constrained = PrescribedDisplacement.none(mesh.n_points).and_also(side_nodes(mesh, "z-"), (0, 0, 0))
    return constrained.and_also(side_nodes(mesh, "z+"), shift)


def test_bonded_joint_is_as_good_as_one_piece():
    mesh, split, joint = joined(tied=True)
    assert joint.area.sum() == pytest.approx(SIZE**2)
    shift = (2.0, 0.0, 2.0)  # pulled apart and sheared
    whole = solve(problem(mesh, GEL, GEL, prescribed=moved_top(mesh, shift)))
    parts = solve(problem(split, GEL, GEL, contacts=(joint,), prescribed=moved_top(split, shift)))
    assert relative(parts.displacement[: mesh.n_points], whole.displacement) < 2e-3


def test_sliding_joint_carries_pressure_but_only_coulombs_shear():
    shift = (6.0, 0.0, -3.0)
    for mu in (0.0, 0.2):
        _, split, joint = joined(mu)
        solution = solve(problem(split, GEL, GEL, contacts=(joint,), prescribed=moved_top(split, shift)))
        force = solution.reactions["joint"]  # on the upper block
        assert force[2] > 1000
        assert np.hypot(force[0], force[1]) <= mu * force[2] * (1 + 1e-9)
        if mu:
            assert -force[0] == pytest.approx(mu * force[2], rel=0.02)
        slid = solution.displacement[joint.nodes[:, 1], 0] - solution.displacement[joint.nodes[:, 0], 0]
        assert slid.min() > 1


def test_sliding_joint_opens_when_pulled():
    _, split, joint = joined(0.3)
    solution = solve(problem(split, GEL, GEL, contacts=(joint,), prescribed=moved_top(split, (0, 0, 1.0))))
    assert not solution.reactions["joint"].any()
    opened = solution.displacement[joint.nodes[:, 1], 2] - solution.displacement[joint.nodes[:, 0], 2]
    np.testing.assert_allclose(opened, 1.0, atol=1e-6)
