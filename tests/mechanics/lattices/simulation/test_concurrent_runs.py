"""Python threads that step one engine, or several, at once: the results are those of one after the other, to the last bit."""

from __future__ import annotations

from collections.abc import Callable
from threading import Barrier, Thread

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.mechanics.contact.rigid_indenters import plane_indenter, spherical_indenter
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.simulation.contact import push

LATTICE = classic_lattice(box_mask((9, 9, 8)), 5.0, total_mass_kg=0.3)
TOP = ConstrainedNodes.of(np.flatnonzero(LATTICE.points[:, 2] > 39.0))
INDENTERS = [plane_indenter((0.0, 0.0, 0.0), static_friction=0.4, kinetic_friction=0.3), spherical_indenter((22.0, 22.0, 50.1), 10.0)]


def engine(stiffness: float = 20.0) -> LatticeEngine:
    return LatticeEngine.of(LATTICE, lattice_parameters(LATTICE, stiffness, 2.0, 50.0))


def run(made: LatticeEngine) -> tuple[FloatArray, FloatArray]:
    motion = made.run(made.rest(), 150, TOP, [[3.0, 0.0, -20.0]])
    return motion.state.position, motion.reaction


def press(made: LatticeEngine) -> tuple[FloatArray, FloatArray]:
    motion = push(made, made.rest(), INDENTERS, [[0.0, 0.0, 0.0], [5.0, 0.0, -30.0]], steps=60)
    return motion.state.position, motion.reaction


Job = Callable[[LatticeEngine], tuple[FloatArray, FloatArray]]


@pytest.mark.parametrize("jobs", [(run, run), (run, press), (press, press)], ids=["runs", "run and contact", "contacts"])
@pytest.mark.parametrize("shared", [True, False], ids=["one engine", "two engines"])
def test_threads_do_not_disturb_one_another(jobs: tuple[Job, Job], shared: bool) -> None:
    engines = [engine()] * 2 if shared else [engine(), engine(35.0)]
    expected = [job(made) for job, made in zip(jobs, engines, strict=True)]
    found: list[tuple[FloatArray, FloatArray] | None] = [None, None]
    together = Barrier(2)

    def work(k: int) -> None:
        together.wait()
        found[k] = jobs[k](engines[k])

    threads = [Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for ours, sequential in zip(found, expected, strict=True):
        assert ours is not None
        np.testing.assert_array_equal(ours[0], sequential[0])
        np.testing.assert_array_equal(ours[1], sequential[1])


def test_runs_of_different_engines_wait_for_no_lock() -> None:
    """A run that another engine's run is in the way of would never begin while that one is stopped halfway."""
    first, second = engine(), engine(35.0)
    with first.scratch() as held:
        assert held is not None
        position, _ = run(second)
        inner, _ = run(first)
    np.testing.assert_array_equal(position, run(second)[0])
    np.testing.assert_array_equal(inner, run(first)[0])
