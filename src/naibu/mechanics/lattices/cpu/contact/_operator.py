"""What contact adds to the matrix of an implicit step: a symmetric block for each face that indenters touch, and its diagonal.

An operator is a tuple: nodes of the faces (f, 4); their blocks (f, 12, 16), kg, in double and in single precision, with the components of
a node together and zeros behind them; nodes of these faces (c,) and what their inverse diagonal blocks add to the scalar one (c, 3, 3);
how many faces and nodes there are; and room for the components of a face, (16,), in double and in single precision. It is empty where
nothing is touched.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, aligned, load, splat, store
from naibu.core.arrays import AnyArray

FACES, NODES = range(2)
ROOM, ROUGH_ROOM = 6, 7  # places in an operator

Operator = tuple[AnyArray, ...]


def new_operator(faces: int, nodes: int) -> Operator:
    """Return an operator with room for so many faces and nodes, empty."""
    return (
        np.zeros((faces, 4), np.int64), aligned((faces, 12, 16), float), aligned((faces, 12, 16), np.float32), np.zeros(nodes, np.int64),
        np.zeros((nodes, 3, 3), np.float32), np.zeros(2, np.int64), aligned((16,), float), aligned((16,), np.float32),
    )  # fmt: skip


@njit(cache=True, fastmath={"contract", "nsz"}, **UNCOUNTED)
def add_contact(corners, blocks, count, sign, p, rows, nodes, room):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add `sign` times what the blocks of `count` faces give for p (3 pad,), and return p times that; `room` (16,) is scratch.

    It is added to the row of `rows` (parts, 3 pad) of the part that has a node; those of part c begin at `nodes[c]`. Blocks are symmetric:
    their rows are taken for columns, eight numbers at a time.
    """
    pad, energy = len(p) // 3, p.dtype.type(0.0)
    factor = p.dtype.type(sign)
    for f in range(count):
        block = blocks[f]
        low, high = splat(p.dtype.type(0.0)), splat(p.dtype.type(0.0))
        for k in range(4):
            i = corners[f, k]
            for a in range(3):
                row, along = block[3 * k + a], splat(p[a * pad + i])
                low, high = low + along * load(row, 0), high + along * load(row, WIDTH)
        store(room, 0, low)
        store(room, WIDTH, high)
        for k in range(4):
            i, c = corners[f, k], 0
            while c + 1 < len(rows) and i >= nodes[c + 1]:
                c += 1
            for a in range(3):
                s = room[3 * k + a]
                energy += p[a * pad + i] * s
                rows[c, a * pad + i] += factor * s
    return sign * float(energy)


@njit(cache=True)
def extra_energy(nodes, inverse, count, r):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return r times what the inverse diagonal blocks of touched nodes add to the preconditioned r (3 pad,)."""
    pad, energy = len(r) // 3, 0.0
    for c in range(count):
        i = nodes[c]
        for a in range(3):
            for b in range(3):
                energy += r[a * pad + i] * inverse[c, a, b] * r[b * pad + i]
    return energy


@njit(cache=True)
def add_preconditioned(nodes, inverse, count, r, p):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to p (3 pad,) what the inverse diagonal blocks of touched nodes add to the preconditioned r."""
    pad = len(r) // 3
    for c in range(count):
        i = nodes[c]
        for a in range(3):
            for b in range(3):
                p[a * pad + i] += inverse[c, a, b] * r[b * pad + i]


@njit(cache=True, **UNCOUNTED)
def close_operator(operator, smoother, slot, diagonal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Gather the nodes of the faces of an operator and invert their diagonal blocks.

    `smoother` (pad,) is the inverse diagonal without contact, `slot` (pad,) holds -1 and is left so, `diagonal` (c, 3, 3) is scratch.
    """
    corners, blocks, rough, nodes, inverse, counts, _, _ = operator
    found = 0
    for f in range(counts[FACES]):
        for k in range(12):  # one by one: the first assignment of arrays takes Numba a second to compile
            for m in range(12):
                rough[f, k, m] = blocks[f, k, m]
        for k in range(4):
            i = corners[f, k]
            if slot[i] < 0:
                slot[i] = found
                nodes[found] = i
                diagonal[found] = 0.0
                found += 1
        for k in range(4):
            for m in range(4):
                if corners[f, k] == corners[f, m]:
                    for a in range(3):
                        for b in range(3):
                            diagonal[slot[corners[f, k]], a, b] += blocks[f, 3 * k + a, 3 * m + b]
    counts[NODES] = found
    for c in range(found):
        i = nodes[c]
        slot[i] = -1
        own = 1.0 / smoother[i]
        for a in range(3):
            diagonal[c, a, a] += own
        _invert_symmetric(diagonal[c])
        for a in range(3):
            for b in range(3):
                inverse[c, a, b] = diagonal[c, a, b] - (smoother[i] if a == b else 0.0)


@njit(cache=True)
def _invert_symmetric(m):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Invert a symmetric matrix (3, 3) in place."""
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    one = 1.0 / (a * aa + b * ab + c * ac)
    m[0, 0], m[1, 1], m[2, 2] = one * aa, one * (a * f - c * c), one * (a * d - b * b)
    m[0, 1] = m[1, 0] = one * ab
    m[0, 2] = m[2, 0] = one * ac
    m[1, 2] = m[2, 1] = one * (b * c - a * e)
