"""Other readings of the vectors of a field: reversed, standing where points came to lie, or both, as of scans that were exchanged.

Small strain tells none of them: reversed, a field is that of the same body under reversed loads. At finite strain the parts of the
displacement that are of second order keep their sign. Moduli and the motion of the surface are therefore refitted to every reading, and
misfits compared. Residuals alone do not tell: vectors of a body that is pulled, placed where points came to lie, were explained by a
modulus a third too high. Nor do derivatives at the fit of the fields as they are: in a body that is pressed by an eighth they found no sign
of that, where the refit leaves half as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.core.progress import report_progress
from naibu.identification.from_fields.assumptions.assumed_law import LEAST_STRAIN, OF_LAW, largest_strain, told_shift
from naibu.identification.from_fields.assumptions.volume_change import mean_gradients
from naibu.identification.from_fields.forward.forward_model import Observed, whitening
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Point
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, fitted_near
from naibu.identification.verdict import Verdict
from naibu.meshing.point_location import locate

DECISIVE = 25.0  # of twice the logarithm of a ratio of likelihoods: five standard deviations of a normal score
ALIKE = 36.0  # the same of readings that may be right as well: what another law explains is only known roughly
LEAST_PART = 0.1  # of what is left beyond noise, that a likelier reading must explain: errors of cells look like less of it
PROBES = 32  # random signs that estimate how much of the noise a surface follows: of a thousand components to one hundredth
REVERSED, PLACED_LATER = "all displacements reversed", "displacements that stand where points came to lie"
EXCHANGED = "the reference and the deformed scan exchanged"
READINGS = {REVERSED: (0.0, -1.0), PLACED_LATER: (-1.0, 1.0), EXCHANGED: (1.0, -1.0)}  # vectors that are added to points, and their sign
MOST_LOST = 0.4  # of the points, that another reading may put outside of the body: where it puts more there it is none
ON_SURFACE = 1e-6  # mm
CHECK = (
    "the fields fit far better with {}{}: check signs, and that vectors stand at points of the reference scan and lead to the deformed one"
)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Another reading of all fields.

    Attributes
    ----------
    text : str
        In words.
    theta : ndarray, shape (2 count,)
        By how much it would change ln mu and ln(kappa / mu) of the zones.
    gain : float
        Twice the logarithm of its likelihood over that of the fields as they are, or of small strain or another law if that is more: a
        field that was computed at small strain lies half-way to the reversed one.
    part : float
        Of what these leave beyond noise, that it explains.
    beyond_elements : bool
        Whether it explains more of what is left on the mesh than elements of half the size do: what it changes is part of the intervals.
    far_beyond : bool
        Whether it explains far more (`far_beyond`), so that it is named.
    """

    text: str
    theta: FloatArray
    gain: float
    part: float = 1.0
    beyond_elements: bool = True
    far_beyond: bool = True

    @property
    def likelier(self) -> bool:
        """Whether the reading fits far better than the fields as they are."""
        return self.gain > DECISIVE and self.part >= LEAST_PART and self.beyond_elements


def other_readings(
    model: FieldModel, best: Point, of_law: float, of_elements: float, variance: float, bounds: Bounds
) -> tuple[Reading, ...]:
    """Return the readings of fields of a body in space; none where small strain was assumed, or is so small that it changes nothing.

    Parameters
    ----------
    model : FieldModel
    best : Point
        The best fit of the fields as they are.
    of_law : float
        By how much chi squared falls with the shape of the law free, a border that slides, or another place of the free surface.
    of_elements : float
        By how much it falls with elements of half the size, if these leave no more than noise: with coarse ones about a small loaded
        hole a true field looked exchanged.
    variance : float
        Of whitened residuals over that stated, errors that neighbours share counted.
    bounds : Bounds
        Of the moduli.
    """
    if model.law.linear or largest_strain(model, best.states) < LEAST_STRAIN:
        return ()
    small = fitted_near(model.with_law("linear"), best.theta, best.states, bounds)
    otherwise = 0.0 if small is None else small.misfit - best.misfit
    other_law, out = min(0.0, otherwise, -of_law), []
    before = _excess_of_points(model, best)
    for text, (shift, sign) in READINGS.items():
        report_progress(model.progress, f"comparing with {text}")
        moved = [_placed(model.mesh, o, u, shift, sign) for o, u in zip(model.observed, best.states, strict=True)]
        if any(kept.mean() < 1.0 - MOST_LOST for _, kept in moved):
            continue
        other = _measured_as(model, [field for field, _ in moved])
        found = fitted_near(other, best.theta, [sign * u for u in best.states], bounds)
        if found is None:
            continue
        left = other_law + sum(float(excess[kept].sum()) for excess, (_, kept) in zip(before, moved, strict=True))
        fall = left - sum(float(excess.sum()) for excess in _excess_of_points(other, found))
        more, far = fall - other_law > of_elements, far_beyond(fall - other_law, of_elements, variance)
        out.append(Reading(text, found.theta - best.theta, fall / variance, fall / max(left, abs(fall), 1e-300), more, far))
    return tuple(out)


