"""Verdict on an identification: whether the model explains the markers, in part, or not.

A search that converged has found a minimum, which says nothing about how low it is. The verdict weighs what tells data apart that the model
cannot explain: the residuals in units of the noise, how much of the deformation they leave unexplained, whether an affine map does as well,
the part of the residuals that neighbours share (noise is not shared), over a state and somewhere in it, estimates far from what was known
beforehand, heights of indenters and layers that contradict the stated ones, experiments that contradict each other, and markers that ask
for another law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.parameters import ParameterSet
from naibu.core.progress import Progress
from naibu.core.rigid_transform import registration
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.checks.assumed_law import contradicted_law, hangs_on_law
from naibu.identification.from_markers.checks.contradicting_experiments import contradicted_experiments
from naibu.identification.from_markers.checks.layer_heights import LAYER, contradicted_layers
from naibu.identification.from_markers.checks.local_residuals import LocalResidual, largest_local_residual
from naibu.identification.from_markers.checks.marker_checks import Doubt, robust_affine
from naibu.identification.from_markers.checks.marker_outliers import Outlier
from naibu.identification.from_markers.law_uncertainty import LawUncertainty, law_uncertainty
from naibu.identification.from_markers.mesh_error import RATIO, STIFFNESSES
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase
from naibu.identification.from_markers.specimen.parameter_names import platen_position
from naibu.identification.verdict import NEIGHBOURS, Explanation, Verdict, shared_part

NOISE_EXPLAINED = 2.0  # residuals below this many times the stated noise need no explanation
NOISE_OVERSTATED = 0.5
UNEXPLAINED = 0.4  # of the deformation left by a model that does not explain it
NO_GAIN, WORSE = 0.95, 1.5  # residual over that of an affine map: nothing is gained; something is wrong even within the noise
SHARED, SHARED_NOISE = 0.1, 1.5  # the part of the residual that neighbours share, over the deformation and over the noise
# mean residual of a marker and its neighbours over its noise: worth a note, a flaw (of 375 means of noise alone, one set in 20 exceeds 3.7)
LOCAL_NOTE, LOCAL_FLAW = 5.0, 8.0
OFF_PRIOR, FAR_PRIOR, VERY_FAR_PRIOR = 3.0, 5.0, 10.0  # standard deviations of a prior: worth a note, a flaw, a grave one
# difference of found and stated height over the stated compression: worth a note, a flaw, a grave one; and at least so many times the noise
OFF_HEIGHT, FAR_HEIGHT, VERY_FAR_HEIGHT, HEIGHT_NOISE = 0.15, 0.5, 1.5, 3.0
WHITE = 0.3  # shared part of a residual that is like noise
MANY = 0.04  # of the markers left out, which is no longer a few
LISTED = 8  # outliers that get a sentence each
COARSE, COARSE_SD = 0.15, 2.0  # change of a modulus on smaller elements: of its logarithm, and in standard deviations
FEWEST = 4  # markers of a zone that is named


@dataclass(frozen=True, slots=True, eq=False)
class CaseEvidence:
    """What a verdict needs to know about one loaded state.

    Attributes
    ----------
    name : str
        ``experiment/state``.
    points : ndarray, shape (k, 3)
        Markers in the object's frame, mm.
    residual : ndarray, shape (k, 3)
        Measured minus predicted, mm, complete.
    sd : ndarray, shape (k, 3)
        Its standard deviation from noise alone, mm.
    rigid_mm, affine_mm : float
        Root mean square distance of the measured markers from the best rigid and affine images of the reference configuration; the latter
        per degree of freedom, since it has twelve parameters.
    full_mm : float
        Height or width at which the indenter touches the undeformed object.
    expected_mm, found_mm : float or None
        Stated or estimated height or width in this state, None where the file has none; and the identified one.
    """

    name: str
    points: FloatArray
    residual: FloatArray
    sd: FloatArray
    rigid_mm: float
    affine_mm: float
    full_mm: float
    expected_mm: float | None
    found_mm: float

    @property
    def rms_mm(self) -> float:
        """Root mean square residual (3-D), mm."""
        return _rms(self.residual)

    @property
    def noise_mm(self) -> float:
        """What noise alone would leave, mm."""
        return _rms(self.sd)

    @property
    def noise_factor(self) -> float:
        """Root mean square residual in units of the noise."""
        return float(np.sqrt(((self.residual / self.sd) ** 2).mean())) if len(self.residual) else 0.0

    @property
    def height_change(self) -> float:
        """Distance of the found height or width from the stated one over the stated compression; zero where none is stated."""
        if self.expected_mm is None:
            return 0.0
        return abs(self.found_mm - self.expected_mm) / max(self.full_mm - self.expected_mm, 0.05 * self.full_mm)

    @property
    def shared_mm(self) -> float:
        """Root mean square of the part of the residual that neighbouring markers share, mm: noise has no such part."""
        if len(self.points) <= NEIGHBOURS:
            return 0.0
        return float(np.sqrt(max(shared_part([(self.points, self.residual)]).square, 0.0)))

    @property
    def local(self) -> LocalResidual | None:
        """Where neighbouring markers are off together most clearly; None where there are too few."""
        return largest_local_residual(self.points, self.residual, self.sd, NEIGHBOURS)


@dataclass(frozen=True, slots=True)
class _Flaw:
    text: str
    grave: bool = False


def verdict_of(
    calibration: Calibration,
    doubts: Sequence[Doubt] = (),
    outliers: Sequence[Outlier] = (),
    progress: Progress | None = None,
    law: LawUncertainty | None = None,
) -> Verdict:
    """Return the verdict on a calibration.

    Parameters
    ----------
    calibration : Calibration
        The finished search.
    doubts : sequence of Doubt
        From `naibu.identification.from_markers.checks.marker_checks.check_markers`.
    outliers : sequence of Outlier
        Markers that were left out.
    progress : callable, optional
        Gets reports where experiments seem to contradict each other, and are identified each by itself.
    law : LawUncertainty, optional
        What the estimates owe to the law, where it is known already.
    """
    match = calibration.match
    values = match.parameters.values()
    cases = [_evidence(t, f, values) for t, f in zip(calibration.load_cases, match.fits, strict=True)]
    of_law = law or law_uncertainty(calibration)
    against = contradicted_law(calibration, of_law)
    apart, coarse = contradicted_experiments(calibration, progress), coarse_elements(calibration)
    doubts = (*apart, *against, *doubts, *coarse, *contradicted_layers(calibration))
    deviations = prior_deviations(match.parameters, calibration.priors)
    others = {name: d for name, d in deviations.items() if LAYER not in name}
    judged = verdict(cases, others, match.noise_factor, match.status, doubts, outliers)
    hangs = hangs_on_law(calibration, of_law)
    if against or not hangs:
        return judged
    if judged.explanation is Explanation.EXPLAINED:
        return replace(judged, limits=hangs)
    return replace(judged, notes=(*judged.notes, f"{hangs[0].upper()}{hangs[1:]}."))


def coarse_elements(calibration: Calibration) -> tuple[Doubt, ...]:
    """Doubt moduli that smaller elements would change by much, and by much more than noise."""
    match, mesh = calibration.match, calibration.mesh
    if mesh is None:
        return ()
    sd = np.sqrt(np.diag(match.covariance))
    relative = np.array([abs(s) if p.name.endswith(STIFFNESSES) else 0.0 for p, s in zip(match.parameters.free, mesh.step, strict=True)])
    worst = int(np.argmax(relative)) if len(relative) else 0
    if not len(relative) or relative[worst] < max(COARSE, COARSE_SD * sd[worst]):
        return ()
    p = match.parameters.free[worst]
    finer = p.physical(p.inner(p.value) + mesh.step[worst])
    text = (
        f"elements of {mesh.element_size_mm:.3g} mm are too coarse: on smaller ones {p.name} would be about {finer:.3g} rather than "
        f"{p.value:.3g} {p.unit}".rstrip()
    )
    return (Doubt(f"{text}; identify with an element_size_mm of {mesh.element_size_mm / RATIO:.2g} or less"),)


def prior_deviations(found: ParameterSet, priors: ParameterSet) -> dict[str, float]:
    """Return how many standard deviations of its prior every free parameter lies from the prior's centre."""
    centres = {p.name: p for p in priors}
    return {
        p.name: (p.inner(p.value) - p.inner(centres[p.name].value)) / p.prior_sd
        for p in found.free
        if np.isfinite(p.prior_sd) and p.name in centres
    }


