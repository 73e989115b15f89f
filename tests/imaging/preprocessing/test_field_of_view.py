"""Padding of scans is found, and background is not taken for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.field_of_view import fields_of_view, in_box

SHAPE = (12, 14, 16)
WHOLE = tuple(slice(0, n) for n in SHAPE)


def noisy(seed: int) -> Volume:
    return Volume.from_array(100.0 + np.random.default_rng(seed).standard_normal(SHAPE), spacing_mm=(1.0, 1.0, 1.0))


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=3, max_size=3), st.sampled_from([0.0, np.nan, 777.0]))
def test_padded_planes_are_cut_off_exactly(counts: list[tuple[int, int]], fill: float) -> None:
    scan = noisy(1)
    box = tuple(slice(a, n - b) for (a, b), n in zip(counts, SHAPE, strict=True))
    values = np.where(in_box(box, SHAPE), scan.values, fill)
    assert fields_of_view(noisy(2), scan.with_values(values)) == (WHOLE, box)
    assert fields_of_view(scan.with_values(values), noisy(2)) == (box, WHOLE)


def block(low: tuple[int, int, int], high: tuple[int, int, int]) -> Volume:
    """A block in air of intensity zero, without noise."""
    values = np.zeros(SHAPE)
    values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = 100.0
    return Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0))


def ball(lost: int = 0, noise: float = 0.0, fill: float = 0.0) -> Volume:
    """A ball in air of intensity zero, of which the last planes are lost."""
    grid = np.stack(np.meshgrid(*(np.arange(24) - 11.5,) * 3, indexing="ij"))
    values = np.where((grid**2).sum(axis=0) < 81.0, 100.0, 0.0) + noise * np.random.default_rng(lost).standard_normal((24,) * 3)
    if lost:
        values[24 - lost :] = fill
    return Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0))


def test_a_background_without_noise_is_no_padding() -> None:
    """A block that is compressed and grows sideways: the planes of air grow, and nothing is missing."""
    assert fields_of_view(block((2, 3, 3), (9, 11, 13)), block((2, 2, 2), (7, 12, 14))) == (WHOLE, WHOLE)
    assert fields_of_view(ball(), ball()) == ((slice(0, 24),) * 3,) * 2


def test_padding_in_the_intensity_of_air_is_found_where_it_cuts_the_object() -> None:
    whole = (slice(0, 24),) * 3
    for lost in (6, 8):
        cut = (slice(0, 24 - lost), *whole[1:])
        assert fields_of_view(ball(), ball(lost)) == (whole, cut)
        assert fields_of_view(ball(lost), ball()) == (cut, whole)
    # a block that loses three of seven planes, its other ends being as abrupt
    assert fields_of_view(block((2, 3, 3), (9, 11, 13)), block((2, 3, 3), (6, 11, 13))) == (WHOLE, (slice(2, 6), *WHOLE[1:]))
    # an object that goes on up to the face of the other scan
    assert fields_of_view(block((0, 3, 3), (12, 11, 13)), block((0, 3, 3), (9, 11, 13))) == (WHOLE, (slice(0, 9), *WHOLE[1:]))


def test_both_scans_may_be_padded_alike() -> None:
    """Air has noise, which the padding has not; and so has the inside of an object that was shifted out of both scans."""
    cut = (slice(0, 22), slice(0, 24), slice(0, 24))
    assert fields_of_view(ball(2, noise=3.0), ball(2, noise=4.0)) == (cut, cut)
    inside = [np.array(noisy(k).values) for k in (1, 2)]
    for values in inside:
        values[:3] = 0.0
    assert fields_of_view(*(noisy(1).with_values(v) for v in inside)) == ((slice(3, 12), *WHOLE[1:]),) * 2


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_scan_of_nothing_keeps_its_box(value: float) -> None:
    assert fields_of_view(noisy(1), noisy(1).with_values(np.full(SHAPE, value))) == (WHOLE, WHOLE)