def far_beyond(fall: float, of_elements: float, variance: float) -> bool:
    """Return whether chi squared falls by far more than with elements of half the size, where these leave no more than noise.

    Their error is known to first order only: about a hole whose wall was pulled a true field looked exchanged, for a third more than that.
    """
    return fall - of_elements > (DECISIVE * variance if of_elements > 0.0 else 0.0)


def likelier(found: Sequence[Reading]) -> tuple[Reading, ...]:
    """Return the readings that fit far better than the fields as they are, and about as well as the best of them, the best first."""
    better = [one for one in found if one.likelier]
    best = max((one.gain for one in better), default=0.0)
    return tuple(sorted((one for one in better if one.gain > best - DECISIVE), key=lambda one: -one.gain))


def covariance_of_readings(found: Sequence[Reading], size: int) -> FloatArray:
    """Return what readings that are likelier leave in doubt of logarithms (size, size): by as much as these change them."""
    return np.asarray(sum((np.outer(one.theta, one.theta) for one in likelier(found)), np.zeros((size, size))))


def judged_readings(judged: Verdict, found: Sequence[Reading], zones: Zones, theta: FloatArray) -> Verdict:
    """Return the verdict with the readings that fit far better than the fields as they are first, and in a note those that fit as well."""
    alike = [one.text for one in found if one.gain >= -ALIKE and not (one.likelier and one.far_beyond)]
    if alike:
        told = f"The fields would fit as well with {' or '.join(alike)}: that they are neither is taken for given."
        judged = replace(judged, notes=(*judged.notes, told.replace("neither", "not") if len(alike) == 1 else told))
    better = [one for one in likelier(found) if one.far_beyond]
    if not better:
        return judged
    texts = " or ".join(f"{one.text} (chi squared falls by {one.gain:.3g})" for one in better)
    changes = told_shift(zones, theta, better[0].theta)
    why = CHECK.format(texts, f", which would make Young's modulus another one ({changes})" if changes else "")
    reasons = (reason for reason in judged.reasons if not reason.startswith(OF_LAW))  # this explains more than another law
    return replace(judged, reasons=tuple(reasons)).in_part(why)


def _excess_of_points(model: FieldModel, point: Point) -> list[FloatArray]:
    """Return by how much chi squared of every point (k,) of the load cases exceeds what noise alone leaves.

    The surface follows some of the noise, the more the fewer points there are near it: by random signs (:cite:p:`bekas2007`). The weak
    prior on its motion says nothing of readings, which differ in strain.
    """
    at = model.linearised(model.evaluate(point.theta, point.states))
    rng = np.random.default_rng(2)
    signs = [rng.choice([-1.0, 1.0], size=(len(o.data), PROBES)) for o in model.observed]
    pulled = at.adjoint([o.operator.T @ z for o, z in zip(model.observed, signs, strict=True)])[1]
    moved = at.forward(None, at.loaded_solved(pulled))
    out = []
    for t, (o, u, z) in enumerate(zip(model.observed, moved, signs, strict=True)):
        free = ((z - np.asarray(o.operator @ u)) ** 2).mean(axis=1)
        out.append((o.residual(point.states[t]) ** 2 - free).reshape(-1, o.load_case.field.points.shape[1]).sum(axis=1))
    return out


def _measured_as(model: FieldModel, fields: Sequence[DisplacementField]) -> FieldModel:
    """Return the model of other measurements at about the same points, with solvers, and for a beginning preconditioners, of a model."""
    out, n = copy(model), model.mesh.n_points  # the first nodes are those of the mesh
    before = [replace(o.load_case, loaded=o.load_case.loaded[:n], external_force=o.load_case.external_force[:n]) for o in model.observed]
    cases = [replace(case, field=field) for case, field in zip(before, fields, strict=True)]
    out.observed = tuple(Observed.of(model.mesh, model.computed, case) for case in cases)
    out.boundary = model.boundary.copied()
    return out


def _placed(mesh: Mesh, o: Observed, u: FloatArray, shift: float, sign: float) -> tuple[DisplacementField, BoolArray]:
    """Return a field as another reading has it, of the points (k,) that it keeps within the body.

    Noise n moves the points as well: with the deformation gradient F of the reading, a vector misses the displacement at its point by F n.
    """
    field = o.load_case.field
    points, vectors = field.points[field.valid], field.vectors[field.valid]
    whiten = whitening(field, o.load_case.name)[0]
    covariance = np.linalg.inv(whiten @ whiten)
    if shift:
        gradient = mean_gradients(mesh, u)[0][locate(mesh, points, tolerance_mm=np.inf).cells]
        deformed = np.linalg.inv(np.eye(3) + shift * gradient)
        covariance = deformed @ covariance @ np.swapaxes(deformed, 1, 2)
        points = points + shift * vectors
    kept = np.asarray(locate(mesh, points, tolerance_mm=np.inf).distance_mm <= ON_SURFACE)
    return DisplacementField.from_arrays(points[kept], sign * vectors[kept], covariance=covariance[kept]), kept
