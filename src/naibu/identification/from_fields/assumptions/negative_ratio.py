"""Whether fields ask for a negative Poisson's ratio, as hardly any material has: a zone that grows by itself, unloaded, looks like that.

From such a fit other assumptions say nothing to first order: its moduli have followed what they were to explain. What the fields ask for is
found by a refit with ratios that are not negative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.progress import report_progress
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Point, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, fitted_near
from naibu.identification.verdict import Explanation, Verdict

DECISIVE = 25.0  # of chi squared over its variance: five standard deviations of a normal score
AT_BOUND = 1e-3  # of a ratio, from the least that is searched
CLEARLY = -0.1  # so that errors of elements and measurement make none of a cork or foam with a ratio of zero
UNTOLD = "Poisson's ratio of {} ends at the least that is searched, which the fields do not tell, nor what else may be wrong"
NEGATIVE = "fields ask for a negative Poisson's ratio"


@dataclass(frozen=True, slots=True)
class NegativeRatio:
    """Zones, the ratios that fit best, whether one of these is the least that is searched, and whether others fit far worse."""

    names: tuple[str, ...]
    ratios: tuple[float, ...]
    at_bound: bool
    decisive: bool = True


def asked_negative_ratio(model: FieldModel, best: Point, variance: float, bounds: Bounds) -> NegativeRatio | None:
    """Return zones with a negative ratio; None where there are none.

    None as well where ratios that are not negative fit as well, unless the negative one is the least that is searched.

    Parameters
    ----------
    model : FieldModel
    best : Point
        The best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    bounds : Bounds
        Of the moduli.
    """
    ratios = young_and_poisson(best.theta)[1]
    negative = np.flatnonzero(ratios < CLEARLY)
    if model.mesh.dimension != 3 or not len(negative) or bounds.poisson_ratio[1] <= 0.0:
        return None
    report_progress(model.progress, "comparing with Poisson's ratios that are not negative")
    least = replace(bounds, poisson_ratio=(max(0.0, bounds.poisson_ratio[0]), bounds.poisson_ratio[1]))
    low, high = least.box(len(ratios))
    found = fitted_near(model, np.clip(best.theta, low, high), best.states, least)
    decisive = found is not None and found.misfit - best.misfit > DECISIVE * variance
    names, values = tuple(model.zones.names[i] for i in negative.tolist()), tuple(ratios[negative].tolist())
    at_bound = min(values) < bounds.poisson_ratio[0] + AT_BOUND
    return NegativeRatio(names, values, at_bound, decisive) if decisive or at_bound else None


def judged_negative_ratio(judged: Verdict, found: NegativeRatio | None, plain: Sequence[str]) -> Verdict:
    """Return the verdict with negative ratios as its first reason.

    At the least ratio that is searched nothing is explained, and of the other reasons only those (`plain`) remain that residuals gave:
    cells too large for a lump that grew left much, for which a wrong Poisson's ratio of the known part was blamed.
    """
    if found is None or (not found.decisive and judged.explanation is Explanation.EXPLAINED):
        return judged
    if not found.decisive:
        return replace(judged, reasons=(UNTOLD.format(" and ".join(found.names)), *plain))
    each = " and ".join(f"{ratio:.2f} of {name}" for name, ratio in zip(found.names, found.ratios, strict=True))
    why = (
        f"{NEGATIVE}, {each}, as hardly any material but auxetic foam has: a zone changes its volume by itself, as by uptake of water, "
        "drying, growth or temperature, or zones or surface are not those of the model"
    )
    if not found.at_bound:
        return judged.in_part(why)
    none = f"{why}; none of the assumptions that are checked explains the fields"
    return replace(judged, explanation=Explanation.NOT_EXPLAINED, reasons=(none, *plain))
