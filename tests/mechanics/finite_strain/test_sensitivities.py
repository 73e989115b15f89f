"""Sensitivities of whole load paths, including Coulomb slip and its history, against central differences of solves."""

import threading
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
import pytest
import scipy.sparse as sp
from builders import GEL, of, problem
from scipy.spatial.transform import Rotation

from naibu.mechanics.contact.contact_surfaces import Friction, interface, rigid_contact
from naibu.mechanics.contact.indenter_geometry import IndenterGeometry, bar_geometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK, Contact
from naibu.mechanics.finite_strain import sensitivities as sensitivities_module
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.sensitivities import Direction, sensitivities
from naibu.mechanics.finite_strain.statics import Solution, solve
from naibu.mechanics.linear_algebra import solver_selection
from naibu.mechanics.linear_algebra.direct import PardisoSolver, pardiso_library
from naibu.meshing.interfaces import split_at_plane
from naibu.meshing.primitives import box
from naibu.meshing.surface import faces_among, faces_towards, node_areas

PATH = SolverSettings(first_step=0.1, largest_step=0.1, tolerance=1e-12, max_iterations=40)
SIZE = 20.0
MESH = box((SIZE, SIZE, SIZE), (3, 3, 4), layers=[("low", 10), ("high", 10)])
MATERIALS = (GEL, of("neo_hookean", 0.4, 35.0))
TILT = np.array([0.02, -0.03, 0.01])


def pressed(surface: IndenterGeometry, mu: float, *, joined: bool = True) -> Problem:
    """Two layers between a table and a tilted plate or bar that also moves sideways."""
    mesh, joints = MESH, []
    if not joined:
        below = replace(mesh, cells=mesh.cells[mesh.regions == 0], regions=mesh.regions[mesh.regions == 0])
        area = node_areas(mesh, faces_among(below, np.flatnonzero(np.abs(mesh.points[:, 2] - 10) < 1e-9)))
        mesh, pairs = split_at_plane(mesh, 10.0)
        joints = [interface("joint", mesh.points, pairs, area[pairs[:, 0]], friction=Friction(0.1, 300.0), normal_stiffness=1e4)]
    turn = Rotation.from_rotvec(TILT).as_matrix()
    base, top = (
        rigid_contact(
            name,
            mesh.points,
            faces_towards(mesh, (0, 0, side)),
            face,
            start=start,
            stop=stop,
            friction=Friction(mu, 150.0),
            normal_stiffness=5e3,
            rotation=rotation,
        )
        for name, side, face, start, stop, rotation in (
            ("base", -1, plane_geometry((0, 0, 1)), (0, 0, 0), (0, 0, 0), None),
            ("top", 1, surface, (0.2, 0.07, SIZE + 0.5), (0.7, -0.43, 0.8 * SIZE), turn),
        )
    )
    return problem(mesh, *MATERIALS, contacts=(base, top, *joints))


def changed(body: Problem, d: Direction, h: float) -> Problem:
    """The problem after a finite step along a direction, made without the code under test."""
    assembler = body.assembler
    if d.materials is not None:
        assembler = assembler.with_parameters(assembler.parameters + h * d.materials)
    contacts = list(body.contacts)
    if d.contact >= 0:
        contacts[d.contact] = _moved(contacts[d.contact], d, h)
    return body.with_changes(assembler=assembler, contacts=tuple(contacts))


def _moved(c: Contact, d: Direction, h: float) -> Contact:
    def plus(value, change):
        return value if change is None else value + h * change

    turn = np.eye(3) if d.rotation is None else Rotation.from_rotvec(h * d.rotation).as_matrix()
    return replace(
        c,
        start=plus(c.start, d.start),
        stop=plus(c.stop, d.stop),
        rotation=turn @ c.rotation,
        friction_coefficient=plus(c.friction_coefficient, d.friction),
        tangential_stiffness=plus(c.tangential_stiffness, d.tangential_stiffness),
    )


