"""Equations of the equilibrium gap: at a node without unknown external force, internal forces equal the known external one.

This is equation (3.20) of :cite:t:`hirai2008` at all nodes of all load cases: ``A x = b`` with the moduli x of the zones (lambda of every
zone, then mu of every zone) and b, the external forces less those of the known cells. A node gives equations only if a displacement is
known at every node of every cell around it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import Delaunay, QhullError, cKDTree

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import KNOWN, FieldLoadCase, Zones
from naibu.identification.load_case import require_load_cases
from naibu.mechanics.finite_elements.linear_simplices import Simplices, simplices
from naibu.mechanics.finite_elements.modulus_derivatives import SimplexLaw, cell_tangents, unit_forces

SAME_PLACE = 1e-9  # distance at which a point of the field is a node, in extents of the mesh
OUTSIDE = 1e-9  # barycentric coordinate to which a node still counts as inside the points of the field


@dataclass(frozen=True, slots=True, eq=False)
class NodalField:
    """A measured field at the nodes of a mesh.

    Attributes
    ----------
    displacement : ndarray, shape (n, d)
        mm; zero where there are no data.
    weights : sparse matrix, shape (n, k)
        What the k points of the field contribute to every node; an empty row where there are no data.
    covariance : sparse matrix, shape (n d, n d)
        Of the displacement of the nodes, mm^2, component by component of every node.
    """

    displacement: FloatArray
    weights: sp.csr_matrix
    covariance: sp.csr_matrix

    @property
    def has_data(self) -> BoolArray:
        """Nodes with a displacement (n,)."""
        return np.asarray(np.diff(self.weights.indptr) > 0)

    @property
    def interpolated(self) -> BoolArray:
        """Nodes whose displacement comes from several points (n,)."""
        return np.asarray(np.diff(self.weights.indptr) > 1)


def nodal_field(field: DisplacementField, mesh: Mesh) -> NodalField:
    """Interpolate a measured field to the nodes of a mesh.

    Where every node is a point of the field, nodes take its vectors, and nodes at points that are not valid have none. Any other field is
    interpolated linearly in the Delaunay simplices of its valid points; nodes outside of them have no data.

    Raises
    ------
    InputError
        Too few valid points for simplices, or points on one plane.
    """
    field = field.at_points()
    weights = _weights_of_same_points(field, mesh.points)
    if weights is None:
        weights = _interpolation_weights(field, mesh.points)
    d = mesh.dimension
    vectors = np.where(field.valid[:, None], field.vectors, 0.0)
    k = len(field.points)
    covariance = np.zeros((k, d, d)) if field.covariance is None else np.where(field.valid[:, None, None], field.covariance, 0.0)
    of_points = sp.bsr_matrix((covariance, np.arange(k), np.arange(k + 1)), shape=(k * d, k * d))
    spread = sp.kron(weights, sp.identity(d), format="csr")
    return NodalField(np.asarray(weights @ vectors), weights, sp.csr_matrix(spread @ of_points @ spread.T))


def _weights_of_same_points(field: DisplacementField, nodes: FloatArray) -> sp.csr_matrix | None:
    """Ones where nodes take the vectors of the field's own points; None where some node is no point of the field."""
    distance, nearest = (np.asarray(found) for found in cKDTree(field.points).query(nodes))
    if distance.max() > SAME_PLACE * float(np.ptp(nodes, axis=0).max()):
        return None
    rows = np.flatnonzero(field.valid[nearest])
    return sp.csr_matrix((np.ones(len(rows)), (rows, nearest[rows])), shape=(len(nodes), len(field.points)))


