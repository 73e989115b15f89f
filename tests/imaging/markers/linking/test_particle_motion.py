"""Displacement, its stated deviation, and strain of particles whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest
from particle_gels import particle_gel
from traction_gels import traction_gel

from naibu.core.errors import InputError
from naibu.imaging.markers.linking.particle_motion import particle_motion

GRADIENT = np.array([[0.05, 0.1, 0.0], [0.0, 0.02, -0.05], [0.03, 0.0, -0.12]])


def affine(n: int, seed: int, sd: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Particles under an affine motion, shuffled, and their true displacement."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0.0, 10.0, (n, 3))
    u = x @ GRADIENT.T + (0.4, -0.2, 0.1)
    noise = np.array(sd) / np.sqrt(2.0)
    y = x + u + noise * rng.standard_normal(x.shape)
    return x + noise * rng.standard_normal(x.shape), y[rng.permutation(n)], u


@pytest.mark.parametrize("n", [400, 3000])
def test_displacement_strain_and_their_deviations(n: int) -> None:
    spacing = 10.0 / n ** (1.0 / 3.0)
    sd = (0.01 * spacing, 0.01 * spacing, 0.05 * spacing)
    x, y, u = affine(n, 1, sd)
    found = particle_motion(x, y)
    here = found.links.pairs[:, 0]
    assert found.field.valid.mean() > 0.97
    error = (found.field.vectors - u[here])[found.field.valid]
    stated = found.field.standard_deviation
    assert stated is not None
    ratio = np.sqrt(np.mean(error**2, axis=0)) / np.sqrt(np.mean(stated[found.field.valid] ** 2, axis=0))
    assert (ratio > 0.8).all() and (ratio < 1.1).all(), ratio
    slope = (found.gradient - GRADIENT) / found.gradient_sd
    assert 0.8 < np.sqrt(np.nanmedian(slope**2) / 0.455) < 1.2  # the median of chi squared with one degree of freedom
    f = np.eye(3) + GRADIENT
    truth = 0.5 * (f.T @ f - np.eye(3))
    np.testing.assert_allclose(np.nanmedian(found.strain, axis=0), truth, atol=0.004)


def test_deviations_follow_the_noise_from_place_to_place() -> None:
    cloud = particle_gel(6000, 3, loss=0.3, press_px=6.0)
    found = particle_motion(cloud.reference, cloud.deformed)
    sd = found.field.standard_deviation
    assert sd is not None
    depth = cloud.reference[found.links.pairs[:, 0], 2]
    top, floor = depth > np.percentile(depth, 80), depth < np.percentile(depth, 20)
    # noise of both states: 0.2, 0.2, 0.8 px, from 0.5 to 1.5 times that, of which the outer fifths have 0.6 and 1.4
    for part, factor in ((top, 0.6), (floor, 1.4)):
        expected = factor * np.sqrt(2.0) * np.array([0.2, 0.2, 0.8])
        ratio = np.median(sd[part], axis=0) / expected
        assert (ratio > 0.8).all() and (ratio < 1.35).all(), ratio


def bulging(x: np.ndarray) -> np.ndarray:
    """Displacement (n, 3) in a cube of 20 that is compressed by a fifth, more in the middle, and bulges."""
    aside, height = x[:, :2] - 10.0, x[:, 2] / 20.0
    down = -4.0 * height * (1.0 + 0.3 * np.cos(np.pi * aside[:, 0] / 20.0))
    return np.column_stack([(0.15 * np.sin(np.pi * height) + 0.03)[:, None] * aside + (0.5, -0.3), down])


@pytest.mark.parametrize("times", [1.0, 7.0])
def test_deviations_hold_along_an_axis_that_is_less_rough_or_noisier_than_the_others(times: float) -> None:
    held, ratio = [], []
    for seed in (11, 12):
        rng = np.random.default_rng(seed)
        x = rng.uniform(0.0, 20.0, (600, 3))
        sd = 0.005 * 20.0 / 600.0 ** (1.0 / 3.0) * np.array([1.0, 1.0, times]) / np.sqrt(2.0)
        y = (x + bulging(x) + sd * rng.standard_normal(x.shape))[rng.permutation(len(x))]
        found = particle_motion(x + sd * rng.standard_normal(x.shape), y)
        stated, valid = found.field.standard_deviation, found.field.valid
        assert stated is not None
        off = (found.field.vectors - bulging(found.field.points))[valid]
        held.append(np.mean(np.abs(off) < 1.96 * stated[valid], axis=0))
        ratio.append(np.median(stated[valid], axis=0) / (np.sqrt(2.0) * sd))
    assert (np.mean(held, axis=0) > 0.92).all(), held
    assert (np.mean(ratio, axis=0) < 1.45).all(), ratio


def half_lost_twice(noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return two states of a bulging cloud that each lost half of it, of which a quarter is left in both, and the numbers of particles.

    `noise` is that of a coordinate in a state, in distances between the particles before the loss.
    """
    rng, n = np.random.default_rng(5), 2500
    x = rng.uniform(0.0, 20.0, (n, 3))
    sd = noise * 20.0 / n ** (1.0 / 3.0)
    first, second = np.flatnonzero(rng.random(n) < 0.5), rng.permutation(np.flatnonzero(rng.random(n) < 0.5))
    seen = [v + sd * rng.standard_normal(v.shape) for v in (x[first], (x + bulging(x))[second])]
    return seen[0], seen[1], first, second


