"""The law of contact, point by point: distances, Coulomb's limit, and derivatives against finite differences."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.mechanics.contact.contact_surfaces import Friction, face_quadrature, interface, rigid_contact
from naibu.mechanics.contact.indenter_geometry import bar_geometry, plane_geometry
from naibu.mechanics.contact.penalty_contact import RAMP_MM, STICK, Contact
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.meshing.primitives import box
from naibu.meshing.surface import face_normals, faces_towards
from naibu.validation.analytic.finite_strain import plate_penetration

SEED = st.integers(0, 2**32 - 1)
K_N, K_T = 2e4, 200.0
FLAT, BAR = plane_geometry((0.0, 0.0, -1.0)), bar_geometry("y", 12.0, corner_radius_mm=2.0)
TILT = Rotation.from_rotvec([0.1, -0.15, 0.05]).as_matrix()


def points(y, *, surface=FLAT, mu=0.3, tied=False, rotation=None, area=1.7) -> Contact:
    """Free points that touch a body; displacement 0 puts them at `y` (p, 3) in the body's frame."""
    y, turn = np.atleast_2d(y).astype(float), np.eye(3) if rotation is None else rotation
    p, zero = len(y), np.zeros(3)
    return Contact(
        "body",
        np.arange(p)[:, None],
        np.ones((p, 1)),
        y @ turn.T,
        np.full(p, area),
        surface,
        zero,
        zero,
        turn,
        np.full(p, K_N),
        np.full(p, K_T),
        np.full(p, mu),
        np.ones(p),
        tied,
    )


def distance_to_bar(x, z, half=6.0, radius=2.0):
    """Signed distance to a rounded half strip that hangs above z = 0 (inigo quilez' formula for a rounded box)."""
    q = np.stack([np.abs(x) - (half - radius), -z + radius])
    return np.linalg.norm(np.maximum(q, 0), axis=0) + np.minimum(q.max(axis=0), 0) - radius


@given(x=st.floats(-12, 12), y=st.floats(-9, 9), z=st.floats(-6, 1.9))
@settings(max_examples=100, deadline=None)
def test_gap_to_a_bar_is_its_distance(x, y, z):
    response = points([[x, y, z]], surface=BAR).evaluate(np.zeros((1, 3)), np.zeros((1, 3)), 0.0)
    assert response.gap[0] == pytest.approx(distance_to_bar(np.array([x]), np.array([z]))[0], abs=1e-12)
    along_x = points([[y, x, z]], surface=bar_geometry("x", 12.0, corner_radius_mm=2.0)).evaluate(np.zeros((1, 3)), np.zeros((1, 3)), 0.0)
    assert along_x.gap[0] == pytest.approx(response.gap[0])


def differences(function, at, h=1e-6):
    """Central differences (p, 3, 3) of a vector field whose rows do not depend on each other."""
    out = np.empty((len(at), 3, 3))
    for j in range(3):
        step = h * np.eye(3)[j]
        out[:, :, j] = (function(at + step) - function(at - step)) / (2 * h)
    return out


