"""Virtual ultrasound: speckle has the statistics of Rayleigh and Goodman and moves with the material; markers, ghosts, noise, levels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest, rayleigh

from naibu.core.errors import InputError
from naibu.validation.scanners.ct_mr import MarkerKind, VirtualObject, empty_grid
from naibu.validation.scanners.motions import FormulaMotion, Still
from naibu.validation.scanners.ultrasound import Ghost, Scatterers, UltrasoundDevice, ultrasound, ultrasound_sequence

LINEAR = UltrasoundDevice(spread_mm=(0.5, 0.25, 0.8), noise=0.0, range_db=None)
BEAD = MarkerKind(2.0, intensity=30.0)


def even(level: float = 1.0):
    return lambda x: np.full(len(x), level)


def image(low: float, high: float, pixel: float = 0.25):
    """Return the grid of an image of one slice at z = 0, rows at one depth."""
    grid = empty_grid([low, low, -0.5], [high, high, 0.5], (pixel, pixel, 3.0))
    assert grid.shape[0] == 1
    return type(grid).from_array(grid.values, spacing_mm=grid.spacing_mm, origin_mm=(low, low, 0.0))


def none_of(kind: MarkerKind = BEAD) -> VirtualObject:
    return VirtualObject.of(even(), np.zeros((0, 3)), kind)


@pytest.fixture(scope="module")
def speckle() -> Scatterers:
    return Scatterers.drawn(even(2.0), [-4, -4, -3], [44, 44, 3], per_mm3=40.0 / LINEAR.cell_mm3, seed=1)


def test_speckle_has_rayleighs_distribution_and_the_strength_asked_for(speckle: Scatterers) -> None:
    shown = ultrasound(none_of(), speckle, Still(), image(0, 40), LINEAR, seed=0).volume.values[0].astype(float)
    # independent cells of 2 pi times the deviations; bounds are five standard errors
    cells = 40.0**2 / (2.0 * np.pi * 0.5 * 0.25)
    assert np.sqrt(np.mean(shown**2)) == pytest.approx(2.0, rel=5.0 * 0.5 / np.sqrt(cells))
    # mean over deviation of Rayleigh's distribution: sqrt(pi / (4 - pi)) = 1.913
    assert shown.mean() / shown.std() == pytest.approx(np.sqrt(np.pi / (4.0 - np.pi)), rel=5.0 * 0.9 / np.sqrt(cells))
    # pixels four deviations apart are nearly independent
    apart = shown[::4, ::8].ravel()
    assert kstest(apart, rayleigh(scale=2.0 / np.sqrt(2.0)).cdf).pvalue > 0.01


def test_speckle_is_as_large_as_the_echo_of_a_point(speckle: Scatterers) -> None:
    """The covariance of intensities is exp(-d^2 / (2 s^2)), s the deviation of a point's amplitude (Goodman)."""
    shown = ultrasound(none_of(), speckle, Still(), image(0, 40), LINEAR, seed=0).volume.values[0].astype(float) ** 2
    extra = shown - shown.mean()
    for axis, spread in ((1, 0.5), (0, 0.25)):
        for step in (1, 2):
            a, b = np.delete(extra, slice(0, step), axis), np.delete(extra, slice(-step, None), axis)
            expected = np.exp(-((0.25 * step) ** 2) / (2.0 * spread**2))
            assert (a * b).mean() / extra.var() == pytest.approx(expected, abs=0.08)


@given(st.integers(-6, 6), st.integers(-6, 6))
@settings(max_examples=6, deadline=None)
def test_speckle_moves_with_the_material(dx: int, dy: int) -> None:
    seen = Scatterers.drawn(even(), [-3, -3, -2], [13, 13, 2], per_mm3=20.0, seed=3)
    shift = 0.25 * np.array([dx, dy, 0.0])
    moved = FormulaMotion(lambda x: x + shift)
    first, second = (ultrasound(none_of(), seen, m, image(0, 10), LINEAR, seed=0).volume.values[0] for m in (Still(), moved))
    inner = slice(8, -8)
    np.testing.assert_allclose(np.roll(first, (dy, dx), (0, 1))[inner, inner], second[inner, inner], rtol=1e-4, atol=1e-5)


