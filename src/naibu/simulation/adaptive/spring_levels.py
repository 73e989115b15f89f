"""Springs of an adaptive lattice on Kuhn's cubes by level: closed forms of :cite:t:`hirai2008` (chapter 4.2, equations 5 to 11)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import require_positive
from naibu.core.errors import InputError

_LENGTH = (np.sqrt(3.0), np.sqrt(2.0), 1.0)  # A: diagonal of a cube, of a face, and an edge
_VOLUME = (1.0, 1.0 / 3.0, 1.0 / 3.0)  # B: of the cells around it


@dataclass(frozen=True, slots=True)
class LevelSpring:
    """Spring on the refinement edge of cells of one level, inside the body.

    Attributes
    ----------
    length_mm : float
        L(n) = A c, with the edge c = 2^-floor(n / 3) of the cubes.
    volume_mm3 : float
        V(n) = B c^3, of the cells around the edge.
    stiffness : float
        k(n) = E V / L^2, mN/mm.
    """

    length_mm: float
    volume_mm3: float
    stiffness: float


def level_spring(level: int, *, young_modulus: float, cube_mm: float) -> LevelSpring:
    """Return the spring on the refinement edge of the cells of a level, which six, four or eight cells share.

    Parameters
    ----------
    level : int
        Number of bisections.
    young_modulus : float
        kPa.
    cube_mm : float
        Edge of the cubes of the coarsest mesh, mm.

    Raises
    ------
    InputError
        A negative level, or a modulus or an edge that is not positive.
    """
    require_positive("young_modulus", young_modulus, "kPa")
    require_positive("cube_mm", cube_mm, "mm")
    if level < 0:
        raise InputError(f"level must not be negative, not {level}")
    cube = cube_mm * 0.5 ** (level // 3)
    length, volume = float(_LENGTH[level % 3] * cube), float(_VOLUME[level % 3] * cube**3)
    return LevelSpring(length, volume, young_modulus * volume / length**2)
