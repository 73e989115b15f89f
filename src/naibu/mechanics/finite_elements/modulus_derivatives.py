"""Two-parameter elastic laws on linear simplices: nodal forces of unit lambda and mu in every cell, energies and tangents.

All laws are ``W = lambda W_lambda(F) + mu W_mu(F)``, so that equilibrium is linear in lambda and mu at finite strain as well:

- ``linear``: ``P = lambda tr(e) 1 + 2 mu e`` with ``e = sym(F - 1)``;
- ``neo_hookean``: ``P = lambda ln J F^-T + mu (F - F^-T)`` :cite:p:`bonet2008`;
- ``saint_venant_kirchhoff``: ``P = F (lambda tr(E) 1 + 2 mu E)`` with ``2 E = F^T F - 1``.

In two dimensions the strain is plane, in one uniaxial: the third stretch is 1, and the formulas hold as they are.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.linear_simplices import Simplices, parameter_forces, per_cell

SimplexLaw = Literal["linear", "neo_hookean", "saint_venant_kirchhoff"]


def unit_forces(body: Simplices, displacement: FloatArray, law: SimplexLaw = "linear") -> tuple[FloatArray, FloatArray]:
    """Return the elastic forces at the vertices of every cell for lambda = 1 kPa and for mu = 1 kPa.

    Parameters
    ----------
    body : Simplices
        The cells.
    displacement : ndarray, shape (n, d)
        mm.
    law : {"linear", "neo_hookean", "saint_venant_kirchhoff"}
        See the module.

    Returns
    -------
    tuple of ndarray, shape (m, d + 1, d)
        mN; the forces of a cell are ``lambda`` times the first plus ``mu`` times the second.

    Raises
    ------
    InputError
        An unknown law, or at finite strain an inverted cell.
    """
    if law == "linear":
        return parameter_forces(body, displacement)
    weighted = body.gradients * body.measures[:, None, None]
    lame, shear = _unit_stresses(body, displacement, law)
    return np.einsum("mab,mkb->mka", lame, weighted), np.einsum("mab,mkb->mka", shear, weighted)


def _unit_stresses(body: Simplices, displacement: FloatArray, law: SimplexLaw) -> tuple[FloatArray, FloatArray]:
    """First Piola-Kirchhoff stress (m, d, d) for lambda = 1 and for mu = 1 of the laws for finite strain."""
    f, j = _deformation(body, displacement, law)
    if law == "neo_hookean":
        inverse = np.swapaxes(np.linalg.inv(f), 1, 2)
        return np.log(j)[:, None, None] * inverse, f - inverse
    strain = _green_strain(f)
    return np.einsum("mcc,mab->mab", strain, f), 2.0 * f @ strain


def energies(
    body: Simplices, displacement: FloatArray, lame_lambda: ArrayLike, shear_modulus: ArrayLike, law: SimplexLaw = "linear"
) -> FloatArray:
    """Return the elastic energy of every cell (m,), mN mm; moduli in kPa, one number or one a cell.

    Raises
    ------
    InputError
        See `unit_forces`.
    """
    lame, shear = per_cell(lame_lambda, body.n_cells, "lame_lambda"), per_cell(shear_modulus, body.n_cells, "shear_modulus")
    if law == "neo_hookean":
        f, j = _deformation(body, displacement, law)
        squares, log_j = np.einsum("mab,mab->m", f, f), np.log(j)
        return np.asarray(body.measures * (shear * (0.5 * (squares - body.dimension) - log_j) + 0.5 * lame * log_j**2))
    if law == "linear":
        gradient = body.displacement_gradients(displacement)
        strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    else:
        strain = _green_strain(_deformation(body, displacement, law)[0])
    trace = np.einsum("maa->m", strain)
    return np.asarray(body.measures * (0.5 * lame * trace**2 + shear * np.einsum("mab,mab->m", strain, strain)))


def cell_tangents(
    body: Simplices, displacement: FloatArray, lame_lambda: ArrayLike, shear_modulus: ArrayLike, law: SimplexLaw = "linear"
) -> FloatArray:
    """Return the derivatives of the vertex forces of every cell with respect to its vertex displacements, (m, d + 1, d, d + 1, d), mN/mm.

    Raises
    ------
    InputError
        See `unit_forces`.
    """
    lame = per_cell(lame_lambda, body.n_cells, "lame_lambda")[:, None, None, None, None]
    shear = per_cell(shear_modulus, body.n_cells, "shear_modulus")[:, None, None, None, None]
    one = np.eye(body.dimension)
    like, crossed, outer = (np.einsum(f"ab,cd->{order}", one, one) for order in ("acbd", "acdb", "abcd"))
    if law == "linear":
        moduli = lame * outer + shear * (like + crossed)
    elif law == "neo_hookean":
        f, j = _deformation(body, displacement, law)
        inverse = np.swapaxes(np.linalg.inv(f), 1, 2)
        turned = np.einsum("mad,mcb->mabcd", inverse, inverse)
        log_j = np.log(j)[:, None, None, None, None]
        moduli = shear * like + (shear - lame * log_j) * turned + lame * np.einsum("mab,mcd->mabcd", inverse, inverse)
    else:
        f = _deformation(body, displacement, law)[0]
        strain = _green_strain(f)
        of_lame = np.einsum("mab,mcd->mabcd", f, f) + np.einsum("mee,ac,bd->mabcd", strain, one, one)
        of_shear = (
            np.einsum("mad,mcb->mabcd", f, f) + np.einsum("mae,mce,bd->mabcd", f, f, one) + 2.0 * np.einsum("ac,mdb->mabcd", one, strain)
        )
        moduli = lame * of_lame + shear * of_shear
    return np.asarray(np.einsum("m,mkb,mabcd,mld->mkalc", body.measures, body.gradients, moduli, body.gradients, optimize=True))


def _deformation(body: Simplices, displacement: FloatArray, law: str) -> tuple[FloatArray, FloatArray]:
    """Deformation gradients (m, d, d) and their determinants (m,) of a law for finite strain."""
    if law not in get_args(SimplexLaw):
        raise InputError(f"law {law!r} is not known on simplices; use one of {', '.join(get_args(SimplexLaw))}")
    f = np.eye(body.dimension) + body.displacement_gradients(displacement)
    j = np.linalg.det(f)
    if not (j > 0.0).all():
        bad = int(np.argmax(~(j > 0.0)))
        nodes = ", ".join(str(node) for node in body.cells[bad])
        raise InputError(
            f"the displacement inverts the cell of nodes {nodes} (det F = {j[bad]:.3g}); correct the data there, use larger cells, "
            "or law='linear'"
        )
    return f, j


def _green_strain(f: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (np.swapaxes(f, 1, 2) @ f - np.eye(f.shape[1])))
