"""Where a search begins at finite strain: what small strain tells of the surface is kept, as long as it takes to make."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward import loaded_components, sensitivities
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.gauss_newton import Objective, first_point, search
from naibu.meshing.point_location import interpolation_operator
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


def test_a_smoothed_field_whose_best_surface_no_body_follows_starts_from_a_smoother_one() -> None:
    """Windows cut at the border of a field bend it there; the ends of the body, beyond its points, magnify that many times."""
    mesh = box([40.0] * 3, [6] * 3, centred=False)
    low = (mesh.points[mesh.cells].mean(axis=1)[:, 2] < 15.0).astype(np.int64)
    mesh = Mesh.from_arrays(mesh.points, mesh.cells, "hexahedron", regions=low, region_names=("gel", "pad"))
    zones, truth = Zones.of(mesh, known={"pad": (10.0, 0.45)}), np.log([5.0 / 2.9, 29.0 / 3.0])
    bottom, top = mesh.points[:, 2] < 1e-9, mesh.points[:, 2] > 40.0 - 1e-9
    along = np.linspace(6.63, 33.37, 11)
    grid = np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1)
    points = grid.reshape(-1, 3)

    def seen(vectors: FloatArray) -> FieldModel:
        field = DisplacementField.from_arrays(points, vectors, sd_mm=0.004)
        return FieldModel(mesh, [FieldLoadCase.of("push", field, mesh, loaded=bottom | top)], zones, "neo_hookean", elements="as_given")

    moved = np.where(top[:, None], [1.0, 0.0, -6.0], 0.0)
    exact = interpolation_operator(mesh, points) @ seen(np.ones_like(points)).from_rest(truth, [moved])[0]
    smoothed = gaussian_filter(exact.reshape(grid.shape), (1.0, 1.0, 1.0, 0.0), mode="nearest")
    model = seen(smoothed.reshape(-1, 3))
    found = search(model, first_point(model, truth), Objective())
    np.testing.assert_allclose(found.point.theta, truth, atol=0.1)
