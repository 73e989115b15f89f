"""Displacement fields of other programs, from small files made by hand after their documentation: the same vectors at the same places."""

from __future__ import annotations

import warnings
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from naibu.core.errors import InputError
from naibu.io.displacement_fields import read_field

SHAPE = (3, 4, 5)  # z, y, x
SPACING, ORIGIN = np.array([1.0, 1.5, 2.0]), np.array([10.0, -20.0, 30.0])
DIRECTION = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
VECTORS = np.random.default_rng(0).normal(size=(*SHAPE, 3)).round(3)
LAST = (2, 3, 4)  # a voxel: index 4 along x, 3 along y, 2 along z
# its place: each axis by itself
PLACE = ORIGIN + DIRECTION @ (SPACING * np.array([4.0, 3.0, 2.0]))
AFFINE_RAS = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.block([[DIRECTION * SPACING, ORIGIN[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
FIXED = [*SHAPE[::-1], *ORIGIN, *SPACING, *DIRECTION.ravel()]
POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 7.0], [0.5, 8.0, 2.0]])
MOVED = np.array([[0.1, 0.2, -0.3], [0.4, -0.5, 0.6], [0.0, 0.25, 0.75]])


def check_grid(path: Path, vectors: np.ndarray = VECTORS) -> None:
    """All vectors are those of LPS, and the last voxel lies where it should."""
    field = read_field(path)
    np.testing.assert_allclose(field.vectors, vectors, atol=1e-6)
    np.testing.assert_allclose(field.points.reshape(*SHAPE, 3)[LAST], PLACE, atol=1e-5)


def nifti(path: Path, vectors: np.ndarray, intent: int, name: str = "") -> Path:
    """Write vectors (nz, ny, nx, 3) along the fifth axis, as they stand."""
    image = nibabel.Nifti1Image(vectors.transpose(2, 1, 0, 3)[:, :, :, None], AFFINE_RAS)
    image.header["intent_code"], image.header["intent_name"] = intent, name
    nibabel.save(image, path)
    return path


def test_ants_writes_lps_vectors_and_the_standard_ras(tmp_path: Path) -> None:
    check_grid(nifti(tmp_path / "1Warp.nii.gz", VECTORS, 1007))
    check_grid(nifti(tmp_path / "ras.nii", VECTORS * (-1.0, -1.0, 1.0), 1006))


@pytest.mark.parametrize("kind", ["affine", "euler", "euler zyx"])
def test_the_linear_transform_of_ants_follows_its_warp(tmp_path: Path, kind: str) -> None:
    """As ITK itself writes it (MATLAB, version 4) and applies it to the ends of the vectors."""
    sitk = pytest.importorskip("SimpleITK")
    if kind == "affine":
        linear = sitk.AffineTransform(3)
        linear.SetMatrix([1.02, 0.1, -0.05, 0.03, 0.97, 0.08, -0.02, 0.04, 1.05])
    else:
        linear = sitk.Euler3DTransform()
        linear.SetRotation(0.2, -0.3, 0.5)
        linear.SetComputeZYX(kind == "euler zyx")
    linear.SetCenter((3.0, -4.0, 5.0))
    linear.SetTranslation((1.0, 2.0, -3.0))
    sitk.WriteTransform(linear, str(tmp_path / "sub0GenericAffine.mat"))
    warp = nifti(tmp_path / "sub1Warp.nii.gz", VECTORS, 1007)
    field = read_field(warp)
    ends = field.points.reshape(*SHAPE, 3) + VECTORS
    expected = np.array([linear.TransformPoint(p) for p in ends.reshape(-1, 3)]).reshape(ends.shape)
    np.testing.assert_allclose(field.vectors, expected - (ends - VECTORS), atol=1e-5)
    warp.rename(tmp_path / "alone1Warp.nii.gz")
    check_grid(tmp_path / "alone1Warp.nii.gz")


def test_what_lies_beside_a_warp_and_is_no_linear_transform_is_refused(tmp_path: Path) -> None:
    warp = nifti(tmp_path / "1Warp.nii.gz", VECTORS, 1007)
    for stored, words in (
        ({"other": np.eye(3)}, "no linear transform"),
        ({"BSplineTransform_double_3_3": np.ones(9), "fixed": np.ones(3)}, "BSpline"),
    ):
        savemat(tmp_path / "0GenericAffine.mat", stored, format="4")
        with pytest.raises(InputError, match=words):
            read_field(warp)
    (tmp_path / "0GenericAffine.mat").write_bytes(b"no matlab at all, but long enough to be looked at " * 10)
    with pytest.raises(InputError, match="0GenericAffine"):
        read_field(warp)


def test_the_inverse_warp_of_ants_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"leads from the moving image to the fixed one.* is in sub1Warp\.nii\.gz"):
        read_field(nifti(tmp_path / "sub1InverseWarp.nii.gz", VECTORS, 1007))


