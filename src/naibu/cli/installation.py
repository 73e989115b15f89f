"""Examination of the installation: what is there, what is missing, what it is needed for, and how to install it."""

from __future__ import annotations

import base64
import hashlib
import importlib
import importlib.metadata
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from naibu._numba.cache_folder import VARIABLE, candidates
from naibu._version import __version__

# imports of other parts stand inside functions: the examination must also run where numpy itself is broken

Status = Literal["ok", "missing", "broken"]
_REQUIRED = {
    "numpy": "arrays",
    "scipy": "sparse matrices, the linear solver that is always there",
    "numba": "compiled kernels of the mechanics",
    "h5py": "results for ParaView as one VTKHDF file",
    "pydantic": "checking experiment folders and study files",
    "cyclopts": "the command line",
    "rich": "progress and tables on the command line",
    "matplotlib": "figures",
    "nibabel": "volumes in NIfTI files",
    "pydicom": "volumes in DICOM series",
    "pynrrd": "volumes in NRRD files",
    "tifffile": "volumes in TIFF stacks",
    "threadpoolctl": "one thread for small matrices",
    "lazy-loader": "public names, loaded when first used",
    "starlette": "the page of naibu live",
    "uvicorn": "the server of naibu live",
    "websockets": "the connection between naibu live and its page",
}
_OPTIONAL = {
    "pandas": "tables of results as DataFrames in notebooks",
    "openpyxl": "importing marker tables from Excel files",
    "zarr": "volumes in Zarr stores",
    "dask": "volumes larger than memory, block by block",
    "distributed": "the same on several processes or computers",
    "pyvista": "looking at .vtu and VTKHDF results from Python (ParaView reads them too)",
    "SimpleITK": "rigid registration of intensities",
}
# where the package that is imported has another name than the distribution that is installed
_MODULES = {"pynrrd": "nrrd", "lazy-loader": "lazy_loader"}
_PROBE_TIMEOUT_S = 60.0
# the last line is the answer: Warp greets on the standard output
_CUDA_DEVICES = "import warp; warp.init(); print('CUDA:', *(f'{d.name} ({d.alias}),' for d in warp.get_cuda_devices()))"


@dataclass(frozen=True, slots=True)
class DoctorRow:
    """One line of the examination.

    Attributes
    ----------
    name : str
        What was examined.
    status : {"ok", "missing", "broken"}
        ``"missing"`` is a choice for what is optional; ``"broken"`` is there but does not work.
    found : str
        Version or other finding.
    purpose : str
        What it is for.
    remedy : str
        The command, or the step, that mends it; empty where nothing is to be done.
    optional : bool
        Whether naibu works without it.
    """

    name: str
    status: Status
    found: str
    purpose: str
    remedy: str = ""
    optional: bool = False


def doctor_rows() -> list[DoctorRow]:
    """Examine Python, the packages, the linear solver, the bundled data and the cache; prints and changes nothing.

    Returns
    -------
    list of DoctorRow
        What naibu needs first, then what is optional.
    """
    return list(examined())


def examined() -> Iterator[DoctorRow]:
    """Give the lines of `doctor_rows`, each as soon as it is examined: those of optional packages, which take longest, last."""
    yield _python_row()
    yield DoctorRow("naibu", "ok", __version__, "this package")
    yield from (_required_row(name, purpose) for name, purpose in _REQUIRED.items())
    yield from (examine() for examine in (_threading_row, _kernels_row, _cache_row, _data_row, _solver_row))
    yield from (_optional_row(name, purpose) for name, purpose in _OPTIONAL.items())
    yield _gpu_row()


def healthy(rows: Iterable[DoctorRow]) -> bool:
    """Tell whether naibu can do its work: nothing is broken, and nothing that it needs is missing."""
    return all(row.status == "ok" or (row.optional and row.status == "missing") for row in rows)


