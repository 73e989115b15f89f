"""Identify moduli from displacement fields, from files to files: volumes of moduli on the grid of the scan, numbers, and a page."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from naibu._version import __version__
from naibu.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, require_lengths
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress
from naibu.core.rigid_transform import registration
from naibu.core.units import kilopascals
from naibu.core.volume import Volume
from naibu.identification.from_fields.estimate import FieldEstimate, identify_field
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.forward.load_cases import KNOWN, FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.io.displacement_fields import read_field
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import read_volume, write_volume
from naibu.meshing.point_location import locate
from naibu.meshing.primitives import grid_cells
from naibu.meshing.surface import boundary_nodes
from naibu.viewer.slices import Overlay, SliceView, slices_html
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import output_folder

FILES = ("report.html", "zones.mha", "young_modulus.mha", "young_modulus_sd.mha", "poisson_ratio.mha", "identification.json")
CELLS, CELLS_OF_MAP = 1200, 2500  # of the model by default
MOST_POINTS = 10_000  # measurements of a load case: neighbours in a field say the same
BLURRED = 0.01  # part of the object that cubes may misrepresent without a word
MOST_CELLS = 100_000  # of a mesh whose size is asked for: beyond, a factorization does not fit into memory
MOST_LABEL = 65535
HALF_FILLED = 0.5  # part of a cell that must lie in the object
LEAST_DEFORMATION, LARGEST_DEFORMATION = 1e-6, 0.5  # RMS of what a rigid motion leaves, part of the extent of the object
POISSON_RATIO, POISSON_RATIO_SD = 0.45, 0.03  # of a known material of which only Young's modulus is stated
RIGID = 300.0  # stiffness of what is called rigid over that of the stiffest other known material
LARGEST_POISSON_RATIO = 0.499  # of a known zone: beyond, elements of one pressure each lock


@dataclass(frozen=True, slots=True, eq=False)
class KnownZones:
    """Known zones: Young's modulus, kPa, and Poisson's ratio by name, their standard deviations, and whether moduli are only ratios."""

    values: Mapping[str, tuple[float, float]]
    doubts: Mapping[str, tuple[float, float]]
    relative: bool


@dataclass(frozen=True, slots=True, eq=False)
class FieldIdentification:
    """What `identify_fields` returns.

    Attributes
    ----------
    estimate : FieldEstimate
        Moduli, intervals and verdict.
    relative : bool
        Whether moduli are multiples of that of a zone whose modulus was not stated.
    notes : tuple of str
        Verdict, intervals and what limits them, in words.
    files : tuple of Path
        What was written.
    """

    estimate: FieldEstimate
    relative: bool
    notes: tuple[str, ...]
    files: tuple[Path, ...] = ()


def identify_fields(
    fields: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    *,
    mask: str | os.PathLike[str] | None = None,
    zones: str | os.PathLike[str] | None = None,
    zone_names: Mapping[int, str] | None = None,
    known: Sequence[str] = (),
    each_cell: bool = False,
    law: LawName = "neo_hookean",
    element_size_mm: float = 0.0,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> FieldIdentification:
    """Identify moduli from measured displacement fields of one body, and write volumes of moduli, numbers and a page.

    The model is made of cubes that fill the object. Forces on its surface are not known: the displacement of the surface is identified
    along with the moduli, and the balance of forces inside determines these up to a factor, which known zones set.

    Parameters
    ----------
    fields : path-like, or sequence of them
        One file for each load case (see `naibu.io.read_field`), such as the ``field.h5`` of ``naibu sense``, all from one reference scan.
    mask : path-like, optional
        Volume that is not zero in the object; by default where `zones` has labels.
    zones : path-like, optional
        Volume of whole numbers on the same grid, one for each zone; 0 outside. Without it the object is one zone.
    zone_names : mapping, optional
        Names of labels; by default ``"label 1"`` and so on.
    known : sequence of str
        ``"gel=12 kPa"``, ``"gel=12 kPa, 0.45"`` with Poisson's ratio, ``"bone=rigid"``; or only a name, of which the others are multiples.
    each_cell : bool
        Map the moduli of unknown zones cell by cell, and make regions of the map.
    law : {"neo_hookean", "linear"}
        Finite or small strain.
    element_size_mm : float
        Edge length of the cubes; 0 chooses it so that there are about 1200, or 2500 for a map.
    out : path-like, optional
        Folder for ``young_modulus.mha``, ``young_modulus_sd.mha`` and ``poisson_ratio.mha`` on the grid of the mask (0 outside; -1 where
        there is no standard deviation), ``zones.mha`` (from 1 in the order of the table of moduli, 0 where they are known),
        ``identification.json`` and ``report.html``.
    overwrite : bool
        Whether these files may be there already.
    progress : callable, optional
        Gets a report after every step.

    Raises
    ------
    InputError
        Files that cannot be read or do not fit together, a known zone that does not exist, or nothing that sets the scale.
    ConvergenceError
        The fields do not fix how the surface moves, or there is no equilibrium.
    """
    paths = [fields] if isinstance(fields, str | os.PathLike) else list(fields)
    folder = None if out is None else output_folder(out, FILES, overwrite=overwrite)
    inside, labels = _object(mask, zones)
    names = _names(labels, inside, zone_names or {})
    stated = parse_known_zones(known, list(names.values()))
    volume = float(inside.values.sum() * np.prod(inside.spacing_mm))
    size = element_size_mm or (volume / (CELLS_OF_MAP if each_cell else CELLS)) ** (1.0 / 3.0)
    mesh, cell_of_voxel = block_mesh(inside, labels, names, size)
    cases = [_load_case(mesh, cell_of_voxel, inside, read_field(p), Path(p).stem) for p in paths]
    found = identify_field(
        mesh, cases, Zones.of(mesh, known=stated.values, known_sd=stated.doubts, each_cell=each_cell), law=law, progress=progress
    )
    result = FieldIdentification(found, stated.relative, (*found.identifiability, *blurred(mesh, cell_of_voxel, inside, labels, names)))
    if folder is None:
        return result
    inputs = input_record({"mask": mask, "zones": zones} | {f"field {k + 1}": p for k, p in enumerate(paths)})
    return replace(result, files=tuple(_written(folder, result, inside, cell_of_voxel, known, law, inputs)))


def parse_known_zones(known: Sequence[str], names: Sequence[str]) -> KnownZones:
    """Read ``"gel=12 kPa"``, ``"gel=12 kPa, 0.45"``, ``"bone=rigid"`` or ``"gel"``.

    Raises
    ------
    InputError
        A text that is none of these, a zone that does not exist, or nothing that sets the scale.
    """
    values: dict[str, tuple[float, float]] = {}
    doubts: dict[str, tuple[float, float]] = {}
    rigid: list[str] = []
    relative = False
    for text in known:
        name, equals, value = (part.strip() for part in text.partition("="))
        if name not in names:
            raise InputError(f"known={text!r}: there is no zone {name!r}; the zones are {', '.join(map(repr, names))}")
        if equals and value == "rigid":
            rigid.append(name)
        elif equals:
            values[name], doubts[name] = _stated_moduli(text, value)
        else:
            relative, values[name], doubts[name] = True, (1.0, POISSON_RATIO), (0.0, POISSON_RATIO_SD)
    if not values:
        raise InputError(
            f"known names no zone with a modulus, so that nothing sets the scale; name one of {', '.join(map(repr, names))}, "
            "with its Young's modulus, or without it for ratios"
        )
    if relative and len(values) > 1:
        raise InputError("known states the modulus of some zones and leaves that of another open; state all, or name one")
    stiff = RIGID * max(young for young, _ in values.values())
    return KnownZones(values | dict.fromkeys(rigid, (stiff, 0.3)), doubts, relative)


def _stated_moduli(text: str, value: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return Young's modulus, kPa, and Poisson's ratio, and their standard deviations, of ``12 kPa`` or ``12 kPa, 0.45``."""
    modulus, comma, ratio = (part.strip() for part in value.partition(","))
    try:
        young, poisson = kilopascals(modulus), float(ratio) if comma else POISSON_RATIO
    except ValueError as error:  # an InputError is one
        said = f" ({error})" if isinstance(error, InputError) else ""
        ways = "write 'gel=12 kPa', 'gel=12 kPa, 0.45' with Poisson's ratio, 'bone=rigid', or 'gel'"
        raise InputError(f"known={text!r}: {ways}{said}") from error
    if not 0.0 <= poisson <= LARGEST_POISSON_RATIO:
        raise InputError(f"known={text!r}: Poisson's ratio must lie between 0 and {LARGEST_POISSON_RATIO:g}, not {poisson:g}")
    return (young, poisson), (0.0, 0.0 if comma else POISSON_RATIO_SD)


