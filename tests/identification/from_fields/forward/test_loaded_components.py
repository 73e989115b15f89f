"""The sought motion of a surface: what measurements determine of it, and what its systems are solved with."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward import loaded_components
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.loaded_components import (
    BoundaryPreconditioner,
    _Cholesky,
    _trace_of_prior,
    conjugate_gradients,
)
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, logarithms
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.linear_algebra.direct import pardiso_library
from naibu.meshing.primitives import box
from naibu.meshing.surface import boundary_nodes


def test_the_trace_by_random_signs_is_that_of_the_inverse_within_a_few_components(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a chain of 400 springs between nodes that are measured more or less well."""
    n, rng = 400, np.random.default_rng(2)
    prior = sp.diags([-np.ones(n - 1), np.r_[1.0, np.full(n - 2, 2.0), 1.0], -np.ones(n - 1)], [-1, 0, 1]).tocsr()
    hessian = prior.toarray() + np.diag(rng.uniform(0.1, 10.0, n))
    factor = _Cholesky(sl.cho_factor(hessian))
    exact = float(np.trace(prior.toarray() @ np.linalg.inv(hessian)))
    assert _trace_of_prior(factor, prior) == pytest.approx(exact, rel=1e-10)
    monkeypatch.setattr(loaded_components, "EXACT_TRACE", 0)
    assert _trace_of_prior(factor, prior) == pytest.approx(exact, abs=0.01 * n)


def beside_a_plate(cell_type: str, points: int = 500, *, whole: bool = True) -> Linearised:
    """Return half a cube of 10 kPa under half a cube of 3000 kPa, forces unknown at top and bottom or all around, at these moduli."""
    layers = [("gel", 15.0), ("plate", 15.0)]
    mesh: Mesh = box([30.0] * 3, [4] * 3, layers=layers, centred=False, cell_type=cell_type)
    rng = np.random.default_rng(3)
    at = rng.uniform(0.5, 29.5, (points, 3))
    field = DisplacementField.from_arrays(at, 0.02 * rng.standard_normal(at.shape), sd_mm=0.02)
    z = mesh.points[:, 2]
    surface = np.isin(np.arange(mesh.n_points), boundary_nodes(mesh)) if whole else (z < 1e-9) | (z > 30.0 - 1e-9)
    case = FieldLoadCase.of("push", field, mesh, loaded=surface)
    model = FieldModel(mesh, [case], Zones.of(mesh, known={"gel": (10.0, 0.45)}))
    lame, shear = (np.array([value]) for value in lame_parameters(3000.0, 0.35))
    return model.linearised(model.evaluate(logarithms(lame, shear), [np.zeros_like(model.points)]))


@pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")
@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra"])
def test_equilibrium_as_a_constraint_tells_what_the_response_to_every_component_tells(
    cell_type: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = beside_a_plate(cell_type)
    full = BoundaryPreconditioner.of(at, 0)
    signs = np.random.default_rng(5).choice([-1.0, 1.0], size=(len(at.model.observed[0].unknown), 4))
    monkeypatch.setattr(loaded_components, "DENSE", 0)
    sparse = BoundaryPreconditioner.of(at, 0)
    expected = full.factor.solve(signs)
    np.testing.assert_allclose(sparse.factor.solve(signs), expected, atol=1e-5 * np.abs(expected).max())
    assert sparse.informed == pytest.approx(full.informed, abs=0.02 * len(signs))
    product = at.product(np.zeros((2, 4)), [expected])[1][0]
    np.testing.assert_allclose(product, signs, atol=1e-6)


@pytest.mark.parametrize("dense", [0, 1600])
def test_one_point_does_not_fix_how_two_plates_move(dense: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Hessian is singular; that a factorization tells it hung on rounding."""
    monkeypatch.setattr(loaded_components, "DENSE", dense)
    with pytest.raises(ConvergenceError, match="does not fix how the loaded nodes move"):
        BoundaryPreconditioner.of(beside_a_plate("hexahedron", points=1, whole=False), 0)


def test_iterations_end_where_a_new_preconditioner_costs_less() -> None:
    """A matrix of the condition 1000 takes a hundred iterations without a preconditioner, at the cost of a thousand of one column."""
    diagonal = np.geomspace(1.0, 1e3, 300)[:, None]
    right = [np.ones((300, 2))]

    def solved(anew: float) -> loaded_components.Solved:
        return conjugate_gradients(lambda x: [diagonal * x[0]], lambda r: r, right, 1e-5, anew=anew)

    whole, ended = solved(np.inf), solved(300.0)
    assert whole.complete
    assert whole.iterations > 100
    np.testing.assert_allclose(whole.solution[0], right[0] / diagonal, atol=1e-4)
    assert not ended.complete
    assert ended.iterations < 20


@pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")
@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra"])
def test_a_system_of_this_point_tells_the_quadratic_in_moduli_that_conjugate_gradients_tell(
    cell_type: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And that the response to every component tells; the body is bent, so that moduli matter."""
    still = beside_a_plate(cell_type)
    bent = 0.01 * still.model.points[:, [2, 0, 1]] ** 2 / 30.0
    at = still.model.linearised(still.model.evaluate(still.point.theta, [bent]))
    expected = at.concentrated(np.eye(2))
    monkeypatch.setattr(loaded_components, "DENSE", 0)
    at.model.boundary.forget()
    by_gradients = at._by_gradients(np.eye(2), 1e-9, None)
    monkeypatch.setattr(Linearised, "_by_gradients", None)
    found = at.concentrated(np.eye(2))
    scale = np.sqrt(np.diag(expected.hessian))
    for other in (expected, by_gradients):
        np.testing.assert_allclose(found.hessian / np.outer(scale, scale), other.hessian / np.outer(scale, scale), atol=1e-6)
        np.testing.assert_allclose(found.gradient / scale, other.gradient / scale, atol=1e-5 * np.abs(expected.gradient / scale).max())
        np.testing.assert_allclose(found.response[0], other.response[0], atol=1e-4 * np.abs(expected.response[0]).max())
        np.testing.assert_allclose(found.offset[0], other.offset[0], atol=1e-4 * np.abs(expected.offset[0]).max())