def _interpolation_weights(field: DisplacementField, nodes: FloatArray) -> sp.csr_matrix:
    """Barycentric weights of the valid points around every node inside them."""
    valid = np.flatnonzero(field.valid)
    d = nodes.shape[1]
    if len(valid) < d + 1:
        raise InputError(f"the field has {len(valid)} valid points; {d + 1} are needed to interpolate it to the nodes")
    if d == 1:
        order = valid[np.argsort(field.points[valid, 0])]
        cells = np.column_stack([order[:-1], order[1:]])
        found = np.searchsorted(field.points[order, 0], nodes[:, 0]).clip(1, len(order) - 1) - 1
        second = (nodes[:, 0] - field.points[cells[found, 0], 0]) / np.diff(field.points[cells[found], 0], axis=1)[:, 0]
        coordinates = np.column_stack([1.0 - second, second])
        inside = (coordinates >= -OUTSIDE).all(axis=1)
    else:
        try:
            delaunay = Delaunay(field.points[valid])
        except QhullError as error:
            raise InputError("the valid points of the field lie on one plane or line, so it cannot be interpolated to the nodes") from error
        cells = valid[delaunay.simplices]
        found = delaunay.find_simplex(nodes, tol=OUTSIDE)
        inside = found >= 0
        transform = delaunay.transform[found]
        inner = np.einsum("nij,nj->ni", transform[:, :d], nodes - transform[:, d])
        coordinates = np.column_stack([inner, 1.0 - inner.sum(axis=1)])
        inside &= np.isfinite(coordinates).all(axis=1)
    rows = np.flatnonzero(inside)
    values = np.where(np.abs(coordinates[rows]) < OUTSIDE, 0.0, coordinates[rows])
    matrix = sp.csr_matrix((values.ravel(), (np.repeat(rows, d + 1), cells[found[rows]].ravel())), shape=(len(nodes), len(field.points)))
    matrix.eliminate_zeros()
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class LoadCaseEquations:
    """The equations of one load case.

    Attributes
    ----------
    name : str
        Of the load case.
    field : NodalField
        Measured displacement of the nodes.
    body : Simplices
        The cells with data at all nodes.
    cells : ndarray, shape (c,), int64
        Their numbers in the mesh.
    rows : ndarray, shape (e,), int64
        Components (node times d plus axis) in equilibrium.
    external_force : ndarray, shape (n, d)
        Known forces on the nodes, mN.
    law : str
        See `naibu.mechanics.finite_elements.modulus_derivatives`.
    zones : Zones
        Of all cells of the mesh.
    """

    name: str
    field: NodalField
    body: Simplices
    cells: IntArray
    rows: IntArray
    external_force: FloatArray
    law: SimplexLaw
    zones: Zones

    @property
    def informative(self) -> BoolArray:
        """Equations with an unknown modulus (e,); the others only constrain the displacement."""
        touched = np.zeros(self.body.n_points, dtype=bool)
        touched[self.body.cells[self.zones.of_cell[self.cells] != KNOWN].ravel()] = True
        return np.asarray(touched[self.rows // self.body.dimension])

    def columns(self, displacement: FloatArray | None = None) -> tuple[sp.csr_matrix, FloatArray]:
        """Return ``A`` (e, 2 count), mm^2, and ``b`` (e,), mN, at a displacement (n, d), mm, the measured one by default.

        Raises
        ------
        InputError
            A cell is turned inside out and the law is one for finite strain.
        """
        forces = self._unit_forces(self.field.displacement if displacement is None else displacement)
        d, zone = self.body.dimension, self.zones.of_cell[self.cells]
        free, n_rows = zone != KNOWN, self.body.n_points * d
        components = (self.body.cells[free][:, :, None] * d + np.arange(d)).ravel()
        parts = []
        for force in forces:
            at = np.repeat(zone[free], (d + 1) * d)
            parts.append(sp.csr_matrix((force[free].ravel(), (components, at)), shape=(n_rows, self.zones.count))[self.rows])
        moduli = (self.zones.known_lambda[self.cells], self.zones.known_mu[self.cells])
        known = sum(np.where(free, 0.0, value)[:, None, None] * force for value, force in zip(moduli, forces, strict=True))
        right = self.external_force - self.body.scattered(np.asarray(known))
        return sp.csr_matrix(sp.hstack(parts)), right.ravel()[self.rows]

    def tangent(self, displacement: FloatArray, moduli: FloatArray) -> sp.csr_matrix:
        """Return the derivative (e, n d) of ``A x - b``, mN/mm, by the displacement, at moduli x (2 count,), kPa."""
        lame, shear = (value[self.cells] for value in self.zones.per_cell(*moduli.reshape(2, -1)))
        with _named(self.name):
            blocks = cell_tangents(self.body, displacement, lame, shear, self.law)
        d, n = self.body.dimension, self.body.n_points
        index = self.body.cells[:, :, None] * d + np.arange(d)
        row = np.broadcast_to(index[:, :, :, None, None], blocks.shape)
        column = np.broadcast_to(index[:, None, None, :, :], blocks.shape)
        whole = sp.csr_matrix((blocks.ravel(), (row.ravel(), column.ravel())), shape=(n * d, n * d))
        return sp.csr_matrix(whole[self.rows])

    def _unit_forces(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        with _named(self.name):
            return unit_forces(self.body, displacement, self.law)


@contextmanager
def _named(load_case: str) -> Iterator[None]:
    """Add the name of the load case to errors."""
    try:
        yield
    except InputError as error:
        raise InputError(f"load case {load_case!r}: {error}") from error


def load_case_equations(
    mesh: Mesh, load_cases: Sequence[FieldLoadCase], zones: Zones, *, law: SimplexLaw = "linear", thickness_mm: float = 1.0
) -> tuple[LoadCaseEquations, ...]:
    """Return the equations of all load cases.

    Parameters
    ----------
    mesh : Mesh
        Lines, triangles (plane strain) or linear tetrahedra.
    load_cases : sequence of FieldLoadCase
        At least one.
    zones : Zones
        Of the cells of `mesh`.
    law : {"linear", "neo_hookean", "saint_venant_kirchhoff"}
        See `naibu.mechanics.finite_elements.modulus_derivatives`.
    thickness_mm : float
        Of triangles.

    Raises
    ------
    InputError
        No load case, shapes that do not fit the mesh, known cells without moduli, or a load case in which no node gives an equation.
    """
    body = simplices(mesh, thickness_mm=thickness_mm)
    require_load_cases(load_cases)
    _check_zones(zones, mesh)
    return tuple(_equations_of(mesh, body, load_case, zones, law) for load_case in load_cases)


def _check_zones(zones: Zones, mesh: Mesh) -> None:
    if zones.of_cell.shape != (mesh.n_cells,):
        raise InputError(f"the zones are for {len(zones.of_cell)} cells, the mesh has {mesh.n_cells}; make them of the same mesh")
    known = zones.of_cell == KNOWN
    finite = np.isfinite(zones.known_lambda) & np.isfinite(zones.known_mu)
    if (known & ~finite).any():
        raise InputError(f"cell {int(np.flatnonzero(known & ~finite)[0])} is called known, but its moduli are not finite numbers")


def _equations_of(mesh: Mesh, body: Simplices, load_case: FieldLoadCase, zones: Zones, law: SimplexLaw) -> LoadCaseEquations:
    if load_case.loaded.shape != mesh.points.shape:
        raise InputError(f"load case {load_case.name!r} was made for {len(load_case.loaded)} nodes, the mesh has {mesh.n_points}")
    with _named(load_case.name):
        field = nodal_field(load_case.field, mesh)
    has = field.has_data
    whole = has[mesh.cells].all(axis=1)
    used = np.zeros(mesh.n_points, dtype=bool)
    used[mesh.cells.ravel()] = True
    used[mesh.cells[~whole].ravel()] = False
    balanced = used[:, None] & ~load_case.loaded
    cells = np.flatnonzero(whole)
    if not balanced.any():
        raise InputError(
            f"load case {load_case.name!r} gives no equation: {int(has.sum())} of {mesh.n_points} nodes have data, and all nodes whose "
            "cells have data are loaded; measure more densely, or use larger cells"
        )
    part = Simplices(body.cells[cells], body.gradients[cells], body.measures[cells], body.n_points)
    return LoadCaseEquations(load_case.name, field, part, cells, np.flatnonzero(balanced.ravel()), load_case.external_force, law, zones)


def require_scale(systems: Sequence[LoadCaseEquations], right: FloatArray) -> None:
    """Refuse systems from which only ratios of moduli follow.

    Raises
    ------
    InputError
        Neither a known cell nor a known force appears in an equation.
    """
    if np.abs(right).max(initial=0.0) > 0.0:
        return
    zones = systems[0].zones
    if not (zones.of_cell == KNOWN).any():
        raise InputError(
            "neither a region nor a force is known: equilibrium then gives only ratios of moduli; name a region in `known`, or give a "
            "load case's external_force (a measured push, or the weight)"
        )
    raise InputError(
        "no known cell meets an unknown one at a node with data that is not loaded, and no force is known: the moduli have no scale; "
        "measure around the border between known and unknown"
    )
