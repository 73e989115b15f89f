"""A gel with a stiff lump under a plate that is known and as good as rigid: moduli below are told as multiples of each other only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes
from naibu.validation.specimens.quadratic_body import Inclusion, QuadraticBody

PLATE_KPA, GEL_KPA, LUMP_KPA = 3000.0, 10.0, 30.0


def gel_under_a_plate() -> tuple[Mesh, Zones, FieldLoadCase]:
    """Return coarse cubes, zones, and 600 noisy points of the body's middle, the motion of the whole surface of which is sought."""
    lump = Inclusion((22.0, 18.0, 10.0), 6.5, LUMP_KPA, 0.45)
    body = QuadraticBody("cube", unknown=(GEL_KPA, 0.45), known=(PLATE_KPA, 0.35), inclusions=(lump,)).solved((1.0, 0.0, -3.0), divisions=6)
    side = 40.0 / 6
    mesh = box((40.0, 40.0, 4 * side), (6, 6, 4), layers=[("gel", 2 * side), ("plate", 2 * side)], centred=False, cell_type="hexahedron")
    mesh = replace(mesh, points=mesh.points + np.array([0.0, 0.0, side]))
    regions = np.where(lump.holds(mesh.points[mesh.cells].mean(axis=1)), 2, mesh.regions)
    mesh = replace(mesh, regions=regions, region_names=("gel", "plate", "lump"))
    rng = np.random.default_rng(0)
    some = rng.uniform(0.02, 0.98, (1200, 3))
    height = 40.0 * some[:, 2]
    points, u = body.at(some[(height > side + 0.1) & (height < 5 * side - 0.1)][:600])
    sd = 0.01 * float(np.linalg.norm(u, axis=1).max())
    field = DisplacementField.from_arrays(points, u + sd * rng.standard_normal(u.shape), sd_mm=sd)
    loaded = np.zeros(mesh.n_points, dtype=bool)
    loaded[boundary_nodes(mesh)] = True
    case = FieldLoadCase.of("push", field, mesh, loaded=loaded)
    return mesh, Zones.of(mesh, known={"plate": (PLATE_KPA, 0.35)}), case
