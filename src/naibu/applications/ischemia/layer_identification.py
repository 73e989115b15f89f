"""Identification of the layers of skin from the indentation over time, with intervals and with what the record does not determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.special import gammaincinv, ndtr, stdtrit

from naibu.applications.ischemia.layered_response import LayeredModes
from naibu.applications.ischemia.skin import SurfaceLoad, refined
from naibu.core.arrays import FloatArray, require_positive
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.small_strain.rheology import Rheology

PARAMETERS = ("young_modulus", "voigt_viscosity", "series_viscosity")
WIDE = 4.0  # a 95 % interval whose ends differ by more than this factor determines nothing
SEARCHED = 1e3  # factor around the first guess
_EVALUATIONS = 2000  # along a valley that the record hardly tells apart it takes hundreds


@dataclass(frozen=True, slots=True)
class LayerParameter:
    """One identified parameter.

    Attributes
    ----------
    layer : int
        Number of the layer from the base upwards.
    name : {"young_modulus", "voigt_viscosity", "series_viscosity"}
        E, kPa, or C1 or C2, kPa s.
    value : float
        Estimate.
    low, high : float
        95 % interval.
    determined : bool
        Whether the record determines it: the ends of the interval differ by less than a factor of 4, and lie inside of the range that is
        searched, a thousandth to a thousand times the first guess.
    """

    layer: int
    name: str
    value: float
    low: float
    high: float
    determined: bool


@dataclass(frozen=True, slots=True, eq=False)
class LayerEstimate:
    """Identified layers.

    Attributes
    ----------
    materials : tuple of Rheology
        From the base upwards.
    parameters : tuple of LayerParameter
        With intervals.
    fitted : ndarray, shape (t,)
        Indentation of the identified patch, mm.
    residual_mm : float
        Root mean square of the residuals.
    explained : bool
        Whether the residuals are no larger than the stated noise allows (at a probability of one in a thousand), and not a pattern in time.
    """

    materials: tuple[Rheology, ...]
    parameters: tuple[LayerParameter, ...]
    fitted: FloatArray
    residual_mm: float
    explained: bool


def identify_layers(
    modes: LayeredModes,
    load: SurfaceLoad,
    times: ArrayLike,
    indentation_mm: ArrayLike,
    noise_mm: float,
    *,
    start: Sequence[Rheology] | None = None,
    known: Sequence[tuple[int, str]] = (),
) -> LayerEstimate:
    """Find E, C1 and C2 of every layer from the indentation in the middle.

    Weighted least squares in the logarithms of the parameters; intervals are profile likelihoods :cite:p:`venzon1988`, so that a
    parameter that has no effect gets an interval that says so. They hold the error of the mesh, estimated on one of halved cells.

    Parameters
    ----------
    modes : LayeredModes
        Of the patch, whose materials are the first guess.
    load : SurfaceLoad
        Force and duration.
    times, indentation_mm : array_like, shape (t,)
        s and mm, under the load and after it.
    noise_mm : float
        Standard deviation of the measured indentation, mm.
    start : sequence of Rheology, optional
        First guess of the layers; those of the patch by default. Layers that differ keep the search from a symmetric start.
    known : sequence of (int, str)
        Parameters that keep their first guess: number of the layer, and ``"young_modulus"``, ``"voigt_viscosity"`` or
        ``"series_viscosity"``.

    Raises
    ------
    InputError
        Fewer measurements than parameters, values that are not finite or lie within their noise, or a known parameter that does not exist.
    ConvergenceError
        The search found no minimum.
    """
    require_positive("noise_mm", noise_mm)
    t, measured = np.asarray(times, dtype=float), np.asarray(indentation_mm, dtype=float)
    if t.ndim != 1 or t.shape != measured.shape or not (np.isfinite(t).all() and np.isfinite(measured).all()):
        raise InputError(f"times and indentation_mm must be finite numbers of one shape, not {t.shape} and {measured.shape}")
    first = tuple(start) if start is not None else tuple(layer.material for layer in modes.meshed.patch.layers)
    if len(first) != len(modes.meshed.patch.layers):
        raise InputError(f"start must have a material for each of the {len(modes.meshed.patch.layers)} layers, not {len(first)}")
    for layer, name in known:
        if name not in PARAMETERS or not 0 <= layer < len(first):
            raise InputError(f"known has ({layer}, {name!r}); layers are 0 to {len(first) - 1}, names {', '.join(PARAMETERS)}")
    names = [(i, n) for i, m in enumerate(first) for n in PARAMETERS if (i, n) not in set(known) and np.isfinite(getattr(m, n))]
    if len(t) <= len(names):
        raise InputError(f"indentation_mm has {len(t)} values for {len(names)} parameters; record more instants, or state `known` ones")
    if float(((measured / noise_mm) ** 2).sum()) <= _greatest_chi_squared(len(t)):
        raise InputError(f"indentation_mm lies within its noise, noise_mm = {noise_mm:g}, about 0: nothing can be identified from it")
    fit = _Fit(_of_indentation(modes, load), load, t, measured, noise_mm, first, tuple(names))
    best = fit.search(np.zeros(len(names)))
    error = fit.discretisation_error(best, replace(fit, summed=_of_indentation(LayeredModes.of(refined(modes.meshed)), load)))
    profiles = [fit.interval(best.x, i) for i in range(len(names))]
    intervals = [(low - e, high + e) for (low, high), e in zip(profiles, error, strict=True)]
    materials = fit.materials(best.x)
    parameters = []
    for (layer, name), (low, high), profile in zip(names, intervals, profiles, strict=True):
        value = float(getattr(materials[layer], name))
        guess = float(getattr(first[layer], name))
        ends = guess * float(np.exp(low)), guess * float(np.exp(high))
        closed = max(abs(end) for end in profile) < np.log(SEARCHED)
        parameters.append(LayerParameter(layer, name, value, *ends, bool(closed and ends[1] < WIDE * ends[0])))
    fitted = fit.indentation(best.x)
    residuals = measured - fitted
    return LayerEstimate(
        materials, tuple(parameters), fitted, float(np.sqrt(np.mean(residuals**2))), _explained(residuals / noise_mm, len(names))
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Minimum:
    """A minimum of half the sum of squares: all logarithms, its value, and the Jacobian of those that were free."""

    x: FloatArray
    cost: float
    jac: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    summed: LayeredModes
    load: SurfaceLoad
    times: FloatArray
    measured: FloatArray
    noise_mm: float
    first: tuple[Rheology, ...]
    names: tuple[tuple[int, str], ...]

    def materials(self, logs: FloatArray) -> tuple[Rheology, ...]:
        values: list[dict[str, float]] = [{} for _ in self.first]
        for (layer, name), log in zip(self.names, logs, strict=True):
            values[layer][name] = float(getattr(self.first[layer], name) * np.exp(log))
        # a material checks its values, which takes longer than the response: one new material a layer
        return tuple(replace(m, **changed) if changed else m for m, changed in zip(self.first, values, strict=True))

    def indentation(self, logs: FloatArray) -> FloatArray:
        both = self.summed.step_response(self.materials(logs), np.concatenate([self.times, self.times - self.load.duration_s]))
        under, after = np.split(self.summed.amplitude @ both, 2)
        return np.asarray(under - after)

    def residuals(self, logs: FloatArray) -> FloatArray:
        return (self.indentation(logs) - self.measured) / self.noise_mm

    def search(self, start: FloatArray, held: tuple[int, float] | None = None) -> _Minimum:
        free = np.array([i for i in range(len(start)) if held is None or i != held[0]])
        logs = start.copy()
        if held is not None:
            logs[held[0]] = held[1]

        def of_free(values: FloatArray) -> FloatArray:
            at = logs.copy()
            at[free] = values
            return self.residuals(at)

        bound = np.log(SEARCHED)
        if len(free) == 0:
            return _Minimum(logs, 0.5 * float((self.residuals(logs) ** 2).sum()), np.zeros((len(self.times), 0)))
        found = least_squares(of_free, np.clip(logs[free], -bound, bound), bounds=(-bound, bound), x_scale=1.0, max_nfev=_EVALUATIONS)
        if not found.success:
            raise ConvergenceError(f"the search for the layers' parameters did not converge: {found.message}; state `known` parameters")
        logs[free] = found.x
        return _Minimum(logs, float(found.cost), np.asarray(found.jac))

    def interval(self, best: FloatArray, i: int) -> tuple[float, float]:
        """Return the ends where the profile of the misfit has risen by what 95 % allow, within the range that is searched."""
        base = self.search(best)
        freedom = len(self.times) - len(best)
        # residuals larger than the noise widen the interval
        factor = max(1.0, 2.0 * base.cost / freedom)
        allowed = base.cost + 0.5 * factor * float(stdtrit(freedom, 0.975)) ** 2
        ends = []
        for sign in (-1.0, 1.0):
            inside, at, step = best[i], best.copy(), 0.02
            limit = sign * np.log(SEARCHED)
            while True:
                trial = inside + sign * step
                if sign * trial >= sign * limit:
                    ends.append(limit)
                    break
                found = self.search(at, (i, trial))
                if found.cost > allowed:
                    ends.append(self._crossing(i, inside, trial, at, allowed))
                    break
                inside, at, step = trial, found.x, 2.0 * step
        return ends[0], ends[1]

    def discretisation_error(self, best: _Minimum, finer: _Fit) -> FloatArray:
        """Return how far the logarithms move, in the first order, if the mesh is refined once and for all.

        The error of the mesh is at most twice its change by halved cells if it falls at least in proportion to their size.
        """
        missing = 2.0 * (finer.residuals(best.x) - self.residuals(best.x))
        return np.asarray(np.abs(np.linalg.lstsq(best.jac, missing, rcond=1e-4)[0]))

    def _crossing(self, i: int, inside: float, outside: float, at: FloatArray, allowed: float) -> float:
        for _ in range(12):
            if abs(outside - inside) < 5e-3:
                break
            middle = 0.5 * (inside + outside)
            found = self.search(at, (i, middle))
            if found.cost > allowed:
                outside = middle
            else:
                inside, at = middle, found.x
        return float(outside)


def _of_indentation(modes: LayeredModes, load: SurfaceLoad) -> LayeredModes:
    """Return modes whose amplitudes are those of the indentation in the middle, mm kPa; modes that respond alike are one."""
    d = modes.meshed.constrained.shape[1]
    weight = -load.force_mn * modes.vectors[modes.meshed.middle * d + d - 1] * modes.amplitude
    share, group = np.unique(np.round(modes.share, 12), return_inverse=True)
    total = np.bincount(group, weight)
    kept = np.abs(total) > 1e-9 * np.abs(total).sum()
    return replace(modes, share=share[kept], amplitude=total[kept])


def _greatest_chi_squared(freedom: int) -> float:
    """Return the sum of squares of `freedom` unit normal numbers that 0.1 % exceed."""
    return 2.0 * float(gammaincinv(0.5 * freedom, 0.999))


def _explained(scaled: FloatArray, parameters: int) -> bool:
    """Return whether scaled residuals are as small as unit noise, and their signs do not run together in time (Wald-Wolfowitz)."""
    small = float((scaled**2).sum()) <= _greatest_chi_squared(max(1, len(scaled) - parameters))
    positive = scaled > 0.0
    n, m = int(positive.sum()), int((~positive).sum())
    if min(n, m) < 2:
        return bool(small) and len(scaled) < 12
    runs = 1 + int((positive[1:] != positive[:-1]).sum())
    mean = 1.0 + 2.0 * n * m / (n + m)
    spread = np.sqrt((mean - 1.0) * (mean - 2.0) / (n + m - 1.0))
    return bool(small and ndtr((runs - mean) / spread) > 1e-3)
