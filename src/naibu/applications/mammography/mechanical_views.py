"""A breast from the outlines of its two views by the mechanical model: its unloaded shape and both equilibria."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.applications.mammography.breast_outline import BreastOutline
from naibu.applications.mammography.breast_shape import BreastShape, shape_from_widths
from naibu.applications.mammography.mechanical_model import (
    DEFAULT_MECHANICS,
    MechanicalCompression,
    MechanicalParameters,
    compressed_levels,
    mechanically_compressed,
    smoothed,
)
from naibu.applications.mammography.two_views import TwoViews, two_views
from naibu.core.arrays import FloatArray

_ROUNDS = 2
_MOST_CHANGE = 1.25  # of a width in one round
_TIP = 0.92  # part of the depth from which on widths are corrected as there
_Path = tuple[tuple[float, FloatArray], ...]


def mechanical_views(
    cc: BreastOutline,
    mlo: BreastOutline,
    thickness_mm: tuple[float, float],
    angle_deg: float,
    parameters: MechanicalParameters = DEFAULT_MECHANICS,
    *,
    rounds: int = _ROUNDS,
) -> TwoViews:
    """Find the unloaded breast whose equilibria between the plates have the outlines of both views.

    It starts from the shape of the geometric model, whose widths at each distance from the chest wall are corrected by the ratio of the
    outlines' widths to those of the equilibria, a few times; what is left is taken by scaling the equilibria onto the outlines.

    Parameters
    ----------
    cc, mlo : BreastOutline
        Outlines.
    thickness_mm : (float, float)
        Distances of the plates in CC and MLO.
    angle_deg : float
        Positioner angle of MLO against CC.
    parameters : MechanicalParameters
        Tissue, skin, plates, weight.
    rounds : int
        Number of corrections.

    Raises
    ------
    InputError
        What `two_views` refuses, or plates farther apart than the breast is thick.
    ConvergenceError
        No equilibrium was found.
    """
    outlines, angles = (cc, mlo), (0.0, angle_deg)
    shape = two_views(cc, mlo, thickness_mm, angle_deg).shape
    states = _pressed(shape, angles, thickness_mm, parameters, ((), ()))
    for _ in range(rounds):
        shape = _corrected(shape, angles, outlines, states)
        states = _pressed(shape, angles, thickness_mm, parameters, (states[0].path, states[1].path))
    whole = max(o.depth_mm / s.extents()[2] for o, s in zip(outlines, states, strict=True))
    final = [_onto(state, outline, whole) for state, outline in zip(states, outlines, strict=True)]
    return TwoViews(final[0].shape, final[0], final[1])


def _pressed(
    shape: BreastShape,
    angles: tuple[float, float],
    thickness_mm: tuple[float, float],
    parameters: MechanicalParameters,
    starts: tuple[_Path, _Path],
) -> tuple[MechanicalCompression, MechanicalCompression]:
    found = [mechanically_compressed(shape, a, t, parameters, start=s) for a, t, s in zip(angles, thickness_mm, starts, strict=True)]
    return found[0], found[1]


def _corrected(
    shape: BreastShape,
    angles: tuple[float, float],
    outlines: tuple[BreastOutline, BreastOutline],
    states: tuple[MechanicalCompression, MechanicalCompression],
) -> BreastShape:
    """Return the shape with widths and depth changed by what the outlines differ from the equilibria."""
    reached = [state.extents() for state in states]
    whole = max(o.depth_mm / r[2] for o, r in zip(outlines, reached, strict=True))
    parts = shape.depths / shape.depth_mm
    widths: list[FloatArray] = []
    for angle, outline, (low, high, depth) in zip(angles, outlines, reached, strict=True):
        centres, squares = shape.in_view(angle, shape.depths)
        wanted_low, wanted_high = _seen(outline, whole * depth, compressed_levels())
        tip = int(np.searchsorted(compressed_levels(), _TIP))
        ratio = np.clip((wanted_high - wanted_low)[: tip + 1] / (high - low)[: tip + 1], 1.0 / _MOST_CHANGE, _MOST_CHANGE)
        ratio = smoothed(np.append(ratio, np.full(len(low) - tip - 1, ratio[-1])))
        half = np.sqrt(squares[:, 0]) * np.interp(parts, compressed_levels(), ratio)
        shift = smoothed(0.5 * (wanted_low + wanted_high - low - high))
        middle = centres[:, 0] + np.interp(parts, compressed_levels(), shift)
        widths.append(np.column_stack([middle - half, middle + half]))
    return shape_from_widths(whole * shape.depths, widths[0], widths[1], angles[1])


def _seen(outline: BreastOutline, depth_mm: float, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the outline's ends at parts of a depth that is that of the outline and of the tissue its image does not reach."""
    at = depth_mm * levels - (depth_mm - outline.depth_mm)
    return np.interp(at, outline.depths, outline.low), np.interp(at, outline.depths, outline.high)


def onto_widths(state: MechanicalCompression, outline: BreastOutline) -> MechanicalCompression:
    """Return an equilibrium that is scaled and shifted along the chest wall onto the widths of an outline.

    The depth stays: what the image does not reach at the chest wall is the difference of the depths.
    """
    depth = state.extents()[2]
    low, high = _seen(outline, depth, compressed_levels())
    return replace(state.with_outline(depth, low, high), hidden_mm=depth - outline.depth_mm)


def _onto(state: MechanicalCompression, outline: BreastOutline, whole: float) -> MechanicalCompression:
    depth = whole * state.extents()[2]
    low, high = _seen(outline, depth, compressed_levels())
    return replace(state.with_outline(depth, low, high), hidden_mm=depth - outline.depth_mm).from_nipple()
