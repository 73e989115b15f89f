"""Virtual CT scans of a textured piece of liver, with stiff or soft lumps or none, on a pad of known gel, before and after it is pressed.

The equilibrium is that of neo-Hookean hexahedra with mean dilatation at finite strain, on a mesh that follows the curved surface and the
spheres of the lumps, and that shares nothing with the cubes of an identification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box
from naibu.meshing.surface import faces_towards, side_nodes
from naibu.validation.scanners.ct_mr import PLASTIC_BEAD, VirtualObject, empty_grid, scan
from naibu.validation.scanners.imaging_artifacts import CTDevice
from naibu.validation.scanners.motions import MeshMotion, Motion, PosedMotion
from naibu.validation.scanners.textures import Texture

SIZE_MM, PAD_MM = np.array([52.0, 44.0, 26.0]), 6.0  # of the whole; height of the pad
PAD, LIVER, LUMP = (10.0, 0.45), (5.0, 0.45), (15.0, 0.45)  # Young's modulus, kPa, and Poisson's ratio
PATCH_MM, PUSH_MM = (np.array([4.0, -2.0]), 15.0), (0.8, -0.5, -3.2)  # middle and radius of the plate; its way
GREY, TEXTURE, GRAIN_MM = {"pad": 900.0, "liver": 1060.0}, 60.0, 1.1
BOND_MM = 0.5  # half the thickness of the bond between liver and pad
POSE_DEG, POSE_MM = 2.0, (0.6, -0.4, 0.3)  # of the scan after


class Lump(NamedTuple):
    """A sphere in the liver: its middle and radius, mm, Young's modulus, kPa, and Poisson's ratio."""

    middle_mm: tuple[float, float, float] = (-3.0, 2.0, 16.0)
    radius_mm: float = 5.0
    young_modulus: float = LUMP[0]
    poisson_ratio: float = LUMP[1]

    def holds(self, points: FloatArray) -> BoolArray:
        """Return which points (..., 3), mm, lie in it."""
        return np.asarray(np.linalg.norm(points - self.middle_mm, axis=-1) < self.radius_mm)


@dataclass(frozen=True, slots=True, eq=False)
class ScannedLiver:
    """Scans, and the truth that an identification does not see.

    Attributes
    ----------
    before, after : Volume
        Scans, uint16.
    labels : Volume
        1 in the pad, 2 in the liver with its lumps, 0 in air; uint8.
    lump : ndarray, shape (nz, ny, nx), bool
        The lumps.
    mesh : Mesh
        The model of the truth, with the regions pad, liver, and one for each lump.
    displacement : ndarray, shape (n, 3)
        Of its nodes, mm.
    motion : Motion
        From the scan before to the scan after.
    """

    before: Volume
    after: Volume
    labels: Volume
    lump: BoolArray
    mesh: Mesh
    displacement: FloatArray
    motion: Motion


def liver_mesh(element_size_mm: float = 1.5, lumps: Sequence[Lump] = (Lump(),)) -> Mesh:
    """Return hexahedra of the piece on its pad, the base at z = 0; nodes next to the sphere of a lump lie on it."""
    layers = [("pad", PAD_MM), ("liver", float(SIZE_MM[2]) - PAD_MM)]
    mesh = box(SIZE_MM.tolist(), [int(n) for n in np.round(SIZE_MM / element_size_mm)], layers=layers)
    x, y, z = mesh.points.T
    a, b, high = 2.0 * x / SIZE_MM[0], 2.0 * y / SIZE_MM[1], np.maximum(z - PAD_MM, 0.0)
    above = high * (1.06 - 0.28 * (a + 0.25) ** 2 - 0.2 * b**2 + 0.06 * np.sin(3.0 * b + a))
    wide = 1.0 - 0.1 * high / (SIZE_MM[2] - PAD_MM)
    round_off = np.sqrt(1.0 - 0.38 * np.stack([b, a], axis=1) ** 2)
    points = np.column_stack([mesh.points[:, :2] * round_off * wide[:, None], np.minimum(z, PAD_MM) + above])
    regions = mesh.regions.copy()
    for number, lump in enumerate(lumps):
        away = points - lump.middle_mm
        radius = np.linalg.norm(away, axis=1)
        near = np.abs(radius - lump.radius_mm) < 0.3 * element_size_mm
        points[near] = lump.middle_mm + away[near] * (lump.radius_mm / radius[near])[:, None]
        regions[lump.holds(points[mesh.cells].mean(axis=1))] = 2 + number
    names = ("pad", "liver", *(f"lump {k + 1}" for k in range(len(lumps))))
    return Mesh.from_arrays(points, mesh.cells, "hexahedron", regions=regions, region_names=names)


def pressed(mesh: Mesh, lumps: Sequence[Lump] = (Lump(),)) -> FloatArray:
    """Return the displacement (n, 3), mm, in equilibrium: base at rest, a bonded plate on top moved by `PUSH_MM`."""
    moduli = (PAD, LIVER, *((lump.young_modulus, lump.poisson_ratio) for lump in lumps))
    materials = [material("neo_hookean", young_modulus=e, poisson_ratio=nu) for e, nu in moduli]
    body = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, materials)
    top = np.unique(faces_towards(mesh, (0.0, 0.0, 1.0), max_angle_deg=60.0))
    middle, radius = PATCH_MM
    under_plate = top[np.linalg.norm(mesh.points[top, :2] - middle, axis=1) < radius]
    held = PrescribedDisplacement.none(mesh.n_points).and_also(side_nodes(mesh, "z-"), (0.0, 0.0, 0.0)).and_also(under_plate, PUSH_MM)
    problem = Problem(mesh.points, body, (), held, np.zeros_like(mesh.points))
    return solve(problem, settings=SolverSettings(first_step=0.5, largest_step=0.5, tolerance=1e-8)).displacement


def scanned_liver(
    *, voxel_mm: float = 0.5, element_size_mm: float = 1.5, noise: float = 8.0, seed: int = 0, lumps: Sequence[Lump] = (Lump(),)
) -> ScannedLiver:
    """Return CT scans before and after the plate presses, in another pose, with their noise.

    Parameters
    ----------
    voxel_mm : float
        Edge length of the voxels.
    element_size_mm : float
        Of the model of the truth.
    noise : float
        Standard deviation of the intensities, whose texture has one of `TEXTURE`.
    seed : int
        Of texture and noise.
    lumps : sequence of Lump
        Spheres that do not overlap, invisible in the scans; none is a homogeneous liver.
    """
    mesh = liver_mesh(element_size_mm, lumps)
    displacement = pressed(mesh, lumps)
    apart = to_tetra(mesh)
    x, y = 0.5 * SIZE_MM[:2] + 4.0
    grid = empty_grid((-x, -y, -3.0), (x, y, float(mesh.points[:, 2].max()) + 3.0), voxel_mm)
    texture = Texture.drawn(GRAIN_MM, seed=seed), Texture.drawn(2.5 * GRAIN_MM, seed=seed + 1)

    def intensity(material_points: FloatArray) -> FloatArray:
        liver = 0.5 + 0.5 * np.tanh((material_points[:, 2] - PAD_MM) / BOND_MM)
        grey = GREY["pad"] + (GREY["liver"] - GREY["pad"]) * liver
        return np.asarray(grey + TEXTURE * np.sqrt(0.5) * (texture[0](material_points) + texture[1](material_points)))

    shown = VirtualObject.of(intensity, np.empty((0, 3)), PLASTIC_BEAD)
    rest: Motion = MeshMotion(apart, np.zeros_like(displacement))
    moved: Motion = PosedMotion(MeshMotion(apart, displacement), RigidTransform.of(_turn(POSE_DEG), POSE_MM))
    device = CTDevice(noise=noise)
    before, after = (scan(shown, motion, grid, device, seed=seed + k, samples=1).volume for k, motion in enumerate((rest, moved)))
    where = grid.positions().reshape(-1, 3)
    inside = np.isfinite(rest.to_material(where)).all(axis=1).reshape(grid.shape)
    labels = np.where(inside, np.where(where[:, 2].reshape(grid.shape) < PAD_MM, 1, 2), 0)
    lump = np.zeros(grid.shape, dtype=bool)
    for each in lumps:
        lump |= each.holds(where).reshape(grid.shape)
    return ScannedLiver(before, after, grid.with_values(labels.astype(np.uint8)), lump, mesh, displacement, moved)


def _turn(degrees: float) -> FloatArray:
    a = np.radians(degrees)
    return np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
