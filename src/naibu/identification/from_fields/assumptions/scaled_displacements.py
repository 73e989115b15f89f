"""Whether displacements grow or shrink through the body, as those of a body do that creeps or relaxes while a scanner moves along it.

A scan that takes minutes sees one end of the body earlier than the other. If the body yields or recovers meanwhile, its displacements are
scaled along the axis of the scan, which looks like a stiffness that changes along it. To first order, moduli and the motion of the loaded
nodes following, the growth along each axis that fits best is found, and by how much it fits better
(`naibu.identification.from_fields.assumptions.score_test`). Only residuals count: it is assumed that the surface strains little, which
speaks for a growth that takes strain off it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.assumed_law import OF_LAW, told_changes
from naibu.identification.from_fields.assumptions.score_test import ScoreTest, most_asked
from naibu.identification.from_fields.forward.forward_model import Observed, whitening
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.identification.from_fields.uncertainty import Uncertainty, intervals
from naibu.identification.verdict import Verdict
from naibu.meshing.point_location import locate, operator_of

AXES = "xyz"
EXPLAINS = 0.5  # of what residuals are beyond noise: what explains less of it is no first reason
SCALED = "as where a body creeps or relaxes while it is scanned"


@dataclass(frozen=True, slots=True, eq=False)
class Scaling:
    """A growth of displacements along an axis that fields ask for.

    Attributes
    ----------
    axis : int
    growth : float
        By how much displacements differ at the two ends of the body, over those half-way; negative where they shrink along the axis.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change, to first order.
    """

    axis: int
    growth: float
    fall: float
    theta: FloatArray


def asked_scaling(test: ScoreTest, variance: float, stretch: FloatArray) -> Scaling | None:
    """Return the growth along the axis of which fields ask most, None where chance or errors of elements give as much.

    What elements of half the size change of a growth is taken for one standard deviation of what elements leave in it; where that is not
    known, no growth is asked for.

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
    if model.mesh.dimension != 3 or not test.errors.any():
        return None
    each = [_grown(model.computed, o, u) for o, u in zip(model.observed, test.at.point.states, strict=True)]
    best = most_asked({axis: test.of_residuals([change[axis] for change in each]) for axis in range(len(AXES))}, variance)
    return None if best is None else Scaling(best[0], best[1].part, best[1].fall, best[1].shift(stretch))


def unless_explained(found: Scaling | None, judged: Verdict, of_law: float, of_geometry: float) -> Scaling | None:
    """Return the growth; None where chi squared falls as much with another law, which the verdict blames, or with another geometry.

    It falls by `of_law`, and by `of_geometry` with a border that slides or another place of the free surface.
    """
    if found is None or found.fall <= of_geometry:
        return None
    return None if found.fall <= of_law and any(reason.startswith(OF_LAW) for reason in judged.reasons) else found


def judged_scaling(
    judged: Verdict,
    found: Scaling | None,
    zones: Zones,
    theta: FloatArray,
    total: Uncertainty,
    explained: float,
    *,
    coarse: bool = False,
) -> Verdict:
    """Return the verdict with a growth of displacements, where moduli would change by much or leave their intervals without it.

    It is the first reason where chi squared falls with it by more than `explained`, the last one otherwise. Where elements are too `coarse`
    for what half their size changes to be their error, it is none: bones of few cells across looked like a growth by a half.
    """
    if found is None or coarse:
        return judged
    changes = _told(found, zones, theta, total)
    if not changes:
        return judged
    along = f"along {AXES[found.axis]}"
    why = (
        f"displacements {'grow' if found.growth > 0.0 else 'shrink'} by {100.0 * abs(found.growth):.2g} % {along} beyond what moduli "
        f"explain, {SCALED}, or where the scale of displacements or the stiffness within a zone changes {along}: without that, {changes}"
    )
    return judged.in_part(why, first=found.fall > explained)


def _told(found: Scaling, zones: Zones, theta: FloatArray, total: Uncertainty) -> str:
    """Say which moduli would change by much or leave their intervals; empty where none does."""
    (young, poisson), (other, ratio) = young_and_poisson(theta), young_and_poisson(theta + found.theta)
    of_young, of_poisson = intervals(theta, total)
    changes = told_changes(zones, np.log(other / young), beyond=_beyond(of_young, other))
    if changes:
        return f"Young's modulus would be another one: {changes}"
    left = np.flatnonzero(_beyond(of_poisson, ratio))
    if not len(left):
        return ""
    i = int(left[np.argmax(np.abs(ratio - poisson)[left])])
    return f"Poisson's ratio of {zones.names[i]} would be {ratio[i]:.3f}"


def _beyond(bounds: FloatArray, values: FloatArray) -> BoolArray:
    """Return which values (k,) lie outside of their bounds (k, 2)."""
    return np.asarray((values < bounds[:, 0]) | (values > bounds[:, 1]))


def _grown(mesh: Mesh, o: Observed, u: FloatArray) -> FloatArray:
    """Return what a growth by the whole of it along each axis changes of the whitened displacement (3, q) of a state (n, 3), mm."""
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    own = operator_of(mesh, locate(mesh, o.points, tolerance_mm=np.inf)) @ u
    whitened = np.einsum("nij,nj->ni", whitening(o.load_case.field, o.load_case.name)[0], own)
    part = (o.points - low) / (high - low) - 0.5
    return np.stack([(part[:, axis, None] * whitened).ravel() for axis in range(len(AXES))])
