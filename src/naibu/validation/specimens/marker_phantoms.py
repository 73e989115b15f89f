"""Virtual specimens: experiments with known parameters, solved on a mesh of their own and seen by a scanner with noise.

A phantom looks like a measured `Experiment`: markers in the reference configuration and in loaded states, each scan in a
pose of its own, positions with random errors and rounded to pixels and slices. All parameters are known, so that an identification can be
judged by the parameters that it returns. The mesh is finer than, and not a refinement of, the one on which parameters are sought.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Layer, Loading, Shape, State
from naibu.core.markers import Markers
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.identification.from_markers.specimen.indenter_path import state_parameters
from naibu.identification.from_markers.specimen.parameter_names import friction, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.resting_state import since_scan
from naibu.identification.from_markers.specimen.scan_alignment import placement
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, Specimen, specimen
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import Solution, solve
from naibu.meshing.point_location import interpolation_operator

ELEMENTS_OVER_HEIGHT = 14  # identification takes 10: no face between elements is shared but the necessary ones


@dataclass(frozen=True, slots=True)
class Scanner:
    """Measurement of marker positions by a virtual scanner.

    Attributes
    ----------
    placing_mm : float
        Standard deviation with which the centre of a marker is placed, along each axis.
    xy_step_mm, z_step_mm : float
        Pixel and slice pitch to which coordinates are rounded; 0 does not round.
    shift_mm : float
        Standard deviation of where the object lies in a scan, along each axis.
    turn_deg : float
        Standard deviation of its turn about the vertical.
    tilt_deg : float
        Standard deviation of its tilt about the two horizontal axes in loaded scans; in the free one it stands upright.
    missing : float
        Fraction of the coordinates that are lost (NaN).
    """

    placing_mm: float = 0.1
    xy_step_mm: float = 0.29
    z_step_mm: float = 0.5
    shift_mm: float = 20.0
    turn_deg: float = 5.0
    tilt_deg: float = 1.0
    missing: float = 0.0

    def __post_init__(self) -> None:
        values = (self.placing_mm, self.xy_step_mm, self.z_step_mm, self.shift_mm, self.turn_deg, self.tilt_deg, self.missing)
        if not all(np.isfinite(v) and v >= 0.0 for v in values) or self.missing >= 1.0:
            raise InputError(f"a scanner needs numbers that are not negative and a missing fraction below 1, not {self}")

    @property
    def standard_deviation(self) -> FloatArray:
        """Standard deviation (3,), mm, of a coordinate along x, y, z: placing and rounding together."""
        steps = np.array([self.xy_step_mm, self.xy_step_mm, self.z_step_mm])
        return np.sqrt(self.placing_mm**2 + steps**2 / 12.0)

    def pose(self, rng: np.random.Generator, *, upright: bool) -> RigidTransform:
        """Draw the pose of an object in a scan."""
        tilt, turn = np.radians(self.tilt_deg) * rng.normal(size=2), np.radians(self.turn_deg) * rng.normal()
        leaning = np.eye(3) if upright else rotation_matrix(np.array([*tilt, 0.0]))
        return RigidTransform(leaning @ rotation_matrix(np.array([0.0, 0.0, turn])), np.zeros(3), self.shift_mm * rng.normal(size=3))

    def seen(self, positions: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return what is read of positions (k, 3), mm: with the error of placing, rounded, and with gaps."""
        read = positions + self.placing_mm * rng.normal(size=positions.shape)
        for axis, step in enumerate((self.xy_step_mm, self.xy_step_mm, self.z_step_mm)):
            if step > 0.0:
                read[:, axis] = step * np.round(read[:, axis] / step)
        return np.where(rng.uniform(size=read.shape) < self.missing, np.nan, read)


@dataclass(frozen=True, slots=True, eq=False)
class VirtualSpecimen:
    """A deformed gel with known parameters and exact marker positions.

    Attributes
    ----------
    experiment : Experiment
        Description, with the markers of the reference configuration in the object's frame (base at z = 0, centre at x = y = 0) and without
        those of the loaded states.
    truth : mapping
        Physical value of every parameter, under the names that identification uses.
    model : Specimen
        The finite element model that was solved.
    free : ndarray, shape (k, 3)
        Positions of the markers in the reference configuration, mm, in the object's frame, in the order of ``experiment.initial.ids``.
    loaded : mapping of str to ndarray, shape (k, 3)
        The same in every loaded state.
    solutions : mapping of str to Solution
        The equilibrium path to every loaded state.
    """

    experiment: Experiment
    truth: Mapping[str, float]
    model: Specimen
    free: FloatArray
    loaded: Mapping[str, FloatArray]
    solutions: Mapping[str, Solution]

    def scanned(self, *, seed: int, scanner: Scanner | None = None) -> Phantom:
        """Scan every state once; another seed is another scan of the same gel."""
        device, rng = scanner or Scanner(), np.random.default_rng([seed, 1])
        poses = {s.name: device.pose(rng, upright=s is self.experiment.states[0]) for s in self.experiment.states}
        states = []
        for state in self.experiment.states:
            points = poses[state.name].applied(self.loaded.get(state.name, self.free))
            states.append(replace(state, markers=Markers.from_arrays(self.experiment.initial.ids, device.seen(points, rng))))
        base = None if len(self.experiment.nominal_heights_mm) > 1 else float(poses[self.experiment.states[0].name].position[2])
        seen = replace(self.experiment, states=tuple(states), xy_step_mm=device.xy_step_mm, z_step_mm=device.z_step_mm, base_z_mm=base)
        return Phantom(seen, dict(self.truth), self, MappingProxyType(poses))


