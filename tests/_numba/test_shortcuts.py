"""Shortcuts of Numba's compiler lead to the machine code that it makes without them, and none of them stays."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import base, event, ir, lowering, postproc, targetconfig
from numba.core.errors import TypingError
from numba.core.types import functions
from numba.core.typing import context
from numba.extending import overload

from naibu._numba import shortcuts
from naibu._numba.cache_folder import VARIABLE
from naibu._numba.compilation import called_apart, njit

pytestmark = pytest.mark.skipif(not called_apart(), reason="shortcuts are for tested versions of Numba")
CODE = """
import contextlib, sys
import numpy as np
from naibu._numba import shortcuts
from naibu._numba.compilation import njit

if sys.argv[1] == "plain":
    shortcuts.taken = contextlib.nullcontext


@njit(cache=True)
def part(x, i, scale):
    if i < 0 or not x > 0.5 and i % 3 == 1:
        raise ValueError("negative")
    return np.sqrt(abs(x)) ** 2 + scale * (i // 2) - min(x, 2), (i, x)


@njit(cache=True, fastmath=True)
def rest(x, of):
    return x % of + max(x, of) / of


@njit(cache=True, error_model="numpy")
def whole(x, n, wanted):
    total, last = 0.0, (0, 0.0)
    for i in range(n):
        if wanted[i] and i & 1 != 0:
            value, last = part(x[i], i - 1, 3)
            total += value / (i - 1)
        else:
            total -= -x[i] + rest(x[i], 2.5) + (i << 2) + np.uint8(7)
    while total > 1e3:
        total /= 1.5
    return total, last[0] > 3, x[:n].sum()


print(whole(np.arange(7.0), 7, np.ones(7, bool)))
print(next(iter(whole.inspect_asm().values())))
"""


def printed(tmp_path: Path, way: str) -> str:
    """What a process prints that compiles kernels in this way."""
    script = tmp_path / "kernels.py"
    script.write_text(CODE)
    environment = os.environ | {VARIABLE: str(tmp_path / way)}
    done = subprocess.run([sys.executable, script, way], capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    return re.sub(r"0x[0-9a-f]{6,}|pickle[a-z]+\.[0-9]+", "address", done.stdout)


def test_the_machine_code_is_the_same(tmp_path: Path) -> None:
    ways = [printed(tmp_path, way) for way in ("plain", "short")]
    assert "sqrt" in ways[0]
    assert ways[0] == ways[1]


def places() -> list[object]:
    """What shortcuts take the place of, as it is now."""
    config = targetconfig.TargetConfig
    found = [event.install_timer, config.values, config.__hash__, config.__eq__]
    found += [
        ir.Inst._rec_list_vars,
        functions.BaseFunction.get_call_type,
        postproc.PostProcessor.run,
        lowering.BaseLower.create_cfunc_wrapper,
    ]
    return [*found, base.BaseContext.refresh, context.BaseContext.refresh, base.BaseContext.get_abi_sizeof]


def test_nothing_stays() -> None:
    before = places()

    def kernel(x: float) -> float:
        return x + 1.0

    assert njit(cache=True)(kernel)(2.0) == 3.0
    assert places() == before
    with pytest.raises(TypingError):
        njit(cache=True)(kernel)("2")
    assert places() == before
    with shortcuts.taken():
        assert all(one is not other for one, other in zip(places(), before, strict=True))
    assert places() == before


def test_operators_follow_the_options_of_each_kernel() -> None:
    def ratio(x: float, y: float) -> float:
        return x / y

    with shortcuts.taken():
        python, numpy = numba.njit(ratio), numba.njit(error_model="numpy")(ratio)
        assert numpy(1.0, 0.0) == np.inf
        with pytest.raises(ZeroDivisionError):
            python(1.0, 0.0)


def test_what_is_registered_while_a_kernel_is_compiled_is_known_to_the_next() -> None:
    def named() -> float:
        raise NotImplementedError

    def kernel() -> float:
        return named()

    with shortcuts.taken():
        assert numba.njit(lambda: 1.0)() == 1.0
        with pytest.raises(TypingError):
            numba.njit(kernel)()
        overload(named)(lambda: lambda: 7.0)
        assert numba.njit(kernel)() == 7.0


def test_generators_and_parts_for_the_interpreter_know_what_is_alive() -> None:
    def halves(n: int):  # type: ignore[no-untyped-def]
        value = 1.0
        for i in range(n):
            value *= 0.5
            yield value + i

    def spoken(x: float) -> float:
        y = x + 1.0
        if x > 0.0:
            with numba.objmode(z="float64"):
                z = float(str(y)) * 2.0
        else:
            z = -y
        return z + y

    with shortcuts.taken():
        steps = numba.njit(halves)
        assert list(steps(3)) == [0.5, 1.25, 2.125]
        assert numba.njit(spoken)(2.0) == 9.0
        assert numba.njit(spoken)(-2.0) == 0.0
