"""Records of force sensors, averaged over windows of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.lattice import require_positive
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy

WINDOW_S = 0.02
SAMPLED_PIECES = 8  # of a path, from which on it is a smooth motion that was sampled, and no motion at constant speeds
LEAST_WITHIN = 0.02  # of the samples of a record within the study: with fewer, times are likely to have another unit


@dataclass(frozen=True, slots=True, eq=False)
class RecordedForces:
    """Mean forces of windows.

    Attributes
    ----------
    window_steps : int
        Steps of the study in a window.
    step_s : float
        Their length, s.
    force : ndarray, shape (windows, bodies, 3)
        mN; NaN where nothing was recorded.
    samples : ndarray, shape (windows, bodies)
        Number of samples that were averaged.
    shares : ndarray, shape (windows * window_steps, bodies)
        Of the steps in the means of their windows, by the samples that were taken in them: simulated forces are averaged alike.
    phase_s : ndarray, shape (windows * window_steps, bodies)
        How much later than the middle of its step a sample was taken, on the average of those in a step, s.
    path_phase_s : ndarray, shape (bodies,)
        How much later than the middle of the pieces of a sampled path samples are taken, s: at its points the speed of a path jumps, and
        where all samples follow them alike, simulated forces seem late or early by that.
    sd_mn : ndarray, shape (bodies,)
        Standard deviation of a component in one sample.
    """

    window_steps: int
    step_s: float
    force: FloatArray
    samples: FloatArray
    shares: FloatArray
    phase_s: FloatArray
    path_phase_s: FloatArray
    sd_mn: FloatArray

    @classmethod
    def of(
        cls,
        study: LatticeStudy,
        records: Sequence[tuple[int, FloatArray, FloatArray]],
        *,
        sd_mn: float | None = None,
        window_s: float = WINDOW_S,
    ) -> RecordedForces:
        """Average samples over windows of time, the same for all records.

        Windows last at least `window_s` and are so long that, at the mean rate of the slowest record, each holds a sample. Windows
        without a sample do not count. No sample is interpolated.

        Parameters
        ----------
        study : LatticeStudy
            Gives steps and duration.
        records : sequence of (int, ndarray, ndarray)
            Number of a body, times (n,), s, and forces (n, 3), mN, on the object.
        sd_mn : float
            Standard deviation of a component of a sample, mN; by default estimated from second differences of neighbouring samples.
        window_s : float
            s.

        Raises
        ------
        InputError
            No sample during the study, or a standard deviation that is not positive or cannot be estimated.
        """
        if sd_mn is not None:
            require_positive(sd_mn, "force_sd_mn", "mN")
        slowest = max((float(np.median(np.diff(times))) for _, times, _ in records), default=0.0)
        each = max(1, round(window_s / study.step_s), int(np.ceil(1.0001 * slowest / study.step_s)))
        end = round(study.frames * study.frame_s / study.step_s)
        windows, bodies = end // each, len(study.bodies)
        if windows == 0:
            raise InputError(
                f"samples of the forces are {slowest:g} s apart, and the study lasts {end * study.step_s:g} s: no window holds one; "
                "is the unit of times another one, to be named in the column, as in time_ms?"
            )
        shares = np.full((windows * each, bodies), 1.0 / each)
        phase, path_phase = np.zeros_like(shares), np.zeros(bodies)
        sums, samples, sd = np.zeros((windows, bodies, 3)), np.zeros((windows, bodies)), np.full(bodies, np.nan)
        for body, times, force in records:
            place = np.floor(times / (each * study.step_s) - 1e-9).astype(np.int64)
            inside = (times > 0.0) & (place < windows)
            if inside.mean() < LEAST_WITHIN:
                raise InputError(
                    f"the record of {study.bodies[body].name} lasts from {times[0]:g} to {times[-1]:g} s, the study from 0 to "
                    f"{end * study.step_s:g} s: {inside.sum() or 'no'} of {len(times)} samples lie within; give times from the beginning "
                    "of the motion on, their unit in the name of the column, as in time_ms, and not what was recorded long before or after"
                )
            np.add.at(sums[:, body], place[inside], force[inside])
            np.add.at(samples[:, body], place[inside], 1.0)
            taken = np.floor(times[inside] / study.step_s - 1e-9).astype(np.int64)
            count = np.bincount(taken, minlength=windows * each)
            shares[:, body] = count / np.maximum(np.repeat(samples[:, body], each), 1.0)
            late = times[inside] - study.step_s * (taken + 0.5)
            phase[:, body] = np.bincount(taken, weights=late, minlength=windows * each) / np.maximum(count, 1)
            motion = study.bodies[body].motion
            path_phase[body] = _after_middle(times[inside], np.array(() if motion is None else motion.kinks))
            sd[body] = sd_mn if sd_mn is not None else _noise(study.bodies[body].name, force)
        last = int(np.flatnonzero(samples.any(axis=1))[-1]) + 1 if records else 0
        mean = np.where(samples[:last, :, None] > 0.0, sums[:last] / np.maximum(samples[:last, :, None], 1.0), np.nan)
        return cls(each, study.step_s, mean, samples[:last], shares[: last * each], phase[: last * each], path_phase, sd)


def _after_middle(times: FloatArray, kinks: FloatArray) -> float:
    """Return the median over pieces of a sampled path, which end at kinks (k,), s, of how late samples are after their middle, s."""
    piece = np.searchsorted(kinks, times)
    within = (piece > 0) & (piece < len(kinks))
    if len(kinks) <= SAMPLED_PIECES or not within.any():
        return 0.0
    late = times[within] - 0.5 * (kinks[piece[within] - 1] + kinks[piece[within]])
    count = np.bincount(piece[within])
    return float(np.median((np.bincount(piece[within], late) / np.maximum(count, 1))[count > 0]))


def _noise(name: str, force: FloatArray) -> float:
    """Return the standard deviation of samples (n, 3) from their second differences, robustly."""
    second = force[2:] - 2.0 * force[1:-1] + force[:-2]
    sd = float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6.0)) if len(second) else 0.0
    if not sd > 0.0:
        raise InputError(f"the noise of the record of {name} cannot be told from its {len(force)} samples; give force_sd_mn")
    return sd
