"""Equilibrium gap method in batch form: equilibrium of all nodes in all load cases as one linear system in the moduli.

The method is that of :cite:t:`claire2004`, and equation (3.34) of :cite:t:`hirai2008`; the unknowns are lambda and mu of every zone. With
fewer equations than unknowns the minimum-norm solution satisfies every equation and need not be close to the truth:
`EquilibriumGapEstimate.determined` states which moduli the equations determine. Noise in the displacement enters the matrix, which makes
least squares underestimate the moduli (errors in variables); `naibu.identification.equilibrium_gap.weighted` removes that bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.optimize import lsq_linear

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.status import Status
from naibu.identification.equilibrium_gap.equations import LoadCaseEquations, load_case_equations, require_scale
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw

EquilibriumGapMethod = Literal["least_squares", "minimum_norm", "bounded"]
MOST_UNKNOWNS = 4000  # a dense decomposition of more would take minutes and gigabytes
MOST_ACTIVE = 100  # unknowns up to which the exact method of active bounds is used, which takes a step for each
RANK_TOLERANCE = 1e-9  # of the largest singular value; displacements of a direct solver are good to about 1e-12
LOOSE = 1e-5  # part of a determined unknown that may lie in the null space
CONTRADICTION = 3.0  # a load case fits alone this many times better than with the others ...
UNEXPLAINED = 0.2  # ... which leave this fraction of its known forces unbalanced


@dataclass(frozen=True, slots=True, eq=False)
class EquilibriumGapEstimate:
    """Moduli of the zones from the equilibrium gap.

    Attributes
    ----------
    names : tuple of str
        The zones.
    lame_lambda, shear_modulus : ndarray, shape (count,)
        kPa; NaN where a method could not reach a zone.
    covariance : ndarray, shape (2 count, 2 count), or None
        Of all lambda, then all mu, kPa^2; only weighted methods know it.
    determined : ndarray, shape (count, 2), bool
        Whether the equations determine lambda and mu of a zone, or the choice among their solutions does.
    equations, unknowns, rank : int
        Equations with an unknown modulus, unknown moduli, and the number of their combinations that the equations determine.
    singular_values : ndarray
        Of the system, mm^2, the largest first; of the weighted system, 1/kPa.
    residual : float
        Norm of the equilibrium gap over that of the known forces.
    sweeps : int
        Linear systems solved.
    status : Status
        How the search ended.
    chi_squared : float
        Of the displacement corrections that restore equilibrium; NaN for methods that do not use the covariance of the noise.
    degrees_of_freedom : int
        Equations less unknowns.
    """

    names: tuple[str, ...]
    lame_lambda: FloatArray
    shear_modulus: FloatArray
    covariance: FloatArray | None
    determined: BoolArray
    equations: int
    unknowns: int
    rank: int
    singular_values: FloatArray
    residual: float
    sweeps: int = 1
    status: Status = Status.CONVERGED
    chi_squared: float = np.nan
    degrees_of_freedom: int = 0

    @property
    def young_modulus(self) -> FloatArray:
        """Young's modulus of every zone (count,), kPa; no elastic solid where it is not positive."""
        lame, mu = self.lame_lambda, self.shear_modulus
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(mu * (3.0 * lame + 2.0 * mu) / (lame + mu))

    @property
    def poisson_ratio(self) -> FloatArray:
        """Poisson's ratio of every zone (count,); no elastic solid outside (-1, 0.5)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.lame_lambda / (2.0 * (self.lame_lambda + self.shear_modulus)))

    @property
    def admissible(self) -> BoolArray:
        """Zones whose moduli an elastic solid can have (count,): positive shear and bulk modulus."""
        return np.asarray((self.shear_modulus > 0.0) & (self.lame_lambda + 2.0 / 3.0 * self.shear_modulus > 0.0))

    @property
    def standard_deviation(self) -> FloatArray:
        """Standard deviations (count, 2) of lambda and mu, kPa; NaN where the method knows none."""
        if self.covariance is None:
            return np.full((len(self.names), 2), np.nan)
        return np.asarray(np.sqrt(np.diag(self.covariance)).reshape(2, -1).T, dtype=np.float64)

    @property
    def engineering_deviation(self) -> FloatArray:
        """Standard deviations (count, 2) of Young's modulus, kPa, and Poisson's ratio, to first order; NaN where the method knows none."""
        lame, mu = self.lame_lambda, self.shear_modulus
        if self.covariance is None:
            return np.full((len(lame), 2), np.nan)
        k = np.arange(len(lame))
        joint = np.stack([self.covariance[k, k], self.covariance[k, k + len(k)], self.covariance[k + len(k), k + len(k)]])
        square = (lame + mu) ** 2
        of_young = np.stack([mu**2, 3.0 * lame**2 + 4.0 * lame * mu + 2.0 * mu**2]) / square
        of_poisson = np.stack([0.5 * mu, -0.5 * lame]) / square
        variances = [s[0] ** 2 * joint[0] + 2.0 * s[0] * s[1] * joint[1] + s[1] ** 2 * joint[2] for s in (of_young, of_poisson)]
        return np.asarray(np.sqrt(np.stack(variances, axis=1)), dtype=np.float64)


def batch_equilibrium_gap(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    zones: Zones,
    *,
    method: EquilibriumGapMethod = "least_squares",
    law: SimplexLaw = "linear",
    thickness_mm: float = 1.0,
    about: tuple[float, float] | None = None,
    rank_tolerance: float = RANK_TOLERANCE,
) -> EquilibriumGapEstimate:
    """Identify the moduli of all zones from the equilibrium gap at all nodes (:cite:p:`claire2004`).

    Parameters
    ----------
    mesh : Mesh
        Lines, triangles (plane strain) or linear tetrahedra.
    load_cases : sequence of FieldLoadCase
        One push or several.
    zones : Zones
        What is known and what is sought.
    method : {"least_squares", "minimum_norm", "bounded"}
        ``"least_squares"`` asks that the equations fix every modulus; ``"minimum_norm"`` takes, of all solutions of least squares, the
        smallest; ``"bounded"`` keeps lambda and mu from being negative.
    law : {"linear", "neo_hookean", "saint_venant_kirchhoff"}
        Equilibrium is linear in the moduli for all of them.
    thickness_mm : float
        Of triangles; matters where forces are known.
    about : (float, float), optional
        Young's modulus, kPa, and Poisson's ratio: ``"minimum_norm"`` then finds the solution nearest to them. Zero moduli by default.
    rank_tolerance : float
        Singular values below this fraction of the largest count as zero.

    Raises
    ------
    InputError
        No known modulus or force, too few or dependent equations for ``"least_squares"``, load cases that contradict each other, or
        data that do not fit (see `load_case_equations`).

    Notes
    -----
    Every load case counts with the size of its forces: a push twice as deep has four times the weight in the sum of squares.
    """
    if method not in get_args(EquilibriumGapMethod):
        raise InputError(f"method {method!r} is not known; use one of {', '.join(get_args(EquilibriumGapMethod))}")
    if about is not None and method != "minimum_norm":
        raise InputError(f"`about` chooses among solutions of minimum norm; method {method!r} has no use for it")
    systems = load_case_equations(mesh, load_cases, zones, law=law, thickness_mm=thickness_mm)
    parts = [_informative(system) for system in systems]
    matrix, right = _stacked(parts)
    require_scale(systems, right)
    _require_columns(matrix, zones)
    left, singular, rows = np.linalg.svd(matrix, full_matrices=False)
    rank = int((singular > rank_tolerance * singular[0]).sum())
    determined = _determined(rows[:rank])
    if method == "least_squares":
        _require_rank(rank, matrix.shape, determined, zones, len(load_cases))
    if method == "bounded":
        solution = _bounded(matrix, right)
    else:
        start = np.repeat(lame_parameters(*about), zones.count) if about is not None else np.zeros(matrix.shape[1])
        solution = start + rows[:rank].T @ ((left[:, :rank].T @ (right - matrix @ start)) / singular[:rank])
    misfit = matrix @ solution - right
    _require_agreement([system.name for system in systems], parts, misfit)
    lame, mu = solution.reshape(2, -1)
    residual = float(np.linalg.norm(misfit) / np.linalg.norm(right))
    flags = determined.reshape(2, -1).T
    return EquilibriumGapEstimate(zones.names, lame, mu, None, flags, len(right), matrix.shape[1], rank, singular, residual)


def _informative(system: LoadCaseEquations) -> tuple[FloatArray, FloatArray]:
    """Dense equations of a load case that hold an unknown."""
    if 2 * system.zones.count > MOST_UNKNOWNS:
        raise InputError(
            f"{2 * system.zones.count} unknown moduli are too many for the equilibrium gap method (at most {MOST_UNKNOWNS}): join cells "
            "to zones, or match displacements with regularization"
        )
    matrix, right = system.columns()
    informative = system.informative
    return matrix[informative].toarray(), right[informative]


def _stacked(parts: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    return np.vstack([matrix for matrix, _ in parts]), np.concatenate([right for _, right in parts])


def _bounded(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Non-negative least squares with columns scaled to one length."""
    length = np.linalg.norm(matrix, axis=0)
    method: Literal["bvls", "trf"] = "bvls" if matrix.shape[1] <= MOST_ACTIVE else "trf"
    return np.asarray(lsq_linear(matrix / length, right, bounds=(0.0, np.inf), method=method, tol=1e-12).x / length)


