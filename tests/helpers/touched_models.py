"""Bodies of each kind to be touched, whose runs are repeatable: tangents are renewed by the steps, not by a thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from touched_lattice import touched_lattice

from naibu.core.mesh import Mesh
from naibu.mechanics import Assembler, elements, material, plane_indenter
from naibu.meshing import box, half_ellipsoid
from naibu.meshing.element_conversion import to_tetra
from naibu.simulation import FiniteElementBody
from naibu.simulation.interactive_bodies import NO_NODES
from naibu.workflows import TouchableModel
from naibu.workflows.interactive.touchable_models import touchable


def repeatable(model: TouchableModel) -> TouchableModel:
    """Return a model whose tangents no thread renews."""
    body = model.body
    return (
        replace(model, body=replace(body, engine=replace(body.engine, background=False))) if isinstance(body, FiniteElementBody) else model
    )


def small_lattice() -> TouchableModel:
    """Return a cube of 5^3 nodes that is held at its lowest ones."""
    return TouchableModel("Lattice", (), touched_lattice(), "mean elongation, %")


def large_lattice() -> TouchableModel:
    """Return a cube of 17^3 nodes that is held at its lowest ones."""
    return TouchableModel("Lattice", (), touched_lattice(16, 5.0), "mean elongation, %")


def small_gel() -> TouchableModel:
    """Return a nearly incompressible block of tetrahedra on a table, under its weight."""
    mesh = to_tetra(box((40.0, 40.0, 40.0), (4, 4, 4)))
    return _of_mesh(mesh, 0.49, False)


def small_mesh() -> TouchableModel:
    """Return half an ellipsoid of tetrahedra of random shapes that is held below."""
    mesh = to_tetra(half_ellipsoid((50.0, 40.0, 30.0), 10.0))
    return _of_mesh(mesh, 0.45, True)


def _of_mesh(mesh: Mesh, poisson_ratio: float, held: bool) -> TouchableModel:
    law = material(young_modulus=10.0, poisson_ratio=poisson_ratio)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    z = mesh.points[:, 2]
    lowest = np.flatnonzero(z < z.min() + 1e-6).astype(np.int64)
    table = plane_indenter((0.0, 0.0, float(z.min())), static_friction=0.5, kinetic_friction=0.5)
    body = FiniteElementBody.of(
        mesh, assembler, supported=lowest if held else NO_NODES, fixtures=() if held else (table,),
        gravity=(0.0, 0.0, 0.0 if held else -9810.0), background=False,
    )  # fmt: skip
    return TouchableModel("Gel", (), body, "equivalent strain, %")


MODELS: dict[str, Callable[[], TouchableModel]] = {
    "lattice": small_lattice,
    "gel": small_gel,
    "mesh": small_mesh,
    "demo": lambda: repeatable(touchable("demo")),
    "demo-threads": lambda: touchable("demo"),
    "dough": lambda: touchable("dough-pressed-by-sphere"),
    "dough-held": lambda: touchable("dough-first-pushing"),
    "cube": large_lattice,
    "octree": lambda: touchable("cube-pushing-octree-1"),
}
