"""Assembly with a given second Piola-Kirchhoff history stress beside the hyperelastic law, and recovery of the law's stress.

A stress H that is constant in the reference configuration during a step, such as that of the history variables of a viscoelastic solid
:cite:p:`simo1987`, derives from the energy ``H : C / 2``. It is evaluated at the same deformation gradient F_bar as the law, so that the
tangent of elements with mean dilatation remains symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.finite_elements.assembly import LARGE, Assembler, _add_forces, _colours, _contract, _deformation, _scratch, _soften
from naibu.mechanics.finite_elements.hyperelasticity import stress_and_tangent

_CHUNK = 64


@dataclass(frozen=True, slots=True, eq=False)
class HistoryAssembler(Assembler):
    """An assembler with a given history stress at its integration points, beside the stress of the law.

    Attributes
    ----------
    history : ndarray, shape (m, q, 3, 3), float64
        Second Piola-Kirchhoff stress, symmetric, kPa.
    """

    history: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3, 3)))
    _history_order: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    _history_start: IntArray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))

    @classmethod
    def of(cls, assembler: Assembler, history: FloatArray, parameters: FloatArray | None = None) -> HistoryAssembler:
        """Return `assembler` with a `history` (m, q, 3, 3), kPa, and, if given, other parameters (m, 4) of the cells."""
        known = {f.name: getattr(assembler, f.name) for f in fields(assembler)}
        if "_history_order" not in known:
            coloured = len(assembler._order) > 0  # single tetrahedra are divided among threads without colours
            e = assembler.elements
            order, start = (assembler._order, assembler._colour_start) if coloured else _colours(e.connectivity, e.n_points)
            known |= {"_history_order": order, "_history_start": start}
        known |= {"history": np.ascontiguousarray(history)}
        if parameters is not None:
            known |= {"parameters": parameters}
        return cls(**known)

    def forces_of_parameter(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative (n, 3) of the internal forces along `direction` (m, 4) in the cells' parameters; the history has none."""
        return Assembler._run(self, displacement, direction, np.empty((0, 3, 3)))[1]

    def _run(self, displacement: FloatArray, parameters: FloatArray, blocks: FloatArray) -> tuple[float, FloatArray, float]:
        energy, force, smallest = Assembler._run(self, displacement, parameters, blocks)
        if not smallest > 0.0:
            return energy, force, smallest
        add = _add_large if len(self.elements.connectivity) > LARGE else _add_small
        energy += add(
            self._history_order, self._history_start, self.elements.connectivity, self.elements.gradients, self.elements.weights,
            self.elements.shared_dilatation, self.history, np.ascontiguousarray(displacement), self._positions, force, blocks,
        )  # fmt: skip
        return float(energy), force, smallest


def second_piola(assembler: Assembler, parameters: FloatArray, displacement: FloatArray) -> FloatArray:
    """Return the second Piola-Kirchhoff stress (m, q, 3, 3), kPa, of the laws with `parameters` (m, 4) at all points; 0 where padded."""
    e = assembler.elements
    out = np.zeros((*e.weights.shape, 3, 3))
    evaluate = _stress_large if len(e.connectivity) > LARGE else _stress_small
    evaluate(
        e.connectivity, e.gradients, e.weights, e.cell_of_point, e.shared_dilatation, assembler.law_codes, parameters,
        np.ascontiguousarray(displacement), out,
    )  # fmt: skip
    return out


