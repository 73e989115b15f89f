"""What a model that does not explain the measurements leaves in doubt of moduli: errors of the model that these follow are not seen.

Residuals are what is left of a discrepancy of the model (:cite:t:`kennedy2001`) after moduli have followed it as far as they can, so that
neither their size nor what neighbours share of them tells how far that was. A discrepancy of several smooth patterns of like size that are
independent of each other puts as much into a change of moduli, which are one more of them, as into each of the others.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.uncertainty import Uncertainty
from naibu.identification.from_fields.verdicts.verdict import SMALL
from naibu.identification.verdict import Explanation, Verdict

PATTERNS = 16  # with labels off, lumps, sliding and strong contrast, moduli were off as with 6 (the worst) to 100 of them, 16 in the mean


def doubt_of_model(judged: Verdict, information: FloatArray, beyond_noise: float, accounted: float) -> FloatArray:
    """Return the covariance (2 k, 2 k) of logarithms for what the model does not explain; zero where it explains the measurements.

    Parameters
    ----------
    judged : Verdict
        On the residuals.
    information : ndarray, shape (2 k, 2 k)
        Fisher information for the stated noise.
    beyond_noise : float
        By how much chi squared exceeds what noise leaves on average. The part of it that is as little of the deformation as needs no
        explanation does not count: errors of elements leave as much, and have a doubt of their own.
    accounted : float
        How much of that a cause explains whose effect on the moduli is part of their covariance. What is not explained at all is so far
        from any such cause that its effect, to first order, says little: nothing is accounted for then.
    """
    covariance = Uncertainty.of(information).covariance
    needs = 1.0 - (SMALL / max(judged.unexplained, SMALL)) ** 2
    left = needs * beyond_noise - (accounted if judged.explanation is Explanation.IN_PART else 0.0)
    if judged.explanation is Explanation.EXPLAINED or not left > 0.0:
        return np.zeros_like(covariance)
    lost = ~np.isfinite(np.diag(covariance))
    covariance[lost] = covariance[:, lost] = 0.0  # nothing is known of these anyway
    return np.asarray(covariance * left / PATTERNS)
