"""Calibration: parameters with priors, and their joint identification from markers in all loaded states by FEMU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Layer
from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.progress import Progress
from naibu.core.status import Status
from naibu.identification.from_markers.coarse_search import coarse_search
from naibu.identification.from_markers.gauss_newton import Checkpoint, Match, Matcher, MatchingSettings
from naibu.identification.from_markers.initial_guess import equilibrium_gap
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.mesh_error import MeshError, mesh_error
from naibu.identification.from_markers.observations import MarkerLoadCase, NoiseModel, SolvedLoadCase
from naibu.identification.from_markers.specimen.indenter_path import state_parameters
from naibu.identification.from_markers.specimen.parameter_names import (
    SHAPE_NAMES,
    base_offset,
    batch_stiffness,
    friction,
    joint_friction,
    pixel_scale,
    poisson_ratio,
    shape_parameter,
    straight_base,
    young_modulus,
)
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, Specimen, specimen

REFERENCE_MODULUS_KPA = 200.0  # of the known region when only ratios are sought
WEIGHED_SD = 1.5  # of ln(modulus) of a gel about that reference, where its weight is to tell: 10 to 4000 kPa
START_POISSON_RATIO = 0.49
START_FRICTION = 0.2
START_SPRING = 30.0  # kPa/mm
BASE_SD_MM = 0.5  # of the height of the markers above the base
GUESSED_BASE_SD_MM = 3.0  # the same where the markers' clearance in a dome is all that tells it
PIXEL_SCALE_SD = 0.005  # a size printed with two digits, 0.29 mm for 0.293
BATCH_SD = 0.3  # of ln(stiffness) between batches: the samples of one gel in Hirai et al. (2008), Table 3.4, have an SD of 0.2
SHAPE_SD = {"c01_fraction": 0.5, "c20_ratio": 1.0, "c30_ratio": 1.0}
TRUSTED_RATIO = (0.05, 20.0)  # of an unknown modulus to the known ones; the equilibrium gap is not used beyond


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Load cases of a calibration and their fit.

    Attributes
    ----------
    load_cases : tuple of MarkerLoadCase
        What was fitted.
    match : Match
        The fit.
    settings : ModelSettings
        Law, contact, mesh.
    noise : NoiseModel
        Of the measurement.
    known_materials : KnownMaterials
        What set the scale.
    priors : ParameterSet
        The parameters as they were before the search.
    mesh : MeshError, optional
        What the size of the elements did to the parameters; None where that was not estimated.
    """

    load_cases: tuple[MarkerLoadCase, ...]
    match: Match
    settings: ModelSettings
    noise: NoiseModel
    known_materials: KnownMaterials
    priors: ParameterSet
    mesh: MeshError | None = None

    @property
    def covariance(self) -> FloatArray:
        """Second moment (p, p) of the errors of the free parameters on the optimiser's scale, from noise, misfit and elements."""
        return self.match.covariance if self.mesh is None else self.match.covariance + self.mesh.covariance

    @property
    def warm_starts(self) -> dict[str, SolvedLoadCase]:
        """The solved load cases by label, for other searches to start from."""
        pairs = zip(self.load_cases, self.match.fits, strict=True)
        return {load_case.name: SolvedLoadCase(fit, self.match.parameters) for load_case, fit in pairs}


