"""Dilatation that its penalty hides: the error, from what trial parts of known dilatation would have left in the field.

A part that swells keeps some of its dilatation in spite of the penalties, and the data pull at the rest. The pull on a trial part, over
what a part that swells by one would make it, is an estimate of its dilatation (a score test), whose variance is that of noise. Trial parts
about every place tell by how much a part may have swollen, and the displacement that is lost with it: much where noise hides it, and little
where the data decide. Their places are weighted by how probable the data make a part there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.results.cell_errors import deformation_at_middles, gradients_of, strain_square
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid
from naibu.imaging.volume_correlation.volume_changes import LARGEST

# cells: radius of the trial parts, and their distance. Smaller parts move their surroundings by little, larger ones are seen
RADIUS, APART = 1.75, 6.0
DRAWS = 16  # lattices of trial parts, displaced so that one or the other has a part near every cell
# additive recurrence of least discrepancy in three dimensions: powers of the inverse of the root of x^4 = x + 1
SHIFTS = 1.22074408460575947536 ** -np.arange(1.0, 4.0)
SPREAD = 0.7  # cells: SD of the window in which cells share what is hidden
REACH = 1.2 * RADIUS  # cells: within which the displacement is lost
MOST_EVIDENCE = 15.0  # logarithm of how much more probable a part at one place is than at another, beyond which it does not matter
LOSS_TOLERANCE = 0.01  # of the linear solves: conjugate gradients find the smooth part, in which the parts of a lattice differ, last


@dataclass(frozen=True, slots=True, eq=False)
class TrialParts:
    """Lattices of spheres that swell and shrink in turn by the factor 1 + 1 of their volume, to first order.

    Attributes
    ----------
    coefficients : ndarray, shape (n, 3, DRAWS), float32
        Of their displacement, mm.
    away : ndarray, shape (DRAWS, m)
        Distance of the middles of the cells from the nearest middle of a sphere, cells.
    of_node, of_cell : tuple of ndarray, shapes (n,) and (m,), int
        Number of that sphere in its lattice, of nodes and of cells.
    middles_mm : tuple of ndarray, shape (p, 3)
        Middles of the spheres of a lattice, mm along the axes of the volume.
    """

    coefficients: Float32Array
    away: FloatArray
    of_node: tuple[IntArray, ...]
    of_cell: tuple[IntArray, ...]
    middles_mm: tuple[FloatArray, ...]

    @classmethod
    def of(cls, system: SplineSystem) -> TrialParts:
        """Return them for all cells of a system."""
        grid, nodes, n = system.grid, system.grid.nodes_mm[system.active], system.n
        middles = grid.origin_mm + (system.cells[:, :1:-1] + 0.5) * grid.step_mm
        out, away, of_node, of_cell, at = [], [], [], [], []
        for k in range(DRAWS):
            shift = APART * ((k * SHIFTS) % 1.0)
            out.append(_displacement(grid, nodes, shift))
            arm, nearest = _from_nearest(grid, np.concatenate([nodes, middles]), shift)
            which, number = np.unique(nearest, axis=0, return_inverse=True)
            away.append(np.linalg.norm(arm[n:], axis=1))
            of_node.append(number.ravel()[:n])
            of_cell.append(number.ravel()[n:])
            at.append(_cell_mm(grid) * (APART * which + shift))
        return cls(np.stack(out, axis=2).astype(np.float32), np.array(away), tuple(of_node), tuple(of_cell), tuple(at))


def loaded_trial_parts(system: SplineSystem, matrix: Float32Array) -> tuple[TrialParts, Float32Array]:
    """Return trial parts, and the loads (n, 3, s) that the matrix (n, 3, 1029) of the intensities alone makes of them."""
    trial = TrialParts.of(system)
    return trial, system.multiplied(matrix, trial.coefficients)


def _cell_mm(grid: SplineGrid) -> float:
    """Return the size of a cube as large as a cell, mm."""
    return float(np.prod(grid.step_mm) ** (1.0 / 3.0))


def _from_nearest(grid: SplineGrid, x_mm: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3), in cells, from the nearest middle of a sphere of a lattice, and the number of that sphere (n, 3)."""
    at = x_mm / _cell_mm(grid) - shift
    nearest = np.round(at / APART)
    return at - APART * nearest, nearest


def _swelling(arm: FloatArray) -> FloatArray:
    """Return the displacement (..., 3) of a sphere that swells by 1 in a medium that keeps its volume, in cells from its middle."""
    r = np.maximum(np.linalg.norm(arm, axis=-1, keepdims=True), RADIUS)
    return np.asarray(arm / 3.0 * (RADIUS / r) ** 3)