def touching(seed: int, surface, *, ramp=False) -> np.ndarray:
    """Places that press on the body: at the face, and at the rounded edge of a bar."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.1, 0.9, 8) * RAMP_MM if ramp else rng.uniform(0.012, 0.2, 8)
    x, y = rng.uniform(-3.5, 3.5, 8), rng.uniform(-5, 5, 8)
    if surface.kind == FLAT.kind:
        return np.column_stack([x, y, depth])
    angle, side = rng.uniform(0.05, 1.5, 8), rng.choice([-1, 1], 8)
    edge = np.column_stack([side * (4 + (2 - depth) * np.sin(angle)), y, 2 - (2 - depth) * np.cos(angle)])
    return np.where((np.arange(8) < 4)[:, None], np.column_stack([x, y, depth]), edge)


@pytest.mark.parametrize("regime", ["stick", "slip", "ramp", "tied", "frictionless"])
@pytest.mark.parametrize("surface", [FLAT, BAR], ids=["plane", "bar"])
@given(seed=SEED)
@settings(max_examples=15, deadline=None)
def test_derivatives_of_tractions(surface, regime, seed):
    rng = np.random.default_rng(seed)
    y = touching(seed, surface, ramp=regime == "ramp")
    mu = {"stick": 1e3, "slip": 0.01, "ramp": 0.3, "tied": 0.1, "frictionless": 0.0}[regime]
    c = points(y, surface=surface, mu=mu, tied=regime == "tied")
    anchors = y + rng.normal(scale=3.0 if regime == "slip" else 0.05, size=y.shape)
    zero = np.zeros_like(y)
    response = c.evaluate(zero, anchors, 0.0)
    pressure = np.linalg.norm(response.force + c.area[:, None] * response.tangential, axis=1)
    rubbing = c.area * np.linalg.norm(response.tangential, axis=1)
    at_limit = np.abs(rubbing - mu * pressure) < 1e-9 * pressure
    trial = np.linalg.norm(points(y, surface=surface, mu=STICK).evaluate(zero, anchors, 0.0).tangential, axis=1) * c.area
    assume((np.abs(trial - mu * pressure) > 1e-3 * pressure * max(mu, 1e-3)).all())  # not at the corner between stick and slip
    if regime != "ramp":
        assert at_limit.mean() >= 0.5 if regime in ("slip", "frictionless") else not at_limit.any()
    size = np.abs(response.stiffness).max()
    np.testing.assert_allclose(response.stiffness, -differences(lambda u: c.evaluate(u, anchors, 0.0).force, zero), atol=1e-6 * size)
    by_place = differences(lambda u: c.evaluate(u, anchors, 0.0).tangential, zero)
    np.testing.assert_allclose(response.tangential_stiffness, by_place, atol=1e-6 * size)
    by_anchor = differences(lambda a: c.evaluate(zero, a, 0.0).force, anchors)
    np.testing.assert_allclose(response.anchor_stiffness, by_anchor, atol=1e-6 * size)
    more, less = (points(y, surface=surface, mu=mu + s * 1e-6, tied=regime == "tied").evaluate(zero, anchors, 0.0).force for s in (1, -1))
    if mu > 0:
        np.testing.assert_allclose(response.slip_direction, (more - less) / 2e-6, atol=1e-6 * np.abs(response.force).max())


@given(seed=SEED)
@settings(max_examples=20, deadline=None)
def test_coulombs_limit_holds_and_friction_opposes_slip(seed):
    rng = np.random.default_rng(seed)
    y = touching(seed, BAR)
    anchors = y + rng.normal(scale=1.0, size=y.shape)
    c = points(y, surface=BAR, mu=0.4)
    response = c.evaluate(np.zeros_like(y), anchors, 0.0)
    friction = -response.tangential
    normal = response.force / c.area[:, None] - friction
    np.testing.assert_allclose(np.einsum("pi,pi->p", friction, normal), 0, atol=1e-9 * np.abs(normal).max() ** 2)
    assert (np.linalg.norm(friction, axis=1) <= 0.4 * np.linalg.norm(normal, axis=1) * (1 + 1e-12)).all()
    assert (np.einsum("pi,pi->p", friction, y - anchors) <= 0).all()
    # the next anchor would give the same friction again, elastically
    again = points(y, surface=BAR, mu=STICK).evaluate(np.zeros_like(y), c.next_anchors(response), 0.0)
    np.testing.assert_allclose(again.tangential, response.tangential, atol=1e-9 * np.abs(response.tangential).max() + 1e-12)


def test_points_apart_from_the_body_feel_nothing_unless_tied():
    away, zero = np.array([[0.0, 0.0, -0.5]]), np.zeros((1, 3))
    response = points(away).evaluate(zero, zero, 0.0)
    assert response.gap[0] == pytest.approx(0.5)
    assert not response.force.any()
    assert not response.stiffness.any()
    np.testing.assert_allclose(points(away, tied=True).evaluate(zero, away, 0.0).force, [[0, 0, 0.5 * K_N * 1.7]])


def test_pressure_starts_smoothly_and_is_linear_beyond_the_ramp():
    depth = np.linspace(0, 0.05, 101)
    c = points(np.column_stack([0 * depth, 0 * depth, depth]), mu=0.0, area=1.0)
    pressure = -c.evaluate(np.zeros((101, 3)), c.anchors_at_rest(), 0.0).force[:, 2]
    assert plate_penetration(pressure[50], K_N, RAMP_MM) == pytest.approx(depth[50])
    assert plate_penetration(pressure[7], K_N, RAMP_MM) == pytest.approx(depth[7])
    slopes = np.diff(pressure) / np.diff(depth)
    assert np.diff(slopes).min() > -1e-6
    np.testing.assert_allclose(slopes[21:], K_N)


def test_without_its_curvature_a_body_presses_alike_and_is_never_softer():
    y = touching(5, BAR)
    c, zero = points(y, surface=BAR), np.zeros_like(y)
    full, plain = c.evaluate(zero, y, 0.0), c.evaluate(zero, y, 0.0, curvature=False)
    np.testing.assert_array_equal(full.force, plain.force)
    difference = np.linalg.eigvalsh(plain.stiffness - full.stiffness)
    assert difference.min() > -1e-9 * np.abs(plain.stiffness).max()
    assert difference.max() > 0.0


def test_a_turned_body_gives_turned_forces():
    y = touching(5, BAR)
    anchors = y + 0.3
    straight, turned = points(y, surface=BAR), points(y, surface=BAR, rotation=TILT)
    zero = np.zeros_like(y)
    one, two = straight.evaluate(zero, anchors, 0.0), turned.evaluate(zero, anchors, 0.0)
    np.testing.assert_allclose(straight.scattered(one.force, 8, np.eye(3)) @ TILT.T, turned.scattered(two.force, 8, TILT), atol=1e-9)
    h, move = 1e-6, np.random.default_rng(0).normal(size=y.shape)
    change = (turned.evaluate(h * move, anchors, 0.0).force - turned.evaluate(-h * move, anchors, 0.0).force) / (2 * h)
    np.testing.assert_allclose(change, -np.einsum("pij,pj->pi", two.stiffness, move @ TILT), rtol=1e-5, atol=1e-5 * np.abs(change).max())


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra"])
def test_quadrature_of_faces_integrates_areas_and_linear_fields(cell_type):
    mesh = box((6, 4, 3), (3, 2, 2), cell_type=cell_type)
    faces = faces_towards(mesh, (0, 0, 1))
    shape, area = face_quadrature(mesh.points, faces)
    assert area.sum() == pytest.approx(24)
    centre = np.einsum("fq,qk,fki->i", area, shape, mesh.points[faces])
    np.testing.assert_allclose(centre, [0, 0, 72], atol=1e-12)
    assert face_normals(mesh.points, faces)[:, 2].min() > 0


def test_bad_contacts_are_refused():
    mesh = box((1, 1, 1), (1, 1, 1))
    top = faces_towards(mesh, (0, 0, 1))
    common = {"start": (0, 0, 1), "stop": (0, 0, 1), "friction": Friction()}
    with pytest.raises(InputError, match="normal of a plane"):
        plane_geometry((0, 0, 0))
    with pytest.raises(InputError, match="corner radius"):
        bar_geometry("x", 10.0, corner_radius_mm=6.0)
    with pytest.raises(InputError, match="lid: faces is empty"):
        rigid_contact("lid", mesh.points, top[:0], FLAT, normal_stiffness=1.0, **common)
    with pytest.raises(InputError, match="lid: normal_stiffness must be positive, kPa/mm"):
        rigid_contact("lid", mesh.points, top, FLAT, normal_stiffness=0.0, **common)
    with pytest.raises(InputError, match="coefficient >= 0"):
        Friction(-0.1)
    with pytest.raises(InputError, match="coinciding nodes"):
        interface("joint", mesh.points, np.array([[0, 1]]), np.ones(1), friction=Friction(), normal_stiffness=1.0)
    with pytest.raises(InputError, match="nodes has node 9; the mesh has nodes 0 to 7"):
        PrescribedDisplacement.none(8).and_also([9], (0, 0, 0))
    with pytest.raises(InputError, match="finite"):
        PrescribedDisplacement.none(8).and_also([1], (0, 0, np.nan))
