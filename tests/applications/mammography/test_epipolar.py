"""Two views of a breast: shape from outlines, epipolar curve and band, position of a lesion."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.mammography.breast_outline import BreastOutline, breast_outline, inside_polygon
from naibu.applications.mammography.breast_shape import half_ellipsoid_shape
from naibu.applications.mammography.epipolar import EpipolarCurve, MammographicPair, ModelUncertainty
from naibu.applications.mammography.geometric_model import DEFAULT_PARAMETERS, Compression, CompressionParameters, compressed
from naibu.applications.mammography.pair_construction import mammographic_pair, pair_of_shape
from naibu.applications.mammography.two_views import two_views
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

SHAPE = half_ellipsoid_shape((130.0, 140.0, 90.0))
PLATES, ANGLE = (60.0, 55.0), 45.0


def shadow(state: Compression) -> BreastOutline:
    """Return the outline of a compressed breast: the largest extents of its columns, from their maps."""
    depths = np.linspace(0.0, state.shape.depth_mm, 300)
    centres, squares = state.shape.in_view(state.angle_deg, depths)
    t = np.deg2rad(state.angle_deg)
    ends = []
    for sign in (-1.0, 1.0):
        along = centres[:, 0] + sign * np.sqrt(squares[:, 0])
        across = centres[:, 1] + sign * squares[:, 2] / np.sqrt(np.maximum(squares[:, 0], 1e-9))
        points = np.column_stack([np.cos(t) * along - np.sin(t) * across, np.sin(t) * along + np.cos(t) * across, depths])
        ends.append(state.project(points))
    return breast_outline(np.vstack([ends[0], ends[1][::-1]]))


def views(
    first: CompressionParameters = DEFAULT_PARAMETERS, second: CompressionParameters = DEFAULT_PARAMETERS
) -> tuple[Compression, Compression]:
    return compressed(SHAPE, 0.0, PLATES[0], first), compressed(SHAPE, ANGLE, PLATES[1], second)


def interior(count: int) -> FloatArray:
    random = np.random.default_rng(2)
    points = random.uniform(-1.0, 1.0, (20 * count, 3)) * [1, 1, 0.5] + [0, 0, 0.5]
    kept = points[(points**2).sum(axis=1) < 0.6][:count]
    return kept * [65.0, 70.0, 90.0]


@pytest.fixture(scope="module")
def pair() -> MammographicPair:
    cc, mlo = views()
    return mammographic_pair(shadow(cc), shadow(mlo), PLATES, ANGLE, draws=60, seed=1)


def test_the_unloaded_shape_is_found_from_the_outlines() -> None:
    cc, mlo = views()
    found = two_views(shadow(cc), shadow(mlo), PLATES, ANGLE)
    assert found.shape.volume_mm3 == pytest.approx(SHAPE.volume_mm3, rel=0.03)
    assert found.shape.depth_mm == pytest.approx(90.0, rel=0.03)  # the deeper of both views is taken to reach the chest wall
    for state in (found.cc, found.mlo):
        assert state.volume_mm3() == pytest.approx(found.shape.volume_mm3, rel=0.05)


@pytest.mark.parametrize("angle", [30.0, 45.0, 90.0])
def test_of_a_breast_that_is_hardly_pressed_the_curve_is_the_line_of_two_parallel_projections(angle: float) -> None:
    # a rigid body in two parallel projections about the axis away from the chest wall: the depth is the same in both, a point at a of
    # the first and y of the height lies at a cos(t) + y sin(t) of the second, and the half ellipsoid ends where its equation says
    rx, ry, depth_mm = 65.0, 70.0, 90.0
    t = np.deg2rad(angle)
    shape = half_ellipsoid_shape((2.0 * rx, 2.0 * ry, depth_mm), sections=2000)
    plates = (1.0 - 1e-5) * 2.0 * ry, (1.0 - 1e-5) * 2.0 * float(np.hypot(rx * np.sin(t), ry * np.cos(t)))
    known = ModelUncertainty(thickness_mm=0.0, angle_deg=0.0)  # plates that are a little farther apart would not press
    pair = pair_of_shape(shape, plates, angle, uncertainty=known, draws=20)
    for depth, along in ((40.0, 20.0), (10.0, -45.0), (60.0, 0.0)):
        curve = pair.epipolar_curve([depth, along]).curve
        np.testing.assert_allclose(curve[:, 0], depth, atol=0.02)
        reach = ry * np.sqrt(1.0 - (along / rx) ** 2 - (depth / depth_mm) ** 2)
        ends = along * np.cos(t) + np.array([-reach, reach]) * np.sin(t)
        np.testing.assert_allclose(curve[[0, -1], 1], ends, atol=0.02 * reach)  # rays are sampled
        height = 0.4 * reach
        found = pair.lesion([depth, along], [depth, along * np.cos(t) + height * np.sin(t)])
        np.testing.assert_allclose(found.position, [along, height, depth], atol=0.05)


def test_tissue_that_an_image_does_not_reach_is_told_from_the_other_view() -> None:
    cc, mlo = views()
    whole = two_views(shadow(cc), shadow(mlo), PLATES, ANGLE)
    polygon = shadow(cc).polygon - [9.0, 0.0]
    cut = breast_outline(polygon[polygon[:, 0] >= 0.0])
    found = two_views(cut, shadow(mlo), PLATES, ANGLE)
    assert found.cc.hidden_mm - whole.cc.hidden_mm == pytest.approx(9.0, abs=1.5)
    position = np.array([10.0, -15.0, 40.0])
    np.testing.assert_allclose(found.cc.project(position), whole.cc.project(position) - np.array([9.0, 0.0]), atol=1.5)


def test_a_projected_point_lies_in_its_region_and_nearly_on_the_curve(pair: MammographicPair) -> None:
    found = pair.project([10.0, -15.0, 40.0])
    for place, region in zip(found.places, found.regions, strict=True):
        assert inside_polygon(region, place)
        assert 10.0 < np.ptp(region[:, 0]) < 60.0
    assert pair.epipolar_curve(found.places[0]).distance(found.places[1]) < 0.05
    with pytest.raises(InputError, match="probability"):
        pair.project([10.0, -15.0, 40.0], probability=1.0)


def test_the_curve_goes_through_the_own_projection_of_a_point(pair: MammographicPair) -> None:
    for position in interior(8):
        cc, mlo = pair.project(position).places
        assert pair.epipolar_curve(cc).distance(mlo) < 0.05
        back = pair.epipolar_curve(mlo, from_view="MLO")
        assert back.distance(cc) < 0.05
        lesion = pair.lesion(cc, mlo)
        np.testing.assert_allclose(lesion.position, position, atol=0.6)
        assert lesion.agrees and np.all((lesion.low <= position + 0.6) & (position <= lesion.high + 0.6))


def test_the_middle_of_a_symmetric_breast_stays_in_the_middle() -> None:
    turn = np.linspace(-np.pi / 2, np.pi / 2, 181)
    outline = breast_outline(np.column_stack([110.0 * np.cos(turn), 80.0 * np.sin(turn)]))
    found = mammographic_pair(outline, outline, (60.0, 60.0), 90.0, draws=20)
    curve = found.epipolar_curve([50.0, 0.0]).curve
    np.testing.assert_allclose(curve[:, 1], -curve[::-1, 1], atol=0.5)
    np.testing.assert_allclose(curve[:, 0], curve[::-1, 0], atol=0.05)


def test_the_band_covers_breasts_with_other_parameters() -> None:
    """Breasts pressed with drawn parameters and displacements; the model is built from their outlines, and knows neither."""
    sds, random = ModelUncertainty(), np.random.default_rng(7)
    held = total = 0
    for _ in range(5):
        own = [
            CompressionParameters(
                *np.clip([1.0 + sds.volume_ratio * a, 0.5 + sds.along_share * b, 0.3 + sds.bending * c], [0.8, -0.4, -0.9], 1.4)
            )
            for a, b, c in random.standard_normal((2, 3))
        ]
        cc, mlo = views(own[0], own[1])
        found = mammographic_pair(shadow(cc), shadow(mlo), PLATES, ANGLE, draws=30, seed=3)
        for position in interior(9):
            noise = sds.unresolved_mm * random.standard_normal((2, 2))
            seen = cc.project(position) + noise[0]
            if not found.outlines[0].contains(seen):
                continue
            try:
                curve = found.epipolar_curve(seen)
            except InputError:
                continue
            held += int(curve.in_band(mlo.project(position) + noise[1]))
            total += 1
    assert total > 35
    assert held / total >= 0.85  # 95 % stated; 3 binomial standard deviations below


def test_the_same_seed_gives_the_same_band(pair: MammographicPair) -> None:
    again = mammographic_pair(*pair.outlines, PLATES, ANGLE, draws=60, seed=1)
    np.testing.assert_array_equal(again.epipolar_curve([50.0, 10.0]).band, pair.epipolar_curve([50.0, 10.0]).band)


def test_where_the_curve_bends_by_more_than_the_band_is_wide_the_band_has_no_hole() -> None:
    """A quarter of a circle of 5 mm between straight lines, and a band of 20 mm to either side: what lies along a normal is in it."""
    turn, run = np.linspace(0.0, 0.5 * np.pi, 31)[:, None], np.linspace(0.0, 30.0, 31)[:, None]
    bend = 5.0 * np.hstack([np.sin(turn), 1.0 - np.cos(turn)])
    curve = np.vstack([np.hstack([run - 30.0, 0.0 * run]), bend[1:-1], bend[-1] + np.hstack([0.0 * run, run])])
    normal = np.vstack([np.tile([0.0, 1.0], (31, 1)), np.hstack([-np.sin(turn), np.cos(turn)])[1:-1], np.tile([-1.0, 0.0], (31, 1))])
    found = EpipolarCurve(curve, np.zeros((len(curve), 3)), np.vstack([curve + 20.0 * normal, (curve - 20.0 * normal)[::-1]]), 0.95)
    across = np.linspace(-19.0, 19.0, 39)[:, None, None]
    places = (0.5 * (curve[1:] + curve[:-1]) + across * 0.5 * (normal[1:] + normal[:-1])).reshape(-1, 2)
    assert found.in_band(places).all() and not found.in_band([[-10.0, -25.0], [40.0, 10.0]]).any()
    assert not inside_polygon(found.band, places).all()  # the polygon has one


def test_points_that_belong_to_no_lesion_are_told(pair: MammographicPair) -> None:
    assert not pair.lesion([30.0, 20.0], [95.0, 0.0]).agrees


def test_what_cannot_be_is_refused(pair: MammographicPair) -> None:
    cc, mlo = pair.outlines
    for plates in ((200.0, 60.0), (60.0, 200.0)):
        with pytest.raises(InputError, match="thickness_mm"):
            two_views(cc, mlo, plates, ANGLE)
    with pytest.raises(InputError, match="thickness_mm is -3"):
        two_views(cc, mlo, (-3.0, 60.0), ANGLE)
    with pytest.raises(InputError, match="angle_deg is 5"):
        two_views(cc, mlo, PLATES, 5.0)
    with pytest.raises(InputError, match=r"point_cc is .* outside of the outline of CC"):
        pair.epipolar_curve([500.0, 0.0])
    with pytest.raises(InputError, match="outside of the unloaded breast"):
        pair.project([0.0, 0.0, 500.0])
    with pytest.raises(InputError, match="from_view"):
        pair.epipolar_curve([50.0, 0.0], from_view="LM")
    turn = np.linspace(-np.pi / 2, np.pi / 2, 91)
    small = breast_outline(np.column_stack([50.0 * np.cos(turn), 40.0 * np.sin(turn)]))
    with pytest.raises(InputError, match="do not belong to one breast"):
        two_views(cc, small, PLATES, ANGLE)
    with pytest.raises(InputError, match="bending"):
        ModelUncertainty(bending=-1.0)
