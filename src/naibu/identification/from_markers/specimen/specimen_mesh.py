"""The mesh of a measured object: hexahedra, refined where the indenter bends them most."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.mesh import Mesh
from naibu.meshing.primitives import box_from_coordinates, cylinder, half_ellipsoid, hemisphere

CELLS_PER_HEIGHT = {"plate": 9.0, "bar": 8.0}  # of a box; its cells shrink further under a bar
ROUND_CELLS_PER_HEIGHT = 7.0
MIRRORED_CELLS_PER_HEIGHT = 10.0  # where mirror planes leave a quarter of the object
REFINEMENT = 0.45  # edge of the cells at a bar over that of the cells far from it


def element_size(experiment: Experiment, element_size_mm: float) -> float:
    """Return the edge of the cells far from the indenter, mm; 0 chooses a seventh to a tenth of the object's height."""
    box, kind = experiment.shape.kind == "box", experiment.loading.kind
    cells = CELLS_PER_HEIGHT.get(kind, ROUND_CELLS_PER_HEIGHT) if box else ROUND_CELLS_PER_HEIGHT
    if kind == "side_plates":
        cells = MIRRORED_CELLS_PER_HEIGHT
    return element_size_mm or experiment.height_mm / cells


def model_mesh(experiment: Experiment, element_size_mm: float = 0.0) -> Mesh:
    """Mesh an object in its own frame: base at z = 0, centred on x = y = 0, one region for each material and batch.

    Raises
    ------
    InputError
        Layers in a body other than a box or a cylinder.
    """
    edge = element_size(experiment, element_size_mm)
    size, kind = experiment.shape.size_mm, experiment.shape.kind
    layers = [(layer.region, layer.to_base_mm - layer.from_base_mm) for layer in experiment.layers]
    if kind == "box":
        return _box(experiment, edge)
    if kind == "cylinder":
        return cylinder(size[0], size[2], edge, layers=layers)
    if len(layers) > 1:
        raise InputError(f"experiment {experiment.name!r}: layers are only covered in boxes and cylinders, not in a {kind}")
    mesh = half_ellipsoid(size, edge) if kind == "half_ellipsoid" else hemisphere(size[0], edge)
    return Mesh(mesh.points, mesh.cells, mesh.cell_type, mesh.regions, (layers[0][0],))


def on_straight_base(points: FloatArray, height: float, base: float) -> FloatArray:
    """Return the nodes of a half ellipsoid (n, 3) moved so that it stands on a straight-sided base of the same outline.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Nodes of a half ellipsoid with its flat side at z = 0, mm.
    height : float
        Its height, mm.
    base : float
        Height of the straight-sided part below it, mm; the nodes are spread over the whole body.
    """
    fraction = np.clip(points[:, 2] / height, 0.0, 1.0)
    z = fraction * (height + base)
    wanted = 1.0 - np.clip((z - base) / height, 0.0, 1.0) ** 2
    had = 1.0 - fraction**2
    apex = had < 1e-9
    stretch = np.where(apex, 1.0, np.sqrt(wanted / np.where(apex, 1.0, had)))
    return np.column_stack([points[:, :2] * stretch[:, None], z])


def _box(experiment: Experiment, edge: float) -> Mesh:
    """A box; under a bar the cells shrink towards its edges and towards the top."""
    size, loading = np.array(experiment.shape.size_mm), experiment.loading
    top = edge
    even = loading.kind == "side_plates"  # a mirror plane parts the cells
    counts = [2 * max(1, round(s / (2.0 * edge))) if even else max(2, round(s / edge)) for s in size[:2]]
    flat = [np.linspace(-s / 2.0, s / 2.0, n + 1) for s, n in zip(size[:2], counts, strict=True)]
    if loading.kind == "bar" and loading.bar_width_mm and loading.bar_width_mm < min(size[:2]):
        top = REFINEMENT * edge
        axis = 0 if loading.bar_axis == "y" else 1
        flat[axis] = _across_bar(size[axis] / 2.0, loading.bar_width_mm / 2.0, top, edge)
    heights, names = [np.zeros(1)], []
    for layer in experiment.layers:
        ends = [edge + (top - edge) * z / experiment.height_mm for z in (layer.from_base_mm, layer.to_base_mm)]
        inner = layer.from_base_mm + graded(layer.to_base_mm - layer.from_base_mm, *ends)
        heights.append(inner[1:])
        names += [layer.region] * (len(inner) - 1)
    return box_from_coordinates(flat[0], flat[1], np.concatenate(heights), region_of_slab=names)


def _across_bar(half_size: float, half_bar: float, fine: float, coarse: float) -> FloatArray:
    """Coordinates across a bar whose edges lie at +-half_bar, finest there."""
    under = np.linspace(0.0, half_bar, max(1, round(half_bar / fine)) + 1)
    half = np.concatenate([under, half_bar + graded(half_size - half_bar, fine, coarse)[1:]])
    return np.concatenate([-half[:0:-1], half])


def graded(length: float, first: float, last: float) -> FloatArray:
    """Return coordinates from 0 to `length` of cells that grow geometrically from about `first` to about `last`."""
    mean = first if np.isclose(first, last) else (last - first) / np.log(last / first)
    count = max(1, round(length / mean))
    sizes = first * (last / first) ** ((np.arange(count) + 0.5) / count)
    return np.asarray(np.concatenate([[0.0], np.cumsum(sizes)]) * (length / sizes.sum()))
