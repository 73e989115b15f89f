"""The virtual scanner: markers keep volume and place, texture goes with the material, noise has the distributions of textbooks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.special import i0e, i1e

from naibu import datasets
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.core.volume import Volume
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box
from naibu.validation.scanners.ct_mr import PLASTIC_BEAD, STEEL_WASHER, MarkerKind, VirtualObject, empty_grid, scan
from naibu.validation.scanners.experiments import rescanned
from naibu.validation.scanners.imaging_artifacts import CTDevice, MRDevice
from naibu.validation.scanners.metal_artifacts import streaks
from naibu.validation.scanners.motions import FormulaMotion, MatchedMotion, MeshMotion, PosedMotion, Still
from naibu.validation.scanners.textures import Texture, layered_block

Array = np.ndarray
CLEAN_CT = CTDevice(noise=0.0, blur_mm=0.0, cupping=0.0, offset=0.0)
GEL = 1000.0


def uniform(intensity: float = GEL):
    return lambda x: np.full(len(x), intensity)


def volume_of(kind: MarkerKind) -> float:
    """Return the volume of a marker, mm3."""
    if kind.thickness_mm == 0.0:
        return np.pi / 6.0 * kind.diameter_mm**3
    return np.pi / 4.0 * (kind.diameter_mm**2 - kind.hole_mm**2) * kind.thickness_mm


def centroid(volume: Volume, background: float = GEL) -> Array:
    """Return the centre of what is brighter than the background, mm."""
    extra = volume.values.astype(float) - background
    z, y, x = np.indices(volume.shape)
    index = np.stack([x, y, z], axis=-1)
    return volume.to_physical((extra[..., None] * index).sum(axis=(0, 1, 2)) / extra.sum())


BALL = MarkerKind(3.0, intensity=3000.0)
PLACE = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@given(PLACE, st.sampled_from([(0.3, 0.3, 0.3), (0.5, 0.5, 1.0), (0.58, 0.58, 1.0)]), st.sampled_from([0.0, 0.4]))
@settings(max_examples=20, deadline=None)
def test_a_ball_keeps_its_volume_and_its_place(place: tuple[float, ...], spacing: tuple[float, ...], blur: float) -> None:
    body = VirtualObject.of(uniform(), [place], BALL)
    found = scan(body, Still(), empty_grid([-6] * 3, [6] * 3, spacing), CTDevice(0.0, blur, 0.0, 0.0), seed=0, samples=1)
    extra = found.volume.values.astype(float) - GEL
    contained = extra.sum() * np.prod(spacing) / (BALL.intensity - GEL)
    assert contained == pytest.approx(volume_of(BALL), rel=0.02)
    assert (np.abs(centroid(found.volume) - place) <= 0.02 * np.array(spacing)).all()
    np.testing.assert_allclose(found.markers.points, [place])


@pytest.mark.parametrize("height", [0.0, 0.1, 0.2, 0.25, 0.37])
def test_a_flat_washer_fills_its_share_of_every_slice(height: float) -> None:
    body = VirtualObject.of(uniform(), [[0.1, -0.2, height]], STEEL_WASHER)
    spacing = (0.25, 0.25, 0.5)
    values = scan(body, Still(), empty_grid([-4] * 3, [4] * 3, spacing), CLEAN_CT, seed=0, samples=1).volume.values.astype(float)
    found = (values - GEL).sum(axis=(1, 2)) * np.prod(spacing) / (STEEL_WASHER.intensity - GEL) / volume_of(STEEL_WASHER)
    faces = -4.25 + 0.5 * np.arange(len(found) + 1)
    half = 0.5 * STEEL_WASHER.thickness_mm
    inside = np.clip(np.minimum(faces[1:], height + half) - np.maximum(faces[:-1], height - half), 0.0, None)
    np.testing.assert_allclose(found, inside / STEEL_WASHER.thickness_mm, atol=0.02)


@given(PLACE, PLACE)
@settings(max_examples=12, deadline=None)
def test_a_washer_keeps_its_volume_and_its_place_however_it_lies(place: tuple[float, ...], turn: tuple[float, ...]) -> None:
    normal = rotation_matrix(np.array(turn)) @ [0.0, 0.0, 1.0]
    body = VirtualObject.of(uniform(), [place], STEEL_WASHER, normals=[normal])
    spacing, blur = np.array([0.25, 0.25, 0.5]), 0.5
    grid = empty_grid([-5] * 3, [5] * 3, spacing)
    found = scan(body, Still(), grid, CTDevice(0.0, blur, 0.0, 0.0), seed=0, samples=1).volume
    extra = found.values.astype(float) - GEL
    assert extra.sum() * np.prod(spacing) / (STEEL_WASHER.intensity - GEL) == pytest.approx(volume_of(STEEL_WASHER), rel=0.02)
    # a washer thinner than a slice tells its height by the point spread function alone
    assert (np.abs(centroid(found) - place) <= 0.02 * spacing).all()
    z, y, x = np.indices(extra.shape)
    at = grid.to_physical(np.stack([x, y, z], axis=-1)) - np.asarray(place)
    second = np.einsum("zyx,zyxa,zyxb->ab", extra, at, at) / extra.sum() - np.diag(spacing**2 / 12.0)
    # the axis about which it is thin, within 3 degrees
    assert abs(np.linalg.eigh(second)[1][:, 0] @ normal) > np.cos(np.radians(3.0))


def test_a_voxel_is_the_mean_of_what_lies_in_it() -> None:
    """A face that cuts voxels: their intensity is the fraction below it."""
    for level in (0.25, 0.5, 0.75):
        body = VirtualObject.of(lambda x, level=level: np.where(x[:, 2] < 3.0 - 0.5 + level, GEL, 0.0), np.zeros((0, 3)), BALL)
        found = scan(body, Still(), empty_grid([0, 0, 0], [4, 4, 6], 1.0), CLEAN_CT, seed=0, samples=4).volume.values
        np.testing.assert_array_equal(found[2], GEL)
        np.testing.assert_array_equal(found[3], level * GEL)
        np.testing.assert_array_equal(found[4], 0)


def test_the_point_spread_function_is_a_gaussian() -> None:
    body = VirtualObject.of(lambda x: np.where(x[:, 0] < 0.0, 0.0, 1e4), np.zeros((0, 3)), BALL)
    grid = empty_grid([-6, -6, -6], [6, 6, 6], 0.25)
    edge = scan(body, Still(), grid, CTDevice(0.0, (0.8, 0.0, 0.0), 0.0, 0.0), seed=0).volume.values[24, 24].astype(float)
    slope = np.gradient(edge, 0.25)
    x = -6.0 + 0.25 * np.arange(len(edge))
    assert (slope * x).sum() / slope.sum() == pytest.approx(0.0, abs=0.01)
    # those of a voxel and of the central difference, two voxels wide, add to the Gaussian's variance; it is cut off at three deviations
    expected = np.sqrt(0.8**2 * 0.973 + 0.25**2 / 12.0 + 0.5**2 / 12.0)
    assert np.sqrt((slope * x**2).sum() / slope.sum()) == pytest.approx(expected, rel=0.01)


def test_rigid_motions_carry_markers_texture_and_outline() -> None:
    """A body in another pose is the same when the grid is moved along."""
    block = layered_block((20.0, 16.0, 12.0), texture=100.0, seed=4)
    body = VirtualObject.of(block, [[3.0, 2.0, 5.0], [-4.0, -3.0, 7.0]], BALL)
    grid = empty_grid([-12, -10, -2], [12, 10, 14], 1.0)
    pose = RigidTransform(rotation_matrix(np.array([0.1, -0.2, 0.7])), np.zeros(3), np.array([30.0, -12.0, 5.0]))
    along = Volume.from_array(
        grid.values, spacing_mm=grid.spacing_mm, origin_mm=pose.applied(grid.origin_mm[None])[0], direction=pose.rotation
    )
    first = scan(body, Still(), grid, CLEAN_CT, seed=0)
    second = scan(body, PosedMotion(Still(), pose), along, CLEAN_CT, seed=0)
    difference = np.abs(first.volume.values.astype(float) - second.volume.values)
    # samples on the very edge of the block or of a marker may fall on either side
    assert np.percentile(difference, 99.5) <= 1.0
    np.testing.assert_allclose(second.markers.points, pose.applied(first.markers.points), atol=1e-12)


@pytest.fixture(scope="module")
def pressed() -> MeshMotion:
    """A block of gel, pressed and sheared between two plates that hold it: solved."""
    mesh = box((24.0, 20.0, 16.0), (5, 4, 4))
    height = mesh.points[:, 2]
    support = PrescribedDisplacement.none(mesh.n_points).and_also(np.flatnonzero(height < 1e-9), np.zeros(3))
    support = support.and_also(np.flatnonzero(height > 16.0 - 1e-9), [2.0, 0.0, -3.0])
    body = Assembler.from_materials(elements(mesh), mesh.regions, [material(young_modulus=30.0, poisson_ratio=0.45)])
    solution = solve(Problem(mesh.points, body, (), support, np.zeros(mesh.points.shape)))
    return MeshMotion(mesh, solution.displacement)


def test_a_solved_model_moves_there_and_back(pressed: MeshMotion) -> None:
    rng = np.random.default_rng(0)
    inside = rng.uniform([-11, -9, 0.5], [11, 9, 15.5], (400, 3))
    positions = pressed.to_space(inside)
    assert np.linalg.norm(positions - inside, axis=1).max() > 2.0
    np.testing.assert_allclose(pressed.to_material(positions), inside, atol=1e-8)
    # nodes go where the model says
    np.testing.assert_allclose(pressed.to_space(pressed.mesh.points), pressed.mesh.points + pressed.displacement, atol=1e-9)
    # the plate has left its place: there is no material where it pressed
    assert np.isnan(pressed.to_material(np.array([[0.0, 0.0, 15.5], [40.0, 0.0, 5.0]]))).all()


def test_a_solved_model_carries_markers_and_texture(pressed: MeshMotion) -> None:
    """Markers lie where the model says, and texture read where the model carries a point is that of the point."""
    block = layered_block((24.0, 20.0, 16.0), ((GEL, np.inf),), texture=100.0, seed=1)
    positions = np.array([[6.0, 4.0, 12.0], [-6.0, -3.0, 5.0], [0.0, 0.0, 8.0]])
    body = VirtualObject.of(uniform(), positions, BALL)
    grid = empty_grid([-16.25, -13.25, -2.25], [16, 13, 18], 0.5)
    found = scan(body, pressed, grid, CLEAN_CT, seed=0, samples=1)
    np.testing.assert_allclose(found.markers.points, pressed.to_space(positions), atol=1e-12)
    for i, truth in enumerate(found.markers.points):
        low = np.floor(grid.to_index(truth)).astype(int) - 4
        assert (np.abs(centroid(found.volume.cropped(low, low + 10)) - truth) < 0.02 * 0.5).all(), i
    bare = VirtualObject.of(block, np.zeros((0, 3)), BALL)
    textured = scan(bare, pressed, grid, CLEAN_CT, seed=0, samples=1).volume
    k, j, i = 12, 26, 32
    material_point = pressed.to_material(grid.to_physical([[i, j, k]]))
    assert textured.values[k, j, i] == pytest.approx(block(material_point)[0], abs=0.5)
    # volume: the gel keeps its volume to what a Poisson ratio of .45 leaves
    fraction = (textured.values > 500).sum() * 0.125 / (24 * 20 * 16)
    assert fraction == pytest.approx(_volume(pressed), rel=0.01)


def _volume(motion: MeshMotion) -> float:
    """Return the volume ratio of a moved mesh, from its cells' six tetrahedra."""
    tetra = to_tetra(motion.mesh)
    ratio = []
    for points in (motion.mesh.points + motion.displacement, motion.mesh.points):
        x = points[tetra.cells]
        ratio.append(np.linalg.det(x[:, 1:] - x[:, :1]).sum())
    return float(ratio[0] / ratio[1])


