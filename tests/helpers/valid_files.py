"""A small valid file of every format that is read, and the reader that a user would call on it."""

from __future__ import annotations

import gzip
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from valid_point_files import cloud_files, foreign_fields, read_cloud, read_foreign

from naibu import datasets
from naibu.applications.mammography.breast_outline import breast_outline, mask_outline
from naibu.core.displacement_field import DisplacementField
from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.volume import Volume
from naibu.identification.from_fields.forward.load_cases import KnownRegion
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.io.displacement_fields import read_field, write_field
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.images import read_displacement, read_volume, write_displacement, write_volume
from naibu.io.meshes import read_mesh, read_surface
from naibu.io.study_schemas.lattice_study_schema import load_study
from naibu.io.tables.blade_table import read_blade_path, read_tip_path
from naibu.io.tables.marker_tables import import_markers
from naibu.io.tables.number_table import read_numbers
from naibu.io.vtk_files import write_vtu
from naibu.meshing.cutting.swept_blade import swept_blade
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box
from naibu.workflows.applications.fingertip_study import prepared_fingertip
from naibu.workflows.applications.simulate_chip import prepared_chip
from naibu.workflows.applications.simulate_ischemia import prepared_ischemia
from naibu.workflows.fields.block_mesh import block_mesh, labelled_object, names_of_labels
from naibu.workflows.results.result_folder import read_any_model, read_model
from naibu.workflows.studies.indentation_study import prepared_indentation
from naibu.workflows.studies.simulate import example_text


@dataclass(frozen=True)
class ValidFile:
    """One valid input.

    Attributes
    ----------
    kind : str
        Format, and the variant of it.
    target : Path
        The file whose bytes may be changed.
    read : callable
        Reads the whole input of which `target` is a part.
    """

    kind: str
    target: Path
    read: Callable[[], object]


def valid_files(folder: Path) -> list[ValidFile]:
    """Write every input into a folder of its own below `folder`."""
    return [
        *_volumes(folder),
        *_other_volumes(folder),
        *_dicom(folder),
        *_meshes(folder),
        *_surfaces(folder),
        *_tables(folder),
        *_texts(folder),
        *_fields(folder),
        *_records(folder),
        *(ValidFile(f"cloud {path.name}", path, lambda path=path: read_cloud(path)) for path in cloud_files(folder / "clouds")),
        *(
            ValidFile(f"foreign field {path.name}", path, lambda path=path: read_foreign(path))
            for path in foreign_fields(folder / "foreign")
        ),
    ]


def _volume() -> Volume:
    values = np.arange(5 * 6 * 7, dtype=np.int16).reshape(5, 6, 7)
    return Volume.from_array(values, spacing_mm=(1.0, 1.5, 2.0), origin_mm=(-3.0, 4.0, 5.5))


def _volumes(folder: Path) -> list[ValidFile]:
    volume, out = _volume(), []
    for name, compressed in (
        ("plain.mha", False),
        ("packed.mha", True),
        ("plain.mhd", False),
        ("plain.nii", False),
        ("packed.nii.gz", True),
        ("plain.nrrd", False),
        ("packed.nrrd", True),
        ("plain.tif", False),
        ("packed.tif", True),
        ("plain.h5", False),
        ("packed.h5", True),
    ):
        path = write_volume(folder / f"volume-{name}" / name, volume, compressed=compressed)
        out.append(ValidFile(f"volume {name}", path, lambda path=path: read_volume(path)))
    raw = folder / "volume-plain.mhd" / "plain.mhd"
    out.append(ValidFile("volume values beside plain.mhd", raw.with_suffix(".raw"), lambda: read_volume(raw)))
    field = np.zeros((*volume.shape, 3))
    for name in ("field.mha", "field.nrrd"):
        path = write_displacement(folder / f"vectors-{name}" / name, field, volume)
        out.append(ValidFile(f"displacement {name}", path, lambda path=path: read_displacement(path)))
    store = write_volume(folder / "volume-store" / "store.zarr", volume)
    out += [
        ValidFile(f"volume store.zarr {file.relative_to(store).as_posix()}", file, lambda: read_volume(store))
        for file in sorted(store.rglob("*"))
        if file.is_file()
    ]
    return out


