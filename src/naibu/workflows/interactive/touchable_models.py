"""Bodies to touch: from an identified model, a lattice study or a mesh to a body on its supports."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import numpy as np

from naibu.core.arrays import FloatArray, IntArray, require_positive, require_within
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.units import MODULI_KPA
from naibu.identification.from_fields.forward.field_laws import NeoHookean
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_markers.specimen.specimen_model import GRAVITY, Specimen, specimen
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.io.meshes import MESH_READERS, read_mesh
from naibu.mechanics.contact.rigid_indenters import (
    RigidIndenter,
    box_indenter,
    capsule_indenter,
    plane_indenter,
    spherical_indenter,
)
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.surface import surface_of
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.point_location import interpolation_operator
from naibu.simulation.frame import Frame
from naibu.simulation.interactive_bodies import FiniteElementBody, InteractiveBody, LatticeBody, nodes_touching
from naibu.viewer.live.scene import LiveReading
from naibu.workflows.joint_model import JointModel
from naibu.workflows.markers.experiments import Source, load_experiment
from naibu.workflows.results.result_folder import MODEL_FILE, read_any_model
from naibu.workflows.studies.lattice_study import NAMED, PreparedStudy, prepared_study

LATTICE_STEP_S = 1e-3
LATTICE_TOLERANCE = 0.1  # of the solver: forces on a sphere are off by less than .1 % of the largest (rms), see `contact_steps.py`
BASE_FRACTION = 1e-3  # of the height of a mesh: nodes this near to its lowest one are held
TOOL_FRICTION = 0.3
MOST_LISTED = 8  # zones whose moduli a heading lists
STICKING = 100.0  # friction coefficients above are those of surfaces that never slip


@dataclass(frozen=True, slots=True)
class MeshMaterial:
    """Material of a mesh without an identified model.

    Attributes
    ----------
    young_modulus_kpa : float
        kPa.
    poisson_ratio : float
        At most 0.499.
    density_g_per_cm3 : float
        g/cm3.

    Raises
    ------
    InputError
        A value out of range.
    """

    young_modulus_kpa: float = 10.0
    poisson_ratio: float = 0.45
    density_g_per_cm3: float = 1.0

    def __post_init__(self) -> None:
        require_within("young_modulus_kpa", self.young_modulus_kpa, *MODULI_KPA, "kPa")
        require_positive("density_g_per_cm3", self.density_g_per_cm3, "g/cm3")
        if not -0.9 <= self.poisson_ratio <= 0.499:
            raise InputError(f"poisson_ratio must lie between -0.9 and 0.499, not {self.poisson_ratio:g}")


class Sensor(Protocol):
    """What reads a body while it is touched."""

    @property
    def readings(self) -> tuple[LiveReading, ...]:
        """What is read."""

    def at(self, frame: Frame) -> FloatArray:
        """Return value and ends of the 95 % interval of every reading at a frame (k, 3), NaN where there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class TouchableModel:
    """A body to touch, and what is said about it.

    Attributes
    ----------
    title : str
        Heading.
    sentences : tuple of str
        What is simulated.
    body : InteractiveBody
        The body on its supports.
    strain : str
        Name and unit of its strain.
    marker_nodes, marker_weights : ndarray, shape (q, c)
        Nodes and weights that interpolate the markers inside; without rows where there are none.
    doubt : str
        What is said, last of the sentences, where identification did not call the model usable; empty where it did.
    tools : mapping of str to RigidIndenter, optional
        What touches it; by default those of `tools_for`.
    aimed_at : tuple of float, optional
        Point, mm, at which the axes of the tools point wherever they are led.
    cuttable : bool
        Whether it can be cut.
    sensor : Sensor, optional
        What reads it.
    """

    title: str
    sentences: tuple[str, ...]
    body: InteractiveBody
    strain: str
    marker_nodes: IntArray = field(default_factory=lambda: np.zeros((0, 8), np.int64))
    marker_weights: FloatArray = field(default_factory=lambda: np.zeros((0, 8)))
    doubt: str = ""
    tools: Mapping[str, RigidIndenter] | None = None
    aimed_at: tuple[float, float, float] | None = None
    cuttable: bool = True
    sensor: Sensor | None = None