def _object(mask: str | os.PathLike[str] | None, zones: str | os.PathLike[str] | None) -> tuple[Volume, IntArray]:
    """Return the object as a volume of ones and zeros, and the label of every voxel."""
    read = [None if path is None else read_volume(path) for path in (mask, zones)]
    first = next((v for v in read if v is not None), None)
    if first is None:
        raise InputError("give `mask`, the voxels of the object, or `zones`, a label for each material")
    if read[0] is not None and read[1] is not None and not read[0].same_grid(read[1]):
        raise InputError("mask and zones lie on different grids; resample one of them")
    labels = np.ones(first.shape, dtype=np.int64) if read[1] is None else _whole(read[1].values)
    inside = (labels > 0) & (True if read[0] is None else read[0].values != 0)
    if not inside.any():
        raise InputError("mask and zones have no voxel in common: there is no object")
    return first.with_values(inside.astype(np.uint8)), labels


def _whole(values: AnyArray) -> IntArray:
    """Return labels as whole numbers."""
    wrong = ~(np.abs(values) <= MOST_LABEL) | (values != np.round(values))  # also what is not a number
    if wrong.any():
        at = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            f"zones has the value {values[at]:g} at voxel {at[::-1]} (x, y, z): labels are whole numbers up to {MOST_LABEL}; "
            "is it a scan, or was it interpolated?"
        )
    return values.astype(np.int64)


