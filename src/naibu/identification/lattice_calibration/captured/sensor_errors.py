"""Errors of force sensors, estimated along with the parameters: an offset and a drift of each component, and a clock that is late.

They enter the residuals linearly, or one by one, so that they need no place in the search: at any parameters the best of them are found,
and what is left are residuals of the parameters alone (variable projection; :cite:t:`golub1973`). Derivatives are taken without what the
errors may explain, so that intervals hold whatever they are. What shifts the forces in time is told from their changes, an offset from how
what they lack stays the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np
import scipy.optimize

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.captured.force_history import ForceHistory, SampledMeans
from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces

MOST_DELAY_S = 0.2  # either way
DELAY_SD_S = 0.2  # weak prior, where forces hardly change
EXACT_S = 1e-7
LARGEST_DRIFT = 1e6  # mN/s, of those that are stated
USUAL_DRIFT = 0.005  # of the largest force of a record, 1/s: standard deviation of a drift of which nothing is stated; load cells have less


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Which errors the sensors may have.

    Attributes
    ----------
    offset : bool
        A constant of each component: the sensor was not tared.
    drift : bool
        What grows evenly with time, of each component; without an offset since the beginning of the record, when it was tared. Creep of
        the object resembles it so closely that forces may fit to within their noise with parameters far off: where a drift is not known
        to be none, intervals hold only with it.
    delay : bool
        The clock of each record is late or early, by up to `MOST_DELAY_S`.
    drift_sd : float, optional
        Standard deviation of the drift of a component, mN/s, known beforehand (of a data sheet), or infinite: any drift is as likely. By
        default it is `USUAL_DRIFT` of the largest force of the record, per second.
    """

    offset: bool = False
    drift: bool = False
    delay: bool = False
    drift_sd: float | None = None

    @classmethod
    def named(cls, name: SensorErrorNames, drift_sd: float | None = None) -> SensorErrors:
        """Return those that go by a name; a drift that does has an offset. All have a drift unless its standard deviation, mN/s, is 0.

        Raises
        ------
        InputError
            Another name, a standard deviation that is negative or above `LARGEST_DRIFT`, or one of 0 beside a drift that is sought.
        """
        if name not in get_args(SensorErrorNames):
            raise InputError(f"sensor_errors is {name!r}; choose one of {', '.join(get_args(SensorErrorNames))}")
        sd = np.inf if drift_sd is None and "drift" in name else drift_sd
        if drift_sd is not None and not 0.0 <= drift_sd <= LARGEST_DRIFT:
            raise InputError(f"force_drift_mn_per_s is {drift_sd:g}: must be between 0 and {LARGEST_DRIFT:g} mN/s; leave it out if unknown")
        if "drift" in name and sd == 0.0:
            raise InputError(f"force_drift_mn_per_s is 0, but sensor_errors is {name!r}; leave one of the two out")
        return cls("offset" in name or "drift" in name, sd != 0.0, "delay" in name, sd)

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return self.offset or self.drift or self.delay

    def holds(self, other: SensorErrors) -> bool:
        """Return whether all of another one are among these."""
        return self.offset >= other.offset and self.drift >= other.drift and self.delay >= other.delay

    @property
    def any_drift(self) -> bool:
        """Whether any drift is as likely."""
        return self.drift and self.drift_sd == np.inf

    @property
    def unknowns(self) -> int:
        """How many numbers of each component nothing is known of."""
        return int(self.offset) + int(self.any_drift)

    @property
    def steady(self) -> int:
        """How many functions of time each component may be off by."""
        return int(self.offset) + int(self.drift)

    def functions(self, times: FloatArray) -> FloatArray:
        """Return these functions (n, `steady`) at times (n,), s: a constant, and time, 0 in its middle or where the sensor was tared."""
        columns = [np.ones_like(times)] if self.offset else []
        if self.drift:
            columns.append(times - (times.mean() if self.offset else 0.0))
        return np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))


NO_ERRORS, LITTLE_DRIFT, ANY_DRIFT = SensorErrors(), SensorErrors(drift=True), SensorErrors(drift=True, drift_sd=np.inf)
SensorErrorNames = Literal["none", "offset", "delay", "offset and delay", "drift", "drift and delay"]


@dataclass(frozen=True, slots=True, eq=False)
class BodyResiduals:
    """Forces of one body against its record, in units of their noise, without what errors of the sensor explain.

    Attributes
    ----------
    counted : ndarray, shape (windows,), bool
        Windows with samples.
    residual, slopes : ndarray, shape (n, 3), (p, n, 3)
        Of the counted windows.
    explained : ndarray, shape (k, 3)
        Offset, mN, and what is added every second, mN/s, of each component; as many as there may be.
    explained_slopes : ndarray, shape (p, k, 3)
        How they change with the parameters.
    explained_variance : ndarray, shape (k,)
        Of each component, at known parameters.
    means : ndarray, shape (windows, 3)
        Simulated means, as late as the clock, mN.
    measured : ndarray, shape (n, 3)
        Recorded means of the counted windows without offset and drift, mN.
    delay : float
        s; 0 where none was sought.
    delay_slopes : ndarray, shape (p,)
        How it changes with the parameters.
    delay_variance : float
        At known parameters; with how far it may be off because samples are not taken in the middle of steps, or of the pieces of a sampled
        path.
    """

    counted: BoolArray
    residual: FloatArray
    slopes: FloatArray
    explained: FloatArray
    explained_slopes: FloatArray
    explained_variance: FloatArray
    means: FloatArray
    measured: FloatArray
    delay: float
    delay_slopes: FloatArray
    delay_variance: float


