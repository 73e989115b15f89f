"""Sensitivities of a motion to moduli and viscosities, by direct differentiation of the default method :cite:p:`michaleris1994`.

A step solves ``K v = ...``; its derivative along a change of the materials solves the same system, ``K v' = ...``, with another right side.
So all derivatives together need one factorization, as the motion does, and some passes over the cells for each; they are exact for
the discrete motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.linear_simplices import Simplices
from naibu.mechanics.small_strain._rheology_kernels import advanced, stage_forces
from naibu.mechanics.small_strain.dynamics import Load, Series, integrate_motion
from naibu.mechanics.small_strain.implicit_integrators import STAGE, MotionState, Phase, Sdirk2
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import CellRheology, Rheology, StepCoefficients
from naibu.mechanics.small_strain.supports import Support

NAMES = {"young_modulus": "elastic", "voigt_viscosity": "voigt", "series_viscosity": "series"}


@dataclass(frozen=True, slots=True, eq=False)
class MaterialChange:
    """A direction in the space of materials: rates of change of the tables of `CellRheology`.

    Attributes
    ----------
    elastic, voigt, series : ndarray, shape (m, 2)
        Change of the lambda and mu parts of E, C1 and C2 for a unit of the parameter; zero where C2 is infinite.
    """

    elastic: FloatArray
    voigt: FloatArray
    series: FloatArray

    @classmethod
    def relative(cls, law: CellRheology, name: str, cells: ArrayLike | None = None) -> MaterialChange:
        """Return the direction of the logarithm of a parameter, in all cells or in those of a mask (m,) or a list of numbers.

        Parameters
        ----------
        law : CellRheology
            The materials at which derivatives are taken.
        name : {"young_modulus", "voigt_viscosity", "series_viscosity"}
            Which parameter; its Poisson ratio is kept.
        cells : array_like, optional
            Cells whose parameter changes; all by default.

        Raises
        ------
        InputError
            Another name, or a mask that does not fit.
        """
        if name not in NAMES:
            raise InputError(f"derivatives are with respect to {', '.join(NAMES)}, not {name!r}")
        chosen = np.zeros(len(law.elastic), dtype=bool)
        where = np.ones_like(chosen) if cells is None else np.asarray(cells)
        if where.dtype == bool and where.shape != chosen.shape:
            raise InputError(f"a mask of cells must have shape {chosen.shape}, not {where.shape}")
        chosen[where] = True
        part = getattr(law, NAMES[name])
        parts = {key: np.zeros_like(law.elastic) for key in NAMES.values()}
        parts[NAMES[name]] = np.where(chosen[:, None] & np.isfinite(part), part, 0.0)
        return cls(**parts)

    @classmethod
    def between(cls, lower: CellRheology, upper: CellRheology, width: float) -> MaterialChange:
        """Return the direction from one table to another nearby, over the difference `width` of the parameter by which they differ.

        A difference of tables is cheap compared with one of motions; with it a Poisson ratio, a gradient of moduli or any other
        parametrisation can be differentiated.

        Parameters
        ----------
        lower, upper : CellRheology
            Tables of materials at two values of the parameter.
        width : float
            Difference of the two values, in the unit of the parameter.

        Raises
        ------
        InputError
            Tables for different numbers of cells, a zero width, or a dashpot that only one of them has.
        """
        if len(lower.elastic) != len(upper.elastic) or width == 0.0 or not np.isfinite(width):
            raise InputError(f"a direction needs two tables for the same cells and a width, not {width:g}")
        if (np.isposinf(lower.series) != np.isposinf(upper.series)).any():
            raise InputError("C2 must be infinite in both tables, or finite in both")
        with np.errstate(invalid="ignore"):
            series = np.where(np.isposinf(lower.series), 0.0, (upper.series - lower.series) / width)
        return cls((upper.elastic - lower.elastic) / width, (upper.voigt - lower.voigt) / width, series)

    def over(self, law: CellRheology, step_s: float) -> StepCoefficients:
        """Return the rate of change of `CellRheology.over`."""
        total, flows = law.voigt + law.series, np.isfinite(law.series) & (law.voigt + law.series != 0.0)
        ratio, x, now = law.viscosity_ratio, law.relaxation_rate * step_s, law.over(step_s)
        with np.errstate(divide="ignore", invalid="ignore"):
            of_ratio = np.where(flows, (self.series * law.voigt - law.series * self.voigt) / total**2, 0.0)
            of_rate = np.where(flows, (self.elastic - law.relaxation_rate * (self.voigt + self.series)) / total, 0.0)
            mean = np.where(x == 0.0, 1.0, -np.expm1(-x) / x)
            slope = np.where(x < 1e-4, -0.5 + x / 3.0, (now.decay - mean) / x)
        return StepCoefficients(
            decay=-step_s * of_rate * now.decay,
            gain=step_s * (of_ratio * mean + ratio * slope * step_s * of_rate),
            spring=of_ratio * law.elastic + ratio * self.elastic,
            dashpot=self.voigt * ratio + law.voigt * of_ratio,
        )


@dataclass(frozen=True, slots=True, eq=False)
class SeriesDerivatives:
    """Derivatives of a time series, one for each direction.

    Attributes
    ----------
    displacement, reaction : ndarray, shape (p, k, n, d)
        mm and mN for a unit of each parameter.
    """

    displacement: FloatArray
    reaction: FloatArray

    def force(self, support: Support) -> FloatArray:
        """Return the derivatives (p, k, d) of the force of a support while it is active, mN."""
        axes = range(self.reaction.shape[3]) if support.axes is None else support.axes
        out = np.zeros((*self.reaction.shape[:2], self.reaction.shape[3]))
        out[..., list(axes)] = self.reaction[:, :, support.nodes].sum(axis=2)[..., list(axes)]
        return out


def simulate_motion_with_derivatives(
    body: LinearBody,
    materials: Rheology | CellRheology,
    density: ArrayLike | None,
    supports: Sequence[Support],
    times: ArrayLike,
    directions: Sequence[MaterialChange],
    *,
    step: float | None = None,
    mass: str = "lumped",
    load: ArrayLike | Load | None = None,
    breaks: Sequence[float] = (),
) -> tuple[Series, SeriesDerivatives]:
    """Simulate a motion by ``"sdirk2"`` from the reference configuration, with its derivatives along changes of the materials.

    Parameters
    ----------
    body, materials, density, supports, times, step, mass, load, breaks
        As for `simulate_motion`.
    directions : sequence of MaterialChange
        Directions of differentiation; `MaterialChange.relative` returns the common ones.

    Returns
    -------
    Series
        The motion.
    SeriesDerivatives
        Its derivatives.

    Raises
    ------
    InputError
        No direction, one for another body, or a support with relative displacements.
    """
    m = body.simplices.n_cells
    if not directions or any(table.shape != (m, 2) for d in directions for table in (d.elastic, d.voigt, d.series)):
        raise InputError(f"derivatives need one or more directions with tables of shape {(m, 2)}")
    if any(support.relative for support in supports):
        raise InputError("derivatives need supports with displacements from the reference configuration; give them without relative=True")
    integrator = _Linearised(body.simplices, directions)
    series = integrate_motion(integrator, body, materials, density, supports, times, step=step, mass=mass, load=load, breaks=breaks)
    displacement, reaction = (np.stack(kept, axis=1) for kept in (integrator.displacements, integrator.reactions))
    return series, SeriesDerivatives(displacement, reaction)


@dataclass(frozen=True, slots=True, eq=False)
class _Tangent:
    """Derivatives (p, ...) of a state: displacement, velocity, internal strain, reaction."""

    displacement: FloatArray
    velocity: FloatArray
    trace: FloatArray
    strain: FloatArray
    reaction: FloatArray


class _Linearised(Sdirk2):
    """The default method, which also advances the derivatives of its state."""

    def __init__(self, body: Simplices, directions: Sequence[MaterialChange]) -> None:
        super().__init__()
        self.directions = directions
        p, m, d = len(directions), body.n_cells, body.dimension
        zero = np.zeros((p, body.n_points, d))
        self.tangent = _Tangent(zero, zero, np.zeros((p, m)), np.zeros((p, m, d, d)), zero)
        self.displacements: list[FloatArray] = []
        self.reactions: list[FloatArray] = []
        self._constrained_rate = zero
        self._changes: dict[str, list[StepCoefficients]] = {}

    def record(self, state: MotionState) -> None:
        """Record the derivatives of a state at an output time."""
        self.displacements.append(self.tangent.displacement)
        self.reactions.append(self.tangent.reaction)

    def begin(self, phase: Phase, state: MotionState, step_s: float, changed: bool) -> MotionState:
        """Return the state after an event; the velocity of constrained components does not depend on the materials."""
        kept = self.tangent.velocity
        after = super().begin(phase, state, step_s, changed)
        if phase.mass is None:
            velocity = kept
        else:
            wrong = np.where(phase.supports.constrained, -kept, 0.0)
            inertia, zero = phase.mass, np.zeros(kept.shape[1:])
            velocity = np.array([v + inertia.accelerations(zero, phase.supports.constrained, w) for v, w in zip(kept, wrong, strict=True)])
        self.tangent = replace(self.tangent, velocity=velocity)
        return after

    def _expect(self, phase: Phase, span: float) -> None:
        """Set the rates that bring the constrained components back on their prescribed motion, whatever the materials."""
        self._constrained_rate = np.where(phase.supports.constrained, -self.tangent.displacement / span, 0.0)

    def _stage(
        self,
        phase: Phase,
        start: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
        h: float,
        until: float,
        known: FloatArray,
        ahead: StepCoefficients | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        """Take the stage, then its derivatives: those of the same equation, with what the change of its coefficients adds."""
        done = super()._stage(phase, start, h, until, known, ahead)
        body, over, rest = phase.body.simplices, self.factorizations.over(phase.law, h), h * (1.0 - STAGE) / STAGE
        last, span = (over, h) if ahead is None else (ahead, rest)
        velocity, internal, t = done[0], start[2:], self.tangent
        changes, later = self._changed(phase, h), self._changed(phase, span)
        guess = np.where(phase.supports.constrained, self._constrained_rate, t.velocity)
        direct = [stage_forces(body, _of_change(over, change), velocity, *internal) for change in changes]
        residual = self._residual(phase, over, guess, h, direct)
        free = np.where(phase.supports.constrained, 0.0, residual)
        found = self._factor(phase, h).solve(np.ascontiguousarray(free.reshape(len(free), -1).T))
        rate = guess - found.T.reshape(guess.shape)
        ends = [advanced(body, last, v, e, f) for v, e, f in zip(rate, t.trace, t.strain, strict=True)]
        added = [advanced(body, change, velocity, *internal) for change in later]
        self.tangent = _Tangent(
            t.displacement + span * rate,
            t.velocity + (1.0 if ahead is None else rest / h) * (rate - t.velocity),
            np.array([e[1] + a[1] for e, a in zip(ends, added, strict=True)]),
            np.array([e[2] + a[2] for e, a in zip(ends, added, strict=True)]),
            self._reaction(phase, over, rate, h, direct) if ahead is None else t.reaction,
        )
        return done

    def _residual(self, phase: Phase, over: StepCoefficients, rate: FloatArray, h: float, direct: list[FloatArray]) -> FloatArray:
        t, body = self.tangent, phase.body.simplices
        parts = zip(rate, t.velocity, t.trace, t.strain, direct, strict=True)
        return np.array([phase.momentum(v - before) / h + stage_forces(body, over, v, e, f) + extra for v, before, e, f, extra in parts])

    def _reaction(self, phase: Phase, over: StepCoefficients, rate: FloatArray, h: float, direct: list[FloatArray]) -> FloatArray:
        out, constrained = self._residual(phase, over, rate, h, direct), phase.supports.constrained
        if phase.mass is not None:  # as for the motion: the prescribed acceleration, which does not depend on the materials
            for i, acceleration in enumerate((rate - self.tangent.velocity) / h):
                wrong = np.where(constrained, -acceleration, 0.0)
                out[i] += phase.mass.apply(phase.mass.accelerations(np.zeros_like(wrong), constrained, wrong))
        return np.where(constrained, out, 0.0)

    def _changed(self, phase: Phase, step_s: float) -> list[StepCoefficients]:
        key = f"{step_s:.10g}"
        if key not in self._changes:
            self._changes[key] = [direction.over(phase.law, step_s) for direction in self.directions]
        return self._changes[key]


def _of_change(now: StepCoefficients, change: StepCoefficients) -> StepCoefficients:
    """Return coefficients whose stage forces are what a change of the coefficients adds at the same velocity and internal strain."""
    return StepCoefficients(
        decay=change.spring * now.decay + now.spring * change.decay,
        gain=np.zeros_like(now.gain),
        spring=np.ones_like(now.spring),
        dashpot=change.dashpot + change.spring * now.gain + now.spring * change.gain,
    )