@dataclass(frozen=True, slots=True, eq=False)
class Phantom:
    """A virtual experiment.

    Attributes
    ----------
    experiment : Experiment
        As if it had been measured.
    truth : dict
        Physical value of every parameter, under the names that identification uses.
    specimen : VirtualSpecimen
        What was scanned.
    poses : mapping of str to RigidTransform
        Pose of the object in the scan of every state.
    """

    experiment: Experiment
    truth: dict[str, float]
    specimen: VirtualSpecimen
    poses: Mapping[str, RigidTransform]


def box_experiment(
    name: str,
    size_mm: tuple[float, float, float],
    layers: Sequence[tuple[str, float]],
    loading: Loading,
    platen_positions_mm: Mapping[str, float],
    *,
    spacing_mm: float = 10.0,
    margin_mm: float = 10.0,
    joined_at_mm: Sequence[float] = (),
) -> Experiment:
    """Describe an experiment on a box, for `phantom`.

    Parameters
    ----------
    name : str
        Name of the experiment.
    size_mm : tuple of float
        Extents along x, y, z.
    layers : sequence of (material, thickness in mm)
        From the base up.
    loading : Loading
        Plate, bar or side plates.
    platen_positions_mm : mapping of str to float
        Name of every loaded state, and the height of the plate or bar (or distance of the side plates) in it.
    spacing_mm, margin_mm : float
        Spacing of the markers' lattice, and the least distance of its outermost markers from the faces.
    joined_at_mm : sequence of float
        Heights at which separately cast blocks lie on each other.

    Raises
    ------
    InputError
        Layers that do not fill the box, or no room for two markers along an axis.
    """
    tops = np.cumsum([thickness for _, thickness in layers])
    if len(layers) == 0 or abs(tops[-1] - size_mm[2]) > 1e-6 * size_mm[2]:
        raise InputError(f"the layers of {name!r} must add up to its height {size_mm[2]:g} mm, not {list(layers)}")
    bottoms = np.concatenate([[0.0], tops[:-1]])
    slabs = tuple(Layer(material, float(a), float(b)) for (material, _), a, b in zip(layers, bottoms, tops, strict=True))
    heights = _centred(size_mm[2], spacing_mm, margin_mm) + 0.5 * size_mm[2]
    states = (State("initial", None, loaded=False), *(State(s, None, stated_mm=float(at)) for s, at in platen_positions_mm.items()))
    return Experiment(
        name=name,
        title=f"virtual specimen {name}",
        source="computed",
        shape=Shape("box", size_mm),
        layers=slabs,
        loading=loading,
        states=states,
        joined_at_mm=tuple(joined_at_mm),
        nominal_spacing_mm=spacing_mm,
        nominal_margin_mm=margin_mm,
        nominal_heights_mm=tuple(heights.tolist()),
    )


def marker_lattice(experiment: Experiment) -> FloatArray:
    """Return the positions (k, 3), mm, of the markers in the object's frame: row by row along x, then y, then z.

    They are the nominal ones of a lattice in a box, else those of the markers in the reference configuration.

    Raises
    ------
    InputError
        The experiment states neither.
    """
    spacing, margin = experiment.nominal_spacing_mm, experiment.nominal_margin_mm
    if experiment.shape.kind == "box" and spacing and margin is not None:
        size = experiment.shape.size_mm
        z = np.array(experiment.nominal_heights_mm) if experiment.nominal_heights_mm else _centred(size[2], spacing, margin) + 0.5 * size[2]
        grid = np.meshgrid(z, _centred(size[1], spacing, margin), _centred(size[0], spacing, margin), indexing="ij")
        return np.stack([g.ravel() for g in grid[::-1]], axis=1)
    if experiment.states[0].markers is None:
        raise InputError(f"experiment {experiment.name!r} has neither a nominal lattice nor markers; give their positions")
    complete = experiment.initial.trusted & np.isfinite(experiment.initial.points).all(axis=1)
    return placement(experiment).to_object(experiment.initial.points[complete])


def _centred(extent: float, spacing: float, margin: float) -> FloatArray:
    """Return the positions of a row of markers about the middle of an edge."""
    count = int(np.floor((extent - 2.0 * margin) / spacing + 1e-9)) + 1
    if count < 2:
        raise InputError(f"an edge of {extent:g} mm has no room for two markers {spacing:g} mm apart and {margin:g} mm from the faces")
    return np.asarray(spacing * (np.arange(count) - 0.5 * (count - 1)))


