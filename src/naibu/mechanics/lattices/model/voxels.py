"""Voxels of a labelled scan as cells of a lattice, with the transform from the lattice's frame to the scanner's."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, as_mask, require_positive
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.mechanics.lattices.model.lattice import Lattice


def voxel_mask(volume: Volume, chosen: ArrayLike, spacing_mm: float) -> tuple[BoolArray, RigidTransform]:
    """Return which cubes of an edge are at least half filled by voxels of a scan, and the frame of these cubes.

    Parameters
    ----------
    volume : Volume
        Geometry of the voxels; its values are not read.
    chosen : array_like, shape (nz, ny, nx), bool
        Voxels of the object.
    spacing_mm : float
        Edge of a cube, mm.

    Returns
    -------
    mask : ndarray, shape (mx, my, mz), bool
        Cubes along the axes of the volume; the first begins at the lowest chosen voxels.
    frame : RigidTransform
        From positions along these axes, counted from the lowest corner of the first cube, mm, to the scanner's frame: the direction of the
        volume, and the position of that corner. Where the volume's axes are left-handed, it is a reflection too.

    Raises
    ------
    InputError
        A mask of another shape, without a voxel, or a spacing that is not positive.
    """
    voxels = as_mask("chosen", chosen, volume.shape)
    require_positive("spacing_mm", spacing_mm, "mm")
    low = np.argwhere(voxels.T).min(axis=0)
    corner = volume.to_physical(low - 0.5)
    return _filled_cubes(voxels, volume.spacing_mm, spacing_mm), RigidTransform(volume.direction, np.zeros(3), corner)


def cropped_mask(mask: BoolArray, frame: RigidTransform, spacing_mm: float) -> tuple[BoolArray, RigidTransform]:
    """Return a mask without empty layers around the object, and the frame that begins at its lowest corner."""
    inside = np.argwhere(mask)
    low, high = inside.min(axis=0), inside.max(axis=0) + 1
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return mask[box], RigidTransform(frame.rotation, np.zeros(3), frame.applied(spacing_mm * low))


def cube_means(lattice: Lattice, volume: Volume) -> FloatArray:
    """Return the mean of a volume in every cube (c,) of a lattice: of the voxels whose centres lie in it.

    Cubes that hold no centre take the voxel around their own. NaN is not counted, and marks cubes without a value.

    Parameters
    ----------
    lattice : Lattice
        Classic, with cubes, in a frame of the scanner.
    volume : Volume
        In the scanner's frame, on any grid.

    Raises
    ------
    InputError
        A lattice without cubes.
    """
    if lattice.cells is None:
        raise InputError("the lattice has no cubes; make it by classic_lattice")
    low, cells = lattice.points.min(axis=0), lattice.cells
    at = np.rint((lattice.points[cells].min(axis=1) - low) / lattice.spacing_mm).astype(np.int64)
    number = np.full(tuple(at.max(axis=0) + 1), -1)
    number[tuple(at.T)] = np.arange(len(cells))
    known = np.isfinite(volume.values)
    centres = volume.to_physical(np.argwhere(known.transpose(2, 1, 0)).astype(float))
    place = np.floor((lattice.frame.inverse().applied(centres) - low) / lattice.spacing_mm + 1e-9).astype(np.int64)
    inside = ((place >= 0) & (place < number.shape)).all(axis=1)
    mine = np.full(len(place), -1)
    mine[inside] = number[tuple(place[inside].T)]
    values = np.asarray(volume.values, dtype=float).transpose(2, 1, 0)[known.transpose(2, 1, 0)]
    sums, counts = (np.bincount(mine[mine >= 0], w, minlength=len(cells)) for w in (values[mine >= 0], None))
    found = np.divide(sums, counts, out=np.full(len(cells), np.nan), where=counts > 0)
    middle = volume.to_index(lattice.frame.applied(lattice.points[cells].mean(axis=1)))
    nearest = np.rint(middle).astype(np.int64)
    near = ((nearest >= 0) & (nearest < np.array(volume.shape)[::-1])).all(axis=1) & (counts == 0)
    found[near] = volume.values[tuple(nearest[near][:, ::-1].T)]
    return np.asarray(found)


def _filled_cubes(voxels: BoolArray, voxel_mm: FloatArray, spacing_mm: float) -> BoolArray:
    """Return which cubes are at least half filled by voxels (nz, ny, nx); they have the axes (x, y, z) and begin with the voxels."""
    used = np.argwhere(voxels.T)
    low, high = used.min(axis=0), used.max(axis=0) + 1
    fraction = voxels.T[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].astype(np.float32)
    for axis in range(3):  # fractions of slabs, one axis after the other
        edges = voxel_mm[axis] * np.arange(fraction.shape[axis] + 1)
        count = int(np.ceil(edges[-1] / spacing_mm - 1e-6))
        filled = np.concatenate([np.zeros((1, *np.delete(fraction.shape, axis))), np.cumsum(np.moveaxis(fraction, axis, 0), axis=0)])
        cuts = np.minimum(spacing_mm * np.arange(count + 1) / voxel_mm[axis], len(edges) - 1.0)
        below = np.minimum(cuts.astype(np.int64), len(edges) - 2)
        part = (cuts - below).reshape(-1, *[1] * (fraction.ndim - 1))
        integral = filled[below] * (1.0 - part) + filled[below + 1] * part
        fraction = np.moveaxis(np.diff(integral, axis=0) * voxel_mm[axis] / spacing_mm, 0, axis)
    return np.asarray(fraction >= 0.5 - 1e-6)