def test_speckle_decorrelates_as_the_material_is_compressed() -> None:
    seen = Scatterers.drawn(even(), [-3, -3, -2], [23, 23, 2], per_mm3=20.0, seed=3)
    grid = image(0, 20)
    rest = ultrasound(none_of(), seen, Still(), grid, LINEAR, seed=0).volume.values[0].ravel()
    like = []
    for strain in (0.0, 0.002, 0.01, 0.05):
        pressed = FormulaMotion(lambda x, e=strain: x * [1.0, 1.0 - e, 1.0])
        like.append(np.corrcoef(rest, ultrasound(none_of(), seen, pressed, grid, LINEAR, seed=0).volume.values[0].ravel())[0, 1])
    assert like[0] == pytest.approx(1.0) and (np.diff(like) < 0.0).all() and like[-1] < 0.3


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
@settings(max_examples=10, deadline=None)
def test_a_marker_is_a_gaussian_where_it_truly_lies(dx: float, dy: float) -> None:
    place = np.array([10.0 + dx, 10.0 + dy, 0.0])
    quiet = Scatterers.drawn(even(1e-9), [0, 0, -1], [20, 20, 1], per_mm3=1.0, seed=0)
    found = ultrasound(VirtualObject.of(even(), [place], BEAD), quiet, Still(), image(0, 20), LINEAR, seed=0)
    shown = found.volume.values[0].astype(float)
    y, x = 0.25 * np.indices(shown.shape)
    assert (shown * x).sum() / shown.sum() == pytest.approx(place[0], abs=0.02 * 0.25)
    assert (shown * y).sum() / shown.sum() == pytest.approx(place[1], abs=0.02 * 0.25)
    expected = 30.0 * np.exp(-0.5 * (((x - place[0]) / 0.5) ** 2 + ((y - place[1]) / 0.25) ** 2))
    near = (np.abs(x - place[0]) < 1.4) & (np.abs(y - place[1]) < 0.7)
    np.testing.assert_allclose(shown[near], expected[near], rtol=1e-4)
    np.testing.assert_allclose(found.markers.points, [place])


def test_ghosts_stand_where_they_are_sent_and_are_no_markers() -> None:
    device = UltrasoundDevice(noise=0.0, range_db=None, ghosts=(Ghost((0.0, -6.0, 0.0), 0.4), Ghost((1.0, -9.0, 0.0), 0.2)))
    quiet = Scatterers.drawn(even(1e-9), [0, 0, -1], [20, 20, 1], per_mm3=1.0, seed=0)
    found = ultrasound(VirtualObject.of(even(), [[10.0, 14.0, 0.0]], BEAD), quiet, Still(), image(0, 20), device, seed=0)
    shown = found.volume.values[0]
    for (x, y), level in (((10, 14), 30.0), ((10, 8), 12.0), ((11, 5), 6.0), ((10, 11), 0.0)):
        assert shown[4 * y, 4 * x] == pytest.approx(level, rel=1e-4, abs=1e-3)
    assert len(found.markers) == 1


def test_amplitudes_are_compressed_to_intensity_levels() -> None:
    device = UltrasoundDevice(noise=0.0, range_db=40.0, white=30.0)
    quiet = Scatterers.drawn(even(1e-9), [0, 0, -1], [20, 20, 1], per_mm3=1.0, seed=0)
    markers = VirtualObject.of(even(), [[10.0, 14.0, 0.0]], BEAD)
    shown = ultrasound(markers, quiet, Still(), image(0, 20), device, seed=0).volume.values
    assert shown.dtype == np.uint8 and shown[0, 56, 40] == 255 and shown[0, 10, 10] == 0
    # one deviation beside the middle the amplitude is 20 log10(exp(-1/2)) = -4.34 dB down; .5 mm aside with .45 mm it is 5.36 dB
    assert shown[0, 56, 42] == round(255 * (1 - 20 * 0.5 * (0.5 / 0.45) ** 2 / np.log(10) / 40))