def _python_row() -> DoctorRow:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    right = sys.version_info >= (3, 11)
    return DoctorRow("Python", "ok" if right else "broken", found, "runs naibu", "" if right else "install Python 3.11 or later")


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _required_row(name: str, purpose: str) -> DoctorRow:
    version = _version(name)
    if version is None:
        return DoctorRow(name, "missing", "not installed", purpose, f"pip install {name}")
    try:
        importlib.import_module(_MODULES.get(name, name))
    # a damaged package may raise anything while it is imported
    except Exception as error:
        return DoctorRow(name, "broken", f"{version}: {_first_line(error)}", purpose, f"pip install --force-reinstall {name}")
    return DoctorRow(name, "ok", version, purpose)


def _optional_row(name: str, purpose: str) -> DoctorRow:
    version = _version(name)
    if version is None:
        return DoctorRow(name, "missing", "not installed", purpose, f"pip install {name}", optional=True)
    trouble = _trouble_in_a_process_of_its_own(name)
    if trouble:
        return DoctorRow(name, "broken", f"{version}: {trouble}", purpose, f"pip install --force-reinstall {name}", optional=True)
    return DoctorRow(name, "ok", version, purpose, optional=True)


def _trouble_in_a_process_of_its_own(module: str) -> str:
    """Import a package whose libraries may end the process, and return what went wrong; empty where nothing did."""
    return _said_in_a_process_of_its_own(f"import {module}")[0]


def _said_in_a_process_of_its_own(code: str) -> tuple[str, str]:
    """Run code that begins with an import; return what went wrong, empty where nothing did, and the last line that it printed."""
    try:
        probe = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=_PROBE_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"the import took more than {_PROBE_TIMEOUT_S:g} s", ""
    said, printed = probe.stderr.strip().splitlines(), probe.stdout.strip().splitlines()
    if probe.returncode == 0:
        return "", printed[-1] if printed else ""
    return said[-1] if said else f"the import ended with code {probe.returncode}", ""


def _gpu_row() -> DoctorRow:
    name, purpose, install = "GPU", "lattices on an NVIDIA GPU, with Warp", 'pip install "naibu[gpu]"'
    version = _version("warp-lang")
    if version is None:
        return DoctorRow(name, "missing", "Warp is not installed", purpose, install, optional=True)
    trouble, said = _said_in_a_process_of_its_own(_CUDA_DEVICES)
    devices = said.removeprefix("CUDA:").strip(" ,")
    if trouble:
        return DoctorRow(name, "broken", f"Warp {version}: {trouble}", purpose, "pip install --force-reinstall warp-lang", optional=True)
    if not devices:
        found, remedy = f"Warp {version}, no CUDA device", "needs an NVIDIA GPU and its driver; without, lattices move on the processor"
        return DoctorRow(name, "missing", found, purpose, remedy, optional=True)
    return DoctorRow(name, "ok", f"Warp {version}: {devices}", purpose, optional=True)


def _threading_row() -> DoctorRow:
    name, purpose = "threads", "kernels on several cores"
    cores = f"{os.cpu_count() or 1} cores"
    try:
        numba = importlib.import_module("numba")
        layers = [layer for layer in numba.config.THREADING_LAYER_PRIORITY if _has_layer(layer)]
    except Exception as error:
        return DoctorRow(name, "broken", f"{cores}; {_first_line(error)}", purpose, "pip install --force-reinstall numba")
    if not layers:
        return DoctorRow(name, "missing", f"{cores}; Numba has no threading layer", purpose, "pip install tbb", optional=True)
    return DoctorRow(name, "ok", f"{cores}, Numba uses {numba.config.NUMBA_NUM_THREADS} (layer {layers[0]})", purpose)


def _has_layer(layer: str) -> bool:
    pool = {"tbb": "tbbpool", "omp": "omppool"}.get(layer, "workqueue")
    try:
        importlib.import_module(f"numba.np.ufunc.{pool}")
    except ImportError:
        return False
    return True


