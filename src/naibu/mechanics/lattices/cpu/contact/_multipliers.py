"""Multipliers of the nodes: the pressure that foundations between the nodes need not carry.

A node carries the fraction that `_kept` tells of the pressure around it. Either its multiplier follows from step to step, which costs
nothing; or it is found together with the end of the step. A multiplier that follows lags behind the compression, and as a force that
lags it feeds vibrations: of a node of mass m on a foundation of stiffness k, with ``alpha = h^2 k / m`` and ``u = 1 - 1 / z``, whose
multiplier takes on all of the pressure, the modes are ``u^3 + alpha = 0``, which grow where alpha is below 1. In steps as short as that
multipliers have to be found together with the end of the step. Under flat indenters the fraction is that of the area that they have near,
and not of what they press at the time: a stiffness that changed with the compression would feed vibrations as well, and where the lattice
resists by its damping differences would grow by some per cent in every step.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.mechanics.lattices.cpu.contact._points import ALONG, BORNE, OWN, TOUCHING, UNDER, exerted
from naibu.mechanics.lattices.model.contact_surface import PER_RADIUS, SHARED, THINNEST

EARNEST = 0.25  # covered fraction of a face that counts
BARELY, NEARLY = 0.4, 0.9  # covered fractions around a node between which it begins to carry pressure without the foundation
MOST_KEPT = 0.95  # fraction that a node carries at most where multipliers are found with the step: at 1 nothing would bound them
# of what a point lacks of its multiplier where a flat indenter has begun to come away, in a step: all at once makes others come and go
GIVEN_BACK = 0.5
COLUMNS = 6  # numbers of a node: see `update_multipliers`
GAIN, COVERING, LARGEST, STIFFNESS, SHARE, BEFORE = range(COLUMNS)


@njit(cache=True, **UNCOUNTED)
def update_multipliers(count, form, surface, history, lists, found, nodal, fraction, settled):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give the nodes what the foundation carries besides their multipliers, as far as the area around them is covered.

    Under round indenters nodes of faces carry the fraction `SHARED` of the pressure in any case, and the thickness of the foundations
    follows from the area that is covered around them. `nodal` (COLUMNS, k, n) are pressure besides the multiplier times area, covered area
    and the largest inverse area of the faces around a node; and, for `settle_multipliers`, stiffness, what is taken of a change, and what
    the multiplier lacked before. `fraction` (k, n) are set to how far nodes are covered. Multipliers that are `settled` agree with the end
    of the step already, and stay.
    """
    corners, spread, _, _, weights, first, rule = surface
    multiplier, thickness = history[5], history[6]
    gain, covering, largest = nodal[GAIN], nodal[COVERING], nodal[LARGEST]
    _gather_pressures(count, surface, lists, found, nodal)
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each = rule[k + 1] - rule[k]
        if form[k, 0] > 0.0 and spread[f, 1] > 0.0:
            area, around = 0.0, 0.0
            for p in range(first[k] + f * each, first[k] + (f + 1) * each):
                area += weights[p]
            for c in range(4):
                around += covering[k, corners[f, c]] if spread[f, c] > 0.0 else 0.0
            thickness[k, f] = np.sqrt(THINNEST**2 + PER_RADIUS**2 * around / (np.pi * area))
    if not settled:
        _release(count, form, surface, multiplier, lists, found, nodal)
    _gather_covered(count, form, surface, lists, found, nodal, settled)
    _gather_fractions(count, form, surface, lists, found, nodal, fraction, settled)
    for entry in range(0 if settled else count):
        k, f = lists[0][entry], lists[1][entry]
        for c in range(4):
            i = corners[f, c]
            if largest[k, i] >= 0.0:
                multiplier[k, i] = max(_kept(form, spread, fraction, k, f, i) * (multiplier[k, i] + largest[k, i] * gain[k, i]), 0.0)
                largest[k, i] = -1.0


