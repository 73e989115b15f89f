"""Virtual breasts in both mammographic views: random shapes, tissues, skin, friction, gravity and plates, pressed by finite elements.

They test models that predict with block-structured hexahedra and the neo-Hookean law: these are unstructured linear tetrahedra with mean
dilatation over patches, and tissues that stiffen exponentially :cite:p:`demiray1972`. Coordinates: x laterally, y upwards, z away from the
chest wall, mm, unloaded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK, Contact
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import from_moduli, law_named, parameter_vector
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.quality import signed_volumes
from naibu.meshing.surface import boundary_faces, level_extents
from naibu.validation.specimens.half_ball_mesh import unstructured_half_ball

GRAVITY = np.array([0.0, -9810.0, 0.0])  # mm/s2
DENSITY = 9.5e-7  # kg/mm3
POISSON_RATIO = 0.48
_EXPONENT = 0.8  # b of Demiray's law mu / (2 b) (exp(b (I1 - 3)) - 1)
STIFFENING = (_EXPONENT / 2.0, _EXPONENT**2 / 6.0)  # c20 / c10 and c30 / c10 of Yeoh's law: its series to the third order
_NORMAL_STIFFNESS = 60.0  # kPa/mm
_CELL = 0.2  # edge, in a half ball of radius 1
_LEVELS = 60
_SETTINGS = SolverSettings(first_step=0.1, largest_step=0.25, tolerance=1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class VirtualBreast:
    """A breast and how it is positioned, drawn at random by `random_breast`.

    Attributes
    ----------
    half_widths_mm : (float, float, float)
        Laterally, upwards and downwards at the chest wall.
    depth_mm : float
        From the chest wall to the nipple.
    profile : float
        Exponent of the outline: 2 an ellipsoid, more a fuller breast.
    droop_mm : (float, float)
        By how much the nipple lies laterally and below of the middle of the chest wall.
    ripple : (float, float)
        Relative size and phase, rad, of a wave of three periods around the axis.
    fat_kpa, gland_ratio : float
        Young's modulus of fat, and that of gland over it.
    gland : ndarray, shape (k, 5)
        Gaussian lumps of gland: centre as a fraction of the half widths and the depth, radius likewise, and amplitude.
    skin_kpa, skin_mm : float
        Young's modulus and thickness of the skin.
    friction : (float, float)
        Coefficients of the plates in CC and MLO.
    wall_kpa_per_mm : float
        Elastic resistance of the chest wall to sliding.
    angles_deg, thickness_mm : (float, float)
        True angles of the plates to the breast in CC and MLO, and plate distances: a breast rolls when it is laid on the detector.
    hidden_mm : (float, float)
        Tissue at the chest wall that each image does not reach.
    stated_angle_deg, stated_thickness_mm : float, (float, float)
        What the device shows.
    """

    half_widths_mm: tuple[float, float, float]
    depth_mm: float
    profile: float
    droop_mm: tuple[float, float]
    ripple: tuple[float, float]
    fat_kpa: float
    gland_ratio: float
    gland: FloatArray
    skin_kpa: float
    skin_mm: float
    friction: tuple[float, float]
    wall_kpa_per_mm: float
    angles_deg: tuple[float, float]
    thickness_mm: tuple[float, float]
    hidden_mm: tuple[float, float]
    stated_angle_deg: float
    stated_thickness_mm: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class PressedBreast:
    """What both views show of a virtual breast, and the truth.

    Attributes
    ----------
    outlines : tuple of ndarray, shape (m, 2)
        In CC and MLO, from one end at the chest wall to the other: distance from it and position along it, mm.
    points : ndarray, shape (k, 3)
        Points of the unloaded breast, from the nipple laterally and upwards and from the chest wall, mm.
    places : ndarray, shape (2, k, 2)
        Where they appear in CC and MLO, mm, in the coordinates of the outlines; at negative distances from the wall: not in the image.
    """

    outlines: tuple[FloatArray, FloatArray]
    points: FloatArray
    places: FloatArray


def random_breast(seed: int) -> VirtualBreast:
    """Draw a breast; the ranges span small and large, fatty and dense, smooth and rough, well and badly positioned ones."""
    random = np.random.default_rng([2008, seed])
    u = random.uniform
    width, depth = u(50.0, 75.0), u(60.0, 105.0)
    upper, lower = width * u(0.95, 1.2), width * u(0.9, 1.15)
    angle = u(40.0, 60.0)
    roll = 3.0 * random.standard_normal(2)
    reach = np.hypot(np.cos(np.deg2rad(angle)) * 0.5 * (upper + lower), np.sin(np.deg2rad(angle)) * width)
    distances = (upper + lower) * u(0.45, 0.62), 2.0 * reach * u(0.45, 0.62)
    lumps = np.column_stack([u(-0.45, 0.45, (4, 2)), u(0.1, 0.7, 4), u(0.2, 0.5, 4), u(0.3, 1.0, 4)])
    return VirtualBreast(
        half_widths_mm=(width, upper, lower), depth_mm=depth, profile=u(1.8, 2.8), droop_mm=(u(-5.0, 8.0), u(0.0, 15.0)),
        ripple=(u(0.0, 0.03), u(0.0, 2.0 * np.pi)), fat_kpa=u(3.0, 7.0), gland_ratio=u(1.5, 8.0), gland=lumps, skin_kpa=u(20.0, 100.0),
        skin_mm=u(1.2, 2.2), friction=(u(0.1, 0.8), u(0.1, 0.8)), wall_kpa_per_mm=float(np.exp(u(np.log(0.03), np.log(0.3)))),
        angles_deg=(float(roll[0]), angle + float(roll[1])), thickness_mm=distances, hidden_mm=(u(0.0, 8.0), u(0.0, 5.0)),
        stated_angle_deg=angle,
        stated_thickness_mm=(distances[0] + float(random.standard_normal()), distances[1] + float(random.standard_normal())),
    )  # fmt: skip


def press_breast(breast: VirtualBreast, *, count: int = 60, cell: float = _CELL) -> PressedBreast:
    """Press a breast in both views.

    Parameters
    ----------
    breast : VirtualBreast
        The breast.
    count : int
        Number of points, quasi-random in the whole breast and at least 5 mm below the skin.
    cell : float
        Edge of the elements in a half ball of radius 1, whose image the breast is.

    Raises
    ------
    ConvergenceError
        No equilibrium was found.
    """
    unit = unstructured_half_ball(cell)
    points = breast_points(breast, unit.points)
    mesh = Mesh(points, unit.cells, unit.cell_type, unit.regions, unit.region_names)
    parameters = _tissue(breast, mesh, unit)
    inside = _interior(count)
    truth = breast_points(breast, inside)
    operator = interpolation_operator(mesh, truth, tolerance_mm=0.5 * cell * breast.depth_mm)
    nipple = breast_points(breast, np.array([[0.0, 0.0, 1.0]]))[0]
    outlines, places = [], []
    settings = zip(breast.angles_deg, breast.thickness_mm, breast.friction, breast.hidden_mm, strict=True)
    for angle, distance, friction, hidden in settings:
        displacement = _pressed(mesh, parameters, breast.wall_kpa_per_mm, friction, angle, distance)
        t = np.deg2rad(angle)
        seen = np.array([[0.0, np.cos(t)], [0.0, np.sin(t)], [1.0, 0.0]])
        outlines.append(_outline((points + displacement) @ seen, boundary_faces(mesh).faces, hidden))
        places.append((truth + operator @ displacement) @ seen - [hidden, 0.0])
    return PressedBreast((outlines[0], outlines[1]), truth - [nipple[0], nipple[1], 0.0], np.array(places))


def breast_points(breast: VirtualBreast, ball: FloatArray) -> FloatArray:
    """Return where points (n, 3) of a half ball of radius 1 lie in the unloaded breast, mm."""
    x, y, z = ball.T
    rest = np.sqrt(np.maximum(1.0 - z**2, 1e-12))
    turn = np.arctan2(y, x)
    size = np.sqrt(np.maximum(1.0 - np.abs(z) ** breast.profile, 0.0)) * (1.0 + breast.ripple[0] * np.cos(3.0 * turn + breast.ripple[1]))
    lateral, upper, lower = breast.half_widths_mm
    upright = np.where(y > 0.0, upper, lower)
    return np.column_stack(
        [
            size * lateral * x / rest + breast.droop_mm[0] * z**2,
            size * upright * y / rest - breast.droop_mm[1] * z**2,
            breast.depth_mm * z,
        ]
    )


def _interior(count: int) -> FloatArray:
    """Return quasi-random points (count, 3) of a half ball of radius 0.9, uniform by volume (additive recurrence)."""
    steps = np.mod(0.5 + np.arange(1, count + 1)[:, None] * np.array([0.8191725134, 0.6710436067, 0.5497004779]), 1.0)
    radius, z, turn = 0.9 * np.cbrt(steps[:, 0]), steps[:, 1], 2.0 * np.pi * steps[:, 2]
    flat = np.sqrt(1.0 - z**2)
    return np.asarray(radius[:, None] * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z]))


def _tissue(breast: VirtualBreast, mesh: Mesh, unit: Mesh) -> FloatArray:
    """Return the law's parameters (m, 4) of all cells; the skin is smeared over the cells beneath it."""
    centres = unit.points[unit.cells].mean(axis=1)
    amount = np.zeros(len(centres))
    for *centre, radius, amplitude in breast.gland:
        amount += amplitude * np.exp(-0.5 * ((centres - centre) ** 2).sum(axis=1) / radius**2)
    young = breast.fat_kpa * breast.gland_ratio ** np.minimum(amount, 1.0)
    faces, cells = boundary_faces(mesh)
    corners = mesh.points[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    outer = mesh.points[faces][:, :, 2].max(axis=1) > 1e-9
    thickness = signed_volumes(mesh)[cells[outer]] / area[outer]
    np.add.at(young, cells[outer], breast.skin_kpa * np.minimum(breast.skin_mm / thickness, 1.0))
    law = law_named("yeoh")
    shear, bulk = young / (2.0 * (1.0 + POISSON_RATIO)), young / (3.0 * (1.0 - 2.0 * POISSON_RATIO))
    return shear[:, None] * parameter_vector(law, 1.0, 0.0, STIFFENING) + bulk[:, None] * parameter_vector(law, 0.0, 1.0, STIFFENING)


def _pressed(mesh: Mesh, parameters: FloatArray, wall: float, friction: float, angle_deg: float, distance_mm: float) -> FloatArray:
    """Return the displacement (n, 3), mm, between two plates that move towards the middle of the breast."""
    discrete, boundary = elements(mesh), boundary_faces(mesh).faces
    at_wall = mesh.points[boundary][:, :, 2].max(axis=1) < 1e-9
    t = np.deg2rad(angle_deg)
    press = np.array([-np.sin(t), np.cos(t), 0.0])
    along = mesh.points @ press
    middle = 0.5 * (along.min() + along.max())

    def body(name: str, faces: IntArray, normal: FloatArray, at: tuple[float, float], rubbing: Friction, tied: bool) -> Contact:
        ends = np.outer(at, press) if name != "chest wall" else np.zeros((2, 3))
        return rigid_contact(
            name, mesh.points, faces, plane_geometry(normal), start=ends[0], stop=ends[1], friction=rubbing,
            normal_stiffness=_NORMAL_STIFFNESS, tied=tied,
        )  # fmt: skip

    rough = Friction(friction, 3.0)
    half = 0.5 * distance_mm
    contacts = (
        body("lower plate", boundary[~at_wall], press, (along.min(), middle - half), rough, False),
        body("upper plate", boundary[~at_wall], -press, (along.max(), middle + half), rough, False),
        body("chest wall", boundary[at_wall], np.array([0.0, 0.0, 1.0]), (0.0, 0.0), Friction(STICK, wall), True),
    )
    pattern = block_pattern(mesh.n_points, discrete.connectivity, *(c.nodes for c in contacts))
    law = law_named("yeoh")
    assembler = Assembler.from_materials(discrete, np.zeros(mesh.n_cells, dtype=np.int64), [from_moduli(law, 1.0, 10.0)], pattern)
    padded = np.zeros((mesh.n_cells, 4))
    padded[:, : parameters.shape[1]] = parameters
    weight = body_force(discrete, np.full(mesh.n_cells, DENSITY), GRAVITY)
    problem = Problem(mesh.points, assembler.with_parameters(padded), contacts, PrescribedDisplacement.none(mesh.n_points), weight)
    return solve(problem, settings=_SETTINGS).displacement


def _outline(places: FloatArray, faces: IntArray, hidden_mm: float) -> FloatArray:
    """Return the silhouette (m, 2) of projected faces, from one end at the edge of the image to the other."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    depths = hidden_mm + (places[:, 0].max() - hidden_mm) * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, _LEVELS))
    low, high = level_extents(places[edges[:, 0]], places[edges[:, 1]], depths)
    seen = depths - hidden_mm
    return np.vstack([np.column_stack([seen, low]), np.column_stack([seen, high])[::-1]])
