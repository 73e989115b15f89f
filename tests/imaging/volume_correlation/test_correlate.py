"""Volume correlation on textured objects in air with an exact motion: intensities are evaluated where the material came from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scenes import texture
from scipy import ndimage

from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.displacement.strain import green_lagrange_strain_of
from naibu.imaging.measure_displacement import measure_displacement
from naibu.imaging.preprocessing.object_mask import object_mask
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation import common_content, correlate, gauss_newton
from naibu.imaging.volume_correlation.common_content import CommonContent
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.rigid_parts.rigid_initialization import RigidInitialization
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid

Array = np.ndarray
Map = Callable[[Array], Array]
MIDDLE = np.array([24.0, 22.0, 20.0])
CHI_SQUARED_95 = 7.815
NOISE = 3.0


def frame(shape: tuple[int, int, int] = (40, 44, 48), spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Volume:
    return Volume.from_array(np.zeros(shape), spacing_mm=spacing)


RADII = np.array([15.0, 14.0, 13.0])
SCALE = np.array([2.0, 1.0, 1.0])  # of the long object, along x


def depth(x: Array, scale: Array | float = 1.0) -> Array:
    """Return how deep points lie in an ellipsoid, mm, roughly."""
    return (1.0 - np.linalg.norm((x - MIDDLE * scale) / (RADII * scale), axis=-1)) * min(RADII)


def scans(
    grid: Volume,
    back: Map,
    *,
    plain: Callable[[Array], Array] | None = None,
    scale: Array | float = 1.0,
    noise: float = NOISE,
    other: bool = False,
) -> tuple[Volume, Volume]:
    """Return reference and deformed scan.

    `back` maps positions to the reference, `plain` gives the fraction without texture; an `other` deformed object has a texture of its own.
    """
    rng = np.random.default_rng(1)

    def intensity(x: Array, seed: int) -> Array:
        own = 0.0 if plain is None else plain(x)
        return (200.0 + (1.0 - own) * (texture(seed, (5.0, 14.0))(x) - 100.0)) / (1.0 + np.exp(-4.0 * depth(x, scale)))

    x = positions(grid)
    pair = intensity(x, 0), intensity(back(x), int(other))
    before, after = (v + noise * rng.standard_normal(v.shape) for v in pair)
    return grid.with_values(before), grid.with_values(after)


def affine(matrix: Array, shift: Array) -> tuple[Map, Map]:
    """Return the displacement of an affine motion about the middle, and where it came from."""
    inverse = np.linalg.inv(matrix)
    return lambda x: (x - MIDDLE) @ (matrix - np.eye(3)).T + shift, lambda x: (x - MIDDLE - shift) @ inverse.T + MIDDLE


def errors(found: CorrelationResult, displacement: Map, least_depth: float = 0.0) -> Array:
    x = positions(found.volume)
    inside = found.valid & (depth(x) > least_depth)
    return found.displacement.vectors[inside] - displacement(x[inside])


def waves() -> tuple[Map, Map]:
    """Return a smooth motion of up to 2 mm and its inverse by fixed-point iteration."""
    k, phase = 2 * np.pi / np.array([34.0, 40.0, 46.0]), np.array([0.3, 1.1, 2.0])

    def move(x: Array) -> Array:
        return 2.0 * np.sin(x[..., [1, 2, 0]] * k + phase)

    def back(x: Array) -> Array:
        y = x.copy()
        for _ in range(60):
            y = y + 0.8 * (x - y - move(y))
        return y

    return move, back


@cache
def waved() -> tuple[Volume, Volume, CorrelationResult]:
    before, after = scans(frame(), waves()[1])
    return before, after, correlate_volumes(before, after)


def test_a_rigid_motion_is_found_without_strain() -> None:
    rotation = rotation_matrix(np.deg2rad(10.0) * np.array([2.0, -1.0, 2.0]) / 3.0)
    displacement, back = affine(rotation, np.array([5.0, -4.0, 3.0]))
    before, after = scans(frame(), back)
    found = correlate_volumes(before, after)
    assert np.linalg.norm(errors(found, displacement), axis=1).mean() < 0.05
    inside = found.valid & (depth(positions(before)) > 2.0)
    f = np.eye(3) + found.gradient()[inside]
    strain = 0.5 * (np.swapaxes(f, 1, 2) @ f - np.eye(3))
    assert np.sqrt((strain**2).mean()) < 0.005
    assert np.abs(f.mean(axis=0) - rotation).max() < 0.002


def test_the_rigid_motion_from_which_the_body_deforms_best_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dented body may correlate best where it is turned too far; from there alone the search does not come back."""
    found, turned = RigidInitialization.found, rotation_matrix(np.deg2rad([0.0, 0.0, 60.0]))
    wrong = turned, MIDDLE - turned @ MIDDLE, 0.99
    before, after, _ = waved()

    def error() -> float:
        return float(np.linalg.norm(errors(correlate_volumes(before, after), waves()[0]), axis=1).mean())

    monkeypatch.setattr(RigidInitialization, "found", lambda own, shifts: [wrong, *found(own, shifts)])
    assert error() < 0.1
    monkeypatch.setattr(RigidInitialization, "found", lambda own, shifts: [wrong])
    with pytest.raises(InputError, match="the volumes match in"):
        error()


