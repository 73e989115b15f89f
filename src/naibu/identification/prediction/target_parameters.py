"""Parameters of a state to predict: those of the model, and for what it does not know those most like them, with wide priors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, State
from naibu.core.parameters import Parameter, ParameterSet
from naibu.identification.from_markers.calibration import REFERENCE_MODULUS_KPA, START_FRICTION, START_SPRING, initial_parameters
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.specimen.specimen_model import Specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel

UNKNOWN_SD = {"tilt": 0.007, "tilt_x": 0.007, "tilt_y": 0.007, "bar_offset": 0.5, "bar_yaw": 0.01, "base_offset": 0.5, "friction": 0.5}
# of ln(stiffness) of a batch relative to another: samples of the gels of Hirai et al. (2008), Table 3.4, have a pooled SD of 0.22 with 4
# degrees of freedom; the difference of two has sqrt(2) times that, and 95 % of Student's t lie within 2.78 rather than 1.96 of it
BATCH_SD = 0.44


def target_parameters(model: CalibratedModel, body: Specimen, state: State, notes: list[str]) -> ParameterSet:
    """Take parameters from the model; where it has none, from its nearest relatives, with a wide prior, and say so."""
    experiment = body.experiment
    own = set(experiment.materials)
    known = {m: e for m, e in model.known_materials.young_moduli.items() if m in own}
    wanted = initial_parameters([body], {experiment.name: [state.name]}, KnownMaterials(known, model.known_materials.scale_is_absolute))
    have = {p.name: p for p in model.parameters}
    out = []
    for p in wanted:
        if p.name in have:
            sd = model.standard_deviation(p.name)
            out.append(Parameter(p.name, have[p.name].value, p.unit, p.scale, prior_sd=sd or np.inf, fixed=sd == 0.0))
        else:
            out.append(_relative(p, model, experiment, notes))
    return ParameterSet.of(out)


def _relative(p: Parameter, model: CalibratedModel, experiment: Experiment, notes: list[str]) -> Parameter:
    """A parameter that the model does not have, from those most like it."""
    subject, _, kind = p.name.partition(": ")
    similar = [q for q in model.parameters if q.name.endswith(f": {kind}")]
    if kind == "young_modulus":
        if len(experiment.materials) > 1:
            raise InputError(
                f"the model does not know {subject!r}; it knows {_materials(model)}. Identify it with an experiment that contains it"
            )
        return Parameter(p.name, REFERENCE_MODULUS_KPA, p.unit, p.scale, fixed=True)
    if kind == "friction":
        body = subject.rpartition(" on ")[2]
        material = subject.rpartition(" on ")[0]
        same = (
            [q for q in similar if f" on {body}:" in q.name]  # two gels on one table rub more alike than one gel on two bodies
            or [q for q in similar if q.name.startswith(f"{material} on ")]
            or similar
        )
        default = START_FRICTION if model.settings.contact == "coulomb" else START_SPRING
        value = float(np.exp(np.mean([np.log(q.value) for q in same]))) if same else default
        notes.append(f"friction of {subject} was not identified; {value:.2f} is taken from {_subjects(same) or 'nothing'}")
        return Parameter(p.name, value, p.unit, p.scale, prior_sd=UNKNOWN_SD["friction"])
    if kind in ("poisson_ratio", "c01_fraction", "c20_ratio", "c30_ratio"):
        if not similar:
            return p
        notes.append(f"{kind} of {subject} was not identified; the mean of the model's materials is taken")
        centre = float(np.mean([q.inner(q.value) for q in similar]))
        return Parameter(p.name, p.physical(centre), p.unit, p.scale, prior_sd=0.5 if p.scale == "incompressibility" else 0.1)
    if kind == "stiffness":
        notes.append(f"the relative stiffness of {subject} was not identified; it is taken to be that of the other batches")
        return Parameter(p.name, 1.0, p.unit, p.scale, prior_sd=BATCH_SD)
    sisters = [q for q in similar if q.name.split("/")[0] == experiment.name]
    if kind.startswith("shift_of_layer") and similar:
        sisters = similar
        notes.append(f"{kind.replace('_', ' ')} mm is that of {_subjects(similar)}, whose layers have the same nominal height")
    if sisters and kind not in ("height", "width"):
        here, there = UNKNOWN_SD.get(kind, p.prior_sd), float(np.mean([model.standard_deviation(q.name) for q in sisters]))
        return Parameter(p.name, float(np.mean([q.value for q in sisters])), p.unit, p.scale, prior_sd=float(np.hypot(here, there)))
    return Parameter(p.name, p.value, p.unit, p.scale, prior_sd=UNKNOWN_SD.get(kind, p.prior_sd))


def _subjects(parameters: Sequence[Parameter]) -> str:
    return ", ".join(p.name.partition(":")[0] for p in parameters)


def _materials(model: CalibratedModel) -> str:
    return ", ".join(p.name.partition(":")[0] for p in model.parameters if p.name.endswith(": young_modulus"))