def _other_volumes(folder: Path) -> list[ValidFile]:
    """Volumes in several files: headers with their values beside them, and slices in a folder."""
    import nibabel
    import tifffile

    values = _volume().values
    out = []
    for name, encoding, content in (("raw", "raw", values.tobytes()), ("gz", "gzip", gzip.compress(values.tobytes()))):
        head = f"NRRD0004\ntype: int16\ndimension: 3\nsizes: 7 6 5\nspacings: 1 1.5 2\nendian: little\nencoding: {encoding}\n"
        header = _written(folder / f"volume-nhdr-{name}" / "apart.nhdr", f"{head}data file: apart.{name}\n".encode())
        beside = _written(header.with_name(f"apart.{name}"), content)
        read = lambda header=header: read_volume(header)  # noqa: E731  of this header
        out += [
            ValidFile(f"volume apart.nhdr ({name})", header, read),
            ValidFile(f"volume values beside apart.nhdr ({name})", beside, read),
        ]
    pair = folder / "volume-pair" / "pair.hdr"
    pair.parent.mkdir(parents=True)
    nibabel.save(nibabel.Nifti1Pair(values.T, np.diag([1.0, 1.5, 2.0, 1.0])), pair)
    out += [ValidFile(f"volume {p.name}", p, lambda: read_volume(pair)) for p in (pair, pair.with_suffix(".img"))]
    stack = folder / "volume-stack"
    stack.mkdir()
    for k, plane in enumerate(values):
        tifffile.imwrite(stack / f"{k}.tif", plane)
    return [*out, ValidFile("volume slices of a stack", stack / "2.tif", lambda: read_volume(stack, spacing_mm=(1.0, 1.5, 2.0)))]


def _dicom(folder: Path) -> list[ValidFile]:
    import pydicom
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian

    series = folder / "dicom"
    series.mkdir(parents=True)
    for k in range(3):
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
        meta.MediaStorageSOPInstanceUID = f"1.2.3.{k + 1}"
        meta.TransferSyntaxUID = ExplicitVRLittleEndian
        slice_ = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
        slice_.SeriesInstanceUID, slice_.SOPInstanceUID = "1.2.3", f"1.2.3.{k + 1}"
        slice_.SOPClassUID = pydicom.uid.CTImageStorage
        slice_.Rows, slice_.Columns, slice_.SamplesPerPixel = 4, 5, 1
        slice_.PhotometricInterpretation, slice_.PixelRepresentation = "MONOCHROME2", 0
        slice_.BitsAllocated, slice_.BitsStored, slice_.HighBit = 16, 16, 15
        slice_.PixelSpacing, slice_.ImageOrientationPatient = [1.0, 1.0], [1, 0, 0, 0, 1, 0]
        slice_.ImagePositionPatient, slice_.SliceThickness = [0.0, 0.0, 2.0 * k], 2.0
        slice_.PixelData = np.full((4, 5), k, dtype=np.uint16).tobytes()
        slice_.save_as(series / f"{k}.dcm", enforce_file_format=True)
    return [ValidFile("dicom slice", series / "1.dcm", lambda: read_volume(series))]