def test_a_uniform_compression_has_its_gradient() -> None:
    stretch = np.diag([1.04, 1.03, 0.92])
    displacement, back = affine(stretch, np.array([0.4, 0.0, -1.3]))
    found = correlate_volumes(*scans(frame(), back))
    inside = found.valid & (depth(positions(found.volume)) > 2.0)
    assert np.abs(found.gradient()[inside].mean(axis=0) - (stretch - np.eye(3))).max() < 0.004
    assert np.linalg.norm(errors(found, displacement), axis=1).mean() < 0.08


def test_layers_of_different_strain_are_resolved() -> None:
    z = np.linspace(-20.0, 60.0, 4001)
    slope = np.where(z < 20.0, 0.90, 0.98)
    after_z = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(z))]) + z[0]
    back = lambda x: np.stack([x[..., 0], x[..., 1], np.interp(x[..., 2], after_z, z)], axis=-1)  # noqa: E731
    found = correlate_volumes(*scans(frame(), back))
    gradient, at = found.gradient()[..., 2, 2], positions(found.volume)
    inside = found.valid & (depth(at) > 2.0)
    assert gradient[inside & (at[..., 2] < 15.0)].mean() == pytest.approx(-0.10, abs=0.02)
    assert gradient[inside & (at[..., 2] > 25.0)].mean() == pytest.approx(-0.02, abs=0.02)


def covered(found: CorrelationResult, displacement: Map, inside: Array) -> float:
    """Share of the voxels whose true displacement lies in the 95 % ellipsoid."""
    x = positions(found.volume)[found.valid & inside]
    e = found.displacement_at(x) - displacement(x)
    return float((np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance_at(x)), e) < CHI_SQUARED_95).mean())


def test_what_has_no_texture_is_not_answered() -> None:
    plain = lambda x: 1.0 / (1.0 + np.exp(-2.0 * (x[..., 0] - 48.0)))  # noqa: E731
    move, back = waves()
    found = correlate_volumes(*scans(frame((40, 44, 96)), back, plain=plain, scale=SCALE))
    x = positions(found.volume)
    inside = depth(x, SCALE) > 0.0
    textured, bare = inside & (x[..., 0] < 44.0), inside & (x[..., 0] > 56.0)
    # its outline shows neither how it twists nor how it slides along itself: errors there were a millimetre, at a stated SD of 0.1
    assert found.valid[bare].mean() < 0.02
    assert found.valid[textured].mean() > 0.99
    assert covered(found, move, textured) >= 0.9


def test_noise_in_the_gradients_is_no_information() -> None:
    """Five times the noise: gradients are then mostly noise along any axis, and counted as information they understate the covariance."""
    move, back = waves()
    found = correlate_volumes(*scans(frame(), back, noise=5.0 * NOISE))
    assert found.valid[depth(positions(found.volume)) > 0.0].mean() > 0.95
    assert 0.9 <= covered(found, move, depth(positions(found.volume)) > 0.0) <= 0.995


def test_another_object_of_the_same_outline_is_refused() -> None:
    with pytest.raises(InputError, match=r"match in .*% of the object only|no common content|no displacement fits"):
        correlate_volumes(*scans(frame(), waves()[1], other=True))


