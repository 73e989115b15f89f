"""Where a tool is: a copy of it at another place, and the next point on its way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.rigid_indenters import RigidIndenter


def placed(tool: RigidIndenter, centre: FloatArray, rotation: FloatArray | None = None) -> RigidIndenter:
    """Return a tool at another place (3,), mm, rotated (3, 3) since it was made."""
    turned = tool.geometry if rotation is None else replace(tool.geometry, axes=tool.geometry.axes @ rotation.T)
    return replace(tool, geometry=turned, centre=centre)


def towards(start: FloatArray, target: FloatArray, reach: float) -> FloatArray:
    """Return the point on the way to a target that is at most `reach` away from the start."""
    way = target - start
    length = float(np.linalg.norm(way))
    return np.asarray(target if length <= reach else start + way * (reach / length), dtype=float)
