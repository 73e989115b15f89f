"""How much further than a standard deviation says moduli may be from where they were found, with the motion of the surface sought.

The softer and the less compressible a body is, the less its moduli are told by a field with unknown forces on its surface. Standard
deviations at the estimate are therefore too small where that came out too stiff by chance, and the intervals that miss the truth are these.
Whether moduli at the end of an interval fit is tested there instead (an interval of the score, :cite:p:`wilson1927`): the score without
bias at these moduli over its own standard deviation says by how many of them the estimate is away.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.identification.from_fields.surface.bias import CorrectedScore, motions_along, moved
from naibu.identification.from_fields.uncertainty import Uncertainty, young_and_poisson_slopes

END = 1.96  # standard deviations at which moduli are tested
NEAR = 0.35  # how far from that they may come out for the distance to be taken in proportion
LEAST, MOST = 0.04, 0.7  # standard deviations of ln E: below, these hardly change within an interval; beyond, nothing is determined
FURTHER, LONGEST = 2.5, 2.5  # times as far as one test is the next at most; and the farthest logarithm from the estimate
TESTS = 3  # on each side
NEAREST, FARTHEST = 1.0, 4.0  # times as far as the standard deviation at the estimate says


def distances_of_bounds(score: CorrectedScore, found: Uncertainty, variance: float, noise_factor: float) -> FloatArray:
    """Return how far bounds of ln E are below and above (2, count), over what the standard deviation at the estimate says.

    They are as far as that where the motion of a part of the surface is sought only, or moduli are known well, or hardly.

    Parameters
    ----------
    score : CorrectedScore
        Where moduli were found, the model's last evaluation, which then is another one.
    found : Uncertainty
        Of the measurement alone, there.
    variance : float
        Of the residuals over that stated.
    noise_factor : float
        By how much standard deviations are larger there than noise as stated makes them.
    """
    theta = score.at.point.theta
    sd, sides = found.of_young_and_poisson(theta)[0], np.ones((2, score.at.model.zones.count))
    tested = np.flatnonzero((sd > LEAST) & (sd < MOST))
    if not (len(tested) and score.at.model.surface_sought):
        return sides
    covariance = np.where(np.isfinite(found.covariance), found.covariance, 0.0)  # of zones that nothing is known of
    along = np.stack([covariance @ slope_of_young(theta, i) / sd[i] for i in tested.tolist()], axis=1)
    motions = motions_along(score.at, score.quadratic, along)
    for k, zone in enumerate(tested.tolist()):
        way = _Way(zone, float(sd[zone]), along[:, k], [u[:, k] for u in motions])
        sides[:, zone] = [_on_a_side(score, way, side, variance, noise_factor) for side in (-1.0, 1.0)]
    return sides


class _Way(NamedTuple):
    """Way along which ln E of a zone changes by a standard deviation, all other moduli (2 count,) and the motion (n d,) following."""

    zone: int
    sd: float
    along: FloatArray
    motion: list[FloatArray]


def _on_a_side(score: CorrectedScore, way: _Way, side: float, variance: float, noise_factor: float) -> float:
    """Return how many times further away moduli are for which the estimate is at the end of an interval than its covariance says."""
    model, start = score.at.model, score.at.point
    longest, times = LONGEST / float(np.abs(way.along).max()), END
    for _ in range(TESTS):
        distance = side * min(times, longest)
        point = moved(model, start, distance * way.along, [distance * u for u in way.motion])
        if point is None:
            return FARTHEST
        at = model.linearised(point)
        there = CorrectedScore.of(at, at.concentrated(np.eye(len(point.theta))), variance)
        slope = slope_of_young(point.theta, way.zone)
        inverse = np.linalg.pinv(there.quadratic.hessian, rcond=1e-12)
        away = abs(float(slope @ inverse @ there.value)) / (noise_factor * float(np.sqrt(slope @ inverse @ slope)))
        young, before = (young_and_poisson(theta)[0][way.zone] for theta in (point.theta, start.theta))
        times = abs(float(np.log(young / before))) / way.sd * min(END / max(away, 1e-3), FURTHER)
        if away > END - NEAR or times > longest:
            break
    return float(np.clip(times / END, NEAREST, FARTHEST))


def slope_of_young(theta: FloatArray, zone: int) -> FloatArray:
    """Return the gradient (2 count,) of ln E of a zone."""
    k = len(theta) // 2
    out = np.zeros(2 * k)
    out[[zone, k + zone]] = young_and_poisson_slopes(theta)[0][:, zone]
    return out