def _stresses(connectivity, gradients, weights, cells, shared, codes, parameters, u, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Second Piola-Kirchhoff stress at all points, ``F^-1 P``."""
    q_count = weights.shape[1]
    for e in prange(len(connectivity)):
        f, ft_inv, det = np.empty((q_count, 3, 3)), np.empty((q_count, 3, 3)), np.empty(q_count)
        stress, c, d, tangent = np.empty((3, 3)), np.empty((3, 3)), np.empty(9), np.empty((9, 9))
        _deformation(connectivity[e], gradients[e], weights[e], u, f, ft_inv, det)
        theta = _shared_dilatation(weights[e], det)
        for q in range(q_count):
            if weights[e, q] == 0.0:
                continue
            scale = (theta / det[q]) ** (1.0 / 3.0) if shared else 1.0
            for i in range(3):
                for j in range(3):
                    f[q, i, j] *= scale
                    ft_inv[q, i, j] /= scale
            cell = cells[e, q]
            j_bar = theta if shared else det[q]
            stress_and_tangent(codes[cell], parameters[cell], f[q], ft_inv[q], j_bar, d, c, stress, tangent, False)
            for i in range(3):
                for j in range(3):
                    v = 0.0
                    for k in range(3):
                        v += ft_inv[q, k, i] * stress[k, j]
                    out[e, q, i, j] = v


@njit(cache=True)
def _shared_dilatation(weights, det):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Mean of det F over the points of a group."""
    theta, volume = 0.0, 0.0
    for q in range(len(weights)):
        if weights[q] > 0.0:
            theta += weights[q] * det[q]
            volume += weights[q]
    return theta / volume


def _add(order, colour_start, connectivity, gradients, weights, shared, history, u, positions, force, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add forces and tangent of the history, colour after colour, chunks of groups in parallel; returns its energy."""
    q, k = weights.shape[1], connectivity.shape[1]
    energy = 0.0
    for colour in range(len(colour_start) - 1):
        start, stop = colour_start[colour], colour_start[colour + 1]
        n_chunks = (stop - start + _CHUNK - 1) // _CHUNK
        energies = np.zeros(n_chunks)
        for chunk in prange(n_chunks):
            f, ft_inv, det = np.empty((q, 3, 3)), np.empty((q, 3, 3)), np.empty(q)
            work = _scratch(q, k)
            for at in range(start + chunk * _CHUNK, min(stop, start + (chunk + 1) * _CHUNK)):
                e = order[at]
                _deformation(connectivity[e], gradients[e], weights[e], u, f, ft_inv, det)
                energies[chunk] += _add_group(
                    connectivity[e], gradients[e], weights[e], shared, history[e], f, ft_inv, det, work, positions[e], force, blocks
                )
        energy += energies.sum()
    return energy


@njit(cache=True)
def _add_group(nodes, gradients, weights, shared, history, f, ft_inv, det, work, positions, force, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add forces ``P = F H`` and their tangent for one group; returns ``H : (C - 1) / 2`` times the volume."""
    _, _, stress, _, tangent, _, v9, t, m, s, k_local, temporary = work
    theta, volume, energy, total_s = _shared_dilatation(weights, det), weights.sum(), 0.0, 0.0
    for q in range(len(weights)):
        w = weights[q]
        if w == 0.0:
            continue
        scale = (theta / det[q]) ** (1.0 / 3.0) if shared else 1.0
        s[q] = 0.0
        for i in range(3):
            energy -= 0.5 * w * history[q, i, i]
            for j in range(3):
                v = 0.0
                for k in range(3):
                    v += f[q, i, k] * history[q, k, j]
                stress[q, i, j] = scale * v
                energy += 0.5 * w * scale * scale * v * f[q, i, j]
                s[q] += w * scale * scale * v * f[q, i, j] / 3.0
        total_s += s[q]
    _add_forces(nodes, gradients, weights, shared, theta, volume, total_s, s, ft_inv, det, stress, force)
    if len(blocks) == 0:
        return energy
    tangent[:] = 0.0
    for q in range(len(weights)):
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    tangent[q, 3 * i + j, 3 * i + k] = history[q, j, k]
    k_local[:] = 0.0
    if shared:
        _soften(gradients, weights, theta, volume, total_s, s, f, ft_inv, det, stress, tangent, v9, t, m, k_local)
    _contract(gradients, weights, shared, tangent, temporary, k_local)
    for a in range(len(nodes)):
        for b in range(len(nodes)):
            block = blocks[positions[a, b]]
            for i in range(3):
                for j in range(3):
                    block[i, j] += k_local[3 * a + i, 3 * b + j]
    return energy


_stress_small = njit(cache=True, nogil=True)(_stresses)
_stress_large = njit(cache=True, parallel=True)(_stresses)
_add_small = njit(cache=True, nogil=True)(_add)
_add_large = njit(cache=True, parallel=True)(_add)
