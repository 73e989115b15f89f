"""Model-form uncertainty of the law: what moduli owe to the law that was assumed, and whether the data speak against it.

A hyperelastic law fixes how stress grows with strain. Where two materials are strained differently, one that stiffens more than the law
says looks like one of another modulus. The parameters that other laws have in addition - the fraction of the second invariant
(Mooney-Rivlin), the square and the cube of the first one (Yeoh) - are consider parameters of an identification
(`naibu.identification.from_markers.consider_parameters`). What they add to the second moment of the estimates is the uncertainty from the
form of the law. Whether the data ask for them is told by the score (:cite:p:`rao1948`): it needs no search with the other law.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.consider_parameters import Considered, considered, variances
from naibu.identification.from_markers.specimen.parameter_names import SHAPE_NAMES


@dataclass(frozen=True, slots=True, eq=False)
class OtherLaw:
    """What the data say about another law.

    Attributes
    ----------
    name : str
        Of the law.
    probability : float
        Of so large a score by chance, if the law that was assumed is right.
    shift : ndarray, shape (p,)
        By how much the parameters that were sought would move then, on the optimiser's scale, to first order.
    """

    name: str
    probability: float
    shift: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LawUncertainty:
    """What estimates owe to the law that was assumed.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Second moment that the form of the law adds to the errors of the parameters that were sought, on the optimiser's scale.
    others : tuple of OtherLaw
        Laws that the data can be asked about, the one that they ask for most first.
    considered : Considered
        The consider parameters behind it.
    """

    covariance: FloatArray
    others: tuple[OtherLaw, ...]
    considered: Considered


def law_uncertainty(calibration: Calibration) -> LawUncertainty:
    """Return what the estimates of a calibration owe to the law that was assumed; nothing is solved anew.

    Raises
    ------
    ConvergenceError
        The tangent at a solution is singular.
    """
    c = considered(calibration)
    ends = {law: tuple(f": {kind}" for kind in kinds) for law, kinds in SHAPE_NAMES.items()}
    added_by = {law: np.array([name.endswith(end) for name in c.names]) & ~c.sought for law, end in ends.items()}
    wide = c.base | np.any(list(added_by.values()), axis=0)
    added = c.covariance(wide) - c.covariance(c.base) + np.outer(shift := c.shift(wide), shift)
    added = added[np.ix_(c.sought, c.sought)]
    others = [_other_law(calibration, c, law, chosen) for law, chosen in added_by.items() if chosen.any()]
    return LawUncertainty(0.5 * (added + added.T), tuple(sorted(others, key=lambda one: one.probability)), c)


def _other_law(calibration: Calibration, c: Considered, name: str, chosen: BoolArray) -> OtherLaw:
    """Test the parameters of one law that are `chosen` (p,) of the free ones against 0.

    The variance is that of what is left with them, as in a likelihood ratio of normal errors of unknown size: a misfit that the other law
    explains does not hide itself.
    """
    kept = c.base | chosen
    left = replace(c, variance=_variance_left(calibration, c, kept))
    shift = left.shift(kept)
    # the gain in likelihood; their priors lessen it a little
    chi_squared = float(c.equations.gradient @ (left.step(kept) - left.step(c.base))) / left.variance
    return OtherLaw(name, float(chdtrc(int(chosen.sum()), max(chi_squared, 0.0))), shift[c.sought])


def _variance_left(calibration: Calibration, c: Considered, kept: BoolArray) -> float:
    """Variance of a datum in units of the noise, for parameters, of what one step with the parameters that are `kept` (p,) leaves."""
    step, size = replace(c, variance=1.0).step(kept), len(kept)
    fits = [
        replace(f, residual=f.residual - f.jacobian @ (c.slopes * step[:size]) - f.pose_jacobian @ step[size + 6 * i : size + 6 * i + 6])
        for i, f in enumerate(c.fits)
    ]
    squares = sum(float(np.nansum((f.residual / f.sd) ** 2)) for f in fits)
    freedom = calibration.match.degrees_of_freedom - (kept & ~c.sought).sum()
    return variances(calibration.load_cases, fits, float(np.sqrt(squares / max(freedom, 1.0))))[2]
