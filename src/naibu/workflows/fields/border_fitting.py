"""Hexahedra of a grid whose nodes are moved onto the borders of zones.

Cubes make stairs of borders that run through them; moduli of layers of few cubes, and of what lies around a rigid inclusion, are then wrong
by as much as the stairs are from the border. Nodes of the stairs are moved onto the border, the others follow smoothly, and movements that
would flatten a cell are cut back, as when meshes of voxels are smoothed (:cite:p:`boyd2006`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.meshing.element_conversion import HEXAHEDRON_EDGES
from naibu.meshing.point_location import locate
from naibu.meshing.quality import min_jacobians, signed_volumes
from naibu.meshing.surface import boundary_faces

FARTHEST = 0.45  # of the shortest edge along an axis: way of a node along it
FLATTEST = 0.15  # of the mean volume density of a cell: least one at its corners
STEPS, SWEEPS, CUTS = 4, 60, 12  # towards the border; of relaxation; of movements that flatten cells
MOST_VOXELS = 20_000_000  # of the grid on which distances from borders are computed


def fitted_to_borders(mesh: Mesh, cell_of_voxel: IntArray, inside: Volume, region_of_voxel: IntArray) -> tuple[Mesh, IntArray]:
    """Return the cells of a grid with nodes between zones on their borders, and the cell of every voxel (nz, ny, nx), -1 outside.

    Nodes at the surface of the body stay in their faces.

    Parameters
    ----------
    mesh : Mesh
        Hexahedra of `naibu.workflows.fields.block_mesh.block_mesh`, with the region that has most of each.
    cell_of_voxel : ndarray, shape (nz, ny, nx), int64
        Cell of every voxel, -1 outside.
    inside : Volume
        Not zero in the object.
    region_of_voxel : ndarray, shape (nz, ny, nx), int64
        Region of every voxel of the object; what it is elsewhere does not matter.
    """
    start = inside.to_index(mesh.points)  # along the axes of the grid, in voxels
    edge = np.array([np.ptp(start[mesh.cells, axis], axis=1).min() for axis in range(3)])
    held = _held(mesh, start)
    border, way = _towards_borders(mesh, start, held, edge, Distances.of(inside, region_of_voxel))
    way = _relaxed(mesh, way, border, held)
    fitted = _unflattened(mesh, inside.to_physical(start), inside.to_physical(start + way))
    return fitted, _cells_of_voxels(fitted, mesh, cell_of_voxel, inside)


class Distances:
    """Signed distance from the surface of every region, positive inside, on the grid of the object, mm."""

    def __init__(self, values: FloatArray, low: FloatArray, stride: int) -> None:
        self._values, self._low, self._stride = values, low, stride

    @classmethod
    def of(cls, inside: Volume, region_of_voxel: IntArray) -> Distances:
        """Measure them; outside of the object its nearest region goes on."""
        there = inside.values != 0
        box = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in ndimage.find_objects(there.astype(np.uint8))[0])
        stride = max(1, int(np.ceil((there[box].size / MOST_VOXELS) ** (1.0 / 3.0))))
        every = (slice(None, None, stride),) * 3
        there, region = there[box][every], region_of_voxel[box][every]
        sampling = stride * np.asarray(inside.spacing_mm)[::-1]
        nearest = ndimage.distance_transform_edt(~there, sampling=sampling, return_distances=False, return_indices=True)
        region = region[tuple(nearest)]
        half = 0.5 * float(np.cbrt(np.prod(sampling)))
        values = np.empty((int(region.max()) + 1, *region.shape), dtype=np.float32)
        for number in range(len(values)):
            own = region == number
            if not own.any() or own.all():
                values[number] = np.where(own, np.inf, -np.inf) if own.all() else -1e6
                continue
            within, away = (ndimage.distance_transform_edt(a, sampling=sampling) for a in (own, ~own))
            values[number] = ndimage.gaussian_filter(np.where(own, within - half, half - away), 1.0)
        return cls(values, np.array([s.start for s in box][::-1], dtype=float), stride)

    def at(self, number: int, index: FloatArray) -> FloatArray:
        """Return the distance (k,), mm, from a region at points given in voxels (k, 3) of the object's grid."""
        own = ((index - self._low) / self._stride)[:, ::-1].T
        return np.asarray(ndimage.map_coordinates(self._values[number], own, order=1, mode="nearest"), dtype=float)

    def between(self, one: int, other: int, index: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the signed distance (k,), mm, from where two regions meet, and its slope (k, 3), mm per voxel."""

        def signed(at: FloatArray) -> FloatArray:
            return 0.5 * (self.at(one, at) - self.at(other, at))

        steps = np.eye(3) * self._stride
        slope = np.stack([(signed(index + s) - signed(index - s)) / (2.0 * self._stride) for s in steps], axis=1)
        return signed(index), slope


def _held(mesh: Mesh, start: FloatArray) -> BoolArray:
    """Return along which axes of the grid nodes (n, 3) may not move: those of the faces at the surface on which they lie."""
    held = np.zeros((mesh.n_points, 3), dtype=bool)
    for face in boundary_faces(mesh).faces:
        held[face, int(np.argmin(np.ptp(start[face], axis=0)))] = True
    return held


def _towards_borders(
    mesh: Mesh, start: FloatArray, held: BoolArray, edge: FloatArray, distances: Distances
) -> tuple[BoolArray, FloatArray]:
    """Return which nodes (n,) lie between regions, and the way (n, 3) of each to the nearest border of two of its regions, in voxels."""
    ones, shape = np.ones(mesh.cells.size), (mesh.n_points, 1 + int(mesh.regions.max()))
    of_node = sp.csr_matrix((ones, (mesh.cells.ravel(), np.repeat(mesh.regions, 8))), shape=shape)
    touches = of_node.toarray() > 0
    border = touches.sum(axis=1) > 1
    nodes = np.flatnonzero(border)
    depth = np.stack([distances.at(r, start[nodes]) for r in range(touches.shape[1])], axis=1)
    nearest = np.argsort(np.where(touches[nodes], -depth, np.inf), axis=1, kind="stable")[:, :2]
    pair = np.sort(nearest, axis=1)
    way = np.zeros_like(start)
    for one, other in np.unique(pair, axis=0):
        of_pair = nodes[(pair == (one, other)).all(axis=1)]
        at = start[of_pair].copy()
        for _ in range(STEPS):
            value, slope = distances.between(int(one), int(other), at)
            slope = np.where(held[of_pair], 0.0, slope)
            at -= slope * (value / np.maximum((slope**2).sum(axis=1), 1e-2))[:, None]
            at = start[of_pair] + np.clip(at - start[of_pair], -FARTHEST * edge, FARTHEST * edge)
        way[of_pair] = at - start[of_pair]
    return border, way


def _relaxed(mesh: Mesh, way: FloatArray, border: BoolArray, held: BoolArray) -> FloatArray:
    """Return the ways (n, 3) with those of nodes away from borders as the means of their neighbours', and none along held axes."""
    a, b = mesh.cells[:, HEXAHEDRON_EDGES].reshape(-1, 2).T
    ones, shape = np.ones(2 * len(a)), (mesh.n_points, mesh.n_points)
    near = sp.csr_matrix((ones, (np.concatenate([a, b]), np.concatenate([b, a]))), shape=shape)
    near.data[:] = 1.0
    mean = sp.diags(1.0 / np.maximum(np.asarray(near.sum(axis=1)).ravel(), 1.0)) @ near
    fixed = border[:, None] | held
    out = np.where(held, 0.0, way)
    for _ in range(SWEEPS):
        out = np.where(fixed, out, mean @ out)
    return np.asarray(out)


def _unflattened(mesh: Mesh, start: FloatArray, end: FloatArray) -> Mesh:
    """Return the mesh with nodes moved from start to end (n, 3), mm, each as far as no cell becomes flat."""
    part = np.ones(len(start))
    for _ in range(CUTS):
        moved = replace(mesh, points=start + part[:, None] * (end - start))
        flat = _flatness(moved) < FLATTEST
        if not flat.any():
            return moved
        part[np.unique(mesh.cells[flat])] *= 0.75
    moved = replace(mesh, points=start + part[:, None] * (end - start))
    part[np.unique(mesh.cells[_flatness(moved) < FLATTEST])] = 0.0
    return replace(mesh, points=start + part[:, None] * (end - start))


def _flatness(mesh: Mesh) -> FloatArray:
    """Return the least Jacobian determinant in hexahedra over its mean, (m,)."""
    return min_jacobians(mesh) / (signed_volumes(mesh) / 8.0)


def _cells_of_voxels(fitted: Mesh, before: Mesh, cell_of_voxel: IntArray, inside: Volume) -> IntArray:
    """Return the cell of every voxel, found again where cells around it changed."""
    moved: BoolArray = np.abs(fitted.points - before.points).max(axis=1) > 1e-9
    changed = np.append(moved[before.cells].any(axis=1), False)  # the last one for voxels without a cell
    again = np.argwhere(changed[cell_of_voxel])
    out = cell_of_voxel.copy()
    if len(again):
        found = locate(fitted, inside.to_physical(again[:, ::-1].astype(float)), tolerance_mm=np.inf)
        out[tuple(again.T)] = found.cells
    return out
