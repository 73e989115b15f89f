"""The report's own indices of misfit, S_shape and S_force :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.identification.lattice_calibration.captured.shape_distance import closest_points, force_difference
from naibu.identification.lattice_calibration.forward_model import SAMPLE_S, Capture, PushedLattice, Reproduced
from naibu.mechanics.lattices.model.lattice import LatticeParameters


@dataclass(frozen=True, slots=True)
class ReportIndices:
    """Misfit measures of the report for one load case.

    Attributes
    ----------
    shape_mm : tuple of float
        S_shape at every capture, mm.
    points : tuple of int
        Captured points.
    large : tuple of int
        Points that are 2.5 mm or more away.
    force_mn : float
        S_force over the samples while the indenters keep still, mN, sum over the sensors.
    samples : int
        Their number, for one sensor.
    """

    shape_mm: tuple[float, ...]
    points: tuple[int, ...]
    large: tuple[int, ...]
    force_mn: float
    samples: int


def indices(capture: Capture, pushed: PushedLattice, parameters: LatticeParameters, *, large_mm: float = 2.5) -> ReportIndices:
    """Return S_shape and S_force of a lattice against a capture; distances below the sensor's error are not counted in S_shape."""
    return indices_of(capture, pushed, pushed.run(parameters), large_mm=large_mm)


def indices_of(capture: Capture, pushed: PushedLattice, found: Reproduced, *, large_mm: float = 2.5) -> ReportIndices:
    """Return S_shape and S_force of a motion that was computed, as `indices`."""
    since = round(capture.pushing.push_s / SAMPLE_S)
    repeated = np.repeat(found.force, round(pushed.long_step / SAMPLE_S), axis=0)
    distances = [np.abs(closest_points(p, pushed.hull, x).signed) for p, x in zip(capture.points, found.positions, strict=True)]
    shape = tuple(float(d[d >= capture.point_sd_mm].sum()) for d in distances)
    large = tuple(int((d >= large_mm).sum()) for d in distances)
    force, _ = force_difference(capture.force[since:], repeated[since:])
    return ReportIndices(shape, tuple(len(d) for d in distances), large, force, len(repeated) - since)