def _meshes(folder: Path) -> list[ValidFile]:
    mesh = to_tetra(box((2.0, 2.0, 1.0), (2, 2, 1)))
    out = []
    path = folder / "mesh-vtu" / "body.vtu"
    write_vtu(path, mesh)
    out.append(ValidFile("mesh body.vtu", path, lambda path=path: read_mesh(path)))
    points = "\n".join(" ".join(map(str, p)) for p in mesh.points.tolist())
    cells = " ".join(str(i) for row in mesh.cells.tolist() for i in row)
    ascii_vtu = (
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian"><UnstructuredGrid>'
        f'<Piece NumberOfPoints="{len(mesh.points)}" NumberOfCells="{len(mesh.cells)}"><Points>'
        f'<DataArray type="Float64" NumberOfComponents="3" format="ascii">{points}</DataArray></Points><Cells>'
        f'<DataArray type="Int64" Name="connectivity" format="ascii">{cells}</DataArray>'
        f'<DataArray type="Int64" Name="offsets" format="ascii">{" ".join(str(4 * (i + 1)) for i in range(len(mesh.cells)))}</DataArray>'
        f'<DataArray type="UInt8" Name="types" format="ascii">{" ".join(["10"] * len(mesh.cells))}</DataArray>'
        "</Cells></Piece></UnstructuredGrid></VTKFile>"
    )
    nodes = "\n".join(f"{i + 1} {' '.join(map(str, p))}" for i, p in enumerate(mesh.points.tolist()))
    elements = "\n".join(f"{i + 1} 4 2 1 1 {' '.join(str(j + 1) for j in row)}" for i, row in enumerate(mesh.cells.tolist()))
    msh2 = (
        f'$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n1\n3 1 "gel"\n$EndPhysicalNames\n$Nodes\n{len(mesh.points)}\n{nodes}\n'
        f"$EndNodes\n$Elements\n{len(mesh.cells)}\n{elements}\n$EndElements\n"
    )
    tags = "\n".join(str(i + 1) for i in range(len(mesh.points)))
    numbered = "\n".join(f"{i + 1} {' '.join(str(j + 1) for j in row)}" for i, row in enumerate(mesh.cells.tolist()))
    n, m = len(mesh.points), len(mesh.cells)
    msh4 = (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Entities\n0 0 0 1\n1 0 0 0 2 2 1 0 0\n$EndEntities\n"
        f"$Nodes\n1 {n} 1 {n}\n3 1 0 {n}\n{tags}\n{points}\n$EndNodes\n$Elements\n1 {m} 1 {m}\n3 1 4 {m}\n{numbered}\n$EndElements\n"
    )
    binary = io.BytesIO()
    binary.write(b"$MeshFormat\n4.1 1 8\n" + np.int32(1).tobytes() + b"\n$EndMeshFormat\n$Nodes\n")
    binary.write(np.array([1, n, 1, n], dtype="<u8").tobytes() + np.array([3, 1, 0], dtype="<i4").tobytes() + np.uint64(n).tobytes())
    binary.write(np.arange(1, n + 1, dtype="<u8").tobytes() + mesh.points.astype("<f8").tobytes() + b"\n$EndNodes\n$Elements\n")
    binary.write(np.array([1, m, 1, m], dtype="<u8").tobytes() + np.array([3, 1, 4], dtype="<i4").tobytes() + np.uint64(m).tobytes())
    rows = np.column_stack([np.arange(1, m + 1), mesh.cells + 1]).astype("<u8")
    binary.write(rows.tobytes() + b"\n$EndElements\n")
    for name, content in (
        ("text.vtu", ascii_vtu.encode()),
        ("old.msh", msh2.encode()),
        ("new.msh", msh4.encode()),
        ("binary.msh", binary.getvalue()),
    ):
        path = _written(folder / f"mesh-{name}" / name, content)
        out.append(ValidFile(f"mesh {name}", path, lambda path=path: read_mesh(path)))
    return out


def _surfaces(folder: Path) -> list[ValidFile]:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    corner = "\n".join(f"{x} {y} {z}" for x, y, z in points.tolist())
    face = "\n".join(f"3 {a} {b} {c}" for a, b, c in faces.tolist())
    head = (
        "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 4\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    packed_faces = b"".join(b"\x03" + np.array(f, dtype="<i4").tobytes() for f in faces)
    facets = "".join(
        "facet normal 0 0 1\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in points[f].tolist()) + "endloop\nendfacet\n"
        for f in faces
    )
    binary_stl = b"\0" * 80 + np.uint32(4).tobytes()
    binary_stl += b"".join(np.concatenate([np.zeros(3), points[f].ravel()]).astype("<f4").tobytes() + b"\0\0" for f in faces)
    indices = ", ".join(f"{a}, {b}, {c}, -1" for a, b, c in faces.tolist())
    contents = {
        "text.ply": (head.format("ascii") + corner + "\n" + face + "\n").encode(),
        "binary.ply": head.format("binary_little_endian").encode() + points.astype("<f4").tobytes() + packed_faces,
        "text.stl": f"solid s\n{facets}endsolid s\n".encode(),
        "binary.stl": binary_stl,
        "text.obj": (
            "".join(f"v {x} {y} {z}\n" for x, y, z in points.tolist())
            + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces.tolist())
        ).encode(),
        "text.wrl": (
            "#VRML V2.0 utf8\nTransform { scale 1 1 1 rotation 0 0 1 0 children [\n"
            "Shape { geometry IndexedFaceSet { coord Coordinate { point [ "
            + ", ".join(f"{x} {y} {z}" for x, y, z in points.tolist())
            + f" ] }} coordIndex [ {indices} ] }} }} ] }}\n"
        ).encode(),
    }
    out = []
    for name, content in contents.items():
        path = _written(folder / f"surface-{name}" / name, content)
        out.append(ValidFile(f"surface {name}", path, lambda path=path: read_surface(path)))
    return out


