"""Damaged files end in a message that names the file, never in a foreign exception, a hang, or a huge allocation."""

from __future__ import annotations

import base64
import contextlib
import gzip
import json
import os
import socket
import subprocess
import sys
import zlib
from pathlib import Path

import fuzz
import h5py
import numpy as np
import pytest
from damaged_files import NUMBERS, WORDS, mutated
from fuzz import outcome, time_limit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lattice_studies import STUDY
from valid_files import ValidFile, valid_files

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.images import read_volume, write_volume
from naibu.io.meshes import read_mesh, read_surface
from naibu.io.study_schemas.lattice_study_schema import load_study
from naibu.io.tables.marker_tables import import_markers

EACH = 12
# a stack whose fourth page is its own successor, found by mutation
CIRCLE_OF_PAGES = (
    b"c-pm;*Hcqb5XOHgG*JW<P_RU7h#`g&Kx`;Bu!}k>6A>YSD1-"
    b"=zB4Y2NV#nTl@4fe~FZ$v*J~;jzZo*{@s1FX|&U|}z&bPbsojqr7T3QsoKub_*QHkdxP$|B*K&{fa{6K+5@m-"
    b"voAD~jRUDn5fASJh2Ot4!_h+EB2#h)k$Q+c_3tC(=bw~L8Xay5b&soz}IGC#;r_SJ%TAuA%{^0OV5h-6)+Nv})L>k`d+T||i^JI7|v%PK5%5-"
    b"|p&UKe8!KGtA#(nZC#Jeyr%qvM=(ywjKrCMTV1E4Jj6+KTK>x;ERW7@;$bwdERY)a{zhl{EO8DLrVToTt=gwOVZj7K5X_VW`BZB}R*vbjnBW#!s^S<@7BGkX"
    b"s5Qh*q?gO2LE>N?Y0yMmX*1Ku0>Eqcah7p)1|g-RVIjJ&B?hdZIDV8zV8q5=T5H5=bP8J|xqZe)MO6b|5JXVlb%;VJO2G&Ir;-XC$K-"
    b"%^1cqj`2(&LvC&ollj6FrZSC8zG7xNS<E1tndFd*CD2M9`Pi7nYzipEP7w~~P)rG>%%zNZ%%_|MRIrdr7O|KmEM*zXS;0zHv6?lkWgY9OVgno5L^Ye)!dAA)"
    b"d)vWIYS_hY_OO?I?B@UnImBU(aFk;l=L9D?#c9rPmUEov0vEZ&Wv+0QYh33BH@U@a?r@iT+~)xgc_gp+2~T;(b6)V0SG?v8Z+XXiKJbxGaubc2mAd)(@t^bY"
    b"S@U~7zG>>uhx<(Y)co<@QW~q++qEXCn?`Ysw!UJ2foFQ`S;eXURIKrs;;JU<ak`fW75lm?{@z52|MuVf1!Fdzg#"
)


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


