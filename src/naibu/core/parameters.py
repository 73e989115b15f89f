"""Named parameters with physical values, unconstrained scales for the optimiser, and Gaussian priors on these scales."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

MAX_POISSON_RATIO = 0.4995  # beyond it displacements do not distinguish a solid from an incompressible one

Scale = Literal["linear", "log", "incompressibility"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a model.

    Attributes
    ----------
    name : str
        Unique name, ``"hardness 0: young_modulus"``.
    value : float
        Physical value; the start of the search and the centre of the prior.
    unit : str
        Unit of the physical value, empty when it has none.
    scale : {"linear", "log", "incompressibility"}
        How the optimiser sees it: as it is, as ln(value), or, for a Poisson ratio, as
        ln(0.999 - 2 value), which keeps it below 0.4995. Every real number is then admissible.
    prior_sd : float
        Standard deviation of the prior on the optimiser's scale; infinite for none.
    fixed : bool
        Whether the value is given and not sought.
    """

    name: str
    value: float
    unit: str = ""
    scale: Scale = "linear"
    prior_sd: float = np.inf
    fixed: bool = False

    def __post_init__(self) -> None:
        if self.scale not in get_args(Scale):
            raise InputError(f"parameter {self.name!r} has the unknown scale {self.scale!r}; use one of {', '.join(get_args(Scale))}")
        if not np.isfinite(self.value):
            raise InputError(f"parameter {self.name!r} must be a finite number, not {self.value}")
        if self.scale == "log" and not self.value > 0.0:
            raise InputError(f"parameter {self.name!r} must be positive, not {self.value:g}")
        if self.scale == "incompressibility" and not self.value < MAX_POISSON_RATIO:
            raise InputError(f"parameter {self.name!r} must be below {MAX_POISSON_RATIO}, not {self.value:g}")
        if not self.prior_sd > 0.0:
            raise InputError(f"parameter {self.name!r} needs a positive prior standard deviation, not {self.prior_sd:g}; fix it instead")

    def inner(self, value: float) -> float:
        """Return the optimiser's value of a physical one."""
        if self.scale == "log":
            return float(np.log(value))
        return float(np.log(2.0 * (MAX_POISSON_RATIO - value))) if self.scale == "incompressibility" else value

    def physical(self, inner: float) -> float:
        """Return the physical value of the optimiser's."""
        if self.scale == "log":
            return float(np.exp(inner))
        return float(MAX_POISSON_RATIO - 0.5 * np.exp(inner)) if self.scale == "incompressibility" else inner

    def slope(self, value: float) -> float:
        """Return d physical / d inner at a physical value."""
        if self.scale == "log":
            return value
        return value - MAX_POISSON_RATIO if self.scale == "incompressibility" else 1.0

    @property
    def bend(self) -> float:
        """Second over first derivative of the physical value with respect to the inner one."""
        return 0.0 if self.scale == "linear" else 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ParameterSet:
    """Parameters in a fixed order, each name once."""

    parameters: tuple[Parameter, ...]

    @classmethod
    def of(cls, parameters: Iterable[Parameter]) -> ParameterSet:
        """Gather parameters.

        Raises
        ------
        InputError
            A name appears twice.
        """
        found = tuple(parameters)
        names = [p.name for p in found]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"parameter {name!r} is defined more than once")
        return cls(found)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    @property
    def free(self) -> tuple[Parameter, ...]:
        """Parameters that are sought."""
        return tuple(p for p in self.parameters if not p.fixed)

    def values(self, inner: FloatArray | None = None) -> dict[str, float]:
        """Return all physical values; free ones taken from the optimiser's vector (in the order of `free`) where it is given."""
        out = {p.name: p.value for p in self.parameters}
        if inner is not None:
            out |= {p.name: p.physical(float(x)) for p, x in zip(self.free, inner, strict=True)}
        return out

    def start(self) -> FloatArray:
        """Return the optimiser's vector of the present values."""
        return np.array([p.inner(p.value) for p in self.free])

    def changed(self, changes: Mapping[str, Parameter]) -> ParameterSet:
        """Return the set with some parameters replaced by others of the same name."""
        return ParameterSet(tuple(changes.get(p.name, p) for p in self.parameters))

    def with_values(self, values: Mapping[str, float], *, fixed: bool | None = None) -> ParameterSet:
        """Return the set with other physical values, and optionally fixed or freed, for the names in `values`."""
        return ParameterSet(
            tuple(
                replace(p, value=values[p.name], fixed=p.fixed if fixed is None else fixed) if p.name in values else p
                for p in self.parameters
            )
        )
