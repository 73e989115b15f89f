"""Springs of a regular lattice from Young's modulus by voxel, so that it answers as the elastic solid does, its surface included.

Springs of edges, face diagonals and space diagonals in the ratio 16 : 8 : 3 deform isotropically; central forces between neighbours of one
element a pair leave no choice of Poisson's ratio, which is 1/4 (Cauchy's relations :cite:p:`ostojastarzewski2002`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.lattice import Lattice

POISSON_RATIO = 0.25
# of E times the edge, what one cube gives to each of its edges (four cubes share one), face diagonals (two) and space diagonals
SHARES = (4.0 / 30.0, 4.0 / 30.0, 3.0 / 30.0)


def elastic_stiffness(lattice: Lattice, young_modulus: ArrayLike) -> FloatArray:
    """Return K (m,), mN/mm, of all elements of a classic lattice from Young's modulus by cube.

    Every cube gives each of its 28 elements a share of its modulus: elements at the surface, which belong to fewer cubes, are weaker in
    proportion, and elements between zones are the sum of both. In any uniform strain the energy is then exactly that of the solid.

    Parameters
    ----------
    lattice : Lattice
        Of `classic_lattice`.
    young_modulus : array_like
        kPa; one number, or one for each of the c cubes of the lattice (`Lattice.cells`).

    Raises
    ------
    InputError
        A lattice without cubes or of an octree, another number of moduli, or one that is not positive and finite.
    """
    if lattice.cells is None or lattice.element_level.any():
        raise InputError("springs from moduli need a classic lattice of cubes; choose kind 'classic'")
    cells = lattice.cells
    given = np.asarray(young_modulus, dtype=float)
    if given.ndim and given.shape != (len(cells),):
        raise InputError(f"young_modulus has shape {given.shape}; give one number, or one for each of {len(cells)} cubes")
    modulus = np.broadcast_to(given, (len(cells),))
    valid = np.isfinite(modulus) & (modulus > 0.0)
    if not valid.all():
        bad = int(np.argmin(valid))
        raise InputError(
            f"young_modulus of cube {bad} is {modulus[bad]:g} kPa; it must be positive and finite: {int((~valid).sum())} are not"
        )
    first, second = np.triu_indices(8, 1)
    low, high = np.minimum(cells[:, first], cells[:, second]), np.maximum(cells[:, first], cells[:, second])
    n = lattice.n_nodes
    keys = lattice.elements[:, 0] * n + lattice.elements[:, 1]
    order = np.argsort(keys)
    element = order[np.searchsorted(keys[order], (low * n + high).ravel())]
    sums = np.bincount(element, np.repeat(modulus, len(first)), minlength=lattice.n_elements)
    return np.asarray(lattice.spacing_mm * np.array(SHARES)[lattice.element_class] * sums)
