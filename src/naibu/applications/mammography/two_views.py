"""A breast from the outlines of its two views: its unloaded shape and both compressions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.mammography.breast_outline import BreastOutline
from naibu.applications.mammography.breast_shape import BreastShape, shape_from_widths
from naibu.applications.mammography.geometric_model import (
    DEFAULT_PARAMETERS,
    Compression,
    CompressionParameters,
    plate_contact,
    with_growth,
)
from naibu.applications.mammography.pressed_view import PressedView
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

_STEPS = 100
_MOST_DEPTH_RATIO = 1.5
_MOST_VOLUME_RATIO = 2.0
_THINNEST_MM, _THICKEST_MM = 12.0, 250.0
LEAST_ANGLE, MOST_ANGLE = 20.0, 90.0


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """An unloaded breast and its compressions in both views.

    Attributes
    ----------
    shape : BreastShape
        Unloaded; coordinates are laterally and upwards from the nipple, and away from the chest wall.
    cc, mlo : PressedView
        The breast between the plates.
    """

    shape: BreastShape
    cc: PressedView
    mlo: PressedView


def two_views(
    cc: BreastOutline,
    mlo: BreastOutline,
    thickness_mm: tuple[float, float],
    angle_deg: float,
    parameters: tuple[CompressionParameters, CompressionParameters] = (DEFAULT_PARAMETERS, DEFAULT_PARAMETERS),
) -> TwoViews:
    """Find the unloaded breast whose compressions have the outlines of both views.

    The outlines are those of the compressed breast, stretched along the chest wall and away from it. They are scaled back by stretches that
    conserve the volume (or change it by the ratio given), instead of by ten percent in both directions :cite:p:`kita2002`. Outline and
    distance of the plates nearly fix the volume between them, so that both views together determine one
    number: the area grows by a power of
    the thickness lost, with one exponent for both. The two depths of the nipple become their geometric mean.

    Parameters
    ----------
    cc, mlo : BreastOutline
        Outlines.
    thickness_mm : (float, float)
        Distances of the plates in CC and MLO.
    angle_deg : float
        Positioner angle of MLO against CC, 20 to 90.
    parameters : (CompressionParameters, CompressionParameters)
        Of CC and MLO.

    Raises
    ------
    InputError
        An angle or a thickness that cannot be, plates farther apart than the breast is thick, outlines that do not fit together.
    """
    if not LEAST_ANGLE <= angle_deg <= MOST_ANGLE:
        raise InputError(
            f"angle_deg is {angle_deg:g}: must be between {LEAST_ANGLE:g} and {MOST_ANGLE:g}, the positioner angle of MLO against CC"
        )
    for value in thickness_mm:
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"thickness_mm is {value:g}: must be greater than 0")
        if not _THINNEST_MM <= value <= _THICKEST_MM:
            raise InputError(
                f"thickness_mm is {value:g}: plates press a breast to {_THINNEST_MM:g} to {_THICKEST_MM:g} mm. Is the distance in mm?"
            )
    depth_ratio = mlo.depth_mm / cc.depth_mm
    if not 1.0 / _MOST_DEPTH_RATIO <= depth_ratio <= _MOST_DEPTH_RATIO:
        raise InputError(
            f"the nipple is {cc.depth_mm:.4g} mm from the chest wall in CC and {mlo.depth_mm:.4g} mm in MLO: "
            f"they do not belong to one breast, "
            "or the outlines have different units"
        )
    angles = (0.0, angle_deg)
    mean_growth, weights, slope = 0.2, np.ones(2), -2.0
    before: tuple[float, float] | None = None
    for _ in range(_STEPS):
        growth = [float(np.exp(mean_growth * w)) for w in weights]
        shape, states = _unloaded((cc, mlo), angles, thickness_mm, growth, parameters)
        contacts = [plate_contact(shape, a) for a in angles]
        _require_pressed(contacts, thickness_mm)
        pressed = np.array([np.log((high - low) / t) for (low, high), t in zip(contacts, thickness_mm, strict=True)])
        weights = pressed / pressed.mean()
        volumes = [s.volume_mm3() / p.volume_ratio for s, p in zip(states, parameters, strict=True)]
        excess = float(np.log(shape.volume_mm3 / np.sqrt(volumes[0] * volumes[1])))
        if abs(excess) < 1e-4:
            break
        if before is not None and abs(mean_growth - before[0]) > 1e-9:
            slope = float(np.clip((excess - before[1]) / (mean_growth - before[0]), -5.0, -0.7))  # secant
        before = mean_growth, excess
        mean_growth += float(np.clip(-excess / slope, -0.3, 0.3))
    else:
        raise InputError(f"thickness_mm {thickness_mm[0]:g} and {thickness_mm[1]:g}: no breast with these outlines keeps its volume")
    if not 1.0 / _MOST_VOLUME_RATIO <= volumes[0] / volumes[1] <= _MOST_VOLUME_RATIO:
        raise InputError(
            f"the breast has {1e-3 * volumes[0]:.4g} cm^3 between the plates in CC and {1e-3 * volumes[1]:.4g} "
            f"cm^3 in MLO: check the outlines, "
            "their units and thickness_mm"
        )
    return TwoViews(shape, *states)


def _require_pressed(contacts: list[tuple[float, float]], thickness_mm: tuple[float, float]) -> None:
    for name, (low, high), thickness in zip(("CC", "MLO"), contacts, thickness_mm, strict=True):
        if thickness >= high - low:
            raise InputError(
                f"thickness_mm is {thickness:g} in {name}, and by the other view's outline the unloaded breast "
                f"is {high - low:.4g} mm thick there: "
                "the plates' distance must be below that"
            )


def _unloaded(
    outlines: tuple[BreastOutline, BreastOutline],
    angles: tuple[float, float],
    thickness_mm: tuple[float, float],
    growth: list[float],
    parameters: tuple[CompressionParameters, CompressionParameters],
) -> tuple[BreastShape, tuple[Compression, Compression]]:
    """Return the shape that has the outlines when it grows so much, and its compressions."""
    nowhere = BreastShape(np.array([0.0, 1.0]), np.zeros((2, 2)), np.ones((2, 3)))
    plain = [with_growth(nowhere, a, t, g, p) for a, t, g, p in zip(angles, thickness_mm, growth, parameters, strict=True)]
    depth_mm = max(o.depth_mm / s.silhouette[1] for o, s in zip(outlines, plain, strict=True))
    depths = depth_mm * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, len(outlines[0].depths)))
    widths: list[FloatArray] = []
    hidden: list[float] = []
    for outline, state in zip(outlines, plain, strict=True):
        hidden.append(depth_mm * state.silhouette[1] - outline.depth_mm)
        own = (outline.depths + hidden[-1]) / state.silhouette[1]
        both = [np.interp(depths, own, end / state.silhouette[0]) for end in (outline.low, outline.high)]
        widths.append(np.column_stack(both))
    shape = shape_from_widths(depths, widths[0], widths[1], angles[1])
    states = [
        Compression(shape, a, t, p.along, p.away, p.bending, h) for a, t, p, h in zip(angles, thickness_mm, plain, hidden, strict=True)
    ]
    return shape, (states[0], states[1])