def _tables(folder: Path) -> list[ValidFile]:
    import openpyxl

    rows = [("marker", "x_mm", "y_mm", "z_mm"), *((k, 1.0 * k, 2.0 * k, 3.5 * k) for k in range(1, 9))]
    text = "\n".join(",".join(map(str, row)) for row in rows) + "\n"
    contents = {"comma.csv": text.encode(), "tab.tsv": text.replace(",", "\t").encode(), "wide.csv": text.encode("utf-16")}
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    stream = io.BytesIO()
    book.save(stream)
    contents["sheet.xlsx"] = stream.getvalue()
    out = []
    for name, content in contents.items():
        path = _written(folder / f"table-{name}" / name, content)
        out.append(ValidFile(f"table {name}", path, lambda path=path: import_markers(path)))
    experiment = folder / "experiment"
    shutil.copytree(datasets.path("ct_cube_plate"), experiment)
    out += [
        ValidFile(f"experiment {name}", experiment / name, lambda: read_experiment(experiment))
        for name in ("meta.toml", "initial.csv", "height_45.csv")
    ]
    return out


def _texts(folder: Path) -> list[ValidFile]:
    study = _written(folder / "study" / "mine.toml", _study().encode())
    model = _written(folder / "model" / "model.json", json.dumps(_model()).encode())
    body = _written(folder / "body" / "model.json", json.dumps(_identified_body()).encode())
    return [
        ValidFile("lattice study", study, lambda: load_study(study, study.read_bytes())),
        ValidFile("model.json", model, lambda: read_model(model)),
        ValidFile("model.json of fields", body, lambda: read_any_model(body)),
    ]


def _fields(folder: Path) -> list[ValidFile]:
    """Displacement fields with covariance on a grid and at points, and as a table."""
    rng = np.random.default_rng(0)
    points, vectors = rng.random((30, 3)), rng.standard_normal((30, 3))
    at_points = DisplacementField.from_arrays(points, vectors, sd_mm=0.01)
    grid = _volume()
    on_grid = DisplacementField.on_grid(grid, np.zeros((*grid.shape, 3)), valid=np.ones(grid.shape, dtype=bool))
    places = [folder / f"field-{name}" / f"{name}.h5" for name in ("points", "grid")]
    for place, field in zip(places, (at_points, on_grid), strict=True):
        place.parent.mkdir(parents=True)
        write_field(place, field)
    rows = "\n".join(",".join(f"{v:.6g}" for v in row) for row in np.hstack([points, vectors, np.full((30, 3), 0.01)]))
    header = "x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,sd_x_mm,sd_y_mm,sd_z_mm"
    places.append(_written(folder / "field-table" / "table.csv", f"{header}\n{rows}\n".encode()))
    return [ValidFile(f"field {place.name}", place, lambda place=place: read_field(place)) for place in places]


