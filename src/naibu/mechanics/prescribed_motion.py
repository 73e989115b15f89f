"""Prescribed motion: the displacement of a rigid body, or of the nodes that move with it, as a function of time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

_FINE, _COARSE = 1e-5, 1e-3  # steps, s, of the differences that stand in for derivatives that are not given


@dataclass(frozen=True, slots=True, eq=False)
class _Polyline:
    """Displacements g (k, d) at times t (k,), linear in between; its methods can be sent to other processes."""

    t: FloatArray
    g: FloatArray

    def displacement(self, time: float) -> FloatArray:
        return np.array([np.interp(time, self.t, column) for column in self.g.T])

    def velocity(self, time: float, side: int) -> FloatArray:
        k = int(np.searchsorted(self.t, time, side="right" if side > 0 else "left"))
        if not 0 < k < len(self.t):
            return np.zeros(self.g.shape[1])
        return np.asarray((self.g[k] - self.g[k - 1]) / (self.t[k] - self.t[k - 1]))

    def acceleration(self, time: float) -> FloatArray:
        return np.zeros(self.g.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class PrescribedMotion:
    """Displacement as a function of time; made by `through` (piecewise linear) or `of` (smooth functions).

    Attributes
    ----------
    displacement : callable
        From a time, s, to the displacement (d,), mm.
    velocity : callable
        From a time and a side (-1 just before it, 1 just after it) to the velocity (d,), mm/s.
    acceleration : callable
        From a time to the acceleration (d,), mm/s^2, away from kinks.
    kinks : tuple of float
        Times, s, at which the velocity jumps: steps end there.
    """

    displacement: Callable[[float], FloatArray]
    velocity: Callable[[float, int], FloatArray]
    acceleration: Callable[[float], FloatArray]
    kinks: tuple[float, ...] = ()

    @classmethod
    def through(cls, times_s: ArrayLike, displacements_mm: ArrayLike) -> PrescribedMotion:
        """Return the piecewise linear motion through given displacements, at rest before the first time and after the last.

        Parameters
        ----------
        times_s : array_like, shape (k,)
            Increasing times, s.
        displacements_mm : array_like, shape (k, d)
            Displacements at these times, mm.

        Raises
        ------
        InputError
            Times that do not increase, shapes that do not fit, or a value that is not finite.
        """
        t, g = np.array(times_s, dtype=float), np.array(displacements_mm, dtype=float)
        if t.ndim != 1 or g.ndim != 2 or len(t) != len(g) or len(t) == 0:
            raise InputError(
                f"times_s must have shape (k,) and displacements_mm (k, d) with k at least 1; their shapes are {t.shape} and {g.shape}"
            )
        if not (np.isfinite(t).all() and np.isfinite(g).all() and (np.diff(t) > 0.0).all()):
            raise InputError("times_s must increase, and times_s and displacements_mm must be finite numbers")
        line = _Polyline(t, g)
        return cls(line.displacement, line.velocity, line.acceleration, tuple(t.tolist()))

    @classmethod
    def of(
        cls,
        displacement: Callable[[float], ArrayLike],
        *,
        velocity: Callable[[float], ArrayLike] | None = None,
        acceleration: Callable[[float], ArrayLike] | None = None,
        kinks: Sequence[float] = (),
    ) -> PrescribedMotion:
        """Return the motion given by smooth functions of time.

        Parameters
        ----------
        displacement : callable
            From a time, s, to the displacement (d,), mm.
        velocity, acceleration : callable, optional
            From a time, s, to its first and second derivative (d,), mm/s and mm/s^2; central differences where they are not given.
        kinks : sequence of float
            Times, s, at which the velocity jumps.
        """

        def position(time: float) -> FloatArray:
            return np.asarray(displacement(time), dtype=float)

        def first(time: float, _: int) -> FloatArray:
            if velocity is not None:
                return np.asarray(velocity(time), dtype=float)
            return np.asarray((position(time + _FINE) - position(time - _FINE)) / (2.0 * _FINE))

        def second(time: float) -> FloatArray:
            if acceleration is not None:
                return np.asarray(acceleration(time), dtype=float)
            return np.asarray((first(time + _COARSE, 1) - first(time - _COARSE, -1)) / (2.0 * _COARSE))

        return cls(position, first, second, tuple(kinks))

    def sampled(self, times_s: ArrayLike) -> FloatArray:
        """Return the displacements (k, d), mm, at times (k,), s."""
        return np.array([self.displacement(float(time)) for time in np.asarray(times_s, dtype=float)])
