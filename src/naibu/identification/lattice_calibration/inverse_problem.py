"""What the searches need of an inverse problem, be it of pushed faces or of a study."""

from __future__ import annotations

from typing import Any, Protocol

from naibu.core.arrays import FloatArray


class Unknowns(Protocol):
    """Named positive parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """What they are called."""

    @property
    def units(self) -> tuple[str, ...]:
        """Units of their values."""

    def vector(self, values: Any) -> FloatArray:
        """Return values (p,) from numbers or a mapping by name."""

    def held(self, values: FloatArray) -> FloatArray:
        """Return values (p,) within their ranges."""

    def parameters(self, values: FloatArray) -> Any:
        """Return what the forward models run with."""

    def changes(self, values: FloatArray) -> tuple[Any, ...]:
        """Return the directions of the logarithms of all values."""


class InverseProblem(Protocol):
    """Unknowns, load cases with a ``coarse`` and a ``fine`` forward model, and residuals in units of their noise."""

    @property
    def unknowns(self) -> Any:
        """What is sought."""

    @property
    def load_cases(self) -> tuple[Any, ...]:
        """What was measured."""

    @property
    def excess(self) -> tuple[float, float]:
        """Factors of the noise of points and forces."""

    @property
    def roughness(self) -> float:
        """How far chi-squared jumps as the parameters change, as a fraction of it: a decrease below that cannot be relied on."""

    def shifts(self, values: FloatArray) -> FloatArray | None:
        """Return by how much logarithms (p,) change for derivatives that are differences; None where they come with a simulation."""

    def enlarged(self, excess: tuple[float, float]) -> Any:
        """Return the problem with other factors of the noise."""

    def with_half_steps(self) -> Any | None:
        """Return the problem with fine steps of half the length, whose residuals tell what steps leave; None where that tells nothing."""

    def weighed(self, load_case: Any, found: Any, step: float) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Return residuals (count,) and derivatives (count, p) of points and of forces in units of their noise."""