@njit(cache=True, **UNCOUNTED)
def settle_multipliers(count, v, form, surface, history, lists, points, nodal, fraction, inertia, slip, begins):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Bring the multipliers nearer to what they come to at the velocity v of the end of the step, by a step of Newton's method each.

    What a node's foundation exerts falls by ``alpha / (1 + alpha)`` of what its multiplier grows by if it moves as a free mass; as it
    does not, the step is rather too short. Where a multiplier turns back, points around it come and go, and it takes half of it from then
    on. How far nodes are covered is as at the end of the step before, so that the pressure derives from a potential.
    `fraction` (k, n) says so; `inertia` are the masses of the nodes and the step, `slip` (3,) is scratch.
    """
    corners, spread, _, _, _, _, _ = surface
    mass, step = inertia
    multiplier, gain, largest = history[5], nodal[GAIN], nodal[LARGEST]
    stiffness, share, before = nodal[STIFFNESS], nodal[SHARE], nodal[BEFORE]
    _gather_exerted(count, v, surface, history, lists, points, slip)
    _gather_pressures(count, surface, lists, points[1], nodal)
    _gather_stiffness(count, surface, history[6], lists, points[1], stiffness)
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        for c in range(4):
            i = corners[f, c]
            if largest[k, i] < 0.0:
                continue
            kept = SHARED if form[k, 0] > 0.0 and spread[f, 1] > 0.0 else min(_kept(form, spread, fraction, k, f, i), MOST_KEPT)
            alpha = step**2 * stiffness[k, i] / mass[i]
            lack = kept * (multiplier[k, i] + largest[k, i] * gain[k, i]) - multiplier[k, i]
            if begins:
                share[k, i], before[k, i] = 1.0, 0.0
            share[k, i] = 0.5 * share[k, i] if lack * before[k, i] < 0.0 else min(1.5 * share[k, i], 1.0)
            before[k, i], largest[k, i] = lack, -1.0
            aim = multiplier[k, i] + lack * (1.0 + alpha) / (1.0 - kept + alpha) if alpha > 0.0 else 0.0
            multiplier[k, i] += share[k, i] * (max(aim, 0.0) - multiplier[k, i])


@njit(cache=True, **UNCOUNTED)
def _kept(form, spread, fraction, k, f, i):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return which fraction of its pressure a node of a face carries by its multiplier."""
    share = SHARED if form[k, 0] > 0.0 and spread[f, 1] > 0.0 else 0.0
    return share + (1.0 - share) * min(max((fraction[k, i] - BARELY) / (NEARLY - BARELY), 0.0), 1.0) ** 2


@njit(cache=True, **UNCOUNTED)
def _gather_exerted(count, v, surface, history, lists, points, slip):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set what linearized points exert at the velocity v, and what of it is not the multipliers'."""
    corners, _, _, shapes, _, first, rule = surface
    linear, found = points
    multiplier, pad = history[5], len(v) // 3
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each = rule[k + 1] - rule[k]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            carried, found[p, TOUCHING] = 0.0, 0.0
            slip[:] = 0.0
            for c in range(4):
                carried += shape[c] * multiplier[k, corners[f, c]]
                for a in range(3):
                    slip[a] += shape[c] * v[a * pad + corners[f, c]]
            exerted(linear[p], slip, found[p])
            found[p, OWN] = found[p, ALONG] - found[p, TOUCHING] * carried


