"""Explicit steps of a mass-spring-dashpot lattice :cite:p:`hirai2008` (chapter 4.3) as kernels for NVIDIA Warp.

This module needs Warp; `naibu.mechanics.lattices.gpu.engine` loads it where it is asked for.

Every element stands in the lists of both its nodes, each time with an extension of its own. Both are moved on from differences that are
the exact negatives of each other, and so stay the same to the last bit: no two threads ever write to one place, and no sum depends on
which thread comes first. Lists of `SLICE` nodes lie side by side, so that neighbouring threads read neighbouring places.
"""

from __future__ import annotations

from typing import Any

import warp as wp

AnyDtype = Any  # of generic kernels: Warp compiles them for the types that their arrays have
SLICE = 32  # nodes whose lists lie side by side: the threads of a warp
FOLD = 32  # numbers that one thread adds up

wp.set_module_options({"enable_backward": False})


@wp.kernel
def forces(
    start: wp.array[wp.int32],
    degree: wp.array[wp.int32],
    neighbour: wp.array[wp.int32],
    row: wp.array[AnyDtype],
    table: wp.array[AnyDtype],
    x: wp.array[AnyDtype],
    v: wp.array[AnyDtype],
    y: wp.array[AnyDtype],
    external: wp.array[AnyDtype],
    f: wp.array[AnyDtype],
) -> None:
    """Set f to the forces on the nodes and move the extensions on by a step of Euler's; rows of the table are A, B, D dt and G dt."""
    i = wp.tid()
    at = start[i // SLICE] + i % SLICE
    xi = x[i]
    vi = v[i]
    force = xi - xi
    if external.shape[0] > 0:
        force += external[i]
    for _ in range(degree[i]):
        j = neighbour[at]
        c = table[int(row[at])]
        d = x[j] - xi
        square = wp.dot(d, d)
        inverse = type(square)(1.0) / wp.sqrt(square)
        rate = wp.dot(v[j] - vi, d) * inverse
        extension = y[at]
        y[at] = extension + (c[2] * rate - c[3] * extension)
        force += ((c[0] * rate + c[1] * extension) * inverse) * d
        at += SLICE
    f[i] = force


@wp.kernel
def drive(
    first: wp.array[wp.int32],
    node: wp.array[wp.int32],
    direction: wp.array[wp.vec3d],
    weight: wp.array[wp.float64],
    body: wp.array[wp.int32],
    velocity: wp.array2d[wp.vec3d],
    count: wp.array[wp.int32],
    mass: wp.array[AnyDtype],
    v: wp.array[AnyDtype],
    step: wp.float64,
    f: wp.array[AnyDtype],
    push: wp.array[wp.vec3d],
) -> None:
    """Change the force on a constrained node so that it takes on the velocity of its bodies in step `count`, along its directions.

    The entries ``first[k]`` to ``first[k + 1]`` hold the k-th mass; `push` takes what each exerts, mN.
    """
    k = wp.tid()
    i = node[first[k]]
    n = count[0]
    m = wp.float64(mass[i])
    force = wp.vec3d(wp.float64(f[i][0]), wp.float64(f[i][1]), wp.float64(f[i][2]))
    old = wp.vec3d(wp.float64(v[i][0]), wp.float64(v[i][1]), wp.float64(v[i][2]))
    for h in range(first[k], first[k + 1]):
        wanted = weight[h] * velocity[n, body[h]]
        lack = wp.dot(direction[h], m * (wanted - old) / step - force)
        push[h] = lack * direction[h]
        force += push[h]
    kept = f[i]
    f[i] = type(kept)(type(kept[0])(force[0]), type(kept[0])(force[1]), type(kept[0])(force[2]))


@wp.kernel
def collect(
    push: wp.array[wp.vec3d],
    entry: wp.array[wp.int32],
    first: wp.array[wp.int32],
    count: wp.array[wp.int32],
    reaction: wp.array2d[wp.vec3d],
) -> None:
    """Add up what part c of a body's entries, ``entry[first[c]]`` to ``entry[first[c + 1] - 1]``, exerts in step `count`."""
    c = wp.tid()
    force = wp.vec3d()
    for k in range(first[c], first[c + 1]):
        force += push[entry[k]]
    reaction[count[0], c] = force


@wp.kernel
def move(
    inverse_mass: wp.array[AnyDtype],
    f: wp.array[AnyDtype],
    step: AnyDtype,
    forward: wp.int32,
    count: wp.array[wp.int32],
    x: wp.array[AnyDtype],
    v: wp.array[AnyDtype],
) -> None:
    """Move a node by a step: by the velocity before it if `forward`, else by that after it; count the step."""
    i = wp.tid()
    old = v[i]
    new = old + step * (inverse_mass[i] * f[i])
    v[i] = new
    if forward != 0:
        x[i] = x[i] + step * old
    else:
        x[i] = x[i] + step * new
    if i == 0:
        count[0] = count[0] + 1


@wp.kernel
def fold(values: wp.array[AnyDtype], sums: wp.array[AnyDtype]) -> None:
    """Set sums[c] to the sum of values[c], values[c + p], ..., p being the number of sums."""
    c = wp.tid()
    k = c
    s = values[c]
    for _ in range(1, FOLD):
        k += sums.shape[0]
        if k < values.shape[0]:
            s += values[k]
    sums[c] = s


_REAL = ((wp.float64, wp.vec3d, wp.vec4d), (wp.float32, wp.vec3f, wp.vec4f))
# named beforehand, so that the module is compiled once for all
for _real, _vector, _row in _REAL:
    _v, _s = wp.array(dtype=_vector), wp.array(dtype=_real)
    _i = wp.array(dtype=wp.int32)
    for _code in (wp.uint8, wp.int32):
        wp.overload(forces, [_i, _i, _i, wp.array(dtype=_code), wp.array(dtype=_row), _v, _v, _s, _v, _v])
    wp.overload(drive, {"mass": _s, "v": _v, "f": _v})
    wp.overload(move, {"inverse_mass": _s, "f": _v, "step": _real, "x": _v, "v": _v})
for _value in (wp.float64, wp.vec3d, wp.types.vector(length=12, dtype=wp.float64)):
    wp.overload(fold, {"values": wp.array(dtype=_value), "sums": wp.array(dtype=_value)})