def verdict(
    cases: Sequence[CaseEvidence],
    deviations: dict[str, float],
    noise_factor: float,
    status: Status,
    doubts: Sequence[Doubt] = (),
    outliers: Sequence[Outlier] = (),
) -> Verdict:
    """Weigh the evidence.

    Parameters
    ----------
    cases : sequence of CaseEvidence
        One for each loaded state.
    deviations : dict of str to float
        Of the estimates from the centres of their priors, in standard deviations of these, by parameter.
    noise_factor : float
        Root mean square residual of all states in units of the stated noise.
    status : Status
        How the search ended.
    doubts, outliers : sequence
        Found before the search.
    """
    flaws = [_Flaw(d.text, d.grave) for d in doubts]
    for case in cases:
        left_out = sum(f"{o.experiment}/{o.state}" == case.name for o in outliers)
        if left_out > MANY * (len(case.points) + left_out):
            flaws.append(_Flaw(f"{left_out} markers of {case.name} were left out as outliers"))
        flaws += _fit_flaws(case) + _height_flaws(case)
    heights = tuple(f"{c.name}: " for c in cases if c.expected_mm is not None)
    counted = {n: d for n, d in deviations.items() if not (n.startswith(heights) and n.endswith((": height", ": width")))}
    for name, d in counted.items():
        if abs(d) > FAR_PRIOR:
            text = f"{name} lies {abs(d):.0f} standard deviations from what was known of it beforehand"
            flaws.append(_Flaw(text, abs(d) > VERY_FAR_PRIOR))
    if not status.ok:
        ended = "the search was interrupted" if status is Status.INTERRUPTED else "the search did not converge"
        flaws.append(_Flaw(ended))
    flaws.sort(key=lambda f: not f.grave)
    explanation = Explanation.IN_PART if flaws else Explanation.EXPLAINED
    if any(f.grave for f in flaws):
        explanation = Explanation.NOT_EXPLAINED
    left = float(np.sqrt(sum(c.rms_mm**2 for c in cases) / max(sum(c.rigid_mm**2 for c in cases), 1e-12)))
    shared = shared_part([(c.points, c.residual) for c in cases]).correlation
    return Verdict(
        explanation, tuple(f.text for f in flaws), _lead(cases, noise_factor, left), noise_factor, left, shared,
        _notes(cases, noise_factor, counted), _left_out(outliers, cases),
    )  # fmt: skip