def test_the_outer_halves_of_the_end_slices_are_answered() -> None:
    scale = np.array([1.0, 1.0, 3.0])  # the object goes on beyond the last slice
    displacement, back = affine(np.eye(3), np.array([0.0, 0.0, 1.0]))
    found = correlate_volumes(*scans(frame((16, 44, 48), (1.0, 1.0, 2.5)), back, scale=scale))
    x = positions(found.volume)
    last = (depth(x, scale) > 0.0) & (x[..., 2] > 37.0)
    assert last.any() and found.valid[last].mean() > 0.99
    assert covered(found, displacement, last) >= 0.9


def test_cells_that_have_not_converged_widen_the_covariance_and_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    before, after, found = waved()
    assert found.converged.all() and found.status.startswith("converged")
    monkeypatch.setattr(correlate, "UNSETTLED", 1.0)  # the same steps, whatever counts as still
    same = correlate_volumes(before, after)
    monkeypatch.setattr(gauss_newton, "STILL", 0.0)
    monkeypatch.setattr(common_content, "MOST_MOVING", 1.0)
    moving = correlate_volumes(before, after)
    assert not moving.converged.all()
    widened = np.trace(moving.cell_covariance - same.cell_covariance, axis1=3, axis2=4)[~moving.converged]
    assert (widened > 0.0).all()
    sensed = measure_displacement(before, after)
    assert sensed.facts["unconverged_cells"] == (~moving.converged).sum()
    assert any("have not converged" in text for text in sensed.warnings)
    monkeypatch.setattr(common_content, "MOST_MOVING", 0.0)
    with pytest.raises(InputError, match="had not converged"):
        correlate_volumes(before, after)


