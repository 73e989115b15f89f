"""Mechanical model of a breast between two plates: static equilibrium at finite strain on an unloaded shape.

The chest wall is held away from the plates' plane only: tissue slides along it against elastic resistance. Plates rub by Coulomb's law, the
skin is smeared over the outermost elements, and the weight hangs downwards. Tissue is of one kind: what differs is in the band of the
epipolar curve. Contact is as stiff as the tissue asks for, so that a body of another modulus under forces in proportion deforms alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from naibu.applications.mammography.breast_mesh import breast_nodes, free_and_wall_faces, unit_breast_mesh, young_moduli
from naibu.applications.mammography.breast_shape import BreastShape, opened_at
from naibu.applications.mammography.geometric_model import require_thickness
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import plane_geometry
from naibu.mechanics.contact.penalty_contact import STICK, Contact
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import from_moduli, law_named
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.point_location import Location, locate
from naibu.meshing.surface import level_extents

_EDGE = 0.2  # of the elements, in a half ball of radius 1
_LEVELS = 60
_EDGE_LEVELS, _SMOOTH_LEVELS = 4, 4.0
_NORMAL_STIFFNESS, _RUBBING_STIFFNESS = 7.5, 0.375  # of contact, 1/mm: over Young's modulus of the tissue
_SETTINGS = SolverSettings(first_step=0.25, largest_step=0.5, tolerance=1e-3)
_NEAR_MM = 1.0  # outside of the facets of the mesh still counts as in the breast
_FAR_MM = 1e4
_G = 9810.0  # mm/s2
_SUNK_MM = 1e-4  # into the table, for the contact to have a stiffness from the beginning


@dataclass(frozen=True, slots=True)
class MechanicalParameters:
    """Tissue, skin, plates and weight: stated, not fitted.

    Attributes
    ----------
    tissue_kpa, poisson_ratio : float
        Young's modulus of fat and gland together, and Poisson's ratio.
    skin_kpa, skin_mm : float
        Young's modulus and thickness of the skin.
    friction : float
        Coefficient of the plates.
    wall_kpa_per_mm : float
        Elastic resistance of the chest wall to sliding.
    density : float
        kg/mm3.
    """

    tissue_kpa: float = 8.0
    poisson_ratio: float = 0.48
    skin_kpa: float = 60.0
    skin_mm: float = 1.7
    friction: float = 0.4
    wall_kpa_per_mm: float = 0.1
    density: float = 9.5e-7

    def __post_init__(self) -> None:
        for name in ("tissue_kpa", "skin_mm", "wall_kpa_per_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name} is {value}: must be greater than 0")
        if not 0.0 <= self.poisson_ratio < 0.5:
            raise InputError(f"poisson_ratio is {self.poisson_ratio}: must be from 0 to below 0.5")
        for name in ("skin_kpa", "friction", "density"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise InputError(f"{name} is {getattr(self, name)}: must not be negative")


DEFAULT_MECHANICS = MechanicalParameters()


@dataclass(frozen=True, slots=True, eq=False)
class MechanicalCompression:
    """A breast in equilibrium between two plates that are perpendicular to the axis of a view.

    Attributes
    ----------
    shape : BreastShape
        The unloaded breast.
    angle_deg, thickness_mm : float, float
        Positioner angle of the view, and distance of the plates.
    mesh : Mesh
        The unloaded breast: laterally, upwards, and away from the chest wall, mm.
    path : tuple of (float, ndarray)
        Parts of the way of the plates, up to 1, and displacements (n, 3) of the nodes there, mm.
    middle_mm : float
        Position half-way between the plates along the compression.
    levels, scale, shift : ndarray, shape (l,)
        Distances from the chest wall as parts of that of the nipple, and by which factor and shift, mm, positions along the chest wall are
        changed there after equilibrium: the constraint of the outline; 1 and 0 without.
    stretch : float
        Factor of distances from the chest wall, likewise.
    hidden_mm : float
        Tissue at the chest wall that the image does not reach: distances in the view are less by this.
    """

    shape: BreastShape
    angle_deg: float
    thickness_mm: float
    mesh: Mesh
    path: tuple[tuple[float, FloatArray], ...]
    middle_mm: float
    levels: FloatArray = field(default_factory=lambda: np.array([0.0, 1.0]))
    scale: FloatArray = field(default_factory=lambda: np.ones(2))
    shift: FloatArray = field(default_factory=lambda: np.zeros(2))
    stretch: float = 1.0
    hidden_mm: float = 0.0

    @property
    def displacement(self) -> FloatArray:
        """Displacement (n, 3) of the nodes between the plates, mm."""
        return self.path[-1][1]

    @property
    def silhouette(self) -> tuple[float, float]:
        """Factors by which the outline is wider and deeper than that of the unloaded breast."""
        low, high, depth = self.extents()
        own = self.shape.in_view(self.angle_deg, self.shape.depths)[1][:, 0]
        before = 2.0 * float(np.sqrt(own.max()))
        return float((high - low).max()) / before, depth * self.stretch / self.shape.depth_mm

    def extents(self) -> tuple[FloatArray, FloatArray, float]:
        """Return least and greatest positions along the chest wall (l,) at the levels of the equilibrium, and the nipple's distance, mm."""
        faces, _, _ = free_and_wall_faces(self.mesh)
        seen = self._in_view(self.mesh.points + self.displacement)[:, [2, 0]]
        edges = np.vstack([faces[:, [k, (k + 1) % 4]] for k in range(4)])
        depth = float(seen[:, 0].max())
        low, high = level_extents(seen[edges[:, 0]], seen[edges[:, 1]], depth * compressed_levels())
        return low, high, depth

    def outline(self) -> FloatArray:
        """Return the outline (m, 2) in the image, depth and position along the chest wall, mm, without what the image does not reach."""
        low, high, depth = self.extents()
        depths = depth * compressed_levels()
        scale, shift = self._correction(depths)
        ends = [np.column_stack([self.stretch * depths, scale * end + shift]) for end in (low, high)]
        return opened_at(np.vstack([ends[0], ends[1][::-1]]), self.hidden_mm)

    def compress(self, points: ArrayLike) -> FloatArray:
        """Return positions in the compressed breast of points (..., 3) of the unloaded one.

        Along the detector, along the compression from half-way between the plates, and away from the chest wall, mm.
        """
        p = np.asarray(points, dtype=float)
        place = locate(self.mesh, p.reshape(-1, 3), tolerance_mm=_FAR_MM)
        moved = p.reshape(-1, 3) + self._values(place, self.displacement)
        return self._outlined(self._in_view(moved)).reshape(p.shape)

    def uncompress(self, points: ArrayLike) -> FloatArray:
        """Return unloaded positions (..., 3) of positions (..., 3) in the compressed breast: the inverse of `compress`."""
        return self._back(np.asarray(points, dtype=float))[0]

    def project(self, points: ArrayLike) -> FloatArray:
        """Return depths and positions along the chest wall (..., 2) in the view, mm, of unloaded points (..., 3); by parallel rays."""
        return np.asarray(self.compress(points)[..., [2, 0]] - np.array([self.hidden_mm, 0.0]))

    def on_ray(self, place: ArrayLike, count: int = 101) -> tuple[FloatArray, BoolArray]:
        """Return unloaded positions (..., count, 3) of the points that appear at a place (..., 2), and which lie in the breast.

        From the lower to the upper plate; a place is depth and position along the chest wall, mm.
        """
        at = np.asarray(place, dtype=float)[..., None, :] + np.array([self.hidden_mm, 0.0])
        heights = np.broadcast_to(0.5 * self.thickness_mm * np.linspace(-1.0, 1.0, count), (*at.shape[:-2], count))
        ray = np.stack(np.broadcast_arrays(at[..., 1], heights, at[..., 0]), axis=-1)
        points, away = self._back(ray)
        inside: BoolArray = (away <= _NEAR_MM) & (ray[..., 2] >= 0.0)
        return points, inside

    def with_outline(self, depth_mm: float, low: FloatArray, high: FloatArray) -> MechanicalCompression:
        """Return the compression whose silhouette is an outline: its ends (l,) at the levels, and the nipple's distance."""
        own_low, own_high, depth = self.extents()
        scale = np.clip((high - low)[:-2] / (own_high - own_low)[:-2], 0.6, 1.6)
        scale = smoothed(np.append(scale, [scale[-1], scale[-1]]))
        shift = smoothed(0.5 * (low + high) - scale * 0.5 * (own_low + own_high))
        return replace(self, levels=compressed_levels(), scale=scale, shift=shift, stretch=depth_mm / depth)

    def from_nipple(self) -> MechanicalCompression:
        """Return the same compression in coordinates whose origin lies on the axis through the unloaded nipple; the image stays."""
        x, y = self.shape.nipple
        nipple = np.array([x, y, 0.0])
        along, press = view_axes(self.angle_deg)
        return replace(
            self,
            shape=replace(self.shape, centres=self.shape.centres - nipple[:2]),
            mesh=self.mesh.moved(np.tile(-nipple, (self.mesh.n_points, 1))),
            middle_mm=self.middle_mm - float(nipple @ press),
            shift=self.shift + self.scale * float(nipple @ along),
        )

    def _back(self, ray: FloatArray) -> tuple[FloatArray, FloatArray]:
        flat = ray.reshape(-1, 3)
        depth = flat[:, 2] / self.stretch
        scale, shift = self._correction(depth)
        own = np.column_stack([(flat[:, 0] - shift) / scale, flat[:, 1], depth])
        deformed = self.mesh.moved(self.displacement)
        found = locate(deformed, self._from_view(own), tolerance_mm=_FAR_MM)
        return self._values(found, self.mesh.points).reshape(ray.shape), found.distance_mm.reshape(ray.shape[:-1])

    def _values(self, place: Location, values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("pk,pki->pi", place.weights, values[self.mesh.cells[place.cells]]))

    def _correction(self, depth: FloatArray) -> tuple[FloatArray, FloatArray]:
        at = np.clip(depth / (self._deepest), 0.0, 1.0)
        return np.interp(at, self.levels, self.scale), np.interp(at, self.levels, self.shift)

    @property
    def _deepest(self) -> float:
        return float((self.mesh.points[:, 2] + self.displacement[:, 2]).max())

    def _outlined(self, seen: FloatArray) -> FloatArray:
        scale, shift = self._correction(seen[:, 2])
        return np.column_stack([scale * seen[:, 0] + shift, seen[:, 1], self.stretch * seen[:, 2]])

    def _in_view(self, points: FloatArray) -> FloatArray:
        along, press = view_axes(self.angle_deg)
        return np.column_stack([points @ along, points @ press - self.middle_mm, points[:, 2]])

    def _from_view(self, seen: FloatArray) -> FloatArray:
        along, press = view_axes(self.angle_deg)
        out = np.outer(seen[:, 0], along) + np.outer(seen[:, 1] + self.middle_mm, press)
        out[:, 2] += seen[:, 2]
        return out


