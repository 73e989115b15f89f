"""Internal forces and tangent stiffness of hyperelastic elements with mean dilatation :cite:p:`simo1985`, in a fixed block pattern."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.finite_elements._hex8_kernels import are_hexahedra_of_first_invariant
from naibu.mechanics.finite_elements._hex8_kernels import assemble_large as _hexahedra_large
from naibu.mechanics.finite_elements._hex8_kernels import assemble_small as _hexahedra_small
from naibu.mechanics.finite_elements._tet4_kernels import ThreadPartition, partition, thread_count
from naibu.mechanics.finite_elements._tet4_kernels import assemble_large as _tetrahedra_large
from naibu.mechanics.finite_elements._tet4_kernels import assemble_small as _tetrahedra_small
from naibu.mechanics.finite_elements.elements import Elements
from naibu.mechanics.finite_elements.hyperelasticity import Material, inverse_transpose, parameter_table, stress_and_tangent
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern, block_pattern

_CHUNK = 64
LARGE = 4000  # groups from which several threads are faster than one


@dataclass(frozen=True, slots=True, eq=False)
class Assembler:
    """Internal forces and tangent stiffness of elements with materials, for any displacement.

    Attributes
    ----------
    elements : Elements
        The groups of nodes and integration points.
    law_codes : ndarray, shape (m,), int64
        Law of every cell.
    parameters : ndarray, shape (m, 4), float64
        Parameters of every cell, kPa.
    pattern : BlockPattern
        Sparsity of the tangent.
    """

    elements: Elements
    law_codes: IntArray
    parameters: FloatArray
    pattern: BlockPattern
    _positions: Int32Array
    _order: IntArray
    _colour_start: IntArray
    _partition: ThreadPartition | None = None

    @classmethod
    def from_materials(
        cls, elements: Elements, regions: IntArray, materials: list[Material], pattern: BlockPattern | None = None
    ) -> Assembler:
        """Combine elements with one material for each region.

        Parameters
        ----------
        elements : Elements
            Groups of nodes and integration points.
        regions : ndarray, shape (m,), int64
            Region of every cell.
        materials : list of Material
            One for each region.
        pattern : BlockPattern, optional
            Sparsity of the tangent, where it must include more couplings than those of the elements (contacts).

        Raises
        ------
        InputError
            A region without a material.
        """
        codes, parameters = parameter_table(materials, regions)
        chosen = block_pattern(elements.n_points, elements.connectivity) if pattern is None else pattern
        positions = chosen.positions(elements.connectivity)
        if elements.weights.shape[1] == 1 and elements.connectivity.shape[1] == 4 and not elements.shared_dilatation:
            none = np.empty(0, dtype=np.int64)
            return cls(elements, codes, parameters, chosen, positions, none, none, _divided(elements, chosen))
        order, start = _colours(elements.connectivity, elements.n_points)
        return cls(elements, codes, parameters, chosen, positions, order, start)

    def with_couplings(self, *connectivities: IntArray) -> Assembler:
        """Return the assembler with a tangent that also has places for the couplings of other groups (m, k) of nodes."""
        rows = np.repeat(np.arange(self.pattern.n_points), np.diff(self.pattern.indptr))
        known = np.stack([rows, self.pattern.indices.astype(np.int64)], axis=1)
        pattern = block_pattern(self.pattern.n_points, known[known[:, 0] <= known[:, 1]], *connectivities)
        parts = None if self._partition is None else _divided(self.elements, pattern)
        return replace(self, pattern=pattern, _positions=pattern.positions(self.elements.connectivity), _partition=parts)

    def with_parameters(self, parameters: FloatArray) -> Assembler:
        """Return the same assembler with other parameters (m, 4) of the cells, kPa."""
        return replace(self, parameters=parameters)

    def with_elements(self, elements: Elements) -> Assembler:
        """Return the same assembler for other elements of the same connectivity (moved nodes)."""
        return replace(self, elements=elements)

    def evaluate(self, displacement: FloatArray) -> tuple[float, FloatArray, FloatArray, float]:
        """Return energy, internal forces and tangent stiffness.

        Parameters
        ----------
        displacement : ndarray, shape (n, 3)
            Displacement of the nodes, mm.

        Returns
        -------
        energy : float
            Strain energy, mN mm.
        force : ndarray, shape (n, 3)
            Internal forces, mN.
        blocks : ndarray, shape (n_blocks, 3, 3)
            Blocks of the tangent, mN/mm, in the order of `pattern`.
        smallest : float
            Smallest det F; where it is not positive the other values are meaningless.
        """
        blocks = np.zeros((self.pattern.n_blocks, 3, 3))
        energy, force, smallest = self._run(displacement, self.parameters, blocks)
        return energy, force, blocks, smallest

    def forces(self, displacement: FloatArray) -> tuple[float, FloatArray, float]:
        """Return energy (mN mm), internal forces (n, 3), mN, and the smallest det F, without the tangent.

        Parameters
        ----------
        displacement : ndarray, shape (n, 3)
            Displacement of the nodes, mm.
        """
        return self._run(displacement, self.parameters, np.empty((0, 3, 3)))

    def forces_of_parameter(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative (n, 3) of the internal forces at a displacement (n, 3), mm, along a direction (m, 4) of parameters, kPa.

        Every law is linear in its parameters, so this is the internal force of the parameters `direction`.
        """
        return self._run(displacement, direction, np.empty((0, 3, 3)))[1]

    @property
    def unsymmetric(self) -> bool:
        """Whether the tangent is unsymmetric; that of elements is not."""
        return False

    def in_step(self, displacement: FloatArray, lips: FloatArray | None = None) -> Assembler:
        """Return the assembler of a time step that begins at a displacement (n, 3), mm; here the same."""
        return self

    def add_contact_of_lips(self, displacement: FloatArray, force: FloatArray) -> None:
        """Add the forces of the two sides of cuts on each other to internal forces (n, 3), mN; here there are none."""

    def _run(self, displacement: FloatArray, parameters: FloatArray, blocks: FloatArray) -> tuple[float, FloatArray, float]:
        force = np.zeros((self.elements.n_points, 3))
        if self._partition is not None:
            return self._run_tetrahedra(self._partition, np.ascontiguousarray(displacement), parameters, force, blocks)
        large = len(self.elements.connectivity) > LARGE
        if are_hexahedra_of_first_invariant(self.elements, self.law_codes):
            hexahedra = _hexahedra_large if large else _hexahedra_small
            energy, smallest = hexahedra(
                self._order, self._colour_start, self.elements.connectivity, self.elements.gradients, self.elements.weights,
                self.elements.cell_of_point, self.law_codes, parameters, np.ascontiguousarray(displacement), self._positions, force, blocks,
            )  # fmt: skip
            return float(energy), force, float(smallest)
        assemble = _assemble_large if large else _assemble_small
        energy, smallest = assemble(
            self._order, self._colour_start, self.elements.connectivity, self.elements.gradients, self.elements.weights,
            self.elements.cell_of_point, self.elements.shared_dilatation, self.law_codes, parameters,
            np.ascontiguousarray(displacement), self._positions, force, blocks,
        )  # fmt: skip
        return float(energy), force, float(smallest)

    def _run_tetrahedra(
        self,
        parts: ThreadPartition,
        displacement: FloatArray,
        parameters: FloatArray,
        force: FloatArray,
        blocks: FloatArray,
    ) -> tuple[float, FloatArray, float]:
        e = self.elements
        assemble = _tetrahedra_large if len(parts.start) > 2 else _tetrahedra_small
        energy, smallest = assemble(
            parts.owner, parts.start, parts.cells, e.connectivity, e.gradients, e.weights, e.cell_of_point, self.law_codes, parameters,
            displacement, self._positions, force, blocks,
        )  # fmt: skip
        return float(energy), force, float(smallest)


