"""The law that was assumed: where it matters, whether fields speak against it, and what hangs on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.free_law import FreeLaw, free_law
from naibu.identification.from_fields.assumptions.other_assumptions import holds
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, young_and_poisson
from naibu.identification.from_fields.uncertainty import EXACT, LawPart, Uncertainty, by_law, intervals
from naibu.identification.verdict import Verdict
from naibu.mechanics.finite_elements.elements import elements

LEAST_STRAIN = 0.02  # equivalent strain, root mean square, below which forms of the law change stress by 2 per cent at most
UNLIKELY = 1e-3  # probability of so large a score by chance, below which fields speak against the law
MODULUS = 0.1  # change of the logarithm of a modulus from which on it matters
NOT_KNOWN = 1.0  # the same from which on a search from the best fit says nothing of it
DOES_NOT_FIT = "the law does not fit"
OR_ELEMENTS = ", or elements are too large, whose errors at finite strain are not known"
NO_LAW = "no law that was tried explains what is more than noise"
ELEMENTS_FIRST = (
    "with its shape sought as well, Young's modulus of {} would be another one by a factor that is not known; too large elements and wrong "
    "zones look like that: compare with smaller elements first"
)
OF_LAW = (DOES_NOT_FIT, NO_LAW)  # beginnings of reasons
HANGS_ON_LAW = "moduli hang on the assumed law"
NOT_SOUGHT = "moduli may hang on the assumed law, whose shape could not be sought as well"
MOST_ZONES = 40  # whose laws are sought: four columns each as long as the displacement
OF_MAP = "The map takes the law for right at strains of {:.2g} per cent: what stiffens with strain looks like another modulus."
LISTED = 2


def equivalent_strain(mesh: Mesh, u: FloatArray) -> float:
    """Return the root mean square of the equivalent strain, ``sqrt(2 e:e / 3)`` of the deviator e, at a displacement (n, 3), mm."""
    discrete = elements(mesh, "standard")
    gradient = np.einsum("mai,mqaj->mqij", u[mesh.cells], discrete.gradients, optimize=True)
    strain = 0.5 * (gradient + np.swapaxes(gradient, 2, 3) + np.einsum("mqki,mqkj->mqij", gradient, gradient, optimize=True))
    strain -= np.einsum("mqkk->mq", strain)[:, :, None, None] / 3.0 * np.eye(3)
    return float(np.sqrt(np.average(2.0 / 3.0 * (strain**2).sum(axis=(2, 3)), weights=discrete.weights)))


def largest_strain(model: FieldModel, states: Sequence[FloatArray]) -> float:
    """Return the largest `equivalent_strain` of all states (n, d), mm; zero of bodies that are not in three dimensions."""
    return max(equivalent_strain(model.computed, u) for u in states) if model.mesh.dimension == 3 else 0.0


def with_law_free(
    at: Linearised, residuals: Sequence[FloatArray] | None, freedom: float, stretch: FloatArray
) -> tuple[FreeLaw | None, LawPart | None]:
    """Return moduli with the shape of the law sought as well, from the best fit, and what that means for their uncertainty.

    None where strains are too small for that to matter; no uncertainty either where there are many zones, no equilibrium was found, or
    small strain was assumed: who asks for that at large strain gets its interval, and the verdict says what hangs on it.

    Parameters
    ----------
    at : Linearised
        At the best fit.
    residuals : sequence of ndarray, shape (q,), or None
        Whitened residuals on elements of half the size; None where these were not computed.
    freedom : float
        Degrees of freedom.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size (see `mesh_error.stretch_of`).
    """
    if largest_strain(at.model, at.point.states) < LEAST_STRAIN:
        return None, None
    if at.model.zones.count > MOST_ZONES:
        return FreeLaw.lost(at.model.zones.names, len(at.point.theta)), None
    pairs = zip(at.model.observed, at.point.states, strict=True)
    here = [o.residual(u) for o, u in pairs]
    free = free_law(at, None if residuals is None else [r - h for r, h in zip(residuals, here, strict=True)], freedom)
    if not free.found or at.model.law.linear:
        return free, None
    return free, LawPart(stretch * free.shift, free.covariance * np.outer(stretch, stretch))


def judged(
    judged: Verdict, free: FreeLaw | None, zones: Zones, theta: FloatArray, total: Uncertainty, *, elements_known: bool
) -> tuple[Verdict, str]:
    """Return the verdict with what fields say against the law, where that changes a modulus by much; and what hangs on the law.

    Where it is not known what elements of half the size change at finite strain (`elements_known`), errors of elements may look like
    another law.
    """
    against = _against(free, zones, theta, elements_known=elements_known)
    if not against:
        return judged, hangs_on_law(judged, free, total, theta)
    return judged.in_part(against), ""


def _against(free: FreeLaw | None, zones: Zones, theta: FloatArray, *, elements_known: bool) -> str:
    """Say that fields ask for another law under which a modulus would be another one by much; empty if they do not.

    Of one that would be another by a factor of e or more, the search from the best fit tells nothing but that: errors of elements near
    incompressibility asked for shapes that no material has.
    """
    if free is None or not free.found or not free.probabilities:
        return ""
    law, least = min(free.probabilities.items(), key=lambda one: one[1])
    probability = least * len(free.probabilities)  # of the least of so many by chance, at most
    change = np.log(young_and_poisson(theta + free.shift)[0] / young_and_poisson(theta)[0])
    changes = told_changes(zones, change)
    if probability > UNLIKELY or not changes:
        return ""
    if (np.abs(change) >= NOT_KNOWN).any():
        names = " and ".join(zones.names[i] for i in np.flatnonzero(np.abs(change) >= NOT_KNOWN).tolist())
        return f"{NO_LAW}: {ELEMENTS_FIRST.format(names)}"
    return (
        f"{DOES_NOT_FIT}{'' if elements_known else OR_ELEMENTS}: fields ask for stress that grows otherwise with strain, as in a {law} "
        f"law; with its shape sought as well, Young's modulus would be another one: {changes}"
    )


def told_changes(zones: Zones, change: FloatArray, beyond: BoolArray | None = None) -> str:
    """Return in words the largest changes of the logarithms of Young's moduli (count,) that matter; empty where none does.

    Those do that are large, or where moduli leave their intervals (`beyond` (count,)).
    Where a single cell is all that is known, moduli are multiples of that of the largest zone.
    """
    if len(zones.known) == 1 and zones.known[0].is_unit and int((zones.of_cell == KNOWN).sum()) == 1:
        change = change - change[np.argmax(np.bincount(zones.of_cell[zones.of_cell != KNOWN], minlength=zones.count))]
    matter = (np.abs(change) > MODULUS) | (False if beyond is None else beyond)
    moved = [i for i in np.argsort(-np.abs(change)).tolist() if matter[i]]
    each = [
        f"that of {zones.names[i]} {100.0 * abs(np.expm1(change[i])):.0f} % {'higher' if change[i] > 0.0 else 'lower'}"
        for i in moved[:LISTED]
    ]
    return " and ".join(each)


def told_shift(zones: Zones, theta: FloatArray, shift: FloatArray) -> str:
    """Return in words what a shift of the logarithms theta (2 count,) changes of Young's moduli; empty where by little."""
    return told_changes(zones, np.log(young_and_poisson(theta + shift)[0] / young_and_poisson(theta)[0]))


