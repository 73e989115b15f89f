"""Load cases with measured markers: data, noise, and their fit at a set of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.parameters import ParameterSet
from naibu.core.rigid_transform import RigidTransform
from naibu.identification.from_markers.specimen.marker_grid import FILLED_SD_MM
from naibu.identification.from_markers.specimen.specimen_model import Specimen
from naibu.mechanics.finite_strain.statics import Solution, WarmStart

WARM_START_SPACING = 0.1  # of the load, between states that the next evaluation starts from
SAME = 1e-9  # relative difference of parameters and positions from rounding
NEAR_THE_END = 0.03  # of the load: a state so close to the end of a path tells where the end is, and is no step on the way to it
FAR = 0.05  # of the extent of the object, by which nodes move with a change of the parameters that is not small


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviation of a measured coordinate, mm: localisation of the marker's centre, and quantisation to pixels and slices.

    Where an experiment states the standard deviation of its coordinates, as tracked markers do, that replaces `placing_mm` and the
    quantisation, and `model_mm` is added: what a model with elements of a tenth of the object leaves unexplained at the true parameters.
    """

    placing_mm: float = 0.1
    model_mm: float = 0.05

    def of_experiment(self, experiment: Experiment) -> FloatArray:
        """Return the standard deviation (3,) along x, y, z, mm, of the coordinates of an experiment."""
        if experiment.sd_mm is not None:
            return np.asarray(np.hypot(experiment.sd_mm, self.model_mm))
        return self.standard_deviation(experiment.xy_step_mm, experiment.z_step_mm)

    def standard_deviation(self, xy_step_mm: float, z_step_mm: float) -> FloatArray:
        """Return the standard deviation (3,) along x, y, z, mm."""
        steps = np.array([xy_step_mm, xy_step_mm, z_step_mm])
        return np.sqrt(self.placing_mm**2 + steps**2 / 12.0)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerLoadCase:
    """One load case with measured markers: a loaded state of a specimen.

    Attributes
    ----------
    specimen : Specimen
        The meshed experiment.
    state : str
        Name of the state.
    measured : ndarray, shape (k, 3)
        Positions in the scan's frame, true mm; NaN where missing.
    sd : ndarray, shape (3,)
        Standard deviation of a measured coordinate of the loaded state, mm.
    free_sd : ndarray, shape (k, 3)
        That of the reference configuration; larger where a coordinate was completed from the lattice.
    """

    specimen: Specimen
    state: str
    measured: FloatArray
    sd: FloatArray
    free_sd: FloatArray

    @property
    def name(self) -> str:
        """``experiment/state``."""
        return f"{self.specimen.experiment.name}/{self.state}"

    @property
    def n_data(self) -> int:
        """Number of measured coordinates."""
        return int(np.isfinite(self.measured).sum())

    @classmethod
    def of(cls, specimen: Specimen, state: str, noise: NoiseModel) -> MarkerLoadCase:
        """Gather the measured positions (true mm in the scan's frame) of a state, in the order of the specimen's markers.

        Raises
        ------
        InputError
            The state has no positions, or fewer than four markers in common with the reference configuration.
        """
        experiment = specimen.experiment
        markers = experiment.state(state).markers
        if markers is None:
            raise InputError(f"{experiment.name}/{state} has no measured positions; give its file or leave the state out")
        measured = markers.aligned(specimen.marker_ids) * specimen.placement.scale
        if np.isfinite(measured).any(axis=1).sum() < 4:
            raise InputError(f"{experiment.name}/{state} shares fewer than 4 trusted markers with the reference configuration")
        sd = noise.of_experiment(experiment)
        return cls(specimen, state, measured, sd, np.where(specimen.marker_filled, FILLED_SD_MM, sd))


@dataclass(frozen=True, slots=True, eq=False)
class LoadCaseFit:
    """Computed and measured markers of a load case at one set of parameters.

    Attributes
    ----------
    predicted : ndarray, shape (k, 3)
        Predicted positions in the scan's frame, true mm.
    residual : ndarray, shape (k, 3)
        Measured minus predicted, mm; NaN where not measured.
    sd : ndarray, shape (k, 3)
        Standard deviation of the residual from noise in both states, mm.
    jacobian : ndarray, shape (k, 3, p)
        Derivatives of `predicted` with respect to the physical values of the free parameters.
    pose_jacobian : ndarray, shape (k, 3, 6)
        Derivatives with respect to the pose.
    path : tuple of ndarray, shape (n, 3, p)
        Derivatives of the states of `solution`; empty where they were not asked for.
    resting : Solution or None
        The body under its weight alone, as the reference scan saw it; None where no weight is applied.
    """

    solution: Solution
    pose: RigidTransform
    predicted: FloatArray
    residual: FloatArray
    sd: FloatArray
    jacobian: FloatArray
    pose_jacobian: FloatArray
    path: tuple[FloatArray, ...]
    resting: Solution | None = None

    def since_scan(self, displacement: FloatArray) -> FloatArray:
        """Return a displacement (n, 3) of the nodes, mm, less that by the weight alone, which the reference scan has seen."""
        return displacement if self.resting is None or not displacement.any() else np.asarray(displacement - self.resting.displacement)


