"""Least squares and weighted equilibrium gap on noisy measurements, compared with the Cramér-Rao bound :cite:p:`hirai2008` (chapter 3)."""

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
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

NOISE_MM = 0.1  # a hundredth of the indentation, as in the best measurements of chapter 3.6 of the report


@dataclass(frozen=True, slots=True, eq=False)
class NoiseStudy:
    """Estimates of Young's moduli, kPa, and Poisson's ratios of the zones over draws of noise.

    Attributes
    ----------
    names : tuple of str
        Names of the zones.
    truth, bound : ndarray, shape (count, 2)
        True values, and standard deviations of the Cramér-Rao bound.
    plain, weighted : ndarray, shape (draws, count, 2)
        Estimates of least squares and of the weighted equilibrium gap.
    """

    names: tuple[str, ...]
    truth: FloatArray
    bound: FloatArray
    plain: FloatArray
    weighted: FloatArray

    def over_bound(self, values: FloatArray) -> float:
        """Return the root mean square over all moduli of the error relative to the bound."""
        return float(np.sqrt((((values - self.truth) / self.bound) ** 2).mean()))


def noise_study(body: PushedBody, sd_mm: float, seed: int, draws: int) -> NoiseStudy:
    """Return identifications of a body from repeated noisy displacements of all its nodes (Monte Carlo).

    The bound is the covariance of the weighted equilibrium gap without noise: the inverse Fisher information of all nodes, with the
    displacement of floor and top among the unknowns.
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
    return NoiseStudy(zones.names, truth, best.engineering_deviation, np.array(plain), np.array(weighted))


def _moduli(estimate: EquilibriumGapEstimate) -> FloatArray:
    return np.column_stack([estimate.young_modulus, estimate.poisson_ratio])


def noise_section(seed: int, draws: int) -> Section:
    """Return bias and standard deviation of both methods, over draws of noise of SD `NOISE_MM`."""
    aside = ((0.0, 0.0, -10.0), (10.0, 0.0, 0.0))
    bodies = {"uniform": cube(), "two layers": cube(LAYERS), "two layers, two load cases": cube(LAYERS, pushes=aside)}
    cases = {name: noise_study(body, NOISE_MM, seed, draws) for name, body in bodies.items()}
    efficiencies = {name: (s.over_bound(s.plain), s.over_bound(s.weighted)) for name, s in cases.items()}
    ratios = [float(r) for s in cases.values() for r in (s.weighted.std(axis=0) / s.bound).ravel()]
    text = (
        f"The report adds no noise to its simulations. Here the displacement of every node has normal noise of {NOISE_MM:g} mm, one per "
        "cent of the indentation, and one pair of moduli is identified for every layer: by the report's least squares, which weights the "
        "forces of all nodes equally, and by the equilibrium gap weighted with the covariance of the forces due to the noise.",
        "Least squares is biased, because the noise is in its matrix too (errors in variables). With weights, the standard deviations of "
        f"the table are {min(ratios):.2f} to {max(ratios):.2f} times the Cramer-Rao bound, the smallest of any unbiased method; a standard "
        f"deviation of {draws} draws is itself known to {100 / np.sqrt(2 * (draws - 1)):.0f} %.",
    )
    figure = Figure("Noise", "Root mean square errors over the bound.", lambda canvas: drawn.efficiencies(canvas, efficiencies), (6.0, 3.2))
    return Section("With noise", text, (_table(cases),), (figure,))


def _table(cases: Mapping[str, NoiseStudy]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case, s in cases.items():
        for z, name in enumerate(s.names):
            for quantity, at, scale in (("E, Pa", 0, 1e3), ("nu", 1, 1.0)):
                numbers = [s.truth[z, at], s.bound[z, at]]
                for values in (s.plain, s.weighted):
                    numbers += [np.mean(values[:, z, at]), np.std(values[:, z, at])]
                rows.append((case, name, quantity, *(scale * float(number) for number in numbers)))
    columns = ("case", "zone", "quantity", "true", "bound", "least squares, mean", "SD", "weighted, mean", "SD ")
    return Table("Noise", columns, tuple(rows), caption=f"Means and standard deviations with noise of {NOISE_MM:g} mm.")