def _fit_flaws(c: CaseEvidence) -> list[_Flaw]:
    """Compare the residual with the noise, with the deformation and with an affine map; say where it is largest."""
    if not len(c.residual):
        return [_Flaw(f"no marker of {c.name} was measured completely in both states", grave=True)]
    left, share = c.rms_mm / max(c.rigid_mm, 1e-9), c.shared_mm / max(c.rigid_mm, 1e-9)
    if c.noise_factor > NOISE_EXPLAINED:
        white = c.shared_mm < WHITE * c.rms_mm
        cause = " (which neighbours do not share: labels or positions are uncertain)" if white else ""
        figures = f"{c.name} is left with {c.rms_mm:.2g} mm RMS{cause}, {c.noise_factor:.1f} times the noise"
        if left > UNEXPLAINED:
            return [_Flaw(f"{figures} and {100 * left:.0f} % of its deformation", grave=True)]
        if c.rms_mm > NO_GAIN * c.affine_mm and not white:
            return [_Flaw(f"{figures}, no less than an affine map leaves ({c.affine_mm:.2g} mm)", grave=True)]
        return [_Flaw(f"{figures}, most {_worst_zone(c)}")]
    if c.rms_mm > WORSE * c.affine_mm:
        return [_Flaw(f"{c.name} is left with {c.rms_mm:.2g} mm RMS, although an affine map leaves only {c.affine_mm:.2g} mm")]
    if share > SHARED or c.shared_mm > SHARED_NOISE * c.noise_mm:
        text = f"neighbouring markers of {c.name} share residuals of {c.shared_mm:.2g} mm, {100 * share:.0f} % of the deformation"
        return [_Flaw(f"{text}, most {_worst_zone(c)}", share > UNEXPLAINED)]
    if (local := c.local) is not None and local.times_noise > LOCAL_FLAW:
        return [_Flaw(_off_together(c, local))]
    return []


def _off_together(c: CaseEvidence, local: LocalResidual) -> str:
    """Say where neighbouring markers are off together, and what may be the cause."""
    at = ", ".join(f"{v:.0f}" for v in local.point)
    return (
        f"markers of {c.name} around ({at}) mm are off by {abs(local.mean_mm):.2g} mm along {'xyz'[local.axis]} together, "
        f"{local.times_noise:.0f} times what noise explains: the model may lack something there, such as an inclusion, a void, a crack "
        "or a contact"
    )


def _height_flaws(c: CaseEvidence) -> list[_Flaw]:
    """Compare the found height with the stated one."""
    change = c.height_change
    if change < FAR_HEIGHT:
        return []
    return [_Flaw(f"{c.name} is stated at {c.expected_mm:g} mm but found at {c.found_mm:.1f} mm", change > VERY_FAR_HEIGHT)]