def _determined(basis: FloatArray) -> BoolArray:
    """Unknowns that lie in the space spanned by orthonormal rows (r, u)."""
    return np.asarray(1.0 - np.einsum("ru,ru->u", basis, basis) < LOOSE**2)


def _require_columns(matrix: FloatArray, zones: Zones) -> None:
    """Refuse zones that no equation holds."""
    empty = np.asarray(np.abs(matrix).sum(axis=0).reshape(2, -1).sum(axis=0) == 0.0)
    if empty.any():
        raise InputError(
            f"{_listed(zones.names, empty)} appear in no equation: no node there has data around it and is free of unknown forces; give "
            "data there, or count these cells to a neighbouring zone"
        )


def _require_rank(rank: int, shape: tuple[int, ...], determined: BoolArray, zones: Zones, n_load_cases: int) -> None:
    """Refuse systems that leave a modulus open."""
    equations, unknowns = shape
    if rank == unknowns:
        return
    remedy = "add load cases that push differently, join cells to zones, or take method='minimum_norm'"
    if equations < unknowns:
        load_cases = "1 load case gives" if n_load_cases == 1 else f"{n_load_cases} load cases give"
        raise InputError(f"{load_cases} {equations} equations for {unknowns} unknown moduli; {remedy}")
    open_zones = np.asarray(~determined.reshape(2, -1).all(axis=0), dtype=bool)
    raise InputError(
        f"{equations} equations fix only {rank} of {unknowns} combinations of the moduli; open are those of "
        f"{_listed(zones.names, open_zones)}: {remedy}"
    )


