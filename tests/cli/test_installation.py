"""The examination of the installation: right on this one, and in words where something is missing or broken."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from pathlib import Path

import numba
import pytest

from naibu import datasets
from naibu._numba.intrinsics import simd
from naibu.cli import installation
from naibu.core.errors import InputError
from naibu.mechanics.linear_algebra import direct


def row(name: str) -> installation.DoctorRow:
    return next(r for r in installation.examined() if r.name == name)


@pytest.fixture
def uninstalled(monkeypatch: pytest.MonkeyPatch):
    """Return a function that makes a distribution look uninstalled."""
    version = importlib.metadata.version
    gone: set[str] = set()

    def asked(name: str) -> str:
        if name in gone:
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", asked)
    return gone.add


def test_this_installation_is_healthy_and_every_row_is_whole() -> None:
    rows = installation.doctor_rows()
    assert installation.healthy(rows), [r for r in rows if r.status != "ok" and not r.optional]
    assert len({r.name for r in rows}) == len(rows)
    for r in rows:
        assert r.found and r.purpose
        assert bool(r.remedy) == (r.status != "ok"), r


def test_every_required_package_of_the_distribution_is_examined() -> None:
    required = {re.split(r"[<>=!~;\[ ]", r)[0] for r in importlib.metadata.requires("naibu") or [] if "extra ==" not in r}
    if not required:
        pytest.skip("naibu runs from its sources and is not installed")
    assert required <= set(installation._REQUIRED)


def test_a_missing_required_package_makes_it_unhealthy(uninstalled) -> None:
    uninstalled("rich")
    found = row("rich")
    assert (found.status, found.remedy, found.optional) == ("missing", "pip install rich", False)
    assert not installation.healthy([found])


def test_a_package_that_cannot_be_imported_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    found = row("h5py")
    assert found.status == "broken" and "h5py" in found.found and found.remedy == "pip install --force-reinstall h5py"


def test_a_missing_optional_package_leaves_it_healthy(uninstalled) -> None:
    uninstalled("openpyxl")
    found = row("openpyxl")
    assert (found.status, found.remedy) == ("missing", "pip install openpyxl")
    assert "Excel" in found.purpose and installation.healthy([found])


def test_an_optional_package_that_ends_the_process_is_broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "pyvista.py").write_text("import os\nos._exit(139)\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    version = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.0" if name == "pyvista" else version(name))
    found = row("pyvista")
    assert found.status == "broken" and "139" in found.found
    assert not installation.healthy([found])


def test_without_warp_the_gpu_is_missing_and_its_extra_named(uninstalled) -> None:
    uninstalled("warp-lang")
    found = row("GPU")
    assert (found.status, found.remedy) == ("missing", 'pip install "naibu[gpu]"') and installation.healthy([found])


@pytest.mark.parametrize(
    ("body", "status", "said"),
    [
        ("def get_cuda_devices(): return []", "missing", "no CUDA device"),
        ("def get_cuda_devices(): return [types.SimpleNamespace(name='Card', alias='cuda:0')]", "ok", "Card (cuda:0)"),
        ("raise OSError('libcuda is damaged')", "broken", "libcuda is damaged"),
    ],
)
def test_the_gpu_is_what_warp_finds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: str, status: str, said: str) -> None:
    (tmp_path / "warp.py").write_text(f"import types\ndef init(): print('Warp greets')\n{body}\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    version = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.12" if name == "warp-lang" else version(name))
    found = row("GPU")
    assert found.status == status and said in found.found and "1.12" in found.found
    assert installation.healthy([found]) == (status != "broken")


@pytest.mark.parametrize("installed", [False, True])
def test_without_pardiso_superlu_is_named(monkeypatch: pytest.MonkeyPatch, uninstalled, installed: bool) -> None:
    monkeypatch.setattr(direct, "pardiso_library", lambda: None)
    monkeypatch.setattr(installation.platform, "machine", lambda: "x86_64")
    if installed:
        monkeypatch.setattr(importlib.metadata, "version", lambda name: "2026.0")
    else:
        uninstalled("mkl")
    found = row("linear solver")
    assert found.status == ("broken" if installed else "missing")
    assert "SuperLU" in found.found and "mkl" in found.remedy


def test_where_mkl_does_not_exist_nothing_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(direct, "pardiso_library", lambda: None)
    monkeypatch.setattr(installation.platform, "machine", lambda: "arm64")
    found = row("linear solver")
    assert found.status == "ok" and found.remedy == "" and "SuperLU" in found.found


def test_bundled_data_that_cannot_be_read_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreadable(name: str) -> None:
        raise InputError(f"{name}/initial.csv: the file is empty")

    monkeypatch.setattr(datasets, "load", unreadable)
    found = row("bundled data")
    assert found.status == "broken" and "initial.csv: the file is empty" in found.found


def test_a_changed_data_file_is_noticed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Recorded(importlib.metadata.PackagePath):
        def locate(self) -> Path:
            return tmp_path / self.name

    files = []
    for name, digest in (("whole.csv", "ungWv48Bz-pBQUDeXa4iI7ADYaOWF3qctBD_YfIAFa0"), ("gone.csv", "x"), ("changed.csv", "x")):
        files.append(Recorded(f"naibu/datasets/data/{name}"))
        files[-1].hash = importlib.metadata.FileHash(f"sha256={digest}")
    (tmp_path / "whole.csv").write_bytes(b"abc")
    (tmp_path / "changed.csv").write_bytes(b"abd")
    monkeypatch.setattr(importlib.metadata, "files", lambda name: files)
    found = row("bundled data")
    assert found.status == "broken" and "gone.csv, changed.csv" in found.found and "whole.csv" not in found.found


def test_a_cache_that_cannot_be_written_is_broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    found = row("cache")
    assert found.status == "broken" and str(tmp_path / "file") in found.found and "NUMBA_CACHE_DIR" in found.remedy


def test_a_cache_folder_that_does_not_exist_yet_is_fine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "new" / "folder"))
    assert row("cache").status == "ok"
    assert list(tmp_path.iterdir()) == []


def test_without_a_folder_to_write_to_kernels_are_temporary(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder", encoding="utf-8")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(installation, "candidates", lambda: iter([tmp_path / "file" / "kernels"]))
    found = row("cache")
    assert found.status == "missing" and "temporary" in found.found and "NUMBA_CACHE_DIR" in found.remedy
    assert installation.healthy([found])


def test_compiled_kernels_are_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    (tmp_path / "naibu").mkdir()
    for name in ("one.nbc", "two.nbc", "three.nbc.lock"):
        (tmp_path / "naibu" / name).touch()
    assert row("cache").found == f"{tmp_path / 'naibu'}, 2 compiled kernels"


def test_what_an_untested_numba_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert row("kernels").status == "ok"
    monkeypatch.setattr(simd, "VECTORS", False)
    monkeypatch.setattr(numba, "__version__", "0.99.0")
    found = row("kernels")
    assert found.status == "missing" and "not tested" in found.found and "no SIMD vectors" in found.found
    assert found.remedy == 'pip install "numba>=0.59,<0.69"' and installation.healthy([found])
