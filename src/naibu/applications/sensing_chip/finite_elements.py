"""Three-dimensional finite elements of a cross-beam chip of anisotropic silicon, for all six components of the load at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.applications.sensing_chip.chip_mesh import BEAMS, ChipMesh, ChipResolution, chip_mesh
from naibu.applications.sensing_chip.design import SILICON_DENSITY, ChipDesign
from naibu.core.arrays import FloatArray, require_shape
from naibu.mechanics.small_strain.anisotropic_body import AnisotropicBody
from naibu.meshing.point_location import interpolation_operator

LOADS = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")
# a force F_z is positive where it presses the block down
_SIGNS = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class ChipResponse:
    """Response of a chip to unit loads at its origin: F_x, F_y, F_z in mN, then M_x, M_y, M_z in mN mm (1 mN mm = 1 N um).

    Attributes
    ----------
    design : ChipDesign
        The chip.
    chip : ChipMesh
        Its mesh.
    stiffness : ndarray, shape (6, 6)
        Loads over the rigid motion of the loaded nodes: displacement, mm (downwards for F_z), and rotation, rad.
    displacement : ndarray, shape (6, n, 3)
        mm per unit load.
    stress : ndarray, shape (6, n, 3, 3)
        At the nodes, kPa per unit load. Where beams meet block and frame at sharp corners it grows as the mesh is refined.
    clamp_loads : ndarray, shape (6, 4, 6)
        Forces and moments that beams A to D exert on the frame, about the centres of their outer ends, per unit load, along x, y, z of the
        chip; only of a chip without an elastic frame, else NaN.
    modal_mass : ndarray, shape (6, 6)
        Kinetic energy of the motions that the loads make, for unit rigid motion of the loaded nodes, kg, kg mm and kg mm^2.
    """

    design: ChipDesign
    chip: ChipMesh
    stiffness: FloatArray
    displacement: FloatArray
    stress: FloatArray
    clamp_loads: FloatArray
    modal_mass: FloatArray

    @property
    def force_stiffness(self) -> float:
        """Force over displacement along z, mN/mm."""
        return float(1.0 / np.linalg.inv(self.stiffness)[2, 2])

    @property
    def moment_stiffness(self) -> float:
        """Moment over rotation about y, mN mm."""
        return float(1.0 / np.linalg.inv(self.stiffness)[4, 4])

    @property
    def resonances_hz(self) -> FloatArray:
        """Six resonance frequencies of the block on its beams, Hz, by Rayleigh and Ritz with the static motions: upper bounds."""
        values = np.linalg.eigvals(np.linalg.solve(self.modal_mass, self.stiffness))
        return np.asarray(np.sqrt(np.sort(np.real(values))) / (2.0 * np.pi))

    def stress_at(self, points: FloatArray) -> FloatArray:
        """Return the stress at points (k, 3), mm, per unit load (6, k, 3, 3), kPa."""
        operator = interpolation_operator(self.chip.mesh, points)
        return np.stack([(operator @ each.reshape(len(each), 9)).reshape(-1, 3, 3) for each in self.stress])

    def of(self, load: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return displacement (n, 3), mm, and stress (n, 3, 3), kPa, under a load (6,), mN and mN mm."""
        require_shape("load", load, (6,))
        return np.asarray(np.tensordot(load, self.displacement, 1)), np.asarray(np.tensordot(load, self.stress, 1))


def solve_chip(design: ChipDesign, resolution: ChipResolution | None = None, *, whole: bool = True) -> ChipResponse:
    """Solve a chip for all loads.

    Parameters
    ----------
    design : ChipDesign
        The chip.
    resolution : ChipResolution, optional
        Numbers of cells of its mesh.
    whole : bool
        Whether block and frame are elastic; otherwise beams between a rigid block and rigid clamps, as the closed forms suppose.

    Raises
    ------
    InputError
        A mesh that cannot be made.
    """
    chip = chip_mesh(design, resolution, whole=whole)
    body = AnisotropicBody.of(chip.mesh)
    points, n = chip.mesh.points, chip.mesh.n_points
    motions = np.zeros((6, n, 3))
    motions[:, chip.loaded] = _rigid_motions(points[chip.loaded])
    constrained = np.repeat((chip.loaded | chip.fixed)[:, None], 3, axis=1)
    tensors = np.broadcast_to(design.stiffness_tensor, (len(chip.mesh.region_names), 3, 3, 3, 3))
    moved, force = body.response(tensors, constrained, motions)
    stiffness = np.einsum("ank,bnk->ab", motions, force)
    inverse = np.linalg.inv(0.5 * (stiffness + stiffness.T))
    displacement = np.tensordot(inverse, moved, 1)
    stress = np.stack([np.einsum("ijkl,nkl->nij", design.stiffness_tensor, body.nodal_strain(u)) for u in displacement])
    clamps = np.tensordot(inverse, _clamp_loads(design, chip, force), 1)
    mass = _modal_mass(design, body, moved, whole=whole)
    return ChipResponse(design, chip, stiffness, displacement, stress, clamps, mass)


def _rigid_motions(points: FloatArray) -> FloatArray:
    """Return the displacements (6, k, 3) of unit motions in the components of the loads."""
    motions = np.zeros((6, len(points), 3))
    for axis in range(3):
        motions[axis, :, axis] = 1.0
        motions[3 + axis] = np.cross(np.eye(3)[axis], points)
    return np.asarray(motions * _SIGNS[:, None, None])


def _clamp_loads(design: ChipDesign, chip: ChipMesh, force: FloatArray) -> FloatArray:
    """Return forces and moments (6, 4, 6) on the frame at the beams' outer ends, NaN where the frame is elastic."""
    loads = np.full((6, len(BEAMS), 6), np.nan)
    if "frame" in chip.mesh.region_names:
        return loads
    points = chip.mesh.points
    outer = design.block_half_width_mm + design.beam_length_mm
    for k, (axis, sign) in enumerate(((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0))):
        end = chip.fixed & (sign * points[:, axis] > 0.5 * outer)
        arm = points[end] - sign * outer * np.eye(3)[axis]
        loads[:, k, :3] = -force[:, end].sum(axis=1)
        loads[:, k, 3:] = -np.cross(arm, force[:, end]).sum(axis=1)
    return loads


def _modal_mass(design: ChipDesign, body: AnisotropicBody, moved: FloatArray, *, whole: bool) -> FloatArray:
    """Return the mass (6, 6) of the motions; pillar and, where it is not meshed, block are rigid."""
    matrix = body.mass_matrix(np.full(len(body.mesh.region_names), SILICON_DENSITY))
    mass = np.sum([moved[..., axis] @ (matrix @ moved[..., axis].T) for axis in range(3)], axis=0)
    if whole:
        return np.asarray(mass + np.diag([design.pillar_mass_kg] * 3 + [0.0] * 3))
    below = 0.5 * (design.block_height_mm - design.beam_thickness_mm)
    block, inertia = design.block_mass_kg - design.pillar_mass_kg, design.block_inertia
    about_z = block * (2.0 * design.block_half_width_mm) ** 2 / 6.0
    rigid = np.diag([design.block_mass_kg] * 3 + [inertia, inertia, about_z])
    # the block hangs below the origin: rotation about y moves its mass along -x, rotation about x along y
    rigid[0, 4] = rigid[4, 0] = -block * below
    rigid[1, 3] = rigid[3, 1] = block * below
    return np.asarray(mass + rigid)
