"""TIFF files of SPAM, one a component, at the nodes of a grid :cite:p:`stamati2020`.

``spam-ldic`` and ``spam-filterPhiField`` write ``PREFIX-Zdisp.tif``, ``-Ydisp.tif`` and ``-Xdisp.tif``: 32-bit numbers, one a node, with
axes z, y, x, in voxels. The files do not state where nodes lie. SPAM places the first one a node spacing from the first voxel along each
axis, and the others a node spacing apart (``spam.DIC.makeGrid``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, require_within
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.io.files.reading import require_regular
from naibu.io.image_formats import tiff

ENDINGS = (".tif", ".tiff")
CONVERGED = 2  # returnStatus of a node
_COMPONENT = re.compile(r"(.*-)[XYZ](disp)", re.IGNORECASE)
_ALL = "-Zdisp.tif, -Ydisp.tif, -Xdisp.tif"


def read(source: Path, *, spacing_mm: Sequence[float] | None = None, node_spacing: Sequence[float] | None = None) -> DisplacementField:
    """Return the field whose three components lie beside each other; nodes whose ``-returnStatus.tif`` is not 2 are not valid.

    Parameters
    ----------
    source : Path
        One of the components.
    spacing_mm : sequence of float
        Size of a voxel along x, y, z, mm.
    node_spacing : sequence of float
        From node to node along x, y, z, in voxels (``-ns`` of SPAM, which counts z, y, x).

    Raises
    ------
    InputError
        A file that is no component, components that are missing or of different shapes, an unknown size of voxels or spacing of nodes, or
        no node that converged.
    """
    parts = _COMPONENT.fullmatch(source.stem)
    if parts is None:
        raise InputError(f"{source.name}: a TIFF file with displacements is one of SPAM's {_ALL}; take one of these, or a table (.tsv)")
    files = [source.with_name(f"{parts[1]}{axis}{parts[2]}{source.suffix}") for axis in "XYZ"]
    missing = [file.name for file in files if not file.exists()]
    if source.exists() and missing:
        plane = "; SPAM leaves out Z of images in the plane, which are not read" if missing == [files[2].name] else ""
        raise InputError(f"{source.name}: {', '.join(missing)} is not beside it; a field takes {_ALL}{plane}")
    if spacing_mm is None or node_spacing is None:
        lacking = " and ".join(
            text
            for text, value in (
                ("spacing_mm, the size of a voxel along x, y, z", spacing_mm),
                ("node_spacing, the voxels from node to node along x, y, z (-ns of SPAM)", node_spacing),
            )
            if value is None
        )
        raise InputError(f"{source.name}: is a field of SPAM, which does not state where nodes lie; give {lacking}")
    for voxels in node_spacing:
        require_within("node_spacing", voxels, 1.0, 1e4, "voxels")
    parts_read = [_values(file) for file in files]
    shapes = {values.shape for values in parts_read}
    status_file = source.with_name(f"{parts[1]}returnStatus{source.suffix}")
    status = _values(status_file) if status_file.exists() else np.full(parts_read[0].shape, float(CONVERGED))
    if len(shapes | {status.shape}) > 1:
        told = ", ".join(f"{f.name} {v.shape}" for f, v in zip((*files, status_file), (*parts_read, status), strict=True))
        raise InputError(f"{source.name}: files of one field must have one shape: {told}")
    size, steps = np.asarray(spacing_mm, dtype=float), np.asarray(node_spacing, dtype=float)
    nodes = 1.0 + np.indices(status.shape).reshape(3, -1)[::-1].T
    vectors = np.stack([values.ravel() for values in parts_read], axis=1) * size
    valid = np.asarray((status.ravel() == CONVERGED) & np.isfinite(vectors).all(axis=1))
    require_converged(source, valid)
    return DisplacementField.from_arrays(nodes * steps * size, vectors, valid=valid)


def require_converged(source: Path, valid: BoolArray) -> None:
    """Refuse a field of SPAM of whose nodes none converged.

    Raises
    ------
    InputError
        None did: ``spam-pixelSearch``, which gives whole voxels, and ``spam-passPhiField``, which gives a guess, mark nodes with 1.
    """
    if not np.any(valid):
        raise InputError(
            f"{source.name}: no node has the returnStatus {CONVERGED}, by which SPAM marks those that converged. That of spam-pixelSearch "
            "and spam-passPhiField is 1: whole voxels, or a guess, that spam-ldic starts from; take what spam-ldic writes"
        )


def _values(file: Path) -> FloatArray:
    """Return the numbers of all nodes (z, y, x); of 3 or 4 along an axis, tifffile calls them colours, and they are none."""
    tifffile = optional_package("tifffile", f"{file.name}: reading TIFF files")
    require_regular(file)
    try:
        with tifffile.TiffFile(file) as stored:
            if not len(stored.pages):
                raise InputError(f"{file.name}: contains no image; copy the file again")
            tiff.require_all_strips(file.name, stored.pages[0])
            values = np.asarray(stored.series[0].asarray(), dtype=float)
    except InputError:
        raise
    # tifffile's decoders raise exceptions of many types
    except Exception as error:
        raise InputError(f"{file.name}: cannot be read as TIFF ({error}); copy the file again") from error
    if values.ndim != 3:
        raise InputError(f"{file.name}: has {values.ndim} axes {values.shape}; a component of a field of SPAM has three: z, y, x")
    return values
