"""A gel on a pad of known modulus, pushed unevenly, all forces unknown: exact data of the mesh on which it is identified."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, logarithms
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.primitives import box

SIDE_MM, SD_MM, CELLS = 40.0, 0.1, 5
TRUTH = logarithms(*(np.array([v]) for v in lame_parameters(5.0, 0.45)))


def gel_on_a_pad() -> tuple[Mesh, Zones, FieldLoadCase]:
    """Return cubes, zones, and the exact displacement at 1500 points under an uneven push, called as accurate as 0.1 mm."""
    mesh = box([SIDE_MM] * 3, [CELLS] * 3, centred=False)
    low = mesh.points[mesh.cells].mean(axis=1)[:, 2] < SIDE_MM / 4
    mesh = Mesh.from_arrays(mesh.points, mesh.cells, "hexahedron", regions=low.astype(np.int64), region_names=("gel", "pad"))
    zones = Zones.of(mesh, known={"pad": (10.0, 0.45)})
    x, y, z = mesh.points.T
    moved = np.zeros_like(mesh.points)
    moved[:, 0], moved[:, 2] = 0.01 * z, -3.0 * np.exp(-((x - 20.0) ** 2 + (y - 20.0) ** 2) / 150.0) * (z / SIDE_MM) ** 2
    surface = np.any(np.isclose(mesh.points, 0.0) | np.isclose(mesh.points, SIDE_MM), axis=1)
    points = np.random.default_rng(0).uniform(0.5, SIDE_MM - 0.5, (1500, 3))
    at, loaded = interpolation_operator(mesh, points), np.repeat(np.asarray(surface)[:, None], 3, axis=1)

    def case(vectors: FloatArray) -> FieldLoadCase:
        return FieldLoadCase.of("push", DisplacementField.from_arrays(points, vectors, sd_mm=SD_MM), mesh, loaded=loaded)

    state = FieldModel(mesh, [case(at @ moved)], zones).evaluate(TRUTH, [moved]).states[0]
    return mesh, zones, case(at @ state)
