"""Mesh and surface files: every format in every encoding, and errors that say what is wrong."""

import base64
import lzma
import struct
import zlib

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.meshes import read_mesh, read_surface
from naibu.io.vtk_files import write_vtu

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
TETRA = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
MESH = Mesh.from_arrays(POINTS, TETRA, "tetra", regions=[1, 0], region_names=["gel <soft>", "棒"])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def vtu_text(encode, *, head="", appended="", types=(10, 10)) -> str:
    arrays = {
        "Points": (POINTS, "Float64", 'NumberOfComponents="3"'),
        "connectivity": (TETRA.ravel(), "Int64", ""),
        "offsets": (np.array([4, 8]), "Int64", ""),
        "types": (np.array(types, dtype=np.uint8), "UInt8", ""),
        "MaterialIds": (np.array([7, 5], dtype=np.int32), "Int32", ""),
    }
    made = {
        name: f'<DataArray type="{kind}" Name="{name}" {extra} {encode(values)}</DataArray>'
        for name, (values, kind, extra) in arrays.items()
    }
    cells = made["connectivity"] + made["offsets"] + made["types"]
    return (
        f'<VTKFile type="UnstructuredGrid" byte_order="LittleEndian" {head}><UnstructuredGrid>'
        f'<Piece NumberOfPoints="5" NumberOfCells="2"><Points>{made["Points"]}</Points><Cells>{cells}</Cells>'
        f"<CellData>{made['MaterialIds']}</CellData></Piece></UnstructuredGrid>{appended}</VTKFile>"
    )


def as_ascii(values: np.ndarray) -> str:
    return 'format="ascii">' + " ".join(str(v) for v in values.ravel())


def as_base64(values: np.ndarray) -> str:
    data = values.tobytes()
    return 'format="binary">\n' + base64.b64encode(struct.pack("<I", len(data)) + data).decode() + "\n"


def as_base64_apart(values: np.ndarray) -> str:
    data = values.tobytes()
    return 'format="binary">' + base64.b64encode(struct.pack("<I", len(data))).decode() + base64.b64encode(data).decode()


def compressed(values: np.ndarray, compress) -> str:
    data = values.tobytes()
    blocks = [compress(data[i : i + 16]) for i in range(0, len(data), 16)]
    header = struct.pack(f"<{3 + len(blocks)}Q", len(blocks), 16, len(data) % 16, *(len(block) for block in blocks))
    return 'format="binary">' + base64.b64encode(header).decode() + base64.b64encode(b"".join(blocks)).decode()


ENCODINGS = {
    "ascii": (as_ascii, ""),
    "base64": (as_base64, ""),
    "base64, header apart": (as_base64_apart, 'header_type="UInt32"'),
    "zlib": (lambda v: compressed(v, zlib.compress), 'header_type="UInt64" compressor="vtkZLibDataCompressor"'),
    "lzma": (lambda v: compressed(v, lzma.compress), 'header_type="UInt64" compressor="vtkLZMADataCompressor"'),
}


def assert_is_the_mesh(mesh: Mesh, names: tuple[str, ...]) -> None:
    np.testing.assert_array_equal(mesh.points, POINTS)
    np.testing.assert_array_equal(mesh.cells, TETRA)
    assert mesh.cell_type == "tetra"
    assert [names.index(mesh.region_names[r]) for r in mesh.regions] == [1, 0]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_vtu_in_every_encoding(tmp_path, encoding):
    encode, head = ENCODINGS[encoding]
    path = tmp_path / "a.vtu"
    path.write_text(vtu_text(encode, head=head))
    assert_is_the_mesh(read_mesh(path), ("region_5", "region_7"))


@pytest.mark.parametrize("raw", [True, False])
def test_vtu_with_appended_data(tmp_path, raw):
    pieces: list[bytes] = []

    def encode(values: np.ndarray) -> str:
        data = struct.pack("<I", values.nbytes) + values.tobytes()
        at = sum(map(len, pieces))
        pieces.append(data if raw else base64.b64encode(data))
        return f'format="appended" offset="{at}">'

    text = vtu_text(encode).replace("</VTKFile>", "")
    form = "raw" if raw else "base64"
    path = tmp_path / "a.vtu"
    path.write_bytes(text.encode() + f'<AppendedData encoding="{form}">\n _'.encode() + b"".join(pieces) + b"\n</AppendedData></VTKFile>")
    assert_is_the_mesh(read_mesh(path), ("region_5", "region_7"))
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(InputError, match="truncated"):
        read_mesh(path)


