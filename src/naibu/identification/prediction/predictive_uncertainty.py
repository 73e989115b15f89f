"""What a calibration leaves uncertain about other load cases: parameters, what was not sought, and the misfit of the model.

The consider parameters of a calibration (`naibu.identification.from_markers.consider_parameters`) widen the prediction of a state in which
they count. The estimate that they would have moves the others; the square of that motion is part of the second moment that is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_markers.calibration import SHAPE_SD, Calibration
from naibu.identification.from_markers.consider_parameters import ELEMENTS, PREDICTED_SHAPES, Considered, considered
from naibu.identification.from_markers.observations import LoadCaseFit
from naibu.identification.from_markers.specimen.specimen_model import Specimen


@dataclass(frozen=True, slots=True)
class CalibratedState:
    """A state that was used: its loading, and the root mean square equivalent logarithmic strain at its markers."""

    loading: str
    strain: float


@dataclass(frozen=True, slots=True, eq=False)
class PredictiveUncertainty:
    """What a calibration leaves uncertain about other load cases.

    Attributes
    ----------
    names : tuple of str
        Free parameters of the calibration, then the consider parameters.
    covariance : ndarray, shape (p, p)
        Second moment of the errors of `names`, on the optimiser's scale.
    discrepancy_mm : float
        Standard deviation of a coordinate from what the model misses, smooth over the markers, in the calibrating states.
    noise_factor : float
        Factor on the stated measurement noise that explains the rest of the residuals.
    states : mapping of str to CalibratedState
        The states used, by ``experiment/state``.
    mesh_step : tuple of float
        Change of `names` that would fit best with vanishing elements, on the optimiser's scale; empty where that was not estimated.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    discrepancy_mm: float
    noise_factor: float
    states: Mapping[str, CalibratedState]
    mesh_step: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, for JSON."""
        return {
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "discrepancy_mm": self.discrepancy_mm,
            "noise_factor": self.noise_factor,
            "states": {label: asdict(s) for label, s in self.states.items()},
            "mesh_step": list(self.mesh_step),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PredictiveUncertainty:
        """Read what `to_dict` wrote, which `naibu.identification.prediction.stored_model` has checked."""
        names = tuple(data["names"])
        covariance = np.array(data["covariance"], dtype=float).reshape(len(names), len(names))
        states = {str(label): CalibratedState(str(s["loading"]), float(s["strain"])) for label, s in data["states"].items()}
        return cls(
            names,
            covariance,
            float(data["discrepancy_mm"]),
            float(data["noise_factor"]),
            states,
            tuple(map(float, data.get("mesh_step", ()))),
        )


def predictive_uncertainty(calibration: Calibration, known: Considered | None = None) -> PredictiveUncertainty:
    """Return what a calibration leaves uncertain about other load cases; `known` are its consider parameters, once computed.

    Raises
    ------
    ConvergenceError
        The tangent at a solution is singular.
    """
    c, match = known or considered(calibration), calibration.match
    others = tuple(f": {kind}" for kind in SHAPE_SD if kind not in PREDICTED_SHAPES)
    free = c.sought | np.array([not name.endswith(others) for name in c.names])
    kept = free & np.array([name != ELEMENTS for name in c.names])
    shift = c.shift(free)
    moment = (c.covariance(free) + np.outer(shift, shift))[np.ix_(kept, kept)]
    names = tuple(name for name, told in zip(c.names, kept, strict=True) if told)
    states = {
        t.name: CalibratedState(t.specimen.experiment.loading.kind, strain_at_markers(t.specimen, match.parameters.values(), f))
        for t, f in zip(calibration.load_cases, match.fits, strict=True)
    }
    steps = (
        {} if calibration.mesh is None else dict(zip((p.name for p in match.parameters.free), calibration.mesh.step.tolist(), strict=True))
    )
    return PredictiveUncertainty(
        names, moment, float(np.sqrt(c.smooth_mm2)), c.noise_factor, states,
        tuple(steps.get(name, 0.0) for name in names) if steps else (),
    )  # fmt: skip


def strain_at_markers(body: Specimen, values: Mapping[str, float], fit: LoadCaseFit) -> float:
    """Return the root mean square equivalent logarithmic (Hencky) strain at the markers of a solution."""
    f = body.reshaped(values).deformation_gradient(fit.solution.displacement)
    principal = 0.5 * np.log(np.maximum(np.linalg.eigvalsh(np.einsum("kji,kjl->kil", f, f)), 1e-12))
    deviator = principal - principal.mean(axis=1, keepdims=True)
    return float(np.sqrt(2.0 / 3.0 * (deviator**2).sum(axis=1).mean()))
