"""Meshes of simple solids from their dimensions: boxes, layered boxes, half ellipsoids, hemispheres and cylinders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, require_positive
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing._o_grid import round_positions, smoothed, wrapped
from naibu.meshing.element_conversion import to_tetra

_AXES = ("x", "y", "z")
# Half width and bulge of the core of round solids: they maximise the smallest scaled Jacobian of half ellipsoids of ratios 1 to 4.
_CORE, _BULGE = 0.5, 0.7
# Half the cells of the core's side for one cell size of radius: cells are slightly smaller than requested in the core, larger outside.
_CORE_CELLS = 0.6


def box_from_coordinates(
    x: ArrayLike, y: ArrayLike, z: ArrayLike, *, cell_type: str = "hexahedron", region_of_slab: Sequence[str] | None = None
) -> Mesh:
    """Mesh a box with given coordinates of its grid lines.

    Parameters
    ----------
    x, y, z : array_like, shape (nx,), (ny,), (nz,)
        Strictly increasing node coordinates, mm.
    cell_type : {"hexahedron", "tetra"}
        ``"tetra"`` splits every cell into Kuhn's six tetrahedra, which conform across cells :cite:p:`kuhn1960`.
    region_of_slab : sequence of str, length nz - 1, optional
        Region name of every slab of cells, from the lowest z up. Names may repeat. Default: one region, ``"body"``.

    Returns
    -------
    Mesh
        Node ``ix + nx * (iy + ny * iz)`` is at ``(x[ix], y[iy], z[iz])``; cells follow the same order.

    Raises
    ------
    InputError
        Coordinates that do not increase, too few of them, a wrong number of region names, or an unknown cell type.
    """
    axes = [_checked_coordinates(name, values) for name, values in zip(_AXES, (x, y, z), strict=True)]
    nx, ny, nz = (len(axis) for axis in axes)
    names, slab = _numbered(["body"] * (nz - 1) if region_of_slab is None else region_of_slab)
    if len(slab) != nz - 1:
        raise InputError(f"region_of_slab names {len(slab)} slabs, but {nz} z coordinates make {nz - 1}; give one name a slab")
    regions = np.repeat(slab, (nx - 1) * (ny - 1))
    return _as_type(Mesh.from_arrays(_grid(*axes), grid_cells(nx, ny, nz), "hexahedron", regions=regions, region_names=names), cell_type)


def box(
    size_mm: Sequence[float],
    divisions: Sequence[int],
    *,
    layers: Sequence[tuple[str, float]] | None = None,
    breaks: Mapping[str, Sequence[float]] | None = None,
    grading: float | Sequence[float] = 1.0,
    centred: bool = True,
    cell_type: str = "hexahedron",
) -> Mesh:
    """Mesh a box that stands on z = 0.

    Parameters
    ----------
    size_mm : sequence of 3 floats
        Extents along x, y and z, mm.
    divisions : sequence of 3 ints
        Cells along x, y and z. Where `layers` or `breaks` cut an axis, each interval gets its proportion, rounded and at least
        one, so that the total of that axis may differ a little.
    layers : sequence of (name, thickness), optional
        Regions from the base up, with their thickness, mm; they must add up to the height. Default: one region, ``"body"``.
    breaks : mapping of {"x", "y", "z"} to sequence of float, optional
        Coordinates (mm, in the frame of the mesh) where a face between cells must lie: ``{"x": (-6.5, 6.5)}``.
    grading : float or sequence of 3 floats
        Size of the cells in the middle of an axis over that of the cells at its two ends; 1 is uniform, 3 refines the faces.
    centred : bool
        True puts x = y = 0 at the middle of the box, False at its corner.
    cell_type : {"hexahedron", "tetra"}
        ``"tetra"`` splits every cell into Kuhn's six tetrahedra.

    Returns
    -------
    Mesh
        Nodes numbered as by `box_from_coordinates`.

    Raises
    ------
    InputError
        Sizes, divisions or gradings that are not positive, layers that do not fill the height, or breaks outside the box.
    """
    size = _three("size_mm", size_mm)
    counts = _three("divisions", divisions)
    ratios = np.full(3, float(grading)) if isinstance(grading, int | float) else _three("grading", grading)
    start = np.array([-size[0] / 2, -size[1] / 2, 0.0]) if centred else np.zeros(3)
    named = _named_layers(layers, float(size[2]))
    tops = _layer_tops(named, float(size[2]))
    forced = {axis: list((breaks or {}).get(axis, ())) for axis in _AXES}
    if unknown := set(breaks or {}) - set(_AXES):
        raise InputError(f"breaks name the axes {sorted(unknown)}; use 'x', 'y' or 'z'")
    forced["z"] += list(tops[:-1])
    x, y, z = (_graded(axis, start[i], start[i] + size[i], counts[i], ratios[i], forced[axis], size.max()) for i, axis in enumerate(_AXES))
    return box_from_coordinates(x, y, z, cell_type=cell_type, region_of_slab=_names_of_slabs(named, tops, z))


def half_ellipsoid(size_mm: Sequence[float], element_size_mm: float, *, cell_type: str = "hexahedron") -> Mesh:
    """Mesh the upper half of an ellipsoid: its flat side lies on z = 0, its axis is x = y = 0.

    Parameters
    ----------
    size_mm : sequence of 3 floats
        Full extent along x, full extent along y, and height, mm.
    element_size_mm : float
        Target size of the cells, mm.
    cell_type : {"hexahedron", "tetra"}
        ``"tetra"`` splits every hexahedron into six.

    Returns
    -------
    Mesh
        A core grid wrapped in shells: no cell is degenerate. Surface nodes lie on the ellipsoid, so that the volume converges with the
        square of the element size.

    Raises
    ------
    InputError
        Sizes that are not positive, or an unknown cell type.
    """
    radii = _three("size_mm", size_mm) / [2, 2, 1]
    n = [max(1, round(r)) for r in _CORE_CELLS * radii / require_positive("element_size_mm", element_size_mm)]
    shells = max(1, round((1 - _CORE) * float(np.cbrt(radii.prod())) / element_size_mm))
    cube = _grid(np.arange(-n[0], n[0] + 1) / n[0], np.arange(-n[1], n[1] + 1) / n[1], np.arange(n[2] + 1) / n[2])
    grid = wrapped(grid_cells(2 * n[0] + 1, 2 * n[1] + 1, n[2] + 1), (cube[:, 2] == 0)[None], shells)
    cube = cube[grid.base]
    free = np.repeat((grid.shell < shells)[:, None], 3, axis=1)
    free[cube[:, 2] == 0, 2] = False
    points = smoothed(round_positions(cube, grid.shell, _CORE, _BULGE) * radii, grid.cells, free)
    return _as_type(Mesh.from_arrays(points, grid.cells, "hexahedron"), cell_type)


def hemisphere(diameter_mm: float, element_size_mm: float, *, cell_type: str = "hexahedron") -> Mesh:
    """Mesh a hemisphere whose flat side lies on z = 0, centred at the origin; see `half_ellipsoid`.

    Parameters
    ----------
    diameter_mm : float
        Diameter, mm.
    element_size_mm : float
        Target size of the cells, mm.
    cell_type : {"hexahedron", "tetra"}
        ``"tetra"`` splits every hexahedron into six.

    Raises
    ------
    InputError
        Sizes that are not positive, or an unknown cell type.
    """
    diameter = require_positive("diameter_mm", diameter_mm)
    return half_ellipsoid((diameter, diameter, diameter / 2), element_size_mm, cell_type=cell_type)


def cylinder(
    diameter_mm: float,
    height_mm: float,
    element_size_mm: float,
    *,
    layers: Sequence[tuple[str, float]] | None = None,
    grading: float = 1.0,
    cell_type: str = "hexahedron",
) -> Mesh:
    """Mesh an upright cylinder that stands on z = 0 around x = y = 0.

    Parameters
    ----------
    diameter_mm, height_mm : float
        Dimensions of the cylinder, mm.
    element_size_mm : float
        Target size of the cells, mm.
    layers : sequence of (name, thickness), optional
        Regions from the base up, with their thickness, mm; they must add up to the height. Default: one region, ``"body"``.
    grading : float
        Height of the cells in the middle over that at the two ends.
    cell_type : {"hexahedron", "tetra"}
        ``"tetra"`` splits every hexahedron into six.

    Returns
    -------
    Mesh
        A square core wrapped in rings; nodes of the side lie on the cylinder.

    Raises
    ------
    InputError
        Sizes that are not positive, layers that do not fill the height, or an unknown cell type.
    """
    radius, height = require_positive("diameter_mm", diameter_mm) / 2, require_positive("height_mm", height_mm)
    size = require_positive("element_size_mm", element_size_mm)
    named = _named_layers(layers, height)
    tops = _layer_tops(named, height)
    z = _graded("z", 0.0, height, height / size, require_positive("grading", grading), tops[:-1].tolist(), height)
    n, shells = max(1, round(_CORE_CELLS * radius / size)), max(1, round((1 - _CORE) * radius / size))
    square = np.arange(-n, n + 1) / n
    cube = _grid(square, square, z)
    grid = wrapped(grid_cells(2 * n + 1, 2 * n + 1, len(z)), np.stack([cube[:, 2] == 0, cube[:, 2] == height]), shells)
    cube = cube[grid.base]
    free = np.repeat((grid.shell < shells)[:, None], 3, axis=1) & np.array([True, True, False])
    points = np.column_stack([round_positions(cube[:, :2], grid.shell, _CORE, _BULGE) * radius, cube[:, 2]])
    names, slab = _numbered(_names_of_slabs(named, tops, z))
    regions = slab[grid.owner // (2 * n) ** 2]
    mesh = Mesh.from_arrays(smoothed(points, grid.cells, free), grid.cells, "hexahedron", regions=regions, region_names=names)
    return _as_type(mesh, cell_type)


def grid_cells(nx: int, ny: int, nz: int) -> IntArray:
    """Return the hexahedra ((nx-1)(ny-1)(nz-1), 8) of a grid whose node (ix, iy, iz) has number ``ix + nx * (iy + ny * iz)``."""
    iz, iy, ix = np.meshgrid(np.arange(nz - 1), np.arange(ny - 1), np.arange(nx - 1), indexing="ij")
    corner = (ix + nx * (iy + ny * iz)).ravel()
    base = np.array([0, 1, nx + 1, nx])
    cells: IntArray = (corner[:, None] + np.concatenate([base, base + nx * ny])).astype(np.int64)
    return cells


def _as_type(mesh: Mesh, cell_type: str) -> Mesh:
    """Return the hexahedral mesh as cells of the requested type."""
    if cell_type not in ("hexahedron", "tetra"):
        raise InputError(f"cell_type is {cell_type!r}; use 'hexahedron' or 'tetra' (and to_quadratic for 'tetra10')")
    return to_tetra(mesh) if cell_type == "tetra" else mesh


def _checked_coordinates(name: str, values: ArrayLike) -> FloatArray:
    """Return one axis of node coordinates as floats, after checks."""
    axis = np.asarray(values, dtype=np.float64)
    if axis.ndim != 1 or len(axis) < 2:
        raise InputError(f"{name} coordinates have shape {axis.shape}; give at least two values in one row")
    steps = np.diff(axis)
    if not (np.isfinite(axis).all() and (steps > 0).all()):
        bad = int(np.flatnonzero(~(steps > 0))[0]) if not (steps > 0).all() else 0
        raise InputError(f"{name} coordinates must be finite and increase, but entry {bad + 1} is {axis[bad + 1]} after {axis[bad]}")
    return axis


def _numbered(names: Sequence[str]) -> tuple[list[str], IntArray]:
    """Return the different names in order of first use, and the number of each name in `names`."""
    different = list(dict.fromkeys(names))
    return different, np.array([different.index(name) for name in names], dtype=np.int64)


def _three(name: str, values: Sequence[float]) -> FloatArray:
    """Return three positive numbers as an array."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (3,) or not (np.isfinite(array) & (array > 0)).all():
        raise InputError(f"{name} is {values!r}; give three positive numbers, for x, y and z")
    if name == "divisions" and (array != np.round(array)).any():
        raise InputError(f"divisions are {values!r}; give three whole numbers")
    return array


