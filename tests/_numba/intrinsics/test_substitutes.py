"""Where an interface of Numba is missing, plain substitutes give the same results."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from naibu._numba import versions
from naibu._numba.intrinsics import _atomic_intrinsics, _vectors

RUN = """
import sys
import numpy as np
{}
from naibu._numba.intrinsics.atomics import ATOMIC
from naibu._numba.intrinsics.packed_tuples import PACKED
from naibu._numba.intrinsics.simd import VECTORS, WIDTH
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes

lattice = classic_lattice(box_mask((5, 4, 6)), 5.0, total_mass_kg=0.6)
z = lattice.points[:, 2]
constrained = ConstrainedNodes.of(np.flatnonzero(z < 1), 0) + ConstrainedNodes.of(np.flatnonzero(z > 29), 1)
velocity = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, -30.0]])
engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 10.0, 0.01, 0.02), **{})
made = engine.run(engine.rest(), 40, constrained, velocity)
np.savez(sys.argv[1], made.state.position, made.state.velocity, made.reaction)
print(VECTORS, WIDTH, ATOMIC, PACKED)
"""
UNTESTED = "import numba; numba.__version__ = '0.99.0'"
PACKED_TYPE = "naibu._numba.intrinsics._packed_type"
WITHOUT_INTRINSICS = f"import sys, numba.extending; del numba.extending.intrinsic; sys.modules['{PACKED_TYPE}'] = None"
OTHER_INSTRUCTIONS = f"{UNTESTED}\nfrom llvmlite import ir; del ir.IRBuilder.shuffle_vector; del ir.IRBuilder.load_atomic"
OTHER_RESULTS = f"{UNTESTED}\nfrom numba.core.compiler import CompileResult; del CompileResult._reduce"
ASK = """
{}
from naibu._numba.intrinsics.atomics import ATOMIC
from naibu._numba.compilation import cache_works, njit
from naibu._numba.intrinsics.simd import VECTORS

@njit(cache=True)
def twice(x):
    return 2 * x

print(VECTORS, ATOMIC, cache_works(), twice(4))
"""


def answer(program: str, *arguments: str) -> str:
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"method": "implicit", "step": 2e-3}, marks=pytest.mark.slow),  # compiles all of an implicit step once more
        {"method": "euler", "step": 1e-4, "threads": 3},
    ],
    ids=["implicit", "explicit"],
)
def test_lattices_move_alike_without_vectors_and_atomic_operations(tmp_path: Path, options: dict[str, object]) -> None:
    assert answer(RUN.format("", options), str(tmp_path / "usual.npz")) == "True 8 True True"
    assert answer(RUN.format(WITHOUT_INTRINSICS, options), str(tmp_path / "plain.npz")) == "False 1 False False"
    with np.load(tmp_path / "usual.npz") as usual, np.load(tmp_path / "plain.npz") as plain:
        for name, expected in usual.items():
            np.testing.assert_allclose(plain[name], expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("first", "said"),
    [
        (UNTESTED, "True True True 8"),
        (OTHER_INSTRUCTIONS, "False False True 8"),
        (OTHER_RESULTS, "True True False 8"),
        (WITHOUT_INTRINSICS, "False False True 8"),
    ],
    ids=["all as it was", "other instructions", "other compile results", "no intrinsics"],
)
def test_on_an_untested_version_what_fails_its_trial_is_substituted(first: str, said: str) -> None:
    assert answer(ASK.format(first)) == said


def test_trials_pass_here() -> None:
    assert versions.tested() and _vectors.trial() and _atomic_intrinsics.trial()


def test_a_trial_decides_only_on_an_untested_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing() -> bool:
        raise TypeError("another interface")

    assert versions.passes(failing)
    for version in ("0.58.1", "0.69.0rc1", "1.0.0"):
        monkeypatch.setattr(numba, "__version__", version)
        assert not versions.tested() and not versions.passes(failing) and versions.passes(lambda: True)