def test_own_vtu_round_trip_keeps_region_names(tmp_path):
    write_vtu(tmp_path / "a.vtu", MESH)
    again = read_mesh(tmp_path / "a.vtu")
    assert_is_the_mesh(again, ("gel <soft>", "棒"))
    assert again.region_names == MESH.region_names
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.vtu", unit_mm=1000).points, 1000 * POINTS)


def test_vtu_voxels_become_hexahedra(tmp_path):
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    text = (
        '<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints="8" NumberOfCells="1">'
        '<Points><DataArray type="Float32" NumberOfComponents="3" format="ascii">'
        f"{' '.join(map(str, corners.ravel()))}</DataArray></Points>"
        '<Cells><DataArray type="Int32" Name="connectivity" format="ascii">0 1 2 3 4 5 6 7</DataArray>'
        '<DataArray type="Int32" Name="offsets" format="ascii">8</DataArray>'
        '<DataArray type="UInt8" Name="types" format="ascii">11</DataArray></Cells></Piece></UnstructuredGrid></VTKFile>'
    )
    (tmp_path / "a.vtu").write_text(text)
    mesh = read_mesh(tmp_path / "a.vtu")
    assert mesh.cells.tolist() == [[0, 1, 3, 2, 4, 5, 7, 6]]
    assert mesh.region_names == ("body",)


NODES = [(3, *POINTS[0]), (5, *POINTS[1]), (9, *POINTS[2]), (4, *POINTS[3]), (11, *POINTS[4]), (20, 9.0, 9.0, 9.0)]
TAGGED = [[3, 5, 9, 4], [5, 9, 4, 11]]
PHYSICAL = '$PhysicalNames\n3\n2 1 "base"\n3 1 "hard bar"\n3 6 "gel"\n$EndPhysicalNames\n'


def gmsh_22() -> bytes:
    nodes = "\n".join(f"{tag} {x} {y} {z}" for tag, x, y, z in NODES)
    rows = ["1 15 2 0 1 3", "2 2 2 1 1 3 5 9"]
    rows += [f"{i + 3} 4 3 {group} {i + 1} 0 {' '.join(map(str, TAGGED[i]))}" for i, group in enumerate((6, 1))]
    elements = "\n".join(rows)
    head = f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{PHYSICAL}"
    return f"{head}$Nodes\n6\n{nodes}\n$EndNodes\n$Elements\n4\n{elements}\n$EndElements\n".encode()


def gmsh_41(binary: bool) -> bytes:
    def packed(*parts: tuple[str, tuple]) -> bytes:
        if binary:
            return b"".join(struct.pack(f"<{len(values)}{code}", *values) for code, values in parts)
        return " ".join(str(v) for _, values in parts for v in values).encode()

    box = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    entities = [("Q", (1, 0, 1, 2)), ("i", (1,)), ("d", (0.0, 0.0, 0.0)), ("Q", (0,))]
    entities += [("i", (1,)), ("d", box), ("Q", (1,)), ("i", (1,)), ("Q", (0,))]
    for tag, physical in ((1, 6), (2, -1)):
        entities += [("i", (tag,)), ("d", box), ("Q", (1,)), ("i", (physical,)), ("Q", (1,)), ("i", (1,))]
    nodes = [("Q", (2, 6, 3, 20)), ("i", (2, 1, 1)), ("Q", (2,)), ("Q", (3, 5))]
    nodes += [("d", (*node[1:], 0.5, 0.5)) for node in NODES[:2]]
    nodes += [("i", (3, 1, 0)), ("Q", (4,)), ("Q", tuple(node[0] for node in NODES[2:]))] + [("d", node[1:]) for node in NODES[2:]]
    elements = [("Q", (3, 3, 1, 3)), ("i", (2, 1, 2)), ("Q", (1,)), ("Q", (1, 3, 5, 9))]
    for i, cell in enumerate(TAGGED):
        elements += [("i", (3, i + 1, 4)), ("Q", (1,)), ("Q", (i + 2, *cell))]
    head = b"$MeshFormat\n4.1 1 8\n" + struct.pack("<i", 1) + b"\n" if binary else b"$MeshFormat\n4.1 0 8\n"
    sections = {"Entities": entities, "Nodes": nodes, "Elements": elements}
    body = b"".join(f"${name}\n".encode() + packed(*parts) + f"\n$End{name}\n".encode() for name, parts in sections.items())
    return head + b"$EndMeshFormat\n" + PHYSICAL.encode() + body


GMSH = {"2.2": gmsh_22, "4.1 ascii": lambda: gmsh_41(False), "4.1 binary": lambda: gmsh_41(True)}


