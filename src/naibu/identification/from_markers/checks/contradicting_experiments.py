"""Experiments of the same materials against each other: whether every one of them alone asks for about the same moduli.

A joint identification finds one compromise, whatever the experiments say, and what it leaves looks like a misfit of the model. What tells
is the estimate from every experiment alone: first one Gauss-Newton step from the joint optimum on its own residuals, with the parameters of
its own, and friction, free; then, where such estimates differ, a search of its own, since a long step overshoots. The estimates share no
data, so that their differences are judged by the sum of their covariances, as the heterogeneity of studies is by the statistic of
:cite:t:`cochran1954`. About the joint estimate every shared parameter keeps the width of its prior: of what an experiment does not tell, it
asks for nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.progress import Progress
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.checks.marker_checks import Doubt
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import LoadCaseFit
from naibu.identification.from_markers.specimen.parameter_names import is_of_material
from naibu.identification.joint_estimate import NormalEstimate, joint_estimate

UNLIKELY = 1e-3  # probability of so large differences by chance, below which experiments contradict each other
APART = 3.0  # standard deviations between two estimates of one parameter that is named
# difference from which on it matters: of the logarithm of a stiffness, of a Poisson's ratio, of another parameter of a law
FACTOR, POISSON, SHAPE = 0.25, 0.02, 0.3
ADVICE = "question the law, identify them one by one, or state a batch where they are of other castings"
REPEATED = 4  # times that robust weights and the scale of the noise are set anew


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction:
    """Two experiments that ask for different values of one parameter.

    Attributes
    ----------
    parameter : Parameter
        The one whose values differ most, by their standard deviations.
    experiments : tuple of str
        The two.
    values : tuple of float
        What either alone asks for, physical.
    probability : float
        Of so large differences of all parameters and experiments by chance.
    """

    parameter: Parameter
    experiments: tuple[str, str]
    values: tuple[float, float]
    probability: float

    def in_words(self, known: KnownMaterials | None = None) -> str:
        """Return it in a sentence without a stop, with values by what is `known` of the scale; without them where nothing is given."""
        p, (a, b), (one, other) = self.parameter, self.experiments, self.values
        begin = f"experiments contradict each other: {a} alone asks for"
        if known is None:
            return f"{begin} a {'lower' if one < other else 'higher'} {p.name} than {b}"
        scale, unit = 1.0, p.unit
        if unit == "kPa" and not known.scale_is_absolute and known.young_moduli:
            reference, scale = next(iter(known.young_moduli.items()))
            unit = f"times that of {reference}"
        digits, end = 3 if p.scale == "incompressibility" else 2, f" {unit}".rstrip()
        first, second = (f"{float(f'{value / scale:.{digits}g}'):g}{end}" for value in (one, other))
        return f"{begin} {p.name} of about {first}, {b} alone for about {second}"


def contradicted_experiments(calibration: Calibration, progress: Progress | None = None) -> tuple[Doubt, ...]:
    """Doubt experiments that ask for different values of what they share; gravely, since the compromise is that of none.

    Nothing is solved unless the first-order estimates contradict each other. Then the two experiments that differ most are identified each
    by itself, from the joint optimum: `progress` gets reports of the stages "EXPERIMENT alone".
    """
    if calibration.match.status is Status.INTERRUPTED:
        return ()
    c, cases = _about_joint(calibration), _by_experiment(calibration)
    parameters = c.match.parameters.free
    first = contradiction(told_alone(c), parameters)
    if first is None:
        return ()
    try:
        found = contradiction({name: _identified_alone(c, name, cases[name], progress) for name in first.experiments}, parameters)
    except (ConvergenceError, InputError):
        return (Doubt(f"{first.in_words()}; {ADVICE}", grave=True),)
    return () if found is None else (Doubt(f"{found.in_words(c.known_materials)}; {ADVICE}", grave=True),)


def contradiction(told: Mapping[str, NormalEstimate], parameters: Sequence[Parameter]) -> Contradiction | None:
    """Return the worst contradiction of experiments; None where what they tell may well be the same, or hardly differs.

    Parameters
    ----------
    told : mapping of str to NormalEstimate
        What every experiment alone tells, on the optimiser's scale, by its name.
    parameters : sequence of Parameter
        All that are named there.
    """
    named = [name for e in told.values() for name in e.names]
    if len(set(named)) == len(named):
        return None
    together = joint_estimate(list(told.values()))
    probability = float(chdtrc(together.degrees_of_freedom, together.chi_squared)) if together.degrees_of_freedom else 1.0
    if probability >= UNLIKELY:
        return None
    worst, farthest = None, APART
    for p in parameters:
        for (a, one), (b, other) in combinations(told.items(), 2):
            if p.name not in one.names or p.name not in other.names:
                continue
            apart = abs(one.value(p.name) - other.value(p.name)) / np.hypot(
                one.standard_deviation(p.name), other.standard_deviation(p.name)
            )
            values = p.physical(one.value(p.name)), p.physical(other.value(p.name))
            if apart > farthest and _matters(p, *values):
                worst, farthest = Contradiction(p, (a, b), values, probability), float(apart)
    return worst


def _matters(p: Parameter, one: float, other: float) -> bool:
    if p.scale == "log":
        return bool(abs(np.log(one / other)) > FACTOR)
    return abs(one - other) > (POISSON if p.scale == "incompressibility" else SHAPE)


def told_alone(calibration: Calibration) -> dict[str, NormalEstimate]:
    """Return what every experiment alone tells of the materials, on the optimiser's scale, by its name; nothing is solved anew.

    Covariances are as wide as those of a calibration: they count in the misfit that is left, and what the elements do.
    """
    cases, about = _by_experiment(calibration), _about_joint(calibration)
    return {name: _linearised(about, chosen) for name, chosen in cases.items()} if len(cases) > 1 else {}


def _by_experiment(calibration: Calibration) -> dict[str, list[int]]:
    cases: dict[str, list[int]] = {}
    for i, load_case in enumerate(calibration.load_cases):
        cases.setdefault(load_case.specimen.experiment.name, []).append(i)
    return cases


def _about_joint(calibration: Calibration) -> Calibration:
    """Put the priors of the materials about the estimates: what an experiment does not tell does not differ from them."""
    found = {p.name: p.value for p in calibration.match.parameters.free if is_of_material(p.name)}
    return replace(calibration, priors=calibration.priors.with_values(found))


def _identified_alone(calibration: Calibration, name: str, chosen: Sequence[int], progress: Progress | None) -> NormalEstimate:
    """Return what the load cases of one experiment tell where its own search ends."""
    values, mesh = calibration.match.parameters.values(), calibration.mesh
    load_cases, fits = [calibration.load_cases[i] for i in chosen], [calibration.match.fits[i] for i in chosen]
    idle = [not any(f.jacobian[:, :, k].any() for f in fits) for k in range(len(calibration.match.parameters.free))]
    others = {p.name: values[p.name] for p, unknown in zip(calibration.match.parameters.free, idle, strict=True) if unknown}
    priors = calibration.priors.with_values(others, fixed=True)
    told = None if progress is None else lambda report: progress(replace(report, stage=f"{name} alone"))
    match = Matcher(load_cases, priors).run(progress=told, start=values, warm_starts=calibration.warm_starts)
    own = None if mesh is None else replace(mesh, moved=tuple(mesh.moved[i] for i in chosen))
    alone = replace(calibration, load_cases=tuple(load_cases), match=match, priors=priors, mesh=own)
    return _linearised(alone, range(len(load_cases)))


def _linearised(calibration: Calibration, chosen: Sequence[int]) -> NormalEstimate:
    """Return what some load cases tell, linearised at the fits, with robust weights at what they leave themselves."""
    found = calibration.match.parameters
    load_cases, fits = [calibration.load_cases[i] for i in chosen], [calibration.match.fits[i] for i in chosen]
    freed = ParameterSet.of(replace(p, prior_sd=np.inf) for p in found)
    matcher, inner, p = Matcher(load_cases, freed), freed.start(), len(freed.free)
    shared = np.array([is_of_material(q.name) for q in freed.free])
    sd = np.array([q.prior_sd for q in calibration.priors.free])
    slope = np.array([q.slope(q.value) for q in freed.free])
    data = matcher.normal_equations(fits, inner).data
    kept = np.flatnonzero(np.diag(data) > 0.0)  # what these load cases do not know is nothing to solve for
    prior = np.concatenate([sd**-2.0, np.zeros(6 * len(fits))])[kept]
    pulled = np.concatenate([calibration.priors.start() - inner, np.zeros(6 * len(fits))])[kept]
    step, count, variance = np.zeros(len(data)), sum(t.n_data for t in load_cases), 1.0
    for _ in range(REPEATED):
        equations = matcher.normal_equations(_moved(fits, slope, step), inner)
        data = equations.data[np.ix_(kept, kept)] / variance
        hessian = data + np.diag(prior)
        change = np.linalg.solve(hessian, equations.gradient[kept] / variance + prior * (pulled - step[kept]))
        step[kept] += change
        chi_squared = sum(float(np.nansum((f.residual / f.sd) ** 2)) for f in _moved(fits, slope, step))
        variance = max(1.0, chi_squared / max(count - float(np.trace(np.linalg.solve(hessian, data))), 1.0))
    covariance: FloatArray = np.linalg.inv(hessian).astype(np.float64)
    if calibration.mesh is not None:
        moved = [replace(f, residual=f.residual - calibration.mesh.moved[i]) for i, f in zip(chosen, fits, strict=True)]
        pull = matcher.normal_equations(moved, inner).gradient - matcher.normal_equations(fits, inner).gradient
        elements = covariance @ pull[kept] / variance
        covariance += np.outer(elements, elements)
    told = np.array([i for i, k in enumerate(kept) if k < p and shared[k]], dtype=np.int64)
    at = kept[told]
    return NormalEstimate(tuple(freed.free[k].name for k in at), inner[at] + step[at], covariance[np.ix_(told, told)])


def _moved(fits: Sequence[LoadCaseFit], slope: FloatArray, step: FloatArray) -> list[LoadCaseFit]:
    """Return fits as they were after a step of parameters and poses, to first order."""
    p = len(slope)
    return [
        replace(f, residual=f.residual - f.jacobian @ (slope * step[:p]) - f.pose_jacobian @ step[p + 6 * t : p + 6 * t + 6])
        for t, f in enumerate(fits)
    ]