def test_warps_that_mean_something_else_are_refused(tmp_path: Path) -> None:
    for intent, name, words in ((2006, "", "a warp of FSL"), (1007, "NREG_TRANS", "a warp of NiftyReg"), (0, "", "intent 0")):
        with pytest.raises(InputError, match=words):
            read_field(nifti(tmp_path / "other.nii", VECTORS, intent, name))
    with pytest.raises(InputError, match=r"\(nx, ny, nz, 1, 3\)"):
        read_field(nifti(tmp_path / "two.nii", VECTORS[..., :2], 1007))


def test_elastix_writes_vectors_of_a_metaimage(tmp_path: Path) -> None:
    header = (
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n"
        "TransformMatrix = 0 1 0 -1 0 0 0 0 1\nOffset = 10 -20 30\nCenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\n"
        "ElementSpacing = 1 1.5 2\nDimSize = 5 4 3\nElementNumberOfChannels = 3\nElementType = MET_FLOAT\n"
        "ElementDataFile = deformationField.raw\n"
    )
    (tmp_path / "deformationField.mhd").write_text(header)
    (tmp_path / "deformationField.raw").write_bytes(VECTORS.astype("<f4").tobytes())
    check_grid(tmp_path / "deformationField.mhd")


def store(group: h5py.Group, number: int, kind: str, parameters: object, fixed: object, typo: str = "Transform") -> None:
    own = group.create_group(str(number))
    own.create_dataset("TransformType", data=np.array([kind.encode()]))
    if parameters is not None:
        own.create_dataset(f"{typo}Parameters", data=np.asarray(parameters, dtype=float))
        own.create_dataset(f"{typo}FixedParameters", data=np.asarray(fixed, dtype=float))


@pytest.mark.parametrize("typo", ["Transform", "Tranform"])
def test_a_transform_of_itk_alone_and_before_an_affine_one(tmp_path: Path, typo: str) -> None:
    with h5py.File(tmp_path / "alone.h5", "w") as root:
        group = root.create_group("TransformGroup")
        store(group, 0, "DisplacementFieldTransform_double_3_3", VECTORS.ravel(), FIXED, typo)
    check_grid(tmp_path / "alone.h5")
    matrix, centre, shift = (
        np.array([[1.1, 0.1, 0.0], [0.0, 0.9, 0.0], [0.0, -0.2, 1.0]]),
        np.array([5.0, 6.0, 7.0]),
        np.array([1.0, 2.0, 3.0]),
    )
    with h5py.File(tmp_path / "Composite.h5", "w") as root:
        group = root.create_group("TransformGroup")
        store(group, 0, "CompositeTransform_double_3_3", None, None)
        store(group, 1, "AffineTransform_double_3_3", [*matrix.ravel(), *shift], centre, typo)
        store(group, 2, "DisplacementFieldTransform_double_3_3", VECTORS.ravel(), FIXED, typo)
    at = read_field(tmp_path / "alone.h5").points.reshape(*SHAPE, 3)
    expected = (at + VECTORS - centre) @ matrix.T + centre + shift - at
    check_grid(tmp_path / "Composite.h5", expected)


