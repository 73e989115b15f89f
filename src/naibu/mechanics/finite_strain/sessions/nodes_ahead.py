"""Nodes that indenters touch or are about to touch, for which the inverse of a tangent is prepared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.lip_assembly import lips_of
from naibu.mechanics.finite_strain.sessions.lips_beside_tangent import lips_about_to_change

AHEAD = 160  # nodes about to be in contact, at most
REACH = 0.2  # extents of the body around an indenter in which they are sought


def nodes_ahead(
    contacts: Sequence[Contact], gaps: Sequence[FloatArray], corners: int, extent_mm: float, assembler: Assembler, displacement: FloatArray
) -> IntArray:
    """Return the nodes in contact, those about to be, the nearest first, and those of lips that are about to open or close.

    Parameters
    ----------
    contacts : sequence of Contact
        Of faces with this number of `corners`.
    gaps : sequence of ndarray, shape (p,)
        Distances of their points from the indenters, mm.
    corners : int
        Nodes of a face.
    extent_mm : float
        Of the body.
    assembler : Assembler
        Its elements, with the lips of cuts.
    displacement : ndarray, shape (n, 3)
        Of its nodes, mm.
    """
    nodes, order = [np.zeros((0, corners), np.int64)], [np.zeros(0)]
    for contact, gap in zip(contacts, gaps, strict=True):
        near = np.flatnonzero(gap < REACH * extent_mm)
        nodes.append(contact.nodes[near])
        order.append(np.maximum(gap[near], 0.0))
    depths = np.concatenate(order)
    ranked = np.concatenate(nodes)[np.argsort(depths, kind="stable")]
    touching = len(np.unique(ranked[: np.count_nonzero(depths == 0.0)]))
    first = ranked.ravel()[np.sort(np.unique(ranked, return_index=True)[1])][: touching + AHEAD]
    lips = [lips_about_to_change(some, displacement) for some in lips_of(assembler)]
    return np.concatenate([first, *lips]).astype(np.int64)