def view_axes(angle_deg: float) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (3,) along the detector and along the compression of a view."""
    t = np.deg2rad(angle_deg)
    return np.array([np.cos(t), np.sin(t), 0.0]), np.array([-np.sin(t), np.cos(t), 0.0])


def mechanically_compressed(
    shape: BreastShape,
    angle_deg: float,
    thickness_mm: float,
    parameters: MechanicalParameters = DEFAULT_MECHANICS,
    *,
    start: Sequence[tuple[float, FloatArray]] = (),
    free_base: bool = False,
    edge: float = _EDGE,
) -> MechanicalCompression:
    """Return the equilibrium of a breast between plates.

    Parameters
    ----------
    shape : BreastShape
        The unloaded breast.
    angle_deg : float
        Positioner angle of the view: 0 of CC.
    thickness_mm : float
        Distance of the plates.
    parameters : MechanicalParameters
        Tissue, skin, plates, weight.
    start : sequence of (float, ndarray)
        Parts of the way of the plates, and displacements (n, 3) of a similar breast there, on the same mesh, mm: its `path`.
    free_base : bool
        Whether the base rests on a table, rubs there, may lift off and is held down by the weight only, as that of a phantom, instead of
        being
        held by a chest wall.
    edge : float
        Of the elements, in a half ball of radius 1.

    Raises
    ------
    InputError
        Plates farther apart than the breast is thick, or closer than a tenth of that.
    ConvergenceError
        No equilibrium was found.
    """
    require_thickness(shape, angle_deg, thickness_mm)
    ball = unit_breast_mesh(edge)
    mesh = Mesh(breast_nodes(shape, ball.points), ball.cells, ball.cell_type, ball.regions, ball.region_names)
    press = mesh.points @ view_axes(angle_deg)[1]
    middle = 0.5 * float(press.min() + press.max())
    problem = _problem(mesh, parameters, angle_deg, (float(press.min()), float(press.max())), middle, thickness_mm, free_base)
    solution = solve(problem, settings=_SETTINGS, warm_start=start, throw=not start)
    if solution.states[-1].load < 1.0:
        solution = solve(problem, settings=_SETTINGS)
    path = tuple((state.load, state.displacement) for state in solution.states[1:])
    return MechanicalCompression(shape, angle_deg, thickness_mm, mesh, path, middle)


def _problem(
    mesh: Mesh,
    parameters: MechanicalParameters,
    angle_deg: float,
    touched: tuple[float, float],
    middle: float,
    thickness_mm: float,
    free_base: bool,
) -> Problem:
    skin, _, wall = free_and_wall_faces(mesh)
    discrete = elements(mesh)
    stop = middle - 0.5 * thickness_mm, middle + 0.5 * thickness_mm
    base = _table(mesh.points, wall, parameters) if free_base else _chest_wall(mesh.points, wall, parameters)
    contacts = (*_plates(mesh.points, skin, parameters, angle_deg, touched, stop), base)
    pattern = block_pattern(mesh.n_points, discrete.connectivity, *(c.nodes for c in contacts))
    law = law_named("neo_hookean")
    unit = from_moduli(law, 1.0 / (2.0 * (1.0 + parameters.poisson_ratio)), 1.0 / (3.0 * (1.0 - 2.0 * parameters.poisson_ratio)))
    assembler = Assembler.from_materials(discrete, np.zeros(mesh.n_cells, dtype=np.int64), [unit], pattern)
    young = young_moduli(mesh, parameters.tissue_kpa, parameters.skin_kpa, parameters.skin_mm)
    weight = body_force(discrete, np.full(mesh.n_cells, parameters.density), np.array([0.0, 0.0, -_G] if free_base else [0.0, -_G, 0.0]))
    assembler = assembler.with_parameters(young[:, None] * assembler.parameters)
    return Problem(mesh.points, assembler, contacts, PrescribedDisplacement.none(mesh.n_points), weight)


def _plates(
    points: FloatArray,
    skin: IntArray,
    parameters: MechanicalParameters,
    angle_deg: float,
    start: tuple[float, float],
    stop: tuple[float, float],
) -> list[Contact]:
    press = view_axes(angle_deg)[1]
    rough = Friction(parameters.friction, _RUBBING_STIFFNESS * parameters.tissue_kpa)
    return [
        rigid_contact(
            f"{name} plate", points, skin, plane_geometry(sign * press), start=a * press, stop=b * press, friction=rough,
            normal_stiffness=_NORMAL_STIFFNESS * parameters.tissue_kpa,
        )
        for name, sign, a, b in zip(("lower", "upper"), (1.0, -1.0), start, stop, strict=True)
    ]  # fmt: skip


def _chest_wall(points: FloatArray, wall: IntArray, parameters: MechanicalParameters) -> Contact:
    return rigid_contact(
        "chest wall", points, wall, plane_geometry((0.0, 0.0, 1.0)), start=np.zeros(3), stop=np.zeros(3),
        friction=Friction(STICK, parameters.wall_kpa_per_mm), normal_stiffness=_NORMAL_STIFFNESS * parameters.tissue_kpa, tied=True,
    )  # fmt: skip


def _table(points: FloatArray, base: IntArray, parameters: MechanicalParameters) -> Contact:
    at = np.array([0.0, 0.0, _SUNK_MM])
    return rigid_contact(
        "table", points, base, plane_geometry((0.0, 0.0, 1.0)), start=at, stop=at,
        friction=Friction(parameters.friction, _RUBBING_STIFFNESS * parameters.tissue_kpa),
        normal_stiffness=_NORMAL_STIFFNESS * parameters.tissue_kpa,
    )  # fmt: skip


def smoothed(values: FloatArray) -> FloatArray:
    """Return values (l,) at the levels without what a coarse mesh makes of them, straight near both ends."""
    inner = np.pad(values[_EDGE_LEVELS:-_EDGE_LEVELS], _EDGE_LEVELS, mode="edge")
    return np.asarray(gaussian_filter1d(inner, _SMOOTH_LEVELS, mode="nearest"))


def compressed_levels() -> FloatArray:
    """Return distances from the chest wall (l,) as parts of that of the nipple, denser there."""
    return np.asarray(np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, _LEVELS)))