@dataclass(frozen=True, slots=True, eq=False)
class SolvedLoadCase:
    """A solved load case to start other searches from.

    Attributes
    ----------
    fit : LoadCaseFit
        Its solution, with derivatives.
    parameters : ParameterSet
        The parameters that gave it.
    between : csr_array, shape (m, n), optional
        Interpolates its displacements at the nodes of another mesh, on which it is to start a search.
    """

    fit: LoadCaseFit
    parameters: ParameterSet
    between: sp.csr_array | None = None

    def warm_start(self, values: Mapping[str, float]) -> list[WarmStart]:
        """Return estimates of the states on its path at other `values`, to first order."""
        change = np.array([values.get(q.name, q.value) - q.value for q in self.parameters.free])
        estimates = _warm_start(self.fit, change)
        return estimates if self.between is None else [(load, np.asarray(self.between @ u)) for load, u in estimates]

    @property
    def stiffness(self) -> dict[float, tuple[FloatArray, ...]]:
        """Penalties of contact of the estimates of `warm_start`, by their loads, where they are to be kept."""
        return {}

    def path_at(self, values: Mapping[str, float], names: Sequence[str], points: FloatArray) -> tuple[FloatArray, ...] | None:
        """Return the derivatives (n, 3, p) of the states with respect to the parameters `names`; None where they are not those at `values`.

        Parameters
        ----------
        values : mapping
            Physical value of every parameter, by name.
        names : sequence of str
            Free parameters.
        points : ndarray, shape (n, 3)
            Nodes in the reference configuration at `values`, mm.
        """
        known, free = self.parameters.values(), {q.name: k for k, q in enumerate(self.parameters.free)}
        if self.between is not None or not self.fit.path or any(name not in free for name in names):
            return None
        if not all(name in known and np.isclose(known[name], value, rtol=SAME, atol=SAME) for name, value in values.items()):
            return None
        nodes = self.fit.solution.problem.points
        if nodes.shape != points.shape or not np.allclose(nodes, points, rtol=0.0, atol=SAME * float(np.ptp(nodes))):
            return None
        columns = [free[name] for name in names]
        return tuple(derivative[:, :, columns] for derivative in self.fit.path)


@dataclass(frozen=True, slots=True, eq=False)
class SamePath(SolvedLoadCase):
    """A solved load case as one to start from where its body moves along the same path, but elsewhere to its end.

    Attributes
    ----------
    reached : float
        How far the body moved in the solved load case, as a fraction of the way to the other end.
    """

    reached: float = 1.0

    def warm_start(self, values: Mapping[str, float]) -> list[WarmStart]:
        """Return its states at the loads at which the body is where it was in them, and what they tell of the other end."""
        states, loads = self.fit.solution.states, self._loads
        known = [(x, s.displacement) for x, s in zip(loads[1:], states[1:], strict=True) if x < 1.0 - NEAR_THE_END]
        if loads[-1] < 1.0 - NEAR_THE_END:  # the rest of the way is a step of its own
            return known
        after = min(max(1, int(np.searchsorted(loads, 1.0))), len(states) - 1)
        share = (1.0 - loads[after - 1]) / (loads[after] - loads[after - 1])
        before, behind = states[after - 1].displacement, states[after].displacement
        return [*known, (1.0, before + share * (behind - before))]

    @property
    def stiffness(self) -> dict[float, tuple[FloatArray, ...]]:
        """Penalties of contact of the states by their loads; those of the last at the other end."""
        states = self.fit.solution.states
        by_load = {x: s.normal_stiffness for x, s in zip(self._loads[1:], states[1:], strict=True)}
        return by_load | {1.0: states[-1].normal_stiffness}

    @property
    def _loads(self) -> list[float]:
        return [float(state.load * self.reached) for state in self.fit.solution.states]


def _warm_start(previous: LoadCaseFit, change: FloatArray) -> list[WarmStart]:
    """Return estimates of the states of a path after a small `change` of the parameters, one for states close together.

    There is none after a large change: a poor estimate costs more iterations than none.
    """
    out: list[WarmStart] = []
    if np.abs(previous.path[-1] @ change).max() > FAR * np.ptp(previous.solution.problem.points, axis=0).max():
        return out
    states = previous.solution.states
    for state, derivative in zip(states[1:], previous.path[1:], strict=True):
        if state.load == 1.0 or state.load - (out[-1][0] if out else 0.0) > WARM_START_SPACING:
            out.append((state.load, state.displacement + derivative @ change))
    return out