def blamed(judged: Verdict, why: str, *, first: bool) -> Verdict:
    """Return the verdict with another reason; where that comes first, another law is none."""
    reasons = tuple(reason for reason in judged.reasons if not (first and reason.startswith(OF_LAW)))
    return replace(judged, reasons=reasons).in_part(why, first=first)


def hangs_on_law(judged: Verdict, free: FreeLaw | None, total: Uncertainty, theta: FloatArray) -> str:
    """Say, in words that follow "but", whether Young's moduli hang on the law; empty if not, or if the verdict says more of it."""
    if free is None or any(reason.startswith(OF_LAW) for reason in judged.reasons):
        return ""
    if not free.found:
        sd = total.of_young_and_poisson(theta)[0]
        return NOT_SOUGHT if (np.isfinite(sd) & (sd > EXACT)).any() else ""
    if total.law is None:
        bounds, other = intervals(theta, total)[0], young_and_poisson(theta + free.shift)[0]
        hangs = any(not holds(low, high, e) for e, (low, high) in zip(other, bounds, strict=True))
    else:
        hangs = bool(by_law(total, theta).any())
    return HANGS_ON_LAW if hangs else ""


def warned(strain: float, sentences: tuple[str, ...]) -> tuple[str, ...]:
    """Return the sentences on a map without intervals, the first of which says that it takes the law for right, where that matters."""
    if strain < LEAST_STRAIN or not sentences:
        return sentences
    return (f"{sentences[0]} {OF_MAP.format(100.0 * strain)}", *sentences[1:])
