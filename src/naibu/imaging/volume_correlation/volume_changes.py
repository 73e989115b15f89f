"""Where volume changes by more than the penalty of dilatation allows: found by a score test, and given weights of their own.

One weight for the whole object, of which most keeps its volume, takes most of the dilatation from a part that swells. The data then pull
against the penalty, and the field keeps some dilatation. What noise alone would leave is known: it is that of random residuals, fitted with
the same penalties. Where the field has many times as much, in squares, the assumption that volume changes as little as elsewhere is
rejected (a score test), and the weight is lower by as much, as the most probable one is where the penalty takes most away
:cite:p:`mackay1992`. What it has beyond noise alone elsewhere is an error: see
`naibu.imaging.volume_correlation.results.hidden_dilatation`.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, Float32Array, FloatArray
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.results.cell_errors import deformation_at_middles

# empirical: mean square of the dilatation, in those of noise alone, above which it is not noise. Where volume is kept it is 0.5 to 1, and
# at most 3; in legs more than 5 in one cell of twenty, where bending is penalised too much
DEMANDED = 5.0
# empirical: mean square of the dilatation, in that of the largest weight, above which a cell may have a weight of its own; and in that of
# half of the cells, which one cell has to exceed: else volume changes alike everywhere, and one weight serves them all. Balls and chests
# that change their volume smoothly reach 2.4 to 4.7, bodies of which a part swells 9 and more
EXPECTED, UNLIKE = 3.0, 6.0
WINDOW = 1.0  # cells: standard deviation of the window in which they are compared
LARGEST = 0.5  # dilatation, up to which the weight of a part that swells lets volume change
DRAWS, LATE_DRAWS = 4, 8  # random fields of noise alone: while the weights are adapted, and for what stays hidden


def squared_dilatation(fit: CorrelationFit) -> FloatArray:
    """Return the mean square of the dilatation about every cell (m,), mm^3, of the field at which the equations were assembled."""
    system = fit.system
    energy = np.asarray(system.gauss_volume * system.dilatation_energy, dtype=float)
    total, count = (fit.windowed(v, WINDOW) for v in (energy, (system.gauss_volume > 0.0).astype(float)))
    return np.asarray(total / np.maximum(count, 1e-30))


def ratio_of_all(fit: CorrelationFit, c: FloatArray, most: float) -> float:
    """Return the ratio of volumes about which those of all cells lie, if a weight `most`, 1/mm^3, does not let expect it; else that of now.

    It is taken for that of the whole object only where the ratios of nine cells of ten differ by less than they do from 1.
    """
    system = fit.system
    volume = np.linalg.det(deformation_at_middles(fit, c))[system.gauss_volume > 0.0]
    if not len(volume) or most == 0.0:
        return system.ratio
    low, middle, high = np.quantile(volume, [0.05, 0.5, 0.95])
    beyond = (middle - 1.0) ** 2 * most * float(np.prod(system.grid.step_mm)) > EXPECTED
    return float(middle) if beyond and high - low < abs(middle - 1.0) and low > 0.0 else system.ratio


def may_swell(fit: CorrelationFit, some: BoolArray, most: float) -> BoolArray:
    """Return about which of some cells (m,) volume changes by more than a weight `most`, 1/mm^3, lets expect, unless it does so alike."""
    square = squared_dilatation(fit)
    alike = square[some].max() < UNLIKE * np.median(square[fit.system.gauss_volume > 0.0])
    return np.asarray(some & (square > EXPECTED / most) & ~alike)


def demanded_dilatation(fit: CorrelationFit, noise: Float32Array, c: FloatArray) -> FloatArray:
    """Return the mean square of the dilatation about every cell (m,), over that of noise alone.

    Parameters
    ----------
    fit : CorrelationFit
        After iterations at coefficients c.
    noise : ndarray, shape (n, 3, s)
        Random coefficients, mm, that residuals of noise alone leave: see `CorrelationFit.noise_samples`.
    c : ndarray, shape (NZ, NY, NX, 3)
        Coefficients, mm.
    """
    system = fit.system
    found, expected = (fit.windowed(system.gauss_volume * e, WINDOW) for e in (system.dilatation_energy, system.energies(noise, c)[1]))
    return np.asarray(np.where(found > 0.0, found / np.maximum(expected, 1e-30), 0.0))


def released_weights(fit: CorrelationFit, weight: float, demand: FloatArray) -> FloatArray:
    """Return weights (m,) that let volume change as much as the data may demand, for cells with that demand and a weight as yet."""
    cell = float(np.prod(fit.system.grid.step_mm))
    return np.asarray(np.clip(weight / np.maximum(demand, 1.0), min(LARGEST**-2 / cell, weight), weight))
