"""Prepare lattice studies: from a study file, or a study that comes with naibu, to the lattice and its indenters."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage

from naibu._version import __version__
from naibu.core.arrays import BoolArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import RigidTransform
from naibu.io.files.parsing import parsed_toml
from naibu.io.files.provenance import sha256
from naibu.io.files.reading import file_beside, read_bytes
from naibu.io.study_schemas.lattice_study_schema import FloorTable, IndenterTable, StudyFile, checked_study, load_study
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter, cylindrical_indenter, plane_indenter, spherical_indenter
from naibu.mechanics.lattices.model.contact_state import TOUCH_MM, check_outside
from naibu.mechanics.lattices.model.hexahedra import lattice_mesh
from naibu.mechanics.lattices.model.lattice import CLASSES, Lattice, box_mask, classic_lattice
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice
from naibu.mechanics.lattices.model.voxels import cropped_mask, voxel_mask
from naibu.mechanics.lattices.simulation.loading_history import Drive, LatticeStudy, StudyBody, check_study
from naibu.mechanics.lattices.simulation.tied_bodies import FacePoints
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.workflows.studies.label_volume import label_volume
from naibu.workflows.studies.lattice_material import element_parameters, material_inputs

OCTREES = ("octree-0", "octree-1", "octree-2")
BASES = ("cube-pushing", "dough-first-pushing", "dough-second-pushing", "dough-pressed-by-sphere", "dough-pushed-over-floor")
VARIED = BASES[:3]  # those that have octree variants
NAMED = tuple(name + variant for name in BASES for variant in ("", *(f"-{kind}" for kind in OCTREES if name in VARIED)))
TEMPLATE = "dough-pressed-by-sphere"
_MOST_CELLS = 20_000_000


@dataclass(frozen=True, slots=True, eq=False)
class PreparedStudy:
    """A study prepared to run: settings, lattice, mesh and provenance.

    Attributes
    ----------
    name : str
        Of the files.
    title : str
        Heading.
    source : str
        File or name that it was asked by.
    settings : StudyFile
        Contents of the file.
    study : LatticeStudy
        What is computed.
    mesh : Mesh
        The cubes of the lattice, as hexahedra.
    inputs : dict
        SHA-256 of every file that was read.
    fingerprint : str
        SHA-256 of settings and inputs; results of equal ones continue each other.
    """

    name: str
    title: str
    source: str
    settings: StudyFile
    study: LatticeStudy
    mesh: Mesh
    inputs: dict[str, str]
    fingerprint: str


def study_text(name: str) -> str:
    """Return the file of a study that comes with naibu.

    Raises
    ------
    InputError
        There is no such study.
    """
    if name not in NAMED:
        raise InputError(f"there is no lattice study {name!r}; choose one of {', '.join(NAMED)}, or give a file STUDY.toml")
    base = next(b for b in BASES if name == b or name.removeprefix(f"{b}-") in OCTREES)
    text = (files("naibu") / "datasets" / "studies" / f"{base}.toml").read_text(encoding="utf-8")
    if name == base:
        return text
    kind = name.removeprefix(f"{base}-")
    return text.replace('kind = "classic"', f'kind = "{kind}"').replace('"  # title', f', {kind.replace("-", " type ")}"  # title')


def prepared_study(source: str | os.PathLike[str]) -> PreparedStudy:
    """Read and check a study.

    Parameters
    ----------
    source : str or path-like
        Name of a study that comes with naibu, or a file.

    Raises
    ------
    InputError
        No such study or file; a key or value that cannot be; an empty mask, or one in pieces; an indenter that starts inside the object.
        The message names the file, the field, its value and the mend.
    """
    content, path, name = _read(source)
    return _prepared(source, path, name, load_study(path, content), hashlib.sha256(content).hexdigest())


def study_tables(source: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the tables of a study, as its file has them.

    Raises
    ------
    InputError
        No such study or file, or text that is not TOML.
    """
    content, path, _ = _read(source)
    return parsed_toml(path, content)


def prepared_document(source: str | os.PathLike[str], document: Mapping[str, Any]) -> PreparedStudy:
    """Check and prepare a study whose tables are given; `source` says where files that it names lie.

    Raises
    ------
    InputError
        As `prepared_study`.
    """
    path = Path() / str(source) if str(source) in NAMED else Path(source)
    text = json.dumps(document, sort_keys=True).encode()
    return _prepared(source, path, path.stem, checked_study(path, document), hashlib.sha256(text).hexdigest())


def _read(source: str | os.PathLike[str]) -> tuple[bytes, Path, str]:
    """Return the file of a study, its path, and the name of its results."""
    path = Path(source)
    if str(source) in NAMED:
        return study_text(str(source)).encode(), Path() / str(source), str(source)
    try:
        return read_bytes(path), path, path.stem
    except InputError as error:
        raise InputError(f"{error}; give a file STUDY.toml, or one of the studies {', '.join(NAMED)}") from error


