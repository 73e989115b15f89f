"""A full disk ends in a message and leaves earlier results as they were; it never ends the interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

NAMES = ("a.vtkhdf", "a.h5", "a.vtu", "a.mha", "a.nii.gz", "a.nrrd", "a.tif", "a.zarr")
WRITE = """
import resource, sys
from pathlib import Path
import numpy as np
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import write_volume
from naibu.io.vtk_files import write_vtkhdf_series, write_vtu
from naibu.meshing.primitives import box

mesh = box((20.0, 20.0, 20.0), (12, 12, 12))
rng = np.random.default_rng(1)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))  # as a disk with so much space left
for target in map(Path, sys.argv[2:]):
    try:
        if target.suffix == ".vtkhdf":
            write_vtkhdf_series(target, mesh, range(12), {"displacement, mm": rng.random((12, mesh.n_points, 3))})
        elif target.suffix == ".vtu":
            write_vtu(target, mesh)
        else:
            write_volume(target, Volume.from_array(rng.random((40, 50, 60)), spacing_mm=(1.0, 1.0, 1.0)))
    except InputError as error:
        print(target.name, "refused:", " ".join(str(error).split()), flush=True)
    else:
        print(target.name, "written", flush=True)
"""


@pytest.mark.parametrize("limit", [0, 3000, 60_000])
def test_a_full_disk_is_an_error_in_words(tmp_path: Path, limit: int) -> None:
    """One process meets it in one kind of file after the other."""
    targets = [tmp_path / name.partition(".")[2] / name for name in NAMES]
    for target in targets:
        target.parent.mkdir()
        if not target.name.endswith("zarr"):
            target.write_text("an earlier result")
    done = subprocess.run([sys.executable, "-c", WRITE, str(limit), *map(str, targets)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    for target, said in zip(targets, done.stdout.splitlines(), strict=True):
        assert said.startswith(f"{target.name} refused: ") and target.name in said.partition("refused: ")[2] and "cannot be written" in said
        left = [] if target.name.endswith("zarr") else [target.name]
        assert [p.name for p in target.parent.iterdir()] == left  # nothing half-written stays
        assert not left or target.read_text() == "an earlier result"
