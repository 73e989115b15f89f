"""Finite element mesh of a cross-beam chip: quadratic tetrahedra, mirrored exactly in all its planes of symmetry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.sensing_chip.design import ChipDesign
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.element_conversion import split_hexahedra, to_quadratic
from naibu.meshing.primitives import box_from_coordinates

BEAMS = ("A", "B", "C", "D")
_ROUND = 1e-9  # mm


@dataclass(frozen=True, slots=True)
class ChipResolution:
    """Numbers of cells of a chip's mesh.

    Attributes
    ----------
    along, across, through : int
        Of a beam: along it, across half of its width, and through its thickness. Cells along it are smaller at its ends.
    below : int
        Of block and frame below the beams; smaller near the beams.
    frame : int
        Across the frame; smaller near the beams.

    Raises
    ------
    InputError
        A number below 1.
    """

    along: int = 10
    across: int = 2
    through: int = 3
    below: int = 3
    frame: int = 4

    def __post_init__(self) -> None:
        if min(self.along, self.across, self.through, self.below, self.frame) < 1:
            raise InputError(f"{self} has a number of cells below 1; give at least 1 of each")


@dataclass(frozen=True, slots=True, eq=False)
class ChipMesh:
    """Mesh of a chip, or of its beams alone.

    Attributes
    ----------
    mesh : Mesh
        Quadratic tetrahedra; regions ``"A"`` to ``"D"`` are the beams, then ``"block"`` and ``"frame"``.
    loaded : ndarray, shape (n,), bool
        Nodes that move rigidly with the load: under the pillar, or the beams' inner ends.
    fixed : ndarray, shape (n,), bool
        Nodes that are fixed: below the frame, or the beams' outer ends.
    """

    mesh: Mesh
    loaded: BoolArray
    fixed: BoolArray


def chip_mesh(design: ChipDesign, resolution: ChipResolution | None = None, *, whole: bool = True) -> ChipMesh:
    """Mesh a chip.

    Parameters
    ----------
    design : ChipDesign
        Dimensions.
    resolution : ChipResolution, optional
        Numbers of cells.
    whole : bool
        Whether the elastic block and frame are meshed; otherwise the beams alone, between a rigid block and rigid clamps, as the closed
        forms suppose.
    """
    r = resolution or ChipResolution()
    x, z = _lines(design, r), _levels(design, r)
    grid = box_from_coordinates(x, x, z)
    region = _region_of(design, grid.points[grid.cells].mean(axis=1))
    wanted = region >= 0 if whole else (region >= 0) & (region < len(BEAMS))
    mesh = to_quadratic(_symmetric_tetrahedra(grid.points, grid.cells[wanted], region[wanted]))
    points = mesh.points
    far = np.abs(points[:, :2]).max(axis=1)
    half, outer = design.block_half_width_mm, design.block_half_width_mm + design.beam_length_mm
    if whole:
        top = points[:, 2] > 0.5 * design.beam_thickness_mm - _ROUND
        loaded = top & (far < 0.5 * design.pillar_width_mm + _ROUND)
        fixed = (points[:, 2] < z[0] + _ROUND) & (far > outer - _ROUND)
    else:
        loaded, fixed = far < half + _ROUND, far > outer - _ROUND
    return ChipMesh(mesh, loaded, fixed)


def _lines(design: ChipDesign, r: ChipResolution) -> FloatArray:
    """Return the grid lines along x or y, symmetric about 0."""
    half, outer = design.block_half_width_mm, design.block_half_width_mm + design.beam_length_mm
    steps = np.linspace(-1.0, 1.0, r.along + 1)
    along = half + 0.5 * design.beam_length_mm * (1.0 + 0.5 * steps * (3.0 - steps**2) * 0.6 + 0.4 * steps)
    inner = np.unique(np.round([0.5 * design.beam_width_mm, 0.5 * design.pillar_width_mm, half], 9))
    size = 0.5 * design.beam_width_mm / r.across
    parts, low = [np.zeros(1)], 0.0
    for high in inner:
        count = max(1, round((high - low) / (1.0 if high == inner[0] else 1.5) / size))
        parts.append(np.linspace(low, high, count + 1)[1:])
        low = high
    frame = outer + design.frame_width_mm * np.linspace(0.0, 1.0, r.frame + 1)[1:] ** 2
    positive = np.concatenate([*parts, along[1:], frame])
    return np.concatenate([-positive[:0:-1], positive])


def _levels(design: ChipDesign, r: ChipResolution) -> FloatArray:
    top, bottom = 0.5 * design.beam_thickness_mm, 0.5 * design.beam_thickness_mm - design.block_height_mm
    beams = np.linspace(-top, top, r.through + 1)
    if bottom > -top - _ROUND:
        return beams
    return np.concatenate([-top + (bottom + top) * np.linspace(1.0, 0.0, r.below + 1)[:-1] ** 2, beams])


def _region_of(design: ChipDesign, centres: FloatArray) -> IntArray:
    """Return 0 to 3 in the beams, 4 in the block, 5 in the frame and -1 in the openings."""
    x, y, z = centres.T
    half, outer = design.block_half_width_mm, design.block_half_width_mm + design.beam_length_mm
    far = np.maximum(np.abs(x), np.abs(y))
    region = np.full(len(centres), -1)
    region[far < half] = 4
    region[far > outer] = 5
    at_height = (z > -0.5 * design.beam_thickness_mm) & (far > half) & (far < outer)
    for k, (along, across, sign) in enumerate(((x, y, -1.0), (x, y, 1.0), (y, x, -1.0), (y, x, 1.0))):
        region[at_height & (sign * along > half) & (np.abs(across) < 0.5 * design.beam_width_mm)] = k
    return region


def _symmetric_tetrahedra(points: FloatArray, cells: IntArray, region: IntArray) -> Mesh:
    """Split hexahedra so that the tetrahedra have the symmetry of the chip.

    Diagonals start at the lowest of a face's nodes: these are numbered by height, then by |x| + |y|, which differs along every diagonal.
    """
    used = np.unique(cells)
    order = used[np.lexsort((np.round(np.abs(points[used, :2]).sum(axis=1), 9), np.round(points[used, 2], 9)))]
    number = np.full(len(points), -1)
    number[order] = np.arange(len(order))
    names = (*BEAMS, "block", "frame")[: int(region.max()) + 1]
    return Mesh.from_arrays(points[order], split_hexahedra(number[cells]), "tetra", regions=np.repeat(region, 6), region_names=names)
