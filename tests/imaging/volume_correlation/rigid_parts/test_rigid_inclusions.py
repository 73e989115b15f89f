"""Texture and noise enclose regions by chance: they are no rigid inclusions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from naibu.imaging.volume_correlation.correlate import DEFAULT, Correlation
from naibu.imaging.volume_correlation.rigid_parts.rigid_inclusions import FALSE, fits_better
from naibu.validation.specimens.intruded_body import intruded_body
from naibu.validation.specimens.swollen_body import swollen_body


@pytest.mark.parametrize("bends", [False, True])
def test_noisy_texture_has_no_rigid_inclusion(bends: bool) -> None:
    """Each of them had one, of 3 cells, whose motion fitted as well as the field, no more."""
    body = intruded_body([], seed=1, noise=20.0) if bends else swollen_body([], seed=1, noise=20.0)
    correlation = Correlation(body.before, body.after, (body.mask, None), DEFAULT, None)
    correlation.initialize()
    correlation.refine()
    correlation.find_inclusions(None)
    assert not correlation.inclusions


def test_chance_hardly_ever_fits_better_and_a_better_motion_does() -> None:
    """Squares of white noise that was smoothed as the volumes are; of two such residuals neither is better."""
    rng, false, found, trials = np.random.default_rng(0), 0, 0, 5
    for _ in range(400):
        one, other = (ndimage.gaussian_filter(rng.standard_normal((16, 16, 16)), 0.8)[3:-3, 3:-3, 3:-3].ravel() for _ in range(2))
        square = float(np.mean(other**2))
        false += fits_better((one**2 - other**2) / square, trials)
        found += fits_better((0.3 * one**2 - other**2) / square, trials)
    assert false / 400 < 5.0 * FALSE
    assert found / 400 > 0.7
