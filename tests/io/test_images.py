"""Volume files: geometry and values survive every format, other programs agree about them, and what is no volume is refused by name."""

from __future__ import annotations

import re
import struct
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError, MissingDependencyError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.io.image_formats.nifti import ContradictingFormsWarning
from naibu.io.images import open_volume, read_displacement, read_volume, read_volume_box, write_displacement, write_volume

RNG = np.random.default_rng(5)
TURN = rotation_matrix(np.array([0.3, -0.5, 0.7]))
SPACING, ORIGIN = (0.8, 1.1, 2.0), (-31.5, 12.25, 140.0)
FORMATS = ("a.mha", "a.mhd", "a.nii", "a.nii.gz", "a.nrrd", "a.tif", "a.h5")


def volume_of(dtype: str = "i2", shape: tuple[int, int, int] = (4, 5, 6)) -> Volume:
    values = RNG.integers(0, 200, shape).astype(dtype)
    return Volume.from_array(values, spacing_mm=SPACING, origin_mm=ORIGIN, direction=TURN)


def same(a: Volume, b: Volume, geometry: float = 1e-6) -> None:
    np.testing.assert_array_equal(a.values, b.values)
    np.testing.assert_allclose(a.spacing_mm, b.spacing_mm, rtol=geometry)
    np.testing.assert_allclose(a.origin_mm, b.origin_mm, atol=1e-4)
    np.testing.assert_allclose(a.direction, b.direction, atol=geometry)


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("name", FORMATS)
def test_values_and_geometry_survive(tmp_path: Path, name: str, compressed: bool) -> None:
    volume = volume_of()
    write_volume(tmp_path / name, volume, compressed=compressed)
    again = read_volume(tmp_path / name)
    same(again, volume)
    assert again.values.dtype == volume.values.dtype


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40)
@given(st.sampled_from(FORMATS), st.sampled_from(["u1", "i2", "u2", "i4", "f4", "f8"]), st.integers(0, 10**6))
def test_any_type_and_orientation_survives(tmp_path: Path, name: str, dtype: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 6, 3))
    values = rng.uniform(0, 255, shape).astype(dtype)
    volume = Volume.from_array(
        values,
        spacing_mm=rng.uniform(0.05, 5.0, 3),
        origin_mm=rng.uniform(-200, 200, 3),
        direction=rotation_matrix(rng.standard_normal(3)) @ np.diag(rng.choice([-1.0, 1.0], 3)),
    )
    write_volume(tmp_path / name, volume)
    same(read_volume(tmp_path / name), volume, geometry=2e-6)


@pytest.mark.parametrize("name", FORMATS[:5])
def test_simpleitk_reads_the_same(tmp_path: Path, name: str) -> None:
    sitk = pytest.importorskip("SimpleITK")
    volume = volume_of()
    write_volume(tmp_path / name, volume)
    image = sitk.ReadImage(str(tmp_path / name))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), volume.values)
    np.testing.assert_allclose(
        image.TransformContinuousIndexToPhysicalPoint((1.5, 2.0, 3.0)), volume.to_physical([1.5, 2.0, 3.0]), atol=1e-4
    )


@pytest.mark.parametrize("name", FORMATS[:5])
def test_what_simpleitk_writes_is_read_the_same(tmp_path: Path, name: str) -> None:
    sitk = pytest.importorskip("SimpleITK")
    volume = volume_of()
    image = sitk.GetImageFromArray(volume.values)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(TURN.ravel().tolist())
    for compressed in (True, False):
        sitk.WriteImage(image, str(tmp_path / name), useCompression=compressed)
        same(read_volume(tmp_path / name), volume, geometry=1e-5)


