"""Filters side by side on a load that rises, stays and is taken away, read through the noise of the electronics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.sensing_chip.electronics import Readout
from naibu.applications.sensing_chip.filters import RampKalman, first_order_filter, forward_backward_filter, noise_gain
from naibu.core.arrays import FloatArray

NAMES = ("unfiltered", "first order", "Kalman", "Kalman with jumps", "first order, both ways", "Kalman smoother with jumps")
ONLINE = NAMES[:4]
JUMP = 5.0  # standard deviations
_RISE, _STAY, _REST, _BEFORE = 800, 400, 400, 100  # samples
_DRAWS = 8


@dataclass(frozen=True, slots=True, eq=False)
class FilterComparison:
    """Readings of one channel and what filters make of them.

    Attributes
    ----------
    times_s : ndarray, shape (n,)
        s.
    truth : ndarray, shape (n,)
        The channel without noise, V.
    outputs : dict
        Reading by filter (n,), V, of a first draw of noise; see `NAMES`.
    noise_sd, lag_samples, overshoot, rms_error : dict
        By filter: standard deviation while the load stays, V; samples behind while it rises; undershoot after it was taken away, over the
        load; and root mean square error of the whole record, V.
    """

    times_s: FloatArray
    truth: FloatArray
    outputs: dict[str, FloatArray]
    noise_sd: dict[str, float]
    lag_samples: dict[str, float]
    overshoot: dict[str, float]
    rms_error: dict[str, float]


def compare_filters(readout: Readout, share: float, *, channel: int = 0, height: float = 8.0, seed: int = 0) -> FilterComparison:
    """Filter a rising, constant, then vanishing load with the report's filter and with Kalman filters that let through as much noise.

    Parameters
    ----------
    readout : Readout
        The electronics.
    share : float
        r of the first-order filter.
    channel : int
        0 for F_z, 1 and 2 for the moments.
    height : float
        Reading under the constant load, V.
    seed : int
        Of the noise.

    Raises
    ------
    InputError
        A share that no filter can have.
    """
    truth = height * np.concatenate(
        [np.zeros(_BEFORE), np.linspace(0.0, 1.0, _RISE, endpoint=False), np.ones(_STAY), np.zeros(_REST)],
    )
    gain = readout.gains[channel]
    bridge = np.zeros((len(truth), 3))
    bridge[:, channel] = 1e3 * truth / gain
    rng = np.random.default_rng(seed)
    read = np.stack([readout.converted(bridge, rng)[:, channel] for _ in range(_DRAWS)], axis=1)
    sd = float(readout.noise_sd[channel])
    kalman, jumping = (RampKalman.with_noise_gain(sd, noise_gain(share), jump=jump) for jump in (np.inf, JUMP))
    filters = {
        NAMES[0]: lambda u: u,
        NAMES[1]: lambda u: first_order_filter(u, share),
        NAMES[2]: kalman.filtered,
        NAMES[3]: jumping.filtered,
        NAMES[4]: lambda u: forward_backward_filter(u, share),
        NAMES[5]: jumping.smoothed,
    }
    outputs = {name: np.asarray(apply(read)) for name, apply in filters.items()}
    clean = {name: np.asarray(apply(truth)) for name, apply in filters.items()}
    rising = slice(_BEFORE + _RISE // 2, _BEFORE + 3 * _RISE // 4)
    staying = slice(_BEFORE + _RISE + _STAY // 4, _BEFORE + _RISE + 3 * _STAY // 4)
    step = height / _RISE
    return FilterComparison(
        np.arange(len(truth)) / readout.sample_rate_hz,
        truth,
        {n: drawn[:, 0] for n, drawn in outputs.items()},
        {n: float((outputs[n] - clean[n][:, None])[staying].std()) for n in NAMES},
        {n: float((truth - clean[n])[rising].mean() / step) for n in NAMES},
        {n: float(max(0.0, -clean[n].min() / height)) for n in NAMES},
        {n: float(np.sqrt(np.mean((outputs[n] - truth[:, None]) ** 2))) for n in NAMES},
    )
