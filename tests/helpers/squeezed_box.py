"""A box of markers squeezed in closed form: it gets lower, wider everywhere, and widest at half its height."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.experiment import Experiment, Loading
from naibu.core.markers import Markers
from naibu.validation.specimens.marker_phantoms import box_experiment, marker_lattice

SIDE_MM = 60.0
Change = Callable[[FloatArray], FloatArray]


def squeezed(points: FloatArray, height_mm: float, bulge: float = 0.24) -> FloatArray:
    """Return the images (k, 3), mm, of points in the object's frame."""
    stretch = height_mm / SIDE_MM
    wide = (1.0 + bulge * (1.0 - stretch) * (1.0 - (2.0 * points[:, 2:] / SIDE_MM - 1.0) ** 2)) / np.sqrt(stretch)
    return np.column_stack([points[:, :2] * wide, points[:, 2] * stretch])


def squeezed_box(
    heights_mm: Mapping[str, float] | None = None,
    *,
    stated_mm: Mapping[str, float] | None = None,
    initial: Change = lambda points: points,
    loaded: Change = lambda points: points,
    layers: tuple[tuple[str, float], ...] = (("soft", 30.0), ("firm", 30.0)),
    noise_mm: float = 0.1,
    seed: int = 1,
) -> Experiment:
    """Return an experiment whose tables were changed by `initial` and `loaded`; `stated_mm` is what its description says of the heights."""
    heights = dict(heights_mm or {"pressed": 45.0})
    template = box_experiment("box", (SIDE_MM,) * 3, layers, Loading("plate"), heights)
    rng, lattice = np.random.default_rng(seed), marker_lattice(template)
    ids = np.arange(1, len(lattice) + 1)

    def seen(points: FloatArray) -> FloatArray:
        return points + noise_mm * rng.normal(size=points.shape)

    states = [replace(template.states[0], markers=Markers.from_arrays(ids, initial(seen(lattice))))]
    for state in template.states[1:]:
        points = loaded(seen(squeezed(lattice, heights[state.name])))
        stated = (heights if stated_mm is None else stated_mm).get(state.name)
        states.append(replace(state, markers=Markers.from_arrays(ids, points), stated_mm=stated))
    return replace(template, states=tuple(states), nominal_heights_mm=())
