"""Fields whose components are in another order, or of other signs, than their positions: refused before a search that leads nowhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.identification.from_fields.assumptions.component_order import LikelierOrder, likelier_order
from naibu.workflows.fields.object_on_cubes import ScannedObject

CUBES = 300  # of the object: components in a wrong order show on coarse ones
MOST_NAMED = 3  # arrangements that are about as likely


def require_likely_components(scanned: ScannedObject, points: int, progress: Progress | None = None) -> None:
    """Refuse fields that suit an elastic body far better with their components in another order or of other signs.

    Parameters
    ----------
    scanned : ScannedObject
        The object and its fields.
    points : int
        Number of measurements of the field that has most.
    progress : callable, optional
        Gets reports.

    Raises
    ------
    InputError
        What is likely wrong, and how to mend it or to go on nevertheless.
    """
    cubes = scanned.on_cubes(scanned.edge_mm(max(min(CUBES, points // 2), 64)), (), exactly=False, each_cell=True)
    found = likelier_order(cubes.mesh, cubes.load_cases, progress)
    if found is not None:
        raise InputError(f"{', '.join(case.name for case in cubes.load_cases)}: {told_order(found)}")


def told_order(found: LikelierOrder) -> str:
    """Return in words which components are likely wrong, and what to do."""
    mends = "; or ".join(_mend(matrix) for matrix in found.arrangements[:MOST_NAMED])
    return (
        f"a homogeneous body leaves {_percent(found.unexplained)} of the deformation unexplained (root mean square), and would leave "
        f"{_percent(found.least)} if displacements had other signs or another order of components. They are likely not in the frame of the "
        f"positions: {mends}. If they are right, as a body of negative Poisson's ratio may show them, and forces act at no sides but those "
        "that `loaded` names, give check_components=False"
    )


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"


def _mend(matrix: FloatArray) -> str:
    """Return in words what to do so that vectors become a matrix, or its negative, times what they are."""
    of, sign = np.abs(matrix).argmax(axis=1), matrix.sum(axis=1)
    if (of == np.arange(len(of))).all():
        flipped, others = ([f"u{'xyz'[k]}" for k in np.flatnonzero(sign == s)] for s in (-1.0, 1.0))
        fewer, more = sorted((flipped, others), key=len)
        return f"change the sign of {' and '.join(fewer)}, or else of {' and '.join(more)}"
    return f"take {_listed(of, sign)} for ux, uy, uz, or else {_listed(of, -sign)}"


def _listed(of: Sequence[int] | FloatArray, sign: FloatArray) -> str:
    return ", ".join(f"{'-' if s < 0.0 else ''}u{'xyz'[int(k)]}" for k, s in zip(of, sign, strict=True))
