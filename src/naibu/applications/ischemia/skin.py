"""A patch of layered viscoelastic skin under a load on its surface: geometry, materials and the load.

Layers of three-element material (a Voigt solid in series with a dashpot) lie on a rigid base, as in the study of active ischemia of
:cite:t:`hirai2008` (chapter 5.3). The load is a force on one node, as there, or the pressure of an air jet :cite:p:`kaneko2007`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from naibu.core.arrays import FloatArray, IntArray, require_count, require_positive
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.small_strain.averaged_dilatation import BrickGrid, Kinematics
from naibu.mechanics.small_strain.rheology import Rheology

Sides = Literal["free", "fixed"]


@dataclass(frozen=True, slots=True)
class SkinLayer:
    """A layer of skin.

    Attributes
    ----------
    thickness_mm : float
        Thickness, mm.
    material : Rheology
        Three elements; the three Poisson ratios must be equal.
    density : float
        kg/mm^3.
    """

    thickness_mm: float
    material: Rheology
    density: float = 1.2e-6

    def __post_init__(self) -> None:
        require_positive("thickness_mm", self.thickness_mm)
        require_positive("density", self.density)
        m = self.material
        if not m.poisson_ratio == m.voigt_poisson_ratio == m.series_poisson_ratio:
            raise InputError(
                f"material of a layer must have one Poisson ratio, not {m.poisson_ratio:g}, {m.voigt_poisson_ratio:g} and "
                f"{m.series_poisson_ratio:g}: the response is computed from one relaxation function a layer"
            )
        if m.young_modulus <= 0.0:
            raise InputError(f"young_modulus of a layer must be positive, not {m.young_modulus:g} kPa")


@dataclass(frozen=True, slots=True)
class SurfaceLoad:
    """A load on the surface, constant while it acts.

    Attributes
    ----------
    force_mn : float
        Total force, mN, downwards.
    duration_s : float
        How long it acts, from time zero, s.
    radius_mm : float
        Radius of the area it acts on (half of its width in plane strain), mm; zero is a force on the node in the middle.
    """

    force_mn: float
    duration_s: float
    radius_mm: float = 0.0

    def __post_init__(self) -> None:
        require_positive("force_mn", self.force_mn)
        require_positive("duration_s", self.duration_s)
        if not (np.isfinite(self.radius_mm) and self.radius_mm >= 0.0):
            raise InputError(f"radius_mm must be zero, for a force on a node, or positive, not {self.radius_mm:g}")


@dataclass(frozen=True, slots=True)
class SkinPatch:
    """Layers on a rigid base, loaded in the middle of their surface.

    Attributes
    ----------
    layers : tuple of SkinLayer
        From the base upwards, one or two.
    width_mm : float
        Width of the patch, mm: its diameter if axisymmetric.
    kinematics : {"plane_strain", "axisymmetric", "three_dimensional"}
        Axisymmetric for a round jet; in plane strain the patch is `depth_mm` deep, and three-dimensional patches are square.
    depth_mm : float
        Depth in plane strain, mm.
    sides : {"free", "fixed"}
        Whether the outer sides move.
    """

    layers: tuple[SkinLayer, ...]
    width_mm: float
    kinematics: Kinematics = "plane_strain"
    depth_mm: float = 1.0
    sides: Sides = "free"

    def __post_init__(self) -> None:
        require_positive("width_mm", self.width_mm)
        require_positive("depth_mm", self.depth_mm)
        if len(self.layers) not in (1, 2):
            raise InputError(f"layers must be one or two, from the base upwards, not {len(self.layers)}")

    @property
    def height_mm(self) -> float:
        """Height of all layers, mm."""
        return sum(layer.thickness_mm for layer in self.layers)


@dataclass(frozen=True, slots=True, eq=False)
class MeshedPatch:
    """A patch with its grid, the layer of every cell, its supports and its load.

    Attributes
    ----------
    patch : SkinPatch
        What is meshed.
    grid : BrickGrid
        Elements.
    layer : ndarray, shape (m,), int64
        Layer of every cell.
    constrained : ndarray, shape (n, d), bool
        Components that do not move.
    load : ndarray, shape (n, d)
        Nodal forces of a total force of 1 mN.
    middle : int
        The node in the middle of the surface.
    load_radius_mm : float
        Radius of the loaded area, mm; zero for a force on the node in the middle.
    """

    patch: SkinPatch
    grid: BrickGrid
    layer: IntArray
    constrained: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    load: FloatArray
    middle: int
    load_radius_mm: float

    def unit_stiffness(self, layer: int) -> tuple[FloatArray, FloatArray]:
        """Return Lame's constants (m,) of a layer for E = 1 kPa, and zero in the others."""
        inside = self.layer == layer
        lame, shear = lame_parameters(1.0, self.patch.layers[layer].material.poisson_ratio)
        return np.where(inside, lame, 0.0), np.where(inside, shear, 0.0)

    @property
    def surface_cells(self) -> IntArray:
        """Cells below the surface."""
        top = self.grid.points[:, -1].max()
        return np.flatnonzero(self.grid.points[self.grid.cells[:, -1], -1] == top)

    @property
    def surface_areas(self) -> FloatArray:
        """Area of the surface (k,) over each of the `surface_cells`, mm^2; symmetric halves count twice."""
        low, high = (self.grid.points[self.grid.cells[self.surface_cells][:, i]] for i in (0, -1))
        if self.grid.kinematics == "axisymmetric":
            return np.asarray(np.pi * (high[:, 0] ** 2 - low[:, 0] ** 2))
        if self.grid.kinematics == "plane_strain":
            return np.asarray((high[:, 0] - low[:, 0]) * self.patch.depth_mm)
        return np.asarray((high[:, 0] - low[:, 0]) * (high[:, 1] - low[:, 1]))


