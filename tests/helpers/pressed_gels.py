"""Virtual gels of two layers under a plate, made on small elements, and what is identified from their markers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.parameter_names import young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.validation.specimens.marker_phantoms import Scanner, VirtualSpecimen, box_experiment, two_gels, virtual_specimen


@cache
def scanned() -> tuple[Experiment, dict[str, float]]:
    """Return the experiment and its truth; the layers meet in the middle, 30 mm above the base."""
    template, truth = two_gels(46.0)
    made = virtual_specimen(template, truth, settings=ModelSettings(element_size_mm=60.0 / 11))
    return made.scanned(seed=2, scanner=Scanner(placing_mm=0.1, xy_step_mm=0.0, z_step_mm=0.0)).experiment, truth


@cache
def identified(element_size_mm: float, *, stated_mm: float = 30.0, with_mesh_error: bool = True) -> Calibration:
    """Identify it on elements of this size; `stated_mm` is where its layers are said to meet."""
    experiment = scanned()[0]
    soft, stiff = experiment.layers
    layers = (replace(soft, to_base_mm=stated_mm), replace(stiff, from_base_mm=stated_mm))
    return calibrate(
        [replace(experiment, layers=layers)], known_materials=KnownMaterials({"stiff": 222.0}),
        settings=ModelSettings(element_size_mm=element_size_mm), with_mesh_error=with_mesh_error,
    )  # fmt: skip


@cache
def gel(number: int, factor: float) -> VirtualSpecimen:
    """Return the first or second of two gels, the second upside down, with a soft layer that is stiffer by `factor`."""
    template = box_experiment(
        ("one", "two")[number], (60.0,) * 3, [(m, 30.0) for m in ("soft", "stiff")[:: (1, -1)[number]]], Loading("plate"),
        {"pressed": (46.0, 48.0)[number]},
    )  # fmt: skip
    truth = two_gels(46.0)[1]
    values = truth | {young_modulus("soft"): truth[young_modulus("soft")] * factor}
    return virtual_specimen(template, values, settings=ModelSettings(element_size_mm=60.0 / 11, contact="stick"))


@cache
def identified_together(factor: float, *, seed: int = 0) -> Calibration:
    """Identify two virtual gels, one upside down, as one pair of materials; the soft one of the second is stiffer by `factor`."""
    made = [gel(k, (1.0, factor)[k]).scanned(seed=2 * seed + k, scanner=Scanner()).experiment for k in range(2)]
    settings, stiff = ModelSettings(element_size_mm=60.0 / 8, contact="stick"), two_gels(46.0)[1][young_modulus("stiff")]
    return calibrate(made, known_materials=KnownMaterials({"stiff": stiff}), settings=settings)