def test_formulas_are_inverted_and_folds_are_told() -> None:
    rng = np.random.default_rng(2)
    bend = FormulaMotion(lambda x: x + 0.5 * np.sin(x[:, [1, 2, 0]] / 2.0))
    points = rng.uniform(-10, 10, (300, 3))
    np.testing.assert_allclose(bend.to_material(bend.to_space(points)), points, atol=1e-6)
    known = FormulaMotion(lambda x: 2.0 * x, lambda x: 0.5 * x)
    np.testing.assert_allclose(known.to_material(points), 0.5 * points)
    with pytest.raises(ConvergenceError, match="cannot be inverted"):
        FormulaMotion(lambda x: x**2 + 1.0).to_material(np.full((2, 3), -5.0))


def test_gaussian_noise_is_as_asked() -> None:
    body = VirtualObject.of(uniform(), np.zeros((0, 3)), BALL)
    grid = empty_grid([0, 0, 0], [60, 60, 40], 1.0)
    white = CTDevice(noise=30.0, blur_mm=0.0, cupping=0.0, offset=0.0, correlation=0.0)
    values = scan(body, Still(), grid, white, seed=3, samples=1).volume.values.astype(float)
    n = values.size
    # rounding adds a twelfth to the variance; bounds are five standard errors
    assert values.mean() == pytest.approx(GEL, abs=5 * 30.0 / np.sqrt(n))
    variance = 30.0**2 + 1.0 / 12.0
    assert values.var() == pytest.approx(variance, abs=5 * variance * np.sqrt(2.0 / n))
    z = (values - GEL) / np.sqrt(variance)
    assert (z**3).mean() == pytest.approx(0.0, abs=5 * np.sqrt(6.0 / n))
    assert (z**4).mean() == pytest.approx(3.0, abs=5 * np.sqrt(24.0 / n))
    grain = scan(body, Still(), grid, CTDevice(30.0, 0.0, 0.0, 0.0, correlation=0.8), seed=3, samples=1).volume.values - GEL
    assert grain.std() == pytest.approx(30.0, rel=0.01)
    neighbour = lambda axis: (np.delete(grain, 0, axis) * np.delete(grain, -1, axis)).mean() / grain.var()  # noqa: E731
    assert neighbour(2) > 0.3 and neighbour(1) > 0.3 and abs(neighbour(0)) < 0.02