@pytest.mark.parametrize("version", GMSH)
def test_gmsh_versions(tmp_path, version):
    path = tmp_path / "a.msh"
    path.write_bytes(GMSH[version]())
    mesh = read_mesh(path)
    # Node 20 belongs to no cell and is left out.
    assert_is_the_mesh(mesh, ("hard bar", "gel"))
    assert mesh.region_names == ("hard bar", "gel")


@pytest.mark.parametrize("version", GMSH)
@pytest.mark.parametrize("fraction", [0.3, 0.6, 0.8, 0.93])
def test_truncated_gmsh_files_are_named(tmp_path, version, fraction):
    data = GMSH[version]()
    path = tmp_path / "a.msh"
    path.write_bytes(data[: int(fraction * len(data))])
    with pytest.raises(InputError, match=r"a\.msh: .*(truncated|has no section|not a number)"):
        read_mesh(path)


def test_gmsh_tetra10_is_renumbered(tmp_path):
    rng = np.random.default_rng(0)
    nodes = "\n".join(f"{i + 1} {x} {y} {z}" for i, (x, y, z) in enumerate(rng.random((10, 3))))
    element = "1 11 2 0 1 " + " ".join(str(i + 1) for i in range(10))
    path = tmp_path / "a.msh"
    path.write_text(f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n10\n{nodes}\n$EndNodes\n$Elements\n1\n{element}\n$EndElements\n")
    mesh = read_mesh(path)
    assert mesh.cells.tolist() == [[0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    assert mesh.region_names == ("body",)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.vtu", vtu_text(as_ascii, types=(13, 10)), "'wedge'"),
        ("a.vtu", vtu_text(as_ascii, types=(5, 5)), "no volume cells"),
        ("a.vtu", vtu_text(as_ascii, types=(99, 10)), "VTK type 99"),
        ("a.vtu", vtu_text(as_ascii)[:400], "truncated"),
        ("a.vtu", vtu_text(as_ascii).replace("UnstructuredGrid", "PolyData"), "PolyData"),
        ("a.vtu", vtu_text(as_ascii, head='compressor="vtkLZ4DataCompressor"'), "vtkLZ4DataCompressor"),
        ("a.vtu", vtu_text(lambda v: as_base64(v).replace("AAAA", "A")), "damaged or truncated"),
        ("a.msh", "nothing", r"\$MeshFormat"),
        ("a.msh", "$MeshFormat\n4 0 8\n", "version 4, ascii"),
        ("a.msh", gmsh_22().decode().replace("3 4 3 6", "3 44 3 6"), "type 44"),
        ("a.msh", gmsh_22().decode().replace("5 9 4 11", "5 9 4 12"), "node 12"),
        ("a.stl", "", "read_surface"),
        ("a.xyz", "", "'.xyz'"),
    ],
)
def test_meshes_that_cannot_be_read_say_why(tmp_path, name, content, told):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=told):
        read_mesh(tmp_path / name)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_mesh(tmp_path / "nowhere.vtu")
    with pytest.raises(InputError, match="unit_mm"):
        write_vtu(tmp_path / "a.vtu", MESH)
        read_mesh(tmp_path / "a.vtu", unit_mm=0)


def stl_ascii() -> bytes:
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n" + "".join(f"  vertex {x} {y} {z}\n" for x, y, z in POINTS[t]) + " endloop\nendfacet\n"
        for t in TRIANGLES
    )
    return f"solid made by hand\n{facets}endsolid\n".encode()


def stl_binary() -> bytes:
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *POINTS[t].ravel(), 0) for t in TRIANGLES)
    return b"solid but binary".ljust(80) + struct.pack("<I", len(TRIANGLES)) + facets