def test_half_of_the_particles_may_be_lost_in_both_states() -> None:
    x, y, first, second = half_lost_twice(0.02)
    found = particle_motion(x, y)
    here, there = found.links.pairs.T
    right = first[here] == second[there]
    assert right.mean() >= 0.995 and right.sum() > 0.97 * len(np.intersect1d(first, second))
    assert found.links.confidence.mean() < right.mean() + 0.005


def test_where_noise_hides_which_particle_is_which_probabilities_say_so() -> None:
    """By noise of a twentieth, within which other particles lie, too; clouds with noise of a tenth are refused."""
    x, y, first, second = half_lost_twice(0.05)
    found = particle_motion(x, y)
    here, there = found.links.pairs.T
    assert found.links.confidence.mean() < (first[here] == second[there]).mean()
    with pytest.raises(InputError, match="no common structure"):
        particle_motion(*half_lost_twice(0.1)[:2])


@pytest.mark.parametrize("seed", [21, 22])
def test_noise_of_a_tenth_of_the_distance_is_answered_where_few_are_lost(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 2500
    x = rng.uniform(0.0, 20.0, (n, 3))
    sd = 0.1 * 20.0 / n ** (1.0 / 3.0)
    second = rng.permutation(np.flatnonzero(rng.random(n) < 0.85))
    found = particle_motion(x + sd * rng.standard_normal(x.shape), (x + bulging(x))[second] + sd * rng.standard_normal((len(second), 3)))
    here, there = found.links.pairs.T
    right = here == second[there]
    assert right.mean() > 0.93 and right.sum() > 0.5 * len(second)
    assert (~right).sum() < np.sum(1.0 - found.links.confidence)
    of_two = np.linalg.norm(found.field.vectors - bulging(found.field.points), axis=1) / (np.sqrt(2.0) * sd)
    assert np.median(of_two) < 1.8  # of a vector of standard normal components: 1.54


def test_stated_deviations_are_raised_where_residuals_are_larger() -> None:
    x, y, _ = affine(800, 2, (0.02, 0.02, 0.02))
    honest = np.full(x.shape, 0.02 / np.sqrt(2.0))
    kept = particle_motion(x, y, reference_sd_mm=honest, deformed_sd_mm=honest)
    raised = particle_motion(x, y, reference_sd_mm=0.1 * honest, deformed_sd_mm=0.1 * honest)
    for found in (kept, raised):
        assert found.field.standard_deviation is not None
        assert np.median(found.field.standard_deviation) == pytest.approx(0.02, rel=0.12)
    with pytest.raises(InputError, match="deformed_sd_mm"):
        particle_motion(x, y, reference_sd_mm=honest, deformed_sd_mm=honest[:5])


def test_particles_in_a_plane_tell_no_strain_across_it() -> None:
    x, y, _ = affine(400, 4, (0.0, 0.0, 0.0))
    x[:, 2] = 0.0
    rng = np.random.default_rng(0)
    y = (x @ (np.eye(3) + np.diag([0.1, -0.05, 0.0])))[rng.permutation(len(x))]
    assert np.isnan(particle_motion(x, y).gradient).all()
    flat = particle_motion(x[:, :2], y[:, :2])
    np.testing.assert_allclose(np.median(flat.gradient, axis=0), np.diag([0.1, -0.05]), atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_clouds_of_two_bodies_other_units_and_mirror_images_are_refused(seed: int) -> None:
    cloud = particle_gel(1500, seed)
    other = particle_gel(1500, seed + 10)
    for second in (other.deformed, 10.0 * cloud.deformed, cloud.deformed * (1.0, 1.0, -1.0)):
        with pytest.raises(InputError, match=r"no common structure|no soft body|mirror image"):
            particle_motion(cloud.reference, second)


@pytest.mark.parametrize(("peak", "decay", "degrees"), [(3.0, 4.0, 0.0), (2.5, 1.5, 20.0)])
def test_particles_around_cells_are_linked_and_deviations_hold_where_the_motion_changes_within_a_few(
    peak: float, decay: float, degrees: float
) -> None:
    gel = traction_gel(8000, 11, peak=peak, decay=decay, degrees=degrees)
    found = particle_motion(gel.cloud.reference, gel.cloud.deformed)
    right, possible, wrong = gel.cloud.judged(found.links.pairs)
    assert right / (right + wrong) > 0.993
    assert right / possible > 0.98
    assert wrong < np.sum(1.0 - found.links.confidence)
    at, sd = found.field.points, found.field.standard_deviation
    assert sd is not None
    for some in (found.field.valid, found.field.valid & (gel.cloud.displacement[found.links.pairs[:, 0]] > 0.5)):
        off = np.abs(found.field.vectors - (gel.moved(at) - at))[some]
        assert 0.9 < np.mean(off < 1.96 * sd[some]) < 0.99
        slope = np.abs(found.gradient - gel.gradient(at))[some]
        assert 0.9 < np.mean(slope < 1.96 * found.gradient_sd[some]) < 0.99