def calibrate(
    experiments: Sequence[Experiment],
    *,
    known_materials: KnownMaterials | None = None,
    states: Mapping[str, Sequence[str]] | None = None,
    settings: ModelSettings | None = None,
    noise: NoiseModel | None = None,
    search: MatchingSettings | None = None,
    start: Mapping[str, float] | None = None,
    warm_starts: Mapping[str, SolvedLoadCase] | None = None,
    with_mesh_error: bool = True,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> Calibration:
    """Identify materials, friction and boundary conditions from all loaded states of some experiments jointly.

    Parameters
    ----------
    experiments : sequence of Experiment
        With three-dimensional markers.
    known_materials : KnownMaterials, optional
        Materials with known modulus; by default the first one found stands for the scale, and the others' moduli are ratios to it.
    states : mapping, optional
        States to use, by experiment; all measured ones by default.
    settings : ModelSettings, optional
        Law, contact, mesh.
    noise : NoiseModel, optional
        Of the measurement.
    search : MatchingSettings, optional
        Iterations and tolerance.
    start : mapping, optional
        Physical values to start from, by name; priors keep their centres.
    warm_starts : mapping, optional
        Solutions near the start, by the labels of their load cases (`Calibration.warm_starts`); they save time.
    with_mesh_error : bool
        Whether to estimate what the size of the elements did to the parameters, on a finer mesh.
    progress : callable, optional
        Gets a report after every step (`naibu.core.progress`).
    checkpoint : callable, optional
        Gets the values of all parameters after every step.

    Raises
    ------
    InputError
        No experiment, no measured loaded state, a known material that no experiment contains, or data that cannot be used.
    ConvergenceError
        A load case cannot be solved at the starting values.
    """
    if not experiments:
        raise InputError("no experiments are given; name at least one folder or bundled dataset")
    chosen, measured = settings or ModelSettings(), noise or NoiseModel()
    specimens = [specimen(e, chosen) for e in experiments]
    used = {e.name: tuple((states or {}).get(e.name, [s.name for s in e.loaded_states])) for e in experiments}
    load_cases = tuple(MarkerLoadCase.of(s, name, measured) for s in specimens for name in used[s.experiment.name])
    if not load_cases:
        raise InputError(f"no loaded state with measured positions in {', '.join(e.name for e in experiments)}")
    known = known_materials or _first_material(experiments)
    parameters = initial_parameters(specimens, used, known)
    begin = dict(start or {}) or _start_from_equilibrium_gap(experiments, known, used)
    finding = search or MatchingSettings()
    coarse = None
    if not warm_starts:
        coarse = coarse_search(load_cases, parameters, measured, finding, start=begin, progress=progress, checkpoint=checkpoint)
        if coarse is not None and coarse.match.status is Status.INTERRUPTED:
            return Calibration(coarse.load_cases, coarse.match, chosen, measured, known, parameters)
        if coarse is not None:
            begin, warm_starts = coarse.match.parameters.values(), coarse.warm_starts
    match = Matcher(load_cases, parameters, finding).run(progress=progress, checkpoint=checkpoint, start=begin, warm_starts=warm_starts)
    estimated = with_mesh_error and match.status is not Status.INTERRUPTED
    solved = None if coarse is None else coarse.solutions
    mesh = mesh_error(load_cases, match, parameters, solved, progress) if estimated else None
    return Calibration(load_cases, match, chosen, measured, known, parameters, mesh)


def _first_material(experiments: Sequence[Experiment]) -> KnownMaterials:
    return KnownMaterials({experiments[0].materials[0]: REFERENCE_MODULUS_KPA}, scale_is_absolute=False)


def _start_from_equilibrium_gap(
    experiments: Sequence[Experiment], known_materials: KnownMaterials, states: Mapping[str, Sequence[str]]
) -> dict[str, float]:
    """Young's moduli, by parameter, from the equilibrium gap between markers, where they are plausible."""
    try:
        found = equilibrium_gap(experiments, known_materials, states)
    except (InputError, np.linalg.LinAlgError):
        return {}
    reference = float(np.mean(list(known_materials.young_moduli.values())))
    low, high = TRUSTED_RATIO
    return {young_modulus(name): e for name, (e, _) in found.items() if low < e / reference < high}


def initial_parameters(specimens: Sequence[Specimen], states: Mapping[str, Sequence[str]], known_materials: KnownMaterials) -> ParameterSet:
    """Return all parameters of the load cases with their starting values and priors.

    Raises
    ------
    InputError
        A known material that no experiment contains.
    """
    found: dict[str, Parameter] = {}
    materials = [m for s in specimens for m in s.experiment.materials]
    for name in known_materials.young_moduli:
        if name not in materials:
            raise InputError(f"known material {name!r} is in none of the experiments; they contain {', '.join(sorted(set(materials)))}")
    reference = float(np.mean(list(known_materials.young_moduli.values()) or [REFERENCE_MODULUS_KPA]))
    for p in _batch_parameters([layer for s in specimens for layer in s.experiment.layers if layer.batch], known_materials):
        found[p.name] = p
    for s in specimens:
        for p in _material_parameters(s, known_materials, reference) + _friction_parameters(s):
            if p.name not in found or (found[p.name].fixed and not p.fixed):  # free wherever one experiment determines it
                found[p.name] = p
        offset = base_offset(s.experiment)
        found.setdefault(offset, Parameter(offset, 0.0, "mm", prior_sd=GUESSED_BASE_SD_MM if s.has_unknown_base else BASE_SD_MM))
        if s.settings.pixel_scale == "sought":
            found.setdefault(name := pixel_scale(s.experiment), Parameter(name, s.experiment.xy_scale, "", prior_sd=PIXEL_SCALE_SD))
        if s.has_unknown_base:
            below, height = straight_base(s.experiment), s.experiment.height_mm
            stated = s.experiment.shape.straight_base_mm
            value = 0.1 * height if stated is None else stated
            found.setdefault(below, Parameter(below, value, "mm", prior_sd=0.4 * height, fixed=stated is not None))
        for name in s.shift_names:
            found.setdefault(name, Parameter(name, 0.0, "mm", prior_sd=1.0))
        for state in states[s.experiment.name]:
            for p in state_parameters(s.experiment, s.experiment.state(state)):
                found[p.name] = p
    return ParameterSet.of(found.values())


def _material_parameters(s: Specimen, known_materials: KnownMaterials, reference: float) -> list[Parameter]:
    out = []
    weighed = _is_weighed(s, known_materials)
    for m in s.experiment.materials:
        given = known_materials.young_moduli.get(m)
        # without a known material in the body its modulus does not follow from displacements: one body of one material has no scale
        alone = len(s.experiment.materials) == 1 and given is None
        fixed, sd = (given is not None or alone) and not weighed, WEIGHED_SD if weighed else 2.0
        out.append(Parameter(young_modulus(m), given or reference, "kPa", "log", prior_sd=sd, fixed=fixed))
        out.append(Parameter(poisson_ratio(m), START_POISSON_RATIO, "", "incompressibility", prior_sd=1.0))
        out += [Parameter(shape_parameter(m, k), 0.0, "", prior_sd=SHAPE_SD[k]) for k in SHAPE_NAMES.get(s.settings.law, ())]
    return out


def _is_weighed(s: Specimen, known_materials: KnownMaterials) -> bool:
    """Whether the modulus is sought from the weight: between side plates nothing else holds an object on its table.

    The unknown height of an object makes up for that of its modulus, so that by default the height must be known.
    """
    if s.experiment.loading.kind != "side_plates" or (known_materials.young_moduli and known_materials.scale_is_absolute):
        return False
    known_height = not s.has_unknown_base or s.experiment.shape.straight_base_mm is not None
    return s.settings.modulus == "weighed" or (s.settings.modulus == "automatic" and known_height)


def _batch_parameters(layers: Sequence[Layer], known_materials: KnownMaterials) -> list[Parameter]:
    """Stiffness of every batch relative to the one from which the known material's modulus is taken, the topmost that holds some."""
    order = [layer.batch for layer in layers if layer.material in known_materials.young_moduli][::-1] + [layer.batch for layer in layers]
    return [
        Parameter(batch_stiffness(batch), 1.0, "", "log", prior_sd=BATCH_SD, fixed=number == 0)
        for number, batch in enumerate(dict.fromkeys(order))
    ]


def _friction_parameters(s: Specimen) -> list[Parameter]:
    """Friction of the layers that touch the base and the indenter, and of joints that may slide."""
    out = []
    experiment, model = s.experiment, s.settings
    if model.contact != "stick":
        value, unit = (START_FRICTION, "") if model.contact == "coulomb" else (START_SPRING, "kPa/mm")
        loading = experiment.loading
        touching = [(experiment.layers[0].material, loading.base_material), (experiment.layers[-1].material, loading.counter_material)]
        if loading.kind == "side_plates":
            touching += [(layer.material, loading.counter_material) for layer in experiment.layers]
        # an object that only its weight holds down does not feel the table's friction; a large one would jam it
        loose = [(m, loading.base_material) for m, _ in touching] if loading.kind == "side_plates" else []
        for pair in dict.fromkeys(touching):
            out.append(Parameter(friction(*pair), value, unit, "log", prior_sd=1.0, fixed=pair in loose))
    if model.joined == "sliding":
        out += [Parameter(joint_friction(experiment, h), 0.5, "", "log", prior_sd=1.0) for h in experiment.joined_at_mm]
    return out
