"""The table ``[material]`` of a lattice study: moduli of the solid, and times of its relaxation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, model_validator

from naibu.io.experiment_folder.schema import NotNegative, between

_LEAST, _MOST = 1e-9, 1e9  # kPa
_SHORTEST_S, _LONGEST_S = 1e-9, 1e6


def _modulus(value: Any) -> Any:
    """Check moduli, kPa: a number, a table by label, or the name of a volume."""
    if isinstance(value, str) and value:
        return value
    if isinstance(value, Mapping):
        wrong = next((key for key in value if not key.lstrip("-").isdigit()), None)
        if wrong is not None or not value:
            raise ValueError(f"{wrong!r} is no label; write moduli by label, such as {{ 1 = 12.0, 2 = 40.0 }}")
        return {key: _modulus(inner) for key, inner in value.items()}
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError('must be a number, a table by label such as { 1 = 12.0, 2 = 40.0 }, or the file of a volume, "young_modulus.mha"')
    if not _LEAST <= value <= _MOST:
        raise ValueError(f"must lie between {_LEAST:g} and {_MOST:g}")
    return float(value)


def _relaxation(value: float) -> float:
    """Check a time of relaxation, s: infinite where stress does not relax."""
    if value != np.inf and not _SHORTEST_S <= value <= _LONGEST_S:
        raise ValueError(f"must lie between {_SHORTEST_S:g} and {_LONGEST_S:g}, or be inf where stress does not relax")
    return value


class MaterialTable(BaseModel):
    """``[material]``: instead of ``[parameters]``, of the elastic solid that the lattice stands for."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    young_modulus_kPa: Annotated[Any, AfterValidator(_modulus)]
    retardation_s: Annotated[NotNegative, between(0.0, 1e6)] = 0.0
    relaxation_s: Annotated[float, AfterValidator(_relaxation)] = np.inf

    @model_validator(mode="after")
    def _mapped(self) -> MaterialTable:
        if isinstance(self.young_modulus_kPa, Mapping) and any(isinstance(v, str | Mapping) for v in self.young_modulus_kPa.values()):
            raise ValueError("young_modulus_kPa by label must be numbers")
        return self
