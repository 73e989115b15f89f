"""Operations on vectors of numbers agree with NumPy's."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

ROOTS = """
import numpy as np
from naibu._numba.compilation import njit
from naibu._numba.intrinsics.simd import WIDTH, inverse_root, load, store

@njit
def roots(x, y):
    for i in range(0, len(x), WIDTH):
        store(y, i, inverse_root(load(x, i)))

for kind in (np.float64, np.float32):
    x = np.exp(np.random.default_rng(0).uniform(-60.0, 80.0, 80_000)).astype(kind)
    y = np.empty_like(x)
    roots(x, y)
    exact = 1.0 / np.sqrt(x.astype(np.longdouble))
    print(float(np.abs(y / exact - 1.0).max() / np.finfo(kind).eps))
"""


@pytest.mark.parametrize("processor", ["this", "generic"])  # the former may estimate roots by an instruction of its own
def test_inverse_roots_are_right_to_rounding_on_every_kind_of_processor(processor: str) -> None:
    surroundings = {**os.environ, **({"NUMBA_CPU_NAME": "generic"} if processor == "generic" else {})}
    done = subprocess.run([sys.executable, "-c", ROOTS], capture_output=True, text=True, check=True, env=surroundings)
    double, single = (float(line) for line in done.stdout.split())
    assert double < 2.0
    assert single < 2.0
