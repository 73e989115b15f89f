"""Verdict on moduli that the size of cells changes: whether those that the data determine stay when the cells are halved.

Where elements of half the size change a modulus by much, its correction to vanishing size, which is linear, is worth nothing, and the model
on these elements is not one of the object. That holds for a modulus that the data determine. One that they leave open, such as the ratio of
bulk to shear modulus of a thin skin, moves at no cost to the fit and changes little else: it is told as not determined instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.identification.from_fields.mesh_error import relative_change, weight_of_change
from naibu.identification.from_fields.uncertainty import Uncertainty, young_and_poisson_slopes
from naibu.identification.from_fields.verdicts.verdict import SHARED
from naibu.identification.verdict import UNDETERMINED, Explanation, Verdict

WITHIN = 0.5  # change of a logarithm from which a linear correction is worth nothing
DETERMINED = 0.5  # standard deviation of a logarithm from measurement alone: 95 % intervals up to 7 times as high as low are determined
NUMBERS = ("Young's modulus", "the shear modulus", "kappa / mu, hence Poisson's ratio,")
ROUGHLY = 0.15  # standard deviation of ln E with which a modulus is known within a third, at 95 %
NO_INFORMATION = (
    "the measurement determines no Young's modulus (standard deviation of the logarithm {:.2g} or more), whatever the size of elements: "
    "measure more points or another load, or name the sides where forces act"
)
FALLS = 0.75  # part of the misfit beyond noise that may be left on elements of half the size for these to be what explains it


@dataclass(frozen=True, slots=True, eq=False)
class HalfSize:
    """What elements of half the size change.

    Attributes
    ----------
    fitted, theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu) of the zones: those that fit best on the mesh, and at vanishing element size.
    of_noise : Uncertainty
        Of `fitted`, from the measurement alone.
    beyond_noise : tuple of float
        Misfit less what noise leaves on average, on the mesh and on elements of half the size.
    """

    fitted: FloatArray
    theta: FloatArray
    of_noise: Uncertainty
    beyond_noise: tuple[float, float]

    @property
    def changes(self) -> FloatArray:
        """Change of ln E, of ln mu, and how much of mu / kappa went (3, count)."""
        young, before = young_and_poisson(self.theta)[0], young_and_poisson(self.fitted)[0]
        return np.stack([np.log(young / before), *relative_change(self.theta - self.fitted).reshape(2, -1)])

    @property
    def weighed(self) -> FloatArray:
        """The same, that of mu / kappa as much as it tells of too large elements (`mesh_error.weight_of_change`)."""
        of_ratio = weight_of_change(self.fitted).reshape(2, -1)[1]
        return np.asarray(self.changes * np.stack([np.ones_like(of_ratio), np.ones_like(of_ratio), of_ratio]))

    @property
    def standard_deviations(self) -> FloatArray:
        """Those of the same numbers (3, count)."""
        return np.stack([self.of_noise.of_young_and_poisson(self.fitted)[0], *self.of_noise.standard_deviations().reshape(2, -1)])

    @property
    def times(self) -> FloatArray:
        """Factor, 1 or more, by which E, mu and kappa / mu change (3, count)."""
        shift = (self.theta - self.fitted).reshape(2, -1)
        times: FloatArray = np.exp(np.abs(np.stack([self.changes[0], *shift])))
        return times

    @property
    def falls(self) -> bool:
        """Whether elements of half the size explain some of what the mesh does not."""
        before, after = self.beyond_noise
        return after < FALLS * before


def judged_within_cells(judged: Verdict, names: Sequence[str], half: HalfSize, set_apart: BoolArray | None = None) -> Verdict:
    """Return the verdict on zones with these names, which end inside of cells.

    Moduli that the data determine and that move are no result; nor is anything where they determine no Young's modulus. Others that move
    are told in the notes as not determined. Where neighbours share residuals that elements of half the size leave, these come first.

    Parameters
    ----------
    judged : Verdict
        On the residuals.
    names : sequence of str
        Zones.
    half : HalfSize
        What elements of half the size change.
    set_apart : ndarray, shape (count,), bool
        Zones whose moduli may be anything without taking the results of the others away, because the intervals of those hold it: they are
        named as not determined, and the verdict is in part at best. By default none.
    """
    sure = half.standard_deviations < DETERMINED
    refused = (np.abs(half.weighed) > WITHIN) & (sure | ~sure[0].any())
    left_open = (np.abs(half.changes) > WITHIN) & ~refused & ~sure
    notes = tuple(_told_open(name, np.flatnonzero(left_open[:, i]), half, i) for i, name in enumerate(names) if left_open[:, i].any())
    judged = replace(judged, notes=(*judged.notes, *notes))
    if not refused.any():
        return judged
    lost = refused.any(axis=0)
    apart = np.zeros(len(names), dtype=bool) if set_apart is None else set_apart
    if (lost <= apart).all() and (sure[0] & ~lost).any():
        return _without(judged, names, refused, half)
    reason = f"zones end inside of elements, and with half their size moduli would change {half.times[refused].max():.2g} times"
    advised = f"{reason}: use smaller ones" if sure[0].any() else NO_INFORMATION.format(float(half.standard_deviations[0].min()))
    reasons = (advised, *judged.reasons)
    if judged.explanation is not Explanation.EXPLAINED and judged.shared > SHARED and not half.falls:
        reasons = (*judged.reasons, f"elements of half the size leave such residuals as well; but {reason}")
    return replace(judged, explanation=Explanation.NOT_EXPLAINED, reasons=reasons)


def _without(judged: Verdict, names: Sequence[str], refused: BoolArray, half: HalfSize) -> Verdict:
    """Return the verdict with zones of which numbers (rows of `HalfSize.changes`) are `refused` (3, count) named as not determined."""
    lost = np.flatnonzero(refused.any(axis=0)).tolist()
    each = [f"{names[i]} (with half their size its moduli would change {half.times[refused[:, i], i].max():.2g} times)" for i in lost]
    limits = f"elements of this size do not determine {' and '.join(each)}"
    part = Explanation.IN_PART if judged.explanation is Explanation.EXPLAINED else judged.explanation
    return replace(judged, explanation=part, limits=limits, mesh_dependent=tuple(names[i] for i in lost))


def with_limits(
    judged: Verdict, names: Sequence[str], of_mesh: FloatArray | None, bounds: FloatArray, unit: str = " kPa", *, of_law: str = ""
) -> Verdict:
    """Return the verdict with the zones first whose modulus is known only roughly, or not at all, and why.

    Residuals as small as the noise tell neither errors of elements nor what the measurement leaves open, so that nobody should read of an
    explanation before he reads of them.

    Parameters
    ----------
    judged : Verdict
        On the residuals.
    names : sequence of str
        Zones.
    of_mesh : ndarray, shape (count,), or None
        Standard deviations of the logarithm of Young's modulus from the size of elements; None where they were not estimated.
    bounds : ndarray, shape (count, 2)
        95 % intervals of Young's modulus, kPa.
    unit : str
        That of moduli, none of multiples.
    of_law : str
        What hangs on the law that was assumed, in words; told first.
    """
    if not judged.ok:
        return judged
    with np.errstate(divide="ignore"):
        factors = np.sqrt(bounds[:, 1] / bounds[:, 0])
    told = ~np.isin(names, judged.mesh_dependent)
    lost = told & ~(factors <= UNDETERMINED)
    by_elements = told & ~lost & (of_mesh is not None and of_mesh > ROUGHLY)
    by_data = told & ~lost & ~by_elements & (factors > np.exp(1.96 * ROUGHLY))
    limits = [text for text in (of_law, judged.limits) if text]
    if lost.any():
        each = [f"{names[i]} ({_between(float(bounds[i, 0]), float(bounds[i, 1]), unit)})" for i in np.flatnonzero(lost).tolist()]
        limits.append(f"Young's modulus of {' and '.join(each)} is not determined")
    for who, rough in (("elements of this size tell", by_elements), ("the measurement tells", by_data)):
        each = [f"that of {names[i]} within a factor of {factors[i]:.2g}" for i in np.flatnonzero(rough).tolist()]
        limits += [f"{who} Young's modulus only roughly, {' and '.join(each)}"] * bool(each)
    return replace(judged, limits="; ".join(limits)) if limits else judged


def told_alike(names: Sequence[str], theta: FloatArray, found: Uncertainty, largest: int) -> str:
    """Say of which regions of a map Young's modulus may, at 95 %, be that of the region number `largest`; empty where of none.

    Parameters
    ----------
    names : sequence of str
        Regions.
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu).
    found : Uncertainty
        Of theta.
    largest : int
        Number of a region.
    """
    k, slopes = len(names), young_and_poisson_slopes(theta)[0]
    logarithm, alike = np.log(young_and_poisson(theta)[0]), []
    for i in (i for i in range(k) if i != largest):
        used = np.array([i, largest, k + i, k + largest])
        way = np.concatenate([[one[i], -one[largest]] for one in slopes])
        sd = float(np.sqrt(max(float(way @ found.covariance[np.ix_(used, used)] @ way), 0.0)))
        if abs(logarithm[i] - logarithm[largest]) < 1.96 * sd < np.log(UNDETERMINED):  # what is less determined is told as such
            alike.append(names[i])
    return f"Young's modulus of {' and '.join(alike)} may be that of {names[largest]}" if alike else ""


def _between(low: float, high: float, unit: str) -> str:
    """Return a 95 % interval in words."""
    return f"95 % from {low:.3g} to {high:.3g}{unit}" if np.isfinite(high) and low > 0.0 else "on which there is no information"


def _told_open(name: str, which: IntArray, half: HalfSize, zone: int) -> str:
    """Say of a zone that numbers `which` (rows of `HalfSize.changes`) are not determined and depend on the size of elements."""
    several = " and ".join(NUMBERS[i] for i in which)
    sd, times = half.standard_deviations[which, zone].min(), half.times[which, zone].max()
    return (
        f"{name}: the measurement does not determine {several} (standard deviation of the logarithm {sd:.2g} or more); elements of half "
        f"the size would change what was found {times:.2g} times. Take it from elsewhere."
    )