def test_steps_go_on_as_long_as_cells_move(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = tuple(replace(level, steps=1) if k >= correlate.HALVINGS else level for k, level in enumerate(correlate.LEVELS))
    monkeypatch.setattr(correlate, "LEVELS", levels)
    monkeypatch.setattr(correlate, "ADAPTED_STEPS", 1)
    before, after, usual = waved()
    found = correlate_volumes(before, after)
    assert found.converged.mean() > 0.95
    assert np.nanmax(np.linalg.norm(found.displacement.vectors - usual.displacement.vectors, axis=-1)) < 0.3


def test_little_agreement_counts_as_no_match_where_the_residual_is_no_noise() -> None:
    content = CommonContent(np.array([0.2, 0.5, 0.5, 0.7]), np.array([0.0, 0.0, 0.3, 0.3]), np.zeros(4, dtype=bool))
    assert content.matched.tolist() == [False, True, False, True]


def test_the_covariance_covers_the_truth() -> None:
    _, _, found = waved()
    move = waves()[0]
    inside = positions(found.volume)[found.valid & (depth(positions(found.volume)) > 0.0)]
    e = found.displacement_at(inside) - move(inside)
    covered = np.einsum("ni,ni->n", e, np.linalg.solve(found.covariance_at(inside), e[..., None])[..., 0]) < CHI_SQUARED_95
    assert np.linalg.norm(e, axis=1).mean() < 0.12
    assert 0.9 <= covered.mean() <= 0.999
    # and is no wider than it must be: errors are a fair fraction of it
    assert np.sqrt((e**2).sum() / np.einsum("nii->", found.covariance_at(inside))) > 0.3


def test_the_standard_deviation_of_strain_covers_the_truth_and_is_not_far_from_its_error() -> None:
    _, _, found = waved()
    x, h = positions(found.volume), 1e-4
    move = waves()[0]
    gradient = np.stack([(move(x + h * e) - move(x - h * e)) / (2 * h) for e in np.eye(3)], axis=-1)
    inside = found.valid & (depth(x) > 2.0)
    off = green_lagrange_strain_of(found.gradient()[inside]) - green_lagrange_strain_of(gradient[inside])
    ratio = np.sqrt((off**2).mean(axis=(-2, -1))) / found.strain_sd()[inside]
    assert 0.4 < np.sqrt((ratio**2).mean()) < 1.2
    assert np.isnan(found.strain_sd()[~found.valid]).all()


def test_gain_and_offset_of_a_scan_do_not_matter() -> None:
    before, after, found = waved()
    bright = correlate_volumes(before, after.with_values(1.4 * after.values + 60.0))
    both = found.valid & bright.valid
    assert np.percentile(np.linalg.norm(found.displacement.vectors - bright.displacement.vectors, axis=-1)[both], 99) < 0.05
    assert np.nanmedian(bright.gain) == pytest.approx(np.nanmedian(found.gain) / 1.4, rel=0.02)


def test_vectors_turn_with_the_axes_of_the_scanner() -> None:
    before, after, found = waved()
    turn = rotation_matrix(np.array([0.3, -0.5, 0.9]))
    turned = [Volume.from_array(v.values, spacing_mm=v.spacing_mm, origin_mm=(5.0, 6.0, 7.0), direction=turn) for v in (before, after)]
    other = correlate_volumes(*turned)
    # the same intensities give the same numbers, to the last bit
    assert np.array_equal(other.coefficients, found.coefficients)
    at = np.argwhere(found.valid)[::97, ::-1]
    assert np.allclose(other.displacement.vectors[other.valid], found.displacement.vectors[found.valid] @ turn.T, atol=1e-9)
    there = turned[0].to_physical(at)
    assert np.allclose(other.displacement_at(there), found.displacement_at(before.to_physical(at)) @ turn.T, atol=1e-6)
    expected = turn @ found.covariance_at(before.to_physical(at)) @ turn.T
    assert np.allclose(other.covariance_at(there), expected, atol=1e-9)
    assert np.allclose(other.gradient()[other.valid], turn @ found.gradient()[found.valid] @ turn.T, atol=1e-9)


@pytest.mark.parametrize(("shape", "spacing"), [((16, 44, 48), (1.0, 1.0, 2.5)), ((40, 44, 19), (2.5, 1.0, 1.0))])
def test_slices_may_be_thick_and_lie_along_any_axis(shape: tuple[int, int, int], spacing: tuple[float, float, float]) -> None:
    move, back = waves()
    found = correlate_volumes(*scans(frame(shape, spacing), back))
    assert np.linalg.norm(errors(found, move, 3.0), axis=1).mean() < 0.2


def test_the_gradient_is_that_of_the_splines() -> None:
    _, _, found = waved()
    at = np.argwhere(found.valid & (depth(positions(found.volume)) > 2.0))[::211]
    x = found.volume.to_physical(at[:, ::-1])
    numeric = np.stack([(found.displacement_at(x + 0.01 * e) - found.displacement_at(x - 0.01 * e)) / 0.02 for e in np.eye(3)], axis=-1)
    assert np.allclose(found.gradient()[tuple(at.T)], numeric, atol=1e-6)
    assert np.allclose(found.displacement_at(x), found.displacement.vectors[tuple(at.T)], atol=1e-9)


def test_what_is_known_of_all_voxels_is_what_is_known_of_each() -> None:
    _, _, found = waved()
    at = positions(found.volume)[found.valid]
    np.testing.assert_allclose(found.covariance()[found.valid], found.covariance_at(at), rtol=1e-4, atol=1e-9)
    assert np.isnan(found.covariance()[~found.valid]).all()
    np.testing.assert_allclose(found.gradient(np.float32)[found.valid], found.gradient()[found.valid], rtol=1e-6, atol=1e-8)
    # a cell that is not known does not count, and where the nearest cells are not known the others do
    cells = np.where(np.random.default_rng(3).random(found.cell_covariance.shape[:3]) < 0.4, np.nan, 1.0)
    less = replace(found, cell_covariance=found.cell_covariance * cells[..., None, None])
    np.testing.assert_allclose(less.covariance()[found.valid], less.covariance_at(at), rtol=2e-4, atol=1e-9)


def test_a_field_is_what_identification_takes() -> None:
    _, _, found = waved()
    field = found.at_points()
    assert field.valid.all() and len(field.points) < found.valid.sum() / 20
    assert np.allclose(field.vectors, found.displacement_at(field.points), atol=1e-9)
    assert np.linalg.eigvalsh(field.covariance).min() > 0.0
    assert len(found.at_points(step=1).points) == found.valid.sum()
    with pytest.raises(InputError, match="1 voxel or more"):
        found.at_points(step=0)


def test_a_rigid_inclusion_has_a_rigid_motion() -> None:
    # the ball keeps its shape, what is about it is squeezed, and both agree on its surface
    move, _ = affine(np.diag([1.03, 1.03, 0.93]), np.zeros(3))

    def displacement(x: Array) -> Array:
        r = np.linalg.norm(x - MIDDLE, axis=-1, keepdims=True)
        return move(x) * np.clip((r - 7.0) / 5.0, 0.0, 1.0) ** 2 + np.array([0.6, -0.4, 0.3])

    def back(x: Array) -> Array:
        y = x.copy()
        for _ in range(60):
            y = y + 0.8 * (x - y - displacement(y))
        return y

    before, after = scans(frame(), back)
    ball = np.linalg.norm(positions(before) - MIDDLE, axis=-1) < 7.0
    found = correlate_volumes(before, after, rigid_mask=ball)
    assert np.array_equal(found.inclusions > 0, ball)
    f = np.eye(3) + found.gradient()[ball]
    assert np.allclose(f @ np.swapaxes(f, 1, 2), np.eye(3), atol=1e-9)
    assert np.linalg.norm(found.displacement.vectors[ball] - np.array([0.6, -0.4, 0.3]), axis=1).max() < 0.1
    assert np.linalg.norm(errors(found, displacement), axis=1).mean() < 0.15


@pytest.mark.parametrize(
    "settings",
    [
        CorrelationSettings(local_gain=False, rigid_inclusions=False),
        CorrelationSettings(robust=np.inf),
        CorrelationSettings(dilatation_penalty=False, adaptive_weight=False),
        CorrelationSettings(gradients="mean", node_spacing_mm=5.0),
    ],
)
def test_every_part_can_be_left_out(settings: CorrelationSettings) -> None:
    before, after, _ = waved()
    found = correlate_volumes(before, after, settings=settings)
    # least squares is the worst of them: air that moves to where the surface was has as much weight as all texture
    assert np.linalg.norm(errors(found, waves()[0]), axis=1).mean() < 0.3


def test_the_object_is_found_in_air() -> None:
    before, _, _ = waved()
    inside = depth(positions(before)) > 0.0
    mask = object_mask(before)
    assert (mask & inside).sum() / inside.sum() > 0.95
    assert (mask & ~inside).sum() / inside.sum() < 0.2


def test_splines_keep_their_field_when_cells_are_halved_and_know_their_bending() -> None:
    grid = SplineGrid.around([0.0, 0.0, 0.0], [9.0, 12.0, 6.0], [3.0, 4.0, 2.0])
    rng = np.random.default_rng(0)
    c = rng.standard_normal((*grid.shape, 3))
    x = rng.uniform(0.0, 1.0, (50, 3)) * [9.0, 12.0, 6.0]
    assert np.allclose(grid.halved().values(grid.refined(c), x), grid.values(c, x), atol=1e-12)
    # u = x y: its only second derivatives are the two mixed ones
    nodes = grid.nodes_mm
    local = (nodes[..., 0] * nodes[..., 1])[:4, :4, :4].ravel()
    assert local @ grid.bending() @ local == pytest.approx(2.0 * np.prod(grid.step_mm))
    assert np.allclose(grid.gauss_gradients()[:, 2] @ local, 0.0, atol=1e-12)


def test_bad_scans_are_refused() -> None:
    before, after, _ = waved()
    with pytest.raises(InputError, match="different grids"):
        correlate_volumes(before, Volume.from_array(after.values, spacing_mm=(1.0, 1.0, 2.0)))
    with pytest.raises(InputError, match="constant"):
        correlate_volumes(before, after.with_values(np.full(after.shape, 7.0)))
    with pytest.raises(InputError, match="mask is empty"):
        correlate_volumes(before, after, mask=np.zeros(before.shape, dtype=bool))
    holed = after.values.copy()
    holed[3, 4, 5] = np.nan
    with pytest.raises(InputError, match=r"\(3, 4, 5\).*NaN"):
        correlate_volumes(before, after.with_values(holed))
    with pytest.raises(InputError, match="lucas_kanade"):
        correlate_volumes(*(v.cropped((0, 0, 20), (48, 44, 21)) for v in (before, after)))
    small = np.zeros(before.shape, dtype=bool)
    small[20, 20:30, 20:30] = True
    with pytest.raises(InputError, match=r"\[10, 10, 1\] voxels"):
        correlate_volumes(before, after, mask=small)
    with pytest.raises(InputError, match="gradients"):
        correlate_volumes(before, after, settings=CorrelationSettings(gradients="none"))  # type: ignore[arg-type]


@cache
def padded(side: int, end: int, fill: float, reference_too: bool) -> tuple[CorrelationResult, Array]:
    """A smooth motion of which one scan lacks a fifth at an end of an axis, and where the other shows the material."""
    grid = frame()
    motion, back = waves()
    pair = list(scans(grid, back))
    n = grid.shape[side]
    lost = slice(int(0.8 * n), n) if end else slice(0, n - int(0.8 * n))
    which = 0 if reference_too else 1
    values = np.array(pair[which].values)
    values[(slice(None),) * side + (lost,)] = fill
    pair[which] = grid.with_values(values)
    x = positions(grid)
    index = np.round((x + (0.0 if reference_too else 1.0) * motion(x))[..., 2 - side]).astype(int)
    return correlate_volumes(*pair), (index < lost.start) if end else (index >= lost.stop)


@pytest.mark.parametrize(("side", "end", "fill", "reference_too"), [(0, 1, 0.0, False), (1, 0, np.nan, False), (2, 1, -500.0, True)])
def test_padding_is_not_compared_and_what_it_hides_is_not_answered(side: int, end: int, fill: float, reference_too: bool) -> None:
    found, shown = padded(side, end, fill, reference_too)
    motion, _ = waves()
    error = errors(found, motion)
    assert np.linalg.norm(error, axis=1).mean() < 0.12
    assert not (found.valid & ~ndimage.binary_dilation(shown, iterations=2)).any()
    assert (found.valid & shown).sum() > 0.97 * (shown & (depth(positions(found.volume)) > 0.0)).sum()
    covariance = found.covariance()[found.valid & (depth(positions(found.volume)) > 0.0)]
    assert (np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) < CHI_SQUARED_95).mean() >= 0.9


