"""Horn-Schunck and Lucas-Kanade: the fixed point of their equations, and known motions of sinusoids and textures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
from scenes import grid, inner, pair, texture
from scipy.sparse.linalg import spsolve

from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.optical_flow import AS_REPORTED, horn_schunck, lucas_kanade
from naibu.imaging.preprocessing.resampling import positions

Array = np.ndarray


def wave(frame: Volume, shift: Array, length_mm: float = 36.0) -> tuple[Volume, Volume]:
    """Return a sum of sinusoids along every axis of the frame, before and after a shift, mm."""
    x = positions(frame)
    axes = [a for a in range(3) if frame.shape[2 - a] > 1]

    def intensity(p: Array) -> Array:
        return 100.0 + sum(25.0 * np.sin(2 * np.pi * p[..., a] / length_mm + a) for a in axes)

    return frame.with_values(intensity(x)), frame.with_values(intensity(x - shift))


@pytest.mark.parametrize("shape", [(16, 20, 24), (1, 36, 40)])
def test_a_translating_sinusoid_is_followed(shape: tuple[int, int, int]) -> None:
    frame = grid(shape, (1.0, 1.0, 1.0))
    shift = np.array([0.4, -0.3, 0.2 if shape[0] > 1 else 0.0])
    before, after = wave(frame, shift)
    inside = inner(shape, 3)
    # wherever one slope vanishes its neighbours must help: the more steps, the further
    found = horn_schunck(before, after, data_weight=0.5, levels=1, warps=6, iterations=400)
    windows = lucas_kanade(before, after, window=(9, 9, 9), damping=1e-6, levels=1, warps=6, median_filter=False)
    for field in (found, windows):
        # interpolation between voxels lowers the crests by 0.4 %, where the slope that tells the motion is least
        error = np.abs(field.vectors[inside] - shift)
        assert error.mean() < 0.015 and np.percentile(error, 95) < 0.06
    if shape[0] == 1:
        assert (found.vectors[..., 2] == 0.0).all() and (windows.vectors[..., 2] == 0.0).all()


def test_the_method_of_the_report_solves_its_equations() -> None:
    """The plain steps converge to the solution of (3.52), (3.53) with the derivative in time that is missing in print."""
    rng = np.random.default_rng(3)
    frame = Volume.from_array(np.zeros((1, 9, 11)), spacing_mm=(1.0, 1.0, 1.0))
    a = 20.0 * rng.standard_normal(frame.shape)
    b = a + rng.standard_normal(frame.shape)
    options = AS_REPORTED | {"iterations": 20000, "full_scale": 256.0, "data_weight": 0.01}
    found = horn_schunck(frame.with_values(a), frame.with_values(b), **options)
    ny, nx = 9, 11
    gy, gx = np.gradient(0.5 * (a + b)[0])
    gt = (b - a)[0]
    number = np.arange(ny * nx).reshape(ny, nx)
    mean = sp.lil_matrix((ny * nx, ny * nx))
    for y in range(ny):
        for x in range(nx):
            for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                mean[number[y, x], number[min(max(y + dy, 0), ny - 1), min(max(x + dx, 0), nx - 1)]] += 0.25
    one, weight = sp.eye(ny * nx), 0.01
    dx, dy, dt = (sp.diags(g.ravel()) for g in (gx, gy, gt))
    system = sp.bmat([[one - mean + weight * dx @ dx, weight * dx @ dy], [weight * dx @ dy, one - mean + weight * dy @ dy]]).tocsr()
    right = -weight * np.concatenate([dx @ dt.diagonal(), dy @ dt.diagonal()])
    exact = spsolve(system, right).reshape(2, ny, nx)
    np.testing.assert_allclose(found.vectors[0, :, :, 0], exact[0], atol=2e-4)
    np.testing.assert_allclose(found.vectors[0, :, :, 1], exact[1], atol=2e-4)


def test_chebyshevs_sequence_reaches_the_same_in_fewer_steps() -> None:
    frame = grid((10, 20, 24))
    before, after, _ = pair(frame, lambda x: np.broadcast_to([0.3, 0.2, -0.1], x.shape), wave_mm=(8.0, 16.0))
    options = {"data_weight": 0.02, "levels": 1, "warps": 1, "median_filter": False}
    final = horn_schunck(before, after, iterations=4000, **options).vectors
    plain, fast = (
        np.abs(horn_schunck(before, after, iterations=40, accelerated=a, **options).vectors - final).max() for a in (False, True)
    )
    assert fast < 0.1 * plain


def bend(x: Array) -> Array:
    return np.stack([3.0 + 1.5 * np.sin(x[..., 1] / 14.0), -2.0 + 1.5 * np.cos(x[..., 0] / 12.0), 1.0 + 0.02 * (x[..., 0] - 20.0)], axis=-1)


@pytest.mark.parametrize("method", ["horn_schunck", "lucas_kanade"])
def test_motions_of_several_voxels_are_found_from_coarse_to_fine(method: str) -> None:
    frame = grid((28, 48, 52), (1.0, 1.0, 1.3), rotation_matrix(np.array([0.05, -0.03, 0.2])))
    before, after, truth = pair(frame, lambda x: bend(x) + np.array([4.0, -3.0, 1.0]), seed=5, wave_mm=(6.0, 40.0), noise=3.0)
    solve = {"horn_schunck": horn_schunck, "lucas_kanade": lucas_kanade}[method]
    options = {"data_weight": 0.01} if method == "horn_schunck" else {"damping": 0.05}
    found, single = solve(before, after, **options), solve(before, after, levels=1, **options)
    inside = inner(frame.shape, 6)
    error, naive = (np.linalg.norm((f.vectors - truth)[inside], axis=-1).mean() for f in (found, single))
    assert error < 0.25
    assert error < 0.5 * naive


def test_a_good_start_is_kept() -> None:
    frame = grid((20, 30, 34), (1.0, 0.9, 1.2))
    before, after, truth = pair(frame, lambda x: bend(x) + np.array([4.0, 0.0, 0.0]), seed=7, wave_mm=(8.0, 16.0))
    inside = inner(frame.shape, 6)
    for solve in (horn_schunck, lucas_kanade):
        found = solve(before, after, start=truth, levels=1)
        assert np.linalg.norm((found.vectors - truth)[inside], axis=-1).mean() < 0.2
        coarse = solve(before, after, start=truth, levels=2)
        assert np.linalg.norm((coarse.vectors - truth)[inside], axis=-1).mean() < 0.3


def test_what_leaves_the_volume_and_what_is_masked_is_not_valid() -> None:
    frame = grid((10, 24, 30))
    before, after, _ = pair(frame, lambda x: np.broadcast_to([3.0, 0.0, 0.0], x.shape), wave_mm=(8.0, 20.0))
    mask = np.ones(frame.shape, dtype=bool)
    mask[:3] = False
    found = horn_schunck(before, after, data_weight=0.05, mask=mask, warps=5)
    assert not found.valid[:3].any()
    assert not found.valid[:, :, -2:].any() and found.valid[5, 8:16, 8:20].all()
    unknown = after.with_values(np.where(np.arange(30) > 20, np.nan, after.values))
    hidden = horn_schunck(before, unknown, data_weight=0.05, warps=5)
    assert not hidden.valid[:, :, 19:].any() and hidden.valid[5, 8:16, 6:14].all()
    # a false edge there would draw the field towards it
    assert np.abs(hidden.vectors[3:7, 6:18, 6:16, 0] - 3.0).max() < 0.5


def test_windows_on_one_edge_are_not_valid() -> None:
    frame = grid((1, 24, 30))
    stripes = frame.with_values(50.0 * np.sin(positions(frame)[..., 0]))
    spots = frame.with_values(texture(2, (5.0, 9.0))(positions(frame)))
    assert not lucas_kanade(stripes, stripes, least_eigenvalue=1.0).valid.any()
    assert lucas_kanade(spots, spots, least_eigenvalue=1.0).valid.mean() > 0.5


def test_bad_options_are_refused() -> None:
    frame = grid((6, 14, 16))
    volume = frame.with_values(texture()(positions(frame)))
    for solve, options, message in (
        (horn_schunck, {"iterations": 0}, "iterations must be 1"),
        (horn_schunck, {"data_weight": 0.0}, "positive"),
        (lucas_kanade, {"window": (4, 3, 3)}, "odd"),
        (lucas_kanade, {"damping": -1.0}, "damping"),
        (lucas_kanade, {"levels": 0}, "levels must be 1"),
        (horn_schunck, {"start": np.full((*frame.shape, 3), np.nan)}, "without displacement"),
        (horn_schunck, {"start": np.zeros((2, 2, 2, 3))}, "must have shape"),
        (horn_schunck, {"mask": np.zeros(frame.shape)}, "empty"),
    ):
        with pytest.raises(InputError, match=message):
            solve(volume, volume, **options)
    with pytest.raises(InputError, match="constant"):
        horn_schunck(volume, frame)


@pytest.mark.parametrize("solve", [horn_schunck, lucas_kanade])
def test_every_grid_is_reported(solve: Callable[..., object]) -> None:
    frame = grid((12, 40, 40))
    volume = frame.with_values(texture()(positions(frame)))
    reports: list[ProgressReport] = []
    solve(volume, volume, levels=2, progress=reports.append)
    assert [(r.done, r.total) for r in reports] == [(0, 2), (1, 2), (2, 2)]
    assert len({r.stage for r in reports}) == 1