def test_nibabel_places_voxels_the_same_but_for_the_sign_of_x_and_y(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    volume = volume_of()
    write_volume(tmp_path / "a.nii", volume)
    image = nibabel.load(tmp_path / "a.nii")
    index = np.array([2.0, 1.0, 3.0])
    np.testing.assert_allclose((image.affine @ [*index, 1.0])[:3] * [-1, -1, 1], volume.to_physical(index), atol=1e-4)
    assert image.get_fdata()[2, 1, 3] == volume.values[3, 1, 2]


def test_values_are_those_stored_unless_rescaling_is_asked_for(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.arange(24, dtype="i2").reshape(2, 3, 4), np.diag([2.0, 2.0, 2.0, 1.0]))
    image.header.set_slope_inter(0.5, -10.0)
    image.to_filename(tmp_path / "a.nii")
    stored = read_volume(tmp_path / "a.nii")
    assert stored.values.dtype == np.int16
    np.testing.assert_array_equal(np.sort(stored.values, axis=None), np.arange(24))
    np.testing.assert_allclose(read_volume(tmp_path / "a.nii", rescaled=True).values, 0.5 * stored.values - 10.0)


def test_units_of_length_are_converted(tmp_path: Path) -> None:
    nibabel, nrrd = pytest.importorskip("nibabel"), pytest.importorskip("nrrd")
    image = nibabel.Nifti1Image(np.zeros((2, 3, 4), dtype="u1"), np.diag([0.001, 0.002, 0.003, 1.0]))
    image.header.set_xyzt_units("meter")
    image.to_filename(tmp_path / "a.nii")
    np.testing.assert_allclose(read_volume(tmp_path / "a.nii").spacing_mm, [1.0, 2.0, 3.0], rtol=1e-6)
    header = {"space": "right-anterior-superior", "space directions": np.diag([5.0, 6.0, 7.0]), "space origin": [1.0, 2.0, 3.0]}
    nrrd.write(str(tmp_path / "a.nrrd"), np.zeros((2, 3, 4), dtype="u1"), header | {"space units": ["um"] * 3})
    volume = read_volume(tmp_path / "a.nrrd")
    np.testing.assert_allclose(volume.spacing_mm, [0.005, 0.006, 0.007])
    np.testing.assert_allclose(volume.origin_mm, [-0.001, -0.002, 0.003])
    np.testing.assert_allclose(volume.direction, np.diag([-1.0, -1.0, 1.0]))
    nrrd.write(str(tmp_path / "b.nrrd"), np.zeros((2, 3, 4), dtype="u1"), header | {"space units": ["furlong"] * 3})
    with pytest.raises(InputError, match="furlong"):
        read_volume(tmp_path / "b.nrrd")
    np.testing.assert_allclose(read_volume(tmp_path / "b.nrrd", unit_mm=2.0).spacing_mm, [10.0, 12.0, 14.0])


@pytest.mark.parametrize("name", ["u.mha", "u.mhd", "u.nrrd"])
def test_displacement_fields_survive_and_open_elsewhere(tmp_path: Path, name: str) -> None:
    grid = volume_of()
    vectors = RNG.standard_normal((*grid.shape, 3)).astype(np.float32)
    vectors[0, 1, 2] = np.nan
    write_displacement(tmp_path / name, vectors, grid)
    again, where = read_displacement(tmp_path / name)
    np.testing.assert_array_equal(again, vectors)
    assert where.same_grid(grid)
    assert not where.values[0, 1, 2] and where.values.sum() == where.values.size - 1
    with pytest.raises(InputError, match=r"not one intensity|several samples"):
        read_volume(tmp_path / name)
    sitk = pytest.importorskip("SimpleITK")
    image = sitk.ReadImage(str(tmp_path / name))
    assert image.GetNumberOfComponentsPerPixel() == 3
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), vectors)
    np.testing.assert_allclose(image.TransformContinuousIndexToPhysicalPoint((1.5, 2.0, 3.0)), grid.to_physical([1.5, 2.0, 3.0]), atol=1e-4)


def test_a_part_of_a_large_volume_keeps_its_place(tmp_path: Path) -> None:
    volume = volume_of(shape=(7, 8, 9))
    write_volume(tmp_path / "a.h5", volume)
    part = read_volume_box(tmp_path / "a.h5", (1, 2, 3), (5, 8, 7))
    same(part, volume.cropped((1, 2, 3), (5, 8, 7)))
    with pytest.raises(InputError, match="cannot read"):
        read_volume_box(tmp_path / "a.h5", (0, 0, 0), (10, 8, 7))
    with pytest.raises(InputError, match="only HDF5"):
        read_volume_box(tmp_path / "a.mha", (0, 0, 0), (1, 1, 1))


