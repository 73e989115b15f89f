"""Adjoint gradients against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState
from naibu.mechanics.lattices.simulation.adjoint import push_gradient, recorded_push

STEPS = 137


def setting(method, seed=0):
    mask = box_mask((3, 2, 3))
    mask[2, 1, 2] = False
    lattice = classic_lattice(mask, 10.0, total_mass_kg=0.05)
    rng = np.random.default_rng(seed)
    draw = [rng.uniform(low, high, lattice.n_elements) for low, high in ((5.0, 20.0), (0.02, 0.1), (0.1, 0.4))]
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, *draw), step=2e-4, method=method)
    z = lattice.points[:, 2]
    constrained = ConstrainedNodes.of(np.flatnonzero(z < 1.0), 0) + ConstrainedNodes.of(
        np.flatnonzero(z > 29.0), 1, axes=(2, 0), weight=0.8
    )
    path = np.zeros((STEPS, 2, 3))
    path[:90, 1] = (20.0, 0.0, -120.0)
    start = LatticeState(
        lattice.points + 0.1 * rng.normal(size=lattice.points.shape), rng.normal(size=lattice.points.shape), engine.rest().extension
    )
    return engine, start, constrained, path, rng


def value(engine, start, constrained, path, targets, force):
    push = recorded_push(engine, start, [40, 90, STEPS], constrained, path, external_force=[0.1, 0.2, -0.5])
    return 0.5 * ((push.positions - targets) ** 2).sum() + 0.5 * ((push.reaction - force) ** 2).sum() * 1e-4, push


@pytest.mark.parametrize("method", ["euler", "symplectic_euler"])
def test_the_gradient_is_that_of_finite_differences(method):
    engine, start, constrained, path, rng = setting(method)
    targets = engine.lattice.points + rng.normal(size=engine.lattice.points.shape)
    force = rng.normal(size=(STEPS, 2, 3))
    _, push = value(engine, start, constrained, path, targets, force)
    groups = engine.lattice.element_class + 3 * engine.lattice.element_zone
    got = push_gradient(push, push.positions - targets, 1e-4 * (push.reaction - force), groups)
    names = ("stiffness", "voigt_damping", "series_damping")
    for name in names:
        for group in np.unique(groups):
            values = getattr(engine.parameters, name)
            size = 1e-4 * values.mean()
            found = []
            for h in (size, 2.0 * size):
                pair = []
                for sign in (-1.0, 1.0):
                    moved = replace(engine.parameters, **{name: values + sign * h * (groups == group)})
                    other = LatticeEngine.of(engine.lattice, moved, step=engine.step, method=method)
                    pair.append(value(other, start, constrained, path, targets, force)[0])
                found.append((pair[1] - pair[0]) / (2.0 * h))
            exact = (4.0 * found[0] - found[1]) / 3.0  # Richardson: the error is of fourth order
            assert getattr(got, name)[group] == pytest.approx(exact, rel=1e-6)
    for k, name in ((0, "position"), (1, "velocity")):
        direction = rng.normal(size=start.position.shape)
        h = 1e-4
        pair = [
            value(engine, replace(start, **{name: getattr(start, name) + s * h * direction}), constrained, path, targets, force)[0]
            for s in (-1, 1)
        ]
        gradient = (got.start_position, got.start_velocity)[k]
        assert (gradient * direction).sum() == pytest.approx((pair[1] - pair[0]) / (2 * h), rel=1e-6)


def test_one_group_an_element_adds_up_to_the_groups():
    engine, start, constrained, path, rng = setting("symplectic_euler")
    push = recorded_push(engine, start, [STEPS], constrained, path)
    weights = rng.normal(size=push.positions.shape)
    fine = push_gradient(push, weights, groups=np.arange(engine.lattice.n_elements))
    coarse = push_gradient(push, weights)
    for name in ("stiffness", "voigt_damping", "series_damping"):
        sums = np.bincount(engine.lattice.element_class, getattr(fine, name))
        np.testing.assert_allclose(getattr(coarse, name), sums, rtol=1e-9)


def test_a_recorded_push_is_the_run():
    engine, start, constrained, path, _ = setting("euler")
    push = recorded_push(engine, start, [0, STEPS], constrained, path)
    motion = engine.run(start, STEPS, constrained, path)
    np.testing.assert_allclose(push.positions, [start.position, motion.state.position], atol=1e-12)
    np.testing.assert_allclose(push.reaction, motion.reaction, atol=1e-9)


def test_bad_input_is_named():
    engine, start, constrained, path, _ = setting("euler")
    with pytest.raises(InputError, match="explicit"):
        recorded_push(LatticeEngine.of(engine.lattice, engine.parameters), start, [1], constrained, path)
    with pytest.raises(InputError, match="0 to 137"):
        recorded_push(engine, start, [STEPS + 1], constrained, path)
    push = recorded_push(engine, start, [1], constrained, path)
    with pytest.raises(InputError, match="by_position"):
        push_gradient(push, np.zeros((2, 3)))