def touchable(source: str | os.PathLike[str], *, experiment: Source | None = None, material: MeshMaterial | None = None) -> TouchableModel:
    """Prepare a body to be touched.

    Parameters
    ----------
    source : str or path-like
        ``"demo"``: the gels that ``naibu demo`` identifies, as they come with naibu; ``model.json`` of an identification or its folder; a
        volume mesh (``.vtu``, ``.msh``); a lattice study (``.toml``), or the name of one.
    experiment : path, str or Experiment, optional
        Whose body an identified model is made for; by default the first one that it was identified from, if that is a bundled dataset.
    material : MeshMaterial, optional
        Of a mesh; soft and nearly incompressible by default.

    Raises
    ------
    InputError
        A source that is none of these or cannot be read, or an option that does not belong to it.
    """
    path = Path(str(files("naibu") / "datasets" / "data" / "identified_gels.json")) if source == "demo" else Path(source)
    is_model = path.suffix == ".json" or (path.is_dir() and (path / MODEL_FILE).is_file())
    is_mesh = path.suffix.lower() in MESH_READERS
    if experiment is not None and not is_model:
        raise InputError(f"`experiment` goes with an identified model, and {source} is none; leave it out, or name a {MODEL_FILE}")
    if material is not None and not is_mesh:
        raise InputError(f"material goes with a mesh, and {source} is none; leave it out, or name one of {', '.join(MESH_READERS)}")
    if is_model:
        model = read_any_model(path)
        if isinstance(model, JointModel):
            model = model.fields if experiment is None else model.markers
        if isinstance(model, CalibratedModel):
            return _identified(model, experiment)
        if experiment is not None:
            raise InputError(f"`experiment` goes with a model of markers; {source} was identified from displacement fields; leave it out")
        return _identified_from_fields(path, model)
    if is_mesh:
        return _meshed(path, read_mesh(path), material or MeshMaterial())
    if str(source) in NAMED or path.suffix == ".toml":
        return _lattice(prepared_study(source))
    if path.is_file():
        raise InputError(
            f"{source}: is neither a mesh ({', '.join(MESH_READERS)}, which ParaView and meshio save), nor a {MODEL_FILE} or its folder, "
            "nor a study (.toml)"
        )
    raise InputError(
        f"{source}: is neither a {MODEL_FILE} or its folder, nor a mesh ({', '.join(MESH_READERS)}), nor a study (.toml); what naibu "
        f"brings with it is demo (the gels of naibu demo), for naibu live fingertip, and the lattices {', '.join(NAMED)}"
    )


def tools_for(body: InteractiveBody) -> dict[str, RigidIndenter]:
    """Return a sphere, a plate and a bar in proportion to a body, waiting above it, with friction."""
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    extent = float((high - low).max())
    surface = {"static_friction": TOOL_FRICTION, "kinetic_friction": TOOL_FRICTION}

    def above(height: float) -> FloatArray:
        return np.array([*(0.5 * (low + high))[:2], high[2] + height + 0.08 * extent])

    return {
        "sphere": spherical_indenter(above(0.14 * extent), 0.14 * extent, **surface),
        "plate": box_indenter(above(0.06 * extent), (0.7 * extent, 0.7 * extent, 0.12 * extent), **surface),
        "bar": capsule_indenter(above(0.07 * extent), 0.07 * extent, 0.7 * extent, (0.0, 1.0, 0.0), **surface),
    }


def _lattice(prepared: PreparedStudy) -> TouchableModel:
    """A lattice on what does not move in its study: tied nodes stay where they are, contact stays contact."""
    study = prepared.study
    still = [b for b in study.bodies if b.motion is None and b.drive is None]
    tied = [b.indenter for b in still if b.tied_until_s is not None]
    fixtures = tuple(b.indenter for b in still if b.tied_until_s is None)
    engine = LatticeEngine.of(study.lattice, study.parameters, step=LATTICE_STEP_S, tolerance=LATTICE_TOLERANCE)
    supported = nodes_touching(study.lattice.points, tied) if still else _lowest(study.lattice.points)
    cells = to_tetra(prepared.mesh).cells
    body = LatticeBody(engine, surface_of(study.lattice).triangles, cells, supported, fixtures, study.external_force)
    sentence = (
        f"Mass-spring-dashpot lattice of {study.lattice.n_nodes} nodes and {study.lattice.n_elements} elements, "
        f"{1e3 * study.lattice.total_mass:.4g} g, stepped {1.0 / LATTICE_STEP_S:.0f} times a second."
    )
    return TouchableModel(prepared.title, (sentence,), body, "mean elongation, %")


