"""Volume correlation block by block gives what it gives in memory, with no seam, on a textured ball whose motion is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np
import pytest
from scenes import texture
from scipy import ndimage

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.large_volumes import thinning
from naibu.imaging.large_volumes.correlate_blocks import BlockwiseCorrelation, InProcess, correlate_blocks
from naibu.imaging.large_volumes.field_blocks import VoxelField, boxes_of
from naibu.imaging.large_volumes.thinning import ThinnedValues, needed_memory_mb, thinned, thinning_factor
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.settings import CorrelationSettings
from naibu.validation.specimens.swollen_body import SwollenSphere, swollen_body

Array = np.ndarray
SIZE, RADIUS, BLOCK = 64, 25.0, 24
SETTINGS = CorrelationSettings(node_spacing_mm=8.0)
MIDDLE = np.full(3, 0.5 * (SIZE - 1))


def moved(x: Array) -> Array:
    wave = np.sin(0.07 * x[..., [1, 2, 0]] + np.array([0.4, 1.3, 2.1]))
    return 1.5 * wave + np.array([1.2, -0.8, 0.5]) - 0.04 * (x - MIDDLE) * [0.0, 0.0, 1.0]


@cache
def scans() -> tuple[Volume, Volume, Array]:
    """Return both scans and the true displacement."""
    grid = Volume.from_array(np.zeros((SIZE,) * 3), spacing_mm=(1.0, 1.0, 1.0))
    grey, x, rng = texture(3, (5.0, 14.0), n=40), positions(grid), np.random.default_rng(5)
    back = x.copy()
    for _ in range(60):
        back = x - moved(back)

    def intensity(at: Array) -> Array:
        depth = RADIUS - np.linalg.norm(at - MIDDLE, axis=-1)
        return 50.0 + (100.0 + grey(at)) / (1.0 + np.exp(-3.0 * depth)) + 3.0 * rng.standard_normal(at.shape[:-1])

    pair = [grid.with_values(np.clip(np.rint(10.0 * intensity(at)), 0, 65535).astype(np.uint16)) for at in (x, back)]
    return pair[0], pair[1], moved(x)


@cache
def in_blocks(edge: int) -> BlockwiseCorrelation:
    a, b, _ = scans()
    return correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(b), settings=SETTINGS, factor=2, edge=edge)


@cache
def in_memory() -> CorrelationResult:
    return correlate_volumes(*scans()[:2], settings=SETTINGS)


@cache
def everywhere(edge: int) -> tuple[Array, Array, Array]:
    """Return displacement, standard deviation and validity of all voxels, from boxes that have nothing to do with the blocks."""
    field = VoxelField.of(in_blocks(edge))
    u, sd, valid = np.empty((SIZE,) * 3 + (3,)), np.empty((SIZE,) * 3), np.zeros((SIZE,) * 3, dtype=bool)
    for box in boxes_of((SIZE,) * 3, 20):
        u[box], sd[box], valid[box] = field.in_box(box, scans()[0].values)
    return u, sd, valid


def inside(depth: float) -> Array:
    return RADIUS - np.linalg.norm(positions(scans()[0]) - MIDDLE, axis=-1) > depth


def test_blocks_give_what_memory_gives() -> None:
    assert in_blocks(BLOCK).blocks >= 27
    (u, sd, valid), whole = everywhere(BLOCK), in_memory()
    assert valid[inside(0.0)].mean() > 0.99
    both = valid & whole.valid & inside(0.0)
    off = np.linalg.norm(u - whole.displacement.vectors, axis=-1)
    stated = np.sqrt(np.linalg.eigvalsh(whole.covariance_at(positions(scans()[0])[both])).max(axis=-1))
    ratio = sd[both] / stated
    # the outline is that in memory, to the noise of the threshold
    assert abs(int(valid.sum()) - int(whole.valid.sum())) < 0.01 * whole.valid.sum()
    assert off[both].mean() < 0.02
    # in the outermost cells, too
    assert off[both & ~inside(2.0)].mean() < 0.025
    assert np.percentile(off[both], 95) < 0.05
    assert (off[both] < stated).mean() > 0.999
    assert 0.85 < np.median(ratio) < 1.2


def test_blocks_come_as_near_to_the_truth_as_memory() -> None:
    """A gain that is matched one pass after the displacement left a tenth more."""
    (u, _, valid), whole, truth = everywhere(BLOCK), in_memory(), scans()[2]
    both = valid & whole.valid & inside(0.0)
    found, in_ram = (np.linalg.norm(v[both] - truth[both], axis=-1).mean() for v in (u, whole.displacement.vectors))
    assert found < 0.98 * in_ram and found < 0.03


def test_a_given_mask_gives_what_it_gives_in_memory() -> None:
    a, b, _ = scans()
    mask = a.with_values(inside(0.0).astype(np.uint8))
    whole = correlate_volumes(a, b, mask=inside(0.0), settings=SETTINGS)
    found = correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(b), mask=ChunkedVolume.of(mask), settings=SETTINGS, factor=2, edge=BLOCK)
    u, sd, valid = VoxelField.of(found).in_box((slice(None),) * 3, mask.values)
    assert (valid & whole.valid).sum() > 0.99 * inside(0.0).sum() and not valid[~inside(0.0)].any()
    both = valid & whole.valid
    off = np.linalg.norm(u - whole.displacement.vectors, axis=-1)
    stated = np.sqrt(np.linalg.eigvalsh(whole.covariance_at(positions(a)[both])).max(axis=-1))
    assert off[both].mean() < 0.01 and off[both & ~inside(1.0)].mean() < 0.02
    assert (off[both] < stated).mean() > 0.998 and (off[both] < 2.0 * stated).mean() > 0.999
    assert 0.85 < np.median(sd[both] / stated) < 1.3


@pytest.mark.slow
def test_a_part_that_swells_is_found_as_in_memory() -> None:
    part = SwollenSphere((24.0, 29.5, 25.5), 12.0, 1.15)
    body = swollen_body([part], seed=1, noise=20.0)
    mask = body.before.with_values(body.mask.astype(np.uint8))
    whole = correlate_volumes(body.before, body.after, mask=body.mask)
    scanned = (ChunkedVolume.of(v) for v in (body.before, body.after))
    found = correlate_blocks(*scanned, mask=ChunkedVolume.of(mask), factor=1, edge=32)
    core = np.linalg.norm(positions(mask) - np.array(part.middle_mm), axis=-1) < 0.6 * part.radius_mm
    swollen = [np.linalg.det(np.eye(3) + r.gradient()[core & r.valid]).mean() for r in (whole, found.result)]
    assert swollen[1] == pytest.approx(swollen[0], abs=0.02) and min(swollen) > 1.09
    off = (found.result.displacement.vectors - whole.displacement.vectors)[whole.valid & found.result.valid]
    assert np.linalg.norm(off, axis=-1).mean() < 0.04
    own = [r.dilatation < 0.1 * np.nanmax(r.dilatation) for r in (whole, found.result)]
    assert (own[0] & own[1]).sum() > 0.8 * own[0].sum()


def test_standard_deviations_cover_the_truth() -> None:
    u, _, valid = everywhere(BLOCK)
    inner = valid & inside(1.0)
    covariance = in_blocks(BLOCK).result.covariance_at(positions(scans()[0])[inner])
    error = (u - scans()[2])[inner]
    distance = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    assert (distance < 7.815).mean() > 0.9


@pytest.mark.parametrize("factor", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_stated_errors_are_those_of_all_voxels_however_coarse_the_start_is(factor: int) -> None:
    """Residuals of the coarse volumes, whose texture is lost, once made them fourteen times as large, and those of points too small."""
    a, b, truth = scans()
    result = correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(b), settings=SETTINGS, factor=factor, edge=BLOCK).result
    points = positions(a)[inside(0.0)]
    covariance = result.covariance_at(points)
    error = result.grid.values(result.coefficients, points) - truth[inside(0.0)]
    assert np.nanmax(result.cell_misplacement) == 0.0
    stated, real = np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 3), np.sqrt((error**2).mean())
    assert real < stated < 3.0 * real
    assert (np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) < 7.815).mean() > 0.9
    small = result.blocks
    assert small is not None and small.covariance is not None
    off = small.vectors - moved(small.points)
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(small.covariance), off)
    assert 0.9 < (squares < 7.815).mean() < 0.99
    assert 0.7 < squares.mean() / 3.0 < 1.3


def test_results_do_not_depend_on_the_blocks_and_no_seam_is_seen_in_strain() -> None:
    one, many = everywhere(1000)[0], everywhere(BLOCK)[0]
    assert in_blocks(1000).blocks == 1
    both = np.isfinite(one).all(axis=-1) & np.isfinite(many).all(axis=-1) & inside(0.0)
    off = np.linalg.norm(one - many, axis=-1)
    assert off[both].mean() < 2e-3
    assert off[both].max() < 2e-2
    frame, truth = in_blocks(BLOCK).frame, scans()[2]
    # a seam would be an error of the strain across the faces between blocks that is larger than elsewhere
    for axis in range(3):
        error = np.diff(many - truth, axis=axis)
        known = np.isfinite(error).all(axis=-1) & inside(3.0)[tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))]
        cells = frame.cell_along(2 - axis)
        face = np.isin(np.arange(SIZE - 1), np.flatnonzero(np.diff(cells // 3)))
        across = np.broadcast_to(face.reshape(tuple(-1 if a == axis else 1 for a in range(3))), known.shape)
        at, elsewhere = (np.sqrt((error[known & which] ** 2).mean()) for which in (across, ~across))
        assert at < 1.3 * elsewhere


def test_a_mask_is_obeyed_and_inclusions_are_not_lost() -> None:
    a, b, _ = scans()
    half = inside(0.0) & (positions(a)[..., 0] < MIDDLE[0])
    mask = ChunkedVolume.of(a.with_values(half.astype(np.uint8)))
    found = correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(b), mask=mask, settings=SETTINGS, factor=2, edge=BLOCK)
    u, _, valid = VoxelField.of(found).in_box((slice(None),) * 3, mask.values)
    assert not valid[:, :, SIZE // 2 + 2 :].any()
    assert valid[half].mean() > 0.95
    assert np.linalg.norm((u - scans()[2])[valid], axis=-1).mean() < 0.1


class Keeping(InProcess):
    """Keeps copies of what was computed."""

    def __init__(self, a: ChunkedVolume, b: ChunkedVolume) -> None:
        super().__init__(a, b)
        self.there: dict[str, Any] = {}

    def kept(self, name: str, compute: Callable[[], Any]) -> Any:
        if name not in self.there:
            self.there[name] = deepcopy(compute())
        return deepcopy(self.there[name])


def test_an_interrupted_run_goes_on_to_the_same_result_where_the_object_shrinks_as_a_whole() -> None:
    """The ratio of volumes at which dilatation is not penalised was forgotten: it is found in the pass that adapts the weights."""
    grid = Volume.from_array(np.zeros((44,) * 3), spacing_mm=(1.0, 1.0, 1.0))
    grey, rng = texture(3, (5.0, 14.0), n=40), np.random.default_rng(5)
    x, middle = positions(grid), np.full(3, 21.5)

    def scan(at: Array, noise: Array) -> ChunkedVolume:
        depth = 17.0 - np.linalg.norm(at - middle, axis=-1)
        values = 50.0 + (100.0 + grey(at)) / (1.0 + np.exp(-3.0 * depth)) + 3.0 * noise
        return ChunkedVolume.of(grid.with_values(values.astype(np.float32)))

    pair = [scan(at, rng.standard_normal(grid.shape)) for at in (x, middle + (x - middle) / 0.9)]
    run = Keeping(*pair)
    straight = correlate_blocks(*pair, settings=SETTINGS, factor=2, edge=44, runner=run).result
    del run.there["covariance"]  # as of a run that was killed in the last pass
    resumed = correlate_blocks(*pair, settings=SETTINGS, factor=2, edge=44, runner=run).result
    np.testing.assert_array_equal(resumed.displacement.vectors, straight.displacement.vectors)
    np.testing.assert_allclose(resumed.covariance(), straight.covariance(), rtol=1e-5, atol=1e-12)


def test_volumes_that_do_not_fit_are_refused() -> None:
    a, b, _ = scans()
    shifted = Volume.from_array(b.values, spacing_mm=(1.0, 1.0, 1.1))
    with pytest.raises(InputError, match="different grids"):
        correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(shifted))
    with pytest.raises(InputError, match="node_spacing_mm"):
        correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(b), settings=CorrelationSettings(node_spacing_mm=3.0), factor=2)
    other = a.with_values(np.random.default_rng(0).permutation(a.values.ravel()).reshape(a.shape))
    with pytest.raises(InputError):
        correlate_blocks(ChunkedVolume.of(a), ChunkedVolume.of(other), settings=SETTINGS, factor=2)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_coarse_voxels_are_smooth_values_in_their_places(factor: int) -> None:
    values = np.random.default_rng(1).integers(0, 1000, (9, 14, 600)).astype(np.uint16)
    fine = ChunkedVolume.from_array(values, spacing_mm=(1.0, 0.5, 2.0), origin_mm=(3.0, 4.0, 5.0))
    coarse = thinned(fine, factor)
    smooth = ndimage.gaussian_filter(values.astype(float), 0.5 * factor, mode="nearest", radius=int(np.ceil(1.5 * factor)))
    every = (slice(None, None, factor),) * 3
    np.testing.assert_allclose(coarse.values, values if factor == 1 else smooth[every], rtol=1e-4)
    np.testing.assert_allclose(coarse.to_physical([1, 2, 3]), fine.grid.to_physical(factor * np.array([1.0, 2.0, 3.0])))
    n = [k // factor for k in values.shape]
    whole = values[: n[0] * factor, : n[1] * factor, : n[2] * factor].astype(float)
    means = whole.reshape(n[0], factor, n[1], factor, n[2], factor).mean(axis=(1, 3, 5))
    lazy = ThinnedValues(values, factor)
    assert lazy.shape == tuple(n)
    np.testing.assert_allclose(lazy[1:3, 0:2, 2:5], means[1:3, 0:2, 2:5], rtol=1e-5)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_slabs_of_either_volume_make_up_the_coarse_one(factor: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = [ChunkedVolume.from_array(np.random.default_rng(k).integers(0, 1000, (23, 14, 11)), spacing_mm=(1.0, 0.5, 2.0)) for k in (1, 2)]
    whole = [thinned(volume, factor) for volume in pair]
    monkeypatch.setattr(thinning, "TILE", (7, 5))
    slabs = thinning.slabs_of(pair[0].shape, factor)
    assert len(slabs) > 2
    for which in range(2):
        parts = [thinning.thinned_slab_of_pair(pair[0], pair[1], None, factor, (which, slab)) for slab in slabs]
        found = thinning.with_thinned_values(pair[which], factor, parts)
        np.testing.assert_array_equal(found.values, whole[which].values)
        assert found.same_grid(whole[which])


def test_the_coarse_volume_has_no_more_voxels_than_allowed() -> None:
    assert thinning_factor((100, 100, 100)) == 1
    for shape in ((160,) * 3, (512,) * 3, (1024, 900, 2000)):
        assert np.prod([n // thinning_factor(shape) for n in shape]) <= 2.6e6
    assert needed_memory_mb((512,) * 3) > 8 * needed_memory_mb((256,) * 3) - 8 * 300.0
