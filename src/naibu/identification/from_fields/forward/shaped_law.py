"""Hyperelastic law whose stress grows otherwise with strain than that of the neo-Hookean law with the same moduli at small strain.

What the moduli at small strain leave open are the *shapes* of the law, alike in a group of cells: the fraction c01 / (c10 + c01) of the
second invariant (Mooney-Rivlin), c20 / c10 and c30 / c10 (Yeoh), and which part of the stored energy has the isochoric invariant and
``kappa (J^2 - 1 - 2 ln J) / 4`` where the neo-Hookean law has ``-mu ln J + lambda (ln J)^2 / 2``. Forces are linear in the moduli, and
affine in the shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import works_of_cells
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material

C01, C20, C30, ISOCHORIC = range(4)
N_SHAPES = 4
TERMS = ("neo_hookean", "mooney_rivlin", "yeoh")
Tables = list[FloatArray]  # parameters of the terms in every cell, kPa


class ShapedLaw:
    """The law on the cells of a mesh with shapes (4, m): c01 fraction, c20 ratio, c30 ratio, isochoric part."""

    linear = False

    def __init__(self, mesh: Mesh, shapes: FloatArray, *, averaged: bool) -> None:
        discrete = elements(mesh, "mean_dilatation" if averaged else "standard")
        m, k = mesh.cells.shape
        each = np.zeros(m, dtype=np.int64)
        own = replace(discrete, n_points=m * k, connectivity=np.arange(m * k, dtype=np.int64).reshape(m, k))
        some = [[material(name, young_modulus=1.0, poisson_ratio=0.3)] for name in TERMS]
        first, alone = Assembler.from_materials(discrete, each, some[0]), Assembler.from_materials(own, each, some[0])
        self._together = [first, *(Assembler.from_materials(discrete, each, one, first.pattern) for one in some[1:])]
        self._apart = [alone, *(Assembler.from_materials(own, each, one, alone.pattern) for one in some[1:])]
        self.cells, self.n_points, self.shapes = mesh.cells, mesh.n_points, shapes

    def with_shapes(self, shapes: FloatArray) -> ShapedLaw:
        """Return the law with other shapes (4, m)."""
        out = object.__new__(ShapedLaw)
        out.__dict__.update(self.__dict__)
        out.shapes = shapes
        return out

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, 3), mN, at a displacement (n, 3), mm; infinite where a cell is inverted."""
        tables = _tables(lame, shear, self.shapes, 1.0)
        _, force, smallest = self._together[0].with_parameters(tables[0]).forces(u)
        if not smallest > 0.0:
            return np.full_like(force, np.inf)
        return force + _sum(self._together[1:], tables[1:], lambda one: one.forces(u)[1])

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the tangent stiffness (n d, n d), mN/mm."""
        tables = _tables(lame, shear, self.shapes, 1.0)
        return self._together[0].pattern.matrix(_sum(self._together, tables, lambda one: one.evaluate(u)[2]))

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the nodes of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, k, 3) each, mN."""
        one, none = np.ones(len(self.cells)), np.zeros(len(self.cells))
        apart, out = u[self.cells].reshape(-1, 3), []
        for moduli in ((one, none), (none, one)):
            force = _sum(self._apart, _tables(*moduli, self.shapes, 1.0), lambda part: part.forces(apart)[1])
            out.append(force.reshape(*self.cells.shape, 3))
        return out[0], out[1]

    def unit_works(self, u: FloatArray, along: FloatArray, against: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the work (m,) each, mN mm, of what small displacements add to `unit_forces` on others (both n d, r), all columns."""
        one, none = np.ones(len(self.cells)), np.zeros(len(self.cells))
        apart, out = u[self.cells].reshape(-1, 3), []
        for moduli in ((one, none), (none, one)):
            blocks = _sum(self._apart, _tables(*moduli, self.shapes, 1.0), lambda part: part.evaluate(apart)[2])
            out.append(works_of_cells(self._apart[0].pattern.matrix(blocks), self.cells, along, against))
        return out[0], out[1]

    def forces_of_shape(self, lame: FloatArray, shear: FloatArray, u: FloatArray, change: FloatArray) -> FloatArray:
        """Return by how much the nodal forces (n, 3), mN, change with the shapes, along a change (4, m) of these."""
        return _sum(self._together, _tables(lame, shear, change, 0.0), lambda one: one.forces(u)[1])


def _tables(lame: FloatArray, shear: FloatArray, shapes: FloatArray, whole: float) -> Tables:
    """Return the parameters of the terms in every cell: of the law (`whole` 1), or of a change of its shapes (`whole` 0)."""
    none, coupled, isochoric = np.zeros_like(shear), whole - shapes[ISOCHORIC], shapes[ISOCHORIC]
    kappa, half = lame + 2.0 / 3.0 * shear, 0.5 * shear
    tables = (
        (shear * coupled, lame * coupled),
        (-half * shapes[C01], half * shapes[C01], none),
        (half * isochoric, half * shapes[C20], half * shapes[C30], kappa * isochoric),
    )
    return [np.stack(columns, axis=1) for columns in tables]


def _sum(assemblers: list[Assembler], tables: Tables, evaluated: Callable[[Assembler], FloatArray]) -> FloatArray:
    """Return the sum of what is `evaluated` of the terms that are there."""
    there = [(one, table) for one, table in zip(assemblers, tables, strict=True) if table.any()]
    return np.asarray(sum(evaluated(one.with_parameters(_padded(table, one))) for one, table in there))


def _padded(table: FloatArray, assembler: Assembler) -> FloatArray:
    out = np.zeros_like(assembler.parameters)
    out[:, : table.shape[1]] = table
    return out