def _prepared(source: str | os.PathLike[str], path: Path, name: str, settings: StudyFile, digest: str) -> PreparedStudy:
    mask, frame, inputs = _mask(path, path.parent, settings)
    inputs |= material_inputs(path, settings)
    study = _study(path, settings, mask, frame)
    said = json.dumps([settings.model_dump(mode="json"), inputs, __version__], sort_keys=True)
    inputs = {path.name: digest, **inputs}
    fingerprint = hashlib.sha256(said.encode()).hexdigest()
    title = settings.title or name.replace("-", " ").replace("_", " ").capitalize()
    return PreparedStudy(name, title, str(source), settings, study, lattice_mesh(study.lattice), inputs, fingerprint)


def _mask(path: Path, folder: Path, settings: StudyFile) -> tuple[BoolArray, RigidTransform, dict[str, str]]:
    """Return the voxels of the object, their frame, and the hashes of files that they come from."""
    table, spacing = settings.object, settings.lattice.spacing_mm
    if table.size_mm is not None or table.cells is not None:
        x, y, z = table.cells if table.cells is not None else [round(edge / spacing) for edge in table.size_mm or ()]
        if x * y * z > _MOST_CELLS:
            raise InputError(f"{path}: [object] {x} x {y} x {z} voxels are more than {_MOST_CELLS}; choose a larger spacing_mm")
        return box_mask((x, y, z)), RigidTransform.identity(), {}
    assert table.labels is not None
    file = file_beside(folder / path.name, table.labels)
    volume = label_volume(path, file, table)
    chosen = np.isin(volume.values, table.label) if table.label else volume.values != 0
    if not chosen.any():
        present = ", ".join(f"{v:g}" for v in np.unique(volume.values)[:8])
        asked = f"label = {table.label}" if table.label else "labels other than 0"
        raise InputError(f"{path}: [object] {asked}: {file} holds no such voxel; its labels are {present}")
    mask, frame = voxel_mask(volume, chosen, spacing)
    if not mask.any():
        raise InputError(
            f"{path}: [lattice] spacing_mm = {spacing:g}: no voxel of that edge is half filled by the labels of {file}; make it less"
        )
    pieces, count = scipy.ndimage.label(mask, structure=np.ones((3, 3, 3)))
    if count > 1 and table.largest_piece:
        mask = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    elif count > 1:
        sizes = sorted(np.bincount(pieces.ravel())[1:].tolist(), reverse=True)
        raise InputError(
            f"{path}: [object] labels = {table.labels!r}: the object falls into {count} pieces of {', '.join(map(str, sizes[:5]))} voxels; "
            "write largest_piece = true to keep the largest, or choose other labels or a smaller spacing_mm"
        )
    mask, frame = cropped_mask(mask, frame, spacing)
    return mask, frame, {Path(table.labels).name: sha256(file)}


def _study(path: Path, settings: StudyFile, mask: BoolArray, frame: RigidTransform) -> LatticeStudy:
    simulation = settings.simulation
    lattice = _lattice(path, settings, mask, frame)
    samples = round(settings.output.every_s / settings.sample_s)
    gravity = simulation.gravity_mm_per_s2
    study = LatticeStudy(
        lattice,
        element_parameters(path, settings, lattice),
        _bodies(path, settings, lattice),
        simulation.step_s,
        round(simulation.duration_s / settings.output.every_s),
        samples,
        round(settings.sample_s / simulation.step_s),
        simulation.method,
        simulation.tolerance,
        np.outer(lattice.node_mass, [0.0, 0.0, -gravity]) if gravity else None,
    )
    try:
        check_study(study)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return study


def _lattice(path: Path, settings: StudyFile, mask: BoolArray, frame: RigidTransform) -> Lattice:
    table, body = settings.lattice, settings.object
    amount: Mapping[str, Any] = (
        {"total_mass_kg": 1e-3 * body.mass_g} if body.mass_g is not None else {"density": 1e-6 * (body.density_g_per_cm3 or 0.0)}
    )
    try:
        if table.kind == "classic":
            return classic_lattice(mask, table.spacing_mm, lumping=table.masses, frame=frame, **amount)
        assert settings.parameters is not None  # no [material] with octrees
        ratios = class_ratios(settings.parameters.K)
        return octree_lattice(
            mask, table.spacing_mm, int(table.kind[-1]), lumping=table.masses, class_stiffness=ratios, frame=frame, **amount
        )
    except InputError as error:
        raise InputError(f"{path}: [lattice] {error}") from error


def class_ratios(stiffness: float | Mapping[str, Any]) -> tuple[float, ...]:
    """Return the ratios of K that the factors of an octree depend on: short, normal and long, of the core where zones differ.

    Where they are alike, or one is 0, the factors are those of equal ones.
    """

    def of_core(given: Any) -> Any:
        return given.get("core", given) if isinstance(given, Mapping) else given

    by_class = of_core(stiffness)
    ratios = tuple(of_core(by_class.get(name)) for name in CLASSES) if isinstance(by_class, Mapping) else ()
    return ratios if ratios and all(isinstance(ratio, float) and ratio > 0.0 for ratio in ratios) else (1.0, 1.0, 1.0)


