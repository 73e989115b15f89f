"""Weighted equilibrium gap: maximum likelihood with errors in variables, without the bias of least squares (:cite:p:`mikhail1976`).

The true displacement x of a load case satisfies ``c(x, p) = A(x) p - b(x) = 0`` at the nodes in equilibrium; the measured one differs from
it by noise of covariance Sigma. Linearised about a state (x, p) of the search, with the tangent T of c,

    r + A dp,   r = c(x, p) + T (measured - x),   S = T Sigma T^T,

dp minimises the norm of S^-1, and the displacement is updated to ``measured - Sigma T^T S^-1 (r + A dp)``, where the forces are in
equilibrium. This is the Gauss-Helmert model of least squares with conditions. Since A is evaluated at the equilibrated displacement and not
at the measured one, noise does not bias the moduli; since all residual forces are mapped back to displacements, stiff and compliant cells
have equal weight. Displacements of loaded nodes enter Sigma like all others: an unknown motion of the boundary is estimated along with the
moduli. Each sweep factorizes S once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.optimize import lsq_linear

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.core.status import Status
from naibu.identification.equilibrium_gap.batch import EquilibriumGapEstimate, batch_equilibrium_gap
from naibu.identification.equilibrium_gap.equations import LoadCaseEquations, load_case_equations
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw
from naibu.mechanics.linear_algebra.direct import direct_solver

FLOOR, CEILING = 1e-4, 1e6  # bounds of the moduli, in units of the known shear modulus; lambda may fall to zero
SOFTEST_START = 0.02  # the search starts from no smaller shear modulus, in the same unit, and from lambda >= mu: noise pulls both down
OPEN = 1e-12  # eigenvalue of the scaled information below which a combination of moduli is open
SHORTEST_STEP = 2.0**-10
LEVEL = 1e-7  # rise of the objective that counts as none: at finite strain it depends a little on where it is linearised


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """The linearised problem at moduli p and displacements x.

    Attributes
    ----------
    objective : float
        ``r S^-1 r``: chi squared where the covariance of the data is known.
    information, gradient : ndarray, shape (u, u) and (u,)
        ``A^T S^-1 A``, 1/kPa^2, and ``A^T S^-1 r``, 1/kPa.
    pulls : tuple of (ndarray, ndarray), shapes (n, d) and (n, d, u)
        ``Sigma T^T S^-1 r``, mm, and ``Sigma T^T S^-1 A``, mm/kPa, of every load case.
    """

    objective: float
    information: FloatArray
    gradient: FloatArray
    pulls: tuple[tuple[FloatArray, FloatArray], ...]

    def displacements(self, systems: Sequence[LoadCaseEquations], step: FloatArray) -> tuple[FloatArray, ...]:
        """Return the equilibrated displacement (n, d), mm, of every load case after a step (u,), kPa, of the moduli."""
        return tuple(b.field.displacement - residual - moduli @ step for b, (residual, moduli) in zip(systems, self.pulls, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """Data common to all sweeps: equations, covariance (n d, n d) of the nodes' displacement, mm^2, and bounds (u,) of the moduli, kPa."""

    systems: tuple[LoadCaseEquations, ...]
    covariances: tuple[sp.csr_matrix, ...]
    lower: FloatArray
    upper: FloatArray

    def swept(self, moduli: FloatArray, displacements: Sequence[FloatArray]) -> _Sweep:
        """Linearise all load cases, with one factorization each."""
        u = len(moduli)
        objective, information, gradient, pulls = 0.0, np.zeros((u, u)), np.zeros(u), []
        for system, covariance, x in zip(self.systems, self.covariances, displacements, strict=True):
            matrix, right = system.columns(x)
            tangent = system.tangent(x, moduli)
            residual = matrix @ moduli - right + tangent @ (system.field.displacement - x).ravel()
            spread = covariance @ tangent.T
            sides = np.column_stack([residual, matrix.toarray()])
            weighted = _solved(system.name, sp.csr_matrix(tangent @ spread), sides)
            products = sides.T @ weighted
            objective += float(products[0, 0])
            gradient += products[1:, 0]
            information += products[1:, 1:]
            pull = np.asarray(spread @ weighted).reshape(*x.shape, u + 1)
            pulls.append((pull[..., 0], pull[..., 1:]))
        return _Sweep(objective, 0.5 * (information + information.T), gradient, tuple(pulls))

    def tried(self, sweep: _Sweep, moduli: FloatArray, step: FloatArray) -> _Sweep | None:
        """Return the sweep after a step, or None where the objective rises or a cell turns inside out."""
        try:
            new = self.swept(moduli + step, sweep.displacements(self.systems, step))
        except InputError:
            return None
        return new if new.objective <= sweep.objective * (1.0 + LEVEL) + 1e-20 else None

    def step(self, sweep: _Sweep, moduli: FloatArray) -> FloatArray:
        """Return the change (u,), kPa, that minimises the linearised objective within the bounds."""
        scale = 1.0 / np.sqrt(np.diag(sweep.information))
        values, vectors = np.linalg.eigh(sweep.information * np.outer(scale, scale))
        if not values[0] > OPEN:
            zones = self.systems[0].zones
            worst = int(np.argmax(np.abs(vectors[:, 0]))) % zones.count
            raise InputError(
                f"{sum(len(b.rows) for b in self.systems)} equations leave a combination of the {len(moduli)} moduli open, which holds "
                f"zone {zones.names[worst]!r}; add load cases that push differently, or join cells to zones"
            )
        root = np.sqrt(values)[:, None] * vectors.T
        target = -(vectors.T @ (scale * sweep.gradient)) / np.sqrt(values)
        free = scale * (vectors @ (target / np.sqrt(values)))
        if ((moduli + free >= self.lower) & (moduli + free <= self.upper)).all():
            return np.asarray(free)
        bounds = ((self.lower - moduli) / scale, (self.upper - moduli) / scale)
        return np.asarray(scale * lsq_linear(root, target, bounds=bounds, method="bvls", tol=1e-12).x)