def test_damaged_files_are_told(tmp_path: Path) -> None:
    volume = volume_of()
    for name in FORMATS:
        write_volume(tmp_path / name, volume, compressed=False)
    (tmp_path / "a.raw").write_bytes((tmp_path / "a.raw").read_bytes()[:-5])
    for name in FORMATS:
        if name != "a.mhd":
            whole = (tmp_path / name).read_bytes()
            (tmp_path / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(InputError, match=r"a\."):
            read_volume(tmp_path / name)
    for name, told in (("none.mha", "check the path"), ("none.nii", "check the path"), ("none.xyz", "does not read files ending")):
        with pytest.raises(InputError, match=told):
            read_volume(tmp_path / name)


def test_what_is_no_volume_is_refused(tmp_path: Path) -> None:
    nibabel, tifffile, nrrd = pytest.importorskip("nibabel"), pytest.importorskip("tifffile"), pytest.importorskip("nrrd")
    nibabel.Nifti1Image(np.zeros((2, 3, 4, 5), dtype="f4"), np.eye(4)).to_filename(tmp_path / "t.nii")
    with pytest.raises(InputError, match="several time points"):
        read_volume(tmp_path / "t.nii")
    colours = np.zeros((2, 3, 4), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.Nifti1Image(colours, np.eye(4)).to_filename(tmp_path / "c.nii")
    with pytest.raises(InputError, match="colours"):
        read_volume(tmp_path / "c.nii")
    sheared = np.eye(4)
    sheared[0, 2] = 0.1
    image = nibabel.Nifti1Image(np.zeros((2, 3, 4), dtype="f4"), sheared)
    image.to_filename(tmp_path / "s.nii")
    with pytest.raises(InputError, match=r"84\.29 degrees"):
        read_volume(tmp_path / "s.nii")
    nrrd.write(str(tmp_path / "c.nrrd"), np.zeros((3, 4, 5, 6), dtype="u1"), {"kinds": ["RGB-color", "domain", "domain", "domain"]})
    with pytest.raises(InputError, match="colours"):
        read_volume(tmp_path / "c.nrrd")
    tifffile.imwrite(tmp_path / "c.tif", np.zeros((4, 5, 6, 3), dtype="u1"), photometric="rgb")
    with pytest.raises(InputError, match="RGB"):
        read_volume(tmp_path / "c.tif", spacing_mm=(1, 1, 1))
    with pytest.raises(InputError, match="three positive"):
        read_volume(tmp_path / "c.tif", spacing_mm=(1, 1, 0))


@pytest.mark.parametrize("opened", [read_volume, open_volume])
def test_a_tiff_whose_size_takes_more_strips_than_it_lists_is_refused(tmp_path: Path, opened: Callable[[Path], object]) -> None:
    """The length of the image is damaged; reading it would take minutes."""
    tifffile = pytest.importorskip("tifffile")
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.arange(42, dtype="<i2").reshape(6, 7), compression="zlib", rowsperstrip=6)
    with tifffile.TiffFile(path) as file:
        tag = file.pages[0].tags["ImageLength"]
    content = bytearray(path.read_bytes())
    content[tag.offset + 2 : tag.offset + 12] = struct.pack("<HII", 4, 1, 6 + (2 << 24))
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"takes 5592407 strips, and it lists 1"):
        opened(path)


