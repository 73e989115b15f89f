"""Where a tool is: a copy of it at another place, where it waits, and the next point on its way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.rigid_indenters import RigidIndenter

THROUGH = 0.5  # of the thinnest half extent of a tool
MOST_RAISED = 40  # steps


def placed(tool: RigidIndenter, centre: FloatArray, rotation: FloatArray | None = None) -> RigidIndenter:
    """Return a tool at another place (3,), mm, rotated (3, 3) since it was made."""
    turned = tool.geometry if rotation is None else replace(tool.geometry, axes=tool.geometry.axes @ rotation.T)
    return replace(tool, geometry=turned, centre=centre)


def towards(start: FloatArray, target: FloatArray, reach: float) -> FloatArray:
    """Return the point on the way to a target that is at most `reach` away from the start."""
    way = target - start
    length = float(np.linalg.norm(way))
    return np.asarray(target if length <= reach else start + way * (reach / length), dtype=float)


def waiting_place(tool: RigidIndenter, positions: FloatArray, step_mm: float) -> FloatArray:
    """Return where a tool waits (3,), mm: where it was made, raised by steps until it is clear of the surface at positions (n, 3), mm."""
    centre = np.array(tool.centre, dtype=float)
    for _ in range(MOST_RAISED):
        if placed(tool, centre).gap(positions).min() > 0.0:
            break
        centre[2] += step_mm
    return centre


def farthest_in_a_step(tool: RigidIndenter) -> float:
    """Return how far a tool may move in a step, mm, so that nothing passes through its middle."""
    size = np.asarray(tool.geometry.size)
    return THROUGH * float(size[size > 0.0].min(initial=np.inf))