def body_residuals(
    errors: SensorErrors,
    record: RecordedForces,
    body: int,
    means: FloatArray,
    means_change: FloatArray,
    history: ForceHistory | None,
    excess: float = 1.0,
) -> BodyResiduals:
    """Return residuals of one body.

    Parameters
    ----------
    errors : SensorErrors
        That the sensor may have.
    record : RecordedForces
        What was measured.
    body : int
        Its number; it has a record.
    means, means_change : ndarray, shape (windows, 3), (p, windows, 3)
        Simulated means over the windows and their derivatives, mN.
    history : ForceHistory, optional
        What they are means of; needed for a delay, and for samples that are not taken in the middle of steps.
    excess : float
        Factor of the noise.
    """
    seen = record.force[:, body]
    counted = np.asarray(np.isfinite(seen).all(axis=1))
    weight = np.sqrt(record.samples[counted, body])[:, None] / (excess * record.sd_mn[body])
    long_step = record.window_steps * record.step_s
    since = long_step * (np.flatnonzero(counted) - np.argmax(counted) + 0.5)
    design = errors.functions(np.asarray(since, dtype=np.float64))
    basis, upper = np.linalg.qr(weight * design)
    # a normal prior of the last coefficient makes noise larger along the last direction: rows are in units of that noise
    largest = float(np.linalg.norm(seen[counted], axis=1).max(initial=0.0))
    drift_sd = USUAL_DRIFT * largest if errors.drift_sd is None else errors.drift_sd
    known = np.abs(upper[-1:, -1:].ravel()) * drift_sd if errors.drift else np.zeros(0)
    taken = np.ones(basis.shape[1])
    taken[len(taken) - len(known) :] = 1.0 - 1.0 / np.sqrt(1.0 + known**2)
    shrunk = taken * (2.0 - taken)  # of coefficients along these directions, 1 without a prior

    def without(rows: FloatArray) -> FloatArray:
        return rows - basis @ (taken[:, None] * (basis.T @ rows))

    delay, rate, doubtful = 0.0, np.zeros_like(seen), np.zeros_like(seen)
    if history is not None and (errors.delay or np.abs(record.phase_s[:, body]).max() > EXACT_S):

        def cost(means: FloatArray) -> float:
            return float((without(weight * (means - seen)[counted]) ** 2).sum())

        delay, means, means_change, rate, doubtful = _sampled(record, body, history, cost if errors.delay else None)
    raw, raw_slopes = weight * (means - seen)[counted], weight * means_change[:, counted]
    residual, slopes = without(raw), without(raw_slopes)
    along, stiffness = without(weight * rate[counted]) * float(errors.delay), DELAY_SD_S**-2
    variance = 1.0 / (float((along**2).sum()) + stiffness)
    delay_slopes = -variance * np.tensordot(slopes, along, axes=([1, 2], [0, 1]))
    slopes = slopes + delay_slopes[:, None, None] * along
    back = np.linalg.inv(upper)
    gain = (back * shrunk) @ basis.T
    of_delay = gain @ (weight * rate[counted])
    explained_slopes = -(gain @ raw_slopes) - delay_slopes[:, None, None] * of_delay
    spread = ((back * shrunk) @ back.T).diagonal() + variance * (of_delay**2).max(axis=1, initial=0.0) * float(errors.delay)
    explained = -(gain @ raw)
    off_middle = variance * float((along * weight * doubtful[counted]).sum()) if errors.delay else 0.0
    return BodyResiduals(
        counted, residual, slopes, explained, explained_slopes, spread, means, seen[counted] - design @ explained, delay, delay_slopes,
        variance + off_middle**2 + record.path_phase_s[body] ** 2 if errors.delay else 0.0,
    )  # fmt: skip


def _sampled(
    record: RecordedForces, body: int, history: ForceHistory, cost: Callable[[FloatArray], float] | None
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the delay of the least cost of means (windows, 3), 0 without a cost, and the means there.

    Then follow their derivatives by all else and by it, and what of them is in doubt because samples are not in the middle of steps.
    """
    sampled = partial(
        SampledMeans.of,
        shares=record.shares[:, body],
        phase_s=record.phase_s[:, body],
        window_steps=record.window_steps,
        step_s=record.step_s,
    )
    force, delay = history.force[:, body, None], 0.0
    if cost is not None:
        late = sampled(history.borders, force)
        delay = _best_delay(lambda tau: cost(late(tau)[0][:, 0]))
    means, rate = sampled(history.borders, np.concatenate([force, history.change[:, :, body].transpose(1, 0, 2)], axis=1))(delay)
    doubtful = sampled(history.borders, force).doubtful(delay)[:, 0]
    return delay, means[:, 0], means[:, 1:].transpose(1, 0, 2), rate[:, 0], doubtful


def _best_delay(cost: Callable[[float], float]) -> float:
    """Return the delay, s, of the least cost with that of the weak prior."""

    def whole(delay: float) -> float:
        return cost(delay) + (delay / DELAY_SD_S) ** 2

    grid = np.linspace(-MOST_DELAY_S, MOST_DELAY_S, 41)
    place = int(np.argmin([whole(delay) for delay in grid]))
    low, high = grid[max(place - 1, 0)], grid[min(place + 1, len(grid) - 1)]
    found = scipy.optimize.minimize_scalar(whole, bounds=(low, high), method="bounded", options={"xatol": EXACT_S})
    return float(found.x)
