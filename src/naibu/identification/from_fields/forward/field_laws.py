"""Material laws of field identification on the finite elements of a mesh: forces, tangents, and the forces of unit moduli in every cell.

Linear tetrahedra resist bending and, near incompressibility, every deformation: moduli found with them are several per cent too low, and
remain so on all meshes of practical size. Tetrahedra are therefore given mid-edge nodes, and hexahedra the mean dilatation of
:cite:t:`simo1985`, unless the elements of the mesh are asked for as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import Elements, elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_elements.linear_simplices import parameter_forces
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.element_conversion import to_quadratic

LawName = Literal["linear", "neo_hookean"]
FieldElements = Literal["accurate", "as_given"]
COLUMNS = 8  # displacements of the nodes of all cells that are held at once


class FieldLaw(Protocol):
    """A law on the cells of a mesh, linear in lambda and mu of every cell (kPa)."""

    cells: IntArray
    n_points: int
    linear: bool

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, d), mN, at a displacement (n, d), mm; not finite where a cell is inverted."""
        ...

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the tangent stiffness (n d, n d), mN/mm."""
        ...

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the nodes of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, k, d) each, mN."""
        ...

    def unit_works(self, u: FloatArray, along: FloatArray, against: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the work (m,) each, mN mm, of what small displacements add to `unit_forces` on others (both n d, r), all columns."""
        ...


class SmallStrainSimplices:
    """Linear elasticity on lines, triangles and linear tetrahedra."""

    linear = True

    def __init__(self, mesh: Mesh) -> None:
        self.body = LinearBody.of(mesh)
        self.cells, self.n_points = mesh.cells, mesh.n_points

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, d), mN, at a displacement (n, d), mm."""
        return self.body.forces(lame, shear, u)

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the stiffness (n d, n d), mN/mm."""
        return self.body.stiffness(lame, shear)

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the vertices of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, d + 1, d) each, mN."""
        return parameter_forces(self.body.simplices, u)

    def unit_works(self, u: FloatArray, along: FloatArray, against: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the work (m,) each, mN mm, of the `unit_forces` of displacements on others (both n d, r), all columns together."""
        return _works_of_linear(self, along, against)


@dataclass(frozen=True, slots=True, eq=False)
class _Assembled:
    """Elements of one mesh, each a cell of its own, as an assembler of the neo-Hookean law, whole and taken apart."""

    elements: Elements
    together: Assembler
    apart: Assembler

    @classmethod
    def of(cls, mesh: Mesh, discrete: Elements) -> _Assembled:
        """Return the assemblers; `apart` gives every cell nodes of its own, so that its forces can be told from its neighbours'."""
        each, some = np.zeros(mesh.n_cells, dtype=np.int64), [material("neo_hookean", young_modulus=1.0, poisson_ratio=0.3)]
        m, k = mesh.cells.shape
        own = replace(discrete, n_points=m * k, connectivity=np.arange(m * k, dtype=np.int64).reshape(m, k))
        return cls(discrete, Assembler.from_materials(discrete, each, some), Assembler.from_materials(own, each, some))

    def table(self, lame: FloatArray, shear: FloatArray) -> FloatArray:
        """Return the parameters of all cells."""
        out = np.zeros((len(lame), self.together.parameters.shape[1]))
        out[:, 0], out[:, 1] = shear, lame
        return out


class SmallStrain:
    """Linear elasticity with the mean dilatation of every cell: the tangent of the hyperelastic element at rest."""

    linear = True

    def __init__(self, mesh: Mesh) -> None:
        self._body = _Assembled.of(mesh, elements(mesh, "mean_dilatation"))
        self.cells, self.n_points = mesh.cells, mesh.n_points
        weights, gradients = self._body.elements.weights, self._body.elements.gradients
        self._volume = weights.sum(axis=1)
        self._mean = np.einsum("mq,mqai->mai", weights, gradients) / self._volume[:, None, None]

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, 3), mN, at a displacement (n, 3), mm."""
        of_lame, of_shear = self.unit_forces(u)
        of_cells = lame[:, None, None] * of_lame + shear[:, None, None] * of_shear
        index = self.cells.ravel()
        return np.stack([np.bincount(index, of_cells[..., a].ravel(), minlength=self.n_points) for a in range(3)], axis=1)

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the stiffness (n d, n d), mN/mm."""
        body = self._body.together.with_parameters(self._body.table(lame, shear))
        return body.pattern.matrix(body.evaluate(np.zeros((self.n_points, 3)))[2])

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the nodes of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, k, 3) each, mN."""
        weights, gradients = self._body.elements.weights, self._body.elements.gradients
        of_cells = u[self.cells]
        dilatation = self._volume * np.einsum("mai,mai->m", self._mean, of_cells)
        of_lame = dilatation[:, None, None] * self._mean
        gradient = np.einsum("mai,mqaj->mqij", of_cells, gradients, optimize=True)
        strain = gradient + np.swapaxes(gradient, 2, 3)
        strain -= np.einsum("mqkk->mq", strain)[:, :, None, None] / 3.0 * np.eye(3)
        deviatoric = np.einsum("mq,mqij,mqaj->mai", weights, strain, gradients, optimize=True)
        return of_lame, deviatoric + 2.0 / 3.0 * of_lame

    def unit_works(self, u: FloatArray, along: FloatArray, against: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the work (m,) each, mN mm, of the `unit_forces` of displacements on others (both n d, r), all columns together."""
        return _works_of_linear(self, along, against)


