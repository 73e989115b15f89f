"""Whether a zone is stiffer in one experiment than in the others, as material that relaxes, dries or is damaged between them is.

An identification from several load cases takes the moduli for the same in all of them. What another shear modulus of a zone in one load
case would change, at the same Poisson's ratio, is found to first order, moduli of all and the motion of the loaded nodes following, and how
much of it fits best (`naibu.identification.from_fields.assumptions.score_test`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.assumptions.assumed_law import MODULUS, blamed
from naibu.identification.from_fields.assumptions.score_test import Asked, ScoreTest, most_asked
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.verdict import Verdict

MOST_TRIED = 24  # zones times load cases
UNLIKE = "experiments contradict each other"


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """A zone with another stiffness in one experiment than in the others.

    Attributes
    ----------
    experiment, others : str
        The name of that one, and that of the others in words.
    zone : int
    logarithm : float
        Of its modulus there over that in the others.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change: there or in the others, wherever by more.
    """

    experiment: str
    others: str
    zone: int
    logarithm: float
    fall: float
    theta: FloatArray


def asked_difference(test: ScoreTest, variance: float, stretch: FloatArray) -> Difference | None:
    """Return the difference that fields ask for most, None where chance or errors of elements give as much.

    Parameters
    ----------
    test : ScoreTest
        Of the best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    """
    observed, count = test.at.model.observed, test.at.model.zones.count
    cases = range(len(observed) if len(observed) > 2 else 1)  # of two, one is stiffer where the other is softer
    if len(observed) < 2 or not test.errors.any() or len(cases) * count > MOST_TRIED:
        return None
    moved = test.at.forward(np.eye(2 * count)[:, :count], None)
    found: dict[tuple[int, int], Asked | None] = {}
    for t in cases:
        of_zones = np.asarray(observed[t].operator @ moved[t])
        for zone in range(count):
            changes = [np.zeros(len(o.data)) for o in observed]
            changes[t] = of_zones[:, zone]
            found[t, zone] = test.of_residuals(changes)
    best = most_asked(found, variance)
    if best is None:
        return None
    (t, zone), asked = best
    others = asked.shift(stretch)
    there = others + asked.part * stretch * (np.arange(2 * count) == zone)
    theta = there if abs(there[zone]) > abs(others[zone]) else others
    others_named = observed[1].load_case.name if len(observed) == 2 else "the others"
    return Difference(observed[t].load_case.name, others_named, zone, float(asked.part * stretch[zone]), asked.fall, theta)


def judged_difference(judged: Verdict, found: Difference | None, zones: Zones, explained: float) -> Verdict:
    """Return the verdict with a zone that is stiffer or softer in one experiment, where that is by much.

    It is the first reason where chi squared falls with it by more than `explained`, and another law is none then; the last one otherwise.
    """
    if found is None or abs(found.logarithm) < MODULUS:
        return judged
    how = f"{100.0 * abs(np.expm1(found.logarithm)):.0f} % {'stiffer' if found.logarithm > 0.0 else 'softer'}"
    why = (
        f"{UNLIKE}: in {found.experiment}, {zones.names[found.zone]} is {how} than in {found.others}, to first order, as where it relaxes, "
        "dries, contracts or is damaged between them: identify each experiment by itself, and compare"
    )
    return blamed(judged, why, first=found.fall > explained)
