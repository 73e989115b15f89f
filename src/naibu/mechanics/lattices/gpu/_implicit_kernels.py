"""Kernels of the linear-implicit step :cite:p:`baraff1998` of a lattice, for NVIDIA Warp.

The method is that of `naibu.mechanics.lattices.cpu.implicit._implicit_kernels`. This module needs Warp. Elements are
computed at both their nodes
(see `naibu.mechanics.lattices.gpu._explicit_kernels`); their directions are computed anew from the positions in each product with the
matrix, which costs less than reading them. Rows of the table are a, b, E and g. All is in double precision. Energies of elements are
counted by halves, once at each end.
"""

from __future__ import annotations

import warp as wp

from naibu.mechanics.lattices.gpu._explicit_kernels import FOLD, SLICE, AnyDtype

wp.set_module_options({"enable_backward": False})

Vector12 = wp.types.vector(length=12, dtype=wp.float64)


@wp.kernel
def constrain(
    first: wp.array[wp.int32],
    node: wp.array[wp.int32],
    direction: wp.array[wp.vec3d],
    weight: wp.array[wp.float64],
    body: wp.array[wp.int32],
    velocity: wp.array2d[wp.vec3d],
    count: wp.array[wp.int32],
    v: wp.array[wp.vec3d],
) -> None:
    """Give the constrained components of a node the velocity of their bodies in step `count`."""
    k = wp.tid()
    i = node[first[k]]
    new = v[i]
    for h in range(first[k], first[k + 1]):
        new += wp.dot(direction[h], weight[h] * velocity[count[0], body[h]] - new) * direction[h]
    v[i] = new


@wp.kernel
def release(first: wp.array[wp.int32], node: wp.array[wp.int32], direction: wp.array[wp.vec3d], values: wp.array[wp.vec3d]) -> None:
    """Take the constrained components out of the values of a node."""
    k = wp.tid()
    i = node[first[k]]
    free = values[i]
    for h in range(first[k], first[k + 1]):
        free -= wp.dot(direction[h], free) * direction[h]
    values[i] = free


@wp.kernel
def support(
    first: wp.array[wp.int32],
    node: wp.array[wp.int32],
    direction: wp.array[wp.vec3d],
    r: wp.array[wp.vec3d],
    step: wp.float64,
    push: wp.array[wp.vec3d],
) -> None:
    """Set the forces by which bodies hold a node, from the residual of a step."""
    k = wp.tid()
    i = node[first[k]]
    for h in range(first[k], first[k + 1]):
        push[h] = (-wp.dot(direction[h], r[i]) / step) * direction[h]