def directions(body: Problem) -> dict[str, tuple[Direction, float]]:
    """Every kind of direction, and the step of its finite difference."""
    rng = np.random.default_rng(0)
    cells, points = len(MESH.cells), [len(c.area) for c in body.contacts]
    law = body.assembler.parameters
    out = {
        "one parameter everywhere": (Direction(materials=np.array([1.0, 0, 0, 0]) * np.ones((cells, 1))), 1e-5),
        "every cell by itself": (Direction(materials=law * rng.uniform(-1, 1, law.shape)), 1e-5),
        "one layer": (Direction(materials=law * (MESH.regions == 1)[:, None]), 1e-5),
    }
    for i, name in enumerate(c.name for c in body.contacts):
        out[f"friction of {name}"] = (Direction(contact=i, friction=np.ones(points[i])), 1e-6)
        out[f"friction of {name}, point by point"] = (Direction(contact=i, friction=rng.uniform(0, 1, points[i])), 1e-6)
        out[f"tangential stiffness of {name}"] = (Direction(contact=i, tangential_stiffness=rng.uniform(0, 1, points[i])), 1e-3)
    for i, axis in ((0, 2), (1, 0), (1, 1), (1, 2)):
        unit = np.eye(3)[axis]
        out[f"start {'xyz'[axis]} of {i}"] = (Direction(contact=i, start=unit), 1e-5)
        out[f"stop {'xyz'[axis]} of {i}"] = (Direction(contact=i, stop=unit), 1e-5)
        out[f"turn about {'xyz'[axis]} of {i}"] = (Direction(contact=i, rotation=unit), 1e-6)
    out["all of a body at once"] = (
        Direction(
            contact=1, friction=np.ones(points[1]), start=rng.normal(size=3), stop=rng.normal(size=3), rotation=0.1 * rng.normal(size=3)
        ),
        1e-6,
    )
    return out


def slipping(solution: Solution, body: Problem) -> np.ndarray:
    """Fraction of the touching points of each contact that slip in the last step."""
    out = []
    for c, a in zip(body.contacts, solution.states[-2].anchors, strict=True):
        response = c.evaluate(solution.displacement, a, 1.0)
        touching = response.gap < 0
        out.append(response.slip_direction.any(axis=1)[touching].mean())
    return np.array(out)


def contact_status(body: Problem, solution: Solution) -> list[np.ndarray]:
    """Whether each point of all contacts touches, and whether it slips, in every state but the first."""
    out = []
    for before, state in pairwise(solution.states):
        responses = [c.evaluate(state.displacement, a, state.load) for c, a in zip(body.contacts, before.anchors, strict=True)]
        out.append(np.concatenate([np.column_stack((r.gap < 0, r.slip_direction.any(axis=1))) for r in responses]))
    return out


def unchanged(status: list[np.ndarray], other: list[np.ndarray]) -> list[bool]:
    """For every state, whether no point differs there or before."""
    same = [bool((a == b).all()) for a, b in zip(status, other, strict=True)]
    return list(accumulate(same, lambda before, now: before and now))


CASES = {
    "plate": (plane_geometry((0, 0, -1)), 0.15, True),
    "bar": (bar_geometry("y", 10.0, corner_radius_mm=2.0), 0.15, True),
    "plate, sliding joint": (plane_geometry((0, 0, -1)), 0.3, False),
    "bar, stick": (bar_geometry("x", 10.0, corner_radius_mm=2.0), STICK, True),
}


