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


def test_a_background_without_noise_is_no_padding() -> None:
    """A block in air of intensity zero that is compressed: the planes of air grow, and nothing is missing."""
    pair = []
    for top in (9, 7):
        values = np.zeros(SHAPE)
        values[2:top, 3:11, 3:13] = 100.0
        pair.append(Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0)))
    assert fields_of_view(*pair) == (WHOLE, WHOLE)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_scan_of_nothing_keeps_its_box(value: float) -> None:
    assert fields_of_view(noisy(1), noisy(1).with_values(np.full(SHAPE, value))) == (WHOLE, WHOLE)