def test_a_transform_as_text(tmp_path: Path) -> None:
    numbers = " ".join(map(str, VECTORS.ravel()))
    fixed = " ".join(map(str, FIXED))
    head = "#Insight Transform File V1.0\n#Transform 0\n"
    path = tmp_path / "field.tfm"
    path.write_text(f"{head}Transform: DisplacementFieldTransform_double_3_3\nParameters: {numbers}\nFixedParameters: {fixed}\n")
    check_grid(path)
    path.write_text(f"{head}Transform: AffineTransform_double_3_3\nParameters: 1 0 0 0 1 0 0 0 1 0 0 0\nFixedParameters: 0 0 0\n")
    with pytest.raises(InputError, match=r"field\.tfm: holds AffineTransform_double_3_3; naibu reads one DisplacementFieldTransform"):
        read_field(path)
    path.write_text(f"{head}Transform: DisplacementFieldTransform_double_3_3\nParameters: 1 2 3\nFixedParameters: {fixed}\n")
    with pytest.raises(InputError, match=r"states \[5.0, 4.0, 3.0\] voxels, but has 3 parameters"):
        read_field(path)


def splines(coefficients: np.ndarray) -> str:
    """Return a B-spline transform as text, with coefficients (nz, ny, nx, 3)."""
    numbers = " ".join(map(str, np.moveaxis(coefficients, -1, 0).ravel()))
    fixed = " ".join(map(str, [*coefficients.shape[2::-1], *FIXED[3:]]))
    head = "#Insight Transform File V1.0\n#Transform 0\nTransform: BSplineTransform_double_3_3"
    return f"{head}\nParameters: {numbers}\nFixedParameters: {fixed}\n"


def test_b_splines_whose_coefficients_are_linear_are_linear(tmp_path: Path) -> None:
    z, y, x = np.indices((5, 6, 7))
    gradient = np.array([[0.1, 0.02, 0.0], [0.0, -0.05, 0.03], [0.01, 0.0, 0.2]])
    index = np.stack([x, y, z], axis=-1)
    (tmp_path / "splines.tfm").write_text(splines(index @ gradient.T))
    field = read_field(tmp_path / "splines.tfm")
    inner = index[1:-1, 1:-1, 1:-1]
    assert field.grid.shape == (3, 4, 5)
    np.testing.assert_allclose(field.vectors, inner @ gradient.T, atol=1e-12)
    np.testing.assert_allclose(field.points.reshape(3, 4, 5, 3), ORIGIN + (inner * SPACING) @ DIRECTION.T, atol=1e-12)
    (tmp_path / "few.tfm").write_text(splines(np.zeros((3, 6, 7, 3))))
    with pytest.raises(InputError, match="has 7 x 6 x 3 control points; cubic ones need 4"):
        read_field(tmp_path / "few.tfm")


@pytest.mark.parametrize("ending", [".tfm", ".txt", ".h5"])
def test_b_splines_followed_by_an_affine_transform_are_those_of_itk(tmp_path: Path, ending: str) -> None:
    sitk = pytest.importorskip("SimpleITK")
    path = tmp_path / "moved.tfm"
    path.write_text(splines(np.random.default_rng(1).normal(size=(6, 5, 7, 3))))
    affine = sitk.AffineTransform([1.02, 0.1, -0.05, 0.03, 0.97, 0.08, -0.02, 0.04, 1.05], (1.0, 2.0, -3.0), (3.0, -4.0, 5.0))
    whole = sitk.CompositeTransform([affine, sitk.ReadTransform(str(path))])
    sitk.WriteTransform(whole, str(tmp_path / f"whole{ending}"))
    field = read_field(tmp_path / f"whole{ending}")
    at, moved = (a.reshape(4, 3, 5, 3)[1:-1, 1:-1, 1:-1].reshape(-1, 3) for a in (field.points, field.vectors))
    np.testing.assert_allclose(moved, [np.subtract(whole.TransformPoint(p), p) for p in at], atol=1e-9)