@pytest.mark.parametrize("case", [pytest.param(k, marks=[pytest.mark.slow] * (k == "plate")) for k in CASES])  # the same plate slides
def test_every_direction_against_finite_differences(case):
    surface, mu, joined = CASES[case]
    body = pressed(surface, mu, joined=joined)
    solution = solve(body, settings=PATH)
    slip = slipping(solution, body)
    assert (slip == 0).all() if mu == STICK else slip.max() > 0.1
    table = directions(body)
    exact = sensitivities(body, solution.states, [d for d, _ in table.values()])
    assert len(exact) == len(solution.states)
    assert not exact[0].any()
    touched = contact_status(body, solution)
    for k, (name, (direction, h)) in enumerate(table.items()):
        known = [(x.load, x.displacement) for x in solution.states[1:]]
        others = [changed(body, direction, s * h) for s in (1, -1)]
        up, down = (solve(other, settings=PATH, warm_start=known) for other in others)
        assert [s.load for s in up.states] == [s.load for s in down.states] == [s.load for s in solution.states]
        kept = [unchanged(contact_status(other, found), touched) for other, found in zip(others, (up, down), strict=True)]
        for i, (found, here, more, less) in enumerate(
            zip(exact[1:], solution.states[1:], up.states[1:], down.states[1:], strict=True)
        ):  # where a point begins to slip the solution has a kink, and a derivative on the side on which none does
            assert kept[0][i] or kept[1][i], (name, here.load)
            above, below, step = more if kept[0][i] else here, less if kept[1][i] else here, h * (int(kept[0][i]) + int(kept[1][i]))
            slope, allowed = (above.displacement - below.displacement) / step, 1e-5 if kept[0][i] and kept[1][i] else 3e-5
            error, size = np.abs(found[:, :, k] - slope).max(), np.abs(slope).max()
            assert error < allowed * size + 1e-8, (name, here.load, error, size)


def test_sum_of_directions_is_the_direction_of_the_sum():
    body = pressed(CASES["bar"][0], 0.15)
    states = solve(body, settings=PATH).states
    one, two = Direction(contact=1, stop=np.array([0, 0, 1.0])), Direction(contact=1, rotation=np.array([0.3, 0.1, 0]))
    both = Direction(contact=1, stop=2 * one.stop, rotation=-one.stop[2] * two.rotation)
    a, b, c = np.moveaxis(sensitivities(body, states, [one, two, both])[-1], 2, 0)
    np.testing.assert_allclose(c, 2 * a - b, atol=1e-10 * np.abs(c).max())


def test_scaling_all_stiffnesses_changes_nothing_but_penetration():
    """Where only displacements are given, the answer depends on ratios of moduli; what remains is due to the penalty."""
    body = pressed(plane_geometry((0, 0, -1)), 0.15)
    states = solve(body, settings=PATH).states
    table = [Direction(materials=body.assembler.parameters), Direction(materials=body.assembler.parameters * (MESH.regions == 1)[:, None])]
    overall, ratio = np.moveaxis(sensitivities(body, states, table)[-1], 2, 0)
    assert np.abs(overall).max() < 0.1 * np.abs(ratio).max()


@pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")
@pytest.mark.parametrize("threads", [2, 3, 100])
def test_tangents_that_are_factorized_ahead_are_those_of_their_states(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    body = pressed(plane_geometry((0, 0, -1)), 0.3)
    states = solve(body, settings=replace(PATH, tolerance=1e-9)).states
    wanted = [d for d, _ in directions(body).values()][:6]
    expected = sensitivities(body, states, wanted)
    monkeypatch.setattr(solver_selection, "UNSYMMETRIC_FROM", 0)
    monkeypatch.setattr(sensitivities_module, "usable_threads", lambda: threads)
    factorized: list[str] = []
    factorize = PardisoSolver.factorize

    def noted(solver: PardisoSolver, matrix: sp.bsr_matrix) -> PardisoSolver:
        factorized.append(threading.current_thread().name)
        return factorize(solver, matrix)

    monkeypatch.setattr(PardisoSolver, "factorize", noted)
    found = sensitivities(body, states, wanted)
    assert len({name for name in factorized if name != threading.main_thread().name}) > 0
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8 * np.abs(expected[-1]).max())