def _displacement(grid: SplineGrid, x_mm: FloatArray, shift: FloatArray) -> FloatArray:
    """Return the displacement (n, 3), mm: spheres that swell by 1 in a medium that keeps its volume, the sign alternating."""
    arm, nearest = _from_nearest(grid, x_mm, shift)
    out = np.zeros_like(arm)
    for near in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3):
        sign = 1.0 - 2.0 * ((nearest + near).sum(axis=1, keepdims=True) % 2.0)
        out += sign * _swelling(arm - APART * near)
    return np.asarray(out * _cell_mm(grid))


def pull_of_parts(system: SplineSystem, pull: AnyFloatArray) -> FloatArray:
    """Return the work (NZ, NY, NX), on a part that swells by 1 about every node, of forces (n, 3) on the coefficients, times mm."""
    from scipy.signal import fftconvolve  # slow to load, with all of scipy.stats

    grid, full = system.grid, np.zeros((*system.active.shape, 3))
    full[system.active] = pull
    # offsets of nodes from one another, z, y, x
    offsets = np.meshgrid(*[np.arange(1.0 - s, s) * h for s, h in zip(grid.shape, grid.step_mm[::-1], strict=True)], indexing="ij")
    moved = _cell_mm(grid) * _swelling(np.stack(offsets[::-1], axis=-1) / _cell_mm(grid))
    # the displacement is odd: what lies along an offset from the part has the part along the opposite one
    return np.asarray(-sum(fftconvolve(full[..., a], moved[..., a], mode="same") for a in range(3)))


def hidden_dilatation(
    fit: CorrelationFit,
    c: FloatArray,
    trial: TrialParts,
    loads: AnyFloatArray,
    noise: Float32Array,
    some: BoolArray,
    pull: AnyFloatArray,
    robust: float,
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
    pull : ndarray, shape (n, 3)
        Forces of the intensities on the coefficients, which those of the penalties balance.
    robust : float
        By which robust weights make the matrix too large: see `naibu.imaging.volume_correlation.residual_noise.lost_to_robustness`.

    Notes
    -----
    With the matrix A of the equations, of which D is that of the intensities, a part of displacement t leaves of itself A^-1 D t. What is
    lost, ``h = t - A^-1 D t = A^-1 (A - D) t``, makes the intensities pull by t.D h, the information on its dilatation where the penalties
    state what else may be there. Noise may be larger than the weights of the voxels say: residuals of neighbours are correlated.
    """
    system = fit.system
    if not some.any():
        return np.zeros(len(some)), np.zeros(len(some))
    # A^-1 (A - D) t and not t - A^-1 D t, of which errors of the solution would be a large part where the data decide
    taken = system.multiplied(system.matrix, trial.coefficients) - loads
    lost, deformation = system.solved_many(np.ascontiguousarray(taken, dtype=np.float32), LOSS_TOLERANCE)[0], deformation_at_middles(fit, c)
    informed = (np.asarray(loads, dtype=float) * lost).sum(axis=1)
    by_noise = np.einsum("nik,nis->ks", lost, system.multiplied(system.matrix, noise), dtype=float)
    louder = max(1.0, float(((by_noise**2).mean(axis=1) / np.maximum(informed.sum(axis=0), 1e-30)).mean()))
    worked = pull_of_parts(system, pull)
    sums = np.zeros((len(some), 3))
    for k, away in enumerate(trial.away):
        at = (trial.middles_mm[k] - system.grid.origin_mm) / system.grid.step_mm + 1.0
        work = robust * ndimage.map_coordinates(worked, at[:, ::-1].T, order=1, mode="nearest")
        information = np.maximum(np.bincount(trial.of_node[k], informed[:, k], minlength=len(at)), 1e-30)
        # noise and what was assumed to be the largest dilatation bound it
        square = np.minimum((work / information) ** 2 + 1.0 / (information / louder + LARGEST**-2), LARGEST**2)
        evidence = np.exp(np.minimum(0.5 * work**2 / (louder * information), MOST_EVIDENCE))
        moved = (system.at_middles(lost[:, :, k], every=True) ** 2).sum(axis=1) / 3.0
        strained = strain_square(deformation, gradients_of(fit, lost[:, :, k]))
        here = trial.of_cell[k]
        weight = evidence[here] * ((away < REACH) & some)
        sums += weight[:, None] * np.column_stack([square[here] * moved, square[here] * strained, np.ones(len(some))])
    known = sums[:, 2] > 0.0
    variances = np.where(known[:, None], np.column_stack([sums[:, :2] / np.maximum(sums[:, 2:], 1e-30), known]), 0.0)
    of_place, of_strain, count = fit.windowed(variances, SPREAD).T
    return of_place / np.maximum(count, 1e-30), of_strain / np.maximum(count, 1e-30)
