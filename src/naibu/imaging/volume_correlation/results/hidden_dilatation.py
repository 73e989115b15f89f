"""Dilatation that its penalty hides: the error, from the dilatation that is left in the field and what trial parts leave.

A part that swells keeps some of its dilatation in spite of the penalty. How much, and what displacement is lost, follows from trial parts
of known dilatation, whose response is that of the linear equations. What the field has beyond noise alone, in squares, then tells how much
a part about every cell may have swollen: much where noise hides it, and little where the data decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.results.cell_errors import deformation_at_middles, dilatation_square, gradients_of, strain_square
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid
from naibu.imaging.volume_correlation.volume_changes import LARGEST, WINDOW, demanded_dilatation

# cells: radius of the trial parts, and their distance. Smaller parts move their surroundings by little, larger ones are seen
RADIUS, APART = 1.75, 6.0
DRAWS = 16  # lattices of trial parts, displaced so that one or the other has a part near every cell
# additive recurrence of least discrepancy in three dimensions: powers of the inverse of the root of x^4 = x + 1
SHIFTS = 1.22074408460575947536 ** -np.arange(1.0, 4.0)
SPREAD = 0.7  # cells: SD of the window in which cells share what is hidden
CORE, REACH = 0.5 * RADIUS, 1.2 * RADIUS  # cells: within which the dilatation is seen, and the displacement is lost
RESPONSE_TOLERANCE = 0.01  # of the linear solves: conjugate gradients find the smooth part, in which the parts of a lattice differ, last


@dataclass(frozen=True, slots=True, eq=False)
class TrialParts:
    """Lattices of spheres that swell and shrink in turn by the factor 1 + 1 of their volume, to first order.

    Attributes
    ----------
    coefficients : ndarray, shape (n, 3, DRAWS), float32
        Of their displacement, mm.
    away : ndarray, shape (DRAWS, m)
        Distance of the middles of the cells from the nearest middle of a sphere, cells.
    """

    coefficients: Float32Array
    away: FloatArray

    @classmethod
    def of(cls, system: SplineSystem) -> TrialParts:
        """Return them for all cells of a system."""
        grid, active, out, away = system.grid, system.active, [], []
        middles = grid.origin_mm + (system.cells[:, :1:-1] + 0.5) * grid.step_mm
        for k in range(DRAWS):
            shift = APART * ((k * SHIFTS) % 1.0)
            out.append(_displacement(grid, grid.nodes_mm[active], shift))
            away.append(np.linalg.norm(_from_nearest(grid, middles, shift)[0], axis=1))
        return cls(np.stack(out, axis=2).astype(np.float32), np.array(away))


def _from_nearest(grid: SplineGrid, x_mm: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3), in cells, from the nearest middle of a sphere of a lattice, and the number of that sphere (n, 3)."""
    at = x_mm / float(np.prod(grid.step_mm)) ** (1.0 / 3.0) - shift
    nearest = np.round(at / APART)
    return at - APART * nearest, nearest


def _displacement(grid: SplineGrid, x_mm: FloatArray, shift: FloatArray) -> FloatArray:
    """Return the displacement (n, 3), mm: spheres that swell by 1 in a medium that keeps its volume, the sign alternating."""
    arm, nearest = _from_nearest(grid, x_mm, shift)
    out = np.zeros_like(arm)
    for near in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3):
        d = arm - APART * near
        r = np.maximum(np.linalg.norm(d, axis=1, keepdims=True), RADIUS)
        sign = 1.0 - 2.0 * ((nearest + near).sum(axis=1, keepdims=True) % 2.0)
        out += sign / 3.0 * d * (RADIUS / r) ** 3
    return np.asarray(out * float(np.prod(grid.step_mm)) ** (1.0 / 3.0))


def hidden_dilatation(
    fit: CorrelationFit, c: FloatArray, trial: TrialParts, loads: AnyFloatArray, noise: Float32Array, some: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the variances (m,) of what may be hidden: of the displacement along every axis, mm^2, and of a component of strain.

    Parameters
    ----------
    fit : CorrelationFit
        Whose equations are assembled at coefficients c and the weights of the penalties.
    c : ndarray, shape (NZ, NY, NX, 3)
        Coefficients, mm.
    trial : TrialParts
        Trial parts.
    loads : ndarray, shape (n, 3, DRAWS)
        What the matrix of the intensities alone makes of their coefficients.
    noise : ndarray, shape (n, 3, s)
        Coefficients, mm, that residuals of noise alone leave.
    some : ndarray, shape (m,), bool
        Cells in which volume may change.
    """
    system = fit.system
    if not some.any():
        return np.zeros(len(some)), np.zeros(len(some))
    response = system.solved_many(np.ascontiguousarray(loads, dtype=np.float32), RESPONSE_TOLERANCE)[0]
    lost = trial.coefficients - response
    deformation, volume = deformation_at_middles(fit, c), system.gauss_volume

    def dilatation(change: Float32Array) -> FloatArray:
        return fit.windowed(volume * dilatation_square(deformation, gradients_of(fit, change)), WINDOW)

    sums = np.zeros((len(some), 5))
    for k, away in enumerate(trial.away):
        core, near = np.exp(-0.5 * (away / CORE) ** 2) * some, (away < REACH) & some
        moved = (system.at_middles(lost[:, :, k], every=True) ** 2).sum(axis=1) / 3.0
        strained = strain_square(deformation, gradients_of(fit, lost[:, :, k]))
        sums += np.stack([core * dilatation(response[:, :, k]), core, near * moved, near * strained, near], axis=1)
    seen, cores, moved, strained, many = fit.windowed(sums, WINDOW).T
    alone = sum((dilatation(noise[..., s]) for s in range(noise.shape[2])), start=np.zeros(len(some))) / noise.shape[2]
    # of the mean square of the dilatation, in that of noise alone: what a dilatation by 1 would add, and what was found
    added = seen / np.maximum(cores * alone, 1e-30)
    beyond = np.maximum(demanded_dilatation(fit, noise, c) - 1.0, 0.0)
    square = np.minimum(beyond / np.maximum(added, 1e-30), LARGEST**2) * some / np.maximum(many, 1e-30)
    variances = np.stack([square * moved, square * strained, some], axis=1)
    of_place, of_strain, known = fit.windowed(variances, SPREAD).T
    return of_place / np.maximum(known, 1e-30), of_strain / np.maximum(known, 1e-30)
