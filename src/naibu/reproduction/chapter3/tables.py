"""Chapter 3 of the 2008 report :cite:p:`hirai2008`: non-uniform elasticity from internal deformation, simulated and measured."""

from __future__ import annotations

from naibu.core.errors import InputError
from naibu.reproduction.chapter3.ct_images import images_of_markers
from naibu.reproduction.chapter3.cubes import identifiability_section, layer_section, uniform_section
from naibu.reproduction.chapter3.design_study import design_section
from naibu.reproduction.chapter3.experiment import MARKER_SD_MM, experiment_section
from naibu.reproduction.chapter3.material_tests import table_3_4, table_3_5
from naibu.reproduction.chapter3.noise import NOISE_MM, noise_section
from naibu.reproduction.chapter3.square import square_section
from naibu.viewer.chapters.chapter import Chapter, Section


def chapter3(seed: int = 0, *, draws: int = 20) -> Chapter:
    """Reproduce chapter 3, except for its section 3.5 on images, which is reproduced with the calf of chapter 1.

    Parameters
    ----------
    seed : int
        Seed of all noise.
    draws : int
        Draws of noise for medians and standard deviations; at least 2.

    Raises
    ------
    InputError
        Fewer than two draws.
    """
    if draws < 2:
        raise InputError(f"draws is {draws}; a standard deviation needs at least 2")
    sections = (
        square_section(seed, draws),
        uniform_section(),
        layer_section(),
        identifiability_section(),
        noise_section(seed, draws),
        table_3_4(),
        table_3_5(),
        _images_section(),
        images_of_markers(seed),
        experiment_section(),
        design_section(draws=draws, seed=seed),
    )
    settings = {"seed": seed, "draws": draws, "noise_mm": NOISE_MM, "marker_sd_mm": MARKER_SD_MM}
    return Chapter("ch3", "Chapter 3: non-uniform elasticity from internal deformation", sections, {**settings})


def _images_section() -> Section:
    text = "Block matching, Horn-Schunck, Lucas-Kanade and their hybrid on MR images of a calf are in chapter 1: naibu reproduce ch1."
    return Section("Internal deformation from MR images (3.5)", (text,))
