"""Materials whose modulus is known beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class KnownMaterials:
    """What is known before the search.

    Attributes
    ----------
    young_moduli : mapping of str to float
        Materials whose Young's modulus is given, kPa; they set the scale.
    scale_is_absolute : bool
        Whether the moduli of the known materials are true values, or stand for 1 in a ratio.
    """

    young_moduli: Mapping[str, float] = field(default_factory=dict)
    scale_is_absolute: bool = True
