"""Identify moduli from displacement fields, from files to files: volumes of moduli on the grid of the scan, numbers, and a page."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.core.volume import Volume
from naibu.identification.from_fields.assumptions.other_assumptions import holds
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.forward.load_cases import KNOWN
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_fields.mesh_error import TOO_COARSE
from naibu.identification.from_fields.regions.relative_map import identify_relative_map
from naibu.identification.from_fields.uncertainty import MESH_DEPENDENT, NOT_DETERMINED, NOT_USABLE, POISSON_POORLY, Uncertainty, grade
from naibu.identification.verdict import Explanation
from naibu.io.displacement_fields import read_field
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import input_record
from naibu.io.images import write_volume
from naibu.viewer.cards import Card
from naibu.viewer.json_values import jsonable
from naibu.viewer.notebook import ShownInNotebook, empty_figure
from naibu.viewer.result_figures import draw_slices
from naibu.viewer.slices import Overlay, SliceView, slices_html
from naibu.viewer.tables import Cell, Table
from naibu.workflows.fields.block_mesh import blurred, labelled_object, names_of_labels, sizes_of_voxels
from naibu.workflows.fields.cells_of_map import cubes_of_map
from naibu.workflows.fields.cells_of_zones import POINTS_OF_CELL, cubes_of_zones
from naibu.workflows.fields.known_zones import NOTHING_KNOWN, KnownZones, parse_known_zones
from naibu.workflows.fields.likely_components import require_likely_components
from naibu.workflows.fields.measured_load_case import (
    beyond_object,
    beyond_rim,
    doubts_of_field,
    placed_on_scan,
    relative_deformation,
    without_copies,
)
from naibu.workflows.fields.object_on_cubes import MOST_REFINED, ObjectOnCubes, ScannedObject, identified_on_smaller_cubes
from naibu.workflows.fields.thin_coverings import Covering, told_left_out
from naibu.workflows.results.files_together import written_together
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FILES = ("model.json", "report.html", "zones.mha", "young_modulus.mha", "young_modulus_sd.mha", "poisson_ratio.mha", "identification.json")
MOST_CARDS = 4
NO_VALUE = np.nan, 0.0, np.inf, np.nan, -1.0, 0.5  # Young's modulus, Poisson's ratio, and their bounds, of a zone that is left out


@dataclass(frozen=True, slots=True, eq=False)
class FieldIdentification(ShownInNotebook):
    """What `identify_fields` returns.

    Attributes
    ----------
    estimate : FieldEstimate
        Moduli, intervals and verdict.
    body : IdentifiedBody
        The model, as ``model.json`` holds it.
    relative : bool
        Whether moduli are multiples of that of a zone whose modulus was not stated.
    notes : tuple of str
        Verdict, intervals and what limits them, in words.
    cautions : tuple of str
        Those of them that doubt units of the fields, or tell what cubes leave out of the object.
    scan : Volume
        Not zero in the object.
    cell_of_voxel : ndarray, shape (nz, ny, nx), int
        Cell of the model at every voxel of it; -1 outside.
    covering : Covering or None
        Zones that cover the object, are thinner than cells, and are left out of the model.
    left_out : tuple of str
        Those of them whose moduli were sought.
    files : tuple of Path
        What was written.
    """

    estimate: FieldEstimate
    body: IdentifiedBody
    relative: bool
    notes: tuple[str, ...]
    cautions: tuple[str, ...]
    scan: Volume
    cell_of_voxel: IntArray
    covering: Covering | None = None
    left_out: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @property
    def unit(self) -> str:
        """Unit of Young's modulus."""
        return self.body.unit

    def page_html(self) -> str:
        """Return the page of the result, a whole HTML document."""
        return slices_html(_page(self))

    def plot(self) -> Canvas:
        """Return a figure of the slice with most of the object: Young's modulus and its standard deviation, and Poisson's ratio."""
        z = int(np.argmax((self.cell_of_voxel >= 0).sum(axis=(1, 2))))
        shown = [(name, values[z], colours) for (name, values), colours in zip(_maps(self), ("viridis", "cividis", "viridis"), strict=True)]
        canvas = empty_figure(11.0, 3.6)
        draw_slices(canvas, shown, self.scan.spacing_mm)
        return canvas

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row a zone or region: its name, Young's modulus, Poisson's ratio, and their 95 % intervals."""
        return tuple(_as_records(table_of_zones(self)))


@no_empty_folders()
def identify_fields(
    fields: Sequence[str | os.PathLike[str]] | str | os.PathLike[str],
    *,
    mask: str | os.PathLike[str] | None = None,
    zones: str | os.PathLike[str] | None = None,
    zone_names: Mapping[int, str] | None = None,
    known: Sequence[str] = (),
    loaded: Sequence[str] = (),
    each_cell: bool = False,
    law: LawName = "neo_hookean",
    element_size_mm: float = 0.0,
    unit: str | None = None,
    spacing_mm: Sequence[float] | None = None,
    node_spacing: Sequence[float] | None = None,
    check_components: bool = True,
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
        A map needs none: moduli are then multiples of that of its largest region.
    loaded : sequence of str
        Sides of the object at which forces act, where they act at no other: ``x-``, ``x+``, ``y-``, ``y+``, ``z-``, ``z+`` in the frame of
        the scan. By default they may act on the whole surface. A surface that is known to be free tells much of the moduli.
    each_cell : bool
        Map the moduli of unknown zones cell by cell, and make regions of the map.
    law : {"neo_hookean", "linear"}
        Finite or small strain.
    element_size_mm : float
        Edge length of the cubes; 0 chooses it so that there are about 1200; fewer where a cell would hold less than two points, more where
        a zone would share less than three quarters with its cubes, or where their size leaves more in doubt of moduli than the measurement
        does (then up to 2800). Of a map there are as many as points, but 700 at least and 2500 at most, and fewer where noise would strain
        them by more than half of what loads do.
    unit, spacing_mm : str, sequence of float, optional
        Unit of fields that do not state theirs, or the size of a voxel along x, y, z, mm, of fields in voxels (see `naibu.io.read_field`).
    node_spacing : sequence of float, optional
        From node to node along x, y, z, in voxels, of TIFF files of SPAM.
    check_components : bool
        Whether to refuse fields that would suit an elastic body far better with their components of other signs or in another order.
    out : path-like, optional
        Folder for ``model.json``, which predicts and can be touched; ``young_modulus.mha``, ``young_modulus_sd.mha`` and
        ``poisson_ratio.mha`` on the grid of the mask (0 outside; not a number, NaN, where the value is not determined or not to be used,
        or has no standard deviation); ``zones.mha`` (from 1 in the order of the table of moduli, 0 where they are known);
        ``identification.json`` and ``report.html``.
    overwrite : bool
        Whether these files may be there already.
    progress : callable, optional
        Gets a report after every step.

    Raises
    ------
    InputError
        Files that cannot be read or do not fit together, a known zone that does not exist, nothing that sets the scale, or displacements
        that are likely not in the frame of their positions.
    ConvergenceError
        The fields do not fix how the surface moves, or there is no equilibrium.
    """
    paths = [fields] if isinstance(fields, str | os.PathLike) else list(fields)
    read = [read_field(path, unit=unit, spacing_mm=spacing_mm, node_spacing=node_spacing) for path in paths]
    _require_different(paths, read)
    inside, labels = labelled_object(mask, zones)
    read = [without_copies(placed_on_scan(field, spacing_mm, inside)) for field in read]
    names = names_of_labels(labels, inside, zone_names or {})
    given = stated = _stated(known, list(names.values()), each_cell=each_cell)
    scanned = ScannedObject(inside, labels, names, tuple((Path(p).stem, f) for p, f in zip(paths, read, strict=True)), tuple(loaded))
    points = max(int(field.valid.sum()) for field in read)
    longer = sizes_of_voxels(inside, element_size_mm) if element_size_mm else ()
    if each_cell:
        cubes, noisy = cubes_of_map(scanned, points, element_size_mm)
        longer += noisy
    else:
        cubes, stated = cubes_of_zones(scanned, points, element_size_mm, stated)
    scanned = cubes.scanned
    folder = None if out is None else output_folder(out, FILES, overwrite=overwrite)
    doubts, untold = require_likely_components(scanned, points, stated, progress) if check_components else ((), ())
    if stated is NOTHING_KNOWN:
        found = identify_relative_map(cubes.mesh, cubes.load_cases, law=law, bounds=stated.bounds, progress=progress)
    else:
        found = cubes.identified(stated, law=law, bounds=stated.bounds, each_cell=each_cell, progress=progress)
        if not (each_cell or element_size_mm):
            cubes, found = identified_on_smaller_cubes(
                cubes, found, stated, most=min(MOST_REFINED, points // POINTS_OF_CELL), law=law, bounds=stated.bounds, progress=progress
            )
    found = told_left_out(found, scanned.covering, given.values)
    inputs = input_record({"mask": mask, "zones": zones} | {f"field {k + 1}": p for k, p in enumerate(paths)})
    body = IdentifiedBody.of(
        found, axes=inside.direction, law=law, relative=stated.relative, load_cases=cubes.load_cases,
        strain=max(relative_deformation(case.field) for case in cubes.load_cases),
        provenance={"naibu": __version__, "known": list(known), "loaded": list(loaded), "inputs": dict(inputs)}, region_at=cubes.region_at,
    )  # fmt: skip
    notes, told = _told(found, cubes, doubts, (*untold, *longer))
    own = () if scanned.covering is None else tuple(name for name in scanned.covering.names if name not in given.values)
    result = FieldIdentification(found, body, stated.relative, notes, told, inside, cubes.cell_of_voxel, scanned.covering, own)
    return result if folder is None else replace(result, files=written_together(folder, FILES, lambda at: _written(at, result)))


def _told(
    found: FieldEstimate, cubes: ObjectOnCubes, doubts: tuple[str, ...], longer: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return all that is to be told of a result, and of that what makes the fields doubtful and what cubes leave out or count as noise."""
    corrected, scanned = cubes.region_at is not None and found.mesh_shift is not None, cubes.scanned
    doubts += tuple(told for name, field in scanned.fields for told in beyond_object(name, field, scanned.whole))
    if scanned.loaded:
        doubts += tuple(told for name, field in scanned.fields for told in beyond_rim(name, field, scanned.whole))
    doubts += tuple(told for case in cubes.load_cases for told in doubts_of_field(case.name, case.field))
    coarse = (*blurred(cubes.left_out, cubes.wrong, cubes.lost, corrected=corrected), *cubes.noise)
    return (*found.identifiability[:1], *doubts, *found.identifiability[1:], *coarse, *longer), (*doubts, *coarse)


def _stated(known: Sequence[str], names: Sequence[str], *, each_cell: bool) -> KnownZones:
    """Return what is known of zones, of which a map needs nothing.

    Raises
    ------
    InputError
        What `parse_known_zones` refuses, or nothing that is not known.
    """
    if each_cell and not known:
        return NOTHING_KNOWN
    stated = parse_known_zones(known, names)
    if set(names) <= set(stated.values):
        ways = "; without it a map is made of multiples of the modulus of its largest region" if each_cell else ""
        raise InputError(f"known names every zone, so that nothing is left to be identified: leave one out{ways}")
    return stated


def _require_different(paths: Sequence[str | os.PathLike[str]], fields: Sequence[DisplacementField]) -> None:
    """Refuse a field that is there twice: it would count as two measurements."""
    for (first, a), (second, b) in combinations(zip(paths, fields, strict=True), 2):
        if np.array_equal(a.vectors, b.vectors, equal_nan=True):
            raise InputError(f"{first} and {second} hold the same displacements, which would count twice; name each field once")


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
    """Return the table of moduli with their intervals, and those of Young's modulus with the law taken for right."""
    found = result.estimate
    rows: list[tuple[Cell, ...]] = []
    if found.uncertainty is not None:
        young, poisson = found.intervals()
        exact = found.intervals(law_exact=True)[0]
        how = _grades(found, found.uncertainty)
        for i, name in enumerate(found.zones.names):
            e, nu = (float(values[i]) for values in (found.young_modulus, found.poisson_ratio))
            rows.append((name, e, *map(float, young[i]), nu, *map(float, poisson[i]), how[i], *map(float, exact[i])))
    rows += [(name, *NO_VALUE, NOT_DETERMINED, 0.0, np.inf) for name in result.left_out]
    moduli = (f"Young's modulus, {result.unit}", "95 % from", "to", "Poisson's ratio", "of which 95 % from", "up to")
    exactly = ("if the law is exact, Young's modulus 95 % from", "if the law is exact, Young's modulus to")
    columns = ("zone", *moduli, "Young's modulus is", *exactly)
    return Table("Moduli", columns, tuple(rows))


def _grades(found: FieldEstimate, uncertainty: Uncertainty) -> list[str]:
    """Return in words how well Young's modulus of every zone is determined, as the sentences say."""
    judged = found.verdict
    usable, apart = judged is None or judged.ok, () if judged is None else judged.mesh_dependent
    sure = (judged is None or judged.explanation is Explanation.EXPLAINED) and TOO_COARSE not in found.identifiability
    bounded = np.isfinite(found.intervals()[0][:, 1])  # a modulus without an upper bound is not determined, whatever its curvature
    sd = np.where(bounded | (not usable), uncertainty.of_young_and_poisson(found.theta)[0], np.inf)
    return [grade(s, usable=usable, sure=sure, apart=n in apart) for s, n in zip(sd, found.zones.names, strict=True)]


def table_of_assumptions(result: FieldIdentification) -> Table:
    """Return what Young's modulus and Poisson's ratio would be under other assumptions: other known values, the other law."""
    found = result.estimate
    rows: list[tuple[Cell, ...]] = []
    if found.uncertainty is not None:
        inside = found.intervals()[0]
        for one in found.assumptions:
            young, poisson = young_and_poisson(one.applied(found.theta))
            for name, e, nu, (low, high) in zip(found.zones.names, young, poisson, inside, strict=True):
                if not np.isfinite(high):  # of a modulus that may be anything, a change to first order says nothing
                    continue
                rows.append((one.text, name, float(e), float(nu), "yes" if holds(low, high, e) else "no"))
    columns = ("other assumption", "zone", f"Young's modulus, {result.unit}", "Poisson's ratio", "modulus within the interval above")
    return Table("Moduli under other assumptions", columns, tuple(rows))


def _cards(result: FieldIdentification) -> list[Card]:
    """Return Young's modulus of the first zones with its interval, and how well it is determined."""
    found = result.estimate
    if found.uncertainty is None:
        return []
    how = _grades(found, found.uncertainty)
    rows = zip(found.zones.names[:MOST_CARDS], found.young_modulus, found.intervals()[0], how, strict=False)
    unit = result.unit.replace("multiples of", "×")  # behind a number
    return [_card(name, unit, e, low, high, word) for name, e, (low, high), word in rows]


def _card(name: str, unit: str, young: float, low: float, high: float, how: str) -> Card:
    """Return the card of a zone; where its modulus is not determined, the best fit is no result and stands behind the interval."""
    label = f"Young's modulus, {name}"
    if how in (NOT_DETERMINED, MESH_DEPENDENT):
        return Card(
            label, how, f"95 % from {low:.3g} to {high:.3g} {unit}, best fit {young:.3g}" if np.isfinite(high) else "any value fits"
        )
    return Card(label, f"{young:.3g} {unit}", f"95 % from {low:.3g} to {high:.3g}, {how}")


def _as_records(table: Table) -> list[dict[str, Cell]]:
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def without_value(found: FieldEstimate, uncertainty: Uncertainty) -> tuple[BoolArray, BoolArray]:
    """Return of which zones Young's modulus, and Poisson's ratio (count,), is no result: its best fit may be anything.

    A volume is seen without the sentences that say so, and the mean over a part of it would hide such a number among others.
    """
    young = np.isin(_grades(found, uncertainty), (NOT_DETERMINED, MESH_DEPENDENT, NOT_USABLE))
    return young, young | ~(uncertainty.of_young_and_poisson(found.theta)[1] <= POISSON_POORLY)


def _volumes(result: FieldIdentification) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Young's modulus, its standard deviation, and Poisson's ratio of every voxel; NaN where there is none, 0 outside."""
    found, cells = result.estimate, result.cell_of_voxel
    young, sd, poisson = (np.where(cells >= 0, values[cells], 0.0) for values in moduli_of_cells(found))
    if result.covering is not None:
        young[result.covering.voxels] = sd[result.covering.voxels] = poisson[result.covering.voxels] = np.nan
    if found.uncertainty is None:
        return young, sd, poisson
    regions = zones_of_voxels(found, result.scan, cells)
    there = regions != KNOWN
    of_young = found.young_modulus * found.uncertainty.of_young_and_poisson(found.theta)[0]
    no_young, no_poisson = without_value(found, found.uncertainty)
    of_zones = (young, found.young_modulus, no_young), (sd, of_young, no_young), (poisson, found.poisson_ratio, no_poisson)
    for full, values, none in of_zones:
        full[there] = np.where(none, np.nan, values)[regions[there]]
    return young, sd, poisson


def _maps(result: FieldIdentification) -> list[tuple[str, FloatArray]]:
    """Return what a page and a figure show, with names; NaN outside, where nothing is known, and in rigid zones, which dwarf the others."""
    young, sd, poisson = _volumes(result)
    there = result.cell_of_voxel
    outside = np.where((there >= 0) & ~result.estimate.zones.in_rigid_region[there], 0.0, np.nan)
    return [
        (f"Young's modulus, {result.unit}", young + outside),
        (f"standard deviation of Young's modulus, {result.unit}", np.where(sd > 0.0, sd, np.nan) + outside),
        ("Poisson's ratio", poisson + outside),
    ]


def _page(result: FieldIdentification) -> SliceView:
    scan, first = result.scan, [line for line in (*result.notes[:1], TOO_COARSE, *result.cautions) if line in result.notes]
    return SliceView(
        title="Moduli from displacement fields",
        sentences=first,
        cards=_cards(result),
        details=[line for line in (*result.notes, *result.estimate.steps) if line not in first],
        spacing_mm=scan.spacing_mm,
        images=[("object", scan.values.astype(np.float32))],
        displacement=np.full((*scan.shape, 3), np.nan),
        overlays=[Overlay(name, values) for name, values in _maps(result)],
        tables=[t for t in (table_of_zones(result), table_of_assumptions(result)) if t.rows],
        origin_mm=scan.origin_mm @ scan.direction,
    )


def _written(folder: Path, result: FieldIdentification) -> list[Path]:
    """Write the model first, then numbers and volumes, and the page."""
    found, body, scan = result.estimate, result.body, result.scan
    young, sd, poisson = _volumes(result)
    regions = zones_of_voxels(found, scan, result.cell_of_voxel)
    volumes = {"young_modulus": young, "young_modulus_sd": sd, "poisson_ratio": poisson}
    files = [write_atomically(folder / "model.json", json.dumps(body.to_dict(), ensure_ascii=False, allow_nan=False) + "\n")]
    files += [write_volume(folder / f"{name}.mha", scan.with_values(v.astype(np.float32))) for name, v in volumes.items()]
    files.append(write_volume(folder / "zones.mha", scan.with_values((regions + 1).astype(np.uint16))))
    verdict = found.verdict
    numbers = {
        "naibu": __version__,
        "verdict": None if verdict is None else verdict.to_dict(),
        "zones": _as_records(table_of_zones(result)),
        "other_assumptions": _as_records(table_of_assumptions(result)),
        "noise_factor": found.noise_factor,
        "in_words": list(result.notes),
        "steps": list(found.steps),
        "known": body.provenance["known"],
        "loaded": body.provenance["loaded"],
        "law": body.law,
        "cells": found.mesh.n_cells,
        "inputs": body.provenance["inputs"],
    }
    text = json.dumps(jsonable(numbers, 17), indent=1, ensure_ascii=False, allow_nan=False)
    files.append(write_atomically(folder / "identification.json", text + "\n"))
    return [write_atomically(folder / "report.html", result.page_html()), *files]
