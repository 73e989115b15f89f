"""Too little memory ends in one sentence that names the verb and what to reduce, with exit code 1."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.ndimage import gaussian_filter

from naibu import cli
from naibu.core import memory
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.io.vtk_files import write_vtu
from naibu.mechanics.linear_algebra import direct
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box

LIMITED = """
import resource, sys
limit = int(sys.argv.pop(1)) * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
from naibu.cli import main
main()
"""
posix = pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of the address space")


def limited(megabytes: int, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LIMITED, str(megabytes), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)


@pytest.mark.parametrize(
    ("verb", "remedy"),
    [
        ("identify", "--element-size-mm"), ("predict", "--element-size-mm"), ("sense", "smaller volumes"), ("simulate", "coarser mesh"),
        ("live", "coarser mesh"), ("cut", "coarser mesh"), ("track", "smaller volumes"),
    ],
)  # fmt: skip
def test_what_to_reduce_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], verb: str, remedy: str) -> None:
    def greedy() -> None:
        raise MemoryError("Unable to allocate 70 TiB")

    monkeypatch.setattr(cli, "_run", greedy)
    monkeypatch.setattr(sys, "argv", ["naibu", verb])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().err
    assert ended.value.code == 1
    assert f"naibu {verb} needs more memory" in said and "70 TiB" in said and remedy in said and "log" not in said


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (OSError(12, "Cannot allocate memory"), True),
        (ImportError("libscipy_openblas.so: failed to map segment from shared object"), True),
        (RuntimeError("can't start new thread"), True),
        (OSError(2, "No such file"), False),
        (ValueError("unable to allocate"), False),
    ],
)
def test_errors_of_too_little_memory_are_known_whatever_their_class(error: Exception, expected: bool) -> None:
    assert memory.is_out_of_memory(error) is expected
    outer = RuntimeError("something else")
    outer.__cause__ = error
    assert memory.is_out_of_memory(outer) is expected


def test_direct_solver_is_not_loaded_where_it_would_end_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    if direct.pardiso_library() is None:
        pytest.skip("needs oneMKL")
    monkeypatch.setattr(memory, "address_space", lambda: (1000.0, 900.0))
    direct._require_room.cache_clear()
    with pytest.raises(MemoryError, match=r"PARDISO .* 100 MB of a limit of 1000 MB are left"):
        direct.PardisoSolver(sp.bsr_matrix(np.eye(6), blocksize=(3, 3)), symmetric=True)


@posix
@pytest.mark.parametrize(
    ("megabytes", "words"),
    [
        *((megabytes, ("simulate", "cube-pushing")) for megabytes in (100, 250, 500)),
        (250, ("live", "--no-browser")),
        (250, ("cut", "a.vtu", "--path", "b.csv")),
    ],
)
def test_libraries_that_do_not_fit_are_not_loaded(megabytes: int, words: tuple[str, ...]) -> None:
    """OpenBLAS would wait for ever, NumPy and LLVM end in messages of their own."""
    done = limited(megabytes, *words)
    assert done.returncode == 1, done.stderr
    assert f"naibu {words[0]} needs more memory" in done.stderr and "coarser" in done.stderr
    assert "Traceback" not in done.stderr and ".log" not in done.stderr


@posix
def test_openblas_does_not_wait_for_memory_for_ever() -> None:
    """Its work space is reserved first: without that, the last line does not end."""
    steps = (
        "import mmap, resource, numpy as np, scipy.linalg\n"
        "from naibu.core.memory import address_space, reserve_work_space\n"
        "taken = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "limit = taken + 100 * 2**20\n"
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit))\n"
        "reserve_work_space()\n"
        "limit, taken = address_space()\n"
        "kept = mmap.mmap(-1, int((limit - taken - 8.0) * 2**20))\n"
        "print(scipy.linalg.cholesky(4.0 * np.eye(64))[0, 0], np.linalg.cholesky(4.0 * np.eye(64))[0, 0])"
    )
    done = subprocess.run([sys.executable, "-c", steps], capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout.split() == ["2.0", "2.0"], done.stderr[-2000:]


@posix
@pytest.mark.slow
@pytest.mark.parametrize("megabytes", [660, 800, 1000, 1300])
@pytest.mark.parametrize(
    "words",
    [
        ("identify", "ct_two_material_1", "--known", "hardness 5=222 kPa", "--element-size-mm", "12"),
        ("simulate", "cube-pushing"),
        ("sense", "a.mha", "b.mha"),
        ("cut", "solid.vtu", "--path", "blade.csv", "--distance-mm", "0.1"),
    ],
    ids=lambda words: words[0],
)
def test_a_limit_ends_in_words(tmp_path: Path, megabytes: int, words: tuple[str, ...]) -> None:
    if words[0] == "sense":
        texture = gaussian_filter(np.random.default_rng(1).normal(size=(96, 96, 96)), 2.0)
        scans = [str(tmp_path / name) for name in words[1:]]
        for scan, shift in zip(scans, (0, 1), strict=True):
            write_volume(scan, Volume.from_array(np.roll(texture, shift, axis=0), spacing_mm=(1.0, 1.0, 1.0)))
        words = ("sense", *scans)
    if words[0] == "cut":
        write_vtu(tmp_path / "solid.vtu", to_tetra(box((20.0, 20.0, 10.0), (4, 4, 2))))
        (tmp_path / "blade.csv").write_text("-12,-12,4.1,-12,12,4.3\n12,-12,4.1,12,12,4.3\n", encoding="utf-8")
        words = tuple(str(tmp_path / word) if word.endswith((".vtu", ".csv")) else word for word in words)
    done = limited(megabytes, *words, "--out", str(tmp_path / "out"))
    assert done.returncode in (0, 1, 3), done.stderr[-2000:]
    assert "Traceback" not in done.stderr and "oneMKL" not in done.stderr.replace("PARDISO (oneMKL)", "") and ".log" not in done.stderr
    if done.returncode == 1:
        assert f"naibu {words[0]} needs more memory" in done.stderr, done.stderr[-2000:]