def _names(labels: IntArray, inside: Volume, given: Mapping[int, str]) -> dict[int, str]:
    there = np.unique(labels[inside.values != 0]).tolist()
    if unknown := sorted(set(given) - set(there)):
        raise InputError(f"zone_names names label {unknown[0]}, which no voxel of the object has; there are {', '.join(map(str, there))}")
    return {label: given.get(label, f"label {label}" if len(there) > 1 else "body") for label in there}


def block_mesh(inside: Volume, labels: IntArray, names: Mapping[int, str], element_size_mm: float) -> tuple[Mesh, IntArray]:
    """Return hexahedra that fill the object, and the cell of every voxel (nz, ny, nx), -1 outside.

    Parameters
    ----------
    inside : Volume
        Not zero in the object.
    labels : ndarray, shape (nz, ny, nx), int64
        Zone of every voxel.
    names : mapping
        Names of the labels.
    element_size_mm : float
        Edge length, at least that of a voxel; 0 for about 1200 cells.

    Raises
    ------
    InputError
        A size that is no length, or so small or large that there are too many cells or too few.
    """
    if element_size_mm:
        require_lengths(element_size_mm=element_size_mm)
    voxels = np.argwhere(inside.values != 0)[:, ::-1]
    volume = len(voxels) * float(np.prod(inside.spacing_mm))
    size = element_size_mm or (volume / CELLS) ** (1.0 / 3.0)
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    counts = np.clip(np.round((high - low) * inside.spacing_mm / size).astype(int), 1, high - low)
    if volume / size**3 > MOST_CELLS and np.prod(counts) > MOST_CELLS:
        least = (volume / MOST_CELLS) ** (1.0 / 3.0)
        raise InputError(f"element_size_mm is {size:.3g} mm, which makes more than {MOST_CELLS} cells; choose at least {least:.2g} mm")
    width = (high - low) / counts  # of a cell, in voxels
    block = np.minimum(((voxels + 0.5 - low) / width).astype(int), counts - 1)
    number = block @ np.array([1, counts[0], counts[0] * counts[1]])
    total = int(np.prod(counts))
    sides = zip(high - low, width, counts, strict=True)
    per_axis = [np.bincount(np.minimum(((np.arange(n) + 0.5) / w).astype(int), c - 1)) for n, w, c in sides]
    room = (per_axis[2][:, None, None] * per_axis[1][:, None] * per_axis[0]).ravel()  # voxels of a full cell
    share = np.bincount(number, minlength=total) / room
    parts, _ = ndimage.label((share >= HALF_FILLED).reshape(counts[::-1]))
    largest = int(np.argmax(np.bincount(parts.ravel())[1:])) + 1 if parts.any() else 1
    kept = np.flatnonzero(parts.ravel() == largest)
    if len(kept) < 8:
        raise InputError(f"the object has room for {len(kept)} cells of {size:.3g} mm; choose a smaller element_size_mm")
    order = sorted(names)
    votes = np.stack([np.bincount(number[labels[tuple(voxels.T[::-1])] == label], minlength=total) for label in order])
    corners = grid_cells(*(counts + 1))[kept]
    used, cells = np.unique(corners, return_inverse=True)
    axes = np.stack(np.unravel_index(used, tuple(counts[::-1] + 1))[::-1], axis=1)
    points = inside.to_physical(low - 0.5 + axes * width)
    regions = votes[:, kept].argmax(axis=0)
    mesh = Mesh.from_arrays(points, cells.reshape(corners.shape), "hexahedron", regions=regions, region_names=[names[k] for k in order])
    if np.linalg.det(inside.direction) < 0.0:
        mesh = Mesh(mesh.points, mesh.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]], "hexahedron", mesh.regions, mesh.region_names)
    cell = np.full(total, -1, dtype=np.int64)
    cell[kept] = np.arange(len(kept))
    of_voxel = np.full(inside.shape, -1, dtype=np.int64)
    of_voxel[tuple(voxels.T[::-1])] = cell[number]
    return mesh, of_voxel


