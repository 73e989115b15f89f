"""Valid files of point clouds, and of displacement fields of other programs: the small inputs that are damaged by the hostile tests."""

from __future__ import annotations

from pathlib import Path

import h5py
import nibabel
import numpy as np
from scipy.io import savemat

from naibu.io.displacement_fields import read_field
from naibu.io.tables.point_clouds import read_point_cloud
from naibu.io.tables.point_tables import TEXT

POINTS = np.random.default_rng(1).uniform(1.0, 9.0, (20, 3)).round(3)
VECTORS = np.random.default_rng(2).normal(size=(3, 4, 5, 3)).round(3)
FIXED = [5.0, 4.0, 3.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, *np.eye(3).ravel()]


def cloud_files(folder: Path) -> list[Path]:
    """Write a cloud of points in every format."""
    folder.mkdir(parents=True)
    rows = "\n".join(",".join(map(str, row)) for row in POINTS.tolist()) + "\n"
    (folder / "cloud.csv").write_text(f"x_um,y_um,z_um\n{rows}")
    (folder / "bare.txt").write_text(rows)
    np.save(folder / "cloud.npy", POINTS)
    np.savez_compressed(folder / "cloud.npz", points=POINTS)
    cell = np.empty((1, 1), dtype=object)
    cell[0, 0] = POINTS
    savemat(folder / "cloud.mat", {"x": cell}, do_compression=True)
    with h5py.File(folder / "new.mat", "w") as root:
        root["x"] = POINTS.T
    return sorted(folder.iterdir())


def foreign_fields(folder: Path) -> list[Path]:
    """Write a displacement field in every format of other programs."""
    folder.mkdir(parents=True)
    image = nibabel.Nifti1Image(VECTORS.transpose(2, 1, 0, 3)[:, :, :, None], np.eye(4))
    image.header["intent_code"] = 1007
    for name in ("warp.nii", "warp.nii.gz"):
        nibabel.save(image, folder / name)
    with h5py.File(folder / "transform.h5", "w") as root:
        own = root.create_group("TransformGroup/0")
        own["TransformType"] = np.array([b"DisplacementFieldTransform_double_3_3"])
        own["TransformParameters"], own["TransformFixedParameters"] = VECTORS.ravel(), np.array(FIXED)
    numbers, fixed = " ".join(map(str, VECTORS.ravel())), " ".join(map(str, FIXED))
    (folder / "transform.tfm").write_text(
        f"#Insight Transform File V1.0\nTransform: DisplacementFieldTransform_double_3_3\nParameters: {numbers}\nFixedParameters: {fixed}\n"
    )
    both = np.hstack([POINTS, 0.01 * POINTS])
    rows = "\n".join(" ".join(map(str, row)) for row in both.tolist()) + "\n"
    (folder / "B1.dat").write_text(f'VARIABLES = "x[mm]" "y[mm]" "z[mm]" "Vx[mm]" "Vy[mm]" "Vz[mm]"\nZONE I=20, F=POINT\n{rows}')
    (folder / "nodes.tsv").write_text("Zpos\tYpos\tXpos\tZdisp\tYdisp\tXdisp\n" + rows.replace(" ", "\t"))
    result = np.empty((1, 1), dtype=object)
    result[0, 0] = {"U": POINTS.reshape(-1, 1)}
    savemat(folder / "results.mat", {"ResultDisp": result, "DVCmesh": {"coordinatesFEM": POINTS}}, do_compression=True)
    array = '<DataArray type="Float64" Name="{}" NumberOfComponents="3" format="ascii">{}</DataArray>'
    text = " ".join(map(str, POINTS.ravel()))
    (folder / "solution.vtu").write_text(
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian"><UnstructuredGrid>'
        '<Piece NumberOfPoints="20" NumberOfCells="0">'
        f"<PointData>{array.format('displacement', text)}</PointData><Points>{array.format('Points', text)}</Points>"
        "</Piece></UnstructuredGrid></VTKFile>"
    )
    return sorted(folder.iterdir())


def read_cloud(path: Path) -> object:
    """Read a cloud of points."""
    return read_point_cloud(path)


def read_foreign(path: Path) -> object:
    """Read a displacement field, in voxels of one millimetre where the file is in voxels."""
    in_voxels = path.suffix == ".mat" or path.suffix in TEXT
    return read_field(path, spacing_mm=(1.0, 1.0, 1.0) if in_voxels else None)
