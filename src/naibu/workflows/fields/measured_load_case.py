"""Load cases from measured displacement fields: the measurements inside the cells, and whether they say anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import registration
from naibu.core.volume import Volume
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.identified.sides import SIDES, loaded_nodes
from naibu.io.tables.table_cells import MM_PER_UNIT
from naibu.meshing.point_location import locate

FEWEST_POINTS = 20
THINNEST = 0.1  # of a cell: points that span less along a direction do not tell how displacements change along it
MOST_POINTS = 10_000  # measurements of a load case: neighbours in a field say the same
LEAST_DEFORMATION, LARGEST_DEFORMATION = 1e-6, 0.5  # RMS of what a rigid motion leaves, part of the extent of the object
MOST_BEYOND = 0.2  # of the points outside of the object: more than its rim
RIM = 0.25  # voxels: that thick is what a mask leaves out of an object; right ones leave out a tenth, since voxels jut out as well
LIKELY = 0.5  # of the points in the object, and of its extent: from here on another unit or frame is named as likely
ZERO = 5, 0.01  # points, and part of them, with a displacement of exactly zero: no measurement is that by chance
TINY_DEFORMATION = 1e-4  # so little is usual for waves and interferometry, and for scans and particles is a sign of another unit


def measured_load_case(
    mesh: Mesh, cell_of_voxel: IntArray, inside: Volume, field: DisplacementField, name: str, sides: Sequence[str] = ()
) -> FieldLoadCase:
    """Return the load case of the measurements inside the cells.

    Parameters
    ----------
    mesh : Mesh
        The object.
    cell_of_voxel : ndarray, shape (nz, ny, nx), int64
        Cell of every voxel, -1 outside.
    inside : Volume
        The grid.
    field : DisplacementField
        What was measured.
    name : str
        For messages.
    sides : sequence of str
        Sides at which unknown forces act; the whole surface where none is named.

    Raises
    ------
    InputError
        A field in the plane, hardly a measurement in the object, all of them in a plane, an object that does not deform, or a side that
        does not exist.
    """
    if unknown := [side for side in sides if side not in SIDES]:
        raise InputError(f"loaded={unknown[0]!r} is no side of the body; use one of {', '.join(SIDES)}")
    at = field.at_points()
    if at.points.shape[1] != 3:
        raise InputError(f"{name}: positions have {at.points.shape[1]} coordinates; moduli are identified from displacements in space")
    if not at.valid.any():
        raise InputError(f"{name}: none of its {len(at.points)} points has a displacement")
    index = np.round(inside.to_index(at.points)).astype(int)[:, ::-1]
    within = ((index >= 0) & (index < inside.shape)).all(axis=1) & at.valid
    within[within] = cell_of_voxel[tuple(index[within].T)] >= 0
    near = np.flatnonzero(within)  # cells end inside of voxels
    chosen = near[locate(mesh, at.points[near], tolerance_mm=np.inf).distance_mm <= 1e-6] if len(near) else near
    if len(chosen) < FEWEST_POINTS:
        raise InputError(
            f"{name}: {len(chosen)} measurements of the field lie in the object, {FEWEST_POINTS} are needed; it spans "
            f"{_spans(at.points[at.valid])} mm, the object {_spans(mesh.points)} mm: are both in mm, and from one reference scan?"
            f"{_likely_frame(at.points[at.valid], inside)}"
        )
    _require_space(name, mesh, at.points[chosen])
    every = -(-len(chosen) // MOST_POINTS)
    chosen = np.random.default_rng(0).permutation(chosen)[: len(chosen) // every]
    covariance = None if at.covariance is None else at.covariance[chosen]
    some = DisplacementField.from_arrays(at.points[chosen], at.vectors[chosen], covariance=covariance)
    _require_deformation(name, some)
    return FieldLoadCase.of(name, some, mesh, loaded=loaded_nodes(mesh, inside.direction, sides))


def without_copies(field: DisplacementField) -> DisplacementField:
    """Return a field in which copies of a measurement, such as those of nodes that cells of a mesh do not share, are there once."""
    if isinstance(field.support, Volume):
        return field
    at = field.at_points()
    there = np.flatnonzero(at.valid)
    kept = there[np.sort(np.unique(np.column_stack([at.points[there], at.vectors[there]]), axis=0, return_index=True)[1])]
    if len(kept) == len(there):
        return field
    covariance = None if at.covariance is None else at.covariance[kept]
    return DisplacementField.from_arrays(at.points[kept], at.vectors[kept], covariance=covariance)


def placed_on_scan(field: DisplacementField, spacing_mm: Sequence[float] | None, scan: Volume) -> DisplacementField:
    """Return a field whose positions are voxels times their size, counted from voxel 0, in the frame of the scan that they count.

    Parameters
    ----------
    field : DisplacementField
        At points of three coordinates.
    spacing_mm : sequence of float or None
        Size of a voxel along x, y, z, mm, as it was given for the field; None for one in mm, which is returned as it is.
    scan : Volume
        Mask or labels; of voxels of another size, they are not the voxels of the field, which is returned as it is.
    """
    if spacing_mm is None or field.points.shape[1] != 3 or not np.allclose(scan.spacing_mm, spacing_mm, rtol=1e-3):
        return field
    points, turn = scan.to_physical(field.points / np.asarray(spacing_mm)), scan.direction
    covariance = None if field.covariance is None else turn @ field.covariance @ turn.T
    return DisplacementField.from_arrays(points, field.vectors @ turn.T, covariance=covariance, valid=field.valid)


def _likely_frame(points: FloatArray, inside: Volume) -> str:
    """Return in words in which unit or frame most points would lie in the object, if in one of those that are common; else nothing."""
    tried = {f"in {unit}; give `unit` {unit}": MM_PER_UNIT[unit] * points for unit in ("cm", "m", "um", "inch")}
    tried["in RAS; change the signs of x, y, ux and uy"] = points * [-1.0, -1.0, 1.0]
    tried["with y upwards; take x, -z, y and ux, -uz, uy for x, y, z and ux, uy, uz"] = points[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    tried["in the order z, y, x; exchange the columns x and z, ux and uz"] = points[:, ::-1]
    tried["in voxels; give spacing_mm"] = inside.to_physical(points)
    if _within(points, inside).mean() > LIKELY:
        return ""
    for told, moved in tried.items():
        share = float(_within(moved, inside).mean())
        extents = np.ptp(moved, axis=0).max(), np.ptp(inside.to_physical(np.argwhere(inside.values)[:, ::-1]), axis=0).max()
        if share > LIKELY and extents[0] > LIKELY * extents[1]:
            return f" {100.0 * share:.0f} % of the points would lie in it if they were {told}."
    return ""


def _within(points: FloatArray, inside: Volume) -> BoolArray:
    """Return which points (n, 3), mm, lie in voxels that differ from zero."""
    index = np.round(inside.to_index(points)).astype(int)[:, ::-1]
    within = np.asarray(((index >= 0) & (index < inside.shape)).all(axis=1))
    within[within] = inside.values[tuple(index[within].T)] != 0
    return within


def _spans(points: FloatArray) -> str:
    """Return from where to where points reach along every axis, in words."""
    return ", ".join(
        f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in zip("xyz", points.min(axis=0), points.max(axis=0), strict=True)
    )


def _require_space(name: str, mesh: Mesh, points: FloatArray) -> None:
    """Refuse measurements in a plane, on a line or at a point, which are often lengths in another unit."""
    edge = float(np.linalg.norm(mesh.points[mesh.cells[:, 1]] - mesh.points[mesh.cells[:, 0]], axis=1).mean())
    directions = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    least = float(np.ptp(points @ directions.T, axis=0).min())
    if least < THINNEST * edge:
        raise InputError(
            f"{name}: the {len(points)} measurements in the object span only {least:.3g} mm along one direction, and cells are "
            f"{edge:.3g} mm large; moduli need displacements in three dimensions. They lie at {_spans(points)} mm: are they in mm?"
        )


def relative_deformation(field: DisplacementField) -> float:
    """Return the root mean square displacement that a rigid motion leaves, as part of the extent of a field at points."""
    points, vectors = field.points[field.valid], field.vectors[field.valid]
    left = vectors - registration(points, points + vectors).displacement(points)
    return float(np.sqrt((left**2).sum(axis=1).mean()) / np.linalg.norm(np.ptp(points, axis=0)))


def doubts_of_field(name: str, field: DisplacementField) -> tuple[str, ...]:
    """Say what speaks for displacements in another unit than mm, or for zeros where nothing was measured; either may be right as it is.

    Parameters
    ----------
    name : str
        For messages.
    field : DisplacementField
        At points that were measured, mm.
    """
    extent = float(np.linalg.norm(np.ptp(field.points[field.valid], axis=0)))
    share = relative_deformation(field)
    deformed, told = share * extent, []
    if share < TINY_DEFORMATION:
        told.append(
            f"{name}: the object, {extent:.3g} mm large, deforms by {deformed:.2g} mm RMS, {share:.1g} of its size. Scans and particles "
            "seldom show so little: are its displacements in metres? Moduli at finite strain, and forces, would be others; give the "
            "columns their unit, such as 'ux [m]'."
        )
    if field.covariance is not None:
        sd = float(np.sqrt(np.trace(field.covariance[field.valid], axis1=1, axis2=2).mean()))
        if deformed < sd:
            told.append(
                f"{name}: the object deforms by {deformed:.2g} mm RMS, less than the stated standard deviation of its vectors, {sd:.2g} "
                "mm: only what many of them share tells its moduli. Are displacements and standard deviations in one unit?"
            )
    zero, count = int((field.vectors[field.valid] == 0.0).all(axis=1).sum()), int(field.valid.sum())
    if zero >= max(ZERO[0], ZERO[1] * count):
        told.append(
            f"{name}: the displacement of {zero} of {count} points in the object is exactly zero, which programs write where they measured "
            "nothing: leave these points out. Only of what a simulation holds fast it is right."
        )
    return tuple(told)


def beyond_object(name: str, field: DisplacementField, inside: Volume) -> tuple[str, ...]:
    """Say which part of a field lies outside of the object, the voxels of `inside` that are not zero, where that is more than its rim."""
    if (share := _share_beyond(field, inside)) <= MOST_BEYOND:
        return ()
    return (
        f"{name}: {100 * share:.0f} % of its points lie outside of the object that the mask or the zones show, and are not used. "
        "Does that volume show all of the object that was measured, on the grid of the scan?",
    )


def beyond_rim(name: str, field: DisplacementField, inside: Volume) -> tuple[str, ...]:
    """Say how thick a rim of the object a mask leaves out, by how many points lie outside of it, where that is more than voxels do.

    Where surfaces are free, the model has them where the mask ends. As many points of equal density as lie outside take up a rim of the
    volume of the mask times their number over that of the others, over its surface.
    """
    if not 0.0 < (share := _share_beyond(field, inside)) <= MOST_BEYOND:
        return ()
    voxels = np.pad(np.asarray(inside.values != 0), 1)
    size = np.asarray(inside.spacing_mm)[::-1]  # along the axes of the array
    faces = np.array([np.count_nonzero(np.diff(voxels, axis=a)) for a in range(3)])
    volume = float(np.prod(size)) * np.count_nonzero(voxels)
    thick = share / (1.0 - share) * volume / float(faces @ (np.prod(size) / size))
    if thick <= RIM * float(np.cbrt(np.prod(size))):
        return ()
    return (
        f"{name}: {100 * share:.0f} % of its points lie outside of the object that the mask or the zones show, as many as in a rim of "
        f"{thick:.2g} mm. If the object reaches so far, its free surfaces are not where the model has them, and moduli, the law or the "
        "readings of its vectors are blamed for that: make the mask larger.",
    )


def _share_beyond(field: DisplacementField, inside: Volume) -> float:
    """Return which part of the points of a field lies where no voxel differs from zero."""
    at = field.at_points()
    return 1.0 - float(_within(at.points[at.valid], inside).mean())


def _require_deformation(name: str, field: DisplacementField) -> None:
    """Refuse a field in which the object moves as a rigid body, or is torn apart: nothing can be identified from either."""
    deformation, extent = relative_deformation(field), float(np.linalg.norm(np.ptp(field.points, axis=0)))
    if deformation <= LEAST_DEFORMATION:
        raise InputError(
            f"{name}: the object moves by up to {np.abs(field.vectors).max():.3g} mm, but does not deform; is it the right field?"
        )
    if deformation > LARGEST_DEFORMATION:
        raise InputError(
            f"{name}: the object, {extent:.3g} mm large, deforms by {deformation * extent:.3g} mm RMS; is the field in mm, and are field "
            "and mask from one reference scan?"
        )
