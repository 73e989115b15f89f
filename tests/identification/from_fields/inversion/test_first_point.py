"""Where a search begins at finite strain: what small strain tells of the surface is kept, as long as it takes to make."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward import loaded_components, sensitivities
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.gauss_newton import first_point
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes

THETA = np.log([4.0, 5.0])


def model() -> FieldModel:
    """Return a cube of 6 cells a side, half of it known, all of its 654 components at the surface sought."""
    mesh = box([30.0] * 3, [6] * 3, centred=False)
    upper = (mesh.points[mesh.cells].mean(axis=1)[:, 2] > 15.0).astype(np.int64)
    mesh = Mesh.from_arrays(mesh.points, mesh.cells, "hexahedron", regions=upper, region_names=("unknown", "known"))
    rng = np.random.default_rng(2)
    points = rng.uniform(0.5, 29.5, (900, 3))
    x, y, z = points.T / 30.0
    moved = np.stack([0.9 * x * z, 0.8 * (y - 0.5) * z, -1.8 * z * (1.0 + 0.2 * x)], axis=1)
    field = DisplacementField.from_arrays(points, moved + 0.02 * rng.standard_normal(moved.shape), sd_mm=0.02)
    surface = np.isin(np.arange(mesh.n_points), boundary_nodes(mesh))
    return FieldModel(
        mesh, [FieldLoadCase.of("push", field, mesh, loaded=surface)], Zones.of(mesh, known={"known": (12.0, 0.45)}), "neo_hookean"
    )


def test_the_hessian_of_small_strain_serves_at_finite_strain(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = first_point(usual := model(), THETA)
    made, of = [0], loaded_components.BoundaryPreconditioner.of

    def counted(*args: object) -> loaded_components.BoundaryPreconditioner:
        made[0] += 1
        return of(*args)  # type: ignore[arg-type]

    def far_from_the_surface(_: object) -> None:
        raise ConvergenceError("measurements next to the loaded nodes do not fix how these move")

    monkeypatch.setattr(sensitivities, "local_preconditioner", far_from_the_surface)
    monkeypatch.setattr(loaded_components.BoundaryPreconditioner, "of", counted)
    found = first_point(here := model(), THETA)
    assert made[0] == 1
    assert len(here.observed[0].unknown) > loaded_components.REFRESHED
    assert here.n_free == pytest.approx(usual.n_free, rel=1e-3)
    assert found.misfit == pytest.approx(expected.misfit, rel=0.02)
    step, other = (m.linearised(p).concentrated(np.eye(2)) for m, p in ((here, found), (usual, expected)))
    np.testing.assert_allclose(step.hessian, other.hessian, rtol=2e-3)