def _identified(model: CalibratedModel, source: Source | None) -> TouchableModel:
    """The body of an experiment with the identified materials, on its table with the identified friction, under its own weight."""
    name = model.load_cases[0].partition("/")[0] if model.load_cases else ""
    try:
        experiment = load_experiment(name if source is None else source)
    except InputError as error:
        mend = "name the folder of an experiment with these materials as `experiment`"
        raise InputError(f"the body of the model is that of experiment {name!r}: {error}; {mend}") from error
    values = model.parameters.values()
    body = specimen(experiment, model.settings, whole=True)
    missing = [m for m in experiment.materials if not any(p.startswith(f"{m}: ") for p in values)]
    if missing:
        raise InputError(
            f"the model does not know the material {missing[0]!r} of experiment {experiment.name!r}; choose another experiment"
        )
    body = body.reshaped(values)
    coefficient = _table_friction(body, values)
    table = plane_indenter((0.0, 0.0, float(body.mesh.points[:, 2].min())), static_friction=coefficient, kinetic_friction=coefficient)
    touched = FiniteElementBody.of(
        body.mesh, body._assembler.with_parameters(body.material_parameters(values)), fixtures=(table,), density=model.settings.density,
        gravity=GRAVITY, normal_stiffness=model.settings.normal_stiffness, tangential_stiffness=model.settings.tangential_stiffness,
    )  # fmt: skip
    nodes, weights = _interpolation(body.mesh, body.marker_points)
    said: tuple[str, ...] = (
        f"Finite elements of the identified materials, {model.settings.law.replace('_', '-')} law: {body.mesh.n_cells} cells of the body "
        f"of {experiment.name}.",
        f"It stands on its table with friction {min(coefficient, STICKING):.2g}; {1.0 / touched.step_s:.0f} steps a second.",
    )
    if model.reference is not None:
        material_of_scale, modulus = model.reference
        said += (f"No modulus is known: that of {material_of_scale} is taken as {modulus:g} kPa, and forces are in proportion to it.",)
    if model.is_weighed:
        said += ("Moduli follow from the weight of the object, and may be larger where something else held it down; so may forces.",)
    return _doubted(TouchableModel(f"{experiment.name}, touched", said, touched, "equivalent strain, %", nodes, weights), model)


def _identified_from_fields(path: Path, model: IdentifiedBody) -> TouchableModel:
    """The body of displacement fields with the moduli of its zones, or of a map, cell by cell; its lowest nodes are held."""
    law = NeoHookean(model.mesh, averaged=True)
    body = FiniteElementBody.of(model.mesh, law.assembler(*model.lame_of_cells()), supported=_lowest(model.mesh.points))
    zones = [f"{name} {young:.3g}" for name, young, _ in model.moduli()]
    listed = f": {', '.join(zones)}" if len(zones) <= MOST_LISTED else f" of {len(zones)} zones"
    unit = f"{model.unit}; forces are in the same measure" if model.relative else model.unit
    said = (
        f"Finite elements of the identified moduli, neo-Hookean: {model.mesh.n_cells} cells; Young's modulus{listed} ({unit}).",
        "The nodes of least z are held.",
    )
    name = path.name if path.is_dir() else path.resolve().parent.name
    return _doubted(TouchableModel(f"{name}, touched", said, body, "equivalent strain, %"), model)


def _doubted(made: TouchableModel, model: CalibratedModel | IdentifiedBody) -> TouchableModel:
    """Say it where identification did not call its model usable."""
    if not model.reservation:
        return made
    doubt = f"The model is doubtful: {model.reservation}"
    return replace(made, sentences=(*made.sentences, doubt), doubt=doubt)


def _table_friction(body: Specimen, values: dict[str, float]) -> float:
    """Mean friction coefficient of the table over the faces that stand on it."""
    contact = body._with_friction(0, values)
    standing = contact.rest[:, 2] < contact.rest[:, 2].min() + 1e-6
    return float(contact.friction_coefficient[standing].mean())


def _meshed(path: Path, mesh: Mesh, given: MeshMaterial) -> TouchableModel:
    """A mesh of one material whose lowest nodes are held."""
    if mesh.cell_type not in ("tetra", "hexahedron"):
        raise InputError(f"{path}: has cells of type {mesh.cell_type}; contact needs linear tetrahedra or hexahedra")
    law = material(young_modulus=given.young_modulus_kpa, poisson_ratio=given.poisson_ratio)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law] * len(mesh.region_names))
    body = FiniteElementBody.of(mesh, assembler, supported=_lowest(mesh.points), density=1e-6 * given.density_g_per_cm3)
    said = (
        f"Finite elements, neo-Hookean: {mesh.n_cells} cells, Young's modulus {given.young_modulus_kpa:g} kPa, Poisson's ratio "
        f"{given.poisson_ratio:g}.",
        "The lowest nodes are held.",
    )
    return TouchableModel(path.stem, said, body, "equivalent strain, %")


def _lowest(points: FloatArray) -> IntArray:
    """Nodes at the lowest height, which hold a body that nothing else holds."""
    z = points[:, 2]
    return np.flatnonzero(z <= z.min() + BASE_FRACTION * np.ptp(z)).astype(np.int64)


def _interpolation(mesh: Mesh, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Nodes and weights (q, c) that interpolate nodal values at points (q, 3)."""
    matrix = interpolation_operator(mesh, points, tolerance_mm=0.1 * float(np.ptp(mesh.points, axis=0).max()))
    most = int(np.diff(matrix.indptr).max(initial=1))
    nodes, weights = np.zeros((len(points), most), np.int64), np.zeros((len(points), most))
    for row, (start, stop) in enumerate(zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True)):
        nodes[row, : stop - start], weights[row, : stop - start] = matrix.indices[start:stop], matrix.data[start:stop]
    return nodes, weights