def test_files_that_hold_a_field_in_another_way_tell_what_to_do(tmp_path: Path) -> None:
    for name, content, words in (
        ("TransformParameters.0.txt", '(Transform "BSplineTransform")\n(NumberOfParameters 3)\n', "transformix -def all"),
        ("B00001.vc7", "", r"export the vectors in DaVis as Tecplot text \(\.dat\)"),
        ("solution.vti", "", r"save it in ParaView as \.vtu"),
    ):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputError, match=words):
            read_field(tmp_path / name)
    savemat(tmp_path / "itk.mat", {"DisplacementFieldTransform_double_3_3": np.ones(3), "fixed": np.ones(3)}, format="4")
    with pytest.raises(InputError, match=r"a transform of ITK; write it as \.h5"):
        read_field(tmp_path / "itk.mat", spacing_mm=(1.0, 1.0, 1.0))


def test_spam_counts_in_voxels_and_marks_what_converged(tmp_path: Path) -> None:
    names = "NodeNumber Zpos Ypos Xpos Fzz Fzy Fzx Zdisp Fyz Fyy Fyx Ydisp Fxz Fxy Fxx Xdisp error iterations returnStatus deltaPhiNorm"
    header = names.replace(" ", "\t")
    rows = [
        [k, *p[::-1], 1, 0, 0, u[2], 0, 1, 0, u[1], 0, 0, 1, u[0], 0.1, 5, status, 0.01]
        for k, (p, u, status) in enumerate(zip(POINTS.tolist(), MOVED.tolist(), (2, 2, -1), strict=True))
    ]
    path = tmp_path / "01-02-ldic.tsv"
    path.write_text("\n".join([header, *("\t".join(f"{v:.7f}" for v in row) for row in rows)]) + "\n")
    with pytest.raises(InputError, match="a table of SPAM, in voxels; give spacing_mm"):
        read_field(path)
    field = read_field(path, spacing_mm=(0.1, 0.1, 0.4))
    np.testing.assert_allclose(field.points, POINTS * (0.1, 0.1, 0.4))
    np.testing.assert_allclose(field.vectors[:2], MOVED[:2] * (0.1, 0.1, 0.4))
    assert field.valid.tolist() == [True, True, False]
    guess = [header, *("\t".join(f"{v:.7f}" for v in [*row[:-2], 1, row[-1]]) for row in rows)]  # spam-pixelSearch, spam-passPhiField
    (tmp_path / "guess.tsv").write_text("\n".join(guess) + "\n")
    with pytest.raises(InputError, match=r"no node has the returnStatus 2.*take what spam-ldic writes"):
        read_field(tmp_path / "guess.tsv", spacing_mm=(0.1, 0.1, 0.4))


def spam_image(file: Path, values: np.ndarray) -> None:
    """Write one component, by the call that SPAM makes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        tifffile.imwrite(file, values.astype("<f4"))


def spam_images(folder: Path, scan: tuple[int, int, int], ns: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Write what ``spam-ldic -ns Z Y X -tif`` writes of a scan of (z, y, x) voxels, and return nodes and displacements, x, y, z, voxels.

    Nodes as by its ``makeGrid``; displacements differ along all axes, so that no exchange goes unnoticed. Four nodes along x are marked
    as colours by tifffile.
    """
    nodes = np.mgrid[ns[0] : scan[0] : ns[0], ns[1] : scan[1] : ns[1], ns[2] : scan[2] : ns[2]]
    z, y, x = nodes
    moved = {"X": 0.01 * x + 0.001 * y, "Y": 0.02 * y - 0.003 * z, "Z": 0.05 * z + 0.002 * x}
    status = np.full(z.shape, 2.0)
    status[0, 1, 2] = -1
    for axis, values in moved.items():
        spam_image(folder / f"01-02-ldic-{axis}disp.tif", values)
    spam_image(folder / "01-02-ldic-returnStatus.tif", status)
    return np.stack([n.ravel() for n in (x, y, z)], axis=1), np.stack([moved[a].ravel() for a in "XYZ"], axis=1)