def test_the_receiver_adds_noise_of_the_strength_asked_for() -> None:
    device = UltrasoundDevice(noise=0.3, range_db=None)
    quiet = Scatterers.drawn(even(1e-9), [0, 0, -1], [20, 20, 1], per_mm3=1.0, seed=0)
    shown = [ultrasound(none_of(), quiet, Still(), image(0, 40), device, seed=s).volume.values.ravel() for s in (0, 0, 1)]
    assert np.sqrt(np.mean(shown[0] ** 2)) == pytest.approx(0.3, rel=5 / np.sqrt(shown[0].size))
    assert kstest(shown[0], rayleigh(scale=0.3 / np.sqrt(2)).cdf).pvalue > 0.01
    np.testing.assert_array_equal(shown[0], shown[1])
    assert (shown[0] != shown[2]).all()


def test_regions_without_scatterers_stay_dark_and_frames_differ_by_motion() -> None:
    cyst = lambda x: np.where(np.hypot(x[:, 0] - 10, x[:, 1] - 10) < 4.0, 0.0, 1.0)  # noqa: E731
    seen = Scatterers.drawn(cyst, [-3, -3, -2], [23, 23, 2], per_mm3=20.0, seed=3)
    lowered = FormulaMotion(lambda x: x + np.array([0.0, 3.0, 0.0]))
    body = VirtualObject.of(even(), [[4.0, 4.0, 0.0], [4.0, 4.0, 9.0], [40.0, 4.0, 0.0]], BEAD)
    frames = list(ultrasound_sequence(body, seen, [Still(), lowered], image(0, 20), LINEAR, seed=5))
    for frame, depth in zip(frames, (40, 52), strict=True):
        shown = frame.volume.values[0]
        assert shown[depth - 6 : depth + 7, 34:47].mean() < 0.05 and shown[depth - 6 : depth + 7, :15].mean() > 0.5
        # one marker lies behind the plane, one beside the image
        np.testing.assert_array_equal(frame.markers.ids, [1])
    np.testing.assert_allclose(frames[1].markers.points - frames[0].markers.points, [[0, 3, 0]])


def test_volumes_of_ultrasound_have_three_axes_of_speckle() -> None:
    device = UltrasoundDevice(spread_mm=(0.5, 0.3, 0.5), noise=0.0, range_db=None)
    grid = empty_grid([0, 0, 0], [10, 10, 10], 0.5)
    seen = Scatterers.drawn(even(), [-2, -2, -2], [12, 12, 12], per_mm3=15.0 / device.cell_mm3, seed=0)
    found = ultrasound(VirtualObject.of(even(), [[5.0, 5.0, 5.0]], MarkerKind(2.0, intensity=40.0)), seen, Still(), grid, device, seed=0)
    assert found.volume.values[10, 10, 10] == pytest.approx(40.0, rel=0.1)
    far = found.volume.values[::4, :4, ::4]
    assert far.mean() / far.std() == pytest.approx(1.913, rel=0.25)


def test_nonsense_is_refused() -> None:
    for work, message in (
        (lambda: UltrasoundDevice(frequency_mhz=0.0), "positive numbers"),
        (lambda: UltrasoundDevice(beam=3), "axis 0, 1 or 2"),
        (lambda: Scatterers.drawn(even(), [0, 0, 0], [1, 1, -1], per_mm3=1.0, seed=0), "low < high"),
        (lambda: Scatterers.drawn(even(0.0), [0, 0, 0], [9, 9, 9], per_mm3=1.0, seed=0), "no scatterer"),
    ):
        with pytest.raises(InputError, match=message):
            work()
