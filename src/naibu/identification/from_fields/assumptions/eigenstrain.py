"""Whether a body or a zone changes its volume by itself, as by uptake of water, drying, growth or temperature, which no load explains.

A volume that changes without stress is an eigenstrain (:cite:t:`mura1987`). The displacement that it makes of every material, and of all
together, is found to first order, moduli and the motion of the loaded nodes following, and how much of it fits best
(`naibu.identification.from_fields.assumptions.score_test`). Where the motion of the surface confines nearly incompressible material,
hardly anything is seen of a growth, and any error asks for a large one: one that would raise the pressure of any material by more than its
shear modulus is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.from_fields.assumptions.assumed_law import blamed, told_shift
from naibu.identification.from_fields.assumptions.free_law import materials_of
from naibu.identification.from_fields.assumptions.score_test import Asked, ScoreTest, most_asked
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Linearised, moduli_of
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.quality import signed_volumes

MOST_MATERIALS = 12  # that are tried: a solution of every load case each
SMALL = 1e-4  # growth for a derivative
SECOND_ORDER = 0.05  # of a growth: what products with the strain, which are left out, may hold back of it
WHOLE = "the whole body"
BY_ITSELF = "changes its volume by itself"


@dataclass(frozen=True, slots=True, eq=False)
class Eigenstrain:
    """A change of volume without stress that fields ask for.

    Attributes
    ----------
    where : str
        The zone, or `WHOLE`.
    volume : float
        By which part the volume grows, negative where it shrinks.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change, to first order.
    """

    where: str
    volume: float
    fall: float
    theta: FloatArray


def asked_eigenstrain(test: ScoreTest, variance: float, stretch: FloatArray) -> Eigenstrain | None:
    """Return the change of volume that fields ask for most, None where chance or errors of elements give as much.

    Parameters
    ----------
    test : ScoreTest
        Of the best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    """
    model = test.at.model
    tried = {name: cells for name, cells in materials_of(model.zones).items() if cells.any()}
    materials = tuple(tried.values())
    if model.mesh.dimension != 3 or not test.errors.any() or len(tried) > MOST_MATERIALS:
        return None
    if len(tried) > 1:
        tried[WHOLE] = np.ones(model.computed.n_cells, dtype=bool)
    possible: dict[str, Asked | None] = {}
    for name, cells in tried.items():
        grown = _grown(test.at, cells)
        asked = test.of_residuals([np.asarray(o.operator @ moved) for o, moved in zip(model.observed, grown, strict=True)])
        possible[name] = None if asked is None or _held_back(test.at, materials, cells, grown, asked.part) else asked
    best = most_asked(possible, variance)
    return None if best is None else Eigenstrain(best[0], best[1].part, best[1].fall, best[1].shift(stretch))


def judged_eigenstrain(judged: Verdict, found: Eigenstrain | None, zones: Zones, theta: FloatArray, explained: float) -> Verdict:
    """Return the verdict with a volume that changes by itself, where moduli would change by much or residuals are more than noise.

    It is the first reason where chi squared falls with it by more than `explained`, and another law is none then; the last one otherwise.
    """
    if found is None:
        return judged
    changes = told_shift(zones, theta, found.theta)
    first = found.fall > explained
    if not changes and (judged.explanation is Explanation.EXPLAINED or not first):
        return judged
    would = f": without that, Young's modulus would be another one: {changes}" if changes else ""
    why = (
        f"{found.where} {BY_ITSELF}, by some {100.0 * found.volume:+.2g} %, as by uptake of water, drying, growth or temperature, or "
        f"lengths of the two scans differ in scale: measure with the same volume and scale{would}"
    )
    return blamed(judged, why, first=first)


def _grown(at: Linearised, cells: BoolArray) -> list[FloatArray]:
    """Return what a growth of the volume of cells (m,) by the whole of it changes of the displacement (3 n,) of every load case."""
    model = at.model
    lame, shear = (np.where(cells, moduli, 0.0) for moduli in moduli_of(model.zones, at.point.theta))
    grown = (model.points / 3.0).ravel()
    right = []
    for o, u in zip(model.observed, at.point.states, strict=True):
        force = np.asarray(model.law.stiffness(lame, shear, u) @ grown)
        force[o.loaded] = 0.0
        right.append(force[:, None])
    return [moved[:, 0] for moved in at.solved(right)]


def _held_back(at: Linearised, materials: Sequence[BoolArray], cells: BoolArray, grown: list[FloatArray], part: float) -> bool:
    """Return whether `part`, by which cells (m,) grow, raises the pressure in one of the materials (m,) by more than its shear modulus."""
    mesh = at.model.computed
    volumes = signed_volumes(mesh)
    lame, shear = moduli_of(at.model.zones, at.point.theta)

    def grow(steps: Sequence[FloatArray]) -> FloatArray:
        """Return the mean growth (m,) of cells under displacements (n, 3) of the load cases, times their volume at rest."""
        return np.asarray(np.mean([signed_volumes(replace(mesh, points=mesh.points + u)) for u in steps], axis=0) - volumes)

    before = grow(at.point.states)
    further = grow([u + SMALL * more.reshape(-1, 3) for u, more in zip(at.point.states, grown, strict=True)]) - before
    after = before + part * (further / SMALL - np.where(cells, volumes, 0.0))
    for there in materials:
        of_all = volumes[there].sum()
        ratio = np.average((lame / shear)[there], weights=volumes[there]) + 2.0 / 3.0
        if abs(after[there].sum()) - abs(before[there].sum()) > of_all * max(1.0 / ratio, SECOND_ORDER * abs(part)):
            return True
    return False