def ply(form: str, *, extra: bool = False) -> bytes:
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    colour = "property uchar red\n" if extra else ""
    head = (
        f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n{colour}"
        "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if not order:
        vertices = "".join(f"{x} {y} {z}{' 255' if extra else ''}\n" for x, y, z in POINTS[:4])
        return (head + vertices + "".join(f"3 {a} {b} {c}\n" for a, b, c in TRIANGLES)).encode()
    vertices_b = b"".join(struct.pack(order + ("3fB" if extra else "3f"), *p, *([255] if extra else [])) for p in POINTS[:4])
    return head.encode() + vertices_b + b"".join(struct.pack(order + "B3i", 3, *t) for t in TRIANGLES)


def obj() -> bytes:
    rows = [f"v {x} {y} {z}" for x, y, z in POINTS[:4]] + ["vn 0 0 1", "usemtl gel"]
    rows += [f"f {a + 1}//1 {b + 1}//1 {c + 1}//1" for a, b, c in TRIANGLES[:2]]
    rows += [f"f {a - 4}/1 {b - 4}/1 {c - 4}/1" for a, b, c in TRIANGLES[2:]]
    return "\n".join(rows).encode()


def vrml(*, field: str = "", ccw: str = "TRUE") -> bytes:
    points = ", ".join(f"{x} {y} {z}" for x, y, z in POINTS[:4])
    index = " ".join(f"{a}, {b}, {c}, -1," for a, b, c in TRIANGLES)
    return (
        f"#VRML V2.0 utf8\nTransform {{ {field} children [ Shape {{ # coordIndex [ no ]\n geometry IndexedFaceSet {{ ccw {ccw}\n"
        f" coord Coordinate {{ point [ {points} ] }}\n texCoordIndex [ 0 0 0 -1 ] coordIndex [ {index} ] }} }} ] }}\n"
    ).encode()


SURFACES = {
    "a.stl": stl_ascii(),
    "b.STL": stl_binary(),
    "a.ply": ply("ascii"),
    "b.ply": ply("binary_little_endian"),
    "c.ply": ply("binary_big_endian", extra=True),
    "d.ply": ply("ascii", extra=True),
    "a.obj": obj(),
    "a.wrl": vrml(field="scale 1 1 1 rotation 0 0 1 0 "),
}


@pytest.mark.parametrize("name", SURFACES)
def test_surfaces_in_every_format(tmp_path, name):
    (tmp_path / name).write_bytes(SURFACES[name])
    surface = read_surface(tmp_path / name)
    assert surface.points.shape == (4, 3)
    np.testing.assert_array_equal(surface.points[surface.triangles], POINTS[TRIANGLES])
    np.testing.assert_array_equal(read_surface(tmp_path / name, unit_mm=10).points, 10 * surface.points)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_polygons_of_different_size_are_cut_into_fans(tmp_path, form):
    head = f"ply\nformat {form} 1.0\nelement vertex 5\nproperty double x\nproperty double y\nproperty double z\n"
    head += "element face 2\nproperty uchar shade\nproperty list uchar int vertex_index\nend_header\n"
    if form == "ascii":
        body = ("\n".join(f"{x} {y} {z}" for x, y, z in POINTS) + "\n9 4 0 1 2 3\n9 3 1 2 4\n").encode()
    else:
        body = POINTS.astype("<f8").tobytes() + struct.pack("<BB4i", 9, 4, 0, 1, 2, 3) + struct.pack("<BB3i", 9, 3, 1, 2, 4)
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    assert read_surface(tmp_path / "a.ply").triangles.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 4]]


def test_vrml_clockwise_faces_are_turned(tmp_path):
    (tmp_path / "a.wrl").write_bytes(vrml(ccw="FALSE"))
    assert read_surface(tmp_path / "a.wrl").triangles.tolist() == TRIANGLES[:, ::-1].tolist()


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.stl", stl_binary()[:-7], "announces 4 facets but contains 3"),
        ("a.stl", stl_ascii()[:-90], "truncated"),
        ("a.stl", b"solid facet endsolid", "no facet"),
        ("a.ply", b"plx", "no PLY header"),
        ("a.ply", ply("binary_little_endian")[:-5], "truncated inside its 'face'"),
        ("a.ply", ply("ascii")[:-9], "truncated inside its 'face'"),
        ("a.ply", ply("ascii").replace(b"property float z", b"property float w"), "lacks"),
        ("a.ply", ply("ascii").replace(b"float x", b"half x"), "'half'"),
        ("a.obj", obj() + b"\nf 1 2 9", "refers to point 8"),
        ("a.obj", b"v 1 2\n", "line 1"),
        ("a.obj", b"v 1 2 3\n", "no faces"),
        ("a.obj", b"v 1 2 x\n", "not a number"),
        ("a.wrl", vrml().replace(b"V2.0", b"V1.0"), "VRML 2.0"),
        ("a.wrl", vrml(field="translation 0 5 0 "), "translation"),
        ("a.wrl", vrml(field="rotation 0 0 1 1.57 "), "rotation"),
        ("a.wrl", vrml(field="scale 2 2 2 ").replace(b"scale 2 2 2 ", b"scale 2,2,2}Transform{"), "scale"),
        ("a.wrl", vrml()[:-40], "truncated"),
        ("a.vtu", b"", "read_mesh"),
    ],
)
def test_surfaces_that_cannot_be_read_say_why(tmp_path, name, content, told):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=told):
        read_surface(tmp_path / name)