def test_tiff_stacks_of_other_programs(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    values = RNG.integers(0, 2000, (4, 5, 6)).astype("u2")
    tifffile.imwrite(
        tmp_path / "ij.tif", values, imagej=True, resolution=(2.0, 4.0), metadata={"spacing": 0.5, "unit": "cm", "axes": "ZYX"}
    )
    volume = read_volume(tmp_path / "ij.tif")
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.spacing_mm, [5.0, 2.5, 5.0])
    tifffile.imwrite(tmp_path / "bare.tif", values, photometric="minisblack")
    with pytest.raises(InputError, match=r"does not state its voxel spacing; give spacing_mm, for example \(0"):
        read_volume(tmp_path / "bare.tif")
    tifffile.imwrite(tmp_path / "plane.tif", values, imagej=True, resolution=(2.0, 4.0), metadata={"unit": "mm", "axes": "ZYX"})
    tifffile.imwrite(tmp_path / "channels.tif", values, imagej=True)
    with pytest.raises(InputError, match=r"axes CYX.*metadata=\{'axes': 'ZYX'\}"):
        read_volume(tmp_path / "channels.tif")
    with pytest.raises(InputError, match=r"states no voxel spacing along z \(along x, y: 0\.5, 0\.25 mm\); give spacing_mm"):
        read_volume(tmp_path / "plane.tif")
    np.testing.assert_array_equal(read_volume(tmp_path / "bare.tif", spacing_mm=(1, 1, 2)).values, values)
    folder = tmp_path / "slices"
    folder.mkdir()
    for i, page in enumerate(values):
        tifffile.imwrite(folder / f"calf_{i + 8}.tif", page)
    np.testing.assert_array_equal(read_volume(folder, spacing_mm=(1, 1, 2)).values, values)
    (folder / "calf_9.tif").unlink()
    with pytest.raises(InputError, match=r"calf_8.tif and calf_10.tif"):
        read_volume(folder, spacing_mm=(1, 1, 2))


# ---------------------------------------------------------------- DICOM


def dicom_slice(pixels: np.ndarray, position: Any, series: str = "1.2.3", turn: np.ndarray = TURN, **extra: Any) -> Any:
    """Return a DICOM data set of one slice, whose pixels are 1.1 mm high and 0.8 mm wide."""
    pydicom = pytest.importorskip("pydicom")
    from pydicom.dataset import FileDataset, FileMetaDataset

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.4"
    meta.MediaStorageSOPInstanceUID = pydicom.uid.generate_uid()
    meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    data.Modality, data.SeriesInstanceUID, data.SeriesDescription = "MR", series, f"series {series}"
    data.Rows, data.Columns = pixels.shape[-2:] if pixels.ndim < 4 else pixels.shape[1:3]
    data.PixelSpacing = [1.1, 0.8]
    data.SliceThickness = 1.5
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated = data.BitsStored = 16
    data.HighBit, data.PixelRepresentation = 15, int(pixels.dtype.kind == "i")
    data.ImagePositionPatient = [f"{v:.6f}" for v in position]
    data.ImageOrientationPatient = [f"{v:.8f}" for v in turn.T[:2].ravel()]
    data.PixelData = pixels.tobytes()
    for key, value in extra.items():
        setattr(data, key, value)
    return data


def write_series(folder: Path, volume: Volume, *, skip: tuple[int, ...] = (), **extra: Any) -> None:
    """Write a series in an order that is not that of the slices."""
    folder.mkdir(exist_ok=True)
    n = volume.shape[0]
    for number, k in enumerate(np.random.default_rng(1).permutation(n)):
        if k not in skip:
            data = dicom_slice(np.ascontiguousarray(volume.values[k]), volume.to_physical([0, 0, k]), **extra)
            data.save_as(folder / f"IM{number:04d}_{extra.get('series', '')}", enforce_file_format=True)


def test_dicom_slices_are_sorted_by_where_they_lie(tmp_path: Path) -> None:
    volume = volume_of()
    write_series(tmp_path / "s", volume)
    (tmp_path / "s" / "notes.txt").write_text("no image")
    same(read_volume(tmp_path / "s"), volume, geometry=1e-5)
    same(read_volume(tmp_path / "s" / "IM0000_"), volume, geometry=1e-5)
    sitk = pytest.importorskip("SimpleITK")
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(tmp_path / "s")))
    image = reader.Execute()
    found = read_volume(tmp_path / "s")
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), found.values)
    np.testing.assert_allclose(
        image.TransformContinuousIndexToPhysicalPoint((1.5, 2.0, 3.0)), found.to_physical([1.5, 2.0, 3.0]), atol=1e-3
    )


