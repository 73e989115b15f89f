"""Standard deviation of predicted coordinates: everything that a calibration leaves uncertain, carried to another state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.parameters import ParameterSet
from naibu.core.rigid_transform import RigidTransform
from naibu.identification.from_markers.observations import LoadCaseFit
from naibu.identification.from_markers.specimen.parameter_names import base_offset, straight_base
from naibu.identification.from_markers.specimen.specimen_model import Specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.platen_position import Gauge
from naibu.identification.prediction.predictive_uncertainty import PredictiveUncertainty

WIDTH = 1.959964  # standard deviations to either side that hold 95 %
BISECTIONS = 40


@dataclass(frozen=True, slots=True, eq=False)
class CoordinateUncertainty:
    """Standard deviations of predicted coordinates, mm, along x, y and z of the scan.

    Attributes
    ----------
    model : ndarray, shape (k, 3)
        Of the prediction: parameters, boundary conditions, law, and what the model misses.
    measured : ndarray, shape (k, 3)
        Of the difference from a measured coordinate: with the noise of both scans.
    """

    model: FloatArray
    measured: FloatArray

    def sentence(self) -> str:
        """Return what the standard deviations hold, in a sentence."""
        model, measured = (float(np.median(per_axis(sd))) for sd in (self.model, self.measured))
        return (
            f"A predicted coordinate is known to {model:.2f} mm (standard deviation per axis, median: parameters, friction, law, platen "
            f"position and model misfit), and to {measured:.2f} mm with the noise of both scans; 95 % lie within 1.96 times that."
        )


def per_axis(sd: FloatArray) -> FloatArray:
    """Return one standard deviation (k,) for all coordinates of a marker, mm, from those along the axes (k, 3).

    It is between their root mean square and the largest: 1.96 of it hold 95 % of the three coordinates together.
    """
    low, high = sd.min(axis=1), sd.max(axis=1)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        enough = erf(WIDTH * middle[:, None] / (np.sqrt(2.0) * sd)).mean(axis=1) >= erf(WIDTH / np.sqrt(2.0))
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return np.asarray(high)


def coordinate_uncertainty(
    model: CalibratedModel,
    body: Specimen,
    parameters: ParameterSet,
    fit: LoadCaseFit,
    *,
    strain_ratio: float,
    platen: str,
    platen_sd_mm: float | None = None,
    gauge: Gauge | None = None,
    pose: RigidTransform | None = None,
    seen: BoolArray | None = None,
    elements_mm: FloatArray | None = None,
) -> CoordinateUncertainty:
    """Return the uncertainty of the coordinates of a predicted state.

    Parameters
    ----------
    model : CalibratedModel
        With its predictive uncertainty.
    body : Specimen
        The meshed experiment.
    parameters : ParameterSet
        Of the state, consider parameters included; priors hold for what the model does not know.
    fit : LoadCaseFit
        The solution, with derivatives with respect to the free parameters.
    strain_ratio : float
        Strain of the state over that of the calibrating ones: what the model misses grows with its square beyond 1. NaN: not known.
    platen : str
        Name of the platen position.
    platen_sd_mm : float, optional
        Its standard deviation where it is known from elsewhere than the model.
    gauge : Gauge, optional
        Markers to which the platen position was fitted.
    pose : RigidTransform, optional
        Transform that registered the prediction to the measured markers: rigid motions do not count then.
    seen : ndarray, shape (k,), bool, optional
        The markers to which it was registered.
    elements_mm : ndarray, shape (k, 3), optional
        How far vanishing elements would move the markers, mm; what they would do to the parameters is known to the model.
    """
    moment = _second_moment(model, parameters, {} if platen_sd_mm is None else {platen: platen_sd_mm})
    j = fit.jacobian * np.array([p.slope(p.value) for p in parameters.free])
    names = [p.name for p in parameters.free]
    mesh = _error_of_elements(known := model.uncertainty, names, j, elements_mm)
    if gauge is not None:
        rates = gauge.derivatives(fit.predicted, j)
        mesh -= j[:, :, names.index(platen)] * (gauge.derivatives(fit.predicted, mesh[:, :, None])[0] / rates[names.index(platen)])
        moment = _gauged(moment, rates, names.index(platen), gauge.sd_mm)
    if pose is not None and seen is not None:
        both = np.concatenate([j, mesh[:, :, None]], axis=2)
        both = np.einsum("il,klp->kip", pose.rotation, _without_rigid_motion(both, fit.pose_jacobian, seen))
        j, mesh = both[:, :, :-1], both[:, :, -1]
    else:  # the markers of the reference scan stay where they are, however high above the base the model puts them
        lifting = [p.name in (base_offset(body.experiment), straight_base(body.experiment)) for p in parameters.free]
        j[:, :, lifting] -= fit.pose.rotation[:, 2, None]
    variance = np.einsum("kip,pq,kiq->ki", j, moment, j)
    # the parameters have taken up what is proportional to the strain; what is left grows with its square
    discrepancy = known.discrepancy_mm * float(np.fmax(1.0, strain_ratio)) ** 2
    sd = np.sqrt(np.maximum(variance, 0.0) + discrepancy**2 + mesh**2 / 3.0)  # elements: anything up to that, to either side
    return CoordinateUncertainty(sd, np.sqrt(sd**2 + (known.noise_factor * fit.sd) ** 2))


def _error_of_elements(known: PredictiveUncertainty, names: list[str], j: FloatArray, elements_mm: FloatArray | None) -> FloatArray:
    """Error (k, 3), mm, that the elements leave: their own in this state, less what parameters identified on such elements make up for."""
    if elements_mm is None or not known.mesh_step:
        return np.zeros(j.shape[:2])
    steps = dict(zip(known.names, known.mesh_step, strict=True))
    return np.asarray(elements_mm + j @ np.array([steps.get(name, 0.0) for name in names]))


def _second_moment(model: CalibratedModel, parameters: ParameterSet, given: dict[str, float]) -> FloatArray:
    """Second moment (p, p) of the errors of the free parameters, on the optimiser's scale: the model's, and priors of the rest."""
    free = parameters.free
    moment = np.diag([given.get(p.name, p.prior_sd) ** 2 if np.isfinite(p.prior_sd) else 0.0 for p in free])
    known = {name: i for i, name in enumerate(model.uncertainty.names)}
    mine = [i for i, p in enumerate(free) if p.name in known and p.name not in given]
    theirs = [known[free[i].name] for i in mine]
    moment[np.ix_(mine, mine)] = model.uncertainty.covariance[np.ix_(theirs, theirs)]
    return moment


def _gauged(moment: FloatArray, rates: FloatArray, platen: int, sd_mm: float) -> FloatArray:
    """The second moment after the platen position was fitted to a distance with derivatives `rates` (p,): it errs with the rest."""
    carried = np.eye(len(moment))
    carried[platen] -= rates / rates[platen]
    out = carried @ moment @ carried.T
    out[platen, platen] += (sd_mm / rates[platen]) ** 2
    return np.asarray(out)


def _without_rigid_motion(j: FloatArray, pose: FloatArray, seen: BoolArray) -> FloatArray:
    """Derivatives (k, 3, p) less the rigid motion that fits each of them best at the markers that were `seen`."""
    rigid = np.linalg.lstsq(pose[seen].reshape(-1, 6), j[seen].reshape(-1, j.shape[2]), rcond=None)[0]
    return np.asarray(j - np.einsum("kij,jp->kip", pose, rigid))
