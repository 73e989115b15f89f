"""Whether a body or a zone changes its volume by itself, as by uptake of water, drying, growth or temperature, which no load explains.

A volume that changes without stress is an eigenstrain (:cite:t:`mura1987`). The displacement that it makes of every material, and of all
together, is found to first order, moduli and the motion of the loaded nodes following, and how much of it fits best
(`naibu.identification.from_fields.assumptions.score_test`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.from_fields.assumptions.assumed_law import blamed, told_shift
from naibu.identification.from_fields.assumptions.free_law import materials_of
from naibu.identification.from_fields.assumptions.score_test import ScoreTest, most_asked
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Linearised, moduli_of
from naibu.identification.verdict import Explanation, Verdict

MOST_MATERIALS = 12  # that are tried: a solution of every load case each
WHOLE = "the whole body"
BY_ITSELF = "changes its volume by itself"


@dataclass(frozen=True, slots=True, eq=False)
class Eigenstrain:
    """A change of volume without stress that fields ask for.

    Attributes
    ----------
    where : str
        The zone, or `WHOLE`.
    volume : float
        By which part the volume grows, negative where it shrinks.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change, to first order.
    """

    where: str
    volume: float
    fall: float
    theta: FloatArray


def asked_eigenstrain(test: ScoreTest, variance: float, stretch: FloatArray) -> Eigenstrain | None:
    """Return the change of volume that fields ask for most, None where chance or errors of elements give as much.

    Parameters
    ----------
    test : ScoreTest
        Of the best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    """
    model = test.at.model
    tried = {name: cells for name, cells in materials_of(model.zones).items() if cells.any()}
    if model.mesh.dimension != 3 or not test.errors.any() or len(tried) > MOST_MATERIALS:
        return None
    if len(tried) > 1:
        tried[WHOLE] = np.ones(model.computed.n_cells, dtype=bool)
    best = most_asked({name: test.of_residuals(_changes(test.at, cells)) for name, cells in tried.items()}, variance)
    return None if best is None else Eigenstrain(best[0], best[1].part, best[1].fall, best[1].shift(stretch))


def judged_eigenstrain(judged: Verdict, found: Eigenstrain | None, zones: Zones, theta: FloatArray, explained: float) -> Verdict:
    """Return the verdict with a volume that changes by itself, where moduli would change by much or residuals are more than noise.

    It is the first reason where chi squared falls with it by more than `explained`, and another law is none then; the last one otherwise.
    """
    if found is None:
        return judged
    changes = told_shift(zones, theta, found.theta)
    first = found.fall > explained
    if not changes and (judged.explanation is Explanation.EXPLAINED or not first):
        return judged
    would = f": without that, Young's modulus would be another one: {changes}" if changes else ""
    why = (
        f"{found.where} {BY_ITSELF}, by some {100.0 * found.volume:+.2g} %, as by uptake of water, drying, growth or temperature, or "
        f"lengths of the two scans differ in scale: measure with the same volume and scale{would}"
    )
    return blamed(judged, why, first=first)


def _changes(at: Linearised, cells: BoolArray) -> list[FloatArray]:
    """Return what a growth of the volume of cells (m,) by the whole of it changes of the whitened displacement (q,) of every load case."""
    model = at.model
    lame, shear = (np.where(cells, moduli, 0.0) for moduli in moduli_of(model.zones, at.point.theta))
    grown = (model.points / 3.0).ravel()
    right = []
    for o, u in zip(model.observed, at.point.states, strict=True):
        force = np.asarray(model.law.stiffness(lame, shear, u) @ grown)
        force[o.loaded] = 0.0
        right.append(force[:, None])
    return [np.asarray(o.operator @ moved[:, 0]) for o, moved in zip(model.observed, at.solved(right), strict=True)]
