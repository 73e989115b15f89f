"""Refinement of a body in motion by the error of its stress."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_elements.linear_simplices import simplices
from naibu.meshing.refinement.forest import BisectionForest, LeafMesh
from naibu.meshing.refinement.marking import Marks
from naibu.simulation.adaptive.error_estimator import recovery_indicators


@dataclass(frozen=True, slots=True)
class StressError:
    """Refine cells whose stress differs from its average around their nodes; see `recovery_indicators`.

    The stress is that of the Green-Lagrange strain in a linear law, so that rotations count nothing.

    Attributes
    ----------
    young_modulus, poisson_ratio : float
        kPa, and dimensionless.
    refine_above, coarsen_below : float
        Errors of a cell as fractions of the norm of the stress of the whole body. Where the stress is smooth, joined cells have some 2.4
        times the error of their halves.
    least : float
        Norm, ``(mN mm)^(1/2)``, below which that of the body is not taken: where it is nearly at rest, errors count less.

    Raises
    ------
    InputError
        Not 0 <= coarsen_below < refine_above, or moduli out of range.
    """

    young_modulus: float
    poisson_ratio: float
    refine_above: float
    coarsen_below: float
    least: float = 0.0

    def __post_init__(self) -> None:
        lame_parameters(self.young_modulus, self.poisson_ratio)
        if not 0.0 <= self.coarsen_below < self.refine_above or not self.least >= 0.0:
            raise InputError(
                f"coarsen_below must not be negative and below refine_above, and least not be negative, not {self.coarsen_below:g}, "
                f"{self.refine_above:g} and {self.least:g}"
            )

    def marks(self, forest: BisectionForest, leaf: LeafMesh, displacement: FloatArray) -> Marks:
        """Return the marks of the leaves; see `naibu.meshing.refinement.marking.Criterion`."""
        lam, mu = lame_parameters(self.young_modulus, self.poisson_ratio)
        identity = np.eye(leaf.mesh.dimension)
        body = simplices(leaf.mesh)
        gradient = body.displacement_gradients(displacement) + identity
        strain = 0.5 * (np.swapaxes(gradient, 1, 2) @ gradient - identity)
        stress = 2.0 * mu * strain + lam * np.einsum("mii->m", strain)[:, None, None] * identity
        norm = float(np.sqrt((body.measures * (stress**2).sum(axis=(1, 2))).sum() / (2.0 * mu)))
        error = recovery_indicators(leaf.mesh, stress, mu) / max(norm, self.least, 1e-300)
        return Marks(error > self.refine_above, error < self.coarsen_below)