def _kernels_row() -> DoctorRow:
    name, purpose = "kernels", "Numba's inner interfaces: vectors and threads of lattices, the cache"
    try:
        from naibu._numba.compilation import cache_works
        from naibu._numba.intrinsics.atomics import ATOMIC
        from naibu._numba.intrinsics.simd import VECTORS
        from naibu._numba.versions import TESTED, tested

        parts = {"SIMD vectors": VECTORS, "thread pool": ATOMIC, "cache": cache_works()}
    except Exception as error:
        return DoctorRow(name, "broken", _first_line(error), purpose, "mend the packages above that are not ok")
    version = f"Numba {_version('numba')}{'' if tested() else ' (not tested)'}"
    lacking = [part for part, works in parts.items() if not works]
    if lacking:
        found = f"{version}: no {', no '.join(lacking)}; slower"
        return DoctorRow(name, "missing", found, purpose, f'pip install "numba{TESTED}"', optional=True)
    return DoctorRow(name, "ok", f"{version}: {', '.join(parts)}", purpose)


def _cache_row() -> DoctorRow:
    name, purpose = "cache", "keeps compiled kernels, so that only the first run compiles"
    folders = cache_folders()
    found = next((folder for folder in folders if _writable(folder)), None)
    if found is not None:
        kept = sum(1 for _ in found.glob("*.nbc"))
        return DoctorRow(name, "ok", f"{found}, {kept} compiled kernels", purpose)
    where, remedy = " or ".join(str(folder) for folder in folders), f"set {VARIABLE} to a folder you may write to"
    if os.environ.get(VARIABLE):
        return DoctorRow(name, "broken", f"cannot write to {where}", purpose, remedy)
    return DoctorRow(name, "missing", f"cannot write to {where}; kernels go to temporary files", purpose, remedy, optional=True)


def cache_folders() -> list[Path]:
    """Return where compiled kernels may be kept, the first choice first; the one that NUMBA_CACHE_DIR names alone where it is set."""
    folders = list(candidates())
    return folders[:1] if os.environ.get(VARIABLE) else folders


def _writable(folder: Path) -> bool:
    """Tell whether a file can be made in `folder`, or in the nearest folder above it where it does not exist yet."""
    there = next(place for place in (folder, *folder.resolve().parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            return True
    except OSError:
        return False


def _data_row() -> DoctorRow:
    name, purpose = "bundled data", "the demo and the examples"
    remedy = "install naibu again: pip install --force-reinstall --no-deps and the folder or wheel it came from"
    try:
        from naibu import datasets

        damaged = _damaged_files("naibu/datasets/data/")
        names = datasets.names()
        for experiment in names:
            datasets.load(experiment)
    except Exception as error:
        return DoctorRow(name, "broken", _first_line(error), purpose, remedy)
    if damaged or not names:
        return DoctorRow(name, "broken", f"not as shipped: {', '.join(damaged) or 'no experiments'}", purpose, remedy)
    return DoctorRow(name, "ok", f"{len(names)} experiments", purpose)


def _damaged_files(prefix: str) -> list[str]:
    """Return installed files below `prefix` that are gone or not what the wheel recorded; none where naibu runs from its sources."""
    try:
        files = importlib.metadata.files("naibu") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    damaged = []
    for file in files:
        if file.as_posix().startswith(prefix) and file.hash is not None:
            path = Path(str(file.locate()))
            digest = hashlib.new(file.hash.mode, path.read_bytes()).digest() if path.exists() else b""
            if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != file.hash.value:
                damaged.append(file.name)
    return damaged


def _solver_row() -> DoctorRow:
    name, purpose, fallback = "linear solver", "oneMKL PARDISO factorizes faster than SciPy's SuperLU", "SuperLU (SciPy)"
    try:
        from naibu.mechanics.linear_algebra.direct import pardiso_library

        library = pardiso_library()
    except Exception as error:
        return DoctorRow(name, "broken", _first_line(error), purpose, "mend the packages above that are not ok")
    version = _version("mkl")
    if library is not None:
        return DoctorRow(name, "ok", f"PARDISO (oneMKL {version or 'of this system'})", purpose)
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return DoctorRow(name, "ok", f"{fallback}; oneMKL is not made for {platform.machine()}", "factorizes the equations")
    if version is not None:
        found, remedy = f"{fallback}; mkl {version} cannot be loaded", "pip install --force-reinstall mkl"
        return DoctorRow(name, "broken", found, purpose, remedy, optional=True)
    return DoctorRow(name, "missing", f"{fallback}; oneMKL is not installed", purpose, "pip install mkl", optional=True)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
