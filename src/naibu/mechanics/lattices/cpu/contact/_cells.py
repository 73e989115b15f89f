"""Cells of faces that an indenter covers: their mean depth, the covered fraction, and what they exert of multipliers."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.mechanics.contact._geometry_kernels import BOX, CYLINDER

LEAST_SLOPE = 1e-3  # of a gap over a cell
LEAST_FACING = 0.01
# of the width of a cell times what the slope changes by over it: mean gap over that at the point, beside the lowest point of an indenter;
# and by how much earlier a cell begins to be covered than it is, so that it is not so at once
BESIDE, EARLY = 1.0 / 24.0, 1.0 / 16.0
LEAST_REACH = 1e-8  # of the width of a cell: below it the difference of two depths is that of their rounding
NEAR = 0.1  # of the width of a cell that looks at a flat indenter: it has what is as near as that
UPRIGHT = 0.75  # width of the cells of a face that stands upright on an indenter: Gauss points lie nearer to its edge than they are wide


@njit(cache=True, **UNCOUNTED)
def covered(depth, slope, width, curvature):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return mean depth and covered fraction of a cell.

    Depths are taken to be spread evenly over a cell, from what is nearest to the indenter: the lowest point of a sphere where that is
    within the cell, else its corner. A disc as large as the cell has the mean depth under a sphere's lowest point exactly so; elsewhere
    Gauss's rule integrates a part of the curvature itself.
    """
    width *= 1.0 - (1.0 - UPRIGHT) * min(max((slope - 0.7) / 0.3, 0.0), 1.0)
    bend = width * curvature  # what the slope changes by over the cell
    nearer = 0.5 * slope**2 / curvature if slope < 0.5 * bend else width * (0.5 * slope - 0.125 * bend)
    mean = width * bend * (BESIDE + (0.25 / np.pi - BESIDE) * max(0.0, 1.0 - slope / max(bend, 1e-300)))
    half = nearer + mean + EARLY * width * bend + 0.5 * width * LEAST_SLOPE
    depth -= mean + 0.5 * width * LEAST_SLOPE  # nothing where a flat indenter just touches
    if depth >= half:
        return depth, 1.0
    if depth <= -half:
        return 0.0, 0.0
    return (depth + half) ** 2 / (4.0 * half), (depth + half) / (2.0 * half)


@njit(cache=True, **UNCOUNTED)
def facing(slope, curvature):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the fraction of its multiplier that a face bears: hardly any where it stands upright on a flat indenter.

    Nodes at an edge have one multiplier for both sides of the edge, and what presses one side does not press the other.
    """
    return 1.0 if curvature > 0.0 else min(max((1.0 - slope) / 0.3, LEAST_FACING), 1.0)


@njit(cache=True, **UNCOUNTED)
def opposite_side(kind, size, rows, d, across):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return how deep a point at d (3,) lies below the side of an indenter that a face with the normal `across` looks at, and its slope.

    `kind` and `size` are those of the indenter, `rows` the nine components of its axes. Infinite, and 1, of indenters without edges.
    """
    depth, towards = np.inf, 0.0
    if kind != BOX and kind != CYLINDER:
        return depth, 1.0
    side, out = 0.0, 0.0  # distance from the axis of a cylinder, and that times how far the face looks away from there
    for a in range(3):
        along = rows[3 * a] * across[0] + rows[3 * a + 1] * across[1] + rows[3 * a + 2] * across[2]
        place = rows[3 * a] * d[0] + rows[3 * a + 1] * d[1] + rows[3 * a + 2] * d[2]
        if kind == CYLINDER and a < 2:
            side, out = side + place * place, out + place * along
        elif abs(along) > towards:
            depth, towards = size[a if kind == BOX else 1] + (place if along > 0.0 else -place), abs(along)
    if kind == CYLINDER:
        side = np.sqrt(side)
        if -out > towards * side:
            depth, towards = size[0] - side, -out / side
    return depth, np.sqrt(max(1.0 - towards * towards, 0.0))


@njit(cache=True, **UNCOUNTED)
def covered_within(depth, slope, width, curvature, other, other_slope):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return mean depth and covered fraction of a cell, no deeper than below the side that the face looks at."""
    mean, part = covered(depth, slope, width, curvature)
    if mean > 0.0 and other_slope < slope:
        below, under = covered(other, other_slope, width, curvature)
        if below < mean:
            return below, under
    return mean, part


@njit(cache=True, **UNCOUNTED)
def pressed(depth, slope, width, curvature, reach):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return mean depth of a cell, the fraction of its multiplier that it exerts, and how fast its pressure grows with the depth.

    The latter is relative to the foundation. Wherever the indenter is nearer than `reach`, the multiplier over the stiffness of the
    foundation, the sum of both presses: it falls steadily to nothing as the indenter leaves, and derives from a convex potential.
    """
    mean, part = covered(depth, slope, width, curvature)
    borne = facing(slope, curvature)
    if reach <= LEAST_REACH * width:
        return mean, borne * part, part
    whole, steep = covered(depth + borne * reach, slope, width, curvature)
    return mean, (whole - mean) / reach, steep


@njit(cache=True, **UNCOUNTED)
def pressed_by_edge(depth, slope, width, curvature, reach, other, other_slope):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `pressed` does beside an edge of an indenter, whose nearest side may stand upright on the face.

    `other` and `other_slope` are what `opposite_side` returns: a cell that reached into the nearest side deeper than below the other one
    would leap as the nearest side changes, with no solution in between.
    """
    mean, part = covered_within(depth, slope, width, curvature, other, other_slope)
    borne = facing(slope, curvature)
    if reach <= LEAST_REACH * width:
        return mean, borne * part, part
    beyond = other + facing(other_slope, curvature) * reach
    whole, steep = covered_within(depth + borne * reach, slope, width, curvature, beyond, other_slope)
    return mean, (whole - mean) / reach, steep


@njit(cache=True, **UNCOUNTED)
def is_far(gap, width, curvature):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Tell whether an indenter covers nothing of a cell, whatever the slope of the gap."""
    return gap >= 0.5 * width * (1.0 + 0.25 * width * curvature + LEAST_SLOPE)


@njit(cache=True, **UNCOUNTED)
def near_flat(gap, slope, width):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the fraction of a cell that a flat indenter has near, and the fraction of its multiplier that the cell bears with that."""
    fraction = covered(NEAR * (1.0 - slope) * width - gap, slope, width, 0.0)[1]
    return fraction, fraction * facing(slope, 0.0)
