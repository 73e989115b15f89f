"""Equilibrium of bodies whose surface moves as measured."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError
from naibu.identification.from_fields.forward import forward_model
from naibu.identification.from_fields.forward.field_laws import field_law
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_strain.newton import Newton
from naibu.meshing.primitives import box


def test_where_there_is_no_equilibrium_it_is_not_sought_at_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cube whose top is pushed through its bottom: by continuation that was sought for hundreds of iterations, again and again."""
    mesh = box([40.0] * 3, [3] * 3, centred=False)
    law = field_law(mesh, "neo_hookean", averaged=True)
    lame, shear = (np.full(mesh.n_cells, value) for value in lame_parameters(10.0, 0.45))
    top = mesh.points[:, 2] > 39.0
    pushed = np.where(top[:, None], [0.0, 0.0, -60.0], 0.0)
    field = DisplacementField.from_arrays(mesh.points, pushed, sd_mm=0.1)
    case = FieldLoadCase.of("push", field, mesh, loaded=top | (mesh.points[:, 2] < 1.0))
    tried = []

    def noted(newton: Newton, *given: object) -> None:
        tried.append(newton.iterations)

    monkeypatch.setattr(Newton, "_pseudo_step", noted)
    with pytest.raises(ConvergenceError):
        forward_model.settled(law, forward_model.Solvers(law, mesh.points), mesh.points, lame, shear, case, pushed)
    assert not tried


def test_the_tangent_of_a_point_near_by_leads_to_the_same_equilibrium_with_one_factorization(monkeypatch: pytest.MonkeyPatch) -> None:
    """And none where moduli and displacement are those of the point before."""
    mesh = box([40.0] * 3, [4] * 3, centred=False)
    law = field_law(mesh, "neo_hookean", averaged=True)
    lame, shear = (np.full(mesh.n_cells, value) for value in lame_parameters(10.0, 0.45))
    top = mesh.points[:, 2] > 39.0
    pushed = mesh.points[:, 2:] / 40.0 * [1.0, 0.0, -4.0]
    field = DisplacementField.from_arrays(mesh.points, pushed, sd_mm=0.1)
    case = FieldLoadCase.of("push", field, mesh, loaded=top | (mesh.points[:, 2] < 1.0))
    solvers, made = forward_model.Solvers(law, mesh.points), []
    anew = solvers._anew
    monkeypatch.setattr(solvers, "_anew", lambda *given: made.append(1) or anew(*given))
    u, _ = forward_model.equilibrium(law, solvers, lame, shear, case, pushed, b"")
    made.clear()
    forward_model.equilibrium(law, solvers, lame, shear, case, u, b"")
    assert not made
    stiffer = np.where(mesh.points[mesh.cells].mean(axis=1)[:, 0] > 20.0, 1.1, 1.0)
    near, factor = forward_model.equilibrium(law, solvers, stiffer * lame, stiffer * shear, case, u, b"")
    assert len(made) == 1
    other = forward_model.Solvers(law, mesh.points)
    expected, tangent = forward_model.equilibrium(law, other, stiffer * lame, stiffer * shear, case, u, b"")
    np.testing.assert_allclose(near, expected, atol=1e-8)
    np.testing.assert_allclose(factor.solve(u.ravel()), tangent.solve(u.ravel()), rtol=1e-6, atol=1e-9)