def blurred(mesh: Mesh, cell_of_voxel: IntArray, inside: Volume, labels: IntArray, names: Mapping[int, str]) -> tuple[str, ...]:
    """Say how much of the object the cubes assign to the wrong zone or leave out; nothing where that is less than one per cent."""
    there = inside.values != 0
    cells = cell_of_voxel[there]
    wrong = np.array(sorted(names))[mesh.regions[cells]] != labels[there]
    share = float(np.mean((cells < 0) | wrong))
    if share < BLURRED:
        return ()
    return (
        f"The cubes leave out, or assign to another zone, {100 * share:.2g} % of the object, because zones end inside of them: what "
        "this costs is not in the intervals; compare with other sizes of elements.",
    )


def _load_case(mesh: Mesh, cell_of_voxel: IntArray, inside: Volume, field: DisplacementField, name: str) -> FieldLoadCase:
    """Return the load case of the measurements inside the cells; all nodes of the surface carry unknown forces."""
    at = field.at_points()
    index = np.round(inside.to_index(at.points)).astype(int)[:, ::-1]
    within = ((index >= 0) & (index < inside.shape)).all(axis=1) & at.valid
    within[within] = cell_of_voxel[tuple(index[within].T)] >= 0
    near = np.flatnonzero(within)  # cells end inside of voxels
    chosen = near[locate(mesh, at.points[near], tolerance_mm=np.inf).distance_mm <= 1e-6] if len(near) else near
    if len(chosen) < 20:
        raise InputError(f"{name}: {len(chosen)} measurements of the field lie in the object; are field and mask from one reference scan?")
    every = -(-len(chosen) // MOST_POINTS)
    chosen = np.random.default_rng(0).permutation(chosen)[: len(chosen) // every]
    covariance = None if at.covariance is None else at.covariance[chosen]
    some = DisplacementField.from_arrays(at.points[chosen], at.vectors[chosen], covariance=covariance)
    _require_deformation(name, some)
    loaded: BoolArray = np.zeros(mesh.n_points, dtype=bool)
    loaded[boundary_nodes(mesh)] = True
    return FieldLoadCase.of(name, some, mesh, loaded=loaded)


def _require_deformation(name: str, field: DisplacementField) -> None:
    """Refuse a field in which the object moves as a rigid body, or is torn apart: nothing can be identified from either."""
    points, vectors = field.points, field.vectors
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    left = vectors - registration(points, points + vectors).displacement(points)
    deformation = float(np.sqrt((left**2).sum(axis=1).mean()))
    if deformation <= LEAST_DEFORMATION * extent:
        raise InputError(f"{name}: the object moves by up to {np.abs(vectors).max():.3g} mm, but does not deform; is it the right field?")
    if deformation > LARGEST_DEFORMATION * extent:
        raise InputError(
            f"{name}: the object, {extent:.3g} mm large, deforms by {deformation:.3g} mm RMS; is the field in mm, and are field and mask "
            "from one reference scan?"
        )


def zones_of_voxels(found: FieldEstimate, inside: Volume, cells: IntArray) -> IntArray:
    """Return the zone of every voxel (nz, ny, nx), -1 where its moduli are known and outside, with borders as fine as voxels."""
    out = np.where(cells >= 0, found.zones.of_cell[cells], KNOWN)
    if found.borders is not None:
        where = out != KNOWN
        out[where] = found.borders.region_at(inside.to_physical(np.argwhere(where)[:, ::-1]), out[where])
    return out


def moduli_of_cells(found: FieldEstimate) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Young's modulus, kPa, its standard deviation, kPa (NaN where none is known), and Poisson's ratio of every cell (m,)."""
    lame, shear = found.lame_of_cells()
    young, poisson = shear * (3.0 * lame + 2.0 * shear) / (lame + shear), lame / (2.0 * (lame + shear))
    sd = np.full(len(young), np.nan)
    unknown = found.zones.of_cell != KNOWN
    if found.uncertainty is not None:
        sd[unknown] = (young[unknown]) * found.uncertainty.of_young_and_poisson(found.theta)[0][found.zones.of_cell[unknown]]
    for number, region in enumerate(found.zones.known):
        sd[found.zones.region_of_cell == number] = region.young_modulus * region.young_modulus_sd
    return young, sd, poisson


def table_of_zones(result: FieldIdentification) -> Table:
    """Return the table of moduli with their intervals, which take the law as given."""
    found = result.estimate
    rows: list[tuple[Cell, ...]] = []
    unit = "multiples of the known zone" if result.relative else "kPa"
    if found.uncertainty is not None:
        young, poisson = found.intervals()
        for i, name in enumerate(found.zones.names):
            e, nu = (float(values[i]) for values in (found.young_modulus, found.poisson_ratio))
            rows.append((name, e, *map(float, young[i]), nu, *map(float, poisson[i])))
    columns = ("zone", f"Young's modulus, {unit}", "95 % from", "to", "Poisson's ratio", "of which 95 % from", "up to")
    return Table("Moduli", columns, tuple(rows))


def table_of_assumptions(result: FieldIdentification) -> Table:
    """Return what Young's modulus and Poisson's ratio would be under other assumptions: other known values, the other law."""
    found = result.estimate
    rows: list[tuple[Cell, ...]] = []
    if found.uncertainty is not None:
        inside = found.intervals()[0]
        for one in found.assumptions:
            young, poisson = young_and_poisson(found.theta + one.theta)
            for name, e, nu, (low, high) in zip(found.zones.names, young, poisson, inside, strict=True):
                rows.append((one.text, name, float(e), float(nu), "yes" if low <= e <= high else "no"))
    unit = "multiples of the known zone" if result.relative else "kPa"
    columns = ("other assumption", "zone", f"Young's modulus, {unit}", "Poisson's ratio", "modulus within the interval above")
    return Table("Moduli under other assumptions", columns, tuple(rows))


def _as_records(table: Table) -> list[dict[str, Cell]]:
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def _written(
    folder: Path, result: FieldIdentification, inside: Volume, cells: IntArray, known: Sequence[str], law: str, inputs: Mapping[str, str]
) -> list[Path]:
    found = result.estimate
    young, sd, poisson = (np.where(cells >= 0, values[cells], 0.0) for values in moduli_of_cells(found))
    regions = zones_of_voxels(found, inside, cells)
    if found.borders is not None and found.uncertainty is not None:
        there = regions != KNOWN
        of_young = found.young_modulus * found.uncertainty.of_young_and_poisson(found.theta)[0]
        for full, values in ((young, found.young_modulus), (sd, of_young), (poisson, found.poisson_ratio)):
            full[there] = values[regions[there]]
    volumes = {"young_modulus": young, "young_modulus_sd": np.nan_to_num(sd, nan=-1.0, posinf=-1.0), "poisson_ratio": poisson}
    files = [write_volume(folder / f"{name}.mha", inside.with_values(v.astype(np.float32))) for name, v in volumes.items()]
    files.append(write_volume(folder / "zones.mha", inside.with_values((regions + 1).astype(np.uint16))))
    outside = np.where(cells >= 0, 0.0, np.nan)
    unit = "multiples of the known zone" if result.relative else "kPa"
    view = SliceView(
        title="Moduli from displacement fields",
        sentences=[*result.notes, *found.steps],
        spacing_mm=inside.spacing_mm,
        images=[("object", inside.values.astype(np.float32))],
        displacement=np.full((*inside.shape, 3), np.nan),
        overlays=[
            Overlay(f"Young's modulus, {unit}", young + outside),
            Overlay(f"standard deviation of Young's modulus, {unit}", np.where(sd > 0.0, sd, np.nan) + outside),
            Overlay("Poisson's ratio", poisson + outside),
        ],
        tables=[t for t in (table_of_zones(result), table_of_assumptions(result)) if t.rows],
        origin_mm=inside.origin_mm @ inside.direction,
    )
    verdict = found.verdict
    numbers = {
        "naibu": __version__,
        "verdict": None if verdict is None else verdict.to_dict(),
        "zones": _as_records(table_of_zones(result)),
        "other_assumptions": _as_records(table_of_assumptions(result)),
        "noise_factor": found.noise_factor,
        "in_words": list(result.notes),
        "steps": list(found.steps),
        "known": list(known),
        "law": law,
        "cells": found.mesh.n_cells,
        "inputs": dict(inputs),
    }
    files.append(write_atomically(folder / "identification.json", json.dumps(numbers, indent=1, ensure_ascii=False) + "\n"))
    return [write_atomically(folder / "report.html", slices_html(view)), *files]
