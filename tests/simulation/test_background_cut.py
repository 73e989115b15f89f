"""Cuts that open some time after the blade has passed."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics import Assembler, elements, material
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicSession, DynamicState
from naibu.meshing import box, to_tetra
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.simulation import FiniteElementBody
from naibu.simulation.cuts.background_cut import BackgroundCut

SIZE = 40.0  # mm


def gel() -> FiniteElementBody:
    """A soft, nearly incompressible cube that is held at its floor, without weight."""
    mesh = to_tetra(box((SIZE,) * 3, (4, 4, 4)))
    law = material(young_modulus=10.0, poisson_ratio=0.49)
    assembler = Assembler.from_materials(elements(mesh, "mean_dilatation"), mesh.regions, [law])
    z = mesh.points[:, 2]
    return FiniteElementBody.of(mesh, assembler, supported=np.flatnonzero(z < z.min() + 1e-9), background=False)


def squeezed(points: FloatArray, part: float) -> FloatArray:
    """Displacements that make a cube lower by a part of its height, and wider by none, mm."""
    out = np.zeros_like(points)
    out[:, 2] = -part * (points[:, 2] - points[:, 2].min())
    return out


@pytest.mark.parametrize("part", [0.3, 0.6])
def test_a_body_that_is_at_rest_again_when_its_cut_opens_stays_there(part: float) -> None:
    """As where a tool squeezed it when the blade passed, and has been lifted since: its way from then would fling the body."""
    body = gel()
    still = np.zeros_like(body.points)
    cutting = BackgroundCut(body)
    high = body.points.max(axis=0) + 5.0
    edges = [[[0.9, y, high[2]], [0.9, y, 0.4]] for y in (-high[1], high[1])]
    cutting.prepare(DynamicState(squeezed(body.points, part), still), swept_blade(edges), None)
    behind, state = cutting.result(DynamicState(still, still))
    assert behind.mesh.n_points > body.mesh.n_points
    np.testing.assert_array_equal(state.displacement, 0.0)
    with behind.session() as session:
        session.press(())
        session.restore(state)
        session.step(behind.grip_velocity(np.zeros(3)), [], steps=3)
        assert np.abs(session.state().displacement).max() < 1e-6 * SIZE


def test_a_body_that_is_where_it_was_when_the_blade_passed_opens_in_the_balance_that_was_found() -> None:
    body = gel()
    away = np.zeros_like(body.points)
    height = body.points[:, 2] - body.points[:, 2].min()
    away[:, 0] = 6.0 * (height / SIZE) ** 2
    state = DynamicState(away, np.zeros_like(away))
    cutting = BackgroundCut(body)
    high = body.points.max(axis=0) + 5.0
    edges = [[[x, 0.7, high[2]], [x, 0.7, 0.4]] for x in (-high[0], high[0])]
    found = cutting.prepare(state, swept_blade(edges), None)
    behind, opened = cutting.result(state)
    forces = [np.abs(behind.engine.assembler.forces(u)[1]) for u in (found.nodal(away), opened.displacement)]
    free = np.setdiff1d(np.arange(behind.mesh.n_points), behind.supported)
    assert forces[1][free].sum() < forces[0][free].sum()
    assert cutting._made is not None
    np.testing.assert_array_equal(opened.displacement, found.nodal(away) + cutting._made[2])


def test_a_balance_that_newtons_method_does_not_find_is_soon_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a tool squeezed the body: shorter and shorter parts of a step took seconds, and found none either."""
    tries: list[float] = []
    monkeypatch.setattr(DynamicSession, "_found", lambda _, step, guess: tries.append(step.duration))
    body = gel()
    still, cutting, high = np.zeros_like(body.points), BackgroundCut(body), body.points.max(axis=0) + 5.0
    edges = [[[x, 0.7, high[2]], [x, 0.7, 0.4]] for x in (-high[0], high[0])]
    found = cutting.prepare(DynamicState(still, still), swept_blade(edges), None)
    assert 0 < len(tries) <= 4 and min(tries) >= 0.05 * body.step_s
    np.testing.assert_array_equal(cutting.result(DynamicState(still, still))[1].displacement, found.nodal(still))
