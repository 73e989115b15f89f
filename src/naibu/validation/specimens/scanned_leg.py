"""Virtual MR scans of a lower leg - bones, muscle, fat and skin - before and after a plate presses it from the side.

The equilibrium is that of neo-Hookean quadratic tetrahedra at finite strain, on a mesh that follows the curved borders of all tissues and
goes on beyond the scan at both ends; it shares nothing with the cubes of an identification. Bones are rigid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import RigidTransform
from naibu.core.volume import Volume
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.meshing.element_conversion import to_quadratic
from naibu.validation.scanners.ct_mr import PLASTIC_BEAD, VirtualObject, empty_grid, scan
from naibu.validation.scanners.imaging_artifacts import MRDevice
from naibu.validation.scanners.motions import MeshMotion, Motion, PosedMotion
from naibu.validation.scanners.textures import Intensity, Texture

LENGTH_MM, SEEN_MM = 76.0, 51.2  # of the model, and of the part that the scan shows
FAT, MUSCLE, SKIN = (5.0, 0.45), (11.0, 0.46), (24.0, 0.45)  # Young's modulus, kPa, and Poisson's ratio
BONE = (3e3, 0.3)  # its nodes do not move; this only fills it
GREY = {"bone": 500.0, "muscle": 330.0, "fat": 620.0, "skin": 260.0}
TEXTURE, GRAIN_MM, EDGE_MM = 45.0, 1.7, 0.8  # deviation and knots of the texture; width of borders
POSE_DEG, POSE_MM = -3.0, (1.6, -1.1, 0.5)  # of the scan after
REGIONS = ("bone", "muscle", "fat", "skin")


@dataclass(frozen=True, slots=True)
class LegShape:
    """Section of the leg, which is the same along its axis, and how a bonded plate presses it from below.

    Attributes
    ----------
    half_axes_mm : (float, float)
        Of the ellipse of the skin's surface.
    skin_mm, fat_mm : float
        Thickness of the layers along rays from the axis.
    bones : tuple of (float, float, float)
        Middle and radius of every bone in the section, mm.
    plate_mm : (float, float)
        Half axes of the plate along x and z.
    push_mm : (float, float, float)
        Its way.
    """

    half_axes_mm: tuple[float, float] = (42.0, 38.0)
    skin_mm: float = 4.5
    fat_mm: float = 9.0
    bones: tuple[tuple[float, float, float], ...] = ((-6.0, 7.0, 10.0), (17.0, -4.0, 5.5))
    plate_mm: tuple[float, float] = (15.0, 13.0)
    push_mm: tuple[float, float, float] = (1.5, 9.0, 1.0)

    @property
    def borders_mm(self) -> tuple[float, float, float]:
        """Depths at which layers begin: skin, fat, muscle."""
        return 0.0, self.skin_mm, self.skin_mm + self.fat_mm

    def tissue_at(self, points: FloatArray) -> IntArray:
        """Return the number in `REGIONS` at points (k, 2 or 3), mm, and -1 outside."""
        _, fat, muscle = self.borders_mm
        depth = self.inward(points)
        soft = np.where(depth < 0.0, -1, np.where(depth < fat, 3, np.where(depth < muscle, 2, 1)))
        return np.asarray(np.where(self.from_bone(points) < 0.0, 0, soft))

    def inward(self, points: FloatArray) -> FloatArray:
        """Return how far (mm) inside the skin's surface points are, along the rays from the axis; negative outside."""
        radius = np.linalg.norm(points[:, :2], axis=1)
        return np.asarray(radius / np.maximum(np.linalg.norm(points[:, :2] / self.half_axes_mm, axis=1), 1e-12) - radius)

    def from_bone(self, points: FloatArray) -> FloatArray:
        """Return the distance (mm) from the nearer bone's surface, negative inside."""
        return np.asarray(np.min([np.linalg.norm(points[:, :2] - [x, y], axis=1) - r for x, y, r in self.bones], axis=0))

    def on_borders(self, points: FloatArray, border: IntArray) -> FloatArray:
        """Return points (k, 2), mm, moved onto a border each: 0 to 2 for the layers, then the bones."""
        out = points.copy()
        for number, depth in enumerate(self.borders_mm):
            at = border == number
            radius = np.linalg.norm(points[at], axis=1)
            out[at] *= (1.0 + (self.inward(points[at]) - depth) / radius)[:, None]
        for number, (x, y, r) in enumerate(self.bones, start=3):
            at = border == number
            ray = points[at] - [x, y]
            out[at] = [x, y] + r * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class ScannedLeg:
    """Scans, and the truth that an identification does not see.

    Attributes
    ----------
    before, after : Volume
        Scans, uint16.
    labels : Volume
        1 in the bones, 2 in the muscle, 3 in the fat, 4 in the skin, 0 in air; uint8.
    mesh : Mesh
        The model of the truth, quadratic tetrahedra with the regions `REGIONS`.
    displacement : ndarray, shape (n, 3)
        Of its nodes, mm.
    motion : Motion
        From the scan before to the scan after.
    """

    before: Volume
    after: Volume
    labels: Volume
    mesh: Mesh
    displacement: FloatArray
    motion: Motion


