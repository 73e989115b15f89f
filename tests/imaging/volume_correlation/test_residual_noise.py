"""Random residuals and what is drawn from them: autocorrelation by Wiener and Khinchin, loads of splines, growth with gradients."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.intensity_comparison import JITTER, ComparisonSettings, IntensityComparison
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise, amplitude_of, coloured, lagged_products, lost_to_robustness
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid

Array = np.ndarray
SPACING = np.array([0.8, 1.0, 1.3])


def level(shape: tuple[int, int, int], margin: int = 2) -> ImageLevel:
    """Return a level of noise, whose object is all but the rim."""
    mask = np.zeros(shape, dtype=bool)
    mask[(slice(margin, -margin),) * 3] = True
    mask[shape[0] // 2, shape[1] // 2] = False  # the object has a hole
    images = np.random.default_rng(0).standard_normal((2, *shape)).astype(np.float32)
    return ImageLevel(images[0], images[1], mask, SPACING, (1, 1, 1), 0.0)


@pytest.mark.parametrize("shape", [(6, 5, 8), (5, 6, 7)])
def test_coloured_noise_has_the_autocovariance_of_its_spectrum(shape: tuple[int, int, int]) -> None:
    """Wiener-Khinchin: the periodic autocovariance is the Fourier transform of the squared amplitudes, for even and odd sizes."""
    lags = np.meshgrid(*(np.minimum(np.arange(n), n - np.arange(n)) for n in shape), indexing="ij")
    wanted = 2.5 * np.exp(-0.5 * (lags[0] ** 2 / 1.5 + lags[1] ** 2 / 0.8 + lags[2] ** 2 / 2.0))
    spectrum = np.fft.rfftn(wanted).real
    amplitude, rng, n = np.sqrt(np.maximum(spectrum, 0.0)).astype(np.float32), np.random.default_rng(1), int(np.prod(shape))
    draws = np.stack([coloured(amplitude, shape, rng).ravel() for _ in range(6000)]).astype(float)
    covariance = draws.T @ draws / len(draws)
    z, y, x = (np.abs(i[:, None] - i) for i in np.unravel_index(np.arange(n), shape))
    expected = np.fft.irfftn(np.maximum(spectrum, 0.0), shape, axes=(0, 1, 2))[z, y, x]
    # the standard deviation of a sample covariance of normal variables
    sd = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / len(draws))
    assert np.abs((covariance - expected) / sd).max() < 6.0
    assert np.sqrt(np.mean(((covariance - expected) / sd) ** 2)) == pytest.approx(1.0, abs=0.15)
    assert np.abs(draws.mean(axis=0)).max() < 6.0 * np.sqrt(2.5 / len(draws))


def test_residuals_are_drawn_as_correlated_as_they_are() -> None:
    """Sums of two neighbours along x have a correlation of one half at a distance of one, and none further."""
    shape, rng = (40, 44, 48), np.random.default_rng(2)
    white = rng.standard_normal((*shape[:2], shape[2] + 1))
    field = 3.0 * (white[..., 1:] + white[..., :-1]) / np.sqrt(2.0)
    mask = np.ones(shape, dtype=bool)
    mask[:, :20, :20] = False
    noise = ResidualNoise(mask, field[mask].astype(np.float32), scale=1.4)
    box, drawn = np.zeros(shape), []
    for _ in range(6):
        box[mask] = noise.draw(rng)
        inner = box[:, 20:]
        drawn.append([np.mean(inner[..., : shape[2] - lag] * inner[..., lag:]) for lag in (0, 1, 2)] + [np.mean(inner[1:] * inner[:-1])])
    variance, along, further, across = np.mean(drawn, axis=0)
    assert variance == pytest.approx(1.4**2 * 9.0, rel=0.03)
    assert along / variance == pytest.approx(0.5, abs=0.03)
    assert abs(further / variance) < 0.03 and abs(across / variance) < 0.03


def test_products_by_distance_are_those_of_all_pairs() -> None:
    rng = np.random.default_rng(3)
    mask = rng.random((4, 5, 6)) > 0.3
    values = rng.standard_normal(int(mask.sum())).astype(np.float32)
    products, pairs = lagged_products(mask, values)
    at = np.argwhere(mask)
    for lag in ([0, 0, 0], [0, 0, 1], [1, 0, 2], [0, 3, -1], [-2, 1, 1]):
        found = [(i, j) for i in range(len(at)) for j in range(len(at)) if (at[j] - at[i] == lag).all()]
        assert pairs[tuple(lag)] == pytest.approx(len(found), abs=1e-3)
        assert products[tuple(lag)] == pytest.approx(sum(float(values[i] * values[j]) for i, j in found), abs=1e-3)
    assert np.isfinite(amplitude_of(products, pairs)).all()


def test_robust_forces_lose_no_more_than_four_fifths() -> None:
    assert lost_to_robustness(2.0, 2.0) == 1.0
    assert lost_to_robustness(2.0, 1.0) == 2.0
    assert lost_to_robustness(2.0, -1.0) == pytest.approx(5.0)


def test_random_loads_are_forces_times_splines() -> None:
    """Loads by the basis functions of SciPy, voxel by voxel; more of them than are added at once, and for a part of the voxels."""
    images = level((11, 12, 13))
    grid = SplineGrid.around([0.0, 0.0, 0.0], np.array(images.mask.shape[::-1]) * SPACING + 2.0 * SPACING, [4.0, 4.5, 5.0])
    system, rng, n = SplineSystem(images, grid), np.random.default_rng(4), len(images.intensity)
    sensitivity, random = rng.standard_normal((n, 3)).astype(np.float32), rng.standard_normal((19, n)).astype(np.float32)
    basis = BSpline.basis_element(np.arange(-2, 3), extrapolate=False)
    at = (images.index * SPACING - grid.origin_mm) / grid.step_mm
    z, y, x = (np.asarray(k) - 1 for k in system.nodes)
    each = [np.nan_to_num(basis(at[:, a, None] - node)) for a, node in enumerate((x, y, z))]
    splines = each[0] * each[1] * each[2]  # voxels by nodes
    wanted = np.einsum("vn,vi,sv->nis", splines, sensitivity, random)
    np.testing.assert_allclose(system.random_loads(sensitivity, random), wanted, atol=2e-5 * np.abs(wanted).max())
    some = rng.random(n) > 0.5
    number = np.full(images.mask.shape, -1, np.int32)
    number[images.mask] = np.where(some, np.cumsum(some) - 1, -1)
    part = np.einsum("vn,vi,sv->nis", splines[some], sensitivity[some], random[:3, some])
    found = system.random_loads(np.ascontiguousarray(sensitivity[some]), np.ascontiguousarray(random[:3, some]), number)
    np.testing.assert_allclose(found, part, atol=2e-5 * np.abs(part).max())
    assert system.random_loads(sensitivity, []).shape == (system.n, 3, 0)


def test_independent_residuals_load_with_the_normal_matrix_as_covariance() -> None:
    """What makes samples those of the error: loads of unit noise, weighted by the sensitivity, have the matrix of the intensities."""
    images = level((9, 10, 11))
    grid = SplineGrid.around([0.0, 0.0, 0.0], np.array(images.mask.shape[::-1]) * SPACING, [5.0, 5.0, 6.0])
    system, rng, n = SplineSystem(images, grid), np.random.default_rng(5), len(images.intensity)
    sensitivity = rng.standard_normal((n, 3)).astype(np.float32)
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    products = np.stack([sensitivity[:, i] * sensitivity[:, j] for i, j in upper], axis=1)
    m = len(system.cells)
    system.assembled(np.zeros((*grid.shape, 3)), products, np.zeros((n, 3), np.float32), np.full((m, 3), 1e-6), np.zeros(m))
    diagonal = system.matrix[:, :, 3 * 171 : 3 * 171 + 3].astype(float)
    count = 4000
    loads = system.random_loads(sensitivity, (rng.standard_normal(n, dtype=np.float32) for _ in range(count))).astype(float)
    covariance = np.einsum("nis,njs->nij", loads, loads) / count
    sd = np.sqrt((diagonal**2 + np.einsum("nii,njj->nij", diagonal, diagonal)) / count)
    well = np.einsum("nii->n", diagonal) > 1e-3
    assert np.abs((covariance - diagonal) / sd)[well].max() < 6.0


class TestObservedJitter:
    """Residuals whose variance grows with the squared gradient: the regression finds by how much."""

    def comparison(self, noise: float, jitter_voxels: float, shape: tuple[int, int, int] = (30, 32, 34)) -> IntensityComparison:
        images, rng = level(shape), np.random.default_rng(6)
        found = IntensityComparison(images, ComparisonSettings(3.0, 0.15, 1.0, 0.0))
        n = len(images.intensity)
        found.gradient[:] = rng.exponential(20.0, (n, 1)) * rng.standard_normal((n, 3))
        sd = np.sqrt(noise**2 + (jitter_voxels * SPACING.mean()) ** 2 * (found.gradient.astype(float) ** 2).sum(axis=1))
        found.residual[:] = sd * rng.standard_normal(n)
        return found

    @pytest.mark.parametrize("jitter", [0.05, 0.15, 0.4])
    def test_is_that_of_the_residuals(self, jitter: float) -> None:
        assert self.comparison(4.0, jitter).observed_jitter_voxels == pytest.approx(jitter, rel=0.1)

    def test_is_none_where_residuals_do_not_grow(self) -> None:
        assert self.comparison(4.0, 0.0).observed_jitter_voxels < 0.02

    def test_does_not_count_voxels_that_are_not_seen(self) -> None:
        found = self.comparison(4.0, 0.15)
        lost = np.random.default_rng(7).random(len(found.value)) < 0.4
        found.value[lost], found.residual[lost] = -1e30, 1e4
        assert found.observed_jitter_voxels == pytest.approx(0.15, rel=0.12)

    def test_of_few_voxels_is_that_of_the_settings(self) -> None:
        few = self.comparison(4.0, 0.4, (10, 11, 12))
        assert few.bounded_jitter(few.observed_jitter_voxels) == pytest.approx(0.15)
        assert few.observed_jitter_voxels == pytest.approx(0.15 / JITTER)

    def test_weighs_never_more_than_the_settings_say(self) -> None:
        found = self.comparison(4.0, 0.4)
        assert found.bounded_jitter(found.observed_jitter_voxels) == 0.15
        assert found.bounded_jitter(0.02) == pytest.approx(0.02 * JITTER)
