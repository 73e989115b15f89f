"""Damaged files end in a message that names the file, never in a foreign exception, a hang, or a huge allocation."""

from __future__ import annotations

import base64
import gzip
import os
import socket
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from damaged_files import mutated
from fuzz import outcome
from valid_files import ValidFile, valid_files

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.images import read_volume, write_volume
from naibu.io.marker_tables import import_markers
from naibu.io.meshes import read_mesh, read_surface

EACH = 12


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[ValidFile]:
    return valid_files(tmp_path_factory.mktemp("valid"))


def test_what_is_not_damaged_is_read(files: list[ValidFile]) -> None:
    for file in files:
        file.read()


@pytest.mark.parametrize("seed", range(EACH))
def test_damaged_files_are_refused_in_words(files: list[ValidFile], seed: int) -> None:
    for number, file in enumerate(files):
        rng = np.random.default_rng([seed, number])
        found = outcome(file, mutated(file.target.read_bytes(), rng))
        assert found in ("read", "refused"), f"{file.kind}: {found}"


@pytest.mark.parametrize("name", ["a.mha", "a.nii", "a.nrrd", "a.tif", "a.h5"])
def test_devices_and_pipes_are_refused_at_once(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="device or a pipe"):
        read_volume(tmp_path / name)
    (tmp_path / "zero").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="device or a pipe"):
        import_markers(tmp_path / "zero")
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "s.stl"))
    with server, pytest.raises(InputError, match="device or a pipe"):
        read_surface(tmp_path / "s.stl")


def test_counts_beyond_the_file_are_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    huge = 2**40
    ply = f"ply\nformat ascii 1.0\nelement vertex {huge}\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    mha = f"NDims = 3\nDimSize = {huge} 1 1\nElementType = MET_UCHAR\nElementSpacing = 1 1 1\nElementDataFile = LOCAL\nabc"
    nrrd = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {huge} 1 1\nencoding: raw\n\nabc"
    for name, text, read in (("a.ply", ply, read_surface), ("a.mha", mha, read_volume), ("a.nrrd", nrrd, read_volume)):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=r"announces \d+"):
            read(tmp_path / name)


def test_compressed_bombs_are_not_unpacked(tmp_path: Path) -> None:
    bomb = zlib.compress(bytes(300 << 20), 9)
    head = (
        "NDims = 3\nDimSize = 10 10 10\nElementType = MET_UCHAR\nElementSpacing = 1 1 1\nCompressedData = True\nElementDataFile = LOCAL\n"
    )
    (tmp_path / "a.mha").write_bytes(head.encode() + bomb)
    with pytest.raises(InputError, match="unpack to more than"):
        read_volume(tmp_path / "a.mha")
    packed = gzip.compress(bytes(300 << 20))
    (tmp_path / "a.nrrd").write_bytes(b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 10 10 10\nspacings: 1 1 1\nencoding: gzip\n\n" + packed)
    with pytest.raises(InputError, match="unpack to more than"):
        read_volume(tmp_path / "a.nrrd")
    head = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 10 10 10\nspacings: 1 1 1\nencoding: gzip\ndata file: a.raw.gz\n"
    (tmp_path / "a.nhdr").write_text(head)
    (tmp_path / "a.raw.gz").write_bytes(packed)
    with pytest.raises(InputError, match="unpack to more than"):
        read_volume(tmp_path / "a.nhdr")
    (tmp_path / "a.raw.gz").write_bytes(gzip.compress(bytes(range(250)) * 4))
    assert read_volume(tmp_path / "a.nhdr").values[0, 0].tolist() == list(range(10))


@pytest.mark.parametrize("named", ["/etc/hostname", "../secret.raw", "sub/../../secret.raw"])
def test_headers_do_not_lead_to_files_elsewhere(tmp_path: Path, named: str) -> None:
    (tmp_path / "secret.raw").write_bytes(bytes(1000))
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "a.mhd").write_text(
        f"NDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementSpacing = 1 1 1\nElementDataFile = {named}\n"
    )
    (folder / "a.nhdr").write_text(
        f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\nspacings: 1 1 1\nencoding: raw\ndata file: {named}\n"
    )
    for name in ("a.mhd", "a.nhdr"):
        with pytest.raises(InputError, match="outside the folder of the header"):
            read_volume(folder / name)


def test_values_of_hdf5_outside_the_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.raw").write_bytes(bytes(8))
    attributes = {"spacing_mm": [1.0, 1.0, 1.0], "origin_mm": [0.0, 0.0, 0.0], "direction": np.eye(3)}
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        stored = file.create_dataset("values", shape=(2, 2, 2), dtype="u1", external=[(str(tmp_path / "secret.raw"), 0, 8)])
        stored.attrs.update(attributes)
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["values"] = h5py.ExternalLink("outside.h5", "values")
    for name in ("outside.h5", "linked.h5"):
        with pytest.raises(InputError, match="copy them into"):
            read_volume(tmp_path / name)


def test_a_lost_chunk_of_a_zarr_store_is_not_taken_for_zeros(tmp_path: Path) -> None:
    values = np.zeros((70, 65, 66), dtype=np.int16)
    store = write_volume(tmp_path / "a.zarr", Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0)))
    assert (read_volume(store).values == 0).all()
    (store / "values" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(InputError, match="1 of its 8 chunks are missing"):
        read_volume(store)


def test_text_nested_without_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "meta.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(InputError, match="nested too deeply"):
        read_experiment(tmp_path)
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {'9' * 5000}\n")
    with pytest.raises(InputError, match=r"a\.obj"):
        read_surface(tmp_path / "a.obj")


def test_a_mesh_whose_blocks_announce_too_much_is_refused_quickly(tmp_path: Path) -> None:
    blocks = np.array([2**31, 2**20, 2**20], dtype="<u4").tobytes()
    text = base64.b64encode(blocks).decode()
    (tmp_path / "a.vtu").write_text(
        '<VTKFile type="UnstructuredGrid" byte_order="LittleEndian" compressor="vtkZLibDataCompressor"><UnstructuredGrid>'
        f'<Piece><Points><DataArray type="Float64" format="binary">{text}</DataArray></Points></Piece></UnstructuredGrid></VTKFile>'
    )
    with pytest.raises(InputError, match="blocks announced"):
        read_mesh(tmp_path / "a.vtu")