def weighted_equilibrium_gap(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    zones: Zones,
    *,
    law: SimplexLaw = "linear",
    thickness_mm: float = 1.0,
    interpolation_sd_mm: float = 0.0,
    start: tuple[FloatArray, FloatArray] | None = None,
    max_sweeps: int = 50,
    tolerance: float = 1e-6,
) -> EquilibriumGapEstimate:
    """Identify the moduli of all zones by the weighted equilibrium gap, the noise of the displacement taken into account.

    Parameters
    ----------
    mesh, load_cases, zones, law, thickness_mm
        As for `naibu.identification.equilibrium_gap.batch.batch_equilibrium_gap`. If the covariance of all fields is zero, all nodes
        have the same unknown variance.
    interpolation_sd_mm : float
        Standard deviation, mm, of what linear interpolation adds at nodes between the points of a field.
    start : tuple of ndarray, shape (count,)
        First lambda and mu of the zones, kPa; by default from non-negative least squares.
    max_sweeps : int
        Linearisations; each factorizes one matrix a load case.
    tolerance : float
        The search ends when a step would change no modulus by more than this fraction of the largest of its zone.

    Returns
    -------
    EquilibriumGapEstimate
        With the covariance, kPa^2: the inverse information, which is the Cramer-Rao bound at the estimate; scaled by the misfit where the
        variance of the data was not given. `equations` counts those without an unknown too: they smooth the displacement.

    Raises
    ------
    InputError
        Moduli that the data leave open, nodes that share their data (see `interpolation_sd_mm`), or as for `batch_equilibrium_gap`.
    """
    systems = load_case_equations(mesh, load_cases, zones, law=law, thickness_mm=thickness_mm)
    covariances, known_noise = _covariances(systems, interpolation_sd_mm)
    least = batch_equilibrium_gap(mesh, load_cases, zones, method="bounded", law=law, thickness_mm=thickness_mm)
    size = _unit(zones, least)
    lower = np.repeat([0.0, FLOOR * size], zones.count)
    search = _Search(systems, covariances, lower, np.full(len(lower), CEILING * size))
    moduli = _start(least, size) if start is None else np.concatenate([np.asarray(part, dtype=float) for part in start])
    if moduli.shape != lower.shape or not ((moduli >= lower) & (moduli <= search.upper)).all():
        raise InputError(f"the start must be {zones.count} positive lambda and as many mu, kPa, not {start}")
    return _estimate(systems, *_descended(search, moduli, max_sweeps, tolerance), known_noise)


def _unit(zones: Zones, least: EquilibriumGapEstimate) -> float:
    """Mean known shear modulus, kPa, or that of the first guess where nothing is known."""
    known = zones.known_mu[np.isfinite(zones.known_mu)]
    return float(known.mean()) if len(known) else max(float(least.shear_modulus.mean()), 1e-12)


def _start(least: EquilibriumGapEstimate, size: float) -> FloatArray:
    mu = np.maximum(least.shear_modulus, SOFTEST_START * size)
    return np.asarray(np.minimum(np.concatenate([np.maximum(least.lame_lambda, mu), mu]), 0.1 * CEILING * size))