def _listed(names: Sequence[str], chosen: BoolArray) -> str:
    picked = [repr(name) for name, keep in zip(names, chosen, strict=True) if keep]
    return ", ".join(picked[:3]) + (f" and {len(picked) - 3} more zones" if len(picked) > 3 else "")


def _require_agreement(names: Sequence[str], parts: Sequence[tuple[FloatArray, FloatArray]], misfit: FloatArray) -> None:
    """Refuse load cases each of which makes sense alone, but not together."""
    start, together, alone = 0, [], []
    for _, right in parts:
        scale = max(float(np.linalg.norm(right)), 1e-300)
        together.append(float(np.linalg.norm(misfit[start : start + len(right)])) / scale)
        start += len(right)
    if len(parts) < 2 or max(together) < UNEXPLAINED:
        return
    for (matrix, right), fraction in zip(parts, together, strict=True):
        if not right.any():
            alone.append(fraction)
            continue
        found = np.linalg.lstsq(matrix, right, rcond=RANK_TOLERANCE)[0]
        alone.append(float(np.linalg.norm(matrix @ found - right) / np.linalg.norm(right)))
    # a load case with more unknowns than equations fits alone whatever it is: then only complete failure counts
    spare = all(len(right) > matrix.shape[1] for matrix, right in parts)
    worst = int(np.argmax(together))
    if (spare and together[worst] > CONTRADICTION * max(alone)) or (together[worst] > 0.98 and max(alone) < 0.1):
        raise InputError(
            f"the load cases {', '.join(map(repr, names))} contradict each other: alone they leave {100.0 * max(alone):.2g} % of the known "
            f"forces unbalanced, together {100.0 * together[worst]:.0f} % of those of {names[worst]!r}; check the order of the fields, "
            "their frames and units, which nodes are loaded, and the forces"
        )