def test_stored_dicom_values_stay_unless_rescaling_is_asked_for(tmp_path: Path) -> None:
    volume = volume_of()
    write_series(tmp_path / "s", volume, RescaleSlope="2", RescaleIntercept="-1024")
    np.testing.assert_array_equal(read_volume(tmp_path / "s").values, volume.values)
    np.testing.assert_allclose(read_volume(tmp_path / "s", rescaled=True).values, 2.0 * volume.values - 1024.0)
    data = dicom_slice(volume.values[0], volume.to_physical([0, 0, 4]), RescaleSlope="3", RescaleIntercept="0")
    data.save_as(tmp_path / "s" / "more", enforce_file_format=True)
    # stored values of slices with different slopes, as in PET, are not comparable
    np.testing.assert_allclose(read_volume(tmp_path / "s").values, [*(2.0 * volume.values - 1024.0), 3.0 * volume.values[0]])


def test_dicom_series_that_make_no_volume_are_refused_by_name(tmp_path: Path) -> None:
    volume = volume_of(shape=(6, 5, 6))
    write_series(tmp_path / "gap", volume, skip=(3,))
    with pytest.raises(InputError, match=r"1 slice is missing between IM\d+_ and IM\d+_ \(4\.000 mm apart, the others 2\.000 mm\)"):
        read_volume(tmp_path / "gap")
    write_series(tmp_path / "two", volume, series="1.1")
    write_series(tmp_path / "two", volume, series="1.2")
    with pytest.raises(InputError, match=r"2 series.*1\.1.*IM\d+_1\.1 .*; give a file of the one that is meant.*series="):
        read_volume(tmp_path / "two")
    same(read_volume(tmp_path / "two", series="1.2"), volume, geometry=1e-5)
    same(read_volume(tmp_path / "two" / "IM0000_1.1"), volume, geometry=1e-5)
    same(read_volume(tmp_path / "two", series="series 1.1"), volume, geometry=1e-5)
    write_series(tmp_path / "uneven", volume, skip=(1, 3))  # slices 0, 2, 4, 5
    with pytest.raises(InputError, match=r"slice spacing is uneven, 2\.000 to 4\.000 mm \(.*\)"):
        read_volume(tmp_path / "uneven")
    write_series(tmp_path / "again", volume)
    dicom_slice(volume.values[2], volume.to_physical([0, 0, 2])).save_as(tmp_path / "again" / "x", enforce_file_format=True)
    with pytest.raises(InputError, match="same position"):
        read_volume(tmp_path / "again")
    write_series(tmp_path / "local", volume)
    other = rotation_matrix(np.array([0.0, 0.0, 1.0]))
    dicom_slice(volume.values[2], (0, 0, 0), turn=other).save_as(tmp_path / "local" / "x", enforce_file_format=True)
    with pytest.raises(InputError, match="differ in orientation"):
        read_volume(tmp_path / "local")


def test_a_tilted_gantry_and_colours_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "tilt"
    folder.mkdir()
    for k in range(4):
        dicom_slice(np.zeros((5, 6), dtype="i2"), (0.0, 0.3 * k, 2.0 * k), turn=np.eye(3)).save_as(
            folder / f"{k}", enforce_file_format=True
        )
    with pytest.raises(InputError, match="not orthogonal"):
        read_volume(folder)
    rgb = tmp_path / "rgb"
    rgb.mkdir()
    data = dicom_slice(np.zeros((5, 6), dtype="u2"), (0, 0, 0), SamplesPerPixel=3, PhotometricInterpretation="RGB", PlanarConfiguration=0)
    data.BitsAllocated = data.BitsStored = 8
    data.HighBit, data.PixelData = 7, bytes(90)
    data.save_as(rgb / "a", enforce_file_format=True)
    with pytest.raises(InputError, match="RGB"):
        read_volume(rgb)
    film = tmp_path / "film"
    film.mkdir()
    dicom_slice(np.zeros((7, 5, 6), dtype="u2"), (0, 0, 0), NumberOfFrames=7).save_as(film / "a", enforce_file_format=True)
    with pytest.raises(InputError, match="7 frames"):
        read_volume(film)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="neither DICOM nor TIFF"):
        read_volume(tmp_path / "empty")


