"""Penalties of contact follow the stiffness of what they touch, and bodies do not penetrate elements by more than a hundredth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import of, problem

from naibu.core.errors import ConvergenceError
from naibu.core.status import Status
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import bar_geometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK
from naibu.mechanics.finite_strain.penalties import with_softer_sticking, with_suited_penalties
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.sensitivities import Direction, sensitivities
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box
from naibu.meshing.surface import faces_towards

MESH = box((20.0, 20.0, 20.0), (4, 4, 4))
EDGE = 5.0
ANY = SolverSettings(penetration=np.inf)


def under_a_bar(normal_stiffness: float, young_modulus: float = 20.0, mu: float = STICK, tangential: float = 200.0) -> Problem:
    def body(name, side, surface, stop):
        start = (0, 0, 20.0 if side > 0 else 0.0)
        return rigid_contact(
            name, MESH.points, faces_towards(MESH, (0, 0, side)), surface, start=start, stop=stop, friction=Friction(mu, tangential),
            normal_stiffness=normal_stiffness,
        )  # fmt: skip

    base, top = body("base", -1, plane_geometry(), (0, 0, 0)), body("bar", 1, bar_geometry("y", 10.0), (0, 0, 17.0))
    return problem(MESH, of("neo_hookean", young_modulus=young_modulus), contacts=(base, top))


def test_no_body_penetrates_by_more_than_a_hundredth_of_an_element():
    """A soft penalty lets the bar sink in; with it raised the force is that of a stiff penalty."""
    soft, stiff = under_a_bar(100.0), under_a_bar(1e4)
    sunk, held, wanted = solve(soft, settings=ANY), solve(soft), solve(stiff, settings=ANY)
    assert sunk.relative_penetration > 0.02
    assert sunk.penetration_mm == pytest.approx(EDGE * sunk.relative_penetration)
    assert held.relative_penetration <= 0.01
    force, true, without = (s.reactions["bar"][2] for s in (held, wanted, sunk))
    assert abs(force / true - 1.0) < 0.02 < abs(without / true - 1.0)
    assert abs(sum(s[2] for s in held.reactions.values())) < 1e-5 * abs(force)


def test_penalties_that_suffice_stay():
    body = under_a_bar(5e3)
    solution = solve(body)
    assert solution.relative_penetration < 0.01
    for given, used in zip(body.contacts, solution.problem.contacts, strict=True):
        np.testing.assert_array_equal(given.normal_stiffness, used.normal_stiffness)
        np.testing.assert_array_equal(given.tangential_stiffness, used.tangential_stiffness)


def test_penetration_that_cannot_be_prevented_is_a_failure():
    settings = SolverSettings(first_step=1.0, largest_step=1.0, smallest_step=0.6, penetration=1e-12)
    assert solve(under_a_bar(5e3), settings=settings, throw=False).status is Status.PENETRATION
    with pytest.raises(ConvergenceError, match="penetrates"):
        solve(under_a_bar(5e3), settings=settings)


def test_derivatives_hold_where_penalties_were_raised():
    body = under_a_bar(200.0, mu=0.2)
    path = SolverSettings(first_step=0.5, largest_step=0.5, tolerance=1e-12, max_iterations=40)
    solution = solve(body, settings=path)
    raised = [s.normal_stiffness[1].max() for s in solution.states[1:]]
    assert raised[-1] > 200.0
    down, h = np.array([0, 0, 1.0]), 1e-5
    exact = sensitivities(body, solution.states, [Direction(contact=1, stop=down)])[-1][:, :, 0]
    base, bar = body.contacts
    ends = [solve(body.with_changes(contacts=(base, replace(bar, stop=bar.stop + sign * h * down))), settings=path) for sign in (1.0, -1.0)]
    slope = (ends[0].displacement - ends[1].displacement) / (2.0 * h)
    assert np.abs(exact - slope).max() < 1e-5 * np.abs(slope).max()


def test_stiff_elements_have_stiffer_contact():
    """Whatever the unit of stress: penalties over moduli stay within a factor of four."""
    ratio = []
    for scale in (1.0, 30.0, 1e3):
        used = with_suited_penalties(under_a_bar(20.0, young_modulus=20.0 * scale)).contacts[0].normal_stiffness
        assert np.log(used / 20.0) / np.log(4.0) == pytest.approx(np.round(np.log(used / 20.0) / np.log(4.0)))
        ratio.append(float(used[0]) * EDGE / (20.0 * scale))
    assert min(ratio) >= 20.0 and max(ratio) <= 84.0  # of three shear moduli, a little more than Young's


def test_only_frictional_points_on_soft_elements_stick_more_softly():
    assert with_softer_sticking(under_a_bar(5e3, mu=0.3)) is None
    assert with_softer_sticking(under_a_bar(5e3, young_modulus=0.5)) is None  # meant to stick, or springs
    softer = with_softer_sticking(under_a_bar(5e3, young_modulus=0.5, mu=0.3))
    assert softer is not None
    used = softer.contacts[1].tangential_stiffness * EDGE / 0.5
    assert used.max() <= 61.0 and used.min() >= 15.0