def test_images_of_spam_lie_at_the_nodes_of_its_grid(tmp_path: Path) -> None:
    nodes, moved = spam_images(tmp_path, (31, 45, 50), (10, 15, 12))
    size = np.array([0.1, 0.2, 0.4])
    known = {"spacing_mm": tuple(size), "node_spacing": (12, 15, 10)}
    field = read_field(tmp_path / "01-02-ldic-Zdisp.tif", **known)
    np.testing.assert_allclose(field.points, nodes * size)
    good = np.delete(np.arange(len(nodes)), 1 * 4 + 2)  # the node of z 10, y 30, x 36
    assert field.valid.sum() == len(good) and field.valid[good].all()
    np.testing.assert_allclose(field.vectors[good], (moved * size)[good], rtol=1e-6)
    np.testing.assert_array_equal(read_field(tmp_path / "01-02-ldic-Xdisp.tif", **known).vectors, field.vectors)
    (tmp_path / "01-02-ldic-returnStatus.tif").unlink()  # as spam-filterPhiField, which writes none
    assert read_field(tmp_path / "01-02-ldic-Ydisp.tif", **known).valid.all()


def test_images_of_spam_that_do_not_tell_enough(tmp_path: Path) -> None:
    spam_images(tmp_path, (31, 45, 50), (10, 15, 12))
    one, known = tmp_path / "01-02-ldic-Zdisp.tif", {"spacing_mm": (1.0, 1.0, 1.0), "node_spacing": (12, 15, 10)}
    with pytest.raises(InputError, match=r"give spacing_mm, the size of a voxel.* and node_spacing, the voxels from node to node"):
        read_field(one)
    with pytest.raises(InputError, match="node_spacing is 0; give a number from 1 to 10000 voxels"):
        read_field(one, spacing_mm=(1.0, 1.0, 1.0), node_spacing=(0.0, 15, 10))
    with pytest.raises(InputError, match="node_spacing goes with TIFF files of SPAM"):
        read_field(tmp_path / "field.h5", node_spacing=(12, 15, 10))
    with pytest.raises(InputError, match=r"is one of SPAM's -Zdisp\.tif"):
        read_field(tmp_path / "01-02-ldic-returnStatus.tif", **known)
    spam_image(tmp_path / "01-02-ldic-returnStatus.tif", np.ones((3, 2, 4)))
    with pytest.raises(InputError, match="no node has the returnStatus 2"):
        read_field(one, **known)
    spam_image(tmp_path / "01-02-ldic-returnStatus.tif", np.full((3, 2, 5), 2.0))
    with pytest.raises(InputError, match=r"must have one shape: .*returnStatus.tif \(3, 2, 5\)"):
        read_field(one, **known)
    (tmp_path / "01-02-ldic-Zdisp.tif").unlink()
    with pytest.raises(InputError, match="SPAM leaves out Z of images in the plane"):
        read_field(tmp_path / "01-02-ldic-Xdisp.tif", **known)


