"""Uncertainty of identified moduli: Fisher information, Cramer-Rao bound (:cite:p:`kay1993`), resolution, and a summary in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl
from scipy.special import ndtri

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import FieldElements, LawName
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, Point, logarithms, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Objective
from naibu.identification.from_fields.inversion.told_combinations import UNBOUNDED
from naibu.identification.from_fields.inversion.truncated_newton import RegularizedSystem, conjugate_gradients
from naibu.identification.verdict import UNDETERMINED

UNKNOWN_BELOW = 1e-12  # fraction of the largest eigenvalue of the information below which a combination is not determined at all
PROBES, RESOLUTION_SOLVED = 24, 0.03  # random vectors, and what solutions leave of them: less than what so few leave in doubt
WELL, POORLY = 0.1, 0.5  # standard deviations of a logarithm of a modulus that are called well and poorly determined
POISSON_POORLY = 0.1
NOT_DETERMINED, NOT_USABLE = "not determined", "not to be used"
EXACT = 1e-6  # standard deviation of a logarithm that is rounding: that of the modulus whose multiples the others are
UNIT = "the unit of the others"
MESH_DEPENDENT = "not determined (depends on the mesh)"
RESOLVED = 0.5
HANGS = 1.5  # times its standard deviation with the law taken for right: what is so much less certain hangs on the law


class LawPart(NamedTuple):
    """What not knowing the law changes: logarithms (2 k,) with its shape sought, and by how much their covariance (2 k, 2 k) is more."""

    shift: FloatArray
    covariance: FloatArray

    @property
    def second_moment(self) -> FloatArray:
        """What it adds to the second moment (2 k, 2 k) of errors of moduli that were found with the law taken for right."""
        return np.asarray(self.covariance + np.outer(self.shift, self.shift))


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Fisher information and covariance of the moduli of k zones.

    Attributes
    ----------
    information : ndarray, shape (2 k, 2 k)
        Fisher information of ln mu, then ln(kappa / mu), the displacement of loaded nodes estimated as well.
    covariance : ndarray, shape (2 k, 2 k)
        Its inverse, and what else there is to errors; infinite on the diagonal where a modulus is not determined.
    stretch : ndarray, shape (2 k,), or None
        Factors by which standard deviations of logarithms are larger than where the data were fitted, because errors of mu / kappa stayed
        while the size of elements was taken off it; None where nothing was.
    sides : ndarray, shape (2, k), or None
        How far the lower and the upper bound of ln E are away, over what its standard deviation says; None where they are as far.
    law : LawPart or None
        What of the covariance is that of the form of the law; None where that was not asked for.
    """

    information: FloatArray
    covariance: FloatArray
    stretch: FloatArray | None = None
    sides: FloatArray | None = None
    law: LawPart | None = None

    @classmethod
    def of(cls, information: FloatArray, noise_factor: float = 1.0) -> Uncertainty:
        """Invert an information matrix, for noise that is `noise_factor` times what was stated."""
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
        lost = values <= UNKNOWN_BELOW * max(float(values[-1]), 1e-300)
        vectors = vectors / scale[:, None]
        kept = vectors[:, ~lost]
        covariance = kept / values[~lost] @ kept.T
        shared = (np.abs(vectors[:, lost] * scale[:, None]) > 1e-6).any(axis=1)
        covariance[shared, shared] = np.inf
        return cls(information / noise_factor**2, covariance * noise_factor**2)

    def with_added(self, covariance: FloatArray) -> Uncertainty:
        """Return the uncertainty with independent errors of another covariance (2 k, 2 k) added; the information stays that of the data."""
        return replace(self, covariance=self.covariance + covariance)

    def with_law(self, law: LawPart | None) -> Uncertainty:
        """Return the uncertainty that holds that of the form of the law, where there is any."""
        return self if law is None else replace(self.with_added(law.second_moment), law=law)

    @property
    def if_law_exact(self) -> Uncertainty:
        """The uncertainty with the law taken for right."""
        return self if self.law is None else replace(self.with_added(-self.law.second_moment), law=None)

    def stretched(self, stretch: FloatArray) -> Uncertainty:
        """Return the uncertainty of logarithms whose errors are larger by factors (2 k,); the information stays that of the data."""
        return replace(self, covariance=self.covariance * np.outer(stretch, stretch), stretch=stretch)

    def with_sides(self, sides: FloatArray) -> Uncertainty:
        """Return the uncertainty whose bounds of ln E lie `sides` (2, k) times as far below and above; ln mu errs by the mean of both."""
        mean = sides.mean(axis=0)
        factors = np.concatenate([mean, np.ones_like(mean)])
        return replace(self, covariance=self.covariance * np.outer(factors, factors), sides=sides / mean)

    def standard_deviations(self) -> FloatArray:
        """Return those of ln mu, then ln(kappa / mu) (2 k,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def of_young_and_poisson(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the standard deviations of ln E (k,) and of Poisson's ratio (k,)."""
        k = len(theta) // 2
        of_young, of_poisson = young_and_poisson_slopes(theta)
        blocks = np.stack([[self.covariance[i * k + np.arange(k), j * k + np.arange(k)] for j in range(2)] for i in range(2)])
        lost = ~np.isfinite(blocks).all(axis=(0, 1))
        blocks[:, :, lost] = 0.0
        young, poisson = (np.sqrt(np.maximum(np.einsum("ik,ijk,jk->k", s, blocks, s), 0.0)) for s in (of_young, of_poisson))
        return np.where(lost, np.inf, young), np.where(lost, np.inf, poisson)