@njit(cache=True, **UNCOUNTED)
def _gather_pressures(count, surface, lists, found, nodal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add up around the nodes what foundations carry besides the multipliers and the covered area, and find their inverse areas."""
    corners, spread, _, shapes, weights, first, rule = surface
    gain, covering, largest = nodal[GAIN], nodal[COVERING], nodal[LARGEST]
    for entry in range(count):
        for c in range(4):
            k, i = lists[0][entry], corners[lists[1][entry], c]
            gain[k, i], covering[k, i], largest[k, i] = 0.0, 0.0, 0.0
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each = rule[k + 1] - rule[k]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            if found[p, TOUCHING] == 0.0:
                continue
            for c in range(4):
                i, part = corners[f, c], weights[p] * shape[c]
                gain[k, i] += part * found[p, OWN]
                covering[k, i] += part * found[p, TOUCHING]
                if part > 0.0:
                    largest[k, i] = max(largest[k, i], spread[f, c])


@njit(cache=True, **UNCOUNTED)
def _gather_stiffness(count, surface, thickness, lists, found, stiffness):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add up around the nodes how stiff the foundations in contact are, mN/mm."""
    corners, _, foundation, shapes, weights, first, rule = surface
    for entry in range(count):
        for c in range(4):
            stiffness[lists[0][entry], corners[lists[1][entry], c]] = 0.0
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each, own = rule[k + 1] - rule[k], foundation[f, 0] / thickness[k, f]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            for c in range(4):
                stiffness[k, corners[f, c]] += own * weights[p] * shape[c] * found[p, TOUCHING]


@njit(cache=True, **UNCOUNTED)
def _release(count, form, surface, multiplier, lists, found, nodal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take from the nodes the pressure that points near a flat indenter no longer exert, all of it where no point around them does.

    A point that has come away, but not as far as its multiplier presses, exerts less than that by what the foundation yields over the gap,
    and how stiff that is depends on the length of the step: were the multiplier to stay, so would the force.
    """
    corners, _, _, shapes, weights, first, rule = surface
    gain, covering = nodal[GAIN], nodal[COVERING]
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        for c in range(4):
            if form[k, 0] == 0.0 and covering[k, corners[f, c]] == 0.0:
                multiplier[k, corners[f, c]] = 0.0
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each = rule[k + 1] - rule[k]
        for g in range(each):
            p, shape, carried = first[k] + f * each + g, shapes[rule[k] + g], 0.0
            part = found[p, TOUCHING]
            lost = GIVEN_BACK * max(found[p, BORNE] - part, 0.0) if part > 0.0 else found[p, UNDER]
            if lost == 0.0:
                continue
            for c in range(4):
                carried += shape[c] * multiplier[k, corners[f, c]]
            for c in range(4):
                gain[k, corners[f, c]] -= weights[p] * shape[c] * lost * carried


@njit(cache=True, **UNCOUNTED)
def _column(form, k, settled):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the column of the covered fraction of points that counts."""
    return UNDER if settled or form[k, 0] == 0.0 else TOUCHING


@njit(cache=True, **UNCOUNTED)
def _gather_covered(count, form, surface, lists, found, nodal, settled):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add up the covered areas around the nodes, and find their inverse areas, by what counts of points."""
    corners, spread, _, shapes, weights, first, rule = surface
    covering, largest = nodal[COVERING], nodal[LARGEST]
    for entry in range(count):
        for c in range(4):
            k, i = lists[0][entry], corners[lists[1][entry], c]
            covering[k, i], largest[k, i] = 0.0, 0.0
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each = rule[k + 1] - rule[k]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            for c in range(4):
                i, part = corners[f, c], weights[p] * shape[c] * found[p, _column(form, k, settled)]
                covering[k, i] += part
                if part > 0.0:
                    largest[k, i] = max(largest[k, i], spread[f, c])


@njit(cache=True, **UNCOUNTED)
def _gather_fractions(count, form, surface, lists, found, nodal, fraction, settled):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find how far nodes are covered: as the least covered one of the faces around them, those hardly touched left out.

    `nodal` holds covered areas and inverse areas by what counts of points.
    """
    corners, spread, _, _, weights, first, rule = surface
    covering, largest = nodal[COVERING], nodal[LARGEST]
    for entry in range(count):
        for c in range(4):
            fraction[lists[0][entry], corners[lists[1][entry], c]] = 1.0
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each, least = rule[k + 1] - rule[k], 1.0
        for c in range(4):
            if spread[f, c] > 0.0:
                least = min(least, covering[k, corners[f, c]] * largest[k, corners[f, c]])
        touching, area = 0.0, 0.0
        for p in range(first[k] + f * each, first[k] + (f + 1) * each):
            touching, area = touching + weights[p] * found[p, _column(form, k, settled)], area + weights[p]
        earnest = min(touching / (EARNEST * area), 1.0)
        for c in range(4):
            i = corners[f, c]
            own = min(covering[k, i] * largest[k, i], earnest * least + 1.0 - earnest)
            fraction[k, i] = min(fraction[k, i], own)