def _grid(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Return the points (nx ny nz, 3) of a tensor grid, x fastest."""
    gz, gy, gx = np.meshgrid(z, y, x, indexing="ij")
    return np.stack([gx.ravel(), gy.ravel(), gz.ravel()], axis=1)


def _named_layers(layers: Sequence[tuple[str, float]] | None, height: float) -> list[tuple[str, float]]:
    """Return the layers as given, or one that fills the height."""
    return [("body", height)] if layers is None else [(str(name), float(t)) for name, t in layers]


def _names_of_slabs(layers: Sequence[tuple[str, float]], tops: FloatArray, z: FloatArray) -> list[str]:
    """Return the name of the layer around the middle of every slab of cells."""
    return [layers[i][0] for i in np.searchsorted(tops, 0.5 * (z[1:] + z[:-1])).clip(max=len(layers) - 1)]


def _layer_tops(layers: Sequence[tuple[str, float]], height: float) -> FloatArray:
    """Return the z (mm) of the top of every layer, the last exactly at the height."""
    thickness = np.array([t for _, t in layers])
    if len(layers) == 0 or not (thickness > 0).all():
        raise InputError(f"layers are {list(layers)!r}; give (name, thickness in mm) with positive thicknesses, from the base up")
    tops = np.cumsum(thickness)
    if abs(tops[-1] - height) > 1e-6 * height:
        raise InputError(f"the layers add up to {tops[-1]:g} mm, but the box is {height:g} mm high; change one of them")
    tops[-1] = height
    return np.asarray(tops, dtype=np.float64)


def _graded(name: str, low: float, high: float, count: float, ratio: float, breaks: Sequence[float], scale: float) -> FloatArray:
    """Return node coordinates from `low` to `high` that meet every break, with cells `ratio` times smaller at the ends."""
    inner = np.unique(np.asarray(breaks, dtype=np.float64))
    inner = inner[(np.abs(inner - low) > 1e-9 * scale) & (np.abs(inner - high) > 1e-9 * scale)]
    # Two breaks that differ by rounding (the top of a layer and the edge of a bar) are one.
    inner = inner[np.diff(inner, prepend=-np.inf) > 1e-9 * scale]
    if len(inner) and not (low < inner[0] and inner[-1] < high):
        raise InputError(f"breaks along {name} are {inner.tolist()} mm, but the box reaches from {low:g} to {high:g} mm")
    knots = np.concatenate([[low], inner, [high]])
    # In the stretched coordinate s in [-1, 1] cells are equal: dx/ds falls as ratio**-|s| from the middle to both ends.
    rate = np.log(ratio)
    u = 2 * (knots - low) / (high - low) - 1
    s = u if abs(rate) < 1e-9 else -np.sign(u) * np.log1p(-np.abs(u) * -np.expm1(-rate)) / rate
    cells = np.maximum(np.floor(np.diff(s) / 2 * count + 0.5 + 1e-9), 1).astype(int)
    parts = [np.linspace(s[i], s[i + 1], n, endpoint=False) for i, n in enumerate(cells)]
    s_nodes = np.concatenate([*parts, [1.0]])
    u_nodes = s_nodes if abs(rate) < 1e-9 else np.sign(s_nodes) * np.expm1(-rate * np.abs(s_nodes)) / np.expm1(-rate)
    nodes = low + (u_nodes + 1) / 2 * (high - low)
    nodes[np.concatenate([[0], np.cumsum(cells)])] = knots
    return np.asarray(nodes, dtype=np.float64)
