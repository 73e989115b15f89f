"""Fields whose components are in another order, or of other signs, than their positions: refused before a search that leads nowhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.identification.from_fields.assumptions.component_order import LikelierOrder, likelier_order
from naibu.identification.from_fields.assumptions.volume_change import VolumeChange, volume_change
from naibu.identification.from_fields.forward.load_cases import is_surface_sought
from naibu.workflows.fields.known_zones import KnownZones
from naibu.workflows.fields.object_on_cubes import ScannedObject

CUBES = 300  # of the object: components in a wrong order show on coarse ones
MOST_NAMED = 3  # arrangements that are about as likely
COMPRESSIBLE = 0.4  # Poisson's ratio of a known zone below which a body may well change its volume
BY_ITSELF = (
    "or the body changes its volume by itself (uptake of water, drying, growth, temperature), and what is found of its zones may be wrong"
)
UNTOLD = (
    "{}: where forces may act on the whole surface, this field does not tell the signs of single components: its volume changes {:.2g} "
    "times as much as its shape, with another sign of u{} {:.2g} times as much. They are taken as they are; naming the sides at which "
    "forces act (`loaded`) has them checked."
)


def require_likely_components(
    scanned: ScannedObject, points: int, known: KnownZones, progress: Progress | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Refuse fields that suit an elastic body far better with their components in another order or of other signs.

    Where forces may act on the whole surface, what tells is that bodies hardly change their volume, unless a zone is known that may. As
    lungs and foams do, too, that is a doubt, which is told.

    Parameters
    ----------
    scanned : ScannedObject
        The object and its fields.
    points : int
        Number of measurements of the field that has most.
    known : KnownZones
        What is stated of zones.
    progress : callable, optional
        Gets reports.

    Returns
    -------
    doubts, untold : tuple of str
        In words: what is doubtful, and what the fields do not tell.

    Raises
    ------
    InputError
        What is likely wrong, and how to mend it or to go on nevertheless.
    """
    cubes = scanned.on_cubes(scanned.edge_mm(max(min(CUBES, points // 2), 64)), (), exactly=False, each_cell=True)
    names = ", ".join(case.name for case in cubes.load_cases)
    found = likelier_order(cubes.mesh, cubes.load_cases, progress)
    if found is not None:
        raise InputError(f"{names}: {told_order(found)}")
    if not is_surface_sought(cubes.mesh, cubes.load_cases):
        return (), ()
    report_progress(progress, "comparing how much volume and shape change")
    compressible = any(poisson < COMPRESSIBLE for zone, (_, poisson) in known.values.items() if zone in known.not_rigid)
    doubts, untold = [], []
    for case in cubes.load_cases:
        changed = volume_change(cubes.mesh, case)
        if changed.wrong_sign and not compressible:
            doubts.append(f"{case.name}: {told_sign(changed)}")
        elif changed.doubtful_order and not compressible:
            doubts.append(f"{case.name}: {told_doubt(changed)}")
        elif not changed.signs_told:
            untold.append(UNTOLD.format(case.name, changed.given, "xyz"[changed.component], changed.flipped))
    return tuple(doubts), tuple(untold)


def told_sign(found: VolumeChange) -> str:
    """Return in words that the sign of a component is likely wrong, and what to do."""
    others = " and ".join(f"u{axis}" for k, axis in enumerate("xyz") if k != found.component)
    return (
        f"the volume changes {_times(found.given)} as much as the shape, and would change {_times(found.flipped)} as much with another "
        f"sign of u{'xyz'[found.component]}. That is right of a lung, sponge or foam that expands or is squeezed in several directions; "
        f"{BY_ITSELF}; of a gel or tissue that does not, components are not in the frame of the positions: change the sign of "
        f"u{'xyz'[found.component]}, or else of {others}."
    )


def told_doubt(found: VolumeChange) -> str:
    """Return in words that components are perhaps in another order."""
    return (
        f"the volume changes {_times(found.given)} as much as the shape, and would change {_times(found.reordered)} as much if components "
        f"were in another order. That is right of a sponge or foam; {BY_ITSELF}; of a gel or tissue that does not, {_mend(found.order)}."
    )


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


def _times(share: float) -> str:
    return f"{share:.2g} times"


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
