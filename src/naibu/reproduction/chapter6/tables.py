"""Chapter 6 of the 2008 report :cite:p:`hirai2008`: the micro force and moment sensor, and the soft fingertip around it."""

from __future__ import annotations

from naibu.applications.fingertip.fingertip import FingertipResolution
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.sensing_chip.analysis import analysed_chip
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import assumed_chip
from naibu.applications.sensing_chip.electronics import report_readout
from naibu.reproduction.chapter6.fingertip import fingertip_sections
from naibu.reproduction.chapter6.sensing_chip import SHARE, chip_sections
from naibu.viewer.chapters.chapter import Chapter


def chapter6(
    seed: int = 0, *, resolution: ChipResolution | None = None, fingertip_resolution: FingertipResolution | None = None
) -> Chapter:
    """Reproduce the sensing chip and the fingertip of chapter 6.

    Parameters
    ----------
    seed : int
        Of the noise.
    resolution : ChipResolution, optional
        Of the chip's finite elements.
    fingertip_resolution : FingertipResolution, optional
        Of the fingertip's.
    """
    analysis = analysed_chip(assumed_chip(), resolution)
    chain = ReadingChain(analysis.of_whole, report_readout())
    sections = (*chip_sections(analysis, seed), *fingertip_sections(chain, seed, fingertip_resolution))
    title = "Chapter 6: a micro force and moment sensor, and a soft fingertip"
    return Chapter("ch6", title, sections, {"seed": seed, "filter share r": SHARE})