def young_and_poisson_slopes(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of ln E and of Poisson's ratio with respect to ln mu and ln(kappa / mu), (2, k) each."""
    ratio = np.exp(theta.reshape(2, -1)[1])
    ones = np.ones_like(ratio)
    return np.stack([ones, 1.0 / (3.0 * ratio + 1.0)]), np.stack([0.0 * ones, 9.0 * ratio / (2.0 * (3.0 * ratio + 1.0) ** 2)])


def cramer_rao_bound(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    zones: Zones,
    lame_lambda: FloatArray,
    shear_modulus: FloatArray,
    states: Sequence[FloatArray],
    *,
    law: LawName = "linear",
    elements: FieldElements = "accurate",
) -> Uncertainty:
    """Return the Cramer-Rao bound at true moduli and displacements, the motion of loaded nodes being unknown.

    Parameters
    ----------
    mesh, load_cases, zones, law, elements
        As for `identify_field`; of the load cases the points, covariances and loaded components count, not the measurements.
    lame_lambda, shear_modulus : ndarray, shape (count,)
        True moduli of the zones, kPa.
    states : sequence of ndarray, shape (n, d)
        True displacement of every load case, mm.
    """
    model = FieldModel(mesh, load_cases, zones, law, elements)
    point = model.evaluate(logarithms(lame_lambda, shear_modulus), [model.on_all_nodes(u) for u in states])
    return Uncertainty.of(information_at(model, point))


def information_at(model: FieldModel, point: Point) -> FloatArray:
    """Return the Fisher information (2 count, 2 count) of the logarithms of all zones' moduli at a point, which must be evaluated last."""
    return model.linearised(point).concentrated(np.eye(2 * model.zones.count)).hessian


def resolution(at: Linearised, objective: Objective, *, explicit: bool, probes: int = PROBES, seed: int = 0) -> FloatArray:
    """Return by how much an estimate under a penalty follows the truth, for every logarithm (2 count,): 1 is all, 0 not at all.

    It is the diagonal of ``(A + P)^-1 A`` with the information A and the penalty's Hessian P: exact from explicit matrices, else its
    estimate from products with random signs (:cite:p:`bekas2007`), which has random errors (single values may leave the range from 0 to 1).
    """
    curvature = objective.curvature(at.point.theta)
    size = curvature.shape[0]
    if explicit:
        data = at.concentrated(np.eye(size)).hessian
        total = data + curvature.toarray() + 1e-9 * float(np.diag(data).max()) * np.eye(size)
        return np.asarray(np.diag(sl.solve(total, data, assume_a="pos")))
    system = RegularizedSystem(at, curvature)
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], size=(probes, size)).T
    # (A + P)^-1 A s = s - (A + P)^-1 P s, the loaded components following
    right = [curvature @ signs, *(np.zeros((len(o.unknown), probes)) for o in at.model.observed)]
    lost = conjugate_gradients(system.product, system.preconditioned, right, RESOLUTION_SOLVED, 200)[0][0]
    return np.asarray((signs * (signs - lost)).mean(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBudget:
    """Where the uncertainty of moduli stems from.

    Attributes
    ----------
    noise, mesh, known : ndarray, shape (2 k,)
        Standard deviations of ln mu, then ln(kappa / mu), from the measurement, from what extrapolation to vanishing element size leaves
        in doubt, and from the stated uncertainty of known regions and of borders. NaN for the mesh where its error was not estimated.
    shared : float
        By how much errors that neighbours share raised the variance from the measurement, 1 or more.
    """

    noise: FloatArray
    mesh: FloatArray
    known: FloatArray
    shared: float


def intervals(theta: FloatArray, found: Uncertainty, level: float = 0.95) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of Young's modulus (k, 2), kPa, and of Poisson's ratio (k, 2) that hold the truth with a probability `level`.

    Errors are normal in a logarithm: of E, and of mu / kappa before what the size of elements added to it was taken off. Towards
    incompressibility they are normal in mu / kappa itself: where its lower bound is below 0, Poisson's ratio may be 0.5. A modulus known
    to no factor of `UNBOUNDED` has no bounds. Bounds that hold the form of the law hold both intervals, that with the law taken for right,
    and that with its shape sought.
    """
    exact = found.if_law_exact
    if found.law is None:
        return _bounds(theta, exact, level)
    pairs = zip(_bounds(theta, exact, level), _bounds(theta + found.law.shift, exact.with_added(found.law.covariance), level), strict=True)
    young, poisson = (np.stack([np.minimum(a, b)[:, 0], np.maximum(a, b)[:, 1]], axis=1) for a, b in pairs)
    return young, poisson


def _bounds(theta: FloatArray, found: Uncertainty, level: float) -> tuple[FloatArray, FloatArray]:
    k, quantile = len(theta) // 2, float(ndtri(0.5 + 0.5 * level))
    of_young, _ = found.of_young_and_poisson(theta)
    half = quantile * of_young[:, None] * (np.ones((k, 2)) if found.sides is None else found.sides.T)
    half = np.where(half > np.log(UNBOUNDED), np.inf, half)
    young = young_and_poisson(theta)[0][:, None] * np.exp(half * np.array([-1.0, 1.0]))
    sd = quantile * found.standard_deviations()[k:]
    stretch = np.ones(k) if found.stretch is None else found.stretch[k:]
    with np.errstate(over="ignore", divide="ignore"):
        most = 1.0 + stretch * np.expm1(np.where(np.isfinite(sd), sd, 1e3 * stretch) / stretch)
        ratio = np.exp(theta[k:])[:, None] / np.stack([most, np.maximum(1.0 - sd, 0.0)], axis=1)
    return young, 0.5 - 1.5 / (3.0 * ratio + 1.0)


def report(
    zones: Zones,
    theta: FloatArray,
    found: Uncertainty,
    *,
    budget: ErrorBudget | None = None,
    usable: bool = True,
    sure: bool = True,
    unit: str = " kPa",
    apart: Sequence[str] = (),
) -> tuple[str, ...]:
    """Say in words how well every zone's moduli are determined, from what the uncertainty stems, and what is determined worst.

    Nothing is called well determined unless the model explains the data and its elements are fine enough (`sure`); nor anything determined
    where the result is not `usable`, or of zones set `apart`, which depend on the mesh. `unit` is that of moduli: none of multiples.
    """
    young, poisson = young_and_poisson(theta)
    of_young, of_poisson = found.of_young_and_poisson(theta)
    within, exact = intervals(theta, found), intervals(theta, found.if_law_exact)[0]
    lines, hangs = [], by_law(found, theta)
    for i, name in enumerate(zones.names):
        how = grade(of_young[i], usable=usable, sure=sure, apart=name in apart)
        line = _sentence(name, young[i], of_young[i], within[0][i], poisson[i], of_poisson[i], within[1][i], unit, how)
        if hangs[i]:
            line += f" If the law is exact, {exact[i, 0]:.4g} to {exact[i, 1]:.4g}{unit}."
        lines.append(line + ("" if budget is None or not np.isfinite(within[0][i, 1]) else _parts(budget, i, zones.count)))
    return (*lines, _worst(zones, found))


def by_law(found: Uncertainty, theta: FloatArray) -> BoolArray:
    """Whether not knowing the law makes the standard deviation of ln E of a zone (k,) half as large again or more."""
    all_of_it, exact = (one.of_young_and_poisson(theta)[0] for one in (found, found.if_law_exact))
    return np.isfinite(exact) & (exact > EXACT) & (all_of_it > HANGS * exact)


def grade(of_young: float, *, usable: bool, sure: bool, apart: bool) -> str:
    """Return in words how well Young's modulus is determined, of which `of_young` is the standard deviation of the logarithm."""
    if not np.isfinite(of_young):
        return NOT_DETERMINED
    if not usable:
        return NOT_USABLE
    if of_young < EXACT:
        return UNIT
    if apart:
        return MESH_DEPENDENT
    if of_young * float(ndtri(0.975)) > np.log(UNDETERMINED):
        return NOT_DETERMINED
    best = "well" if sure else "within the model"
    return f"{best if of_young < WELL else 'roughly' if of_young < POORLY else 'poorly'} determined"


def _sentence(
    name: str,
    young: float,
    of_young: float,
    e: FloatArray,
    poisson: float,
    of_poisson: float,
    nu: FloatArray,
    unit: str,
    how: str,
) -> str:
    if not np.isfinite(e[1]):
        return f"{name}: the measurements do not determine its moduli."
    text = f"{name}: Young's modulus {young:.4g}{unit} is {how} (standard error {100 * of_young:.2g} %, "
    text += f"95 % interval {e[0]:.4g} to {e[1]:.4g}{unit})"
    if of_poisson > POISSON_POORLY:
        return text + f"; Poisson's ratio {poisson:.3f} is not (standard error {of_poisson:.2g}): take it from elsewhere."
    return text + f", Poisson's ratio {poisson:.3f} ({nu[0]:.3f} to {nu[1]:.3f})."


def _parts(budget: ErrorBudget, zone: int, count: int) -> str:
    noise, mesh, known = (100.0 * float(values[zone]) for values in (budget.noise, budget.mesh, budget.known))
    parts = [f"measurement {noise:.2g} %", f"elements {mesh:.2g} %" if np.isfinite(mesh) else "elements not estimated"]
    if known > 0.0:
        parts.append(f"known values and borders {known:.2g} %")
    shared = f" Errors that neighbours share raised the first {np.sqrt(budget.shared):.2g} times." if budget.shared > 1.0 else ""
    return f" Of its shear modulus: {', '.join(parts)}.{shared}"


def _worst(zones: Zones, found: Uncertainty) -> str:
    values, vectors = np.linalg.eigh(found.information)
    worst = vectors[:, 0] / np.abs(vectors[:, 0]).max()
    k = zones.count
    names = [f"mu of {n}" for n in zones.names] + [f"kappa / mu of {n}" for n in zones.names]
    parts = [i for i in np.argsort(-np.abs(worst)) if abs(worst[i]) > 0.2][:4]
    towards = ", ".join(f"{names[i]} {'up' if worst[i] * worst[parts[0]] > 0 else 'down'}" for i in parts)
    sd = 1.0 / np.sqrt(max(float(values[0]), 1e-300)) * float(np.abs(vectors[:, 0]).max())
    several = "together " if len(parts) > 1 else ""
    if sd > np.log(UNBOUNDED):
        return f"Least determined among {2 * k} numbers: {towards}; any value fits."
    much = f"by {100 * sd:.2g} %" if sd < 1.0 else f"{np.exp(sd):.2g} times"
    return f"Least determined among {2 * k} numbers: {towards}; {several}{much} before the fit exceeds the noise."


def resolution_report(zones: Zones, centres: FloatArray, resolved: FloatArray) -> tuple[str, ...]:
    """Say in words which of many zones (centres (count, d), mm) the measurements resolve, and in which modulus.

    Parameters
    ----------
    zones : Zones
        The zones whose moduli varied freely.
    centres : ndarray, shape (count, d)
        Where they are, mm.
    resolved : ndarray, shape (2 count,)
        Resolution of ln mu, then ln(kappa / mu).
    """
    lines = []
    for what, r in zip(("shear modulus", "ratio of bulk to shear modulus"), resolved.reshape(2, -1), strict=True):
        low = r < RESOLVED
        lines.append(
            f"{what}: {100 * (1 - low.mean()):.0f} % of {zones.count} elements are resolved one by one (resolution above {RESOLVED:g}); "
            f"the measurements determine {r.sum():.0f} numbers in all, the rest follows neighbours."
        )
        if low.any() and not low.all():
            where = [
                f"{axis} {a:.3g} to {b:.3g}" for axis, a, b in zip("xyz", *np.quantile(centres[low], [0.1, 0.9], axis=0), strict=False)
            ]
            lines.append(f"  least resolved: {_named(zones, r, low)}; most of them at {', '.join(where)} mm.")
    return tuple(lines)


def _named(zones: Zones, r: FloatArray, low: BoolArray) -> str:
    order = np.argsort(r)[: min(3, int(low.sum()))]
    return ", ".join(f"{zones.names[i]} ({r[i]:.2g})" for i in order)
