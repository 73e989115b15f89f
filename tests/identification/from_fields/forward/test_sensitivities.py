"""Displacement of loaded nodes in the sensitivities: rough solutions, warm starts, and when its Hessian is made anew."""

from __future__ import annotations

import numpy as np
import pytest
from gel_on_a_pad import SD_MM, TRUTH, gel_on_a_pad

from naibu.core.progress import ProgressReport
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised
from naibu.identification.from_fields.inversion.gauss_newton import first_point


def test_hessians_err_by_the_square_of_what_is_left_of_the_loaded_components() -> None:
    """With the preconditioner of a softer, more compressible body; beside residuals of 1e-10."""
    mesh, zones, case = gel_on_a_pad()
    model = FieldModel(mesh, [case], zones)
    states = first_point(model, np.log([1.0, 2.0])).states
    at = model.linearised(model.evaluate(TRUTH, states))
    exact, rougher, rough = (at.concentrated(np.eye(2), tolerance) for tolerance in (1e-10, 1e-2, 1e-3))
    first = np.abs(rough.response[0] - exact.response[0]).max() / np.abs(exact.response[0]).max()
    assert first > 1e-4
    errors = [np.abs(found.hessian / exact.hessian - 1.0).max() for found in (rougher, rough)]
    assert errors[1] < min(errors[0] / 20.0, 2e-4)
    assert np.abs(rough.gradient - exact.gradient).max() < 1e-3 * np.sqrt(np.diag(exact.hessian)).min()  # of its standard deviation
    near = at.concentrated(np.eye(2), 1e-2, exact.response)
    assert near.response[0] == pytest.approx(exact.response[0], abs=1e-6 * np.abs(exact.response[0]).max())


def test_many_columns_are_solved_with_a_hessian_made_at_their_own_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """With that of an earlier point each of hundreds of columns took tens of iterations, and maps of 250 cells longer than those of 700."""
    mesh, _, case = gel_on_a_pad()
    zones = Zones.of(mesh, known={"pad": (10.0, 0.45)}, each_cell=True)
    model = FieldModel(mesh, [case], zones)
    states = first_point(model, np.repeat(np.log([1.0, 2.0]), zones.count)).states
    at = model.linearised(model.evaluate(np.repeat(TRUTH, zones.count), states))
    solutions: list[int] = []
    product = Linearised._loaded_product
    monkeypatch.setattr(Linearised, "_loaded_product", lambda one, b: solutions.append(b[0].shape[1]) or product(one, b))
    at.concentrated(np.eye(2 * zones.count))
    assert len(solutions) <= 2


def test_the_first_surface_of_finite_strain_takes_one_hessian_of_the_loaded_components(monkeypatch: pytest.MonkeyPatch) -> None:
    """That of small strain was made for a single column, and was a poor preconditioner at finite strain."""
    mesh, zones, case = gel_on_a_pad()
    model = FieldModel(mesh, [case], zones, "neo_hookean")
    made: list[ProgressReport] = []
    model.progress = lambda report: made.append(report) if "follows its surface" in report.stage else None
    point = first_point(model, TRUTH)
    assert [report.done for report in made] == [0, 256]
    assert np.abs(point.states[0] - first_point(FieldModel(mesh, [case], zones), TRUTH).states[0]).max() < 0.1 * SD_MM + 0.05
    assert model.n_free < model.n_data
