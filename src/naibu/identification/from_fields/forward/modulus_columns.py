"""Nodal forces of relative changes of the moduli of zones, as a sparse matrix."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.field_laws import FieldLaw
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones


def modulus_columns(law: FieldLaw, zones: Zones, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.csc_matrix:
    """Return the nodal forces (n d, 2 count), mN, of a relative change of mu at constant kappa / mu, then of kappa, of every zone."""
    unit_lame, unit_shear = law.unit_forces(u)
    _, k, d = unit_lame.shape
    unknown = np.flatnonzero(zones.of_cell != KNOWN)
    of_zone = unknown[np.argsort(zones.of_cell[unknown], kind="stable")]  # the cells of every zone, one zone after the other
    cells = law.cells.astype(np.int32)  # fewer than 2^31 forces: 10^8 cells
    if not np.array_equal(of_zone, np.arange(len(cells))):
        lame, shear, unit_lame, unit_shear = (a[of_zone] for a in (lame, shear, unit_lame, unit_shear))
        cells = cells[of_zone]
    values, rows = np.empty((2, len(of_zone), k, d)), np.empty((2, len(of_zone), k, d), dtype=np.int32)
    np.multiply(lame[:, None, None], unit_lame, out=values[0])
    values[0] += shear[:, None, None] * unit_shear
    np.multiply((lame + 2.0 / 3.0 * shear)[:, None, None], unit_lame, out=values[1])
    rows[:] = d * cells[:, :, None] + np.arange(d, dtype=np.int32)
    sizes = k * d * np.bincount(zones.of_cell[unknown], minlength=zones.count)
    start = np.concatenate([[0], np.cumsum(np.tile(sizes, 2))]).astype(np.int32)
    out = sp.csc_matrix((values.ravel(), rows.ravel(), start), shape=(law.n_points * d, 2 * zones.count))
    if len(unknown) > zones.count:  # cells of a zone share nodes
        out.sum_duplicates()
    return out
