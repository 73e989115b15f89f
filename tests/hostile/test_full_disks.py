"""A full disk ends in a message and leaves earlier results as they were; it never ends the interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WRITE = """
import resource, sys
from pathlib import Path
import numpy as np
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu
from naibu.meshing.primitives import box

target = Path(sys.argv[1])
mesh = box((20.0, 20.0, 20.0), (12, 12, 12))
rng = np.random.default_rng(1)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))  # as a disk with so much space left
try:
    if target.suffix == ".vtkhdf":
        write_vtkhdf_series(target, mesh, range(12), {"displacement, mm": rng.random((12, mesh.n_points, 3))})
    elif target.suffix == ".vtu":
        write_vtu(target, mesh)
    else:
        write_volume(target, Volume.from_array(rng.random((40, 50, 60)), spacing_mm=(1.0, 1.0, 1.0)))
except InputError as error:
    print(error)
    sys.exit(7)
"""


@pytest.mark.parametrize("name", ["a.vtkhdf", "a.h5", "a.vtu", "a.mha", "a.nii.gz", "a.nrrd", "a.tif", "a.zarr"])
@pytest.mark.parametrize("limit", [0, 3000, 60_000])
def test_a_full_disk_is_an_error_in_words(tmp_path: Path, name: str, limit: int) -> None:
    target = tmp_path / name
    if not name.endswith("zarr"):
        target.write_text("an earlier result")
    done = subprocess.run([sys.executable, "-c", WRITE, str(target), str(limit)], capture_output=True, text=True, check=False)
    assert done.returncode == 7, done.stderr[-2000:]
    assert name in done.stdout and "cannot be written" in done.stdout
    assert [p.name for p in tmp_path.iterdir()] == ([] if name.endswith("zarr") else [name])  # nothing half-written stays
    assert name.endswith("zarr") or target.read_text() == "an earlier result"
