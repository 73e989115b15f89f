"""Chapter 3 of the report: nonuniform elasticity from inner deformation, in simulation and from measured markers (spec I1 to I5)."""

from __future__ import annotations

from naibu.core.errors import InputError
from naibu.reproduction.chapter3.cubes import layer_section, reach_section, uniform_section
from naibu.reproduction.chapter3.design_study import design_section
from naibu.reproduction.chapter3.experiment import MARKER_SD_MM, experiment_section
from naibu.reproduction.chapter3.material_tests import table_3_4, table_3_5
from naibu.reproduction.chapter3.noise import NOISE_MM, noise_section
from naibu.reproduction.chapter3.square import square_section
from naibu.viewer.chapter import Chapter, Section


def chapter3(seed: int = 0, *, draws: int = 20) -> Chapter:
    """Reproduce chapter 3, but for what it measures in images (3.5): that needs the calf of chapter 1 and stands there.

    Parameters
    ----------
    seed : int
        Of all noise.
    draws : int
        Of noise, for medians and standard deviations; at least 2.

    Raises
    ------
    InputError
        Fewer than two draws.
    """
    if draws < 2:
        raise InputError(f"scatter needs at least 2 draws of noise, not {draws}")
    sections = (
        square_section(seed, draws),
        uniform_section(),
        layer_section(),
        reach_section(),
        noise_section(seed, draws),
        table_3_4(),
        table_3_5(),
        _images_section(),
        experiment_section(),
        design_section(draws=draws, seed=seed),
    )
    settings = {"seed": seed, "draws": draws, "noise_mm": NOISE_MM, "marker_sd_mm": MARKER_SD_MM}
    return Chapter("ch3", "Chapter 3: nonuniform elasticity from inner deformation", sections, {**settings})


def _images_section() -> Section:
    text = "Block matching, Horn-Schunck, Lucas-Kanade and their hybrid on MR images of a calf stand in chapter 1: naibu reproduce ch1."
    return Section("Inner deformation from MR images (3.5)", (text,))
