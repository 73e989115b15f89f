"""Candidate strain readings from CT images: between marker layers, and in a simulated block with constrained faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from naibu import datasets
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.markers import Markers
from naibu.identification.material_testing.marker_strain import marker_strain, poisson_ratio_from_markers
from naibu.identification.material_testing.uniaxial import PoissonRatio
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.primitives import box

GELS = ("hardness 5", "hardness 0")
PLATE_STATES = (
    ("ct_two_material_2", "deformed"),
    ("ct_two_material_3", "deformed"),
    ("ct_cube_plate", "height_45"),
    ("ct_cube_plate", "height_35"),
)
READING_SD = 0.01  # of a strain: 0.15 mm at both ends of 40 mm in both states, and two printed digits
SIDE_MM = 60.0
PIXEL_MM = 150.0 / 512.0


@dataclass(frozen=True, slots=True)
class MarkerRatio:
    """Poisson's ratio of one gel in one state, from the markers inside it."""

    gel: str
    label: str
    ratio: PoissonRatio
    longitudinal: float
    transversal: float


@dataclass(frozen=True, slots=True)
class Readings:
    """Axial and lateral strains of one state between marker layers, by what was read; compression is negative."""

    longitudinal: dict[str, float]
    transversal: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class ConstrainedBlock:
    """Compressed cube with constrained faces: relative heights (k,), lateral strain there (k,), volume ratio of the cube."""

    height: FloatArray
    transversal: FloatArray
    volume_ratio: float

    def transversal_at(self, height: float) -> float:
        """Return the lateral strain at a relative height."""
        return float(np.interp(height, self.height, self.transversal))


@dataclass(frozen=True, slots=True)
class MatchingPairs:
    """Number of pairs of readings tried, and numbers within two standard deviations of each printed pair."""

    tried: int
    fitting: tuple[int, ...]


@cache
def marker_ratios() -> tuple[MarkerRatio, ...]:
    """Return Poisson's ratios from the markers of every gel compressed by a plate as a separate block."""
    parts = [
        ("hardness 5", "ct_two_material_2", "deformed", (51, 100)),
        ("hardness 5", "ct_two_material_3", "deformed", (51, 100)),
        ("hardness 0", "ct_two_material_2", "deformed", (1, 50)),
        ("not stated", "ct_cube_plate", "height_45", (1, 125)),
        ("not stated", "ct_cube_plate", "height_35", (1, 125)),
    ]
    out = []
    for gel, name, state, (first, last) in parts:
        experiment = datasets.load(name)
        free, loaded = (_between(m, first, last) for m in (experiment.initial, experiment.state(state).markers))
        ratio = poisson_ratio_from_markers(free, loaded)
        along = np.linalg.norm(marker_strain(free, loaded).gradients[:, :, 2], axis=1)
        stretch = float(np.exp(np.log(along).mean()))
        widening = float(np.sqrt(ratio.volume_ratio / stretch))
        out.append(MarkerRatio(gel, f"{name}/{state}", ratio, stretch - 1.0, widening - 1.0))
    return tuple(out)


def readings(name: str, state: str) -> Readings:
    """Return the strains between marker layers of a bundled plate experiment.

    Axial: between the outermost layers, between the layers of each gel, and from the stated and estimated heights of the plate.
    Lateral: of every layer, from the affine fit of its complete markers (square root of the area ratio).
    """
    experiment = datasets.load(name)
    free, loaded = experiment.initial.points * _scale(experiment), experiment.state(state).markers
    if loaded is None:
        raise InputError(f"{name}/{state} has no measured positions")
    pressed = loaded.aligned(experiment.initial.ids) * _scale(experiment)
    layer = (experiment.initial.ids - 1) // 25
    count = int(layer.max()) + 1
    z = np.array([[np.nanmean(a[layer == k, 2]) for k in range(count)] for a in (free, pressed)])
    names = _gel_of_layers(experiment, count)
    along = {"all layers": float((z[1, -1] - z[1, 0]) / (z[0, -1] - z[0, 0]) - 1.0)}
    for k in range(count - 1):
        if names[k] == names[k + 1]:
            along[f"{names[k]}, layers {k + 1} and {k + 2}"] = float((z[1, k + 1] - z[1, k]) / (z[0, k + 1] - z[0, k]) - 1.0)
    record = experiment.state(state)
    for what, height in (("stated height", record.stated_mm), ("estimated height", record.estimated_mm)):
        if height is not None:
            along[what] = height / experiment.height_mm - 1.0
    across = {f"{names[k]}, layer {k + 1}": _transversal_strain(free[layer == k], pressed[layer == k]) for k in range(count)}
    return Readings(along, across)


