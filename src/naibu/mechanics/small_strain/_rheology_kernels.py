"""Matrix-free nodal forces and internal strains of three-element (Jeffreys) solids :cite:p:`hirai2008` (chapter 2)."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.finite_elements.linear_simplices import Simplices
from naibu.mechanics.small_strain.rheology import CellRheology, FlowCoefficients, StepCoefficients


def stage_forces(body: Simplices, step: StepCoefficients, velocity: FloatArray, trace: FloatArray, strain: FloatArray) -> FloatArray:
    """Return the internal forces (n, d), mN, at the end of a step of constant velocity (n, d), mm/s.

    Parameters
    ----------
    trace, strain : ndarray, shape (m,) and (m, d, d)
        Internal strain at the start of the step, of the lambda and of the mu part; not changed.
    """
    force = np.zeros_like(velocity)
    _stage(
        body.cells,
        body.gradients,
        body.measures,
        np.ascontiguousarray(velocity),
        trace,
        strain,
        step.decay,
        step.gain,
        step.spring,
        step.dashpot,
        step.decay,
        step.gain,
        trace,
        strain,
        False,
        force,
    )
    return force


def advanced(
    body: Simplices,
    step: StepCoefficients,
    velocity: FloatArray,
    trace: FloatArray,
    strain: FloatArray,
    until: StepCoefficients | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the internal forces (n, d), mN, at the end of a step, and the internal strain there, or at the end of the step `until`."""
    force, new_trace, new_strain = np.zeros_like(velocity), np.empty_like(trace), np.empty_like(strain)
    last = step if until is None else until
    _stage(
        body.cells,
        body.gradients,
        body.measures,
        np.ascontiguousarray(velocity),
        trace,
        strain,
        step.decay,
        step.gain,
        step.spring,
        step.dashpot,
        last.decay,
        last.gain,
        new_trace,
        new_strain,
        True,
        force,
    )
    return force, new_trace, new_strain


