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
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen_model import ModelSettings

FORMAT = "naibu model 1"


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
        Of the free parameters on the optimiser's scale.
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
    """

    settings: ModelSettings
    parameters: ParameterSet
    covariance: FloatArray
    noise: NoiseModel
    noise_factor: float
    known_materials: KnownMaterials
    load_cases: tuple[str, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, calibration: Calibration, provenance: Mapping[str, Any] | None = None) -> CalibratedModel:
        """Take the model from a calibration."""
        c = calibration
        labels = tuple(t.name for t in c.load_cases)
        return cls(
            c.settings, c.match.parameters, c.match.covariance, c.noise, c.match.noise_factor, c.known_materials, labels, provenance or {}
        )

    def standard_deviation(self, name: str) -> float:
        """Standard deviation of a parameter on the optimiser's scale; 0 where it was given.

        Raises
        ------
        InputError
            The model has no such parameter.
        """
        free = [p.name for p in self.parameters.free]
        if name in free:
            return float(np.sqrt(self.covariance[free.index(name), free.index(name)]))
        if name in self.parameters.values():
            return 0.0
        raise InputError(f"the model has no parameter {name!r}; it has {', '.join(self.parameters.values())}")

    def interval(self, name: str, width: float = 1.959964) -> tuple[float, float]:
        """Return the bounds of a parameter, `width` standard deviations about its estimate on the optimiser's scale (95 % by default)."""
        parameter = next(p for p in self.parameters if p.name == name)
        centre, half = parameter.inner(parameter.value), width * self.standard_deviation(name)
        low, high = sorted((parameter.physical(centre - half), parameter.physical(centre + half)))
        return low, high

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
            "units": "mm, kg, s, mN, kPa",
            "settings": asdict(self.settings),
            "noise": asdict(self.noise),
            "noise_factor": self.noise_factor,
            "known": {"young_moduli": dict(self.known_materials.young_moduli), "scale_is_absolute": self.known_materials.scale_is_absolute},
            "load_cases": list(self.load_cases),
            "parameters": rows,
            "covariance": self.covariance.tolist(),
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
        try:
            parameters = ParameterSet.of(Parameter(**(row | {"prior_sd": row["prior_sd"] or np.inf})) for row in data["parameters"])
            covariance = np.array(data["covariance"], dtype=float).reshape(len(parameters.free), len(parameters.free))
            known = data["known"]
            return cls(
                ModelSettings(**data["settings"]), parameters, covariance, NoiseModel(**data["noise"]), float(data["noise_factor"]),
                KnownMaterials(known["young_moduli"], known["scale_is_absolute"]), tuple(data["load_cases"]), data.get("provenance", {}),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the model file is damaged or was written by another version ({error}); identify the model again") from error
