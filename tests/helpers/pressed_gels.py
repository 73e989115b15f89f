"""Virtual gels of two layers under a plate, made on small elements, and what is identified from their markers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.parameter_names import young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, two_gels, virtual_specimen


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
def identified_together(factor: float, *, seed: int = 0) -> Calibration:
    """Identify two virtual gels, one upside down, as one pair of materials; the soft one of the second is stiffer by `factor`."""
    layers = ("soft", "stiff")
    truth = two_gels(46.0)[1]
    made = []
    for k, (name, order) in enumerate((("one", layers), ("two", layers[::-1]))):
        experiment = box_experiment(name, (60.0,) * 3, [(m, 30.0) for m in order], Loading("plate"), {"pressed": (46.0, 48.0)[k]})
        values = truth | {young_modulus("soft"): truth[young_modulus("soft")] * (1.0, factor)[k]}
        body = virtual_specimen(experiment, values, settings=ModelSettings(element_size_mm=60.0 / 11, contact="stick"))
        made.append(body.scanned(seed=2 * seed + k, scanner=Scanner()).experiment)
    settings = ModelSettings(element_size_mm=60.0 / 8, contact="stick")
    return calibrate(made, known_materials=KnownMaterials({"stiff": truth[young_modulus("stiff")]}), settings=settings)
