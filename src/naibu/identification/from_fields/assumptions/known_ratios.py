"""Whether fields speak against the Poisson's ratio that was stated of a known region.

How a known region deforms depends on its Poisson's ratio, and with a wrong one its neighbours come out too stiff or too soft with small
standard errors. Its Young's modulus sets the scale, and no field tells it; its Poisson's ratio shows in the field. To first order in
mu / kappa of the region, moduli and the motion of the loaded nodes following, the ratio that fits best is found, and by how much it fits
better (`naibu.identification.from_fields.assumptions.score_test`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.identification.from_fields.assumptions.assumed_law import MODULUS, UNLIKELY
from naibu.identification.from_fields.assumptions.other_assumptions import changes_under, other_poisson_ratio
from naibu.identification.from_fields.assumptions.score_test import ScoreTest
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import moduli_of, young_and_poisson
from naibu.identification.verdict import Verdict
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

STATED_SD = 2.0  # stated standard deviations of a ratio within which another one is no contradiction
DOES_NOT_FIT = "a stated Poisson's ratio does not fit"


@dataclass(frozen=True, slots=True, eq=False)
class AskedRatio:
    """The Poisson's ratio of a known region that fits best, and what it would do.

    Attributes
    ----------
    region : str
        Its name.
    stated, asked : float
        Poisson's ratios.
    probability : float
        Of so large a score by chance.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change, to first order.
    """

    region: str
    stated: float
    asked: float
    probability: float
    fall: float
    theta: FloatArray


def asked_ratios(test: ScoreTest, variance: float, stretch: FloatArray) -> tuple[AskedRatio, ...]:
    """Return the ratios of known regions that fields contradict by more than is stated of them, and that matter.

    Parameters
    ----------
    test : ScoreTest
        Of the best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    """
    at, model, out = test.at, test.at.model, []
    for number, region in enumerate(model.zones.known):
        if region.is_rigid:
            continue
        lame, shear = moduli_of(model.zones, at.point.theta)
        cells, near = model.zones.region_of_cell == number, other_poisson_ratio(region.poisson_ratio)
        lame[cells], shear[cells] = lame_parameters(region.young_modulus, near)
        try:
            found = test.along(changes_under(at, model.law, lame, shear))
        except ConvergenceError:  # a body so far from equilibrium with another ratio is none that a first order could judge
            continue
        if found is None:
            continue
        stated, other = (_compressibility(nu) for nu in (region.poisson_ratio, near))
        least = min(_compressibility(MAX_POISSON_RATIO), stated)
        part = (max(stated + found.part * (other - stated), least) - stated) / (other - stated)
        asked = _poisson_ratio(stated + part * (other - stated))
        probability = float(chdtrc(1, found.fall / variance))
        one = AskedRatio(region.name, region.poisson_ratio, asked, probability, found.fall, found.shift(stretch, part))
        matters = np.abs(_change(one, at.point.theta)).max(initial=0.0) > MODULUS
        if one.probability < UNLIKELY and matters and abs(asked - one.stated) > STATED_SD * region.poisson_ratio_sd:
            out.append(one)
    return tuple(out)


def judged_ratios(judged: Verdict, found: Sequence[AskedRatio], zones: Zones, theta: FloatArray) -> Verdict:
    """Return the verdict with the ratios that fields contradict."""
    if not found:
        return judged
    each = []
    for one in found:
        change = _change(one, theta)
        i = int(np.argmax(np.abs(change)))
        much = f"{100.0 * abs(np.expm1(change[i])):.0f} % {'higher' if change[i] > 0.0 else 'lower'}"
        each.append(
            f"fields ask for some {one.asked:.2g} instead of {one.stated:.3g} of {one.region!r}, with which Young's modulus of "
            f"{zones.names[i]} would be {much}"
        )
    return judged.in_part(f"{DOES_NOT_FIT}: {'; '.join(each)}")


def doubt_of_ratios(found: Sequence[AskedRatio], size: int) -> FloatArray:
    """Return what stated ratios that fields contradict add to the second moment (size, size) of errors of theta."""
    return np.asarray(sum((np.outer(one.theta, one.theta) for one in found), np.zeros((size, size))))


def _change(one: AskedRatio, theta: FloatArray) -> FloatArray:
    """Return the change of ln E (count,) of the zones."""
    return np.asarray(np.log(young_and_poisson(theta + one.theta)[0] / young_and_poisson(theta)[0]))


def _compressibility(poisson: float) -> float:
    """Return mu / kappa."""
    return 3.0 * (1.0 - 2.0 * poisson) / (2.0 * (1.0 + poisson))


def _poisson_ratio(compressibility: float) -> float:
    return (3.0 - 2.0 * compressibility) / (6.0 + 2.0 * compressibility)