def test_aldvc_counts_from_one_node_after_the_other(tmp_path: Path) -> None:
    result = np.empty((1, 1), dtype=object)
    result[0, 0] = {"U": MOVED.reshape(-1, 1), "ULocalICGN": MOVED.reshape(-1, 1)}
    savemat(tmp_path / "results.mat", {"ResultDisp": result, "DVCmesh": {"coordinatesFEM": POINTS + 1.0, "elementsFEM": np.ones((1, 8))}})
    field = read_field(tmp_path / "results.mat", spacing_mm=(0.5, 0.5, 2.0))
    np.testing.assert_allclose(field.points, POINTS * (0.5, 0.5, 2.0))
    np.testing.assert_allclose(field.vectors, MOVED * (0.5, 0.5, 2.0))
    with pytest.raises(InputError, match="a result of ALDVC, in voxels"):
        read_field(tmp_path / "results.mat")
    several = np.empty((2, 1), dtype=object)
    several[0, 0] = several[1, 0] = result[0, 0]
    for stored, words in (
        ({"x": POINTS}, "lacks ResultDisp, and has x"),
        ({"ResultDisp": result}, "lacks DVCmesh"),
        ({"ResultDisp": several, "DVCmesh": {"coordinatesFEM": POINTS}}, "of 2 states"),
        ({"ResultDisp": result, "DVCmesh": {"coordinatesFEM": POINTS[:2]}}, r"shape \(2, 3\) and U \(9, 1\)"),
        ({"ResultDisp": result, "DVCmesh": {"nodes": POINTS}}, "no coordinatesFEM"),
    ):
        savemat(tmp_path / "bad.mat", stored)
        with pytest.raises(InputError, match=words):
            read_field(tmp_path / "bad.mat", spacing_mm=(1.0, 1.0, 1.0))