def _bodies(path: Path, settings: StudyFile, lattice: Lattice) -> tuple[StudyBody, ...]:
    bodies = [] if settings.floor is None else [_floor(settings.floor, lattice)]
    for k, table in enumerate(settings.indenter):
        body = _indenter(table, k, settings.simulation.duration_s)
        try:
            check_outside(lattice, [body.indenter])
            if table.contact == "points":
                body = replace(body, points=_face_points(table, lattice))
        except InputError as error:
            told = re.sub(r"^indenters\[0\], an? \w+, ", "the indenter ", str(error))
            raise InputError(f"{path}: [[indenter]] number {k + 1} centre_mm = {table.centre_mm}: {told}") from error
        bodies.append(body)
    names = [body.name for body in bodies]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise InputError(
            f"{path}: [[indenter]] name = {twice!r} is given twice; give every indenter a name of its own ('floor' is the floor)"
        )
    return tuple(bodies)


def _surface(table: FloorTable | IndenterTable) -> dict[str, float]:
    return {
        "static_friction": table.static_friction,
        "kinetic_friction": table.static_friction if table.kinetic_friction is None else table.kinetic_friction,
        "pull_stiffness": table.pull_stiffness_mN_per_mm,
        "pull_damping": table.pull_damping_mN_s_per_mm,
        "pull_speed": table.pull_speed_mm_per_s,
    }


def _floor(table: FloorTable, lattice: Lattice) -> StudyBody:
    low, high = lattice.points.min(axis=0), lattice.points.max(axis=0)
    middle = 0.5 * (low + high)
    ground = plane_indenter((middle[0], middle[1], low[2]), **_surface(table))
    return StudyBody("floor", ground, tied_until_s=np.inf if table.contact == "sticking" else None)


def _indenter(table: IndenterTable, k: int, duration_s: float) -> StudyBody:
    drive = None
    if table.force is not None:
        force = np.array(table.force)
        drive = Drive(force[:, 0], force[:, 1], np.array(table.direction), 1e-3 * (table.mass_g or 0.0))
    until = None
    if table.contact != "friction":
        until = np.inf if table.until_s is None else table.until_s
    return StudyBody(table.name or f"indenter {k + 1}", _rigid(table), _motion(table, duration_s), drive, until)


def _face_points(table: IndenterTable, lattice: Lattice) -> FacePoints:
    """Return a grid of points on the side of a box that lies on a face of the object, as far as they are over it."""
    size, centre = np.array(table.size_mm), np.array(table.centre_mm)
    low, high = lattice.points.min(axis=0), lattice.points.max(axis=0)
    ends = {"-": (centre + 0.5 * size, low), "+": (centre - 0.5 * size, high)}
    faces = [(sign, a) for sign, (own, face) in ends.items() for a in range(3) if abs(own[a] - face[a]) < TOUCH_MM]
    if not faces:
        raise InputError('contact = "points" needs a side of the box on an outermost face of the object; move centre_mm so that they touch')
    sign, across = faces[0]
    each, axes = table.points_mm or lattice.spacing_mm, []
    for a in range(3):
        count = int(np.floor(size[a] / each + 1e-9))
        own = centre[a] + each * (np.arange(count + 1) - 0.5 * count)
        axes.append(ends[sign][1][[a]] if a == across else own[(own >= low[a] - 1e-9) & (own <= high[a] + 1e-9)])
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if not len(points):
        raise InputError("none of the points of the box lies over the face of the object; make points_mm less, or move centre_mm")
    return FacePoints(f"{sign}{'xyz'[across]}", points)


def _rigid(table: IndenterTable) -> RigidIndenter:
    surface = _surface(table)
    if table.shape == "box":
        return box_indenter(table.centre_mm, table.size_mm or (), **surface)
    if table.shape == "sphere":
        return spherical_indenter(table.centre_mm, table.radius_mm or 0.0, **surface)
    return cylindrical_indenter(table.centre_mm, table.radius_mm or 0.0, table.length_mm or 0.0, table.axis, **surface)


def _motion(table: IndenterTable, duration_s: float) -> PrescribedMotion | None:
    """Return the prescribed motion of an indenter, None where it does not move."""
    if table.path:
        rows = np.array(table.path)
        return PrescribedMotion.through(rows[:, 0], rows[:, 1:]) if rows[:, 1:].any() else None
    if not table.velocity:
        return None
    rows = np.array(table.velocity)
    rows = rows[rows[:, 0] < duration_s]
    times = np.append(rows[:, 0], duration_s)
    moved = np.cumsum(rows[:, 1:] * np.diff(times)[:, None], axis=0)
    return PrescribedMotion.through(times, np.concatenate([np.zeros((1, 3)), moved])) if moved.any() else None