class NeoHookean:
    """Compressible neo-Hookean law ``W = mu (I1 - 3) / 2 - mu ln J + lambda (ln J)^2 / 2`` at finite strain."""

    linear = False

    def __init__(self, mesh: Mesh, *, averaged: bool) -> None:
        self._body = _Assembled.of(mesh, elements(mesh, "mean_dilatation" if averaged else "standard"))
        self.cells, self.n_points = mesh.cells, mesh.n_points

    def assembler(self, lame: FloatArray, shear: FloatArray) -> Assembler:
        """Return the assembler of the body with these moduli."""
        return self._body.together.with_parameters(self._body.table(lame, shear))

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, 3), mN, at a displacement (n, 3), mm; infinite where a cell is inverted."""
        _, force, smallest = self.assembler(lame, shear).forces(u)
        return force if smallest > 0.0 else np.full_like(force, np.inf)

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the tangent stiffness (n d, n d), mN/mm."""
        return self._body.together.pattern.matrix(self.assembler(lame, shear).evaluate(u)[2])

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the nodes of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, k, 3) each, mN."""
        one, none = np.ones(len(self.cells)), np.zeros(len(self.cells))
        apart = u[self.cells].reshape(-1, 3)
        both = (self._body.apart.forces_of_parameter(apart, self._body.table(*moduli)) for moduli in ((one, none), (none, one)))
        of_lame, of_shear = (force.reshape(*self.cells.shape, 3) for force in both)
        return of_lame, of_shear

    def unit_works(self, u: FloatArray, along: FloatArray, against: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the work (m,) each, mN mm, of what small displacements add to `unit_forces` on others (both n d, r), all columns."""
        one, none, body = np.ones(len(self.cells)), np.zeros(len(self.cells)), self._body.apart
        apart, out = u[self.cells].reshape(-1, 3), []
        for moduli in ((one, none), (none, one)):
            blocks = body.with_parameters(self._body.table(*moduli)).evaluate(apart)[2]
            out.append(works_of_cells(body.pattern.matrix(blocks), self.cells, along, against))
        return out[0], out[1]


def works_of_cells(tangent: sp.bsr_matrix, cells: IntArray, along: FloatArray, against: FloatArray) -> FloatArray:
    """Return the work (m,), mN mm, of the forces along small displacements on others (both n d, r), all columns together.

    The `tangent`, mN/mm, is that of all cells (m, k) with nodes of their own.
    """
    d = tangent.shape[0] // cells.size
    rows, work = (d * cells[:, :, None] + np.arange(d)).ravel(), np.zeros(len(cells))
    for a in range(0, along.shape[1], COLUMNS):
        of_cells = against[rows, a : a + COLUMNS] * (tangent @ along[rows, a : a + COLUMNS])
        work += of_cells.reshape(len(cells), -1).sum(axis=1)
    return work


def _works_of_linear(law: FieldLaw, along: FloatArray, against: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `unit_works` of a law whose forces are linear in displacements."""
    out = np.zeros((2, len(law.cells)))
    for a, b in zip(along.T, against.T, strict=True):
        moved = b.reshape(law.n_points, -1)[law.cells]
        out += [np.einsum("mki,mki->m", force, moved) for force in law.unit_forces(a.reshape(law.n_points, -1))]
    return out[0], out[1]


def field_law(mesh: Mesh, name: LawName, *, averaged: bool) -> FieldLaw:
    """Return the law of that name on a mesh, in 3-D with the mean dilatation of its cells or without.

    Raises
    ------
    InputError
        An unknown name, or cells that the law is not made for.
    """
    if name == "linear":
        return SmallStrain(mesh) if averaged else SmallStrainSimplices(mesh)
    if name != "neo_hookean":
        raise InputError(f"law {name!r} is not known for fields; use 'linear' or 'neo_hookean'")
    if mesh.dimension != 3:
        raise InputError(f"the neo-Hookean law needs a body in three dimensions, not {mesh.cell_type!r} cells; use law='linear'")
    return NeoHookean(mesh, averaged=averaged)


def computed_mesh(mesh: Mesh, chosen: FieldElements) -> tuple[Mesh, bool]:
    """Return the mesh on which equilibrium is computed, its first nodes those of `mesh`, and whether it has mean dilatation.

    Raises
    ------
    InputError
        `chosen` is not known, or cells without corner nodes alone.
    """
    if chosen not in ("accurate", "as_given"):
        raise InputError(f"elements={chosen!r} is not known; use 'accurate' or 'as_given'")
    if mesh.cell_type == "tetra10":
        raise InputError("the mesh of a field has cells of corner nodes, not 'tetra10'; mid-edge nodes are added where they are needed")
    if mesh.cell_type == "hexahedron":
        return mesh, True
    if chosen == "as_given" or mesh.dimension < 3:
        return mesh, False
    return to_quadratic(mesh), True
