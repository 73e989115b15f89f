"""Studies of indentations: from a file, or the one that comes with naibu, to a mesh, materials and indenters."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.files.parsing import parsed_toml
from naibu.io.files.provenance import sha256
from naibu.io.files.reading import file_beside, read_bytes
from naibu.io.meshes import read_mesh
from naibu.io.study_schemas.indentation_schema import IndentationFile, PressTable, load_indentation
from naibu.mechanics.contact.rigid_indenters import RigidIndenter, box_indenter, capsule_indenter, spherical_indenter
from naibu.mechanics.finite_elements.hyperelasticity import Material, material
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_faces, triangles_of_faces
from naibu.simulation.adaptive.conditions import Conditions

INDENTATION = "indentation"  # name of the study that naibu brings along
INDENTATION_TITLE = "gel pressed by a sphere, on a mesh that is refined for the force"
MOST_CELLS = 200_000  # of the coarsest mesh
ON_THE_PLANE = 1e-6  # of the extent: nodes at the height that is held are held


@dataclass(frozen=True, slots=True, eq=False)
class PreparedIndentation:
    """A study, read and checked.

    Attributes
    ----------
    name, title, source : str
        Of the files, heading, and what was asked for.
    settings : IndentationFile
        Contents of the file.
    mesh : Mesh
        Coarsest mesh, tetrahedra.
    materials : tuple of Material
        Of the regions of the mesh.
    conditions : Conditions
        What is held.
    indenters : tuple of RigidIndenter
        At the start.
    names : tuple of str
        Of the indenters.
    travel : ndarray, shape (k, 3)
        Their ways, mm.
    inputs : dict
        SHA-256 of every file that was read.
    """

    name: str
    title: str
    source: str
    settings: IndentationFile
    mesh: Mesh
    materials: tuple[Material, ...]
    conditions: Conditions
    indenters: tuple[RigidIndenter, ...]
    names: tuple[str, ...]
    travel: FloatArray
    inputs: dict[str, str]

    @property
    def rubs(self) -> bool:
        """Whether there is friction, so that forces depend on the way."""
        return any(i.static_friction > 0.0 for i in self.indenters)

    @property
    def locks(self) -> bool:
        """Whether a material resists a change of volume so much that dilatations must be averaged over patches of tetrahedra."""
        return max(table.poisson_ratio for table in self.settings.material) > 0.4


def indentation_text() -> str:
    """Return the file of the study that comes with naibu, which explains every key."""
    return (files("naibu") / "datasets" / "studies" / "indentation.toml").read_text(encoding="utf-8")


def describes_indentation(source: str | os.PathLike[str]) -> bool:
    """Whether a study is one of an indentation: by its name, or a file that has a table ``[solid]``."""
    if os.fspath(source) == INDENTATION:
        return True
    try:
        return "solid" in parsed_toml(source, read_bytes(Path(source)))
    except InputError:  # told by whoever reads it
        return False


def prepared_indentation(source: str | os.PathLike[str]) -> PreparedIndentation:
    """Read and check a study.

    Parameters
    ----------
    source : str or path-like
        ``"indentation"``, or a file.

    Raises
    ------
    InputError
        No such file; a key or value that cannot be; a mesh that cannot be read or has regions without a material; an indenter that begins
        inside the solid. The message names the file.
    """
    own = os.fspath(source) == INDENTATION
    path = Path(f"{INDENTATION}.toml") if own else Path(source)
    content = indentation_text().encode() if own else read_bytes(path)
    settings = load_indentation(path, content)
    for table, given in (("material", settings.material), ("indenter", settings.indenter)):
        if not given:
            raise InputError(f"{path}: [[{table}]] is missing; add one; the example of the study {INDENTATION!r} shows every key")
    mesh, inputs = _mesh(path, settings)
    bottom = float(mesh.points[:, 2].min()) + (settings.solid.held_below_mm or 0.0)
    held = bottom + ON_THE_PLANE * float(np.ptp(mesh.points, axis=0).max())
    if (mesh.points[:, 2] <= held).all():
        raise InputError(f"{path}: [solid] held_below_mm = {settings.solid.held_below_mm}: holds the whole solid; give less")
    indenters = tuple(_indenter(table) for table in settings.indenter)
    names = tuple(table.name or f"indenter {k + 1}" for k, table in enumerate(settings.indenter))
    for k, indenter in enumerate(indenters):
        if (depth := deepest(mesh, indenter)) > 1e-9 * float(np.abs(mesh.points).max()):
            raise InputError(
                f"{path}: [[indenter]] number {k + 1} centre_mm = {settings.indenter[k].centre_mm}: begins {depth:.3g} mm inside the "
                "solid; move it away"
            )
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise InputError(f"{path}: [[indenter]] name = {twice!r} is given twice; give every indenter a name of its own")
    name = INDENTATION if own else path.stem
    digest = {path.name: hashlib.sha256(content).hexdigest(), **inputs}
    return PreparedIndentation(
        name, settings.title or name, os.fspath(source), settings, mesh, _materials(path, settings, mesh),
        Conditions(lambda points: points[:, 2] <= held), indenters, names, np.array([t.travel_mm for t in settings.indenter]), digest,
    )  # fmt: skip


def deepest(mesh: Mesh, indenter: RigidIndenter) -> float:
    """Return how deep an indenter that is smaller than the faces may be begins in the body, mm; negative where it begins outside."""
    triangles = triangles_of_faces(boundary_faces(mesh).faces)
    corners = mesh.points[triangles]
    centre = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    gap = indenter.gap(centre)
    near = gap < reach
    depth = -float(indenter.gap(mesh.points).min())
    if not near.any():
        return depth
    count = int(np.clip(np.ceil(2.0 * reach[near].max() / (0.1 * indenter.geometry.inradius)), 1, 60))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij"))
    inside = i + j <= count
    weights = np.stack([count - i - j, i, j], axis=1)[inside] / count
    return max(depth, *(-float(indenter.gap(weights @ triangle).min()) for triangle in corners[near]))


def _mesh(path: Path, settings: IndentationFile) -> tuple[Mesh, dict[str, str]]:
    solid = settings.solid
    if solid.size_mm is not None:
        edge = solid.element_mm or 0.25 * min(solid.size_mm)
        counts = [max(1, round(s / edge)) for s in solid.size_mm]
        if 6 * np.prod(np.array(counts, dtype=float)) > MOST_CELLS:
            raise InputError(
                f"{path}: [solid] element_mm = {edge:g}: makes more than {MOST_CELLS} tetrahedra; begin with larger ones, which are refined"
            )
        return box(solid.size_mm, counts, cell_type="tetra", centred=False), {}
    file = file_beside(path, solid.mesh or "")
    try:
        return to_tetra(read_mesh(file)), {file.name: sha256(file)}
    except InputError as error:
        raise InputError(f"{path}: [solid] mesh = {solid.mesh!r}: {error}") from error


def _materials(path: Path, settings: IndentationFile, mesh: Mesh) -> tuple[Material, ...]:
    made = [material(t.law, young_modulus=t.young_modulus_kPa, poisson_ratio=t.poisson_ratio) for t in settings.material]
    regions = [t.region for t in settings.material]
    if len(made) == 1 and regions[0] is None:
        return tuple(made * max(len(mesh.region_names), int(mesh.regions.max()) + 1))
    known = ", ".join(mesh.region_names)
    for k, region in enumerate(regions):
        if region is None or region not in mesh.region_names:
            raise InputError(f"{path}: [[material]] number {k + 1} region = {region!r}: is no region of the mesh; it has {known}")
    lacking = next((name for name in mesh.region_names if name not in regions), None)
    if lacking is not None:
        raise InputError(f"{path}: region {lacking!r} of the mesh has no material; add [[material]] with region = {lacking!r}")
    return tuple(made[regions.index(name)] for name in mesh.region_names)


def _indenter(table: PressTable) -> RigidIndenter:
    surface = {"static_friction": table.friction, "kinetic_friction": table.friction}
    if table.shape == "sphere":
        return spherical_indenter(table.centre_mm, table.radius_mm or 0.0, **surface)
    if table.shape == "plate":
        return box_indenter(table.centre_mm, table.size_mm or (), **surface)
    return capsule_indenter(table.centre_mm, table.radius_mm or 0.0, table.length_mm or 0.0, table.axis, **surface)