@pytest.mark.parametrize("signal", [0.0, 15.0, 40.0, 400.0])
def test_magnitudes_have_the_distribution_of_rice(signal: float) -> None:
    body = VirtualObject.of(uniform(signal), np.zeros((0, 3)), BALL)
    sigma = 20.0
    device = MRDevice(noise=sigma, blur_mm=0.0, shading=0.0)
    values = scan(body, Still(), empty_grid([0, 0, 0], [50, 50, 50], 1.0), device, seed=1, samples=1).volume.values.astype(float)
    # mean sigma sqrt(pi / 2) L_1/2(-q), L_1/2(-q) = exp(-q/2) ((1 + q) I0(q/2) + q I1(q/2)), q = signal^2 / (2 sigma^2)
    q = signal**2 / (2.0 * sigma**2)
    mean = sigma * np.sqrt(np.pi / 2.0) * ((1.0 + q) * i0e(0.5 * q) + q * i1e(0.5 * q))
    variance = 2.0 * sigma**2 + signal**2 - mean**2
    assert values.mean() == pytest.approx(mean, abs=5 * np.sqrt(variance / values.size))
    assert values.var() == pytest.approx(variance + 1.0 / 12.0, rel=5 * np.sqrt(3.0 / values.size))


def test_seeds_repeat_and_differ() -> None:
    body = VirtualObject.of(uniform(), [[4.0, 4.0, 4.0]], PLASTIC_BEAD)
    grid = empty_grid([0, 0, 0], [8, 8, 8], 1.0)
    one, same, other = (scan(body, Still(), grid, CTDevice(), seed=s).volume.values for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.9


def test_the_streaks_of_a_disc_are_those_of_abels_integral() -> None:
    """-loss p^2 with p = 2 sqrt(r^2 - s^2) comes from a density -loss (8 / pi) sqrt(r^2 - s^2) in the disc and none outside."""
    n, radius, loss = 81, 5.0, 0.1
    y, x = np.indices((n, n)) - 0.5 * (n - 1)
    step = 0.25
    s = step * np.hypot(x, y)
    sub = (np.arange(8) + 0.5) / 8 - 0.5
    fraction = np.mean([step * np.hypot(x + a, y + b) <= radius for a in sub for b in sub], axis=0, dtype=np.float32)
    found = streaks(fraction[None], np.array([step, step, 1.0]), loss)[0]
    expected = -loss * 8.0 / np.pi * np.sqrt(np.maximum(radius**2 - s**2, 0.0))
    inside, outside = s < 0.9 * radius, (s > 1.1 * radius) & (s < 9.0)
    assert np.abs(found - expected)[inside].max() < 0.04 * np.abs(expected).max()
    assert np.abs(found[outside]).max() < 0.04 * np.abs(expected).max()


def test_streaks_join_markers_and_only_markers() -> None:
    grid = empty_grid([-15, -15, 0], [15, 15, 4], 0.5)
    pair = VirtualObject.of(uniform(), [[-6.0, 0.0, 2.0], [6.0, 0.0, 2.0]], MarkerKind(3.0, intensity=3600.0))
    plain, hardened = (
        scan(pair, Still(), grid, CTDevice(0.0, 0.0, 0.0, 0.0, streaks_per_mm=s), seed=0, samples=1).volume.values.astype(float)
        for s in (0.0, 0.1)
    )
    error = hardened - plain
    k, middle = 4, 30
    between, aside = error[k, middle, middle - 6 : middle + 7].mean(), error[k, middle + 16, middle - 6 : middle + 7].mean()
    assert between < -10.0 and between < 3.0 * min(aside, 0.0)
    assert (error[0] == 0).all()  # no marker in this slice
    bare = VirtualObject.of(uniform(), np.zeros((0, 3)), STEEL_WASHER)
    none = scan(bare, Still(), grid, CTDevice(0.0, 0.0, 0.0, 0.0, streaks_per_mm=0.1), seed=0, samples=1).volume.values
    np.testing.assert_array_equal(none, GEL)


def test_textures_have_unit_spread_and_repeat() -> None:
    texture = Texture.drawn((2.0, 3.0, 4.0), seed=5)
    points = np.random.default_rng(0).uniform(0, 128, (40_000, 3))
    values = texture(points)
    assert values.mean() == pytest.approx(0.0, abs=0.05) and values.std() == pytest.approx(1.0, rel=0.03)
    np.testing.assert_allclose(texture(points + 32 * texture.cell_mm), values, atol=1e-6)


def test_layers_and_bubbles_are_where_they_are_said_to_be() -> None:
    intensity = layered_block((10.0, 8.0, 6.0), ((500.0, 2.0), (900.0, np.inf)), texture=0.0, bubbles=[((0.0, 0.0, 4.0), 1.0)])
    points = np.array([[0, 0, 1], [4.9, 3.9, 5.9], [0, 0, 4.5], [0, 0, 6.1], [5.1, 0, 1], [0, 0, -0.1]], dtype=float)
    np.testing.assert_array_equal(intensity(points), [500.0, 900.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("name", ["ct_test_piece", "ct_two_material_1"])
def test_measured_states_are_scanned_anew(name: str) -> None:
    """Every trusted, complete marker of the report's measurements is a washer at its measured place, and texture goes with the gel."""
    experiment = datasets.load(name)
    spacing = np.array([1.0, 1.0, 1.0])
    scans = rescanned(experiment, spacing_mm=spacing, kind=MarkerKind(3.0, intensity=3600.0), device=CLEAN_CT)
    measured = [s for s in experiment.states if s.markers is not None]
    assert set(scans) == {s.name for s in measured}
    for state in measured:
        found, markers = scans[state.name], state.markers
        good = markers.trusted & np.isfinite(markers.points).all(axis=1)
        np.testing.assert_array_equal(found.markers.ids, markers.ids[good])
        np.testing.assert_array_equal(found.markers.points, markers.points[good])
        distance = cKDTree(found.markers.points).query(found.markers.points, k=2)[0][:, 1]
        for point in found.markers.points[distance > 6.0][::17]:
            low = np.round(found.volume.to_index(point)).astype(int) - 3
            part = found.volume.cropped(low, low + 7)
            background = float(np.median(part.values))
            at = centroid(part.with_values(np.where(part.values > background + 150.0, part.values.astype(float), background)), background)
            assert np.linalg.norm(at - point) < 0.15


def test_matched_motions_meet_their_markers() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 30, (40, 3))
    b = a + 0.1 * a[:, [1, 2, 0]] + rng.standard_normal((40, 3))
    motion = MatchedMotion(a, b)
    np.testing.assert_allclose(motion.to_space(a), b, atol=1e-6)
    np.testing.assert_allclose(motion.to_material(b), a, atol=1e-6)


def test_lost_markers_are_not_scanned() -> None:
    body = VirtualObject.of(uniform(), [[2.0, 4, 4], [6.0, 4, 4], [40.0, 4, 4]], MarkerKind(2.0))
    found = scan(body.without([2]), Still(), empty_grid([0, 0, 0], [8, 8, 8], 1.0), CLEAN_CT, seed=0)
    np.testing.assert_array_equal(found.markers.ids, [1])
    assert found.volume.values[4, 4, 2] > 2 * GEL and found.volume.values[4, 4, 6] == GEL


def test_nonsense_is_refused() -> None:
    grid = empty_grid([0, 0, 0], [4, 4, 4], 1.0)
    body = VirtualObject.of(uniform(), [[1.0, 1, 1]], BALL)
    for work, message in (
        (lambda: MarkerKind(0.0), "positive diameter"),
        (lambda: MarkerKind(2.0, 0.3, 2.5), "larger than its hole"),
        (lambda: VirtualObject.of(uniform(), [[np.nan, 0, 0]], BALL), "finite positions"),
        (lambda: VirtualObject.of(uniform(), [[0.0, 0, 0]], BALL, normals=[[0.0, 0, 0]]), "length zero"),
        (lambda: scan(body, Still(), grid, CLEAN_CT, seed=0, samples=0), "at least one sample"),
        (lambda: empty_grid([0, 0, 0], [1, 1, -1], 1.0), "low < high"),
        (lambda: CTDevice(noise=-1.0), "noise of a CTDevice"),
        (lambda: MRDevice(blur_mm=(1.0, 2.0)), "blur_mm of a MRDevice"),  # type: ignore[arg-type]
        (lambda: MeshMotion(box((1, 1, 1), (1, 1, 1)), np.zeros((3, 3))), "shape"),
        (lambda: MatchedMotion(np.zeros((3, 3)), np.zeros((3, 3))), "at least 5"),
        (lambda: streaks(np.ones((1, 3, 3), dtype=np.float32), np.ones(3), 0.1, views=1), "views"),
        (lambda: rescanned(datasets.load("us_agar")), "complete markers"),
    ):
        with pytest.raises(InputError, match=message):
            work()