def meshed(patch: SkinPatch, load_radius_mm: float, *, across: int = 24, upwards: int = 12) -> MeshedPatch:
    """Return the grid of a patch, finer towards the load.

    Parameters
    ----------
    patch : SkinPatch
        Layers, width and kinematics.
    load_radius_mm : float
        Radius of the loaded area, mm; zero for a force on the node in the middle.
    across, upwards : int
        Number of cells over half of the width (the radius), and over the height.

    Raises
    ------
    InputError
        A load wider than the patch, or too few cells.
    """
    require_count("across", across, 2)
    require_count("upwards", upwards, 2)
    half = 0.5 * patch.width_mm
    if load_radius_mm >= half:
        raise InputError(f"radius_mm of the load must be smaller than half of the width of the patch, {half:g} mm, not {load_radius_mm:g}")
    outward = graded(half, load_radius_mm, across)
    both = np.concatenate([-outward[:0:-1], outward])
    vertical = _layer_planes(patch, upwards)
    planes = {
        "plane_strain": (both, vertical),
        "axisymmetric": (outward, vertical),
        "three_dimensional": (both, both, vertical),
    }[patch.kinematics]
    return from_planes(patch, planes, load_radius_mm)


def from_planes(patch: SkinPatch, planes: tuple[FloatArray, ...], load_radius_mm: float) -> MeshedPatch:
    """Return the grid of a patch between given planes; see `meshed`."""
    grid = BrickGrid.of(planes, patch.kinematics)
    points = grid.points
    bounds = np.cumsum([0.0, *(layer.thickness_mm for layer in patch.layers)])
    layer = np.clip(np.searchsorted(bounds, grid.centres[:, -1]) - 1, 0, len(patch.layers) - 1)
    constrained = np.zeros(points.shape, dtype=bool)
    constrained[points[:, -1] == points[:, -1].min()] = True
    for axis in range(points.shape[1] - 1):
        if patch.kinematics == "axisymmetric":
            constrained[points[:, 0] == 0.0, 0] = True
        if patch.sides == "fixed":
            outer = np.abs(points[:, axis]) == np.abs(points[:, axis]).max()
            constrained[outer] = True
    top = points[:, -1] == points[:, -1].max()
    middle = int(np.flatnonzero(top)[np.argmin((points[top, :-1] ** 2).sum(axis=1))])
    force = np.zeros(points.shape)
    force[:, -1] = -_nodal_shares(grid, points, top, middle, load_radius_mm)
    if patch.kinematics == "plane_strain":
        force /= patch.depth_mm  # the grid is 1 mm deep
    return MeshedPatch(patch, grid, layer.astype(np.int64), constrained, force, middle, load_radius_mm)


def refined(mesh: MeshedPatch) -> MeshedPatch:
    """Return the same patch with halved cells."""
    halved = [np.sort(np.concatenate([p, 0.5 * (p[1:] + p[:-1])])) for p in mesh.grid.planes]
    return from_planes(mesh.patch, tuple(halved), mesh.load_radius_mm)


def graded(half_mm: float, fine_mm: float, count: int) -> FloatArray:
    """Return planes from 0 to `half_mm`: even up to `fine_mm` (with a half of the cells), and then growing evenly in ratio."""
    if fine_mm == 0.0:
        ratio = 1.0 + 1.5 / count
        steps = ratio ** np.arange(count)
        return np.asarray(np.concatenate([[0.0], np.cumsum(steps)]) * half_mm / steps.sum())
    inner = max(1, count // 2)
    outer = count - inner
    even = np.linspace(0.0, fine_mm, inner + 1)
    return np.concatenate([even, np.geomspace(fine_mm, half_mm, outer + 1)[1:]])


def _layer_planes(patch: SkinPatch, upwards: int) -> FloatArray:
    planes = [np.zeros(1)]
    begin = 0.0
    for layer in patch.layers:
        count = max(2, round(upwards * layer.thickness_mm / patch.height_mm))
        planes.append(np.linspace(begin, begin + layer.thickness_mm, count + 1)[1:])
        begin += layer.thickness_mm
    return np.concatenate(planes)


def _nodal_shares(grid: BrickGrid, points: FloatArray, top: np.ndarray, middle: int, radius_mm: float) -> FloatArray:
    """Return the share of every node (n,) in an even pressure on the loaded area; the shares add up to one."""
    shares = np.zeros(len(points))
    if radius_mm == 0.0:
        shares[middle] = 1.0
        return shares
    surface = np.flatnonzero(points[grid.cells[:, -1], -1] == points[:, -1].max())
    corners = grid.cells[surface][:, 1::2]  # the upper corners: the last axis varies fastest
    centres = points[corners][..., :-1].mean(axis=1)
    loaded = np.linalg.norm(centres, axis=1) < radius_mm
    low, high = points[corners[:, 0], :-1], points[corners[:, -1], :-1]
    if grid.kinematics == "axisymmetric":
        a, b = low[:, 0], high[:, 0]
        # integrals of the two shape functions over a ring
        inner = 2.0 * np.pi * (b - a) * (2.0 * a + b) / 6.0
        outer = 2.0 * np.pi * (b - a) * (a + 2.0 * b) / 6.0
        parts = np.stack([inner, outer], axis=1)
    else:
        parts = np.repeat((high - low).prod(axis=1)[:, None] / corners.shape[1], corners.shape[1], axis=1)
    np.add.at(shares, corners[loaded].ravel(), parts[loaded].ravel())
    return np.asarray(shares / shares.sum())
