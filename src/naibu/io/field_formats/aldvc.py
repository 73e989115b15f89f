"""Results of ALDVC (MATLAB, ``.mat``): displacement in voxels at the nodes of a mesh :cite:p:`yang2020`.

``DVCmesh.coordinatesFEM`` (n, 3), or that of ``ResultFEMesh{1}``, are nodes in voxels, counted from 1 along the axes of the MATLAB array;
``ResultDisp{k}.U`` (3n, 1) are displacements (u, v, w of one node after the other) from the first volume to volume k + 1.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError


def read(source: Path) -> tuple[FloatArray, FloatArray]:
    """Return nodes (n, 3), from 0, and displacements (n, 3), NaN where there is none, in voxels.

    Raises
    ------
    InputError
        No result of ALDVC, or one of several states.
    """
    from scipy.io import loadmat

    try:
        stored = loadmat(source)
    except NotImplementedError as error:
        raise InputError(f"{source.name}: is a MATLAB file of version 7.3; save it with the option '-v7'") from error
    displacement, mesh = stored.get("ResultDisp"), stored.get("DVCmesh", stored.get("ResultFEMesh"))
    if displacement is None or mesh is None:
        there = ", ".join(name for name in stored if not name.startswith("__")) or "nothing"
        if "_3_3" in there:
            raise InputError(f"{source.name}: holds {there[:200]}, a transform of ITK; write it as .h5 or .tfm")
        raise InputError(
            f"{source.name}: is no result of ALDVC: it lacks {'ResultDisp' if displacement is None else 'DVCmesh'}, and has {there[:200]}; "
            "save points and displacements of other programs as a table"
        )
    if displacement.dtype == object and displacement.size != 1:
        raise InputError(
            f"{source.name}: holds the displacements of {displacement.size} states; save that of one: ResultDisp = ResultDisp(k), and the "
            "mesh that it refers to"
        )
    nodes, moved = _member(source, mesh, "coordinatesFEM"), _member(source, displacement, "U")
    if nodes.ndim != 2 or nodes.shape[1] != 3 or moved.size != nodes.size:
        raise InputError(
            f"{source.name}: coordinatesFEM has shape {nodes.shape} and U {moved.shape}; three coordinates a node and as many "
            "displacements are needed (volumes, not images)"
        )
    return nodes - 1.0, moved.reshape(-1, 3)


def _member(source: Path, holder: Any, name: str) -> FloatArray:
    """Return a field of the structure in an array or cell."""
    inner = holder
    while isinstance(inner, np.ndarray) and inner.dtype == object and inner.size:
        inner = inner.ravel()[0]
    if not isinstance(inner, np.ndarray) or inner.dtype.names is None or name not in inner.dtype.names or not inner.size:
        raise InputError(f"{source.name}: its structure has no {name}; save the result of ALDVC again")
    return np.asarray(inner[name].ravel()[0], dtype=float)
