"""Why a load cannot be followed any further: elements turn inside out, the object finds no rest, or points of contact alternate."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.core.status import Status
from naibu.mechanics.contact.penalty_contact import ContactResponse
from naibu.mechanics.finite_elements.elements import Elements
from naibu.mechanics.finite_strain.newton import Newton, solved

NEARLY_FLAT = 0.1  # of its volume, to which a part of an element is compressed before it turns inside out
MOVED = 0.5  # edges of an element: a body that moves so far without coming to rest has left its equilibrium
ITERATIONS = 12  # of Newton's method, to see whether points of contact alternate


def failure_reason(newton: Newton, u: FloatArray, anchors: tuple[FloatArray, ...], load: float, *, penetrated: bool) -> tuple[Status, str]:
    """Return why no equilibrium was found at a load, and what was seen, in a sentence.

    Parameters
    ----------
    newton : Newton
        The solver that failed.
    u : ndarray, shape (n, 3)
        Displacement at the last equilibrium, mm.
    anchors : tuple of ndarray, shape (p, 3)
        Frictional anchors of the points of every contact there, mm.
    load : float
        Fraction of the load at which it failed.
    penetrated : bool
        Whether there was an equilibrium in which a rigid body penetrates too deeply.
    """
    if newton.rigid_motion:
        return Status.SINGULAR, ""
    if penetrated:
        return Status.PENETRATION, ""
    discrete = newton.problem.assembler.elements
    points = newton.problem.points
    ratio, group = smallest_volume_ratio(discrete, u)
    at = _place((points + u)[np.unique(discrete.connectivity[group])].mean(axis=0))
    seen = f"The most compressed element, near {at}, has at one point {100.0 * ratio:.0f} % of its volume."
    if ratio < NEARLY_FLAT:
        return Status.INVERSION, seen
    if newton.restless is not None:
        way = np.linalg.norm(newton.restless, axis=1)
        edge = (discrete.volume / len(discrete.connectivity)) ** (1.0 / 3.0)
        if way.max() > MOVED * edge:
            node = int(np.argmax(way))
            far = "farther than its own size" if way[node] > np.ptp(points, axis=0).max() else f"by {way[node]:.2g} mm"
            moved = f"Slowed down, the object still moved {far} near {_place((points + u)[node])}, without coming to rest."
            return Status.NO_REST, f"{moved} {seen}"
    alternating, touching = alternating_points(newton, u, anchors, load)
    if alternating:
        return Status.ALTERNATING_CONTACT, f"{alternating} of {touching} points of contact changed in the last iteration. {seen}"
    return Status.STEP_TOO_SMALL, seen


def smallest_volume_ratio(discrete: Elements, u: FloatArray) -> tuple[float, int]:
    """Return the smallest det F at an integration point for the displacement `u` (n, 3), mm, and its group of nodes."""
    f = np.eye(3) + np.einsum("mai,mqaj->mqij", u[discrete.connectivity], discrete.gradients)
    det = np.where(discrete.weights > 0.0, np.linalg.det(f), np.inf)
    group = int(np.argmin(det.min(axis=1)))
    return float(det[group].min()), group


def alternating_points(newton: Newton, u: FloatArray, anchors: tuple[FloatArray, ...], load: float) -> tuple[int, int]:
    """Return how many points of contact change between contact and none, or stick and slip, in the last of some iterations; of how many."""
    before: list[FloatArray] = []
    changed = touching = 0
    for _ in range(ITERATIONS):
        try:
            residual, _, factorization, responses = newton.linearised(u, anchors, load)
            found = newton.line_search(u, -solved(factorization, residual, 1e-2), anchors, load, residual)
        except ConvergenceError:
            break
        now = [_contact_status(response) for response in responses]
        changed = sum(int((a != b).sum()) for a, b in zip(now, before, strict=True)) if before else 0
        touching = sum(int((a > 0).sum()) for a in now)
        if found is None:
            break
        u, before = found[0], now
    return changed, touching


def _contact_status(response: ContactResponse) -> FloatArray:
    """Return 0 where a point is apart from the body, 1 where it sticks, 2 where it slips."""
    slips = np.abs(response.slip_direction).sum(axis=1) > 0.0
    return np.where(response.gap < 0.0, np.where(slips, 2.0, 1.0), 0.0)


def _place(x: FloatArray) -> str:
    return f"({x[0]:.1f}, {x[1]:.1f}, {x[2]:.1f}) mm"