def _worst_zone(c: CaseEvidence) -> str:
    """Name the zone of the object with the largest residual in units of the noise."""
    squared = (c.residual / c.sd) ** 2
    low, high = c.points.min(axis=0), c.points.max(axis=0)
    band = 0.2 * np.maximum(high - low, 1e-9)
    names = (("on its low-x side", "on its high-x side"), ("on its low-y side", "on its high-y side"), ("near its base", "near its top"))
    zones: dict[str, BoolArray] = {}
    for axis in range(3):
        zones[names[axis][0]] = c.points[:, axis] < low[axis] + band[axis]
        zones[names[axis][1]] = c.points[:, axis] > high[axis] - band[axis]
    zones["in its middle"] = ~np.any(list(zones.values()), axis=0)
    size = {name: float(np.sqrt(squared[zone].mean())) for name, zone in zones.items() if zone.sum() >= FEWEST}
    if not size:
        return "everywhere"
    name = max(size, key=lambda key: size[key])
    axis = int(np.argmax(squared[zones[name]].mean(axis=0)))
    return f"{name} along {'xyz'[axis]} ({_rms(c.residual[zones[name]][:, axis : axis + 1]):.2g} mm)"


def _notes(cases: Sequence[CaseEvidence], noise_factor: float, deviations: dict[str, float]) -> tuple[str, ...]:
    notes = [
        f"{name} lies {abs(d):.1f} standard deviations from what was known of it beforehand: it may make up for something that the model "
        "does not describe."
        for name, d in deviations.items()
        if OFF_PRIOR < abs(d) <= FAR_PRIOR
    ]
    if noise_factor < NOISE_OVERSTATED:
        notes.append(
            f"Residuals are {noise_factor:.2g} times the stated noise, which is thus overstated about "
            f"{1.0 / max(noise_factor, 1e-3):.0f}-fold; the intervals follow the stated noise and are wider than the data need."
        )
    for c in cases:
        off = c.expected_mm is not None and abs(c.found_mm - c.expected_mm) > HEIGHT_NOISE * c.noise_mm
        if off and OFF_HEIGHT < c.height_change < FAR_HEIGHT:
            notes.append(
                f"{c.name} is stated at {c.expected_mm:g} mm, but the markers put it at {c.found_mm:.1f} mm: check how it was measured, "
                "since predictions at positions that were measured alike are off by as much."
            )
        if (local := c.local) is not None and LOCAL_NOTE < local.times_noise <= LOCAL_FLAW and c.noise_factor < NOISE_EXPLAINED:
            text = _off_together(c, local)
            notes.append(f"{text[0].upper()}{text[1:]}.")
        if len(c.residual) and c.noise_factor < NOISE_EXPLAINED and c.rms_mm > 0.9 * c.affine_mm:
            notes.append(
                f"An affine map describes {c.name} as well ({c.affine_mm:.2g} mm against {c.rms_mm:.2g} mm): "
                "so uniform a deformation tells little about materials and friction."
            )
    return tuple(notes)


def _left_out(outliers: Sequence[Outlier], cases: Sequence[CaseEvidence]) -> tuple[str, ...]:
    """Tell where markers lie, and how good the fit is without them."""
    told = []
    for o in outliers[:LISTED]:
        own = [c.rms_mm for c in cases if c.name == f"{o.experiment}/{o.state}"]
        rms = max(own or [c.rms_mm for c in cases if c.name.startswith(f"{o.experiment}/")], default=0.0)
        off = f"{abs(o.offset_mm):.2g} mm off along {o.axis}"
        told.append(f"Marker {o.marker} of {o.experiment}/{o.state} is {off}: left out; {rms:.2g} mm RMS remain without it.")
    if rest := [f"{o.marker} of {o.experiment}/{o.state}" for o in outliers[LISTED:]]:
        told.append(f"Left out as well: markers {', '.join(rest)}.")
    return tuple(told)


def _lead(cases: Sequence[CaseEvidence], noise_factor: float, left: float) -> str:
    worst = max((c.rms_mm for c in cases), default=0.0)
    figures = f"residuals of {worst:.2g} mm RMS at most, {noise_factor:.2f} times the noise"
    return f"{figures}; {100 * (1.0 - left):.0f} % of the deformation is explained"


def _evidence(t: MarkerLoadCase, f: LoadCaseFit, values: dict[str, float]) -> CaseEvidence:
    body, state = t.specimen, t.specimen.experiment.state(t.state)
    whole = np.isfinite(f.residual).all(axis=1) & ~np.any(body.marker_filled, axis=1)
    points, measured = body.marker_points[whole], t.measured[whole]
    rigid = affine = 0.0
    if len(points) >= FEWEST:
        rigid = _rms(measured - registration(points, measured).applied(points))
        affine = _rms(measured - robust_affine(points, measured)[1]) * float(np.sqrt(len(points) / max(len(points) - 4, 1)))
    return CaseEvidence(
        t.name, points, f.residual[whole], f.sd[whole], rigid, affine, body.experiment.full_platen_position_mm,
        state.estimated_mm or state.stated_mm, values[platen_position(body.experiment, t.state)],
    )  # fmt: skip


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt((residual**2).sum(axis=1).mean())) if len(residual) else 0.0