EDITS = st.lists(
    st.tuples(
        st.floats(0.0, 1.0),  # where, as a fraction of the file
        st.integers(0, 64),  # how many bytes go
        st.one_of(st.binary(max_size=16), st.sampled_from([*NUMBERS, *WORDS])),  # what comes instead
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.floats(0.0, 1.0, exclude_max=True), edits=EDITS)
def test_any_edit_of_a_valid_file_is_read_or_refused(files: list[ValidFile], which: float, edits: list[tuple[float, int, bytes]]) -> None:
    file = files[int(which * len(files))]
    content = file.target.read_bytes()
    for where, gone, new in edits:
        at = int(where * len(content))
        content = content[:at] + new + content[at + gone :]
    assert outcome(file, content) in ("read", "refused"), file.kind


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_ten_thousand_mutations_end_in_words(seed: int) -> None:
    program = [sys.executable, Path(fuzz.__file__), "--count", "250", "--seed", str(seed)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


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
    with h5py.File(tmp_path / "far.h5", "w") as file:  # a link within the file that passes through another one
        file["elsewhere"] = h5py.ExternalLink("inside.h5", "/")
        file["values"] = h5py.SoftLink("/elsewhere/values")
    with h5py.File(tmp_path / "inside.h5", "w") as file:
        file.create_dataset("values", data=np.zeros((2, 2, 2), dtype="u1")).attrs.update(attributes)
        file["again"] = h5py.SoftLink("/values")
    assert read_volume(tmp_path / "inside.h5").shape == (2, 2, 2)
    for name in ("outside.h5", "linked.h5", "far.h5"):
        with pytest.raises(InputError, match="copy them into"):
            read_volume(tmp_path / name)


HEADER = {
    "NDims": "3", "DimSize": "2 2 2", "ElementType": "MET_UCHAR", "ElementSpacing": "1 1 1", "Offset": "0 0 0",
    "TransformMatrix": "1 0 0 0 1 0 0 0 1", "HeaderSize": "0", "ElementNumberOfChannels": "1", "ElementDataFile": "LOCAL",
}  # fmt: skip


@pytest.mark.parametrize("field", [name for name in HEADER if name != "ElementDataFile"])
@pytest.mark.parametrize(
    "value", ["abc", "2.5 x", "", "0", "-7", "nan nan nan", "1e400 1 1", "9" * 5000, "2 2", "LIST", "\u00b2 \u00b2 \u00b2"]
)
def test_fields_of_a_header_that_cannot_be_are_named(tmp_path: Path, field: str, value: str) -> None:
    text = "".join(f"{name} = {value if name == field else given}\n" for name, given in HEADER.items())
    (tmp_path / "a.mha").write_bytes(text.encode() + bytes(8))
    if (field, value) == ("HeaderSize", "0"):
        assert read_volume(tmp_path / "a.mha").shape == (2, 2, 2)
        return
    with pytest.raises(InputError, match=r"a\.mha"):
        read_volume(tmp_path / "a.mha")


@pytest.mark.parametrize("names", ["", "gone.raw\n", "/etc/hostname\n", "a.mhd\na.mhd\n", "\x00\n", "a/" * 3000 + "\n"])
def test_lists_of_files_that_are_none_are_refused(tmp_path: Path, names: str) -> None:
    text = "".join(f"{name} = {given}\n" for name, given in (HEADER | {"DimSize": "20 20 20", "ElementDataFile": "LIST"}).items())
    (tmp_path / "a.mhd").write_text(text + names)
    with pytest.raises(InputError):
        read_volume(tmp_path / "a.mhd")


def test_every_cut_of_a_file_is_refused_or_read(files: list[ValidFile]) -> None:
    short = [
        f for f in files if f.kind in ("mesh binary.msh", "surface binary.ply", "surface binary.stl", "surface text.obj", "table wide.csv")
    ]
    assert len(short) == 5
    for file in short:
        content = file.target.read_bytes()
        for end in np.unique(np.linspace(0, len(content) - 1, 60).astype(int)):
            found = outcome(file, content[:end])
            assert found in ("read", "refused"), f"{file.kind} of {end} bytes: {found}"


def test_a_lost_chunk_of_a_zarr_store_is_not_taken_for_zeros(tmp_path: Path) -> None:
    values = np.zeros((70, 65, 66), dtype=np.int16)
    store = write_volume(tmp_path / "a.zarr", Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0)))
    assert (read_volume(store).values == 0).all()
    (store / "values" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(InputError, match="1 of its 8 chunks are missing"):
        read_volume(store)


def test_pages_that_follow_each_other_in_a_circle_end(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(zlib.decompress(base64.b85decode(CIRCLE_OF_PAGES)))
    with time_limit(), contextlib.suppress(InputError):
        read_volume(tmp_path / "a.tif")


def test_a_store_that_announces_endless_chunks_is_refused_quickly(tmp_path: Path) -> None:
    store = write_volume(tmp_path / "a.zarr", Volume.from_array(np.zeros((5, 6, 7), dtype=np.int16), spacing_mm=(1.0, 1.0, 1.0)))
    described = store / "values" / "zarr.json"
    stated = json.loads(described.read_text())
    described.write_text(json.dumps(stated | {"shape": [2**40, 2**20, 7]}))
    with time_limit(), pytest.raises(InputError, match="chunks are missing"):
        read_volume(store)


@pytest.mark.parametrize(
    ("old", "new"), [("spacing_mm = 10.0", "spacing_mm = 1e-308"), ("duration_s = 0.2", "duration_s = 0.2\nstep_s = 1e-308")]
)
def test_numbers_of_a_study_that_overflow_are_refused(old: str, new: str) -> None:
    with pytest.raises(InputError, match="must lie between"):
        load_study("mine.toml", STUDY.replace(old, new).encode())


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
