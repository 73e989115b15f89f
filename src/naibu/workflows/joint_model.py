"""Models of markers and of displacement fields, each with what both kinds of data tell together, and the file that holds both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.parameters import Parameter, ParameterSet
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.observations import SolvedLoadCase
from naibu.identification.from_markers.specimen.parameter_names import poisson_ratio, young_modulus
from naibu.identification.joint_estimate import JointEstimate, NormalEstimate, joint_estimate, moved_along
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.predictive_uncertainty import PredictiveUncertainty
from naibu.workflows.markers.experiments import RATIO_REFERENCE_KPA

FORMAT = "naibu joint model 1"
# mean square that joint moduli leave of markers beyond what their own leave, as a fraction of that: from which it is said, and doubted
SAID, DOUBTED = 0.2, 1.3


@dataclass(frozen=True, slots=True, eq=False)
class JointModel:
    """Moduli that experiments with markers and displacement fields tell together, in the model of each.

    Attributes
    ----------
    markers : CalibratedModel
        Predicts states of experiments.
    fields : IdentifiedBody
        Predicts displacements of the body whose fields were measured.
    doubts : tuple of str
        What speaks against using either, beside what spoke against them before.
    notes : tuple of str
        What is to be known of their predictions, in sentences.
    """

    markers: CalibratedModel
    fields: IdentifiedBody
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return both models as plain numbers and strings, for JSON."""
        return {"format": FORMAT, "markers": self.markers.to_dict(), "fields": self.fields.to_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> JointModel:
        """Return what `to_dict` wrote.

        Raises
        ------
        InputError
            Another format, or a missing or unusable entry.
        """
        parts = [data.get(kind) for kind in ("markers", "fields")]
        if data.get("format") != FORMAT or not all(isinstance(part, Mapping) for part in parts):
            raise InputError(f"this is not a naibu model of markers and displacement fields, whose format is {FORMAT!r}")
        return cls(CalibratedModel.from_dict(data["markers"]), IdentifiedBody.from_dict(data["fields"]))


def told_by_markers(model: CalibratedModel) -> NormalEstimate:
    """Return logarithms of Young's moduli, kPa or ratios, and of ``1 - 2 nu``, as experiments with markers tell them."""
    shared = _moduli(model)
    values = [_logarithm(model, p) for p in shared]
    slope = _slope_of_moduli(shared, [p.name for p in model.parameters.free])
    return NormalEstimate(tuple(p.name for p in shared), np.array(values), slope @ model.covariance @ slope.T)


def _moduli(model: CalibratedModel) -> list[Parameter]:
    """Moduli that another kind of data may tell as well: none that follows from the weight, which is in kPa where others are ratios."""
    kinds = (poisson_ratio(""),) if model.is_weighed else (young_modulus(""), poisson_ratio(""))
    return [p for p in model.parameters.free if p.name.endswith(kinds)]


def _logarithm(model: CalibratedModel, p: Parameter) -> float:
    if p.name.endswith(poisson_ratio("")):
        return float(np.log(1.0 - 2.0 * p.value))
    return float(np.log(p.value / (1.0 if model.known_materials.scale_is_absolute else RATIO_REFERENCE_KPA)))


def _slope_of_moduli(shared: Sequence[Parameter], names: Sequence[str]) -> FloatArray:
    """Return the derivatives of the logarithms of moduli (k, n) by parameters on the optimiser's scale."""
    slope = np.zeros((len(shared), len(names)))
    for row, p in zip(slope, shared, strict=True):
        row[names.index(p.name)] = -2.0 * p.slope(p.value) / (1.0 - 2.0 * p.value) if p.name.endswith(poisson_ratio("")) else 1.0
    return slope


def told_by_fields(found: FieldEstimate) -> NormalEstimate:
    """Return the same as displacement fields tell them."""
    if found.uncertainty is None:
        raise InputError("the fields have no covariance of moduli: a map cannot be joined with markers")
    young, poisson = young_and_poisson(found.theta)
    slope = _slope_of_theta(found.theta)
    lost, finite = _finite(found.uncertainty.covariance)
    covariance = slope @ finite @ slope.T
    unknown = (np.abs(slope) @ lost.astype(float)) > 0.0
    covariance[unknown, unknown] = np.inf
    names = tuple([young_modulus(n) for n in found.zones.names] + [poisson_ratio(n) for n in found.zones.names])
    return NormalEstimate(names, np.concatenate([np.log(young), np.log(1.0 - 2.0 * poisson)]), covariance)


def _slope_of_theta(theta: FloatArray) -> FloatArray:
    """Return the derivatives (2 k, 2 k) of ln E and ln(1 - 2 nu) by ln mu and ln(kappa / mu) of k zones.

    With r = kappa / mu, ln E = ln mu + ln(9 r / (3 r + 1)) and ln(1 - 2 nu) = ln(3 / (3 r + 1)).
    """
    k = len(theta) // 2
    ratio = np.exp(theta[k:])
    return np.block([[np.eye(k), np.diag(1.0 / (3.0 * ratio + 1.0))], [np.zeros((k, k)), np.diag(-3.0 * ratio / (3.0 * ratio + 1.0))]])


def _theta_of(scales: FloatArray) -> FloatArray:
    """Return ln mu and ln(kappa / mu) (2 k,) of ln E and ln(1 - 2 nu) (2 k,) of k zones."""
    young, incompressibility = scales.reshape(2, -1)
    ratio = np.exp(-incompressibility) - 1.0 / 3.0
    return np.concatenate([young + np.log((3.0 * ratio + 1.0) / (9.0 * ratio)), np.log(ratio)])


def _finite(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what data tell nothing of, and the covariance of the rest."""
    lost = np.isinf(np.diag(covariance))
    return lost, np.where(lost[:, None] | lost, 0.0, covariance)


def joint_model(
    calibration: Calibration, markers: CalibratedModel, fields: IdentifiedBody, found: FieldEstimate, joint: JointEstimate
) -> JointModel:
    """Return the models of both kinds with what both tell together.

    The estimate is joint only as far as chi squared of either kind is a quadratic about its own optimum: whether the experiments are met by
    the joint moduli as their own covariance promises is computed, and what they leave more is part of every prediction.

    Parameters
    ----------
    calibration : Calibration
        Of the experiments with markers.
    markers, fields
        As either kind of data tells them.
    found : FieldEstimate
        What `fields` was made from.
    joint : JointEstimate
        Of both.

    Raises
    ------
    ConvergenceError
        An experiment has no equilibrium with the joint moduli.
    """
    told = told_by_markers(markers)
    slope = _slope_of_moduli(_moduli(markers), [p.name for p in markers.parameters.free])
    inner, covariance = moved_along(markers.parameters.start(), markers.covariance, slope, told, joint.together)
    values = {p.name: p.physical(float(x)) for p, x in zip(markers.parameters.free, inner, strict=True)}
    parameters = markers.parameters.with_values(values)
    own, left = _misfits(calibration, parameters)
    doubts = ["markers and fields contradict each other"] if joint.contradicted else []
    more, notes = (left / own) ** 2 - 1.0, []
    if more > SAID:
        met = f"with the moduli from both, markers are met to {left:.3g} mm a coordinate, and to {own:.3g} mm with those from markers alone"
        if more > DOUBTED:
            doubts.append(f"{met}: their model or elements do not fit the moduli from fields")
        else:
            notes.append(f"{met.capitalize()}; predictions of experiments count that in, smaller elements may lessen it.")
    predictive = None if markers.predictive is None else _predictive(markers, markers.predictive, found, joint, left**2 - own**2)
    of_markers = replace(
        markers, parameters=parameters, covariance=covariance, predictive=predictive, law_covariance=None,
        reservation=_both(*doubts, markers.reservation),
    )  # fmt: skip
    assert found.uncertainty is not None  # `told_by_fields` refuses it
    of_theta, own_fields = _finite(found.uncertainty.covariance)[1], told_by_fields(found)
    # in the scales of the joint estimate, which a linear step in theta would miss
    slope = _slope_of_theta(found.theta)
    scales, spread = moved_along(own_fields.values, slope @ of_theta @ slope.T, np.eye(len(slope)), own_fields, joint.together)
    theta = _theta_of(scales)
    back = np.linalg.inv(_slope_of_theta(theta))
    reservation = _both(*doubts, fields.reservation)
    of_fields = replace(
        fields, theta=theta, covariance=None if fields.covariance is None else back @ spread @ back.T, reservation=reservation
    )
    return JointModel(of_markers, of_fields, tuple(doubts), tuple(notes))


def _misfits(calibration: Calibration, parameters: ParameterSet) -> tuple[float, float]:
    """Return root mean square residuals of a coordinate, mm, as calibrated, and with these parameters."""
    fits = calibration.match.fits
    starts = [SolvedLoadCase(fit, calibration.match.parameters) for fit in fits]
    moved = Matcher(calibration.load_cases, parameters).evaluate(parameters.values(), starts, trial=True)
    own, left = (float(np.sqrt(np.nanmean(np.concatenate([f.residual.ravel() for f in some]) ** 2))) for some in (fits, moved))
    return own, left


def _both(*texts: str) -> str:
    return "; ".join(text for text in dict.fromkeys(texts) if text)


def _predictive(
    model: CalibratedModel, predictive: PredictiveUncertainty, found: FieldEstimate, joint: JointEstimate, lack: float
) -> PredictiveUncertainty:
    """Return what is left uncertain about other load cases, with a larger mean square misfit, mm2.

    With what was taken for known, moduli from markers count for less than in the joint estimate.
    """
    shared = _moduli(model)
    slope = _slope_of_moduli(shared, list(predictive.names))
    own = NormalEstimate(
        tuple(p.name for p in shared), np.array([_logarithm(model, p) for p in shared]), slope @ predictive.covariance @ slope.T
    )
    together = joint_estimate((own, told_by_fields(found))).together
    widened = max(joint.widened, 1.0) ** 2
    told = NormalEstimate(together.names, together.values, np.asarray(together.covariance * widened, dtype=np.float64))
    _, covariance = moved_along(np.zeros(len(predictive.names)), predictive.covariance, slope, own, told)
    discrepancy = float(np.sqrt(predictive.discrepancy_mm**2 + max(lack, 0.0)))
    return replace(predictive, covariance=covariance, discrepancy_mm=discrepancy)
