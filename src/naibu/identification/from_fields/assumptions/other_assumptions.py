"""Sensitivity of identified moduli to what was assumed: the moduli of known regions, where borders lie, and the law.

As for the discretisation (`mesh_error`), the states under another assumption change the residuals, and the best moduli follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.identification.from_fields.forward.field_laws import FieldLaw, LawName, field_law
from naibu.identification.from_fields.forward.forward_model import Observed, Solvers, equilibrium
from naibu.identification.from_fields.forward.load_cases import KnownRegion, Zones
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised, moduli_of, young_and_poisson
from naibu.identification.from_fields.mesh_error import change_of_fit
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

OTHER_YOUNG, OTHER_POISSON = 0.1, 0.02  # changes whose effect is stated: relative, of Young's modulus; absolute, of Poisson's ratio
MOST_POISSON = 0.499
OTHER_LAW: dict[LawName, LawName] = {"linear": "neo_hookean", "neo_hookean": "linear"}
LAW_NAMES = {"linear": "small strain", "neo_hookean": "a neo-Hookean law at finite strain"}
ROUNDING = 1e-9  # of the unit of relative moduli, whose interval has no width


@dataclass(frozen=True, slots=True, eq=False)
class Assumption:
    """Another assumption, and what it would do to the moduli.

    Attributes
    ----------
    text : str
        The other assumption in words.
    theta : ndarray, shape (2 count,)
        By how much it would change ln mu and ln(kappa / mu) of the zones, to first order.
    standard_deviations : float
        How many standard deviations it is away from what was assumed; zero where it is a question of the model.
    """

    text: str
    theta: FloatArray
    standard_deviations: float

    def applied(self, theta: FloatArray) -> FloatArray:
        """Return the logarithms of the moduli (2 count,) under the assumption, from those found.

        A change that was found to first order is one of ln mu, and one of mu / kappa rather than of its logarithm, which data near
        incompressibility leave open by many times; where mu / kappa would fall below 0, ln(kappa / mu) is that of a Poisson's ratio of 0.5.
        """
        k = len(theta) // 2
        less = np.maximum(1.0 - self.theta[k:], 1e-12)
        return np.concatenate([theta[:k] + self.theta[:k], theta[k:] - np.log(less)])


@dataclass(frozen=True, slots=True, eq=False)
class MovedBorder:
    """The same cells where a border of regions may lie as well.

    Attributes
    ----------
    text : str
        In words, such as ``"with the border of 'pad' 0.25 mm further along z"``.
    points : ndarray, shape (n, d)
        Nodes of the mesh then, mm.
    standard_deviations : float
        How many standard deviations the border is away from where the mesh has it.
    """

    text: str
    points: FloatArray
    standard_deviations: float


def assumptions(
    at: Linearised, quadratic: Concentrated, law: LawName, stretch: FloatArray, borders: Sequence[MovedBorder] = ()
) -> tuple[Assumption, ...]:
    """Return what other moduli of the known regions, borders elsewhere, and the other law would do to the result.

    Borders are moved in meshes on whose own nodes equilibrium is computed, as it is on hexahedra. `stretch` (2 count,) is by how much more
    changes of logarithms are after extrapolation to vanishing element size (see `stretch_of`).
    """
    model, out = at.model, []
    for number, region in enumerate(model.zones.known):
        cells = model.zones.region_of_cell == number
        for text, young, poisson, sd in _others(region):
            lame, shear = moduli_of(model.zones, at.point.theta)
            lame[cells], shear[cells] = lame_parameters(young, poisson)
            changed = _refitted(at, quadratic, model.law, lame, shear)
            if changed is not None:
                out.append(Assumption(text, changed, sd))
    for border in borders if model.computed is model.mesh else ():
        changed = _with_border(at, quadratic, border.points)
        if changed is not None:
            out.append(Assumption(border.text, changed, border.standard_deviations))
    if model.mesh.dimension == 3:
        lame, shear = moduli_of(model.zones, at.point.theta)
        other = OTHER_LAW[law]
        changed = _refitted(at, quadratic, field_law(model.computed, other, averaged=model.averaged), lame, shear)
        if changed is not None:
            out.append(Assumption(f"with {LAW_NAMES[other]}", changed, 0.0))
    return tuple(replace(one, theta=one.theta * stretch) for one in out)


def covariance_of(found: tuple[Assumption, ...], size: int) -> FloatArray:
    """Return the covariance (size, size) of theta that stems from the stated uncertainty of known regions and of borders."""
    out = np.zeros((size, size))
    for one in found:
        if one.standard_deviations > 0.0:
            per_sd = one.theta / one.standard_deviations
            out += np.outer(per_sd, per_sd)
    return out


def holds(low: float, high: float, value: float) -> bool:
    """Whether an interval of positive moduli holds a value, but for rounding."""
    return bool(low * (1.0 - ROUNDING) <= value <= high * (1.0 + ROUNDING))


def effects(found: tuple[Assumption, ...], zones: Zones, theta: FloatArray, within: FloatArray) -> tuple[str, ...]:
    """Say what other assumptions would do to moduli that are determined, at most three each, and where that leaves their intervals.

    Parameters
    ----------
    found : tuple of Assumption
        From `assumptions`.
    zones : Zones
        Their names.
    theta : ndarray, shape (2 count,)
        Logarithms of the moduli.
    within : ndarray, shape (count, 2)
        Intervals of Young's modulus, kPa.
    """
    young, poisson = young_and_poisson(theta)
    lines, bounded = [], np.flatnonzero(np.isfinite(within[:, 1]))
    for one in found if len(bounded) else ():
        other, ratio = young_and_poisson(one.applied(theta))
        rows = [
            f"{zones.names[i]} {100 * (other[i] / young[i] - 1):+.2g} %, Poisson's ratio {ratio[i] - poisson[i]:+.3f}" for i in bounded[:3]
        ]
        out = [name for name, e, (low, high) in zip(zones.names, other, within, strict=True) if not holds(low, high, e)]
        left = f" {_named(out)} would leave the interval, which takes this assumption as given." if out else ""
        lines.append(f"{one.text[0].upper()}{one.text[1:]}, Young's modulus would change: {'; '.join(rows)}.{left}")
    return tuple(lines)


def _named(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} other zone{'s' if len(names) > 2 else ''}"


def other_poisson_ratio(poisson: float) -> float:
    """Return a Poisson's ratio near another one, by which the effect of not knowing it is found."""
    near = min(poisson + OTHER_POISSON, 0.5 * (poisson + 0.5), MOST_POISSON)
    return near if near - poisson >= 1e-3 else poisson - OTHER_POISSON


