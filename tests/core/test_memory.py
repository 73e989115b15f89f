"""Memory that was freed goes back to the system when it is asked for."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

HOLED = """
from pathlib import Path
from naibu.core.memory import return_freed_memory

def held():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

parts = [bytearray(100_000) for _ in range(2000)]
full = held()
kept = parts[::200]  # what lies between holes keeps the C library from returning them
del parts
freed = held()
return_freed_memory()
print(full, freed, held(), len(kept))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps what was freed until it is asked")
def test_freed_memory_goes_back_to_the_system() -> None:
    done = subprocess.run([sys.executable, "-c", HOLED], capture_output=True, text=True, check=True)
    full, freed, returned, _ = map(float, done.stdout.split())
    assert full - freed < 100.0  # of 190 MB
    assert full - returned > 170.0