def test_enhanced_dicom_files_hold_a_volume_in_one_file(tmp_path: Path) -> None:
    pytest.importorskip("pydicom")
    from pydicom.dataset import Dataset
    from pydicom.sequence import Sequence

    volume = volume_of()
    order = [2, 0, 3, 1]
    data = dicom_slice(np.ascontiguousarray(volume.values[order]), (0, 0, 0), NumberOfFrames=4)
    for tag in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "SliceThickness"):
        delattr(data, tag)
    measures, plane, shared = Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, measures.SliceThickness = [1.1, 0.8], 2.0
    plane.ImageOrientationPatient = [f"{v:.8f}" for v in TURN.T[:2].ravel()]
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([plane])
    frames = []
    for k in order:
        position, frame = Dataset(), Dataset()
        position.ImagePositionPatient = [f"{v:.6f}" for v in volume.to_physical([0, 0, k])]
        frame.PlanePositionSequence = Sequence([position])
        frames.append(frame)
    data.SharedFunctionalGroupsSequence, data.PerFrameFunctionalGroupsSequence = Sequence([shared]), Sequence(frames)
    data.save_as(tmp_path / "enhanced.dcm", enforce_file_format=True)
    same(read_volume(tmp_path / "enhanced.dcm"), volume, geometry=1e-5)


@pytest.mark.parametrize(("name", "package"), [("a.nii", "nibabel"), ("a.nrrd", "nrrd"), ("a.tif", "tifffile"), ("a.dcm", "pydicom")])
def test_a_missing_package_is_told_with_the_command_that_gets_it(
    tmp_path: Path, name: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependencyError, match=r"pip install"):
        read_volume(tmp_path / name)


def test_vectors_of_another_shape_or_format_are_refused(tmp_path: Path) -> None:
    grid = volume_of()
    with pytest.raises(InputError, match="must have shape"):
        write_displacement(tmp_path / "u.mha", np.zeros((4, 5, 6)), grid)
    with pytest.raises(InputError, match="does not write displacement"):
        write_displacement(tmp_path / "u.nii", np.zeros((4, 5, 6, 3)), grid)
    write_volume(tmp_path / "a.mha", grid)
    with pytest.raises(InputError, match="no vectors"):
        read_displacement(tmp_path / "a.mha")
    with pytest.raises(InputError, match="no type for values"):
        write_volume(tmp_path / "b.mha", grid.with_values(np.zeros(grid.shape, dtype=np.longdouble)))


@pytest.mark.parametrize(
    ("sform", "code", "told"),
    [
        (np.diag([1.0, 1.0, 3.0, 1.0]), 4, r"sform \(code 4\) .* voxels of 1 x 1 x 3 and of 1 x 1 x 2; the sform was used"),
        (np.diag([1.0, 1.0, 2.0, 1.0]) + 40.0 * np.eye(4, k=3), 1, "places that are up to 40 .* apart"),
        (np.diag([1.0, 1.0, 2.0, 1.0]) + 40.0 * np.eye(4, k=3), 4, ""),
        (np.diag([1.0, 1.0, 2.0, 1.0]), 2, ""),
    ],
    ids=["size", "place", "atlas", "alike"],
)
def test_forms_of_nifti_that_contradict_each_other_are_told(tmp_path: Path, sform: np.ndarray, code: int, told: str) -> None:
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.zeros((3, 4, 5), dtype="i2"), np.eye(4))
    image.set_qform(np.diag([1.0, 1.0, 2.0, 1.0]), code=1)
    image.set_sform(sform, code=code)
    nibabel.save(image, tmp_path / "a.nii")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        volume = read_volume(tmp_path / "a.nii")
    messages = [str(each.message) for each in warned if each.category is ContradictingFormsWarning]
    assert len(messages) == bool(told) and all(re.search(told, message) for message in messages)
    assert volume.spacing_mm[2] == sform[2, 2]
