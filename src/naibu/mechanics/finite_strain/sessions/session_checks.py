"""Checks that the sessions of finite elements share: nodes that bodies move, indenters and their motions, and states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_motion import IndenterMotion, indenter_velocities
from naibu.mechanics.contact.rigid_indenters import RigidIndenter


def checked_bodies(constrained: Sequence[ArrayLike], n_points: int, bodies: int) -> tuple[IntArray, ...]:
    """Return the sorted nodes of every rigid body, empty for bodies without nodes up to the number `bodies`.

    Raises
    ------
    InputError
        A node that does not exist, or that belongs to two bodies.
    """
    chosen = tuple(np.unique(np.asarray(nodes, dtype=np.int64)) for nodes in constrained)
    listed = np.concatenate([*chosen, np.zeros(0, np.int64)])
    if len(listed) and (listed.min() < 0 or listed.max() >= n_points):
        raise InputError(f"constrained has nodes from {listed.min()} to {listed.max()}; the mesh has nodes 0 to {n_points - 1}")
    if len(np.unique(listed)) < len(listed):
        raise InputError("constrained has a node that belongs to two bodies; each node moves with one")
    return chosen + tuple(np.zeros(0, np.int64) for _ in range(bodies - len(chosen)))


def dead_load(external_force: ArrayLike | None, points: FloatArray) -> FloatArray:
    """Return a load (n, 3), mN, on the nodes of points (n, 3), mm: None is none, and one force that of every node.

    Raises
    ------
    InputError
        A load of another shape, or that is not finite.
    """
    load = np.asarray(0.0 if external_force is None else external_force, dtype=float)
    try:
        spread = np.broadcast_to(load, points.shape)
    except ValueError as error:
        raise InputError(f"external_force has shape {load.shape}; give one force (3,) or those of all nodes {points.shape}") from error
    if not np.isfinite(load).all():
        raise InputError("external_force has values that are not finite; replace them")
    return spread


def checked_velocities(
    indenters: Sequence[RigidIndenter], motions: Sequence[IndenterMotion], centres: FloatArray, rotations: FloatArray, duration_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return velocities (k, 3), mm/s, and angular velocities (k, 3), rad/s, of indenters with rotations (k, 3, 3) since they were made.

    Raises
    ------
    InputError
        Motions for another number of indenters, or what `indenter_velocities` refuses.
    """
    if len(motions) not in (0, len(indenters)):
        raise InputError(f"motions has {len(motions)} entries for {len(indenters)} indenters; give one for each, or none")
    axes = np.array([i.geometry.axes @ r.T for i, r in zip(indenters, rotations, strict=True)]).reshape(-1, 3, 3)
    along, spin, _ = indenter_velocities(indenters, motions, centres, axes, duration_s)
    return along, spin


def require_state(displacement: FloatArray, anchors: Sequence[FloatArray], points: FloatArray, indenters: Sequence[RigidIndenter]) -> None:
    """Check that a state belongs to a mesh and to its indenters, or to none.

    Raises
    ------
    InputError
        A state of another mesh or of other indenters.
    """
    if displacement.shape != points.shape or len(anchors) not in (0, len(indenters)):
        raise InputError(
            f"state is that of {len(displacement)} nodes and {len(anchors)} indenters; the session has {len(points)} and {len(indenters)}"
        )
