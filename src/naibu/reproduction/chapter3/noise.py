"""Chapter 3 with noise: what the report's least squares and the weighted balance make of the same measurements, and the bound (spec I6)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.identification.equilibrium_gap.batch import EquilibriumGapEstimate, batch_equilibrium_gap
from naibu.identification.equilibrium_gap.weighted import weighted_equilibrium_gap
from naibu.reproduction.chapter3 import figures as drawn
from naibu.reproduction.chapter3.bodies import LAYERS, PushedBody, cube
from naibu.viewer.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

NOISE_MM = 0.1  # a hundredth of the push, as the best measurements of the report's chapter 3.6 allow


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Young's moduli, kPa, and Poisson's ratios of the zones over draws of noise.

    Attributes
    ----------
    names : tuple of str
        The zones.
    truth, bound : ndarray, shape (count, 2)
        True values, and the standard deviations of the Cramer-Rao bound.
    plain, weighted : ndarray, shape (draws, count, 2)
        Of least squares and of the weighted balance.
    """

    names: tuple[str, ...]
    truth: FloatArray
    bound: FloatArray
    plain: FloatArray
    weighted: FloatArray

    def over_bound(self, values: FloatArray) -> float:
        """Root mean square error over the bound, over all moduli."""
        return float(np.sqrt((((values - self.truth) / self.bound) ** 2).mean()))


def noise_scatter(body: PushedBody, sd_mm: float, seed: int, draws: int) -> Scatter:
    """Identify a body from noisy displacements of all its nodes, over and over.

    The bound is the covariance of the weighted balance without noise: the inverse information of all nodes, with the motion of floor and
    top among the unknowns.
    """
    zones = body.zones()
    exact = [replace(t, field=DisplacementField.from_arrays(t.field.points, t.field.vectors, sd_mm=sd_mm)) for t in body.load_cases()]
    best = weighted_equilibrium_gap(body.mesh, exact, zones)
    plain, weighted = [], []
    for k in range(draws):
        trials = body.load_cases(sd_mm=sd_mm, seed=seed + k)
        plain.append(_moduli(batch_equilibrium_gap(body.mesh, trials, zones)))
        weighted.append(_moduli(weighted_equilibrium_gap(body.mesh, trials, zones)))
    truth = np.array([body.truth[name] for name in zones.names])
    return Scatter(zones.names, truth, best.engineering_deviation, np.array(plain), np.array(weighted))


def _moduli(estimate: EquilibriumGapEstimate) -> FloatArray:
    return np.column_stack([estimate.young_modulus, estimate.poisson_ratio])


def noise_section(seed: int, draws: int) -> Section:
    """Return bias and scatter of both methods, over draws of noise of `NOISE_MM`."""
    aside = ((0.0, 0.0, -10.0), (10.0, 0.0, 0.0))
    bodies = {"uniform": cube(), "two layers": cube(LAYERS), "two layers, two pushes": cube(LAYERS, pushes=aside)}
    cases = {name: noise_scatter(body, NOISE_MM, seed, draws) for name, body in bodies.items()}
    efficiencies = {name: (s.over_bound(s.plain), s.over_bound(s.weighted)) for name, s in cases.items()}
    text = (
        f"The report adds no noise to its simulations. Here every node's displacement has normal noise of {NOISE_MM:g} mm, one per cent of "
        "the push, and one pair of moduli is sought for every layer: the report's least squares, which weighs the forces of all nodes "
        "alike, and the balance weighted by the covariance that the noise gives those forces, at the displacement that balances.",
        "Least squares is biased, as the noise is in its matrix too; weighting reaches the Cramer-Rao bound, the least scatter that any "
        "unbiased method can have.",
    )
    figure = Figure("Noise", "Root mean square errors over the bound.", lambda canvas: drawn.efficiencies(canvas, efficiencies), (6.0, 3.2))
    return Section("With noise", text, (_table(cases),), (figure,))


def _table(cases: Mapping[str, Scatter]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case, s in cases.items():
        for z, name in enumerate(s.names):
            for quantity, at, scale in (("E, Pa", 0, 1e3), ("nu", 1, 1.0)):
                numbers = [s.truth[z, at], s.bound[z, at]]
                for values in (s.plain, s.weighted):
                    numbers += [np.mean(values[:, z, at]), np.std(values[:, z, at])]
                rows.append((case, name, quantity, *(scale * float(number) for number in numbers)))
    columns = ("case", "zone", "quantity", "true", "bound", "least squares, mean", "scatter", "weighted, mean", "scatter ")
    return Table("Noise", columns, tuple(rows), caption=f"Means and standard deviations with noise of {NOISE_MM:g} mm.")
