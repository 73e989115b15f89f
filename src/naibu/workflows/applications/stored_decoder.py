"""A decoder of a fingertip from the file that a simulation of it wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from naibu.applications.fingertip.decoder import ForceDecoder
from naibu.applications.fingertip.slip import SlipDetector
from naibu.io.study_schemas.fingertip_schema import load_decoder


def stored_detector(path: Path) -> SlipDetector:
    """Return the detector of slip of ``NAME-decoder.json``, with its decoder.

    Raises
    ------
    InputError
        No such file, no decoder, or values that cannot be.
    """
    stored = load_decoder(path)
    decoder = ForceDecoder(
        stored.radius_mm, np.array(stored.volts_per_load), np.array(stored.noise), np.array(stored.coefficients), np.array(stored.unit),
        np.array(stored.spread), np.array(stored.limits), stored.model_error,
    )  # fmt: skip
    slip = stored.slip
    return SlipDetector(decoder, np.array(slip.coefficients), slip.spread, slip.sensitivity_mm, slip.sensitivity_error)