def test_padding_in_the_intensity_of_air_is_not_compared() -> None:
    """A fifth of the object is zero in the second scan, and so is, without noise, the air in both: it was squeezed into what is left."""
    motion, back = waves()
    before, after = scans(frame(), back)
    silent = [np.where(ndimage.gaussian_filter(v.values, 1.0) < 60.0, 0.0, v.values) for v in (before, after)]
    silent[1][28:] = 0.0
    found = correlate_volumes(*(before.with_values(v) for v in silent))
    x = positions(before)
    shown = (x + motion(x))[..., 2] < 28.0
    assert np.linalg.norm(errors(found, motion), axis=1).mean() < 0.15
    assert not (found.valid & ~ndimage.binary_dilation(shown, iterations=2)).any()
    assert (found.valid & shown).sum() > 0.9 * (shown & (depth(x) > 1.0)).sum()
    assert covered(found, motion, depth(x) > 0.0) >= 0.9


def test_scans_of_noise_are_refused() -> None:
    """Also where a mask says that there is an object: a search always finds some displacement."""
    rng, grid = np.random.default_rng(3), frame()
    pair = [grid.with_values(100.0 + 10.0 * rng.standard_normal(grid.shape)) for _ in range(2)]
    stages: list[str] = []
    with pytest.raises(InputError, match="no common content"):
        correlate_volumes(*pair, mask=depth(positions(grid)) > 0.0, progress=lambda report: stages.append(report.stage))
    assert "covariance" not in stages and "weights of the penalties" not in stages  # which take most of the time


def test_scans_that_are_known_in_different_places_do_not_overlap() -> None:
    before, after, _ = waved()
    left, right = before.values.copy(), after.values.copy()
    left[:, :, 24:], right[:, :, :24] = np.nan, np.nan
    with pytest.raises(InputError, match="overlap"):
        correlate_volumes(before.with_values(left), after.with_values(right))
