"""Steps with a Hessian from near by: SciPy's BFGS, exact gradients, and where searches with exact Hessians end."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import BFGS

from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Linearised, Point, logarithms
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, Objective, first_point, search
from naibu.identification.from_fields.inversion.kept_hessian import DAMPED, KeptHessian, gradient_of_moduli, updated
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.reproduction.chapter3.bodies import LAYERS, cube


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.integers(1, 6))
def test_updates_are_those_of_damped_bfgs(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((size + 2, size))
    hessian, step, change = root.T @ root, rng.standard_normal(size), rng.standard_normal(size)
    other = BFGS(exception_strategy="damp_update", min_curvature=DAMPED, init_scale=1.0)
    other.initialize(size, "hess")
    other.update(np.ones(size), np.ones(size))  # SciPy scales at its first update
    other.B = np.triu(hessian)
    other.update(step, change)
    found = updated(hessian, step, change)
    assert found == pytest.approx(other.get_matrix(), rel=1e-8, abs=1e-8 * np.abs(found).max())
    assert np.linalg.eigvalsh(found).min() > 0.0


@cache
def layers() -> tuple[FieldModel, Point]:
    """The cube of two unknown layers, measured with noise, and a start off by factors of up to 2."""
    body = cube(LAYERS, pushes=((0.0, 0.0, -10.0), (7.0, 0.0, -7.0)))
    model = FieldModel(body.mesh, body.load_cases(sd_mm=0.05, seed=3), body.zones(), elements="as_given")
    truth = logarithms(*np.array([lame_parameters(*layer) for layer in LAYERS.values()]).T)
    return model, first_point(model, truth + np.array([0.7, -0.6, 0.3, 0.2]))


def test_gradients_are_those_with_the_whole_hessian() -> None:
    model, start = layers()
    here = model.evaluate(start.theta, [u * 1.02 for u in start.states])  # where the loaded nodes are not at their optimum
    at = model.linearised(here)
    whole = at.concentrated(np.eye(4))
    gradient, offset = gradient_of_moduli(at)
    assert gradient == pytest.approx(whole.gradient, rel=1e-4)
    for found, expected in zip(offset, whole.offset, strict=True):
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_searches_end_where_those_with_exact_hessians_do_with_fewer_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    model, start = layers()
    made, concentrated = [0], Linearised.concentrated

    def counted(self: Linearised, *arguments: Any) -> Concentrated:
        made[0] += 1
        return concentrated(self, *arguments)

    monkeypatch.setattr(Linearised, "concentrated", counted)
    exact = search(model, model.evaluate(start.theta, start.states), Objective(bounds=Bounds()))
    of_exact, made[0] = made[0], 0
    kept = search(model, model.evaluate(start.theta, start.states), Objective(bounds=Bounds()), rule=KeptHessian())
    assert 1 <= made[0] < of_exact
    there = model.linearised(model.evaluate(exact.point.theta, exact.point.states))
    sd = np.sqrt(np.diag(np.linalg.inv(concentrated(there, np.eye(4)).hessian)))
    assert (np.abs(kept.point.theta - exact.point.theta) < 0.05 * sd).all()
    assert kept.objective == pytest.approx(exact.objective, abs=1e-2)


def test_a_hessian_that_leads_nowhere_is_made_anew() -> None:
    """That of a quadratic that has nothing to do with the data: 10^4 times too flat in some directions, or too steep."""
    model, start = layers()
    exact = search(model, model.evaluate(start.theta, start.states), Objective(bounds=Bounds()))
    here = model.evaluate(start.theta, start.states)
    right = model.linearised(here).concentrated(np.eye(4))
    for scale in (1e-4, 1e2):
        wrong = replace(right, hessian=scale * right.hessian)
        here = model.evaluate(start.theta, start.states)
        found = search(model, here, Objective(bounds=Bounds()), rule=KeptHessian(start.theta, wrong))
        assert found.objective == pytest.approx(exact.objective, abs=0.05)