def virtual_specimen(
    template: Experiment,
    truth: Mapping[str, float],
    *,
    settings: ModelSettings | None = None,
    markers: ArrayLike | None = None,
    jitter_mm: float = 0.0,
    seed: int = 0,
    solver: SolverSettings | None = None,
) -> VirtualSpecimen:
    """Solve all loaded states of an experiment with known parameters.

    Parameters
    ----------
    template : Experiment
        Object, loading and states: a measured one to make its virtual twin, or one from `box_experiment`. Its measured positions are
        used only for the positions of the markers where there is no nominal lattice.
    truth : mapping of str to float
        Physical values: `young_modulus` and `poisson_ratio` of every material, `friction` (sticking where left out), and what departs
        from the nominal boundary conditions: `platen_position`, tilts, offset of a bar.
    settings : ModelSettings, optional
        Law, contact, mesh; by default those of identification with `ELEMENTS_OVER_HEIGHT` elements over the height.
    markers : array_like, shape (k, 3), optional
        Positions of the markers in the object's frame, mm; default: `marker_lattice`.
    jitter_mm, seed : float, int
        Standard deviation of the markers about their positions, and the seed of that draw.
    solver : SolverSettings, optional
        Load steps and tolerance.

    Raises
    ------
    InputError
        A parameter is missing or unknown, or markers lie outside the object.
    ConvergenceError
        A state cannot be reached.
    """
    chosen = settings or ModelSettings(element_size_mm=template.height_mm / ELEMENTS_OVER_HEIGHT)
    places = marker_lattice(template) if markers is None else np.asarray(markers, dtype=float)
    free = places + jitter_mm * np.random.default_rng([seed, 0]).normal(size=places.shape)
    clean = _described(template, free)
    model = specimen(clean, chosen, whole=True)
    values = _complete(clean, model, truth)
    at_markers = interpolation_operator(model.mesh, free)
    solutions = {s.name: solve(model.problem(values, s.name), settings=solver) for s in clean.states[1:]}
    loaded = {name: free + at_markers @ since_scan(s) for name, s in solutions.items()}
    return VirtualSpecimen(clean, MappingProxyType(values), model, free, MappingProxyType(loaded), MappingProxyType(solutions))


def phantom(
    template: Experiment,
    truth: Mapping[str, float],
    *,
    seed: int,
    scanner: Scanner | None = None,
    settings: ModelSettings | None = None,
    jitter_mm: float = 0.0,
) -> Phantom:
    """Make a virtual experiment: `virtual_specimen` and its `VirtualSpecimen.scanned` with one seed.

    Raises
    ------
    InputError, ConvergenceError
        See `virtual_specimen`.
    """
    return virtual_specimen(template, truth, settings=settings, jitter_mm=jitter_mm, seed=seed).scanned(seed=seed, scanner=scanner)


def _described(template: Experiment, free: FloatArray) -> Experiment:
    """Return the template with exact markers in the object's frame, its loaded states only, and nothing of how it was measured."""
    first = template.states[0]
    markers = Markers.from_arrays(np.arange(1, len(free) + 1), free)
    states = (replace(first, markers=markers), *(replace(s, markers=None) for s in template.states[1:] if s.loaded))
    exact = replace(template, states=states, base_z_mm=0.0, xy_scale=1.0, xy_step_mm=0.0, z_step_mm=0.0, known_problems=())
    return replace(exact, title=f"virtual twin: {template.title}", source="computed", scanner={}, input_hashes={})


def _complete(experiment: Experiment, model: Specimen, truth: Mapping[str, float]) -> dict[str, float]:
    """Return the truth with nominal boundary conditions where it is silent; refuse missing and unknown names."""
    needed = [name(material) for material in experiment.materials for name in (young_modulus, poisson_ratio)]
    if missing := [name for name in needed if name not in truth]:
        raise InputError(f"the truth of {experiment.name!r} lacks {', '.join(missing)}")
    values = {p.name: p.value for state in experiment.states[1:] for p in state_parameters(experiment, state)} | dict(truth)
    for name, value in values.items():
        if not np.isfinite(value):
            raise InputError(f"{name} must be a finite number, not {value}")
        if not any(model.direction(name, values, state.name) for state in experiment.states[1:]):
            raise InputError(f"experiment {experiment.name!r} does not depend on {name!r}; it knows {', '.join(sorted(needed))}, ...")
    return values


def two_gels(height_mm: float) -> tuple[Experiment, dict[str, float]]:
    """Return an experiment to be made virtual, and its truth: a soft gel under a stiff one, a 60 mm cube pressed to `height_mm`."""
    truth = {
        young_modulus("soft"): 90.0,
        young_modulus("stiff"): 222.0,
        poisson_ratio("soft"): 0.48,
        poisson_ratio("stiff"): 0.47,
        friction("soft", "table"): 0.45,
        friction("stiff", "acrylic"): 0.25,
    }
    return box_experiment("virtual", (60.0,) * 3, [("soft", 30.0), ("stiff", 30.0)], Loading("plate"), {"pressed": height_mm}), truth
