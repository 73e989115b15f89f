"""Identification of every tetrahedron of the cube from one load case by minimum norm :cite:p:`hirai2008` (chapter 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.equilibrium_gap.batch import EquilibriumGapEstimate, batch_equilibrium_gap
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.reproduction.chapter3.bodies import PushedBody, shape_error_percent

SIDE_MM = 40.0
SIDEWAYS = (10.0, 0.0, 0.0)  # push that was not used for identification, mm


@dataclass(frozen=True, slots=True, eq=False)
class CellResult:
    """Moduli of every tetrahedron of the unknown half from one load case, and simulations with them.

    Attributes
    ----------
    body : PushedBody
        The virtual body.
    zones : Zones
        One zone per tetrahedron.
    estimate : EquilibriumGapEstimate
        Estimate of minimum norm.
    displacement, again : ndarray, shape (n, 3)
        Displacement with the true and with the identified moduli, mm.
    error, sideways : float
        Error (3.35) of the report, per cent, for the load case that was used and for `SIDEWAYS`.
    """

    body: PushedBody
    zones: Zones
    estimate: EquilibriumGapEstimate
    displacement: FloatArray
    again: FloatArray
    error: float
    sideways: float

    def layer(self, name: str) -> BoolArray:
        """Return which zones (count,) lie in a layer."""
        return np.array([zone.startswith(f"{name}: ") for zone in self.zones.names])


def identify_cells(body: PushedBody) -> CellResult:
    """Identify every tetrahedron by minimum norm from the exact displacement, as in the report, and simulate with the result."""
    zones = body.zones(each_cell=True)
    estimate = batch_equilibrium_gap(body.mesh, body.load_cases(), zones, method="minimum_norm")
    moduli = zones.per_cell(estimate.lame_lambda, estimate.shear_modulus)

    def simulated(push: ArrayLike) -> tuple[FloatArray, FloatArray, float]:
        first, second = body.displacement(push), body.displacement(push, moduli)
        return first, second, shape_error_percent(first, second, SIDE_MM, SIDE_MM)

    return CellResult(body, zones, estimate, *simulated(body.pushes[0]), simulated(SIDEWAYS)[2])
