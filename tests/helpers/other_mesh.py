"""Load cases of virtual bodies measured on a mesh of their own, other than the one on which moduli are identified."""

from __future__ import annotations

import numpy as np

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.meshing.point_location import interpolation_operator
from naibu.reproduction.chapter3.bodies import PushedBody


def load_cases_of(truth: PushedBody, model: PushedBody, points: np.ndarray, *, sd_mm: float, seed: int = 0) -> list[FieldLoadCase]:
    """Return the load cases of `model` with the displacement of `truth`, solved on its own mesh, at points (k, 3), mm, with noise."""
    rng, at_points = np.random.default_rng(seed), interpolation_operator(truth.mesh, points)
    out = []
    for k, push in enumerate(truth.pushes):
        exact = np.asarray(at_points @ truth.displacement(push))
        field = DisplacementField.from_arrays(points, exact + sd_mm * rng.standard_normal(points.shape), sd_mm=sd_mm)
        out.append(FieldLoadCase.of(f"push {k + 1}", field, model.mesh, loaded=model.constrained))
    return out


def grid_of_points(size_mm: float, spacing_mm: float) -> np.ndarray:
    """Return points (k, 3), mm, of a cubic grid in a cube with a corner at the origin, half a spacing away from its faces."""
    at = np.arange(0.5 * spacing_mm, size_mm, spacing_mm)
    return np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
