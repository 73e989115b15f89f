"""A lattice of markers as a finite element mesh: markers are its nodes, and what they did is its displacement (report ch. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import registration
from naibu.identification.from_markers.specimen.marker_grid import completed, lattice_indices
from naibu.identification.from_markers.specimen.scan_alignment import placement

ON_LAYER = 0.15  # an interface this near to a marker layer, in gaps between layers, gets no nodes of its own


@dataclass(frozen=True, slots=True, eq=False)
class MarkerMesh:
    """One measured state of a marker lattice.

    Attributes
    ----------
    label : str
        ``experiment/state``.
    mesh : Mesh
        Hexahedra between the markers, in the object's frame, mm; nodes that no cell uses stand at the origin.
    displacement : ndarray, shape (n, 3)
        Of the nodes, mm, without the rigid motion between the two scans.
    measured : ndarray, shape (n, 3), bool
        False where a coordinate was completed from the lattice or interpolated.
    interior : ndarray, shape (k,), int64
        Nodes with a cell in each of the eight corners around them: no load reaches them from outside.
    """

    label: str
    mesh: Mesh
    displacement: FloatArray
    measured: BoolArray
    interior: IntArray


def marker_mesh(experiment: Experiment, state: str) -> MarkerMesh:
    """Make the markers of a loaded state nodes of a mesh, with extra nodes on the interfaces between marker layers.

    Missing coordinates are completed from the lattice; cells at markers that stay incomplete are left out.

    Raises
    ------
    InputError
        Two-dimensional data, a height not along z, no positions, no lattice, or an inverted cell.
    """
    if experiment.dimensions != 3 or experiment.up_axis != "z":
        raise InputError(f"experiment {experiment.name!r}: the equilibrium gap needs three-dimensional markers and a height along z")
    free, loaded, seen = _grids(experiment, state)
    planes: list[tuple[int, float | None]]
    planes = [(k, None) for k in range(len(free))] + [(k, h) for h in _interfaces(experiment) if (k := _gap(free, h)) is not None]
    planes.sort(key=lambda plane: (plane[0], plane[1] or -np.inf))
    shape = free.shape[1:]
    points, moved, measured = (np.zeros((len(planes), *shape), dtype=a.dtype) for a in (free, loaded, seen))
    for at, (k, h) in enumerate(planes):
        if h is None:
            points[at], moved[at], measured[at] = free[k], loaded[k], seen[k]
        else:
            fraction = ((h - free[k, ..., 2]) / (free[k + 1, ..., 2] - free[k, ..., 2]))[..., None]
            points[at], moved[at] = ((1.0 - fraction) * a[k] + fraction * a[k + 1] for a in (free, loaded))
    return _assembled(f"{experiment.name}/{state}", experiment, points, moved, measured)


def _grids(experiment: Experiment, state: str) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Free and loaded positions (nk, nj, ni, 3), mm, in the object's frame, and what of them was measured in both states."""
    initial, markers = experiment.initial, experiment.state(state).markers
    if markers is None:
        raise InputError(f"{experiment.name}/{state} has no measured positions; give its file or leave the state out")
    read = np.where(initial.trusted[:, None], initial.points, np.nan), markers.aligned(initial.ids)
    index = lattice_indices(initial.ids, read[0]) if len(initial) else None
    if index is None:
        raise InputError(f"experiment {experiment.name!r}: its markers are not numbered on a lattice, which the equilibrium gap needs")
    place = placement(experiment)
    free, loaded = (place.to_object(completed(initial.ids, r)[0]) for r in read)
    whole = np.isfinite(free).all(axis=1)
    if (whole & np.isfinite(loaded).all(axis=1)).sum() < 8:
        raise InputError(f"{experiment.name}/{state} shares fewer than 8 complete markers with the reference configuration; measure more")
    pose = registration(free[whole], loaded[whole])
    loaded = (loaded - pose.position) @ pose.rotation + pose.centre
    size = index.max(axis=0) + 1
    grids = [np.full((*size[::-1], 3), np.nan) for _ in range(2)]
    seen = np.zeros((*size[::-1], 3), dtype=bool)
    at = tuple(index[:, ::-1].T)
    grids[0][at], grids[1][at], seen[at] = free, loaded, np.isfinite(read[0]) & np.isfinite(read[1])
    steps = np.stack([np.nanmean(np.diff(grids[0], axis=axis), axis=(0, 1, 2)) for axis in (2, 1, 0)])
    if np.argmax(np.abs(steps[2])) != 2:
        raise InputError(f"experiment {experiment.name!r}: its markers are not numbered layer by layer; renumber them")
    up = slice(None, None, int(np.sign(steps[2, 2])))
    right = slice(None, None, int(np.sign(np.linalg.det(steps * [[1], [1], [np.sign(steps[2, 2])]]))))
    return grids[0][up, right], grids[1][up, right], seen[up, right]


def _interfaces(experiment: Experiment) -> list[float]:
    """Heights at which the material changes, mm."""
    pairs = zip(experiment.layers, experiment.layers[1:], strict=False)
    return [below.to_base_mm for below, above in pairs if below.material != above.material]


def _gap(free: FloatArray, height: float) -> int | None:
    """Index of the marker layer below an interface that needs nodes of its own."""
    z = np.nanmean(free[..., 2], axis=(1, 2))
    k = int(np.searchsorted(z, height)) - 1
    if not 0 <= k < len(z) - 1:
        return None
    fraction = (height - z[k]) / (z[k + 1] - z[k])
    return k if ON_LAYER < fraction < 1.0 - ON_LAYER else None


def _assembled(label: str, experiment: Experiment, points: FloatArray, moved: FloatArray, measured: BoolArray) -> MarkerMesh:
    """Join planes (p, nj, ni, 3) of nodes by cells, leave out those at incomplete nodes, and give every cell the material at its middle."""
    names = experiment.materials
    n = np.arange(points.size // 3).reshape(points.shape[:3])
    low, high = ([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]] for p in (n[:-1].transpose(1, 2, 0), n[1:].transpose(1, 2, 0)))
    cells = np.stack([c.ravel() for c in (*low, *high)], axis=1)
    x, y, seen = points.reshape(-1, 3), moved.reshape(-1, 3), measured.reshape(-1, 3)
    complete: BoolArray = np.isfinite(np.concatenate([x, y], axis=1)).all(axis=1)
    cells = cells[complete[cells].all(axis=1)]
    if len(cells) == 0:
        raise InputError(f"{label}: no eight neighbouring markers are complete; give more coordinates")
    middle = x[cells, 2].mean(axis=1)
    tops = np.array([layer.to_base_mm for layer in experiment.layers[:-1]])
    material = np.array([names.index(layer.material) for layer in experiment.layers])
    x, y = np.where(complete[:, None], x, 0.0), np.where(complete[:, None], y, 0.0)
    mesh = Mesh.from_arrays(x, cells, "hexahedron", regions=material[np.searchsorted(tops, middle)], region_names=names)
    interior = np.flatnonzero(np.bincount(cells.ravel(), minlength=len(x)) == 8)
    return MarkerMesh(label, mesh, y - x, seen & complete[:, None], interior)