def _others(region: KnownRegion) -> list[tuple[str, float, float, float]]:
    """Return text, Young's modulus, Poisson's ratio and distance in standard deviations of other moduli of a region that is not rigid."""
    if region.is_rigid:
        return []
    young, poisson = region.young_modulus, region.poisson_ratio
    near = other_poisson_ratio(poisson)
    of_young = OTHER_YOUNG / region.young_modulus_sd if region.young_modulus_sd > 0.0 else 0.0
    of_poisson = abs(near - poisson) / region.poisson_ratio_sd if region.poisson_ratio_sd > 0.0 else 0.0
    stiffer = (1.0 + OTHER_YOUNG) * young
    other_ratio = (f"with Poisson's ratio {near:.4g} for {poisson:.4g} of {region.name!r}", young, near, of_poisson)
    if region.is_unit:
        return [other_ratio]
    return [(f"with {stiffer:.4g} kPa for {young:.4g} kPa of {region.name!r}", stiffer, poisson, of_young), other_ratio]


def _refitted(at: Linearised, quadratic: Concentrated, law: FieldLaw, lame: FloatArray, shear: FloatArray) -> FloatArray | None:
    """Return the change (2 count,) of theta when equilibrium is that of other moduli or another law; None where there is none."""
    try:
        return change_of_fit(at, quadratic, changes_under(at, law, lame, shear))
    except ConvergenceError:
        return None


def changes_under(at: Linearised, law: FieldLaw, lame: FloatArray, shear: FloatArray) -> list[FloatArray]:
    """Return by how much whitened residuals (q,) change with other moduli (m,), kPa, or another law, the loaded nodes moving as they do.

    Raises
    ------
    ConvergenceError
        There is no equilibrium.
    """
    solvers, changes = Solvers(law, at.model.points), []
    for o, u in zip(at.model.observed, at.point.states, strict=True):
        state, _ = equilibrium(law, solvers, lame, shear, o.load_case, u, b"")
        changes.append(np.asarray(o.operator @ (state - u).ravel()))
    return changes


def changes_on(at: Linearised, points: FloatArray) -> list[FloatArray]:
    """Return by how much whitened residuals (q,) change when the nodes of the mesh lie elsewhere (n, 3), mm, the loaded ones moving alike.

    Raises
    ------
    ConvergenceError
        There is no equilibrium.
    """
    model = at.model
    mesh = replace(model.mesh, points=points)
    body = field_law(mesh, "linear" if model.law.linear else "neo_hookean", averaged=model.averaged)
    lame, shear = moduli_of(model.zones, at.point.theta)
    solvers, changes = Solvers(body, points), []
    for o, u in zip(model.observed, at.point.states, strict=True):
        on = Observed.of(mesh, mesh, o.load_case)
        state, _ = equilibrium(body, solvers, lame, shear, on.load_case, u, b"")
        changes.append(on.residual(state) - o.residual(u))
    return changes


def _with_border(at: Linearised, quadratic: Concentrated, points: FloatArray) -> FloatArray | None:
    """Return the change (2 count,) of theta when the nodes of the mesh lie elsewhere; None where there is no equilibrium."""
    try:
        return change_of_fit(at, quadratic, changes_on(at, points))
    except ConvergenceError:
        return None
