"""Forward model of calibration by a study: any number of indenters on any paths, tied or in contact with friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.captured.force_history import ForceHistory
from naibu.identification.lattice_calibration.forward_model import QUICK_S, Reproduced
from naibu.identification.lattice_calibration.studies.study_unknowns import Trial, TrialChange
from naibu.mechanics.contact.triangle_tree import TriangleTree
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.model.surface import surface_of
from naibu.mechanics.lattices.simulation.contact import push
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy, check_study
from naibu.mechanics.lattices.simulation.tangent_linear import Loads, ParameterChange, driven_steps, rest_change
from naibu.mechanics.lattices.simulation.tied_bodies import tied_constraints

QUICK_TOUCHING_S = 0.02  # like `QUICK_S`, in contact, where the first touch of moving indenters is no change of their motion

EXACT = 1e-4  # tolerance of the solver in contact: what it leaves decides where points begin to slip, and shapes and forces jump by that


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """Steps of one length under one set of constraints.

    Attributes
    ----------
    begin, end : int
        Fine steps.
    each : int
        Fine steps that are taken at once.
    constrained : ConstrainedNodes
        Of tied bodies.
    velocity : ndarray, shape (steps, bodies, 3)
        mm/s.
    """

    begin: int
    end: int
    each: int
    constrained: ConstrainedNodes
    velocity: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class StudyModel:
    """A study prepared to be simulated with any parameters, and compared at given instants.

    Attributes
    ----------
    study : LatticeStudy
        What happens.
    hull : TriangleTree
        Surface of the object.
    captures : tuple of int
        Fine steps after which the shape is wanted.
    windows : int
        Number of windows that forces are averaged over, from the start on.
    window_steps : int
        Fine steps in a window.
    weights : ndarray, shape (steps + 1, bodies)
        Sums over fine steps of their shares in the means of the windows, those of a window adding up to one.
    stretches : tuple
        How the steps are taken.
    coarse : bool
        Whether most of them are long.
    """

    study: LatticeStudy
    hull: TriangleTree
    captures: tuple[int, ...]
    windows: int
    window_steps: int
    weights: FloatArray
    stretches: tuple[_Stretch, ...]
    coarse: bool

    @classmethod
    def of(
        cls,
        study: LatticeStudy,
        capture_s: Sequence[float],
        windows: int,
        window_steps: int,
        *,
        coarse: bool,
        shares: FloatArray | None = None,
    ) -> StudyModel:
        """Prepare a study.

        Parameters
        ----------
        study : LatticeStudy
            By the implicit method.
        capture_s : sequence of float
            When shapes are compared, s; moved to the nearest step.
        windows, window_steps : int
            See the attributes.
        coarse : bool
            Whether a step is as long as a window, but within `QUICK_S` after a change of motion and next to captures.
        shares : ndarray, shape (windows * window_steps, bodies)
            Shares of fine steps in the means of their windows, such as those of the samples that a sensor took in them; equal by default.

        Raises
        ------
        InputError
            What `check_study` refuses, an explicit method, an indenter that is moved by a force, or a capture after the study's end.
        """
        check_study(study)
        if study.method != "implicit":
            raise InputError(f"method is {study.method!r}; a calibration needs the implicit one")
        if study.driven is not None:
            raise InputError(
                f"{study.bodies[study.driven].name} is moved by a force, and a recorded force tells nothing; give its measured path"
            )
        captures = tuple(round(time / study.step_s) for time in capture_s)
        most = round(study.frames * study.frame_s / study.step_s)
        if max(captures, default=0) > most or windows * window_steps > most:
            raise InputError(
                f"captures last until {max(capture_s):g} s, the study {most * study.step_s:g} s; "
                "count time from its beginning, or make its duration_s larger"
            )
        end = max(*captures, windows * window_steps, 1)
        each = np.full((windows * window_steps, len(study.bodies)), 1.0 / window_steps) if shares is None else shares
        weights = np.concatenate([np.zeros((1, len(study.bodies))), np.cumsum(each, axis=0)])
        stretches = _stretches(study, captures, end, window_steps, coarse)
        return cls(study, surface_of(study.lattice), captures, windows, window_steps, weights, stretches, coarse)

    @property
    def long_step(self) -> float:
        """Duration of a window, s, which forces are averaged over."""
        return self.window_steps * self.study.step_s

    def run(self, trial: Trial, changes: Sequence[TrialChange] = ()) -> Reproduced:
        """Return shapes at the captures, mean forces of the windows, and their derivatives along changes.

        Of tied studies, derivatives by the elements' parameters are integrated along with the motion; all others are differences.
        """
        if self.study.tied:
            tangents = [c.tangent for c in changes if c.tangent is not None]
            found = self._tied(trial, tangents)
            if len(tangents) == len(changes):
                return found
        else:
            found, tangents = self._touching(trial), []
        assert found.history is not None
        by_tangent = iter(zip(found.positions_change, found.force_change, found.history.change, strict=True))
        slopes = [next(by_tangent) if tangents and c.tangent is not None else self._difference(found, c) for c in changes]
        if not slopes:
            return found
        positions, force, history = (np.stack([s[k] for s in slopes]) for k in range(3))
        return replace(found, positions_change=positions, force_change=force, history=replace(found.history, change=history))

    def _difference(self, found: Reproduced, change: TrialChange) -> tuple[FloatArray, FloatArray, FloatArray]:
        moved, by = self._tied(change.moved, ()) if self.study.tied else self._touching(change.moved), np.expm1(change.shift)
        assert found.history is not None and moved.history is not None
        history = (moved.history.force - found.history.force) / by
        return (moved.positions - found.positions) / by, (moved.force - found.force) / by, history

    def _lattice(self, trial: Trial) -> tuple[Lattice, FloatArray | None]:
        """Return the lattice with a trial's masses, and the external force on it."""
        given, external = self.study.lattice, self.study.external_force
        if trial.node_mass is given.node_mass:
            return given, external
        weight = None if external is None else external * (trial.node_mass / given.node_mass)[:, None]
        return replace(given, node_mass=trial.node_mass), weight

    def _tied(self, trial: Trial, changes: Sequence[ParameterChange]) -> Reproduced:
        study, bodies = self.study, len(self.study.bodies)
        lattice, external = self._lattice(trial)
        engines = {
            e: LatticeEngine.of(lattice, trial.parameters, step=e * study.step_s, tolerance=study.tolerance) for e in self._lengths()
        }
        state = next(iter(engines.values())).rest()
        change = rest_change(next(iter(engines.values())), len(changes))
        weight = np.zeros((lattice.n_nodes, 3)) if external is None else external
        total = weight.sum(axis=0)
        share = np.linalg.norm(weight, axis=1) / max(float(np.linalg.norm(total)), 1e-300)  # a weight; all parts have one direction
        loads = Loads(np.arange(lattice.n_nodes), share, np.full(lattice.n_nodes, bodies))
        force = np.concatenate([np.zeros((bodies, 3)), total[None]])
        sums, sums_change = np.zeros((self.windows, bodies, 3)), np.zeros((len(changes), self.windows, bodies, 3))
        kept, kept_change, histories = {0: state.position}, {0: change.position}, []
        for s in self.stretches:
            path = np.concatenate([s.velocity, np.zeros((len(s.velocity), 1, 3))], axis=1)
            run = driven_steps(
                engines[s.each], state, len(path), s.constrained, path, loads=loads, force=force, changes=changes, state_change=change
            )
            state, change = run.state, run.state_change
            kept[s.end], kept_change[s.end] = state.position, change.position
            self._add(s, run.reaction[:, :bodies], sums)
            histories.append((run.reaction[:, :bodies], run.reaction_change[:, :, :bodies]))
            for own, slope in zip(sums_change, run.reaction_change, strict=True):
                self._add(s, slope[:, :bodies], own)
        shape_change = np.stack([kept_change[c] for c in self.captures], axis=1) if self.captures else np.zeros((len(changes), 0, 0, 3))
        history = self._history([h[0] for h in histories], np.concatenate([h[1] for h in histories], axis=1))
        return Reproduced(self._shapes(kept), sums, shape_change, sums_change, history)

    def _touching(self, trial: Trial) -> Reproduced:
        study = self.study
        lattice, external = self._lattice(trial)
        engines = {
            e: LatticeEngine.of(lattice, trial.parameters, step=e * study.step_s, tolerance=min(study.tolerance, EXACT))
            for e in self._lengths()
        }
        state = next(iter(engines.values())).rest()
        sums, kept, reactions = np.zeros((self.windows, len(study.bodies), 3)), {0: state.position}, []
        for s in self.stretches:
            motion = push(engines[s.each], state, trial.indenters, s.velocity, external_force=external)
            state = motion.state
            kept[s.end] = state.position
            reactions.append(motion.reaction)
            self._add(s, motion.reaction, sums)
        none = np.zeros((0, *sums.shape))
        history = self._history(reactions, np.zeros((0, sum(map(len, reactions)), *none.shape[2:])))
        return Reproduced(self._shapes(kept), sums, np.zeros((0, len(self.captures), 0, 3)), none, history)

    def _history(self, reactions: Sequence[FloatArray], change: FloatArray) -> ForceHistory:
        borders = np.concatenate([[0], *(np.arange(s.begin, s.end, s.each) + s.each for s in self.stretches)])
        return ForceHistory(self.study.step_s * borders, np.concatenate(reactions), change)

    def _lengths(self) -> list[int]:
        return sorted({s.each for s in self.stretches})

    def _shapes(self, kept: dict[int, FloatArray]) -> FloatArray:
        return np.stack([kept[c] for c in self.captures]) if self.captures else np.zeros((0, self.study.lattice.n_nodes, 3))

    def _add(self, stretch: _Stretch, reaction: FloatArray, sums: FloatArray) -> None:
        """Add forces of steps to the means of their windows."""
        first = np.arange(stretch.begin, stretch.end, stretch.each)
        inside = first < self.windows * self.window_steps
        first, reaction = first[inside], reaction[inside]
        share = self.weights[first + stretch.each] - self.weights[first]
        np.add.at(sums, first // self.window_steps, reaction * share[:, :, None])


def _stretches(study: LatticeStudy, captures: Sequence[int], end: int, ratio: int, coarse: bool) -> tuple[_Stretch, ...]:
    """Return how steps are taken: fine ones behind kinks of the motion and around events, long ones elsewhere."""
    step, bodies = study.step_s, len(study.bodies)
    never = np.iinfo(np.int64).max
    until = [never if b.tied_until_s is None or np.isinf(b.tied_until_s) else round(b.tied_until_s / step) for b in study.bodies]
    tied = tied_constraints(study.lattice, study.bodies) if study.tied else ()
    kinks = {0, *(round(t / step) for b in study.bodies if b.motion is not None for t in b.motion.kinks), *(u for u in until if u < end)}
    events = sorted({*captures, *kinks})
    quick = round((QUICK_S if study.tied else QUICK_TOUCHING_S) / step)
    cells: list[tuple[int, int, int]] = []
    for begin in range(0, end, ratio):
        stop = min(begin + ratio, end)
        fine = not coarse or stop - begin < ratio or any(begin < e < stop for e in events) or any(k <= begin < k + quick for k in kinks)
        cells.append((begin, stop, 1 if fine else ratio))
    breaks = {*captures, *(u for u in until if u < end)}
    found = []
    for (each, _), group in groupby(cells, key=lambda c: (c[2], 0)):
        run = list(group)
        marks = sorted({run[0][0], run[-1][1], *(b for b in breaks if run[0][0] < b < run[-1][1])})
        for a, b in pairwise(marks):
            times = np.asarray(step * np.arange(a, b + 1, each), dtype=np.float64)
            path = np.stack([np.diff(body.moved(times), axis=0) / (each * step) for body in study.bodies], axis=1)
            constrained = ConstrainedNodes.none()
            for k in range(bodies if study.tied else 0):
                constrained = constrained + tied[k] if until[k] > a else constrained
            found.append(_Stretch(a, b, each, constrained, path))
    return tuple(found)
