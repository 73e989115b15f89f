"""A measured object as a finite element model: mesh, contacts and observation of its markers, as functions of named parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, Layer
from naibu.core.mesh import Mesh
from naibu.identification.from_markers.specimen.boundary_conditions import material_of, rigid_bodies, sliding_joints
from naibu.identification.from_markers.specimen.indenter_path import moved_indenter, path_directions
from naibu.identification.from_markers.specimen.marker_grid import completed
from naibu.identification.from_markers.specimen.mirror_planes import MirrorPlanes, WholeBody
from naibu.identification.from_markers.specimen.parameter_names import (
    SHAPE_NAMES,
    base_offset,
    batch_stiffness,
    friction,
    joint_friction,
    law_of_shape,
    layer_shift,
    pixel_scale,
    poisson_ratio,
    shape_parameter,
    straight_base,
    young_modulus,
)
from naibu.identification.from_markers.specimen.scan_alignment import Placement, placement
from naibu.identification.from_markers.specimen.specimen_mesh import element_size, model_mesh, on_straight_base
from naibu.mechanics.contact.penalty_contact import STICK, Contact
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import Law, from_moduli, law_named, parameter_vector
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.finite_strain.sensitivities import Direction
from naibu.mechanics.finite_strain.statics import Solution
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.point_location import interpolation_operator

ContactModel = Literal["coulomb", "stick", "springs"]
GRAVITY = np.array([0.0, 0.0, -9810.0])  # mm/s2


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """What a specimen is modelled with.

    Attributes
    ----------
    law : str
        Hyperelastic law of every material, see `naibu.mechanics.finite_elements.hyperelasticity.LAWS`.
    contact : {"coulomb", "stick", "springs"}
        What the rigid bodies do to the surface sideways: rub with a friction coefficient for each pair of materials, hold it, or hold it
        by tangential springs.
    joined : {"tied", "sliding"}
        Bond between separately cast blocks.
    element_size_mm : float
        Edge of the hexahedra, smaller under a bar; 0 takes a seventh to a tenth of the object's height.
    normal_stiffness : float
        Contact penalty, kPa/mm.
    density : float
        kg/mm3; weight is applied where an object is not pressed onto its base.
    pixel_scale : {"given", "sought"}
        Whether the true size of a pixel along x and y is that of the file, or an unknown of every experiment.
    modulus : {"automatic", "given", "weighed"}
        Whether a modulus that nobody states is a reference value, or sought between side plates from a weight (automatic: of known height,
        and as a lower bound; "weighed" states that nothing but its weight holds the object down).
    """

    law: str = "neo_hookean"
    contact: ContactModel = "coulomb"
    joined: Literal["tied", "sliding"] = "tied"
    element_size_mm: float = 0.0
    normal_stiffness: float = 5e3
    tangential_stiffness: float = 200.0
    density: float = 1e-6
    pixel_scale: Literal["given", "sought"] = "given"
    modulus: Literal["automatic", "given", "weighed"] = "automatic"


@dataclass(frozen=True, slots=True, eq=False)
class Specimen:
    """A meshed experiment.

    Attributes
    ----------
    experiment : Experiment
        What was measured.
    settings : ModelSettings
        Law, contact, mesh size.
    placement : Placement
        Where the object lies in its reference scan.
    mirror : MirrorPlanes
        Planes that complete what is modelled to the whole object.
    mesh : Mesh
        Of what is modelled, in the object's frame, mm.
    marker_ids : ndarray, shape (k,), int64
        Trusted markers whose position in the reference configuration is known, or known in part and completed from the lattice.
    marker_points : ndarray, shape (k, 3)
        Their positions in the object's frame, mm.
    marker_filled : ndarray, shape (k, 3), bool
        Which coordinates (in the scan's axes) were completed.
    observation : csr_matrix, shape (k, n)
        Interpolates at the markers, or at their images in what is modelled; see `at_markers`.
    """

    experiment: Experiment
    settings: ModelSettings
    placement: Placement
    mirror: MirrorPlanes
    mesh: Mesh
    marker_ids: IntArray
    marker_points: FloatArray
    marker_filled: BoolArray
    observation: sp.csr_array
    _gradient: tuple[sp.csr_array, ...]
    _rest_points: FloatArray
    _assembler: Assembler
    _contacts: tuple[Contact, ...]
    _pairs: tuple[tuple[str, ...], ...]
    _pair_of_points: tuple[IntArray, ...]

    @property
    def law(self) -> Law:
        """The hyperelastic law."""
        return law_named(self.settings.law)

    @property
    def indenters(self) -> tuple[int, ...]:
        """Indices of the contacts that move."""
        return tuple(i for i, c in enumerate(self._contacts) if not np.array_equal(c.start, c.stop) or c.name.startswith("indenter"))

    def moved_indenters(self, values: Mapping[str, float], state: str) -> list[Contact]:
        """Return the indenters on their paths to a state."""
        return [moved_indenter(self._contacts[i], self.experiment, state, values) for i in self.indenters]

    @property
    def whole(self) -> WholeBody:
        """The whole object, of which a part may be modelled."""
        return self.mirror.whole(self.mesh)

    def reactions(self, solution: Solution) -> dict[str, FloatArray]:
        """Return the force (3,), mN, of every rigid body and joint on the whole object, by name."""
        return self.mirror.reactions([(c.name, c.surface.normal, solution.reactions[c.name]) for c in self._contacts])

    def at_markers(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (k, 3), or (k, 3, p), at the markers from those (n, 3), or (n, 3, p), at the nodes."""
        found = (self.observation @ vectors.reshape(len(vectors), -1)).reshape(len(self.marker_points), *vectors.shape[1:])
        signs = self.mirror.signs(self.marker_points)
        return np.asarray(found * signs.reshape(*signs.shape, *(1,) * (vectors.ndim - 2)))

    @property
    def has_unknown_base(self) -> bool:
        """Whether the object may extend below its nominal shape: a half ellipsoid whose base height is not stated."""
        return self.experiment.shape.kind == "half_ellipsoid" and self.experiment.base_z_mm is None

    @property
    def shift_names(self) -> tuple[str, ...]:
        """Names of the shifts of the layers' boundaries."""
        return tuple(layer_shift(self.experiment, b.to_base_mm) for b in self.experiment.layers[:-1])

    def shift(self, name: str, values: Mapping[str, float]) -> FloatArray | None:
        """Return how the nodes (n, 3) move with a parameter of the shape; None for other parameters.

        A layer's boundary moves fully, what lies between it and its neighbours less.
        """
        if self.has_unknown_base and name == straight_base(self.experiment):
            step, height, now = 1e-3, self.experiment.height_mm, values.get(name, 0.0)
            ends = [on_straight_base(self._rest_points, height, now + sign * step) for sign in (1.0, -1.0)]
            return np.asarray((ends[0] - ends[1]) / (2.0 * step))
        if name not in self.shift_names:
            return None
        heights = [0.0, *(layer.to_base_mm for layer in self.experiment.layers)]
        at = self.shift_names.index(name) + 1
        out = np.zeros_like(self.mesh.points)
        out[:, 2] = np.interp(self._rest_points[:, 2], heights[at - 1 : at + 2], [0.0, 1.0, 0.0])
        return out

    def enlargement(self, values: Mapping[str, float]) -> FloatArray:
        """Return by what (3,) printed coordinates are larger in truth than the file's scale makes them."""
        r = values.get(pixel_scale(self.experiment), self.experiment.xy_scale) / self.experiment.xy_scale
        return np.array([r, r, 1.0])

    def marker_motion(self, name: str, values: Mapping[str, float]) -> FloatArray | None:
        """Return how the markers' positions (k, 3) in the undeformed object move with a parameter; None for other parameters."""
        if name in (base_offset(self.experiment), straight_base(self.experiment)):
            return np.tile([0.0, 0.0, 1.0], (len(self.marker_points), 1))
        if name == pixel_scale(self.experiment):  # the centre of the lattice stays the centre of the object
            return np.asarray(self.marker_points * np.array([1.0, 1.0, 0.0]) / self.experiment.xy_scale)
        return None

    def reshaped(self, values: Mapping[str, float]) -> Specimen:
        """Return the specimen with its layers' boundaries, its base and its markers where `values` put them."""
        below = values.get(straight_base(self.experiment), 0.0) if self.has_unknown_base else 0.0
        offset = values.get(base_offset(self.experiment), 0.0) + below
        shift = (
            on_straight_base(self._rest_points, self.experiment.height_mm, below) - self._rest_points
            if below
            else np.zeros_like(self.mesh.points)
        )
        for name in self.shift_names:
            shift += values.get(name, 0.0) * np.asarray(self.shift(name, values))
        enlargement = self.enlargement(values)
        if offset == 0.0 and not shift.any() and enlargement[0] == 1.0:
            return self
        mesh = self.mesh.moved(shift)
        points = self.marker_points * enlargement + np.array([0.0, 0.0, offset])
        contacts = tuple(
            c if c.name.startswith("joint") else replace(c, rest=np.einsum("pk,pki->pi", c.shape, mesh.points[c.nodes]))
            for c in self._contacts
        )
        observation, gradient = _observation(mesh, points, self.experiment, self.settings, self.mirror)
        assembler = self._assembler.with_elements(self._assembler.elements.moved(shift))
        return replace(
            self, mesh=mesh, marker_points=points, observation=observation, _gradient=gradient, _assembler=assembler, _contacts=contacts
        )

    def deformation_gradient(self, displacement: FloatArray) -> FloatArray:
        """Return F (k, 3, 3) at the markers, by central differences over a tenth of an element."""
        step = _difference_step(self.settings, self.experiment)
        values = [self.mirror.signs(p) * (a @ displacement) for a, p in zip(self._gradient, _around(self.marker_points, step), strict=True)]
        return np.stack([(f - b) / (2.0 * step) for f, b in zip(values[:3], values[3:], strict=True)], axis=2) + np.eye(3)

    def material_parameters(self, values: Mapping[str, float]) -> FloatArray:
        """Return the parameters (cells, 4), kPa, of all cells."""
        rows = np.zeros((len(self.mesh.region_names), 4))
        for row, layer in zip(rows, self._region_layers, strict=True):
            vector = from_moduli(self.law, *_moduli(layer, values), _shape(self.law, layer.material, values)).parameters
            row[: len(vector)] = vector
        return rows[self.mesh.regions]

    def problem(self, values: Mapping[str, float], state: str) -> Problem:
        """Return the boundary-value problem of one state.

        Parameters
        ----------
        values : mapping
            Physical value of every parameter of the specimen, by name.
        state : str
            Name of the state.
        """
        body = self.reshaped(values)
        contacts = []
        for i in range(len(body._contacts)):
            changed = body._with_friction(i, values)
            contacts.append(moved_indenter(changed, self.experiment, state, values) if i in self.indenters else changed)
        assembler = body._assembler.with_parameters(self.material_parameters(values))
        weight = np.zeros((self.mesh.n_points, 3))
        if self.experiment.loading.kind == "side_plates":
            weight = body_force(body._assembler.elements, np.full(self.mesh.n_cells, self.settings.density), GRAVITY)
        return Problem(body.mesh.points, assembler, tuple(contacts), self.mirror.held(body.mesh.points), weight)

    def direction(self, name: str, values: Mapping[str, float], state: str) -> list[Direction]:
        """Return how the problem of a state depends on the physical value of a parameter; empty where it does not.

        The change is the sum of the directions returned. A parameter of the shape of another law (`SHAPE_NAMES`) adds to the specimen's
        law what distinguishes the other one from a neo-Hookean law.
        """
        if (materials := self._material_direction(name, values)) is not None:
            other = law_of_shape(name.rpartition(": ")[2], self.law.name)
            return [Direction(materials=materials, law=None if other in (None, self.law.name) else law_named(str(other)).code)]
        out = []
        for i, (pairs, pair_of_point) in enumerate(zip(self._pairs, self._pair_of_points, strict=True)):
            if name in pairs:
                mask = np.array([p == name for p in pairs], dtype=float)[pair_of_point]
                springs = self._is_spring(i)
                out.append(Direction(contact=i, tangential_stiffness=mask) if springs else Direction(contact=i, friction=mask))
        if (points := self.shift(name, values)) is not None:
            out.append(Direction(points=points))
        for i in self.indenters:
            path = path_directions(self._contacts[i], self.experiment, state).get(name)
            if path is not None:
                out.append(replace(path, contact=i))
        return out

    @property
    def _region_layers(self) -> list[Layer]:
        """A layer of every region of the mesh, for its material and batch."""
        by_name = {layer.region: layer for layer in self.experiment.layers}
        return [by_name[name] for name in self.mesh.region_names]

    def _material_direction(self, name: str, values: Mapping[str, float]) -> FloatArray | None:
        """Derivative (cells, 4) of the cells' parameters with respect to the physical value of a material's or a batch's parameter."""
        out, found = np.zeros((self.mesh.n_cells, 4)), False
        for index, layer in enumerate(self._region_layers):
            vector = self._region_direction(layer, name, values)
            if vector is not None:
                out[self.mesh.regions == index, : len(vector)] = vector
                found = True
        return out if found else None

    def _region_direction(self, layer: Layer, name: str, values: Mapping[str, float]) -> tuple[float, ...] | None:
        material, shape = layer.material, _shape(self.law, layer.material, values)
        mu, kappa = _moduli(layer, values)
        e, nu = values[young_modulus(material)], values[poisson_ratio(material)]
        if name == young_modulus(material):
            return parameter_vector(self.law, mu / e, kappa / e, shape)
        if layer.batch and name == batch_stiffness(layer.batch):
            factor = values[name]
            return parameter_vector(self.law, mu / factor, kappa / factor, shape)
        if name == poisson_ratio(material):
            return parameter_vector(self.law, -mu / (1.0 + nu), 2.0 * kappa / (1.0 - 2.0 * nu), shape)
        kind = name.rpartition(": ")[2]
        law_name = law_of_shape(kind, self.law.name)
        if law_name is not None and name == shape_parameter(material, kind):
            law = law_named(law_name)
            one = tuple(float(kind == other) for other in SHAPE_NAMES[law_name])
            return tuple(a - b for a, b in zip(parameter_vector(law, mu, 0.0, one), parameter_vector(law, mu, 0.0), strict=True))
        return None

    def _is_spring(self, index: int) -> bool:
        """Whether the friction parameters of a contact are spring stiffnesses."""
        return self.settings.contact == "springs" and not self._contacts[index].name.startswith("joint")

    def _with_friction(self, index: int, values: Mapping[str, float]) -> Contact:
        contact = self._contacts[index]
        given = np.array([values.get(name, STICK) for name in self._pairs[index]])[self._pair_of_points[index]]
        if self._is_spring(index):
            return replace(contact, tangential_stiffness=given, friction_coefficient=np.full_like(given, STICK))
        if self.settings.contact == "stick" and not contact.name.startswith("joint"):
            given = np.full_like(given, STICK)
        return replace(contact, friction_coefficient=given)


def specimen(experiment: Experiment, settings: ModelSettings | None = None, *, whole: bool = False) -> Specimen:
    """Mesh an experiment and prepare its contacts and observations.

    Parameters
    ----------
    experiment : Experiment
        What was measured.
    settings : ModelSettings, optional
        Law, contact, mesh size.
    whole : bool
        Whether the whole object is modelled even where mirror planes would save most of it.

    Raises
    ------
    InputError
        A kind of object or loading that this model does not cover, or markers that lie far outside the object.
    """
    chosen = settings or ModelSettings()
    _require_supported(experiment)
    place = placement(experiment)
    mirror = MirrorPlanes() if whole else MirrorPlanes.of(experiment)
    mesh = mirror.part(model_mesh(experiment, chosen.element_size_mm))
    mesh, joints = sliding_joints(experiment, mesh, chosen.normal_stiffness) if chosen.joined == "sliding" else (mesh, [])
    boundary = mirror.outer_faces(mesh)
    bodies = rigid_bodies(experiment, mesh, boundary.faces, chosen.normal_stiffness, chosen.tangential_stiffness)
    material = {layer.region: layer.material for layer in experiment.layers}
    pairs = [tuple(friction(material[m], material_of(c)) for m in mesh.region_names) for c in bodies]
    pair_of_points = [np.repeat(mesh.regions[boundary.cells], len(c.area) // len(boundary.cells)) for c in bodies]
    pairs += [(joint_friction(experiment, float(height)),) for height in experiment.joined_at_mm[: len(joints)]]
    pair_of_points += [np.zeros(len(c.area), dtype=np.int64) for c in joints]
    contacts = (*bodies, *joints)
    discrete = elements(mesh, "standard" if chosen.law == "linear_elastic" else "mean_dilatation")
    pattern = block_pattern(mesh.n_points, discrete.connectivity, *(c.nodes for c in contacts))
    placeholder = [from_moduli(law_named(chosen.law), 1.0, 10.0)] * len(mesh.region_names)
    assembler = Assembler.from_materials(discrete, mesh.regions, placeholder, pattern)
    initial = experiment.initial
    filled, was_missing = completed(initial.ids, np.where(initial.trusted[:, None], initial.points, np.nan))
    partly = np.isfinite(np.where(initial.trusted[:, None], initial.points, np.nan)).any(axis=1)
    usable = partly & np.isfinite(filled).all(axis=1)
    points = place.to_object(filled[usable])
    observation, gradient = _observation(mesh, points, experiment, chosen, mirror)
    return Specimen(
        experiment, chosen, place, mirror, mesh, initial.ids[usable], points, was_missing[usable], observation, gradient, mesh.points,
        assembler, contacts, tuple(pairs), tuple(pair_of_points),
    )  # fmt: skip


def _observation(
    mesh: Mesh, points: FloatArray, experiment: Experiment, settings: ModelSettings, mirror: MirrorPlanes
) -> tuple[sp.csr_array, tuple[sp.csr_array, ...]]:
    """Interpolation at markers (k, 3), mm, and at points a little before and behind them along each axis."""
    tolerance = 0.05 * experiment.height_mm
    around = _around(points, _difference_step(settings, experiment))
    here = interpolation_operator(mesh, points * mirror.signs(points), tolerance_mm=tolerance)
    return here, tuple(interpolation_operator(mesh, p * mirror.signs(p), tolerance_mm=2 * tolerance) for p in around)


def _around(points: FloatArray, step: float) -> list[FloatArray]:
    """Points (k, 3) one step before, and one behind, `points` along each axis."""
    return [points + sign * step * axis for sign in (1.0, -1.0) for axis in np.eye(3)]


def _require_supported(experiment: Experiment) -> None:
    if experiment.dimensions != 3:
        raise InputError(
            f"experiment {experiment.name!r} has two-dimensional data; displacement matching needs markers in three dimensions"
        )
    if experiment.up_axis != "z":
        raise InputError(
            f"experiment {experiment.name!r} has its height along {experiment.up_axis}; turn its axes so that z points away from the base"
        )
    if experiment.loading.kind == "cylinder":
        raise InputError(f"experiment {experiment.name!r} is pressed by a cylinder; plates, bars and side plates are covered")


def _difference_step(settings: ModelSettings, experiment: Experiment) -> float:
    return 0.1 * element_size(experiment, settings.element_size_mm)


def _moduli(layer: Layer, values: Mapping[str, float]) -> tuple[float, float]:
    """Shear and bulk modulus, kPa."""
    e, nu = values[young_modulus(layer.material)], values[poisson_ratio(layer.material)]
    e *= values.get(batch_stiffness(layer.batch), 1.0)
    return e / (2.0 * (1.0 + nu)), e / (3.0 * (1.0 - 2.0 * nu))


def _shape(law: Law, material: str, values: Mapping[str, float]) -> tuple[float, ...]:
    return tuple(values.get(shape_parameter(material, name), 0.0) for name in SHAPE_NAMES.get(law.name, ()))
