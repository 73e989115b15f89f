"""What is said where a load cannot be followed is what happens there."""

import numpy as np
import pytest
from builders import KINDS, as_kind, problem

from naibu.core.errors import ConvergenceError
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import plane_geometry
from naibu.mechanics.finite_elements.assembly import body_force
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_strain.failure_reasons import alternating_points, smallest_volume_ratio
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_faces


@pytest.mark.parametrize("kind", KINDS)
def test_the_volume_ratio_is_that_of_the_motion(kind: str) -> None:
    """x = X (1 + X / 40) along one axis has det F = 1 + X / 20: the smallest is at the integration point closest to X = -10."""
    mesh = as_kind(box((20.0, 20.0, 20.0), (8, 2, 2)), kind)
    discrete = elements(mesh)
    x = mesh.points[:, 0]
    u = np.zeros_like(mesh.points)
    u[:, 0] = x * x / 40.0
    ratio, group = smallest_volume_ratio(discrete, u)
    assert 0.5 <= ratio < 0.5 + 2.5 / 20.0  # within the first of eight cells
    assert x[discrete.connectivity[group]].min() == -10.0


def slab(slope: float, friction: float) -> Problem:
    """A slab on a plane whose normal is turned from its weight by the angle of this slope."""
    mesh = box((20.0, 20.0, 4.0), (3, 3, 1))
    angle = np.arctan(slope)
    weight = body_force(elements(mesh), np.full(mesh.n_cells, 1e-5), 9810 * np.array([np.sin(angle), 0.0, -np.cos(angle)]))
    bottom = boundary_faces(mesh).faces
    bottom = bottom[(mesh.points[bottom][:, :, 2] == mesh.points[:, 2].min()).all(axis=1)]
    base = rigid_contact(
        "base", mesh.points, bottom, plane_geometry(), start=(0, 0, 1e-4), stop=(0, 0, 1e-4), friction=Friction(friction, 50.0),
        normal_stiffness=5e3,
    )  # fmt: skip
    return problem(mesh, contacts=(base,), force=weight)


def test_a_body_that_slides_away_is_said_to_find_no_rest() -> None:
    settings = SolverSettings(first_step=0.5, largest_step=0.5, smallest_step=0.1)
    assert solve(slab(0.28, 0.3), settings=settings).status.ok
    with pytest.raises(ConvergenceError, match=r"loses its equilibrium.*moved farther than its own size near \("):
        solve(slab(0.304, 0.3), settings=settings)


def test_points_that_come_to_slip_are_counted() -> None:
    body = slab(0.32, 0.3)
    at_rest = tuple(c.anchors_at_rest() for c in body.contacts)
    changed, touching = alternating_points(Newton(body, SolverSettings()), np.zeros_like(body.points), at_rest, 1.0)
    assert 0 <= changed <= touching <= 9 * 9  # nine points on each of nine faces
    assert touching > 0
