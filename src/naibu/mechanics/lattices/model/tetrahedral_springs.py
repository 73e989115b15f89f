"""Mass-spring-dashpot lattices on tetrahedral meshes: stiffness from volumes :cite:p:`vangelder1998`."""

from __future__ import annotations

from typing import Literal

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import simplices
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, general_lattice, require_positive

DampingRule = Literal["ratio", "printed"]


def mesh_edges(cells: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges (m, 2) of tetrahedra (k, 4), and the number of each of the six edges of every tetrahedron (k, 6)."""
    first, second = np.triu_indices(4, 1)
    i, j, count = cells[:, first].ravel(), cells[:, second].ravel(), int(cells.max()) + 1
    keys, number = np.unique(np.minimum(i, j) * count + np.maximum(i, j), return_inverse=True)  # rows would take ten times as long
    return np.stack([keys // count, keys % count], axis=1), number.reshape(-1, 6)


def volumetric_lattice(
    mesh: Mesh,
    *,
    density: float,
    young_modulus: float,
    damping: DampingRule = "ratio",
    damping_ratio: float = 1.0,
    series_damping: float = np.inf,
) -> tuple[Lattice, LatticeParameters]:
    """Return the three-element lattice on the edges of a mesh of tetrahedra.

    Parameters
    ----------
    mesh : Mesh
        Linear tetrahedra.
    density : float
        kg/mm^3.
    young_modulus : float
        E, kPa.
    damping : str
        ``"ratio"``: C1 is `damping_ratio` times the critical damping of its edge, mN s/mm; ``"printed"``: the report's formula,
        which divides that for a ratio of one by the length at rest (in mm).
    damping_ratio : float
        Of ``"ratio"``.
    series_damping : float
        C2 of all edges, mN s/mm; infinite for none.

    Raises
    ------
    InputError
        Parameters that are not positive, an unknown rule, a mesh of other cells or one in pieces.

    Notes
    -----
    With the volumes V of the tetrahedra at a node or an edge: ``m = density sum V / 4``, ``K = E sum V / L^2`` and
    ``C1 = 2 ratio sqrt(K (m_i + m_j))``.

    Averaged over all directions such springs have the modulus E and Poisson's ratio 1/4; where edges have preferred directions they do
    not. Kuhn's six tetrahedra of a cube, all cut along one space diagonal, have springs of E h along the axes and E h / 3 along the
    diagonals of faces and of the cube: a bar along an axis is 1.36 times as stiff as E says. Springs of cubes from moduli
    (`naibu.mechanics.elastic_stiffness`) have no such error.
    """
    require_positive(density, "the density", "kg/mm^3")
    require_positive(young_modulus, "Young's modulus", "kPa")
    if mesh.cell_type != "tetra":
        raise InputError(f"volumetric springs lie on the edges of tetrahedra, not of {mesh.cell_type!r} cells; split the cells first")
    if not (np.isfinite(damping_ratio) and damping_ratio >= 0.0):
        raise InputError(f"the damping ratio must not be negative, and is {damping_ratio:g}")
    if not series_damping > 0.0:
        raise InputError(f"the series damping must be positive (infinite for none), not {series_damping:g} mN s/mm")
    volumes = simplices(mesh).measures
    edges, number = mesh_edges(mesh.cells)
    masses = density / 4.0 * np.bincount(mesh.cells.ravel(), np.repeat(volumes, 4), minlength=mesh.n_points)
    around = np.bincount(number.ravel(), np.repeat(volumes, 6), minlength=len(edges))
    lattice = general_lattice(mesh.points, edges, masses)
    lengths = lattice.lengths
    stiffness = young_modulus * around / lengths**2
    voigt = edge_damping(stiffness, masses[edges].sum(axis=1), lengths, damping, damping_ratio)
    m = len(edges)
    return lattice, LatticeParameters(stiffness, voigt, np.full(m, float(series_damping)), np.full(m, 0.5))


def edge_damping(stiffness: FloatArray, mass: FloatArray, length: FloatArray, rule: DampingRule, ratio: float = 1.0) -> FloatArray:
    """Return the damping of edges, mN s/mm, from stiffness (mN/mm), the sum of the masses at their ends (kg) and length (mm).

    Raises
    ------
    InputError
        An unknown rule.
    """
    critical = 2.0 * np.sqrt(stiffness * mass)
    if rule == "ratio":
        return np.asarray(ratio * critical)
    if rule == "printed":
        return np.asarray(critical / length)
    raise InputError(f"rules of damping are 'ratio' and 'printed', not {rule!r}")
