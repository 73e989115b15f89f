"""Chapter 6 of the 2008 report :cite:p:`hirai2008`: the micro force and moment sensor."""

from __future__ import annotations

from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.reproduction.chapter6.sensing_chip import SHARE, chip_sections
from naibu.viewer.chapter import Chapter


def chapter6(seed: int = 0, *, resolution: ChipResolution | None = None) -> Chapter:
    """Reproduce the sensing chip of chapter 6.

    Parameters
    ----------
    seed : int
        Of the noise.
    resolution : ChipResolution, optional
        Of the finite elements.
    """
    return Chapter(
        "ch6", "Chapter 6: a micro force and moment sensor", chip_sections(seed, resolution), {"seed": seed, "filter share r": SHARE}
    )