def rates(
    body: Simplices, flow: FlowCoefficients, velocity: FloatArray, trace: FloatArray, strain: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the internal forces (n, d), mN, of a state, and the rates (m,) and (m, d, d), 1/s, of its internal strain."""
    force, trace_rate, strain_rate = np.zeros_like(velocity), np.empty_like(trace), np.empty_like(strain)
    _stage(
        body.cells,
        body.gradients,
        body.measures,
        np.ascontiguousarray(velocity),
        trace,
        strain,
        flow.one,
        flow.zero,
        flow.spring,
        flow.dashpot,
        flow.decay_rate,
        flow.viscosity_ratio,
        trace_rate,
        strain_rate,
        True,
        force,
    )
    return force, trace_rate, strain_rate


def elastic_energy(body: Simplices, law: CellRheology, trace: FloatArray, strain: FloatArray) -> float:
    """Return the energy stored in the springs, mN mm."""
    lame = law.elastic[:, 0] * np.where(law.viscosity_ratio[:, 0] > 0.0, trace, 0.0) ** 2
    shear = 2.0 * law.elastic[:, 1] * np.einsum("mab,mab->m", strain, strain)
    return float(0.5 * ((lame + shear) * body.measures).sum())


def _stage(
    cells: IntArray,
    gradients: FloatArray,
    measures: FloatArray,
    velocity: FloatArray,
    trace: FloatArray,
    strain: FloatArray,
    decay: FloatArray,
    gain: FloatArray,
    spring: FloatArray,
    dashpot: FloatArray,
    last_decay: FloatArray,
    last_gain: FloatArray,
    new_trace: FloatArray,
    new_strain: FloatArray,
    write: bool,
    force: FloatArray,
) -> None:
    """Add the forces at the end of a step, and write the internal strain at the end of the step of `last_decay` and `last_gain`.

    The kernel of tetrahedra is written out: it takes a fifth of the time of the one for any dimension.
    """
    kernel = _stage_3d if velocity.shape[1] == 3 else _stage_any
    kernel(
        cells,
        gradients,
        measures,
        velocity,
        trace,
        strain,
        decay,
        gain,
        spring,
        dashpot,
        last_decay,
        last_gain,
        new_trace,
        new_strain,
        write,
        force,
    )


@njit(cache=True, fastmath={"contract"})
def _stage_any(  # type: ignore[no-untyped-def]  # pragma: no cover
    cells,
    gradients,
    measures,
    velocity,
    trace,
    strain,
    decay,
    gain,
    spring,
    dashpot,
    last_decay,
    last_gain,
    new_trace,
    new_strain,
    write,
    force,
):
    m, k, d = gradients.shape
    rate, stress, corner = np.empty((d, d)), np.empty((d, d)), np.empty((k, d))
    for c in range(m):
        for i in range(k):
            for a in range(d):
                corner[i, a] = velocity[cells[c, i], a]
        for a in range(d):
            for b in range(d):
                s = 0.0
                for i in range(k):
                    s += corner[i, a] * gradients[c, i, b]
                rate[a, b] = s
        divergence = 0.0
        for a in range(d):
            divergence += rate[a, a]
        volume = measures[c]
        lame = dashpot[c, 0] * divergence + spring[c, 0] * (decay[c, 0] * trace[c] + gain[c, 0] * divergence)
        of_rate = 2.0 * (dashpot[c, 1] + spring[c, 1] * gain[c, 1])
        of_strain = 2.0 * spring[c, 1] * decay[c, 1]
        for a in range(d):
            for b in range(a + 1):
                symmetric = 0.5 * (rate[a, b] + rate[b, a])
                value = volume * (of_rate * symmetric + of_strain * strain[c, a, b])
                if write:
                    after = last_decay[c, 1] * strain[c, a, b] + last_gain[c, 1] * symmetric
                    new_strain[c, a, b] = after
                    new_strain[c, b, a] = after
                stress[a, b] = value
                stress[b, a] = value
            stress[a, a] += volume * lame
        if write:
            new_trace[c] = last_decay[c, 0] * trace[c] + last_gain[c, 0] * divergence
        for i in range(k):
            for a in range(d):
                s = 0.0
                for b in range(d):
                    s += stress[a, b] * gradients[c, i, b]
                force[cells[c, i], a] += s


@njit(cache=True, fastmath={"contract"})
def _stage_3d(  # type: ignore[no-untyped-def]  # pragma: no cover
    cells,
    gradients,
    measures,
    velocity,
    trace,
    strain,
    decay,
    gain,
    spring,
    dashpot,
    last_decay,
    last_gain,
    new_trace,
    new_strain,
    write,
    force,
):
    for c in range(len(cells)):  # scalars throughout: views of rows would double the time
        n0, n1, n2, n3 = cells[c, 0], cells[c, 1], cells[c, 2], cells[c, 3]
        g1x, g1y, g1z = gradients[c, 1, 0], gradients[c, 1, 1], gradients[c, 1, 2]
        g2x, g2y, g2z = gradients[c, 2, 0], gradients[c, 2, 1], gradients[c, 2, 2]
        g3x, g3y, g3z = gradients[c, 3, 0], gradients[c, 3, 1], gradients[c, 3, 2]
        x0, y0, z0 = velocity[n0, 0], velocity[n0, 1], velocity[n0, 2]
        x1, y1, z1 = velocity[n1, 0] - x0, velocity[n1, 1] - y0, velocity[n1, 2] - z0
        x2, y2, z2 = velocity[n2, 0] - x0, velocity[n2, 1] - y0, velocity[n2, 2] - z0
        x3, y3, z3 = velocity[n3, 0] - x0, velocity[n3, 1] - y0, velocity[n3, 2] - z0
        xx = x1 * g1x + x2 * g2x + x3 * g3x
        yy = y1 * g1y + y2 * g2y + y3 * g3y
        zz = z1 * g1z + z2 * g2z + z3 * g3z
        xy = 0.5 * (x1 * g1y + x2 * g2y + x3 * g3y + y1 * g1x + y2 * g2x + y3 * g3x)
        xz = 0.5 * (x1 * g1z + x2 * g2z + x3 * g3z + z1 * g1x + z2 * g2x + z3 * g3x)
        yz = 0.5 * (y1 * g1z + y2 * g2z + y3 * g3z + z1 * g1y + z2 * g2y + z3 * g3y)
        divergence, volume = xx + yy + zz, measures[c]
        lame = volume * (dashpot[c, 0] * divergence + spring[c, 0] * (decay[c, 0] * trace[c] + gain[c, 0] * divergence))
        a = 2.0 * volume * (dashpot[c, 1] + spring[c, 1] * gain[c, 1])
        b = 2.0 * volume * spring[c, 1] * decay[c, 1]
        sxx, syy, szz = a * xx + b * strain[c, 0, 0] + lame, a * yy + b * strain[c, 1, 1] + lame, a * zz + b * strain[c, 2, 2] + lame
        sxy, sxz, syz = a * xy + b * strain[c, 0, 1], a * xz + b * strain[c, 0, 2], a * yz + b * strain[c, 1, 2]
        if write:
            p, q = last_decay[c, 1], last_gain[c, 1]
            new_trace[c] = last_decay[c, 0] * trace[c] + last_gain[c, 0] * divergence
            new_strain[c, 0, 0] = p * strain[c, 0, 0] + q * xx
            new_strain[c, 1, 1] = p * strain[c, 1, 1] + q * yy
            new_strain[c, 2, 2] = p * strain[c, 2, 2] + q * zz
            new_strain[c, 0, 1] = new_strain[c, 1, 0] = p * strain[c, 0, 1] + q * xy
            new_strain[c, 0, 2] = new_strain[c, 2, 0] = p * strain[c, 0, 2] + q * xz
            new_strain[c, 1, 2] = new_strain[c, 2, 1] = p * strain[c, 1, 2] + q * yz
        f1x, f1y, f1z = sxx * g1x + sxy * g1y + sxz * g1z, sxy * g1x + syy * g1y + syz * g1z, sxz * g1x + syz * g1y + szz * g1z
        f2x, f2y, f2z = sxx * g2x + sxy * g2y + sxz * g2z, sxy * g2x + syy * g2y + syz * g2z, sxz * g2x + syz * g2y + szz * g2z
        f3x, f3y, f3z = sxx * g3x + sxy * g3y + sxz * g3z, sxy * g3x + syy * g3y + syz * g3z, sxz * g3x + syz * g3y + szz * g3z
        f0x, f0y, f0z = -f1x - f2x - f3x, -f1y - f2y - f3y, -f1z - f2z - f3z
        for n, x, y, z in ((n0, f0x, f0y, f0z), (n1, f1x, f1y, f1z), (n2, f2x, f2y, f2z), (n3, f3x, f3y, f3z)):
            force[n, 0] += x
            force[n, 1] += y
            force[n, 2] += z
