"""Stress at the rounded corners where beams meet block and frame: finite elements of one end of a beam, and loads that it bears.

In a sharp re-entrant corner the stress has no bound. With fillets it has: one end of a beam with part of the wall it grows from is solved
for the six resultants of a section, finely around the fillet, and the resultants at the eight ends of the chip's beams follow from the
finite elements of the beams.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.sensing_chip.design import ChipDesign
from naibu.applications.sensing_chip.finite_elements import ChipResponse
from naibu.applications.sensing_chip.load_envelope import envelope_along_rays
from naibu.core.arrays import BoolArray, FloatArray, IntArray, require_count, require_positive, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.small_strain.anisotropic_body import AnisotropicBody
from naibu.meshing.element_conversion import split_hexahedra, to_quadratic
from naibu.meshing.primitives import box_from_coordinates
from naibu.meshing.surface import boundary_faces

_WALL = 2.0  # thicknesses of the wall that are meshed around a beam
_GROWTH = 1.7
_ROUND = 1e-9  # mm
_SIDES = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))  # from a wall into the beam, in the plane of the chip


@dataclass(frozen=True, slots=True, eq=False)
class FilletedEnd:
    """One end of a beam, in the four directions in which ends of the chip's beams lie.

    Attributes
    ----------
    design : ChipDesign
        The chip.
    fillet_mm : float
        Radius of the fillets beside and below the beams, mm.
    points : ndarray, shape (n, 3)
        Nodes of the surface near the fillet, from the middle of the section in the wall: along the beam, across, and up, mm.
    stress : ndarray, shape (4, 6, n, 3, 3)
        kPa per unit force, mN, and moment, mN mm, of the beam on the wall, of walls from which a beam goes along x, y, -x and -y;
        components of loads and stresses are those along the beam, across it and up.
    """

    design: ChipDesign
    fillet_mm: float
    points: FloatArray
    stress: FloatArray

    def largest_stress(self, beams: ChipResponse, loads: ArrayLike) -> FloatArray:
        """Return the largest principal stress at the eight ends of the beams under loads on the block, kPa.

        Parameters
        ----------
        beams : ChipResponse
            Of the beams alone.
        loads : array_like, shape (k, 6)
            F_x, F_y, F_z, M_x, M_y, M_z, mN and mN mm.

        Returns
        -------
        ndarray, shape (k,)
        """
        rows = np.asarray(loads, dtype=float)
        require_shape("loads", rows, (len(rows), 6))
        largest = np.zeros(len(rows))
        for side, resultants in end_loads(beams):
            stress = np.tensordot(rows @ resultants, self.stress[side], 1)
            largest = np.maximum(largest, np.linalg.eigvalsh(stress)[..., 2].max(axis=1))
        return largest

    def concentration(self, beams: ChipResponse) -> FloatArray:
        """Return the largest principal stress over the nominal one of the closed forms, for F_z and M_y alone (2,)."""
        forms = self.design.closed_forms
        bending = max(abs(float(forms.bending_stress(x))) for x in (0.0, self.design.beam_length_mm))
        nominal = np.array([float(forms.force_stress(0.0)), bending / float(forms.moment_stiffness)])
        return np.asarray(self.largest_stress(beams, np.eye(6)[[2, 4]]) / nominal)

    def load_limits(self, beams: ChipResponse) -> FloatArray:
        """Return the largest F_z, mN, M_x and M_y, mN mm, that the ends bear, each alone (3,), of either sign."""
        units = np.eye(6)[[2, 3, 4]]
        return np.asarray(self.design.strength_kpa / np.maximum(self.largest_stress(beams, units), self.largest_stress(beams, -units)))

    def envelope(self, beams: ChipResponse, *, azimuth_deg: float = 0.0, count: int = 31) -> FloatArray:
        """Return the largest loads in the plane of force and moment, of any sign.

        Parameters
        ----------
        beams : ChipResponse
            Of the beams alone.
        azimuth_deg : float
            Direction of the moment from x towards y, degrees.
        count : int
            Number of points.

        Returns
        -------
        ndarray, shape (count, 2)
            F_z, mN, and size of the moment, mN mm, from the force alone to the moment alone.
        """

        def stress(force: FloatArray, moment_x: FloatArray, moment_y: FloatArray) -> FloatArray:
            loads, worst = np.zeros((count, 6)), np.zeros(count)
            for sign, way in product((1.0, -1.0), repeat=2):
                loads[:, 2], loads[:, 3], loads[:, 4] = sign * force, way * moment_x, way * moment_y
                worst = np.maximum(worst, self.largest_stress(beams, loads))
            return worst

        return envelope_along_rays(self.load_limits(beams), self.design.strength_kpa, stress, azimuth_deg=azimuth_deg, count=count)


def require_bearable_at_fillets(end: FilletedEnd, beams: ChipResponse, load: FloatArray) -> float:
    """Return the largest stress at the fillets over the strength under a load (6,), or refuse the load.

    Raises
    ------
    InputError
        The load exceeds what the fillets bear; the message tells by how much.
    """
    used = float(end.largest_stress(beams, load[None])[0]) / end.design.strength_kpa
    if not used <= 1.0:
        trusted = 1e-6 * end.design.strength_kpa
        raise InputError(
            f"load F_z = {load[2]:g} mN, M_x = {load[3]:g} and M_y = {load[4]:g} N um stresses the fillets of {1e3 * end.fillet_mm:g} um "
            f"to {used * trusted:.3g} GPa, and the silicon is trusted with {trusted:.3g} GPa; make the load at most {1.0 / used:.3g} times "
            "as large, or the fillets larger"
        )
    return used


def filleted_end(design: ChipDesign, fillet_mm: float, *, fineness: int = 3) -> FilletedEnd:
    """Solve one end of a beam with fillets.

    Parameters
    ----------
    design : ChipDesign
        The chip. Where the block is no wider than the beams, or no higher, there is no corner beside or below them.
    fillet_mm : float
        Radius of the fillets, mm.
    fineness : int
        Cells along half of the quarter circle.

    Raises
    ------
    InputError
        A radius that does not fit between beam and block, or a number below 1.
    """
    require_fillet(design, fillet_mm)
    require_count("fineness", fineness, 1)
    mesh = end_mesh(design, fillet_mm, fineness)
    points = mesh.points
    held, moved = points[:, 0] < points[:, 0].min() + _ROUND, points[:, 0] > design.beam_length_mm - _ROUND
    motions = np.zeros((6, mesh.n_points, 3))
    for axis in range(3):
        motions[axis, moved, axis] = 1.0
        motions[3 + axis, moved] = np.cross(np.eye(3)[axis], points[moved])
    body = AnisotropicBody.of(mesh)
    surface = np.unique(boundary_faces(mesh).faces)
    near = surface[(np.abs(points[surface, 1]) < 0.5 * design.beam_width_mm + fillet_mm + _ROUND)
                   & (points[surface, 0] > -_ROUND) & (points[surface, 0] < 0.5 * design.beam_length_mm)]  # fmt: skip
    constrained = np.repeat((held | moved)[:, None], 3, axis=1)
    tensors = [_turned(design.stiffness_tensor, side) for side in _SIDES]
    stresses: list[FloatArray] = []
    for k, tensor in enumerate(tensors):
        same = next((j for j in range(k) if np.allclose(tensors[j], tensor, rtol=1e-9, atol=1e-9 * np.abs(tensor).max())), None)
        stresses.append(_unit_stress(body, tensor, constrained, motions, near) if same is None else stresses[same])
    return FilletedEnd(design, fillet_mm, points[near], np.stack(stresses))


def require_fillet(design: ChipDesign, fillet_mm: float) -> None:
    """Refuse a radius of fillets, mm, that does not fit a chip.

    Raises
    ------
    InputError
        It is not positive, or larger than the room beside the beams, below them, or between their ends.
    """
    require_positive("fillet_mm", fillet_mm, "mm")
    rooms = (
        ("between the beams' side and the block's corner", design.block_half_width_mm - 0.5 * design.beam_width_mm, True),
        ("below the beams", design.block_height_mm - design.beam_thickness_mm, True),
        ("along the beams, a quarter of their length", 0.25 * design.beam_length_mm, False),
    )
    for where, room, may_be_none in rooms:
        if fillet_mm > room + _ROUND and not (may_be_none and room < _ROUND):
            raise InputError(f"fillet_mm is {fillet_mm:g}, more than the {room:.4g} mm {where}; make it less")


def _turned(tensor: FloatArray, side: tuple[float, float]) -> FloatArray:
    """Return a stiffness tensor in axes along the beam, across it and up."""
    axes = _axes(side)
    return np.asarray(np.einsum("ai,bj,ck,dl,ijkl->abcd", axes, axes, axes, axes, tensor, optimize=True))


def _axes(side: tuple[float, float]) -> FloatArray:
    """Return rows (3, 3): directions along a beam from its wall, across it and up, in the frame of the chip."""
    x, y = side
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])


def _unit_stress(body: AnisotropicBody, tensor: FloatArray, constrained: BoolArray, motions: FloatArray, near: IntArray) -> FloatArray:
    """Return the stress (6, n, 3, 3) at nodes, kPa per unit load of the moved section about the origin."""
    found, force = body.response(tensor[None], constrained, motions)
    stiffness = np.einsum("ank,bnk->ab", motions, force)
    unit = np.tensordot(np.linalg.inv(0.5 * (stiffness + stiffness.T)), found, 1)
    return np.stack([np.einsum("ijkl,nkl->nij", tensor, body.nodal_strain(u)[near]) for u in unit])


def end_loads(beams: ChipResponse) -> tuple[tuple[int, FloatArray], ...]:
    """Return of all eight ends the direction of the beam from the wall, and what unit loads make the beam exert on the wall there.

    Parameters
    ----------
    beams : ChipResponse
        Of the beams alone.

    Returns
    -------
    tuple of int and ndarray, shape (6, 6)
        Number of the direction (x, y, -x, -y), and force, mN, and moment about the section's centre, mN mm, along the beam, across it and
        up, of each of the six loads on the block.

    Raises
    ------
    InputError
        The response of a whole chip.
    """
    if not np.isfinite(beams.clamp_loads).all():
        raise InputError("beams is the response of a whole chip; give that of its beams alone, `solve_chip(design, whole=False)`")
    ends = []
    for k, outwards in enumerate(((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))):
        inner, outer = _SIDES.index(outwards), _SIDES.index((-outwards[0] + 0.0, -outwards[1] + 0.0))
        force, moment = beams.clamp_loads[:, k, :3], beams.clamp_loads[:, k, 3:]
        arm = beams.design.beam_length_mm * np.array([*outwards, 0.0])
        for side, on_wall, about in ((outer, force, moment), (inner, -force, -(moment + np.cross(arm, force)))):
            axes = _axes(_SIDES[side])
            ends.append((side, np.concatenate([on_wall @ axes.T, about @ axes.T], axis=1)))
    return tuple(ends)


def end_mesh(design: ChipDesign, fillet_mm: float, fineness: int) -> Mesh:
    """Return quadratic tetrahedra of a beam and the wall it grows from, with fillets; the origin is the section's centre in the wall."""
    half, top, length = 0.5 * design.beam_width_mm, 0.5 * design.beam_thickness_mm, design.beam_length_mm
    size, reach = fillet_mm / fineness, _WALL * design.beam_thickness_mm + fillet_mm
    beside = min(design.block_half_width_mm - half, reach)
    below = min(design.block_height_mm - design.beam_thickness_mm, reach)
    x = np.concatenate([-_graded(size, fillet_mm, reach)[:0:-1], _graded(size, fillet_mm, length)])
    out = half + _graded(size, fillet_mm, beside)[1:]
    within = half - _graded(size, 0.0, half)[::-1]
    y = np.concatenate([within, out])
    y = np.concatenate([-y[:0:-1], y])
    z = np.concatenate([-top - _graded(size, fillet_mm, below)[:0:-1], -top + _graded(size, 0.0, 2.0 * top)])
    grid = box_from_coordinates(x, y, z)
    centres = grid.points[grid.cells].mean(axis=1)
    solid = (centres[:, 0] < 0.0) | ((np.abs(centres[:, 1]) < half) & (centres[:, 2] > -top))
    used, cells = np.unique(grid.cells[solid], return_inverse=True)
    corners = grid.points[used]
    order = np.lexsort((np.round(np.abs(corners[:, 1]), 9), corners[:, 0], corners[:, 2]))  # diagonals are mirrored at y = 0
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    sharp = to_quadratic(Mesh.from_arrays(corners[order], split_hexahedra(number[cells].reshape(-1, 8)), "tetra"))
    points = _rounded(sharp.points, design, fillet_mm, reach, sides=beside > _ROUND, underside=below > _ROUND)
    return replace(sharp, points=points)  # with curved edges


