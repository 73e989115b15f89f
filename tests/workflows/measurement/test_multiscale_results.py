"""What `naibu sense --multiscale` writes: stores whose finest level is what was measured."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from naibu.cli import main
from naibu.imaging.displacement.chunked_strain import COMPONENTS
from naibu.io.images import read_displacement, read_volume, write_volume
from naibu.validation.specimens.textured_sphere import squeezed_ball
from naibu.workflows.measurement.multiscale_results import FILES

zarr = pytest.importorskip("zarr")


def test_scans_displacement_and_strain_open_in_viewers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after, _, _ = squeezed_ball(seed=3)
    write_volume(tmp_path / "before.mha", before)
    write_volume(tmp_path / "after.mha", after)
    out = tmp_path / "out"

    def sense(*options: str) -> int:
        command = ["naibu", "sense", f"{tmp_path}/before.mha", f"{tmp_path}/after.mha", "--method", "horn-schunck", "--out", str(out)]
        monkeypatch.setattr(sys, "argv", [*command, *options])
        with pytest.raises(SystemExit) as end:
            main()
        return int(end.value.code or 0)

    assert sense("--multiscale") == 0
    assert all((out / name).is_dir() for name in FILES)
    np.testing.assert_array_equal(read_volume(out / "reference.ome.zarr").values, before.values)
    vectors, _ = read_displacement(out / "displacement.mha")
    stored = zarr.open_group(str(out / "displacement.ome.zarr"), mode="r")["0"][...]
    np.testing.assert_array_equal(np.moveaxis(stored, 0, -1), vectors.astype(np.float32))
    strain = zarr.open_group(str(out / "strain.ome.zarr"), mode="r")
    assert strain["0"].shape == (6, *before.shape) and [c["label"] for c in strain.attrs["omero"]["channels"]] == list(COMPONENTS)
    known = np.isfinite(strain["0"][...])
    assert known.any() and not known.all()
    capsys.readouterr()
    assert sense("--multiscale") == 2
    assert "ome.zarr" in capsys.readouterr().err
    assert sense("--multiscale", "--overwrite") == 0
