"""Kernels of the two-level (coarse) correction of the implicit solver :cite:p:`toselli2005`, with its small dense solve.

`coarse` is the tuple that `lattice_coarse.coarse_space` makes: steps, vectors, further ones, small, weights and memory (see there); its
arrays are empty where an engine does without.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import COUNTED, UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, load, splat, store, total

_FAST = {"contract", "nsz"}
# places in the memory: constrained components known of, inverse in use, work done, and work from which on a new inverse costs little;
# whether there is an inverse with contacts, and the work of the last step in contact
NODES, SLOT, CREDIT, PRICE, TOUCHED, LATEST = range(6)
PLAIN, HELD, CONTACT = range(3)  # inverses: without constrained components, with them, and with contacts too
CHANGED = 0.3  # change of what contacts add, as a fraction of it, from which on an inverse is made anew
FACES_PRICE = 0.125  # iterations that it takes to add a face to the matrix
DEARER = 2.0  # how many times what an inverse costs the iterations of a step have to be, so that no short step takes much longer for it


@njit(cache=True, fastmath=_FAST)
def gather(lanes, sums, values, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the weighted values (3, p) of the sources begin to end to `sums` (3, q)."""
    starts, target, row, table = lanes
    for i in range(begin, end, WIDTH):
        x, y, z = load(values[0], i), load(values[1], i), load(values[2], i)
        for k in range(starts[i // WIDTH], starts[i // WIDTH + 1]):
            w, at = load(table, row[k]), target[k]
            store(sums[0], at, load(sums[0], at) + w * x)
            store(sums[1], at, load(sums[1], at) + w * y)
            store(sums[2], at, load(sums[2], at) + w * z)


@njit(cache=True, fastmath=_FAST)
def _hand_back(lanes, sums, values, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the values (3, p) of the sources begin to end to what the weighted sums (3, q) give: the transpose of `gather`."""
    starts, target, row, table = lanes
    zero = splat(values.dtype.type(0))
    for i in range(begin, end, WIDTH):
        x, y, z = zero, zero, zero
        for k in range(starts[i // WIDTH], starts[i // WIDTH + 1]):
            w, at = load(table, row[k]), target[k]
            x, y, z = x + w * load(sums[0], at), y + w * load(sums[1], at), z + w * load(sums[2], at)
        store(values[0], i, x)
        store(values[1], i, y)
        store(values[2], i, z)


@njit(cache=True, fastmath=_FAST)
def turn_with(lanes, sums, p, r, smoother, beta, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set p (3, pad) of the masses begin to end to smoother r + beta p + what the weighted sums (3, q) give."""
    starts, target, row, table = lanes
    part = splat(beta)
    for i in range(begin, end, WIDTH):
        s = load(smoother, i)
        x = s * load(r[0], i) + part * load(p[0], i)
        y = s * load(r[1], i) + part * load(p[1], i)
        z = s * load(r[2], i) + part * load(p[2], i)
        for k in range(starts[i // WIDTH], starts[i // WIDTH + 1]):
            w, at = load(table, row[k]), target[k]
            x, y, z = x + w * load(sums[0], at), y + w * load(sums[1], at), z + w * load(sums[2], at)
        store(p[0], i, x)
        store(p[1], i, y)
        store(p[2], i, z)


@njit(cache=True, fastmath=_FAST)
def _collect(fraction, sources, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add weighted sources (3, p) to sums (3, q), one by one."""
    target, weight, shift = fraction
    x, y, z, s0, s1, s2 = sources[0, shift:], sources[1, shift:], sources[2, shift:], sums[0], sums[1], sums[2]
    for i in range(len(target)):
        for k in range(target.shape[1]):
            w, at = weight[i, k], target[i, k]
            s0[at] += w * x[i]
            s1[at] += w * y[i]
            s2[at] += w * z[i]


@njit(cache=True, fastmath=_FAST)
def _spread(fraction, sources, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set sources (3, p) to weighted sums (3, q): the transpose of `_collect`."""
    target, weight, shift = fraction
    x, y, z, s0, s1, s2 = sources[0, shift:], sources[1, shift:], sources[2, shift:], sums[0], sums[1], sums[2]
    for i in range(len(target)):
        a, b, c = x.dtype.type(0), x.dtype.type(0), x.dtype.type(0)
        for k in range(target.shape[1]):
            w, at = weight[i, k], target[i, k]
            a, b, c = a + w * s0[at], b + w * s1[at], c + w * s2[at]
        x[i], y[i], z[i] = a, b, c


@njit(cache=True, fastmath=_FAST)
def _times(inverse, right, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set `out` to inverse (l, l) times `right`; l is a multiple of eight."""
    wide = len(inverse)
    for i in range(0, wide, 4):
        a, b, c, d = inverse[i], inverse[i + 1], inverse[i + 2], inverse[i + 3]
        sa = splat(inverse.dtype.type(0))
        sb, sc, sd = sa, sa, sa
        for k in range(0, wide, WIDTH):
            x = load(right, k)
            sa, sb, sc, sd = sa + load(a, k) * x, sb + load(b, k) * x, sc + load(c, k) * x, sd + load(d, k) * x
        out[i], out[i + 1], out[i + 2], out[i + 3] = total(sa), total(sb), total(sc), total(sd)


@njit(cache=True, fastmath=_FAST)
def _to_nodes(steps, vectors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the sums of columns (parts, 3, p), which are cleared, to nodes."""
    _, rows, fraction = steps
    columns, given, lines, right, _ = vectors
    zero = splat(columns.dtype.type(0))
    for axis in range(3):
        for i in range(0, columns.shape[2], WIDTH):
            s = zero
            for part in range(len(columns)):
                s = s + load(columns[part, axis], i)
                store(columns[part, axis], i, zero)
            store(given[axis], i, s)
        for i in range(0, lines.shape[1], WIDTH):
            store(lines[axis], i, zero)
        for i in range(0, right.shape[1], WIDTH):
            store(right[axis], i, zero)
    gather(rows, lines, given, 0, WIDTH * (len(rows[0]) - 1))
    _collect(fraction, lines, right)


@njit(cache=True, fastmath=_FAST)
def _from_nodes(steps, vectors):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take values of nodes to what columns are given back: the transpose of `_to_nodes`."""
    _, given, lines, _, values = vectors
    _spread(steps[2], lines, values)
    _hand_back(steps[1], lines, given, 0, WIDTH * (len(steps[1][0]) - 1))


@njit(cache=True, fastmath=_FAST)
def correct(coarse):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Turn the sums of columns of nodes, of all parts, into what they are to be given back; return the scalar product of the two."""
    steps, vectors, further, small, _, memory = coarse
    scale, inverse = small[1], small[3]
    slot, right, values = memory[2][SLOT], vectors[3], vectors[4]
    _to_nodes(steps, vectors)
    if scale.shape[1]:
        lanes, less = further[0][0], further[1]
        gather(lanes, less[0][0], right, 0, right.shape[1])
        _to_nodes(further[0], less)
        _times(inverse[slot], less[3].reshape(less[3].size), less[4].reshape(less[4].size))
        _from_nodes(further[0], less)
        turn_with(lanes, less[1], values, right, scale[slot], values.dtype.type(0), 0, right.shape[1])
    else:
        _times(inverse[slot], right.reshape(right.size), values.reshape(right.size))
    _from_nodes(steps, vectors)
    return _product(right, values)


@njit(cache=True, fastmath=_FAST)
def _product(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    s = splat(a.dtype.type(0))
    for axis in range(3):
        for i in range(0, a.shape[1], WIDTH):
            s = s + load(a[axis], i) * load(b[axis], i)
    return float(total(s))


@njit(cache=True)
def assemble(elements, directions, stiff, corner, weight, dense, diagonal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the stiffness of elements, as coarse functions see it, to `dense` (3, n, 3, n) and `diagonal` (3, n); either may be empty."""
    node, fraction = np.empty(16, np.int64), np.empty(16)
    for m in range(len(elements)):
        count = 0
        for side in range(2):
            for k in range(8):
                w = weight[elements[m, side], k] * (2 * side - 1.0)
                if w == 0.0:
                    continue
                c, h = corner[elements[m, side], k], 0
                while h < count and node[h] != c:
                    h += 1
                if h == count:
                    node[h], fraction[h] = c, 0.0
                    count += 1
                fraction[h] += w
        for h in range(count):
            for a in range(3):
                along = stiff[m] * fraction[h] * directions[m, a]
                if diagonal.size:
                    diagonal[a, node[h]] += along * fraction[h] * directions[m, a]
                if dense.size:
                    for k in range(count):
                        for b in range(3):
                            dense[a, node[h], b, node[k]] += along * fraction[k] * directions[m, b]


@njit(cache=True)
def add_constrained(constrained, smoother, corner, weight, dense, diagonal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add what it costs that coarse functions do not move constrained components: the diagonal of the matrix there, as `assemble` does."""
    node, direction = constrained[0], constrained[1]
    for h in range(len(node)):
        i = node[h]
        for k in range(8):
            c = corner[i, k]
            for a in range(3):
                along = weight[i, k] * direction[h, a] / smoother[i]
                if diagonal.size:
                    diagonal[a, c] += along * weight[i, k] * direction[h, a]
                if dense.size:
                    for q in range(8):
                        for b in range(3):
                            dense[a, c, b, corner[i, q]] += along * weight[i, q] * direction[h, b]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _invert(a):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Turn a positive definite matrix, whose size is a multiple of eight, into its inverse, by sweeps."""
    n = len(a)
    for k in range(n):
        own = a[k]
        pivot = splat(1.0 / own[k])
        own[k] = 1.0
        for j in range(0, n, WIDTH):
            store(own, j, pivot * load(own, j))
        for i in range(n):
            if i != k:
                other = a[i]
                factor = splat(other[k])
                other[k] = 0.0
                for j in range(0, n, WIDTH):
                    store(other, j, load(other, j) - factor * load(own, j))


@njit(cache=True)
def add_contacts(operator, corner, weight, dense, diagonal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add what contact adds to the matrix, as coarse functions see it, to `dense` (3, n, 3, n) and `diagonal` (3, n), as `assemble` does.

    `operator` are nodes of faces (f, 4), their blocks (f, 12, 16), and how many faces there are.
    """
    corners, blocks, count = operator
    node, fraction, half = np.empty(32, np.int64), np.empty((4, 32)), np.empty((12, 96))
    for f in range(count):
        found = 0
        for c in range(4):
            for k in range(8):
                w = weight[corners[f, c], k]
                if w == 0.0:
                    continue
                at, h = corner[corners[f, c], k], 0
                while h < found and node[h] != at:
                    h += 1
                if h == found:
                    node[h] = at
                    for e in range(4):
                        fraction[e, h] = 0.0
                    found += 1
                fraction[c, h] += w
        block = blocks[f]
        for row in range(12):
            for h in range(found):
                for b in range(3):
                    s = 0.0
                    for e in range(4):
                        s += block[row, 3 * e + b] * fraction[e, h]
                    half[row, 3 * h + b] = s
        for h in range(found):
            for a in range(3):
                for k in range(found if dense.size else 0):
                    for b in range(3):
                        s = 0.0
                        for c in range(4):
                            s += fraction[c, h] * half[3 * c + a, 3 * k + b]
                        dense[a, node[h], b, node[k]] += s
                if diagonal.size:
                    for c in range(4):
                        diagonal[a, node[h]] += fraction[c, h] * half[3 * c + a, 3 * h + a]


@njit(cache=True, **UNCOUNTED)
def _shares(operator, corner, weight, shares):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set `shares` (n,) to what contact adds to the diagonal of the matrix, divided among coarse functions."""
    corners, blocks, count = operator
    shares[:] = 0.0
    for f in range(count):
        for c in range(4):
            own = blocks[f, 3 * c, 3 * c] + blocks[f, 3 * c + 1, 3 * c + 1] + blocks[f, 3 * c + 2, 3 * c + 2]
            for k in range(8):
                shares[corner[corners[f, c], k]] += weight[corners[f, c], k] * own


@njit(cache=True, **COUNTED)
def follow_contacts(coarse, smoother, constrained, operator, work):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make the inverse one that knows what contacts add, anew where these have changed much and that pays.

    It pays where the iterations of this step so far, `work`, or those of the step before are several times what an inverse costs.
    `operator` is as in `add_contacts`.
    """
    corner, weight, (_, _, state, shares) = coarse[4][0], coarse[4][1], coarse[5]
    if not len(state):
        return
    dear = max(work, state[LATEST]) >= DEARER * (state[PRICE] + FACES_PRICE * operator[2])
    if operator[2] == 0 or not (state[TOUCHED] or dear):
        state[SLOT] = HELD if len(constrained[0]) and _knows(coarse[5], constrained) else PLAIN
        return
    _shares(operator, corner, weight, shares[1])
    changed, least = 0.0, 0.0
    for h in range(shares.shape[1]):
        changed += abs(shares[1, h] - shares[0, h])
        least += min(shares[1, h], shares[0, h])
    if dear and not (state[TOUCHED] and changed <= CHANGED * least):
        build(coarse, smoother, constrained, operator, CONTACT)
        for h in range(shares.shape[1]):
            shares[0, h] = shares[1, h]
        state[TOUCHED] = 1
    state[SLOT] = CONTACT if state[TOUCHED] else PLAIN


@njit(cache=True, **COUNTED)
def no_contacts():  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return what `add_contacts` takes where nothing is touched."""
    return np.zeros((0, 4), np.int64), np.zeros((0, 12, 12)), 0


@njit(cache=True, **COUNTED)
def build(coarse, smoother, constrained, operator, slot):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Invert the coarse matrix while components are constrained and faces are touched, into a slot; `operator` is as in `add_contacts`."""
    _, _, _, (base, scale, diagonal, inverse), (corner, weight, fine_corner, fine_weight), _ = coarse
    dense, nothing, flat = base.copy(), np.zeros((0, 0, 0, 0)), np.zeros((0, 0))
    add_constrained(constrained, smoother, corner, weight, dense, flat)
    add_contacts(operator, corner, weight, dense, flat)
    square = dense.reshape(inverse.shape[1:])
    _invert(square)
    for i in range(len(square)):
        for j in range(len(square)):
            inverse[slot, i, j] = 0.5 * (square[i, j] + square[j, i])
    if diagonal.size:
        fine = diagonal.copy()
        add_constrained(constrained, smoother, fine_corner, fine_weight, nothing, fine)
        add_contacts(operator, fine_corner, fine_weight, nothing, fine)
        for i in range(fine.shape[1]):  # half, since the levels above and below see part of it as well
            scale[slot, i] = 1.5 / (fine[0, i] + fine[1, i] + fine[2, i])


@njit(cache=True)
def begin(coarse):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Drop the constraints of the last run, so that a run does not depend on those before it."""
    if len(coarse[5][2]):
        coarse[5][2][SLOT] = PLAIN
        coarse[5][2][CREDIT] = 0


@njit(cache=True)
def _knows(memory, constrained):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return whether the second inverse is that for these constrained components."""
    node, direction, state, _ = memory
    if state[NODES] != len(constrained[0]):
        return False
    for h in range(len(constrained[0])):
        if node[h] != constrained[0][h]:
            return False
        for a in range(3):
            if direction[h, a] != constrained[1][h, a]:
                return False
    return True


@njit(cache=True, **COUNTED)
def follow(coarse, smoother, constrained, at_once):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make the inverse that of the constrained components, at once or when enough work was done that a new one costs little in comparison.

    Until then the one in use goes on; it is only slower.
    """
    memory = coarse[5]
    node, direction, state, _ = memory
    if not len(state):
        return
    if len(constrained[0]) == 0:
        state[SLOT] = PLAIN
        return
    if state[SLOT] == HELD and _knows(memory, constrained):
        return
    if not at_once and state[CREDIT] < state[PRICE]:
        return
    if not _knows(memory, constrained):
        build(coarse, smoother, constrained, no_contacts(), HELD)
        state[NODES] = len(constrained[0])
        for h in range(len(constrained[0])):
            node[h] = constrained[0][h]
            for a in range(3):
                direction[h, a] = constrained[1][h, a]
    state[SLOT], state[CREDIT] = HELD, 0


@njit(cache=True, **COUNTED)
def begin_with(inner, constrained):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Prepare the solver, whose arrays are `inner`, for a run in which these components are constrained."""
    begin(inner[8])
    follow(inner[8], inner[3], constrained, True)
