"""Other readings of the vectors of a field: all of them reversed, or standing where points came to lie.

Small strain tells neither: reversed, a field is that of the same body under reversed loads. At finite strain the parts of the
displacement that are of second order keep their sign. To first order in these, a field whose vectors are reversed leaves as much less or
more as small strain does in comparison with the law, twice; and one whose vectors stand at the points of the loaded body leaves what the
vectors are apart there. Moduli and the motion of the loaded nodes are refitted to either, and misfits compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.identification.from_fields.assumptions.assumed_law import LEAST_STRAIN, largest_strain
from naibu.identification.from_fields.forward.field_laws import field_law
from naibu.identification.from_fields.forward.forward_model import Observed, Solvers, equilibrium, whitening
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised, moduli_of
from naibu.identification.from_fields.mesh_error import Refit, refitted
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.point_location import locate

DECISIVE = 16.0  # of twice the logarithm of a ratio of likelihoods: four standard deviations of a normal score
ALIKE = 36.0  # the same of readings that may be right as well: changes are of first order, and found from a fit that is not theirs
REVERSED, PLACED_LATER = "all displacements reversed", "displacements that stand where points came to lie"

CHECK = "the fields fit far better with {}: check signs, and that vectors stand at points of the reference scan"


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Another reading of all fields.

    Attributes
    ----------
    text : str
        In words.
    theta : ndarray, shape (2 count,)
        By how much it would change ln mu and ln(kappa / mu) of the zones, to first order.
    gain : float
        Twice the logarithm of its likelihood over that of the fields as they are, or of small strain if that is more: a field that was
        computed at small strain lies half-way to the reversed one.
    """

    text: str
    theta: FloatArray
    gain: float


def other_readings(at: Linearised, quadratic: Concentrated, variance: float) -> tuple[Reading, ...]:
    """Return the readings of fields of a body in space; none where small strain was assumed, or is so small that it changes nothing.

    Parameters
    ----------
    at, quadratic : Linearised, Concentrated
        At the best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    """
    model = at.model
    if model.law.linear or largest_strain(model, at.point.states) < LEAST_STRAIN:
        return ()
    straight = _of_small_strain(at)
    if straight is None:
        return ()
    given, small, *others = [
        refitted(at, quadratic, changes)
        for changes in ([np.zeros_like(c) for c in straight], straight, [2.0 * c for c in straight], _of_placed_later(at))
    ]
    before = min(_misfit(at, given), _misfit(at, small))
    pairs = zip((REVERSED, PLACED_LATER), others, strict=True)
    return tuple(Reading(text, refit.theta - given.theta, (before - _misfit(at, refit)) / variance) for text, refit in pairs)


def judged_readings(judged: Verdict, found: Sequence[Reading]) -> Verdict:
    """Return the verdict with the readings that fit better than the fields as they are, and in a note those that fit as well."""
    better = [f"{one.text} (chi squared falls by {one.gain:.3g})" for one in found if one.gain > DECISIVE]
    alike = [one.text for one in found if -ALIKE <= one.gain <= DECISIVE]
    if alike:
        told = f"The fields would fit as well with {' or '.join(alike)}: that they are neither is taken for given."
        judged = replace(judged, notes=(*judged.notes, told.replace("neither", "not") if len(alike) == 1 else told))
    if not better:
        return judged
    part = Explanation.IN_PART if judged.explanation is Explanation.EXPLAINED else judged.explanation
    return replace(judged, explanation=part, reasons=(CHECK.format(" or ".join(better)), *judged.reasons))


def _of_small_strain(at: Linearised) -> list[FloatArray] | None:
    """Return by how much whitened residuals (q,) change, the loaded nodes moving as they do; None without equilibrium at small strain."""
    model = at.model
    law = field_law(model.computed, "linear", averaged=model.averaged)
    lame, shear = moduli_of(model.zones, at.point.theta)
    solvers, out = Solvers(law, model.points), []
    try:
        for o, u in zip(model.observed, at.point.states, strict=True):
            state, _ = equilibrium(law, solvers, lame, shear, o.load_case, u, b"")
            out.append(np.asarray(o.operator @ (state - u).ravel()))
    except ConvergenceError:
        return None
    return out


def _of_placed_later(at: Linearised) -> list[FloatArray]:
    """Return by how much whitened residuals (q,) change where vectors belong to the points from which they lead; none from outside."""
    return [_moved_back(at, o, u) for o, u in zip(at.model.observed, at.point.states, strict=True)]


def _moved_back(at: Linearised, o: Observed, u: FloatArray) -> FloatArray:
    field = o.load_case.field
    points, vectors = field.points[field.valid], field.vectors[field.valid]
    mesh = at.model.computed
    here, there = (locate(mesh, p, tolerance_mm=np.inf) for p in (points, points - vectors))
    rows = np.repeat(np.arange(len(points)), here.weights.shape[1])
    change = np.zeros_like(vectors)
    for found, sign in ((there, 1.0), (here, -1.0)):
        shape = (len(points), mesh.n_points)
        change += sign * np.asarray(sp.csr_matrix((found.weights.ravel(), (rows, mesh.cells[found.cells].ravel())), shape=shape) @ u)
    change[there.distance_mm > 0.0] = 0.0
    return np.asarray(np.einsum("nij,nj->ni", whitening(field, o.load_case.name)[0], change).ravel())


def _misfit(at: Linearised, refit: Refit) -> float:
    """Return the misfit with the weak prior on the motion of the loaded nodes."""
    motions = [o.sought(u + moved) for o, u, moved in zip(at.model.observed, at.point.states, refit.moved, strict=True)]
    return refit.misfit + sum(float(b @ (o.prior @ b)) for o, b in zip(at.model.observed, motions, strict=True))