def _descended(search: _Search, moduli: FloatArray, max_sweeps: int, tolerance: float) -> tuple[_Sweep, FloatArray, int, Status]:
    """Gauss-Newton with step halving; returns the last sweep, its moduli, the number of sweeps and how it ended."""
    sweep = search.swept(moduli, [system.field.displacement for system in search.systems])
    # gradient and objective hold at displacements in equilibrium, to which the measured ones are corrected first
    sweep, count, fresh = search.swept(moduli, sweep.displacements(search.systems, np.zeros_like(moduli))), 2, True
    while True:
        step, length = search.step(sweep, moduli), 1.0
        largest = np.tile(np.abs(moduli.reshape(2, -1)).max(axis=0), 2)
        if (np.abs(step) <= tolerance * largest).all():
            return sweep, moduli, count, Status.CONVERGED
        new = None
        while new is None and length > SHORTEST_STEP and count < max_sweeps:
            count += 1
            new = search.tried(sweep, moduli, length * step)
            length *= 1.0 if new is not None else 0.5
        if new is not None:
            sweep, moduli, fresh = new, moduli + length * step, False
        elif not fresh and count < max_sweeps:
            sweep, count, fresh = search.swept(moduli, sweep.displacements(search.systems, np.zeros_like(moduli))), count + 1, True
        else:
            return sweep, moduli, count, Status.ITERATION_LIMIT


def _covariances(systems: Sequence[LoadCaseEquations], interpolation_sd_mm: float) -> tuple[tuple[sp.csr_matrix, ...], bool]:
    """Covariance of the nodes of every load case, and whether the data came with one."""
    if not (np.isfinite(interpolation_sd_mm) and interpolation_sd_mm >= 0.0):
        raise InputError(f"interpolation_sd_mm must be a number >= 0, not {interpolation_sd_mm:g}")
    given = [system.field.covariance.nnz > 0 and bool(system.field.covariance.diagonal().any()) for system in systems]
    if any(given) and not all(given):
        without = ", ".join(repr(b.name) for b, has in zip(systems, given, strict=True) if not has)
        raise InputError(f"the fields of {without} come without standard deviations, the others with; give sd_mm to all fields or to none")
    out = []
    for system, has in zip(systems, given, strict=True):
        d = system.body.dimension
        spread = sp.kron(system.field.weights, sp.identity(d), format="csr")
        covariance = system.field.covariance if has else spread @ spread.T
        extra = np.repeat(np.where(system.field.interpolated, interpolation_sd_mm**2, 0.0), d)
        if interpolation_sd_mm == 0.0 and len(system.rows) > d * (np.diff(system.field.weights.tocsc().indptr) > 0).sum():
            raise _shared(system.name)
        out.append(sp.csr_matrix(covariance + sp.diags(extra)))
    return tuple(out), all(given)


def _solved(load_case: str, matrix: sp.csr_matrix, sides: FloatArray) -> FloatArray:
    """Solve with the covariance of the residual, scaled to a unit diagonal."""
    diagonal = matrix.diagonal()
    if not (diagonal > 0.0).all():
        raise _shared(load_case)
    scale = 1.0 / np.sqrt(diagonal)
    scaled = sp.bsr_matrix(sp.diags(scale) @ matrix @ sp.diags(scale), blocksize=(1, 1))
    scaled.sort_indices()
    try:
        return np.asarray(scale[:, None] * direct_solver(scaled, symmetric=True).factorize(scaled).solve(scale[:, None] * sides))
    except ConvergenceError as error:
        raise _shared(load_case) from error


def _shared(load_case: str) -> InputError:
    return InputError(
        f"load case {load_case!r}: the covariance of the equilibrium equations is singular, for nodes share the data of the same points, "
        "or have no noise of their own; make the points the nodes of the mesh, or give interpolation_sd_mm, or standard deviations > 0"
    )


def _estimate(
    systems: Sequence[LoadCaseEquations], sweep: _Sweep, moduli: FloatArray, count: int, status: Status, known_noise: bool
) -> EquilibriumGapEstimate:
    zones = systems[0].zones
    equations = sum(len(system.rows) for system in systems)
    freedom = equations - len(moduli)
    covariance: FloatArray = np.asarray(np.linalg.inv(sweep.information), dtype=np.float64)
    if not known_noise:
        covariance = covariance * (sweep.objective / freedom if freedom > 0 else np.nan)
    squares = np.zeros(2)
    for system in systems:
        matrix, right = system.columns()
        informative = system.informative
        squares += [float(np.sum((matrix @ moduli - right)[informative] ** 2)), float(np.sum(right[informative] ** 2))]
    singular = np.asarray(np.sqrt(np.linalg.eigvalsh(sweep.information)[::-1].clip(0.0)), dtype=np.float64)
    lame, mu = moduli.reshape(2, -1)
    return EquilibriumGapEstimate(
        zones.names, lame, mu, covariance, np.ones((zones.count, 2), dtype=bool), equations, len(moduli), len(moduli), singular,
        float(np.sqrt(squares[0] / squares[1])), count, status, sweep.objective, freedom,
    )  # fmt: skip
