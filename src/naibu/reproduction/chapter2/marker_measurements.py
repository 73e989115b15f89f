"""Marker displacements measured in agar by ultrasound and MR, Tables 2.1 and 2.2 of the 2008 report :cite:p:`hirai2008`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu import datasets
from naibu.core.arrays import BoolArray, FloatArray, IntArray

TRIALS = ("trial1", "trial2")
MARKER_HEIGHT_MM = 20.0  # 10 mm below the top of a block of 30 mm
MR_MIDDLE_MM, MR_BASE_MM = 25.0, 4.0  # position of the block in the axes of Table 2.2: assumed


@dataclass(frozen=True, slots=True, eq=False)
class MarkerMeasurement:
    """Marker numbers (k,), initial positions (k, 2) in the axes of the block, mm, and displacements (k, 2), mm, in one plane."""

    ids: IntArray
    start: FloatArray
    displacement: FloatArray


def ultrasound_trial(name: str) -> MarkerMeasurement:
    """Return the ultrasound measurement of a trial, ``"trial1"`` or ``"trial2"`` (Table 2.1)."""
    experiment = datasets.load("us_agar")
    before, after = experiment.state(f"{name}_initial").markers, experiment.state(f"{name}_deformed").markers
    assert before is not None and after is not None  # both are bundled
    start = before.points[:, :2]
    return MarkerMeasurement(before.ids, start + np.array([0.0, MARKER_HEIGHT_MM]), after.aligned(before.ids)[:, :2] - start)


def magnetic_resonance_measurement(state: str = "deformed") -> tuple[MarkerMeasurement, BoolArray]:
    """Return the MR measurement of a state of Table 2.2, in the cross-section under the bar, and which markers are trusted (k,)."""
    experiment = datasets.load("mr_agar")
    before, after = experiment.initial, experiment.state(state).markers
    assert after is not None  # it is bundled
    start = before.points[:, :2] - np.array([MR_MIDDLE_MM, MR_BASE_MM])
    return MarkerMeasurement(before.ids, start, after.points[:, :2] - before.points[:, :2]), after.trusted & before.trusted
