"""Small bodies and problems shared by the tests of mechanics."""

import numpy as np

from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import Material, material
from naibu.mechanics.finite_strain.problem import Problem
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.meshing.element_conversion import to_quadratic, to_tetra
from naibu.meshing.primitives import box

KINDS = ("hexahedron", "tetra", "tetra10")
SHAPES = {"mooney_rivlin": (0.3,), "yeoh": (0.2, 0.05)}
GEL = material(young_modulus=20.0, poisson_ratio=0.45)


def of(law: str, poisson_ratio: float = 0.45, young_modulus: float = 20.0) -> Material:
    return material(law, young_modulus=young_modulus, poisson_ratio=poisson_ratio, shape=SHAPES.get(law, ()))


def as_kind(mesh: Mesh, kind: str) -> Mesh:
    if kind == "hexahedron":
        return mesh
    return to_tetra(mesh) if kind == "tetra" else to_quadratic(to_tetra(mesh))


def distorted(kind: str, *, size=10.0, divisions=3, amount=0.15, seed=0) -> Mesh:
    """A cube whose corners of cells, inside and on its faces, are shifted by up to `amount` of a cell; edges stay straight."""
    mesh = box((size,) * 3, (divisions,) * 3)
    rng = np.random.default_rng(seed)
    moved = mesh.moved(rng.uniform(-amount, amount, mesh.points.shape) * size / divisions)
    return as_kind(moved, kind)


def assembler(mesh: Mesh, *materials: Material, formulation="mean_dilatation") -> Assembler:
    return Assembler.from_materials(elements(mesh, formulation), mesh.regions, list(materials) or [GEL])


def problem(mesh: Mesh, *materials: Material, contacts=(), prescribed=None, force=None, formulation="mean_dilatation") -> Problem:
    table = elements(mesh, formulation)
    pattern = block_pattern(mesh.n_points, table.connectivity, *(c.nodes for c in contacts))
    body = Assembler.from_materials(table, mesh.regions, list(materials) or [GEL], pattern)
    weight = np.zeros(mesh.points.shape) if force is None else force
    return Problem(mesh.points, body, tuple(contacts), prescribed or PrescribedDisplacement.none(mesh.n_points), weight)


def relative(a, b) -> float:
    """Largest difference over the largest magnitude."""
    return float(np.abs(np.asarray(a) - b).max() / np.abs(b).max())