def _divided(elements: Elements, pattern: BlockPattern) -> ThreadPartition:
    """Divide single tetrahedra among threads."""
    count = thread_count() if len(elements.connectivity) > LARGE else 1
    return partition(elements.connectivity, pattern.indptr, pattern.indices, count)


def body_force(elements: Elements, density_of_cell: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Return the nodal forces (n, 3), mN, of the weight of the cells, lumped to their nodes.

    Parameters
    ----------
    elements : Elements
        Groups of nodes and integration points.
    density_of_cell : ndarray, shape (m,)
        kg/mm3 (water: 1e-6).
    acceleration : ndarray, shape (3,)
        mm/s2, usually (0, 0, -9810).
    """
    weight = elements.weights * density_of_cell[elements.cell_of_point]
    used = np.any(elements.gradients != 0.0, axis=3)
    nodal = weight[:, :, None] * used / np.maximum(used.sum(axis=2, keepdims=True), 1)
    mass = np.bincount(elements.connectivity.ravel(), nodal.sum(axis=1).ravel(), minlength=elements.n_points)
    return mass[:, None] * acceleration


@njit(cache=True)
def _greedy_colours(connectivity, n_points):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Colour groups so that no two of one colour share a node (bit masks of the colours met at each node)."""
    colour = np.empty(len(connectivity), np.int64)
    met = np.zeros((n_points, 4), np.uint64)
    for e in range(len(connectivity)):
        found = -1
        for word in range(4):
            taken = np.uint64(0)
            for node in connectivity[e]:
                taken |= met[node, word]
            for bit in range(64):
                if not (taken >> np.uint64(bit)) & np.uint64(1):
                    found = 64 * word + bit
                    break
            if found >= 0:
                break
        colour[e] = found
        for node in connectivity[e]:
            met[node, found // 64] |= np.uint64(1) << np.uint64(found % 64)
    return colour


def _colours(connectivity: IntArray, n_points: int) -> tuple[IntArray, IntArray]:
    """Return groups sorted by colour, and where each colour starts; groups of one colour share no node."""
    colour = _greedy_colours(connectivity, n_points)
    if colour.min() < 0:
        raise ValueError("a node belongs to more than 256 elements")
    order = np.argsort(colour, kind="stable").astype(np.int64)
    start = np.concatenate([[0], np.cumsum(np.bincount(colour))]).astype(np.int64)
    return order, start


def _assemble(  # type: ignore[no-untyped-def]  # pragma: no cover
    order, colour_start, connectivity, gradients, weights, cells, shared, codes, parameters, u, positions, force, blocks
):
    """Colour after colour, chunks of groups in parallel; returns energy and smallest det F."""
    q, k = weights.shape[1], connectivity.shape[1]
    energy, smallest = 0.0, np.inf
    for colour in range(len(colour_start) - 1):
        start, stop = colour_start[colour], colour_start[colour + 1]
        n_chunks = (stop - start + _CHUNK - 1) // _CHUNK
        energies = np.zeros(n_chunks)
        determinants = np.full(n_chunks, np.inf)
        for chunk in prange(n_chunks):
            f, ft_inv, det = np.empty((q, 3, 3)), np.empty((q, 3, 3)), np.empty(q)
            work = _scratch(q, k)
            for at in range(start + chunk * _CHUNK, min(stop, start + (chunk + 1) * _CHUNK)):
                e = order[at]
                lowest = _deformation(connectivity[e], gradients[e], weights[e], u, f, ft_inv, det)
                determinants[chunk] = min(determinants[chunk], lowest)
                if lowest > 0.0:
                    energies[chunk] += _group(
                        connectivity[e], gradients[e], weights[e], cells[e], shared, codes, parameters,
                        f, ft_inv, det, work, positions[e], force, blocks,
                    )  # fmt: skip
        for chunk in range(n_chunks):
            energy += energies[chunk]
            smallest = min(smallest, determinants[chunk])
    return energy, smallest


# Small meshes are assembled by one thread, so that several problems can be solved side by side; large ones by all.
_assemble_small = njit(cache=True, nogil=True)(_assemble)
_assemble_large = njit(cache=True, parallel=True)(_assemble)


@njit(cache=True)
def _scratch(q, k):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Work arrays of one thread: fbar, g, stress, c, tangent, d, v9, t, m, s, k_local, temporary."""
    return (
        np.empty((3, 3)), np.empty((3, 3)), np.empty((q, 3, 3)), np.empty((3, 3)), np.empty((q, 9, 9)), np.empty(9),
        np.empty((2, 9)), np.empty(3 * k), np.empty(3 * k), np.empty(q), np.empty((3 * k, 3 * k)), np.empty((9, 3 * k)),
    )  # fmt: skip


@njit(cache=True)
def _deformation(nodes, gradients, weights, u, f, ft_inv, det):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Deformation gradients, their inverse transposes and determinants at the points; returns the smallest determinant."""
    lowest = np.inf
    for q in range(len(weights)):
        if weights[q] == 0.0:
            continue
        fq = f[q]
        for i in range(3):
            for j in range(3):
                v = 1.0 if i == j else 0.0
                for a in range(len(nodes)):
                    v += u[nodes[a], i] * gradients[q, a, j]
                fq[i, j] = v
        det[q] = inverse_transpose(fq, ft_inv[q])
        lowest = min(lowest, det[q])
    return lowest


@njit(cache=True)
def _group(  # type: ignore[no-untyped-def]  # pragma: no cover
    nodes, gradients, weights, cells, shared, codes, parameters, f, ft_inv, det, work, positions, force, blocks
):
    """Add forces and tangent of one group; returns its energy. See the module `elements` for the formulation."""
    fbar, gbar, stress, c, tangent, d, v9, t, m, s, k_local, temporary = work
    with_tangent = len(blocks) > 0
    energy, theta, volume = 0.0, 0.0, 0.0
    if shared:
        for q in range(len(weights)):
            theta += weights[q] * det[q] if weights[q] > 0.0 else 0.0
            volume += weights[q]
        theta /= volume
    total_s = 0.0
    for q in range(len(weights)):
        w = weights[q]
        if w == 0.0:
            continue
        scale = (theta / det[q]) ** (1.0 / 3.0) if shared else 1.0
        for i in range(3):
            for j in range(3):
                fbar[i, j] = scale * f[q, i, j]
                gbar[i, j] = ft_inv[q, i, j] / scale
        j_bar = theta if shared else det[q]
        energy += w * stress_and_tangent(
            codes[cells[q]], parameters[cells[q]], fbar, gbar, j_bar, d, c, stress[q], tangent[q], with_tangent
        )
        if shared:
            s[q] = 0.0
            for i in range(3):
                for j in range(3):
                    s[q] += w * scale * stress[q, i, j] * f[q, i, j] / 3.0
            total_s += s[q]
    _add_forces(nodes, gradients, weights, shared, theta, volume, total_s, s, ft_inv, det, stress, force)
    if with_tangent:
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


@njit(cache=True)
def _add_forces(nodes, gradients, weights, shared, theta, volume, total_s, s, ft_inv, det, stress, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the nodal forces: w c Pbar + (S w J / (Theta V) - s) F^-T, contracted with the gradients."""
    for q in range(len(weights)):
        w = weights[q]
        if w == 0.0:
            continue
        scale, extra = w, 0.0
        if shared:
            scale = w * (theta / det[q]) ** (1.0 / 3.0)
            extra = total_s * w * det[q] / (theta * volume) - s[q]
        for i in range(3):
            p0 = scale * stress[q, i, 0] + extra * ft_inv[q, i, 0]
            p1 = scale * stress[q, i, 1] + extra * ft_inv[q, i, 1]
            p2 = scale * stress[q, i, 2] + extra * ft_inv[q, i, 2]
            for a in range(len(nodes)):
                force[nodes[a], i] += p0 * gradients[q, a, 0] + p1 * gradients[q, a, 1] + p2 * gradients[q, a, 2]


@njit(cache=True)
def _soften(gradients, weights, theta, volume, total_s, s, f, ft_inv, det, stress, tangent, v9, t, m, k_local):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Turn the tangents dPbar/dFbar into those of the averaged dilatation (weights included), and add the couplings to `k_local`.

    With b = F^-T : dF and t = dTheta / Theta, dFbar = c (dF + F (t - b) / 3). The second variation of W(Fbar) has a part local to a
    point, put into `tangent`, and parts with t, which couple all points of the group: m t + t m + kappa t t.
    """
    n = len(t)
    t[:] = 0.0
    m[:] = 0.0
    kappa = -total_s
    for q in range(len(weights)):
        w = weights[q]
        if w == 0.0:
            continue
        scale = (theta / det[q]) ** (1.0 / 3.0)
        ratio = w * det[q] / (theta * volume)
        a = tangent[q]
        left, vector = v9[0], v9[1]
        faf = 0.0
        for i in range(9):
            v = 0.0
            for j in range(9):
                v += a[i, j] * f[q, j // 3, j % 3]
            left[i] = v
            faf += v * f[q, i // 3, i % 3]
        wc2 = w * scale * scale
        wc = w * scale
        geometric = s[q] - total_s * ratio
        bb = wc2 * faf / 9.0 + s[q] / 3.0 + total_s * ratio
        kappa += wc2 * faf / 9.0 + s[q] / 3.0
        for i in range(9):
            bi, pi = ft_inv[q, i // 3, i % 3], stress[q, i // 3, i % 3]
            for j in range(9):
                bj, pj = ft_inv[q, j // 3, j % 3], stress[q, j // 3, j % 3]
                v = wc2 * (a[i, j] - (left[i] * bj + bi * left[j]) / 3.0) - wc / 3.0 * (pi * bj + bi * pj)
                a[i, j] = v + bb * bi * bj + geometric * ft_inv[q, i // 3, j % 3] * ft_inv[q, j // 3, i % 3]
            vector[i] = wc2 / 3.0 * (left[i] - faf * bi / 3.0) + wc / 3.0 * pi - s[q] / 3.0 * bi
        for node in range(n // 3):
            for i in range(3):
                for j in range(3):
                    g = gradients[q, node, j]
                    t[3 * node + i] += ratio * ft_inv[q, i, j] * g
                    m[3 * node + i] += vector[3 * i + j] * g
    for i in range(n):
        for j in range(n):
            k_local[i, j] += m[i] * t[j] + t[i] * m[j] + kappa * t[i] * t[j]


@njit(cache=True)
def _contract(gradients, weights, shared, tangent, temporary, k_local):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add sum_q G^T A G to `k_local`, computing one triangle of this symmetric matrix."""
    k = gradients.shape[1]
    for q in range(len(weights)):
        if weights[q] == 0.0:
            continue
        w = 1.0 if shared else weights[q]
        a = tangent[q]
        for r in range(9):
            for b in range(k):
                g0, g1, g2 = w * gradients[q, b, 0], w * gradients[q, b, 1], w * gradients[q, b, 2]
                for i in range(3):
                    temporary[r, 3 * b + i] = a[r, 3 * i] * g0 + a[r, 3 * i + 1] * g1 + a[r, 3 * i + 2] * g2
        for n in range(k):
            g0, g1, g2 = gradients[q, n, 0], gradients[q, n, 1], gradients[q, n, 2]
            for i in range(3):
                row = 3 * n + i
                for col in range(row, 3 * k):
                    k_local[row, col] += g0 * temporary[3 * i, col] + g1 * temporary[3 * i + 1, col] + g2 * temporary[3 * i + 2, col]
    for row in range(3 * k):
        for col in range(row):
            k_local[row, col] = k_local[col, row]