def _section(shape: LegShape, element_size_mm: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Return points (n, 2), mm, the border on which each lies (n,), -1 for none, and triangles (m, 3), which end at borders of tissues."""
    h, curves = element_size_mm, []
    for depth in shape.borders_mm:
        turns = np.arange(n := int(2.0 * np.pi * (np.mean(shape.half_axes_mm) - depth) / (0.8 * h))) * (2.0 * np.pi / n)
        rays = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        curves.append(rays * (1.0 / np.linalg.norm(rays / shape.half_axes_mm, axis=1) - depth)[:, None])
    for x, y, r in shape.bones:
        turns = np.arange(n := max(10, int(2.0 * np.pi * r / (0.8 * h)))) * (2.0 * np.pi / n)
        curves.append([x, y] + r * np.stack([np.cos(turns), np.sin(turns)], axis=1))
    borders = np.concatenate(curves)
    rows, columns = np.mgrid[-60.0 : 60.0 : 0.87 * h, -60.0:60.0:h]
    columns[::2] += 0.5 * h
    inside = np.stack([columns.ravel(), rows.ravel()], axis=1)
    apart = np.min(np.linalg.norm(inside[:, None] - borders[None], axis=2), axis=1) > 0.62 * h
    inside = inside[apart & (shape.tissue_at(inside) >= 0)]
    border = np.repeat(np.append(np.arange(len(curves)), -1), [*map(len, curves), len(inside)])
    points = np.concatenate([borders, inside])
    return points, border, Delaunay(points).simplices.astype(np.int64)


def leg_mesh(shape: LegShape | None = None, element_size_mm: float = 5.5) -> Mesh:
    """Return quadratic tetrahedra of the leg, its axis along z and its middle at z = 0, with curved edges on the borders of tissues."""
    shape = shape or LegShape()
    flat, border, triangles = _section(shape, element_size_mm)
    a, b, c = flat[triangles].transpose(1, 0, 2)
    area = np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]
    middles = flat[triangles].mean(axis=1)
    kept = (np.abs(area) > 1e-3 * element_size_mm**2) & (shape.tissue_at(middles) >= 0)
    triangles, tissue = triangles[kept], shape.tissue_at(middles[kept])
    layers, n = int(np.ceil(LENGTH_MM / element_size_mm)), len(flat)
    heights = np.linspace(-0.5 * LENGTH_MM, 0.5 * LENGTH_MM, layers + 1)
    points = np.concatenate([np.column_stack([flat, np.full(n, z)]) for z in heights])
    low, high = np.sort(triangles, axis=1), np.sort(triangles, axis=1) + n
    # a prism as three tetrahedra: diagonals of its sides begin at the node of lowest number, for either neighbour
    prism = [np.column_stack([low, high[:, 2]]), np.column_stack([low[:, :2], high[:, 1:]]), np.column_stack([low[:, 0], high])]
    cells = np.concatenate([tetra + k * n for k in range(layers) for tetra in prism])
    p = points[cells]
    negative = np.linalg.det(p[:, 1:] - p[:, :1]) < 0.0
    cells[negative] = cells[negative][:, [1, 0, 2, 3]]
    linear = Mesh.from_arrays(points, cells, "tetra", regions=np.tile(tissue, 3 * layers), region_names=REGIONS)
    return _curved(shape, to_quadratic(linear), np.tile(border, layers + 1))


def _curved(shape: LegShape, mesh: Mesh, border: IntArray) -> Mesh:
    """Return the mesh with the mid-edge nodes between corners of one border (n_corners,) on that border."""
    ends = mesh.cells[:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]].reshape(-1, 2)
    middle = mesh.cells[:, 4:].ravel()
    on, chord = border[ends], np.linalg.norm(mesh.points[ends[:, 0], :2] - mesh.points[ends[:, 1], :2], axis=1)
    both = (on[:, 0] == on[:, 1]) & (on[:, 0] >= 0) & (chord > 0.0)
    for number in range(border.max() + 1):  # chords of more than one step cross the tissue inside
        of_border = both & (on[:, 0] == number)
        both[of_border] = chord[of_border] < 1.5 * chord[of_border].min()
    points = mesh.points.copy()
    points[middle[both], :2] = shape.on_borders(points[middle[both], :2], on[both, 0])
    return Mesh(points, mesh.cells, mesh.cell_type, mesh.regions, mesh.region_names)


def pressed(mesh: Mesh, shape: LegShape | None = None) -> FloatArray:
    """Return the displacement (n, 3), mm, in equilibrium: bones and both ends of the leg at rest, a bonded plate moved."""
    shape = shape or LegShape()
    materials = [material("neo_hookean", young_modulus=e, poisson_ratio=nu) for e, nu in (BONE, MUSCLE, FAT, SKIN)]
    body = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, materials)
    x, y, z = mesh.points.T
    still = np.unique(mesh.cells[mesh.regions == 0])
    ends = np.flatnonzero(np.abs(np.abs(z) - 0.5 * LENGTH_MM) < 1e-9)
    outside = np.abs(shape.inward(mesh.points)) < 1e-6 * shape.half_axes_mm[0]
    plate = np.flatnonzero(outside & (y < 0.0) & ((x / shape.plate_mm[0]) ** 2 + (z / shape.plate_mm[1]) ** 2 < 1.0))
    held = PrescribedDisplacement.none(mesh.n_points).and_also(np.union1d(still, ends), (0.0, 0.0, 0.0)).and_also(plate, shape.push_mm)
    problem = Problem(mesh.points, body, (), held, np.zeros_like(mesh.points))
    return solve(problem, settings=SolverSettings(first_step=0.25, largest_step=0.5, tolerance=1e-8)).displacement


def scanned_leg(
    *,
    shape: LegShape | None = None,
    voxel_mm: float = 0.8,
    element_size_mm: float = 5.5,
    noise: float = 9.0,
    seed: int = 0,
    displacement: FloatArray | None = None,
) -> ScannedLeg:
    """Return MR scans before and after the plate presses, in another pose, with their noise.

    Parameters
    ----------
    shape : LegShape, optional
        The leg and its load.
    voxel_mm : float
        Edge length of the voxels; 0.8 makes 128 x 128 x 64 of them.
    element_size_mm : float
        Of the model of the truth.
    noise : float
        Standard deviation of the noise of either channel, where texture has one of `TEXTURE`.
    seed : int
        Of texture and noise.
    displacement : ndarray, shape (n, 3), optional
        Of the nodes of ``leg_mesh(shape, element_size_mm)``, mm, where it was solved before.
    """
    shape = shape or LegShape()
    mesh = leg_mesh(shape, element_size_mm)
    moved = pressed(mesh, shape) if displacement is None else displacement
    count = np.round(np.array([102.4, 102.4, SEEN_MM]) / voxel_mm)
    high = 0.5 * (count - 1.0) * voxel_mm
    grid = empty_grid(-high, high, voxel_mm)
    rest: Motion = MeshMotion(mesh, np.zeros_like(moved))
    turn = np.radians(POSE_DEG)
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    pushed: Motion = PosedMotion(MeshMotion(mesh, moved), RigidTransform.of(about_z, POSE_MM))
    shown, device = VirtualObject.of(_intensity(shape, seed), np.empty((0, 3)), PLASTIC_BEAD), MRDevice(noise=noise, blur_mm=0.5 * voxel_mm)
    before, after = (scan(shown, motion, grid, device, seed=seed + k, samples=1).volume for k, motion in enumerate((rest, pushed)))
    labels = shape.tissue_at(grid.positions().reshape(-1, 3)).reshape(grid.shape) + 1
    return ScannedLeg(before, after, grid.with_values(labels.astype(np.uint8)), mesh, moved, pushed)


def _intensity(shape: LegShape, seed: int) -> Intensity:
    """Return the intensity (k,) at material points (k, 3), mm."""
    fine, coarse = Texture.drawn(GRAIN_MM, seed=seed), Texture.drawn(2.5 * GRAIN_MM, seed=seed + 1)
    _, to_fat, to_muscle = shape.borders_mm

    def part(inward_mm: FloatArray) -> FloatArray:
        return np.asarray(0.5 + 0.5 * np.tanh(2.0 * inward_mm / EDGE_MM))

    def intensity(points: FloatArray) -> FloatArray:
        depth, grey = shape.inward(points), np.full(len(points), GREY["skin"])
        borders = (("fat", depth - to_fat), ("muscle", depth - to_muscle), ("bone", -shape.from_bone(points)))
        for name, inward in borders:
            grey += (GREY[name] - grey) * part(inward)
        return np.asarray(grey + TEXTURE * np.sqrt(0.5) * (fine(points) + coarse(points)))

    return intensity
