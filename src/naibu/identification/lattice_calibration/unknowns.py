"""Unknown parameters of a lattice: K, C1 and C2 by class of element, and by zone :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.lattice import CLASSES, ZONES, Lattice, LatticeParameters
from naibu.mechanics.lattices.simulation.tangent_linear import ParameterChange

KINDS = ("K", "C1", "C2")
UNITS = {"K": "mN/mm", "C1": "mN s/mm", "C2": "mN s/mm"}
VOIGT_FRACTION = 0.7  # has no effect
MOST_NAMED = 4  # parameters of a combination
FRACTION_NOTE = (
    "a, the Voigt part's fraction of the length at rest, changes neither force nor shape (only the extension Z - a L enters): "
    "no measurement of either can identify it."
)


@dataclass(frozen=True, slots=True, eq=False)
class LatticeUnknowns:
    """Named parameters of groups of elements.

    Attributes
    ----------
    names : tuple of str
        ``"K short"``, ``"C1 long surface"`` and so on.
    kind : tuple of int
        0 K, 1 C1, 2 C2 of every parameter.
    members : ndarray, shape (p, m), bool
        Elements that have it.
    scale : ndarray, shape (m,)
        `Lattice.scale`, by which values are multiplied.
    """

    names: tuple[str, ...]
    kind: tuple[int, ...]
    members: BoolArray
    scale: FloatArray

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the values."""
        return tuple(UNITS[KINDS[kind]] for kind in self.kind)

    @classmethod
    def of(cls, lattice: Lattice, *, classes: bool = True, zones: bool = False, levels: bool = False) -> LatticeUnknowns:
        """Name the parameters of a lattice: one of each kind for every class, zone and octree level that occurs, or for all elements."""
        groups: list[tuple[str, BoolArray]] = [("", np.ones(lattice.n_elements, dtype=bool))]
        steps = tuple(f"level {k}" for k in range(int(lattice.element_level.max(initial=0)) + 1))
        parts = ((classes, lattice.element_class, CLASSES), (zones, lattice.element_zone, ZONES), (levels, lattice.element_level, steps))
        for wanted, codes, labels in parts:
            if wanted:
                split = [(f"{name} {label}", mask & (codes == k)) for name, mask in groups for k, label in enumerate(labels)]
                groups = [(name, mask) for name, mask in split if mask.any()]
        names = tuple(f"{kind}{name}" for kind in KINDS for name, _ in groups)
        members = np.array([mask for _ in KINDS for _, mask in groups])
        return cls(names, tuple(k for k in range(3) for _ in groups), members, lattice.scale)

    def vector(self, values: ArrayLike | Mapping[str, float]) -> FloatArray:
        """Return values (p,) in the order of the names, from numbers or a mapping by name or kind.

        Raises
        ------
        InputError
            A value is missing, unknown, or not positive and finite.
        """
        if isinstance(values, Mapping):
            unknown = [key for key in values if key not in self.names and key not in KINDS]
            if unknown:
                raise InputError(
                    f"there is no parameter {unknown[0]!r}; there are {', '.join(self.names)} (or {', '.join(KINDS)} for all of a kind)"
                )
            lack = [n for n, k in zip(self.names, self.kind, strict=True) if n not in values and KINDS[k] not in values]
            if lack:
                raise InputError(f"no value is given for {', '.join(lack)}")
            found = np.array([values.get(n, values.get(KINDS[k], np.nan)) for n, k in zip(self.names, self.kind, strict=True)], dtype=float)
        else:
            found = np.array(values, dtype=float)
            if found.shape != (len(self.names),):
                raise InputError(f"values have shape {found.shape}, but there are {len(self.names)} parameters: {', '.join(self.names)}")
        return require_positive_values(self.names, found)

    def held(self, values: FloatArray) -> FloatArray:
        """Return the values (p,): they have no range."""
        return values

    def parameters(self, values: FloatArray) -> LatticeParameters:
        """Return the parameters of all elements for values (p,)."""
        tables = np.zeros((3, len(self.scale)))
        for kind, members, value in zip(self.kind, self.members, values, strict=True):
            tables[kind, members] = value
        k, c1, c2 = tables * self.scale
        return LatticeParameters(k, c1, c2, np.full(len(self.scale), VOIGT_FRACTION))

    def changes(self, values: FloatArray) -> tuple[ParameterChange, ...]:
        """Return the derivatives of all elements' parameters by the logarithm of every value."""
        zero = np.zeros(len(self.scale))
        result = []
        for kind, members, value in zip(self.kind, self.members, values, strict=True):
            own = np.where(members, value * self.scale, 0.0)
            result.append(ParameterChange(*(own if k == kind else zero for k in range(3))))
        return tuple(result)


def require_positive_values(names: tuple[str, ...], values: FloatArray) -> FloatArray:
    """Return the values (p,) of parameters; an InputError where one is not positive and finite."""
    for name, value in zip(names, values, strict=True):
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be positive and finite, not {value:g}")
    return values


def identifiability(names: tuple[str, ...], information: FloatArray, *, loose: float = 0.5) -> tuple[str, ...]:
    """Name in words the combinations of parameters that the data do not determine.

    Parameters
    ----------
    names : tuple of str
        Parameters.
    information : ndarray, shape (p, p)
        Fisher information of their logarithms.
    loose : float
        Standard deviation of a combination, as a logarithm, from which it counts as not determined.
    """
    values, vectors = np.linalg.eigh(information)
    sentences = []
    for value, vector in zip(values, vectors.T, strict=True):
        spread = 1.0 / np.sqrt(max(float(value), 1e-300))
        if spread <= loose:
            continue
        strong = vector / vector[np.argmax(np.abs(vector))]
        order = [int(k) for k in np.argsort(-np.abs(strong)) if abs(strong[k]) > 0.25]
        parts = [names[order[0]]] if len(order) == 1 else [f"{names[k]} {'up' if strong[k] > 0 else 'down'}" for k in order[:MOST_NAMED]]
        if len(order) > MOST_NAMED:
            parts.append("others")
        if len(names) > 1 and strong.min() > 0.5:
            parts = [f"the common scale of all {len(names)}", f"{names[0]} to {names[-1]} up together"]
        much = "at all" if spread > 20.0 else f"but within a factor of {np.exp(spread * np.abs(vector).max()):.2g}"
        sentences.append(f"{' with '.join(parts)}: the data do not determine this {'combination ' if len(parts) > 1 else ''}{much}.")
    return (*sentences, FRACTION_NOTE)
