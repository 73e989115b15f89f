"""Residuals, gradients and Gauss-Newton matrices of volume correlation against finite differences of its objective."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scenes import texture
from scipy.spatial.transform import Rotation

from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.intensity_comparison import ComparisonSettings, IntensityComparison
from naibu.imaging.volume_correlation.rigid_parts.rigid_inclusions import InclusionMotion, RigidInclusion
from naibu.imaging.volume_correlation.splines._spline_kernels import product
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid, separable

Array = np.ndarray
SPACING = np.array([1.0, 1.2, 1.5])
SHAPE = (20, 24, 28)
RATIO = 0.9
STEP = 1e-4  # of finite differences in double precision, mm
SINGLE_STEP = 0.005  # of those of images in single precision, mm


def affine() -> tuple[Array, Array]:
    """Return matrix and shift, mm, of the motion between the images."""
    return np.eye(3) + np.array([[0.04, 0.06, 0.0], [-0.05, -0.06, 0.03], [0.02, 0.0, 0.03]]), np.array([0.4, -0.3, 0.5])


def level(gain: float = 1.3, noise: float = 0.5) -> ImageLevel:
    """Return images of a texture that moves by `affine`, the deformed one less bright."""
    grid = Volume.from_array(np.zeros(SHAPE), spacing_mm=SPACING)
    x, pattern, rng = grid.positions(), texture(3, (8.0, 16.0)), np.random.default_rng(4)
    matrix, shift = affine()
    reference = pattern(x) + noise * rng.standard_normal(SHAPE)
    deformed = (pattern((x - shift) @ np.linalg.inv(matrix).T) + noise * rng.standard_normal(SHAPE) - 7.0) / gain
    mask = np.zeros(SHAPE, dtype=bool)
    mask[4:-4, 4:-4, 4:-4] = True
    return ImageLevel(reference.astype(np.float32), deformed.astype(np.float32), mask, SPACING, (1, 1, 1), 0.0)


@dataclass
class Fit:
    """A small system, coefficients about which it is linearised, and directions in them."""

    level: ImageLevel
    system: SplineSystem
    c: Array
    directions: list[Array]

    def along(self, direction: Array, step: float) -> Array:
        c = self.c.copy()
        c[self.system.active] += step * direction
        return c

    def times(self, direction: Array) -> Array:
        """Multiply a direction by the assembled matrix."""
        x, y = np.zeros((self.system.n + 1, 3), np.float32), np.empty((self.system.n, 3), np.float32)
        x[:-1] = direction
        product(self.system.matrix, self.system.neighbours, x, y)
        return y.astype(float)


def fit() -> Fit:
    images, rng = level(), np.random.default_rng(0)
    grid = SplineGrid.around(3.0 * SPACING, SPACING * [23.0, 19.0, 15.0], [5.0, 6.0, 5.5])
    system = SplineSystem(images, grid, RATIO)
    matrix, shift = affine()
    c = grid.nodes_mm @ (matrix - np.eye(3)).T + shift + 0.2 * rng.standard_normal((*grid.shape, 3))
    return Fit(images, system, c, [rng.standard_normal((system.n, 3)) for _ in range(3)])


def at_quadrature(system: SplineSystem, c: Array, orders: tuple[int, int, int], points: Array) -> Array:
    """Return derivatives of the field (cells z, y, x, points z, y, x, component) at points of all cells, from one-dimensional splines."""
    grid = system.grid
    matrices = []
    for axis in range(3):
        at = grid.origin_mm[axis] + grid.step_mm[axis] * (np.arange(grid.cells[axis])[:, None] + points).ravel()
        matrices.append(grid.matrix(axis, at, orders[axis]))
    values = separable(matrices, c)
    nx, ny, nz = (int(n) for n in grid.cells)
    k = len(points)
    return values.reshape(nz, k, ny, k, nx, k, 3).transpose(0, 2, 4, 1, 3, 5, 6)


def bending_energy(system: SplineSystem, c: Array, weights: Array) -> float:
    """Return half the weighted integral of all squared second derivatives, by Gauss quadrature that is exact."""
    x, w = np.polynomial.legendre.leggauss(5)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    total = np.zeros((*(int(n) for n in system.grid.cells[::-1]), 3))
    for i in range(3):
        for j in range(3):
            orders = tuple(int(i == a) + int(j == a) for a in range(3))
            second = at_quadrature(system, c, orders, x)  # type: ignore[arg-type]
            total += np.einsum("zyxabcd,a,b,c->zyxd", second**2, w, w, w) * np.prod(system.grid.step_mm)
    return 0.5 * float((weights * total[tuple(system.cells[:, 2:].T)]).sum())


def volume_ratios(system: SplineSystem, c: Array) -> Array:
    """Return det(I + grad u) (m, 8) at the two-point Gauss points of the cells."""
    x = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    gradient = np.stack([at_quadrature(system, c, o, x) for o in ((1, 0, 0), (0, 1, 0), (0, 0, 1))], axis=-1)
    determinant = np.linalg.det(np.eye(3) + gradient)
    return determinant[tuple(system.cells[:, 2:].T)].reshape(len(system.cells), 8)


def no_data(system: SplineSystem) -> tuple[Array, Array]:
    n = len(system.level.intensity)
    return np.zeros((n, 6), np.float32), np.zeros((n, 3), np.float32)


def test_bending_force_and_stiffness_are_derivatives_of_its_energy() -> None:
    f, rng = fit(), np.random.default_rng(1)
    weights = rng.uniform(0.5, 2.0, (len(f.system.cells), 3))
    load = f.system.assembled(f.c, *no_data(f.system), weights, np.zeros(len(f.system.cells)))
    assert np.allclose(f.system.bending_load(f.c, weights), load, atol=1e-4 * np.abs(load).max())
    energies = [bending_energy(f.system, f.along(f.directions[0], s), weights) for s in (-STEP, STEP)]
    assert -(load * f.directions[0]).sum() == pytest.approx((energies[1] - energies[0]) / (2 * STEP), rel=1e-4)
    assert 0.5 * float((f.system.bending_energy * weights).sum()) == pytest.approx(bending_energy(f.system, f.c, weights), rel=1e-5)
    # the energy is quadratic: its second difference is exact for any step
    for v in f.directions:
        second = sum(bending_energy(f.system, f.along(v, s), weights) for s in (-1.0, 1.0)) - 2.0 * bending_energy(f.system, f.c, weights)
        assert (v * f.times(v)).sum() == pytest.approx(second, rel=1e-5)


def test_dilatation_force_and_gauss_newton_matrix_are_derivatives_of_the_volume_ratio() -> None:
    f, rng = fit(), np.random.default_rng(1)
    weights = rng.uniform(0.5, 2.0, len(f.system.cells))
    load = f.system.assembled(f.c, *no_data(f.system), np.zeros((len(weights), 3)), weights)
    assert np.allclose(f.system.dilatation_load(f.c, weights), load, atol=1e-4 * np.abs(load).max())
    ratio = volume_ratios(f.system, f.c)
    assert np.ptp(ratio) > 0.1
    slopes = [(volume_ratios(f.system, f.along(v, STEP)) - volume_ratios(f.system, f.along(v, -STEP))) / (2 * STEP) for v in f.directions]
    for v, along_v in zip(f.directions, slopes, strict=True):
        assert -(load * v).sum() == pytest.approx((weights[:, None] * (ratio - RATIO) * along_v).sum(), rel=1e-4)
        for u, along_u in zip(f.directions, slopes, strict=True):
            expected = (weights[:, None] * along_u * along_v).sum()
            assert (u * f.times(v)).sum() == pytest.approx(expected, rel=1e-4, abs=1e-4 * (weights[:, None] * along_v**2).sum())
    np.testing.assert_allclose(f.system.dilatation_energy, ((ratio - RATIO) ** 2).sum(axis=1), rtol=1e-4, atol=1e-6)


def residuals(f: Fit, comparison: IntensityComparison, c: Array) -> Array:
    """Return residuals in double precision at coefficients c, with the present gain and offset."""
    n = len(f.level.intensity)
    value = np.empty(n, np.float32)
    f.system.warped(c, value, *(np.empty((n, 3), np.float32) for _ in range(3)))
    assert (value > -1e29).all()
    return f.level.intensity.astype(float) - comparison.gain.astype(float) * value.astype(float) - comparison.offset.astype(float)


@pytest.mark.parametrize("robust", [np.inf, 2.0])
def test_data_force_and_gauss_newton_matrix_are_derivatives_of_the_robust_misfit(robust: float) -> None:
    f = fit()
    comparison = CorrelationFit(f.level, f.system, ComparisonSettings(robust, 0.0, 0.0, 0.0))
    comparison.compare(f.c)
    zero = np.zeros(len(f.system.cells))
    load = f.system.assembled(f.c, comparison.products, comparison.force, np.zeros((len(zero), 3)), zero)
    assert comparison.gain[0] == pytest.approx(1.3, abs=0.1)

    def misfit(c: Array) -> float:
        """Geman-McClure function of the residuals."""
        square = (residuals(f, comparison, c) / comparison.residual_sd) ** 2
        return 0.5 * float((square / (1.0 + square / robust**2)).sum())

    for v in f.directions:
        numeric = (misfit(f.along(v, SINGLE_STEP)) - misfit(f.along(v, -SINGLE_STEP))) / (2 * SINGLE_STEP)
        assert -(load * v).sum() == pytest.approx(numeric, rel=5e-3)
        along = (residuals(f, comparison, f.along(v, SINGLE_STEP)) - residuals(f, comparison, f.along(v, -SINGLE_STEP))) / (2 * SINGLE_STEP)
        assert (v * f.times(v)).sum() == pytest.approx((comparison.weight * along**2).sum(), rel=5e-3)


def test_gradients_of_the_reference_are_pushed_forward() -> None:
    # where the images agree, f(x) = a g(x + u) + b, the gradient of f is F^T grad g
    images = level(noise=0.0)
    grid = fit().system.grid
    system = SplineSystem(images, grid)
    matrix, shift = affine()
    comparison = CorrelationFit(images, system, ComparisonSettings(np.inf, 0.0, 0.0, 0.0))
    comparison.compare(grid.nodes_mm @ (matrix - np.eye(3)).T + shift)
    deformed = comparison.gradient
    off = np.linalg.norm(comparison.reference_gradient - deformed) / np.linalg.norm(deformed)
    assert off < 0.03
    unmoved = np.linalg.norm(images.gradient - deformed) / np.linalg.norm(deformed)
    assert unmoved > 2.0 * off


def test_anchors_are_springs_to_the_first_displacement() -> None:
    f = fit()
    comparison = CorrelationFit(f.level, f.system, ComparisonSettings(np.inf, 0.0, 0.0, 0.0))
    comparison.compare(f.c)
    before, diagonal = comparison.force.copy(), comparison.products[:, 0].copy()
    first = comparison.displacement + np.random.default_rng(2).standard_normal(comparison.displacement.shape).astype(np.float32)
    comparison.anchor(first, 0.1)
    stiffness = comparison.products[:, 0] - diagonal
    np.testing.assert_allclose(stiffness, stiffness.mean(), rtol=1e-2)
    np.testing.assert_allclose(comparison.force - before, stiffness.mean() * (first - comparison.displacement), rtol=1e-2, atol=1e-2)


def inclusion(gain: float = 1.3, noise: float = 0.0) -> tuple[RigidInclusion, IntensityComparison]:
    """Return an inclusion at its true motion, and the comparison that holds the gain."""
    rng = np.random.default_rng(7)
    grid = Volume.from_array(np.zeros(SHAPE), spacing_mm=SPACING)
    x, pattern = grid.positions(), texture(5, (8.0, 16.0))
    turn, shift = Rotation.from_rotvec([0.05, -0.08, 0.1]).as_matrix(), np.array([0.4, -0.3, 0.5])
    middle = 0.5 * (np.array(SHAPE[::-1]) - 1) * SPACING
    deformed = (pattern((x - middle - shift) @ turn + middle) - 7.0) / gain
    mask = np.zeros(SHAPE, dtype=bool)
    mask[6:-6, 6:-6, 6:-6] = True
    before, after = ((v + noise * rng.standard_normal(SHAPE)).astype(np.float32) for v in (pattern(x), deformed))
    images = ImageLevel(before, after, mask, SPACING, (1, 1, 1), 0.0)
    comparison = IntensityComparison(images, ComparisonSettings(np.inf, 0.0, 0.0, 0.0))
    comparison.gain[:], comparison.offset[:], comparison.residual_sd = gain, 7.0, 1.0
    found = RigidInclusion(1, np.arange(0, len(images.intensity), 3), images)
    found.start(((found.points - middle) @ (turn - np.eye(3)).T + shift).astype(np.float32))
    return found, comparison


def test_rigid_inclusions_have_the_derivatives_of_their_residuals() -> None:
    found, comparison = inclusion()
    rotation, shift = found.rotation, found.shift
    r, derivatives, _, _ = found.linearised(comparison)
    assert np.sqrt(np.mean(r**2)) < 0.02 * np.ptp(comparison.level.intensity)
    steps = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02])
    for k, step in enumerate(steps):
        ends = []
        for sign in (-1.0, 1.0):
            d = sign * step * np.eye(6)[k]
            found.rotation, found.shift = Rotation.from_rotvec(d[:3]).as_matrix() @ rotation, shift + d[3:]
            ends.append(found.linearised(comparison)[0])
        numeric = (ends[1] - ends[0]) / (2 * step)
        # one of the two gradients that are averaged is that of the reference, which differs by interpolation
        assert np.linalg.norm(numeric + derivatives[:, k]) < 0.03 * np.linalg.norm(numeric)


def test_rigid_inclusions_come_back_to_their_motion() -> None:
    found, comparison = inclusion()
    rotation, shift = found.rotation, found.shift
    found.rotation, found.shift = Rotation.from_rotvec([0.03, 0.02, -0.03]).as_matrix() @ rotation, shift + np.array([0.3, -0.2, 0.3])
    found.fit(comparison)
    assert np.abs(found.shift - shift).max() < 0.01
    assert np.abs(found.rotation - rotation).max() < 1e-3


def test_noise_in_the_gradients_of_an_inclusion_is_no_information() -> None:
    """Both counts are those of the same texture: one holds the noise of the gradients, too."""
    shift = slice(3, None)
    matrices = []
    for noise in (0.0, 10.0):
        found, comparison = inclusion(noise=noise)
        comparison.residual_sd = 30.0
        found.fit(comparison)
        matrices.append((found.normal[shift, shift], found.information[shift, shift]))
    assert np.allclose(matrices[0][1], matrices[0][0], rtol=0.03, atol=0.03 * np.trace(matrices[0][0]))
    truth = np.trace(matrices[0][0])
    assert np.trace(matrices[1][0]) > 1.5 * truth
    assert np.trace(matrices[1][1]) == pytest.approx(truth, rel=0.1)


def test_inclusions_pull_the_field_to_their_motion() -> None:
    found, comparison = inclusion()
    comparison.displacement[:] = np.random.default_rng(0).standard_normal(comparison.displacement.shape)
    found.follow(comparison)
    at = found.voxels
    wanted = found.moved - found.points

    def energy(u: Array) -> float:
        return 0.5 * found.weight * float(((wanted - u) ** 2).sum())

    u, v = comparison.displacement[at].astype(float), np.random.default_rng(1).standard_normal((len(at), 3))
    assert (comparison.force[at] * v).sum() == pytest.approx(-(energy(u + STEP * v) - energy(u - STEP * v)) / (2 * STEP), rel=1e-4)
    second = energy(u + v) + energy(u - v) - 2.0 * energy(u)
    stiffness = comparison.products[at][:, [0, 3, 5]]
    assert (stiffness * v**2).sum() == pytest.approx(second, rel=1e-5)
    assert not comparison.products[at][:, [1, 2, 4]].any()


def test_the_covariance_of_an_inclusion_is_that_of_its_motion_to_first_order() -> None:
    rng = np.random.default_rng(0)
    transform = RigidTransform(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, 5.0]))
    points, root = rng.uniform(-5.0, 5.0, (20, 3)), rng.standard_normal((6, 6))
    found = InclusionMotion(1, transform, root @ root.T).displacement_covariance(points)
    derivatives = np.empty((20, 3, 6))
    for k in range(6):
        ends = []
        for sign in (-1.0, 1.0):
            d = sign * 1e-6 * np.eye(6)[k]
            moved = RigidTransform(
                Rotation.from_rotvec(d[:3]).as_matrix() @ transform.rotation, transform.centre, transform.position + d[3:]
            )
            ends.append(moved.displacement(points))
        derivatives[:, :, k] = (ends[1] - ends[0]) / 2e-6
    np.testing.assert_allclose(found, derivatives @ (root @ root.T) @ np.swapaxes(derivatives, 1, 2), rtol=1e-6, atol=1e-6)


def test_spline_tables_hold_derivatives() -> None:
    grid = SplineGrid.around([0.0, 0.0, 0.0], [9.0, 12.0, 6.0], [3.0, 4.0, 2.0])
    rng = np.random.default_rng(0)
    for axis in range(3):
        at = rng.uniform(0.01, 0.99, 40) * grid.step_mm[axis] * grid.cells[axis]
        for order in (0, 1):
            numeric = (grid.matrix(axis, at + STEP, order) - grid.matrix(axis, at - STEP, order)) / (2 * STEP)
            np.testing.assert_allclose(grid.matrix(axis, at, order + 1), numeric, atol=1e-4)


def test_forces_on_no_voxel_load_nothing() -> None:
    images = level()
    system = SplineSystem(images, SplineGrid.around(np.zeros(3), np.array(SHAPE[::-1]) * SPACING, np.full(3, 8.0)))
    # a block at the rim of an object can hold so few voxels that none of them is drawn
    number = np.full(images.mask.shape, -1, np.int32)
    assert not system.force_loads(np.zeros((0, 3, 4), np.float32), number).any()
