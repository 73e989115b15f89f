"""Kernels that cover elements by blocks and find what blocks have in common: see `naibu.mechanics.lattices.cpu.element_blocks`."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH

_STRIDE = 4  # a neighbour along y, z or a diagonal, and the two beside it along x, overlap
_ODD = np.uint64(0x9E3779B97F4A7C15)


@njit(cache=True, **UNCOUNTED)
def in_order(pairs):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return whether the smaller nodes of pairs (m, 2) lie in eights of nodes that do not fall."""
    before = 0
    for e in range(len(pairs)):
        tile = min(pairs[e, 0], pairs[e, 1]) // WIDTH
        if tile < before:
            return False
        before = tile
    return True


@njit(cache=True, **UNCOUNTED)
def _sorted_gaps(pairs, begin, end, gaps):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set `gaps` to the different distances between the nodes of pairs begin to end, sorted, and return how many there are."""
    count, at, before = 0, 0, 0
    for e in range(begin, end):
        gap = abs(pairs[e, 1] - pairs[e, 0])
        if gap <= before:  # those of one node mostly grow
            at = 0
        before = gap
        while at < count and gaps[at] < gap:
            at += 1
        if at == count or gaps[at] != gap:
            for k in range(count, at, -1):
                gaps[k] = gaps[k - 1]
            gaps[at] = gap
            count += 1
    return count


@njit(cache=True, **UNCOUNTED)
def _turn(rank, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the place of a block among `count` of the same first nodes, such that those whose second nodes overlap are apart.

    These are neighbours by their distance; a processor stalls where it loads what it has just stored in other pieces.
    """
    place = rank // _STRIDE
    for other in range(rank % _STRIDE):
        place += (count - other + _STRIDE - 1) // _STRIDE
    return place


@njit(cache=True, **UNCOUNTED)
def cover(pairs, gaps, first, second, lane):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the nodes of lane 0 of blocks, and the lane of every pair; return how many blocks there are.

    Pairs are in the order that `in_order` asks for. `gaps` is room for as many numbers as there are pairs at eight nodes.
    """
    blocks, begin = 0, 0
    while begin < len(pairs):
        tile, end = min(pairs[begin, 0], pairs[begin, 1]) // WIDTH, begin + 1
        while end < len(pairs) and min(pairs[end, 0], pairs[end, 1]) // WIDTH == tile:
            end += 1
        count = _sorted_gaps(pairs, begin, end, gaps)
        for k in range(count):
            block = blocks + _turn(k, count)
            first[block] = WIDTH * tile
            second[block] = WIDTH * tile + gaps[k]
        at, before = 0, 0
        for e in range(begin, end):
            gap = abs(pairs[e, 1] - pairs[e, 0])
            if gap <= before:
                at = 0
            before = gap
            while gaps[at] < gap:
                at += 1
            lane[e] = WIDTH * (blocks + _turn(at, count)) + min(pairs[e, 0], pairs[e, 1]) % WIDTH
        blocks += count
        begin = end
    return blocks


@njit(cache=True, **UNCOUNTED)
def mark_filled(lane, filled):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the bits of the lanes of every block (nb,) that hold an element."""
    for e in range(len(lane)):
        filled[lane[e] // WIDTH] |= np.uint8(1 << (lane[e] % WIDTH))


@njit(cache=True, **UNCOUNTED)
def add_to_keys(lane, bits, keys):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to the number of every block (nb,) one that its values, given by their bits, and their lanes determine."""
    for e in range(len(lane)):
        mixed = bits[e] ^ (_ODD * np.uint64(lane[e] % WIDTH + 1))
        mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        keys[lane[e] // WIDTH] += mixed ^ (mixed >> np.uint64(32))


@njit(cache=True, **UNCOUNTED)
def number_kinds(keys, places, kind):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Number different keys by where they first appear, in `kind`; return how many there are. `places`, zeros, are a power of two."""
    count, mask = 0, len(places) - 1
    for b in range(len(keys)):
        at = np.int64(keys[b] >> np.uint64(1)) & mask
        while places[at] and keys[places[at] - 1] != keys[b]:
            at = (at + 1) & mask
        if places[at]:
            kind[b] = kind[places[at] - 1]
        else:
            places[at] = b + 1
            kind[b] = count
            count += 1
    return count


@njit(cache=True, **UNCOUNTED)
def tabulate(lane, kind, bits, table):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the table (8 kinds,) with the values of the blocks of each kind; return whether all of a kind have the same."""
    alike = True
    for e in range(len(lane)):
        table[WIDTH * kind[lane[e] // WIDTH] + lane[e] % WIDTH] = bits[e]
    for e in range(len(lane)):
        alike = alike and table[WIDTH * kind[lane[e] // WIDTH] + lane[e] % WIDTH] == bits[e]
    return alike
