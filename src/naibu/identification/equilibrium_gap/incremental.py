"""Incremental equilibrium gap method: node by node from the known region into the unknown one (:cite:p:`hirai2008`, section 3.3.2).

At a node that touches known cells the equilibrium of all load cases gives the moduli of its unknown cells; these count as known from then
on. A node with k unknown cells needs 2 k equations, hence at least two load cases in the plane. Errors accumulate from step to step:
`IncrementalStep.depth` counts the steps that a result depends on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.equilibrium_gap.batch import RANK_TOLERANCE, EquilibriumGapEstimate
from naibu.identification.equilibrium_gap.equations import LoadCaseEquations, load_case_equations, require_scale
from naibu.identification.from_fields.forward.load_cases import KNOWN, FieldLoadCase, Zones
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw


@dataclass(frozen=True, slots=True)
class IncrementalStep:
    """One node and the moduli that its equilibrium gave.

    Attributes
    ----------
    node : int
        Number of the node.
    zones : tuple of int
        Zones whose moduli it gave.
    equations : int
        Of all load cases at the node.
    condition : float
        Condition number of its equations, columns scaled to one length: the largest amplification of errors at this step.
    depth : int
        Number of consecutive steps that the result depends on, this one included.
    """

    node: int
    zones: tuple[int, ...]
    equations: int
    condition: float
    depth: int


@dataclass(frozen=True, slots=True, eq=False)
class IncrementalEstimate:
    """Moduli found step by step.

    Attributes
    ----------
    estimate : EquilibriumGapEstimate
        Moduli; NaN of zones that were not reached.
    steps : tuple of IncrementalStep
        In the order in which they were taken.
    """

    estimate: EquilibriumGapEstimate
    steps: tuple[IncrementalStep, ...]

    @property
    def depth(self) -> IntArray:
        """Number of steps (count,) that the moduli of every zone rest on; 0 where it was not reached."""
        out = np.zeros(len(self.estimate.names), dtype=np.int64)
        for step in self.steps:
            out[list(step.zones)] = step.depth
        return out


def incremental_equilibrium_gap(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    zones: Zones,
    *,
    law: SimplexLaw = "linear",
    thickness_mm: float = 1.0,
    order: Sequence[int] | None = None,
    partial: bool = False,
    rank_tolerance: float = RANK_TOLERANCE,
) -> IncrementalEstimate:
    """Identify the moduli of all zones step by step (:cite:p:`hirai2008`, section 3.3.2).

    Parameters
    ----------
    mesh, load_cases, zones, law, thickness_mm
        As for `naibu.identification.equilibrium_gap.batch.batch_equilibrium_gap`; zones are usually single cells.
    order : sequence of int, optional
        Nodes to use, one after the other. By default every step takes the node whose equations are conditioned best.
    partial : bool
        Whether to return what was reached where the steps end before the last zone, or to raise.
    rank_tolerance : float
        Singular values of a step below this fraction of its largest count as zero.

    Raises
    ------
    InputError
        Steps that end early (unless `partial`), a node of `order` that gives no result, or as for `load_case_equations`.
    """
    systems = load_case_equations(mesh, load_cases, zones, law=law, thickness_mm=thickness_mm)
    walk = _Walk.of(systems, zones, mesh, rank_tolerance)
    if order is None:
        while (node := walk.best()) is not None:
            walk.take(node)
    else:
        for node in order:
            walk.require(int(node))
            walk.take(int(node))
    if not partial and np.isnan(walk.moduli).any():
        raise InputError(walk.shortage(len(load_cases), mesh.dimension))
    return IncrementalEstimate(walk.estimate(), tuple(walk.steps))


@dataclass(frozen=True, slots=True, eq=False)
class _Node:
    """Equations of all load cases at a node: ``matrix`` (e, 2, k) times the moduli (2, k) of its zones is ``right`` (e,)."""

    zones: IntArray
    matrix: FloatArray
    right: FloatArray
    anchored: bool  # it meets a known cell or a known force, without which nothing follows from zeros


@dataclass(slots=True, eq=False)
class _Walk:
    """Moduli (2, count) found so far, NaN until then, and the condition numbers of the nodes as they are now."""

    nodes: dict[int, _Node]
    names: tuple[str, ...]
    tolerance: float
    moduli: FloatArray
    depth: IntArray
    conditions: dict[int, float]
    steps: list[IncrementalStep]

    @classmethod
    def of(cls, systems: Sequence[LoadCaseEquations], zones: Zones, mesh: Mesh, tolerance: float) -> _Walk:
        count = zones.count
        empty, none = np.full((2, count), np.nan), np.zeros(count, dtype=np.int64)
        return cls(_nodes(systems, zones, mesh), zones.names, tolerance, empty, none, {}, [])

    def best(self) -> int | None:
        """Return the node with open zones whose equations are conditioned best, or None."""
        for node in self.nodes:
            if node not in self.conditions:
                self.conditions[node] = self._condition(node)
        node, condition = min(self.conditions.items(), key=lambda item: item[1], default=(-1, np.inf))
        return node if np.isfinite(condition) else None

    def take(self, node: int) -> None:
        """Solve at a node and count what it gives as known."""
        matrix, right, found = self._local(node)
        condition, length = self._condition_of(matrix), np.linalg.norm(matrix, axis=0)
        self.moduli[:, found] = (np.linalg.lstsq(matrix / length, right, rcond=self.tolerance)[0] / length).reshape(2, -1)
        depth = 1 + int(self.depth[self.nodes[node].zones].max())
        self.depth[found] = depth
        self.steps.append(IncrementalStep(node, tuple(found.tolist()), len(right), condition, depth))
        for other, near in self.nodes.items():
            if np.isin(near.zones, found).any():
                self.conditions.pop(other, None)

    def require(self, node: int) -> None:
        """Refuse a node of a given order that gives no result."""
        if node not in self.nodes:
            raise InputError(f"node {node} is not in equilibrium in any load case, or meets no unknown cell; leave it out of the order")
        if not np.isfinite(self._condition(node)):
            _, right, found = self._local(node)
            raise InputError(
                f"node {node} cannot be taken now: {len(right)} equations for the {2 * len(found)} moduli of {len(found)} open zones, "
                "or they depend on each other; change the order, or add load cases"
            )

    def shortage(self, n_load_cases: int, dimension: int) -> str:
        """Say why the steps ended."""
        left = int(np.isnan(self.moduli[0]).sum())
        needs = [-(-2 * k // dimension) for node in self.nodes if (k := len(self._local(node)[2]))]
        more = (
            f"at least {min(needs)} independent load cases" if needs and min(needs) > n_load_cases else "load cases that push differently"
        )
        return (
            f"the steps ended after {len(self.names) - left} of {len(self.names)} zones: with {n_load_cases} load cases no node fixes "
            f"all its remaining zones; give {more}, join cells to zones, or use batch_equilibrium_gap, which solves for all nodes at once"
        )

    def estimate(self) -> EquilibriumGapEstimate:
        """Return the moduli, and how well they balance the nodes whose zones are all known."""
        reached = ~np.isnan(self.moduli[0])
        whole = [node for node in self.nodes.values() if reached[node.zones].all()]
        misfit = sum(float(((np.einsum("epk,pk->e", n.matrix, self.moduli[:, n.zones]) - n.right) ** 2).sum()) for n in whole)
        force = sum(float((n.right**2).sum()) for n in whole)
        return EquilibriumGapEstimate(
            self.names, self.moduli[0], self.moduli[1], None, np.column_stack([reached, reached]),
            sum(len(node.right) for node in self.nodes.values()), self.moduli.size, 2 * int(reached.sum()), np.zeros(0),
            float(np.sqrt(misfit / force)) if force else np.nan, len(self.steps),
        )  # fmt: skip

    def _local(self, node: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """Equations (e, 2 k) of the k open zones at a node, their right side (e,), and the zones."""
        n = self.nodes[node]
        values = self.moduli[:, n.zones]
        is_open = np.isnan(values[0])
        right = n.right - np.einsum("epk,pk->e", n.matrix, np.where(is_open, 0.0, values))
        return n.matrix[:, :, is_open].reshape(len(right), -1), right, n.zones[is_open]

    def _condition(self, node: int) -> float:
        """Condition number at a node; infinite where it cannot be taken."""
        matrix, right, found = self._local(node)
        reached = self.nodes[node].anchored or len(found) < len(self.nodes[node].zones)
        return self._condition_of(matrix) if reached and 0 < 2 * len(found) <= len(right) else np.inf

    def _condition_of(self, matrix: FloatArray) -> float:
        length = np.linalg.norm(matrix, axis=0)
        if not (length > 0.0).all():
            return np.inf
        singular = np.linalg.svd(matrix / length, compute_uv=False)
        return float(singular[0] / singular[-1]) if singular[-1] > self.tolerance * singular[0] else np.inf


def _nodes(systems: Sequence[LoadCaseEquations], zones: Zones, mesh: Mesh) -> dict[int, _Node]:
    """Gather the equations that hold an unknown by node."""
    parts, keep = [system.columns() for system in systems], np.concatenate([system.informative for system in systems])
    matrix = sp.csr_matrix(sp.vstack([part[0] for part in parts]))[keep]
    right = np.concatenate([part[1] for part in parts])[keep]
    require_scale(systems, right)
    node_of_row = np.concatenate([system.rows // mesh.dimension for system in systems])[keep]
    order = np.argsort(node_of_row, kind="stable")
    nodes, first = np.unique(node_of_row[order], return_index=True)
    pairs = np.unique(np.column_stack([mesh.cells.ravel(), np.repeat(zones.of_cell, mesh.cells.shape[1])]), axis=0)
    pushed = np.any([system.external_force.any(axis=1) for system in systems], axis=0)
    out = {}
    for node, rows in zip(nodes.tolist(), np.split(order, first[1:]), strict=True):
        near = pairs[slice(*np.searchsorted(pairs[:, 0], (node, node + 1))), 1]
        free = near[near != KNOWN]
        columns = matrix[rows][:, np.concatenate([free, free + zones.count])].toarray().reshape(len(rows), 2, -1)
        out[node] = _Node(free, columns, right[rows], bool(pushed[node] or len(free) < len(near)))
    return out
