"""Faces at the front of a cut: the blade went through them, but cells around them still hold all their vertices together.

They stay closed, so that the mesh conforms, and follow its refinement and coarsening until a cut goes on and opens them.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import IntArray

NO_FRONT = np.empty((0, 3), dtype=np.int64)


def followed_front(front: IntArray, refined: bool, nodes: IntArray, ends: IntArray) -> IntArray:
    """Return the faces of a front behind a refinement or a coarsening.

    Parameters
    ----------
    front : ndarray, shape (f, 3)
        Vertices of the faces.
    refined : bool
        Whether edges were bisected, or joined again.
    nodes, ends : ndarray, shapes (v,) and (v, 2)
        Vertices that were made or removed, in their order, and the ends of their edges.
    """
    if not len(front):
        return front
    faces = {tuple(face) for face in front.tolist()}
    known = np.isin(ends, front).all(axis=1) if refined else np.isin(nodes, front)
    if refined:  # edges between vertices that are new themselves
        known |= np.isin(ends, nodes).any(axis=1)
    for z, (p, q) in zip(nodes[known].tolist(), ends[known].tolist(), strict=True):
        if refined:
            for face in [f for f in faces if p in f and q in f]:
                faces.remove(face)
                faces |= {_exchanged(face, p, z), _exchanged(face, q, z)}
        else:
            for face in [f for f in faces if z in f]:
                faces.remove(face)
                if p in face or q in face:  # others lay between the two halves of a cell
                    faces.add(_exchanged(face, z, q if p in face else p))
    return np.array(sorted(faces), dtype=np.int64).reshape(-1, 3)


def _exchanged(face: tuple[int, ...], old: int, new: int) -> tuple[int, ...]:
    return tuple(sorted(new if v == old else v for v in face))
