"""A calibrated model: the law, the estimated parameters with their covariance, and how well they fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.parameters import Parameter, ParameterSet
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.law_uncertainty import LawUncertainty, law_uncertainty
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.predictive_uncertainty import PredictiveUncertainty, predictive_uncertainty
from naibu.identification.prediction.stored_model import check_stored_model

FORMAT = "naibu model 1"
LARGEST_EXPONENT = 700.0
UNBOUNDED = 1e3  # a factor between estimate and bound beyond which the data give no bound


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedModel:
    """What an identification hands on.

    Attributes
    ----------
    settings : ModelSettings
        Law, contact, mesh size.
    parameters : ParameterSet
        Estimated and given values, boundary conditions of the load cases included.
    covariance : ndarray, shape (p, p)
        Second moment of the errors of the free parameters on the optimiser's scale: from noise, misfit, elements and the form of the law.
    noise : NoiseModel
        Of the measurement.
    noise_factor : float
        Root mean square residual in units of the noise.
    known_materials : KnownMaterials
        What set the scale.
    load_cases : tuple of str
        ``experiment/state`` of the data used.
    provenance : mapping
        Version, settings, input hashes.
    predictive : PredictiveUncertainty, optional
        What the calibration leaves uncertain about other load cases.
    reservation : str
        What speaks against using the model, from the verdict on its identification; empty where nothing does.
    law_covariance : ndarray, shape (p, p), optional
        The part of `covariance` that stems from the form of the law; None where it was not told apart.
    """

    settings: ModelSettings
    parameters: ParameterSet
    covariance: FloatArray
    noise: NoiseModel
    noise_factor: float
    known_materials: KnownMaterials
    load_cases: tuple[str, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    predictive: PredictiveUncertainty | None = None
    reservation: str = ""
    law_covariance: FloatArray | None = None

    @property
    def uncertainty(self) -> PredictiveUncertainty:
        """What the calibration leaves uncertain about other load cases; no more than the covariance where the model does not say."""
        if self.predictive is not None:
            return self.predictive
        return PredictiveUncertainty(tuple(p.name for p in self.parameters.free), self.covariance, 0.0, max(1.0, self.noise_factor), {})

    @property
    def reference(self) -> tuple[str, float] | None:
        """The material whose modulus is the unit of all others, and the number, kPa, that stands for it; None where moduli are in kPa.

        Moduli are in kPa where one was given, or where all are sought from the weight of the object.
        """
        fixed = {p.name for p in self.parameters if p.fixed}
        relative = not self.known_materials.scale_is_absolute
        named = [(m, e) for m, e in self.known_materials.young_moduli.items() if relative and young_modulus(m) in fixed]
        return named[0] if named else None

    @property
    def is_weighed(self) -> bool:
        """Whether moduli are in kPa because they were sought from the weight of the object."""
        stated = self.known_materials.young_moduli and self.known_materials.scale_is_absolute
        return not stated and self.reference is None

    def is_lower_bound(self, name: str) -> bool:
        """Whether a parameter is a modulus that only bounds the true one from below, as it follows from the weight of the object.

        Whatever else holds the object on its table, such as a base that sticks, looks like a smaller modulus. With
        ``ModelSettings(modulus="weighed")`` it is stated that nothing does.
        """
        return self.is_weighed and self.settings.modulus == "automatic" and name.endswith(young_modulus(""))

    def shown(self, p: Parameter) -> tuple[float, str]:
        """Return the factor from a parameter to the number told of it, and its unit: multiples where no modulus is known."""
        if self.reference is None or not p.unit.startswith("kPa"):
            return 1.0, p.unit
        material, modulus = self.reference
        return 1.0 / modulus, f"× {material}{p.unit.removeprefix('kPa')}"

    @classmethod
    def of(
        cls, calibration: Calibration, provenance: Mapping[str, Any] | None = None, law: LawUncertainty | None = None
    ) -> CalibratedModel:
        """Take the model from a calibration; `law` is what it owes to the law, where that is known already."""
        c, by_law = calibration, law or law_uncertainty(calibration)
        labels = tuple(t.name for t in c.load_cases)
        return cls(
            c.settings, c.match.parameters, c.covariance + by_law.covariance, c.noise, c.match.noise_factor, c.known_materials, labels,
            provenance or {}, predictive_uncertainty(c, by_law.considered), law_covariance=by_law.covariance,
        )  # fmt: skip

    def standard_deviation(self, name: str, *, law_exact: bool = False) -> float:
        """Standard deviation of a parameter on the optimiser's scale, if `law_exact` with the law taken for right; 0 where it was given.

        Raises
        ------
        InputError
            The model has no such parameter.
        """
        free = [p.name for p in self.parameters.free]
        if name in free:
            k = free.index(name)
            by_law = self.law_covariance[k, k] if law_exact and self.law_covariance is not None else 0.0
            return float(np.sqrt(max(self.covariance[k, k] - by_law, 0.0)))
        if name in self.parameters.values():
            return 0.0
        raise InputError(f"the model has no parameter {name!r}; it has {', '.join(self.parameters.values())}")

    def interval(self, name: str, width: float = 1.959964, *, law_exact: bool = False) -> tuple[float, float]:
        """Return the bounds of a parameter, `width` standard deviations about its estimate on the optimiser's scale (95 % by default).

        They hold whichever law the material obeys; with `law_exact` those that hold if it obeys the law that was assumed.

        They respect physics: a Poisson's ratio is at least -1, and a positive parameter known to no power of `UNBOUNDED` has no bounds. A
        modulus that is a lower bound (`is_lower_bound`) has no upper one.
        """
        low, high = self.interval_of_model(name, width, law_exact=law_exact)
        return low, np.inf if self.is_lower_bound(name) else high

    def interval_of_model(self, name: str, width: float = 1.959964, *, law_exact: bool = False) -> tuple[float, float]:
        """Return the bounds of a parameter if only what the model holds acts on the object: of a modulus that is a lower bound both."""
        parameter = next(p for p in self.parameters if p.name == name)
        centre, half = parameter.inner(parameter.value), min(width * self.standard_deviation(name, law_exact=law_exact), LARGEST_EXPONENT)
        if parameter.scale == "log" and half > np.log(UNBOUNDED):
            return 0.0, np.inf
        low, high = sorted((parameter.physical(centre - half), parameter.physical(centre + half)))
        return (max(low, -1.0), high) if parameter.scale == "incompressibility" else (low, high)

    def correlation(self, names: Sequence[str]) -> FloatArray:
        """Return the correlation matrix of some free parameters."""
        free = [p.name for p in self.parameters.free]
        index = [free.index(n) for n in names]
        block = self.covariance[np.ix_(index, index)]
        sd = np.sqrt(np.diag(block))
        return np.asarray(block / np.outer(sd, sd))

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain numbers and strings, for JSON; infinite prior widths are None."""
        rows = [asdict(p) | {"prior_sd": p.prior_sd if np.isfinite(p.prior_sd) else None} for p in self.parameters]
        return {
            "format": FORMAT,
            "reservation": self.reservation,
            "units": "mm, kg, s, mN, kPa",
            "settings": asdict(self.settings),
            "noise": asdict(self.noise),
            "noise_factor": self.noise_factor,
            "known": {"young_moduli": dict(self.known_materials.young_moduli), "scale_is_absolute": self.known_materials.scale_is_absolute},
            "load_cases": list(self.load_cases),
            "parameters": rows,
            "covariance": self.covariance.tolist(),
            "law_covariance": None if self.law_covariance is None else self.law_covariance.tolist(),
            "predictive": None if self.predictive is None else self.predictive.to_dict(),
            "provenance": dict(self.provenance),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> CalibratedModel:
        """Read a model that `to_dict` wrote.

        Raises
        ------
        InputError
            Another format, or a missing or unusable entry.
        """
        if data.get("format") != FORMAT:
            raise InputError(f"this is not a naibu model: its format is {data.get('format')!r}, not {FORMAT!r}")
        check_stored_model(data)
        try:
            parameters = ParameterSet.of(Parameter(**(row | {"prior_sd": row["prior_sd"] or np.inf})) for row in data["parameters"])
            covariance = np.array(data["covariance"], dtype=float).reshape(len(parameters.free), len(parameters.free))
            known, predictive, by_law = data["known"], data.get("predictive"), data.get("law_covariance")
            return cls(
                ModelSettings(**data["settings"]), parameters, covariance, NoiseModel(**data["noise"]), float(data["noise_factor"]),
                KnownMaterials(known["young_moduli"], known["scale_is_absolute"]), tuple(data["load_cases"]), data.get("provenance", {}),
                None if predictive is None else PredictiveUncertainty.from_dict(predictive),
                str(data.get("reservation", "")), None if by_law is None else np.array(by_law, dtype=float).reshape(covariance.shape),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the model file is damaged or was written by another version ({error}); identify the model again") from error
