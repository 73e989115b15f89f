"""Settings of volume correlation are checked by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.imaging.volume_correlation.settings import CorrelationSettings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("node_spacing_mm", 0.0),
        ("node_spacing_mm", np.nan),
        ("cells_along", -1.0),
        ("voxels_per_cell", 0.0),
        ("robust", 0.0),
        ("robust", np.nan),
        ("gain_cell", np.inf),
        ("dilatation_weight", 0.0),
        ("bending_weight", -64.0),
        ("gradients", "both"),
        ("samples", 7),
        ("jitter_sd_voxels", -0.1),
        ("jitter_sd_voxels", np.inf),
        ("smoothing_voxels", np.nan),
        ("seed", -1),
    ],
)
def test_a_setting_out_of_range_is_named(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"^{name} must be .*, not "):
        CorrelationSettings(**{name: value})


def test_least_squares_and_no_smoothing_are_allowed() -> None:
    CorrelationSettings(robust=np.inf, smoothing_voxels=0.0, jitter_sd_voxels=0.0, node_spacing_mm=4.0, samples=8, seed=0)