def test_davis_names_units_and_marks_what_is_valid(tmp_path: Path) -> None:
    rows = "\n".join(f"{x} {y} {z} {u} {v} {w} {k != 1:d}" for k, ((x, y, z), (u, v, w)) in enumerate(zip(POINTS, MOVED, strict=True)))
    path = tmp_path / "B00001.dat"
    names = 'VARIABLES = "x[mm]" "y[mm]" "z[mm]" "Vx[mm]" "Vy[mm]" "Vz[mm]" "isValid"'
    head = f'TITLE = "B00001"\n{names}\nZONE T="Snapshot 0000"\nI=3, J=1, K=1, ZONETYPE = Ordered\nDATAPACKING = POINT\n'
    path.write_text(head + rows + "\n")
    field = read_field(path)
    np.testing.assert_allclose(field.points, POINTS)
    np.testing.assert_allclose(field.vectors[[0, 2]], MOVED[[0, 2]])
    assert field.valid.tolist() == [True, False, True]
    for text, words in (
        (head.replace("Vx[mm]", "Vx[m/s]") + rows, "2 columns of displacements"),
        (head.replace("POINT", "BLOCK") + rows, "by blocks"),
        (head + rows + "\nZONE T=2\n" + rows, "line 9: a second zone begins"),
        (head + "1 2 3\n", "line 6 holds no 7 numbers"),
        ("1 2 3\n", "is no Tecplot text file"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_field(path)


def test_davis_in_voxels_is_read_with_their_size(tmp_path: Path) -> None:
    rows = "\n".join(f"{x} {y} {z} {u} {v} {w} 1" for (x, y, z), (u, v, w) in zip(POINTS, MOVED, strict=True))
    names = 'VARIABLES = "x[voxel]" "y[voxel]" "z[voxel]" "Vx[voxel]" "Vy[voxel]" "Vz[voxel]" "isValid"'
    path = tmp_path / "B00001.dat"
    path.write_text(f"{names}\nZONE I=3, J=1, K=1\n{rows}\n")
    field = read_field(path, spacing_mm=(0.5, 0.5, 2.0))
    np.testing.assert_allclose(field.points, POINTS * [0.5, 0.5, 2.0])
    np.testing.assert_allclose(field.vectors, MOVED * [0.5, 0.5, 2.0])
    with pytest.raises(InputError, match="is in voxels; give spacing_mm, the size of a voxel along x, y, z"):
        read_field(path)
    with pytest.raises(InputError, match=r"in voxels, but unit = 'mm'; give spacing_mm"):
        read_field(path, unit="mm")
    path.write_text(f"{names.replace('Vz[voxel]', 'Vz[mm]')}\nZONE I=3, J=1, K=1\n{rows}\n")
    with pytest.raises(InputError, match=r"some variables are in voxels, and 'Vz\[mm\]' not"):
        read_field(path, spacing_mm=(0.5, 0.5, 2.0))


def test_points_of_a_mesh_and_their_displacement(tmp_path: Path) -> None:
    path = tmp_path / "solution.vtu"

    def text(name: str, more: str = "") -> str:
        numbers = [" ".join(map(str, a.ravel())) for a in (POINTS, MOVED)]
        array = '<DataArray type="Float64" Name="{}" NumberOfComponents="3" format="ascii">{}</DataArray>'
        return (
            '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian"><UnstructuredGrid>'
            '<Piece NumberOfPoints="3" NumberOfCells="0">'
            f"<PointData>{array.format(name, numbers[1])}{more}</PointData><Points>{array.format('Points', numbers[0])}</Points>"
            "</Piece></UnstructuredGrid></VTKFile>"
        )

    other = text("v").split("<PointData>")[1].split("</PointData>")[0]
    for written in (text("displacement"), text("U"), text("Displacement", other), text("anything")):
        path.write_text(written)
        np.testing.assert_allclose(read_field(path).vectors, MOVED)
    np.testing.assert_allclose(read_field(path, unit="cm").points, 10.0 * POINTS)
    stated = other.replace('"v"', '"standard_deviation_mm"').replace("-", "")
    path.write_text(text("displacement_mm", stated))
    sd = read_field(path).standard_deviation
    assert sd is not None
    np.testing.assert_allclose(sd, np.abs(MOVED))
    path.write_text(text("displacement", stated.replace(">0.1", ">-0.1")))
    with pytest.raises(InputError, match="standard_deviation_mm must be one or three numbers a point, 0 or more"):
        read_field(path)
    path.write_text(text("a", other))
    with pytest.raises(InputError, match="needs one array of three components at its points, called displacement; it has a, v"):
        read_field(path)


@pytest.mark.parametrize(
    "header",
    [
        "x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,sd_x_mm,sd_y_mm,sd_z_mm",
        "X [mm],Y [mm],Z [mm],Displacement X [mm],Displacement Y [mm],Displacement Z [mm],sigma_x [mm],sigma_y [mm],sigma_z [mm]",
        "x,y,z,u,v,w,sd_u,sd_v,sd_w",
        "x,y,z,ux,uy,uz,ux_sd,uy_sd,uz_sd",
        "x,y,z,ux,uy,uz,se_ux,se_uy,se_uz",
        "Coor.X,Coor.Y,Coor.Z,Disp.X,Disp.Y,Disp.Z,Error X,Error Y,Error Z",
    ],
)
def test_tables_with_standard_deviations(tmp_path: Path, header: str) -> None:
    sd = np.array([[0.01, 0.01, 0.04], [0.02, 0.01, 0.03], [0.01, 0.02, 0.05]])
    rows = "\n".join(",".join(map(str, row)) for row in np.hstack([POINTS, MOVED, sd]).tolist())
    (tmp_path / "field.csv").write_text(f"{header}\n{rows}\n")
    field = read_field(tmp_path / "field.csv")
    np.testing.assert_allclose(field.points, POINTS)
    np.testing.assert_allclose(field.vectors, MOVED)
    assert field.standard_deviation is not None
    np.testing.assert_allclose(field.standard_deviation, sd)


@pytest.mark.parametrize(
    "header",
    [
        "Points:0,Points:1,Points:2,displacement:0,displacement:1,displacement:2",  # ParaView
        "Points_0,Points_1,Points_2,displacement_0,displacement_1,displacement_2",
        "COORD1,COORD2,COORD3,U1,U2,U3",  # Abaqus
        "X,Y,Z,U-U1,U-U2,U-U3",
        "X Location (mm),Y Location (mm),Z Location (mm),Directional Deformation X (mm),Directional Deformation Y (mm),"
        "Directional Deformation Z (mm)",  # Ansys
        "% x (mm),y (mm),z (mm),u (mm),v (mm),w (mm)",  # COMSOL
        "x [mm],y [mm],z [mm],Displacement u [mm],Displacement v [mm],Displacement w [mm]",  # DaVis
    ],
)
def test_columns_as_other_programs_name_them(tmp_path: Path, header: str) -> None:
    shuffled = [4, 0, 2, 5, 1, 3]
    names, values = header.split(","), np.hstack([POINTS, MOVED])
    if not header.startswith("%"):
        names, values = [names[k] for k in shuffled], values[:, shuffled]
    rows = "\n".join(",".join(map(str, row)) for row in values.tolist())
    (tmp_path / "field.csv").write_text(f"{','.join(names)}\n{rows}\n")
    field = read_field(tmp_path / "field.csv")
    np.testing.assert_allclose(field.points, POINTS)
    np.testing.assert_allclose(field.vectors, MOVED)


def test_one_standard_deviation_is_that_of_every_component(tmp_path: Path) -> None:
    rows = "\n".join(",".join(map(str, [*p, *u, 20.0])) for p, u in zip(POINTS.tolist(), MOVED.tolist(), strict=True))
    (tmp_path / "field.csv").write_text(f"x,y,z,ux,uy,uz,sd_um\n{rows}\n")
    sd = read_field(tmp_path / "field.csv").standard_deviation
    assert sd is not None
    np.testing.assert_allclose(sd, np.full((3, 3), 0.02))


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "field.csv"
    for text, arguments, words in (
        ("x,y,z\n1,2,3\n", {}, "no columns of displacements"),
        ("x,y,z,ux,uy\n1,2,3,4,5\n", {}, "3 coordinates, but 2 columns of displacements"),
        ("x,y,z,ux,uy,uz,u\n1,2,3,4,5,6,7\n", {}, "both 'ux' and 'u' may be the x of displacements"),
        ("x,y,z,ux,uy,uz,sd_x,sd_y,sd_z\n1,2,3,4,5,6,1,-1,1\n", {}, r"row 1 of the points has standard deviations \[1.0, -1.0, 1.0\]"),
        ("x,y,z,ux,uy,uz\n1,2,3,4,5,6\n", {"unit": "px"}, "unit = 'px' is not known"),
        ("x,y,z,ux,uy,uz\n1,2,3,4,5,6\n", {"unit": "mm", "spacing_mm": (1.0, 1.0, 1.0)}, "give one of them"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_field(path, **arguments)
    with pytest.raises(InputError, match="states its own: leave it out"):
        read_field(tmp_path / "field.mha", spacing_mm=(1.0, 1.0, 1.0))


@pytest.mark.parametrize("masked", [0, 1])
@pytest.mark.parametrize("ending", [".dat", ".csv"])
def test_a_mask_is_what_the_displacements_beside_it_say(tmp_path: Path, masked: int, ending: str) -> None:
    """Some programs mark what is masked, others what is left; both write zeros there."""
    rows = [f"{x},{y},0,{0.1 * (x != 1)},{0.2 * (x != 1)},0,{masked if x == 1 else 1 - masked}" for y in range(2) for x in range(4)]
    header = "x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,mask"
    if ending == ".dat":
        header = "VARIABLES = " + " ".join(f'"{name}"' for name in header.split(",")) + "\nZONE I=4, J=2, F=POINT"
        rows = [row.replace(",", " ") for row in rows]
    (file := tmp_path / f"field{ending}").write_text("\n".join([header, *rows]), encoding="utf-8")
    field = read_field(file)
    np.testing.assert_array_equal(field.valid, field.points[:, 0] != 1.0)


def test_a_mask_that_does_not_tell_what_it_marks_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"{x},0,0,0.1,0,0,{int(x == 1)}\n" for x in range(4))
    (file := tmp_path / "field.csv").write_text(f"x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm,mask\n{rows}", encoding="utf-8")
    with pytest.raises(InputError, match=r"'mask' does not tell which points were measured.*isValid"):
        read_field(file)