@wp.kernel
def residual(
    start: wp.array[wp.int32],
    degree: wp.array[wp.int32],
    neighbour: wp.array[wp.int32],
    row: wp.array[AnyDtype],
    table: wp.array[wp.vec4d],
    mass: wp.array[wp.float64],
    x: wp.array[wp.vec3d],
    y: wp.array[wp.float64],
    v: wp.array[wp.vec3d],
    before: wp.array[wp.vec3d],
    external: wp.array[wp.vec3d],
    step: wp.float64,
    r: wp.array[wp.vec3d],
    strength: wp.array[wp.float64],
) -> None:
    """Set r to the momenta that the velocity v leaves unbalanced, and add up the squares of the impulses of extensions."""
    i = wp.tid()
    at = start[i // SLICE] + i % SLICE
    xi = x[i]
    vi = v[i]
    left = mass[i] * (before[i] - vi)
    if external.shape[0] > 0:
        left += step * external[i]
    squares = wp.float64(0.0)
    for _ in range(degree[i]):
        j = neighbour[at]
        c = table[int(row[at])]
        d = x[j] - xi
        inverse = wp.float64(1.0) / wp.sqrt(wp.dot(d, d))
        impulse = step * c[1] * y[at]
        squares += wp.float64(0.5) * impulse * impulse
        impulse += step * step * c[0] * (wp.dot(v[j] - vi, d) * inverse)
        left += (impulse * inverse) * d
        at += SLICE
    r[i] = left
    strength[i] = squares


@wp.func
def going(norm: wp.array[wp.vec2d], goal: wp.array[wp.float64], curvature: wp.array[wp.float64]) -> bool:
    """Tell whether the solver goes on: iterations that are given to the device beyond its end change nothing.

    `norm` holds the squares of the residual's norms in the smoother, by which it ends, and in the preconditioner.
    """
    zero = wp.float64(0.0)
    return bool(norm[0][0] > goal[0] and norm[0][1] > zero and curvature[0] > zero)


@wp.kernel
def multiply(
    start: wp.array[wp.int32],
    degree: wp.array[wp.int32],
    neighbour: wp.array[wp.int32],
    row: wp.array[AnyDtype],
    table: wp.array[wp.vec4d],
    mass: wp.array[wp.float64],
    x: wp.array[wp.vec3d],
    p: wp.array[wp.vec3d],
    step: wp.float64,
    q: wp.array[wp.vec3d],
    always: wp.bool,
    norm: wp.array[wp.vec2d],
    goal: wp.array[wp.float64],
    curvature: wp.array[wp.float64],
) -> None:
    """Set q to A p, `always` or only while the solver goes on."""
    i = wp.tid()
    if not always and not going(norm, goal, curvature):
        return
    at = start[i // SLICE] + i % SLICE
    xi = x[i]
    pi = p[i]
    result = mass[i] * pi
    for _ in range(degree[i]):
        j = neighbour[at]
        c = table[int(row[at])]
        d = x[j] - xi
        result -= (step * step * c[0] * wp.dot(p[j] - pi, d) / wp.dot(d, d)) * d
        at += SLICE
    q[i] = result


@wp.kernel
def scaled(smoother: wp.array[wp.float64], r: wp.array[wp.vec3d], smoothed: wp.array[wp.vec3d]) -> None:
    """Set `smoothed` to the residual times the smoother."""
    i = wp.tid()
    smoothed[i] = smoother[i] * r[i]


@wp.kernel
def descend(
    norm: wp.array[wp.vec2d],
    goal: wp.array[wp.float64],
    curvature: wp.array[wp.float64],
    smoother: wp.array[wp.float64],
    p: wp.array[wp.vec3d],
    q: wp.array[wp.vec3d],
    v: wp.array[wp.vec3d],
    r: wp.array[wp.vec3d],
    smoothed: wp.array[wp.vec3d],
) -> None:
    """Move v along p to the least energy, r with it; set `smoothed` to the residual times the smoother."""
    i = wp.tid()
    if going(norm, goal, curvature):
        fraction = norm[0][1] / curvature[0]
        v[i] = v[i] + fraction * p[i]
        left = r[i] - fraction * q[i]
        r[i] = left
        smoothed[i] = smoother[i] * left


@wp.kernel
def turn(
    norm: wp.array[wp.vec2d],
    goal: wp.array[wp.float64],
    curvature: wp.array[wp.float64],
    later: wp.array[wp.vec2d],
    z: wp.array[wp.vec3d],
    p: wp.array[wp.vec3d],
) -> None:
    """Set p to the next direction."""
    i = wp.tid()
    if going(norm, goal, curvature):
        p[i] = z[i] + (later[0][1] / norm[0][1]) * p[i]


@wp.kernel
def accept(
    norm: wp.array[wp.vec2d],
    goal: wp.array[wp.float64],
    curvature: wp.array[wp.float64],
    later: wp.array[wp.vec2d],
    turns: wp.array[wp.int32],
) -> None:
    """Take on the later norm and count the iteration."""
    if going(norm, goal, curvature):
        norm[0] = later[0]
        turns[0] = turns[0] + 1


@wp.kernel
def products(a: wp.array[wp.vec3d], b: wp.array[wp.vec3d], sums: wp.array[wp.float64]) -> None:
    """Set sums[c] to the sum of a . b over the nodes c, c + p, ..., p being the number of sums."""
    c = wp.tid()
    k = c
    s = wp.dot(a[c], b[c])
    for _ in range(1, FOLD):
        k += sums.shape[0]
        if k < a.shape[0]:
            s += wp.dot(a[k], b[k])
    sums[c] = s


@wp.kernel
def norms(r: wp.array[wp.vec3d], smoothed: wp.array[wp.vec3d], z: wp.array[wp.vec3d], sums: wp.array[wp.vec2d]) -> None:
    """Set sums[c] to the sums of r . smoothed and r . z over the nodes c, c + p, ..., p being the number of sums."""
    c = wp.tid()
    k = c
    s = wp.vec2d()
    for _ in range(FOLD):
        if k < r.shape[0]:
            s += wp.vec2d(wp.dot(r[k], smoothed[k]), wp.dot(r[k], z[k]))
        k += sums.shape[0]
    sums[c] = s


@wp.kernel
def fold_norms(values: wp.array[wp.vec2d], sums: wp.array[wp.vec2d]) -> None:
    """Do as `fold` does.

    It is a kernel of its own, since Warp 1.19 takes two overloads of one kernel for the same when it records launches on the processor.
    """
    c = wp.tid()
    k = c
    s = wp.vec2d()
    for _ in range(FOLD):
        if k < values.shape[0]:
            s += values[k]
        k += sums.shape[0]
    sums[c] = s


@wp.kernel
def weighted(mass: wp.array[wp.float64], values: wp.array[wp.vec3d], result: wp.array[wp.vec3d]) -> None:
    """Multiply values by the nodal masses."""
    i = wp.tid()
    result[i] = mass[i] * values[i]


@wp.kernel
def moments(
    mass: wp.array[wp.float64], x: wp.array[wp.vec3d], centre: wp.vec3d, impulse: wp.array[wp.vec3d], result: wp.array[Vector12]
) -> None:
    """Set the momentum and the angular momentum of an impulse on a node, and its moments xx, yy, zz, yz, zx, xy about the centre."""
    i = wp.tid()
    d = x[i] - centre
    s = wp.cross(d, impulse[i])
    p = impulse[i]
    m = mass[i]
    result[i] = Vector12(
        p[0],
        p[1],
        p[2],
        s[0],
        s[1],
        s[2],
        m * d[0] * d[0],
        m * d[1] * d[1],
        m * d[2] * d[2],
        m * d[1] * d[2],
        m * d[2] * d[0],
        m * d[0] * d[1],
    )


@wp.kernel
def add_rigid(
    x: wp.array[wp.vec3d],
    centre: wp.vec3d,
    speed: wp.vec3d,
    spin: wp.vec3d,
    sign: wp.float64,
    v: wp.array[wp.vec3d],
) -> None:
    """Add a rigid motion, times a sign, to v."""
    i = wp.tid()
    v[i] = v[i] + sign * (speed + wp.cross(spin, x[i] - centre))


@wp.kernel
def balance(
    x: wp.array[wp.vec3d], centre: wp.vec3d, speed: wp.vec3d, spin: wp.vec3d, mass: wp.array[wp.float64], r: wp.array[wp.vec3d]
) -> None:
    """Take the momenta of a rigid motion from r."""
    i = wp.tid()
    r[i] = r[i] - mass[i] * (speed + wp.cross(spin, x[i] - centre))


@wp.kernel
def correct(fraction: wp.float64, p: wp.array[wp.vec3d], v: wp.array[wp.vec3d]) -> None:
    """Add share times p to v."""
    i = wp.tid()
    v[i] = v[i] + fraction * p[i]


@wp.kernel
def weigh(
    start: wp.array[wp.int32],
    degree: wp.array[wp.int32],
    neighbour: wp.array[wp.int32],
    row: wp.array[AnyDtype],
    table: wp.array[wp.vec4d],
    stiffness: wp.array[wp.float64],
    mass: wp.array[wp.float64],
    x: wp.array[wp.vec3d],
    v: wp.array[wp.vec3d],
    before: wp.array[wp.vec3d],
    y: wp.array[wp.float64],
    lengths: wp.array[wp.float64],
    step: wp.float64,
    energies: wp.array[wp.vec3d],
) -> None:
    """Set what the elements at a node, and the change of its velocity, dissipate, and what the rotation stores: linear and square part."""
    i = wp.tid()
    at = start[i // SLICE] + i % SLICE
    half = wp.float64(0.5)
    xi = x[i]
    vi = v[i]
    moved = xi + step * vi
    slowed = before[i] - vi
    dissipated = half * mass[i] * wp.dot(slowed, slowed)
    linear = wp.float64(0.0)
    square = wp.float64(0.0)
    for _ in range(degree[i]):
        j = neighbour[at]
        c = table[int(row[at])]
        k = stiffness[int(row[at])]
        d = x[j] - xi
        change = step * wp.dot(v[j] - vi, d) / wp.sqrt(wp.dot(d, d))
        old = y[at]
        new = c[2] * old + c[3] * change
        after = x[j] + step * v[j] - moved
        added = c[3] * (wp.sqrt(wp.dot(after, after)) - lengths[at] - change)
        dissipated += half * ((c[0] * change + c[1] * old) * change - half * k * (new * new - old * old))
        linear += half * k * new * added
        square += half * half * k * added * added
        at += SLICE
    energies[i] = wp.vec3d(dissipated, linear, square)


@wp.kernel
def extend(
    start: wp.array[wp.int32],
    degree: wp.array[wp.int32],
    neighbour: wp.array[wp.int32],
    row: wp.array[AnyDtype],
    table: wp.array[wp.vec4d],
    x: wp.array[wp.vec3d],
    v: wp.array[wp.vec3d],
    step: wp.float64,
    fraction: wp.float64,
    y: wp.array[wp.float64],
    lengths: wp.array[wp.float64],
) -> None:
    """Move on extensions and the lengths they know of, with a fraction of what the rotation adds."""
    i = wp.tid()
    at = start[i // SLICE] + i % SLICE
    xi = x[i]
    vi = v[i]
    moved = xi + step * vi
    for _ in range(degree[i]):
        j = neighbour[at]
        c = table[int(row[at])]
        d = x[j] - xi
        change = step * wp.dot(v[j] - vi, d) / wp.sqrt(wp.dot(d, d))
        after = x[j] + step * v[j] - moved
        length = wp.sqrt(wp.dot(after, after))
        turned = length - lengths[at] - change
        y[at] = c[2] * y[at] + c[3] * change + fraction * (c[3] * turned)
        lengths[at] = length - (wp.float64(1.0) - fraction) * turned
        at += SLICE


@wp.kernel
def shift(step: wp.float64, v: wp.array[wp.vec3d], count: wp.array[wp.int32], x: wp.array[wp.vec3d]) -> None:
    """Move a node by its velocity; count the step."""
    i = wp.tid()
    x[i] = x[i] + step * v[i]
    if i == 0:
        count[0] = count[0] + 1


for _code in (wp.uint8, wp.int32):
    for _kernel in (residual, multiply, weigh, extend):
        wp.overload(_kernel, {"row": wp.array(dtype=_code)})