def _graded(size: float, even: float, to: float) -> FloatArray:
    """Return coordinates from 0 to `to`: cells of a size up to `even`, then growing ones."""
    if to < _ROUND:
        return np.zeros(1)
    at = [*np.linspace(0.0, even, max(round(even / size), 0) + 1)]
    step = size
    while at[-1] < to - _ROUND:
        step *= _GROWTH
        left = to - at[-1]
        at.append(to if left < 1.5 * step else at[-1] + step)
    return np.array(at)


def _rounded(points: FloatArray, design: ChipDesign, radius: float, reach: float, *, sides: bool, underside: bool) -> FloatArray:
    """Move the points around the sharp corner so that it becomes a quarter circle: the corner's own point becomes its middle.

    Sections of the beam grow towards the wall; on the wall, and into it less and less, the shells around the section move outwards.
    """
    half, thickness = 0.5 * design.beam_width_mm, design.beam_thickness_mm
    x, y, under = points[:, 0], points[:, 1], 0.5 * thickness - points[:, 2]
    beyond = np.maximum(np.abs(y) - half if sides else -np.inf, under - thickness if underside else -np.inf)
    outside = np.clip(beyond, 0.0, radius)
    angle = 0.25 * np.pi * (1.0 - outside / radius)
    shell, lift = radius * (1.0 - np.sin(angle)), radius * (1.0 - np.cos(angle))
    fades = np.clip(1.0 + x / reach, 0.0, 1.0)
    angle = 0.25 * np.pi * (1.0 - np.clip(x, 0.0, radius) / radius)
    along, grown = radius * (1.0 - np.sin(angle)) - np.clip(x, 0.0, radius), radius * (1.0 - np.cos(angle))
    of_wall = x < _ROUND
    # distances from the section's sides, of a shell around it in the wall, or of the beam's surface
    new = np.where(of_wall, outside + fades * (shell - outside), grown)
    old = np.where(of_wall, outside, 0.0)
    moved = points.copy()
    if sides:
        moved[:, 1] += y * ((half + new) / (half + old) - 1.0)
    if underside:
        moved[:, 2] -= under * ((thickness + new) / (thickness + old) - 1.0)
    moved[:, 0] += np.where(of_wall, fades * lift, along)
    return moved
