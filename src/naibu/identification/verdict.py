"""The verdict on an identification, whatever was measured: whether the model explains the data, in part, or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.neighbours import neighbours

NEIGHBOURS = 6
UNDETERMINED = 4.0  # factor within which a parameter lies at 95 %, from which it is called not determined


class Explanation(Enum):
    """How far the model explains the data."""

    EXPLAINED = "explained"
    IN_PART = "explained in part"
    NOT_EXPLAINED = "not explained, do not use"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the model explains the data.

    Attributes
    ----------
    explanation : Explanation
    reasons : tuple of str
        What speaks against an explanation, the gravest first; empty where nothing does.
    lead : str
        The figures behind it, in words.
    noise_factor : float
        Root mean square residual in units of the stated noise.
    unexplained : float
        Residual over the deformation (displacement less its rigid motion), root mean squares.
    shared : float
        Correlation of the residual of a point with the mean of its neighbours', see `shared_part`.
    notes : tuple of str
        What else to know.
    outliers : tuple of str
        Points that were left out, one sentence each.
    limits : str
        What is known only roughly or not at all although the model explains the data, in words that follow "but"; empty where nothing is.
    mesh_dependent : tuple of str
        Zones whose moduli smaller elements would change by so much that they are not determined, while those of the others are.
    """

    explanation: Explanation
    reasons: tuple[str, ...]
    lead: str
    noise_factor: float
    unexplained: float
    shared: float
    notes: tuple[str, ...] = ()
    outliers: tuple[str, ...] = ()
    limits: str = ""
    mesh_dependent: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the result can be used, with care where it is explained in part."""
        return self.explanation is not Explanation.NOT_EXPLAINED

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        what = self.explanation.value + f", but {self.limits}" * bool(self.limits)
        return f"{what[0].upper()}{what[1:]}: {'; '.join(self.reasons[:3]) or self.lead}."

    @property
    def reservation(self) -> str:
        """The sentence where something speaks against the model, else nothing."""
        return "" if self.explanation is Explanation.EXPLAINED and not self.limits else self.sentence

    def in_part(self, reason: str, *, first: bool = True) -> Verdict:
        """Return the verdict with one more reason, before or after the others: what was explained is so in part."""
        part = Explanation.IN_PART if self.explanation is Explanation.EXPLAINED else self.explanation
        return replace(self, explanation=part, reasons=(reason, *self.reasons) if first else (*self.reasons, reason))

    def to_dict(self) -> dict[str, Any]:
        """Return what a file of results tells of it."""
        return {
            "explanation": self.explanation.name.lower(),
            "sentence": self.sentence,
            "reasons": list(self.reasons),
            "notes": list(self.notes),
            "mesh_dependent": list(self.mesh_dependent),
        }


@dataclass(frozen=True, slots=True)
class SharedPart:
    """The part of residuals that neighbours share: noise of independent points has none (compare Moran's I, :cite:p:`moran1950`).

    Attributes
    ----------
    square : float
        Mean product of the residuals (vectors) of neighbouring points, in the residuals' unit squared.
    correlation : float
        Correlation of the residual of a point with the mean of its neighbours', in [-1, 1].
    """

    square: float
    correlation: float


def shared_part(load_cases: Sequence[tuple[FloatArray, FloatArray]]) -> SharedPart:
    """Return the part of the residuals that neighbours share, of pairs of points (k, d) and their residuals (k, e)."""
    products = own = of_means = 0.0
    count = 0
    for points, residual in load_cases:
        if len(points) < 2:
            continue
        means = residual[neighbours(points, NEIGHBOURS)[1]].mean(axis=1)
        products += float((residual * means).sum())
        own += float((residual**2).sum())
        of_means += float((means**2).sum())
        count += len(points)
    return SharedPart(products / max(count, 1), products / max(float(np.sqrt(own * of_means)), 1e-300))
