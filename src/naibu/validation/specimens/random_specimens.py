"""Random virtual specimens: one or two gels of random size, stiffness and friction under a plate, a bar or side plates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from naibu.core.experiment import Experiment, Loading, LoadingKind
from naibu.identification.from_markers.specimen.parameter_names import friction, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.validation.specimens.marker_phantoms import box_experiment

EDGES_MM = (40.0, 100.0)
SOFT_KPA = (2.0, 200.0)
MODULUS_RATIO = (1.0, 50.0)
POISSON_RATIO = (0.3, 0.499)
FRICTION = (0.0, 1.0)
COMPRESSION = (0.05, 0.4)
LAYER = (0.25, 0.75)  # thickness of the lower layer, as a fraction of the height
BAR = (0.2, 0.6)  # width, as a fraction of the edge across
CELLS = (5.0, 9.0)  # along an edge of the cube of the same volume
KINDS = tuple(kind for kind in get_args(LoadingKind) if kind != "cylinder")


@dataclass(frozen=True, slots=True, eq=False)
class RandomSpecimen:
    """A specimen to be made virtual by `virtual_specimen`.

    Attributes
    ----------
    experiment : Experiment
        Object, loading and its one loaded state, ``"pressed"``.
    truth : dict
        Physical value of every parameter.
    settings : ModelSettings
        With the size of the elements.
    compression : float
        By what fraction the plate, the bar or the side plates shorten the object.
    """

    experiment: Experiment
    truth: dict[str, float]
    settings: ModelSettings
    compression: float

    @property
    def description(self) -> str:
        """Return what it is, in one line."""
        e = self.experiment
        size = " x ".join(f"{v:.0f}" for v in e.shape.size_mm)
        moduli = ", ".join(
            f"{layer.material} {self.truth[young_modulus(layer.material)]:.3g} kPa nu {self.truth[poisson_ratio(layer.material)]:.3f}"
            for layer in e.layers
        )
        rubbing = ", ".join(f"{value:.2f}" for name, value in self.truth.items() if name.endswith("friction"))
        return f"{e.loading.kind}, {size} mm, {moduli}, friction {rubbing}, {100 * self.compression:.0f} %"


def random_specimen(seed: int) -> RandomSpecimen:
    """Draw a specimen; the loading alternates between plate, bar and side plates."""
    rng = np.random.default_rng([seed, 2])
    kind = KINDS[seed % len(KINDS)]
    size = rng.uniform(*EDGES_MM, size=3)
    lower = float(size[2] * rng.uniform(*LAYER))
    soft = float(np.exp(rng.uniform(*np.log(SOFT_KPA))))
    moduli = [soft, float(soft * np.exp(rng.uniform(*np.log(MODULUS_RATIO))))]
    names = ["soft", "stiff"] if rng.uniform() < 0.5 else ["stiff", "soft"]
    compression = float(rng.uniform(*COMPRESSION))
    axis: str = rng.choice(["x", "y"])
    across = float(size["yx".index(axis)])
    loading = Loading(kind, across * float(rng.uniform(*BAR)) if kind == "bar" else None, "x" if axis == "x" else "y")
    pressed = float(size["xy".index(axis)]) if kind == "side_plates" else float(size[2])
    experiment = box_experiment(
        f"random_{seed}", (float(size[0]), float(size[1]), float(size[2])), [(names[0], lower), (names[1], float(size[2]) - lower)],
        loading, {"pressed": pressed * (1.0 - compression)},
    )  # fmt: skip
    truth = {young_modulus("soft"): moduli[0], young_modulus("stiff"): moduli[1]}
    truth |= {poisson_ratio(name): float(rng.uniform(*POISSON_RATIO)) for name in names}
    touching = [(names[0], loading.base_material)]
    touching += [(name, loading.counter_material) for name in (names if kind == "side_plates" else names[1:])]
    truth |= {friction(*pair): float(rng.uniform(*FRICTION)) for pair in touching}
    edge = float(np.prod(size) ** (1 / 3) / rng.uniform(*CELLS))
    return RandomSpecimen(experiment, truth, ModelSettings(element_size_mm=edge), compression)
