"""Springs of bisected cubes by closed forms, equations (5) to (11) of the 2008 report :cite:p:`hirai2008` (chapter 4.2)."""

from __future__ import annotations

import numpy as np

from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import simplices
from naibu.mechanics.lattices.model.tetrahedral_springs import mesh_edges, volumetric_lattice
from naibu.meshing.refinement.forest import BisectionForest
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.tables import Cell, Table

LEVELS = 6  # bisections of all cells that are compared
EXACT = 1e-12


def closed_form(level: int, cube_mm: float, young_modulus: float) -> tuple[float, float, float]:
    """Return length (mm), volume (mm^3) and stiffness (mN/mm) of the base edges of a level by (5) and (7) to (11)."""
    size = 2.0 ** -(level // 3) * cube_mm
    length = (np.sqrt(3.0), np.sqrt(2.0), 1.0)[level % 3] * size
    volume = (1.0, 1.0 / 3.0, 1.0 / 3.0)[level % 3] * size**3
    return float(length), volume, float(young_modulus * volume / length**2)


def measured(coarse: Mesh, level: int, young_modulus: float) -> tuple[float, tuple[float, float], tuple[float, float]]:
    """Return length, least and largest volume, and stiffness of the base edges inside a cube from the origin, all of it bisected."""
    forest = BisectionForest.of(coarse)
    for _ in range(level):
        forest.refine(forest.leaves())
    mesh = forest.leaf_mesh().mesh
    lattice, parameters = volumetric_lattice(mesh, density=1.0, young_modulus=young_modulus)
    edges, number = mesh_edges(mesh.cells)
    around = np.bincount(number.ravel(), np.repeat(simplices(mesh).measures, 6), minlength=len(edges))
    ends = mesh.points[edges]
    side = mesh.points.max()
    on_face = ((np.abs(ends) < EXACT * side).all(axis=1) | (np.abs(ends - side) < EXACT * side).all(axis=1)).any(axis=1)
    base = (lattice.lengths > (1.0 - 1e-9) * lattice.lengths.max()) & ~on_face
    volume, stiffness = around[base], parameters.stiffness[base]
    return float(lattice.lengths.max()), (float(volume.min()), float(volume.max())), (float(stiffness.min()), float(stiffness.max()))


def levels_section(coarse: Mesh, cubes: int, young_modulus: float) -> Section:
    """Return closed forms beside what the meshes give, level by level, of a cube of so many cubes of Kuhn's tetrahedra along a side."""
    cube, rows = float(coarse.points.max()) / cubes, list[tuple[Cell, ...]]()
    worst = 0.0
    for level in range(LEVELS + 1):
        length, volume, stiffness = closed_form(level, cube, young_modulus)
        own, volumes, springs = measured(coarse, level, young_modulus)
        off = max(abs(a / b - 1.0) for a, b in ((own, length), *((v, volume) for v in volumes), *((k, stiffness) for k in springs)))
        worst = max(worst, off)
        rows.append((level, length, volume, stiffness, own, volumes[0], volumes[1], springs[0], springs[1]))
    columns = (
        "level", "L, mm", "V, mm³", "K, mN/mm", "mesh: L, mm", "V, least", "V, largest", "K, least, mN/mm", "K, largest, mN/mm",
    )  # fmt: skip
    agreement = "agree to rounding" if worst < EXACT else f"differ by up to {worst:.1e}"
    text = (
        "The edge that is bisected next, the base edge of a level, has a length, a volume of tetrahedra around it and hence a stiffness in "
        f"closed form, (5) to (11). Beside them, what a block of {cubes} x {cubes} x {cubes} cubes gives, bisected everywhere: they "
        f"{agreement}. On the surface part of the volume, and of the stiffness, is missing. Damping (6) follows from stiffness and "
        "masses.",
    )
    return Section("Springs by level", text, (Table("(5) to (11)", columns, tuple(rows), caption="Base edges inside the body."),))