def _records(folder: Path) -> list[ValidFile]:
    """Paths of tools, outlines of views, masks of zones, and studies of applications."""
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 31)
    outline = "\n".join(f"{x:.4f},{y:.4f}" for x, y in np.stack([80.0 * np.cos(turn), 60.0 * np.sin(turn)], axis=1).tolist())
    contents = {
        "blade.csv": "-1,-1,5,-1,21,5\n10,-1,5,10,21,6\n21,-1,5,21,21,5\n",
        "tip.csv": "x,y,z\n3,8,0\n10,8.5,0\n17,9,0\n",
        "outline.csv": outline,
        "record.csv": "".join(f"{0.1 * k:.2g},{0.01 * k:.3g}\n" for k in range(20)),
        "chip.toml": example_text("chip"),
        "fingertip.toml": example_text("fingertip"),
        "ischemia.toml": example_text("ischemia"),
        "indentation.toml": example_text("indentation"),
    }
    paths = {name: _written(folder / f"record-{name}" / name, text.encode()) for name, text in contents.items()}
    readers: dict[str, Callable[[Path], object]] = {
        "blade.csv": lambda path: swept_blade(read_blade_path(path)),
        "tip.csv": read_tip_path,
        "outline.csv": lambda path: breast_outline(read_numbers(path, ("deep", "along"))),
        "record.csv": lambda path: read_numbers(path, ("s", "mm")),
        "chip.toml": prepared_chip,
        "fingertip.toml": prepared_fingertip,
        "ischemia.toml": prepared_ischemia,
        "indentation.toml": prepared_indentation,
    }
    plane = np.zeros((1, 100, 60), dtype=np.uint8)
    y, x = np.mgrid[:100, :60]
    plane[0] = (x / 50.0) ** 2 + ((y - 50.0) / 40.0) ** 2 < 1.0
    mask = write_volume(folder / "record-mask" / "mask.mha", Volume.from_array(plane, spacing_mm=(1.6, 1.6, 1.0)))
    labels = np.zeros((8, 8, 8), dtype=np.uint8)
    labels[1:4, 1:7, 1:7], labels[4:7, 1:7, 1:7] = 1, 2
    zones = write_volume(folder / "record-zones" / "zones.mha", Volume.from_array(labels, spacing_mm=(2.0, 2.0, 2.0)))
    return [
        *(ValidFile(f"record {name}", path, lambda name=name: readers[name](paths[name])) for name, path in paths.items()),
        ValidFile("record mask.mha", mask, lambda: mask_outline(read_volume(mask).values[0], 1.6)),
        ValidFile("record zones.mha", zones, lambda: meshed_zones(zones)),
    ]


def meshed_zones(zones: Path) -> object:
    """Read a volume of labels, and mesh the object as `naibu identify` does with displacement fields."""
    inside, labels = labelled_object(None, zones)
    return block_mesh(inside, labels, names_of_labels(labels, inside, {}), 0.0)


def _study() -> str:
    from lattice_studies import STUDY

    return STUDY


def _identified_body() -> dict[str, object]:
    """A body of two cells as it is stored, one of them known."""
    mesh = box((2.0, 1.0, 1.0), (2, 1, 1))
    zones = csr_matrix(([1.0], ([0], [0])), shape=(2, 1))
    known, of_cell = (KnownRegion("pad", 10.0, 0.4, 0.0, 0.03),), np.array([-1, 0])
    theta, covariance = np.array([0.5, 2.0]), np.diag([0.01, 0.04])
    body = IdentifiedBody(
        mesh, np.eye(3), ("gel",), zones, theta, covariance, known, of_cell, "neo_hookean", False, 0.01, 1.1, 0.02, ("field",)
    )
    return body.to_dict()


def _model() -> dict[str, object]:
    """A calibrated model as it is stored, with two materials."""
    parameters = ParameterSet.of(
        [
            Parameter("soft: young_modulus", 100.0, "kPa", "log"),
            Parameter("soft: poisson_ratio", 0.48, "", "incompressibility", prior_sd=1.0),
            Parameter("firm: young_modulus", 200.0, "kPa", "log", fixed=True),
        ]
    )
    known = KnownMaterials({"firm": 200.0}, scale_is_absolute=True)
    return CalibratedModel(ModelSettings(), parameters, 0.01 * np.eye(2), NoiseModel(), 1.0, known, ("press/pressed",)).to_dict()


def _written(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path