def matching_pairs(printed: Sequence[tuple[float, float, float]]) -> MatchingPairs:
    """Compare every pair of an axial and a lateral reading of one state with the printed values (axial, lateral, nu)."""
    tried, fitting = 0, [0] * len(printed)
    for name, state in PLATE_STATES:
        seen = readings(name, state)
        for along, across in product(seen.longitudinal.values(), seen.transversal.values()):
            tried += 1
            for k, pair in enumerate(printed):
                fitting[k] += bool(np.hypot(along - pair[0], across - pair[1]) <= 2.0 * READING_SD)
    return MatchingPairs(tried, tuple(fitting))


@cache
def constrained_block(shortening: float, poisson_ratio: float, divisions: int) -> ConstrainedBlock:
    """Compress a cube with constrained loaded faces by a fraction `shortening` of its height, for any Young's modulus."""
    mesh = box((SIDE_MM,) * 3, (divisions, divisions, 2 * divisions))
    z = mesh.points[:, 2]
    bottom, top = np.flatnonzero(z < 1e-9), np.flatnonzero(z > SIDE_MM - 1e-9)
    supports = PrescribedDisplacement.none(mesh.n_points).and_also(bottom, (0.0, 0.0, 0.0)).and_also(top, (0.0, 0.0, -shortening * SIDE_MM))
    body = Assembler.from_materials(elements(mesh), mesh.regions, [material(young_modulus=100.0, poisson_ratio=poisson_ratio)])
    u = solve(Problem(mesh.points, body, (), supports, np.zeros_like(mesh.points))).displacement
    heights = np.unique(z.round(6))
    at = [np.abs(z - h) < 1e-3 for h in heights]
    across = np.array([_transversal_strain(mesh.points[k], mesh.points[k] + u[k]) for k in at])
    volume = elements(mesh.moved(u)).volume / elements(mesh).volume
    return ConstrainedBlock(heights / SIDE_MM, across, volume)


def _transversal_strain(free: FloatArray, pressed: FloatArray) -> float:
    """Return the lateral strain of points (k, 3) of one layer: square root of the area ratio of their affine fit, less one."""
    ok = np.isfinite(free).all(axis=1) & np.isfinite(pressed).all(axis=1)
    design = np.column_stack([np.ones(ok.sum()), free[ok, :2]])
    slope = np.linalg.lstsq(design, pressed[ok, :2], rcond=None)[0][1:]
    return float(np.sqrt(abs(np.linalg.det(slope)))) - 1.0


def _scale(experiment: Experiment) -> FloatArray:
    return np.array([experiment.xy_scale, experiment.xy_scale, 1.0])


def _gel_of_layers(experiment: Experiment, count: int) -> list[str]:
    """Return the material of every marker layer, from its nominal height."""
    tops = np.array([layer.to_base_mm for layer in experiment.layers[:-1]])
    return [experiment.layers[int(np.searchsorted(tops, h))].material for h in experiment.nominal_heights_mm[:count]]


def _between(markers: Markers | None, first: int, last: int) -> Markers:
    if markers is None:
        raise InputError("the state has no measured positions")
    own = (markers.ids >= first) & (markers.ids <= last)
    return Markers.from_arrays(markers.ids[own], markers.points[own], markers.trusted[own])
