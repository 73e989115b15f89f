"""Kernels that flush subnormal numbers get zeros of them, and leave the thread as it was."""

from __future__ import annotations

import numpy as np
import pytest

from naibu._numba.compilation import njit
from naibu._numba.intrinsics import _control_register
from naibu._numba.intrinsics.subnormals import FLUSHES, flush_subnormals, restore
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, explicit_step_limit

LEAST = np.finfo(np.float32).tiny


@njit
def tenths(numbers):  # type: ignore[no-untyped-def]
    before = flush_subnormals()
    for i in range(len(numbers)):
        numbers[i] *= np.float32(0.1)
    restore(before)


@pytest.mark.skipif(not FLUSHES, reason="not on this processor or version of Numba")
def test_subnormal_results_and_operands_are_zeros_within_the_kernel_only() -> None:
    numbers = np.array([2 * LEAST, 0.5 * LEAST, 20 * LEAST, 1.0], dtype=np.float32)
    tenths(numbers)
    assert numbers[:2].tolist() == [0, 0] and numbers[2:] == pytest.approx([2 * LEAST, 0.1])
    assert 0 < np.float32(2 * LEAST) * np.float32(0.1) < LEAST
    assert _control_register.trial()


@pytest.mark.skipif(not FLUSHES, reason="not on this processor or version of Numba")
def test_no_subnormal_numbers_stand_before_a_wave_in_a_lattice() -> None:
    lattice = classic_lattice(box_mask((2, 2, 90)), 1.0, total_mass_kg=0.01)
    parameters = lattice_parameters(lattice, 0.03, 0.002, 0.003)
    ends = ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 2] > 89.5), 0)
    engine = LatticeEngine.of(
        lattice, parameters, step=0.05 * explicit_step_limit(lattice, parameters), method="euler", precision="single", threads=1
    )
    speed = np.abs(engine.run(engine.rest(), 30, ends, np.array([[0.0, 0.0, -1e-30]])).state.velocity)
    assert (speed > 0).any() and not ((speed > 0) & (speed < LEAST)).any()
