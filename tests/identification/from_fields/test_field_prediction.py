"""The inside of a body as it follows from its surface, at finite strain and near incompressibility."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.identified.field_prediction import predict_inside, predict_moved_sides
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.meshing.primitives import box

SIDE_MM, NOISE_MM = 40.0, 0.05


def gel(poisson_ratio: float) -> IdentifiedBody:
    """Return a cube of one gel, 5 kPa."""
    mesh = box((SIDE_MM,) * 3, (6, 6, 6), centred=False, cell_type="hexahedron")
    shear = 5.0 / (2.0 * (1.0 + poisson_ratio))
    bulk_over_shear = 2.0 * (1.0 + poisson_ratio) / (3.0 * (1.0 - 2.0 * poisson_ratio))
    whole = sp.csr_matrix(np.ones((mesh.n_cells, 1)))
    return IdentifiedBody(
        mesh, np.eye(3), ("gel",), whole, np.log([shear, bulk_over_shear]), 1e-4 * np.eye(2), (), np.full(mesh.n_cells, -1), "neo_hookean",
        False, NOISE_MM, 1.0, 0.2, ("pressed",),
    )  # fmt: skip


@pytest.mark.parametrize("push_mm", [-8.0, -12.0])
def test_a_body_that_is_nearly_incompressible_follows_a_surface_that_moves_far(push_mm: float) -> None:
    """Whole Gauss-Newton steps turn its cells inside out."""
    body = gel(0.4995)
    true = predict_moved_sides(body, {"z-": (0.0, 0.0, 0.0), "z+": (0.0, 0.0, push_mm)})
    rng = np.random.default_rng(0)
    points = rng.uniform(0.3, SIDE_MM - 0.3, (700, 3))
    u = true.at(points)[0] + NOISE_MM * rng.standard_normal(points.shape)
    found, inner = predict_inside(body, DisplacementField.from_arrays(points, u, sd_mm=NOISE_MM))
    error = found.at(points[inner])[0] - true.at(points[inner])[0]
    assert float(np.sqrt((error**2).mean())) < 2.0 * NOISE_MM
    held = np.abs(found.displacement - true.displacement) < 1.96 * found.standard_deviation
    assert float(held.mean()) > 0.93
