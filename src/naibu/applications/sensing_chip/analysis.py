"""All that is computed of one chip: closed forms, beams between rigid parts, and the whole chip, with their sensitivities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.sensing_chip.bridge import closed_form_sensitivities, sensitivity_matrix
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import ChipDesign
from naibu.applications.sensing_chip.finite_elements import ChipResponse, solve_chip
from naibu.core.arrays import FloatArray
from naibu.core.progress import Progress, report_progress

BEAMS_RESOLUTION = ChipResolution(along=12, across=2, through=3)


@dataclass(frozen=True, slots=True, eq=False)
class ChipAnalysis:
    """A chip by closed forms and by finite elements.

    Attributes
    ----------
    design : ChipDesign
        The chip.
    beams, whole : ChipResponse
        Beams between a rigid block and rigid clamps, and the whole elastic chip.
    closed : ndarray, shape (3,)
        Sensitivities of the closed forms, mV/mN and mV/(N um).
    of_beams, of_whole, misaligned : ndarray, shape (3, 6)
        Sensitivities of the bridges to all loads, mV/mN and mV/(N um); the last of the whole chip with a shifted mask.
    shift_mm : tuple of float
        That shift along x and y, mm.
    """

    design: ChipDesign
    beams: ChipResponse
    whole: ChipResponse
    closed: FloatArray
    of_beams: FloatArray
    of_whole: FloatArray
    misaligned: FloatArray
    shift_mm: tuple[float, float]

    @property
    def sensitivities(self) -> FloatArray:
        """Sensitivity of every bridge to its own load (3,), of the whole chip, mV/mN and mV/(N um)."""
        return np.asarray(self.of_whole[[0, 1, 2], [2, 3, 4]])


def analysed_chip(
    design: ChipDesign,
    resolution: ChipResolution | None = None,
    *,
    shift_mm: tuple[float, float] = (0.002, 0.002),
    progress: Progress | None = None,
) -> ChipAnalysis:
    """Compute a chip by all models.

    Parameters
    ----------
    design : ChipDesign
        The chip.
    resolution : ChipResolution, optional
        Of the whole chip's mesh, and along, across and through the beams alone, where it is given.
    shift_mm : tuple of float
        Misalignment of the resistors' mask, mm.
    progress : callable, optional
        Called with a `ProgressReport` before either solution.
    """
    report_progress(progress, "beams between rigid parts", done=0, total=2)
    beams = solve_chip(design, resolution or BEAMS_RESOLUTION, whole=False)
    report_progress(progress, "whole chip", done=1, total=2)
    whole = solve_chip(design, resolution)
    return ChipAnalysis(
        design, beams, whole, closed_form_sensitivities(design),
        sensitivity_matrix(beams), sensitivity_matrix(whole), sensitivity_matrix(whole, shift_mm=shift_mm), shift_mm,
    )  # fmt: skip
