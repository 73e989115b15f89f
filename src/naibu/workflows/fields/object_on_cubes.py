"""An object with its measured fields on cubes of one size, and its moduli identified on them, on smaller ones where these change moduli."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.identification.from_fields.estimate import homogeneous_moduli, identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.representation_error import with_noise_of_neighbours, with_representation_error
from naibu.identification.from_fields.forward.zones_within_cells import RegionAt
from naibu.identification.from_fields.inversion.gauss_newton import Bounds
from naibu.identification.from_fields.mesh_error import one_cell_thick
from naibu.identification.from_fields.verdicts.verdict import LEAST_POINTS
from naibu.workflows.fields.block_mesh import CELLS, ends_within, lost_parts, misplaced, moved_borders, region_in, regions_of
from naibu.workflows.fields.border_fitting import fitted_to_borders
from naibu.workflows.fields.contradicted_measurements import without_contradicted
from naibu.workflows.fields.known_zones import KnownZones
from naibu.workflows.fields.measured_load_case import measured_load_case
from naibu.workflows.fields.thin_coverings import Covering, loaded_below, mesh_on_what_is_left, without_thin_coverings

MOST_REFINED = 2800  # cells that are made unasked where smaller ones change moduli: beyond, the time grows with the square of their number
POINTS_THAT_TELL = 2  # a cube, from which neighbours tell noise: the nodes of smaller ones follow it
WORTHWHILE = 0.85  # of the edge length: refinement by less changes little
HALF = 0.5  # of it: the least by which cells are made smaller at once
UNRESOLVED = (
    "{}: {:.2g} % of the measurements lie where displacements change on a scale below that of the elements; what these cannot follow is "
    "counted as their noise."
)
UNDERSTATED = "{}: measurements scatter {:.2g} times as much about any displacement of the cubes as is stated; that counts as their noise."
UNSTATED = (
    "{}: no standard deviation is stated; measurements scatter by {:.2g} mm about any displacement of the cubes, which is taken for it."
)
COMPRESSIBLE = 0.48  # largest Poisson's ratio from which a search on smaller cells starts


@dataclass(frozen=True, slots=True, eq=False)
class ScannedObject:
    """An object in a scan with the fields measured in it.

    Attributes
    ----------
    inside : Volume
        Not zero in the object.
    labels : ndarray, shape (nz, ny, nx), int64
        Zone of every voxel.
    names : mapping
        Names of the labels.
    fields : tuple of (str, DisplacementField)
        Names and measured fields.
    loaded : tuple of str
        Sides at which forces act; the whole surface where there are none.
    covering : Covering or None
        Zones that were left out, which are not part of `inside` and `names`.
    """

    inside: Volume
    labels: IntArray
    names: Mapping[int, str]
    fields: tuple[tuple[str, DisplacementField], ...]
    loaded: tuple[str, ...]
    covering: Covering | None = None

    @property
    def whole(self) -> Volume:
        """Not zero in the object and in what was left out of it."""
        covered = False if self.covering is None else self.covering.voxels
        return self.inside.with_values(((self.inside.values != 0) | covered).astype(np.uint8))

    def without_thin_coverings(
        self, size_mm: float, sought: Collection[str], *, exactly: bool, known: Collection[str] = ()
    ) -> ScannedObject:
        """Return the object without zones that are thinner than cubes of a size (see `naibu.workflows.fields.thin_coverings`)."""
        points = max(int(field.valid.sum()) for _, field in self.fields)
        left, names, covering = without_thin_coverings(
            self.inside, self.labels, self.names, sought, size_mm, exactly=exactly, known=known,
            most=min(int(points / LEAST_POINTS), MOST_REFINED),
        )  # fmt: skip
        return self if covering is None else replace(self, inside=left, names=names, covering=covering)

    def edge_mm(self, cells: int) -> float:
        """Return the edge length, mm, of cubes of which so many fill the object."""
        return float((self.volume_mm3 / cells) ** (1.0 / 3.0))

    @property
    def volume_mm3(self) -> float:
        """Volume of the object."""
        return float(self.inside.values.sum() * np.prod(self.inside.spacing_mm))

    def on_cubes(self, size_mm: float, sought: Collection[str], *, exactly: bool, each_cell: bool) -> ObjectOnCubes:
        """Return the object on cubes of an edge length (see `mesh_that_shows`), moved onto borders of zones unless it is to be mapped."""
        covered = np.zeros(self.inside.shape, dtype=bool) if self.covering is None else self.covering.voxels
        mesh, cell_of_voxel = mesh_on_what_is_left(self.inside, self.labels, self.names, sought, size_mm, covered, exactly=exactly)
        left_out, wrong, lost = self._misplaced(mesh, cell_of_voxel)
        if not each_cell and ends_within(wrong, lost) and self.covering is None:
            mesh, cell_of_voxel = fitted_to_borders(mesh, cell_of_voxel, self.inside, regions_of(self.labels, self.names))
            left_out, wrong, lost = self._misplaced(mesh, cell_of_voxel)
        all_measured = [measured_load_case(mesh, cell_of_voxel, self.inside, field, name, self.loaded) for name, field in self.fields]
        if self.covering is not None:
            below = loaded_below(mesh, self.covering.voxels, self.inside)
            all_measured = [replace(case, loaded=case.loaded | below[:, None]) for case in all_measured]
        cases, outliers = zip(*map(without_contradicted, all_measured), strict=True)
        words = tuple(text for told in outliers for text in told)
        noisy = [self._with_noise(mesh, case) for case in cases]
        words += tuple(text for case, factor in noisy for text in _told_noise(case, factor))
        coarser = [(case, 0.0) if each_cell else with_representation_error(mesh, case) for case, _ in noisy]
        words += tuple(UNRESOLVED.format(case.name, 100 * part) for case, part in coarser if part > 0.0)
        within = region_in(self.inside, self.labels, self.names) if not each_cell and ends_within(wrong, lost) else None
        return ObjectOnCubes(self, mesh, cell_of_voxel, tuple(case for case, _ in coarser), words, left_out, wrong, lost, within)

    def _with_noise(self, mesh: Mesh, case: FieldLoadCase) -> tuple[FieldLoadCase, float]:
        """Return a load case with the noise that neighbours show; where none is stated, with few points for the cubes, in larger ones."""
        points = int(case.field.valid.sum())
        if case.field.covariance is not None or points >= POINTS_THAT_TELL * mesh.n_cells:
            return with_noise_of_neighbours(mesh, case)
        body = replace(self, labels=(self.inside.values != 0).astype(np.int64), names={1: "body"}, covering=None)
        edge = self.edge_mm(max(points // (2 * POINTS_THAT_TELL), 1))
        larger = body.on_cubes(edge, (), exactly=True, each_cell=True)
        found = next(one.field.covariance for one in larger.load_cases if one.name == case.name)
        if found is None:
            return with_noise_of_neighbours(mesh, case)
        alike = np.broadcast_to(found.mean(axis=0), (len(case.field.points), *found.shape[1:]))
        field = case.field
        return replace(case, field=DisplacementField.from_arrays(field.points, field.vectors, covariance=alike, valid=field.valid)), np.nan

    def _misplaced(self, mesh: Mesh, cell_of_voxel: IntArray) -> tuple[float, float, dict[str, float]]:
        """Return which parts of the object cubes leave out and assign to another zone, and which part of every zone is not its cubes'."""
        wrong = misplaced(mesh, cell_of_voxel, self.inside, self.labels, self.names)
        return *wrong, lost_parts(mesh, cell_of_voxel, self.labels, self.names)


@dataclass(frozen=True, slots=True, eq=False)
class ObjectOnCubes:
    """The object as cubes, with its load cases.

    Attributes
    ----------
    scanned : ScannedObject
        What is modelled.
    mesh : Mesh
        Cubes that fill it, one region a label.
    cell_of_voxel : ndarray, shape (nz, ny, nx), int64
        Cell of every voxel, -1 outside.
    load_cases : tuple of FieldLoadCase
        One for each field.
    noise : tuple of str
        What counts as noise of measurements beyond what is stated, in words.
    left_out, wrong : float
        Parts of the object that cubes leave out, and assign to another zone.
    lost : mapping
        Which part of every zone, or of its cubes, is not the other.
    region_at : callable or None
        Region of the mesh at points, where zones end inside of cubes.
    """

    scanned: ScannedObject
    mesh: Mesh
    cell_of_voxel: IntArray
    load_cases: tuple[FieldLoadCase, ...]
    noise: tuple[str, ...]
    left_out: float
    wrong: float
    lost: Mapping[str, float]
    region_at: RegionAt | None

    def identified(
        self,
        stated: KnownZones,
        *,
        law: LawName,
        bounds: Bounds,
        each_cell: bool,
        progress: Progress | None,
        coarser: FieldEstimate | None = None,
    ) -> FieldEstimate:
        """Return the moduli of zones that are not stated (see `identify_field`), from those on coarser cubes where these are known."""
        given = stated.zones(self.mesh, each_cell=each_cell)
        borders = moved_borders(self.mesh, self.scanned.inside, self.scanned.labels)
        begin: tuple[FloatArray, FloatArray] | None = None
        other: FloatArray | None = None
        told: tuple[str, ...] = ()
        if coarser is not None:
            begin, other = _start(coarser), coarser.theta
        elif self.mesh.n_cells > MOST_REFINED:
            begin, told = self._homogeneous(stated, given.count, law, bounds, progress)
        found = identify_field(
            self.mesh, self.load_cases, given, law=law, bounds=bounds, start=begin, region_at=self.region_at, borders=borders,
            other_mesh=other, progress=progress,
        )  # fmt: skip
        return replace(found, steps=(*told, *found.steps))

    def _homogeneous(
        self, stated: KnownZones, count: int, law: LawName, bounds: Bounds, progress: Progress | None
    ) -> tuple[tuple[FloatArray, FloatArray] | None, tuple[str, ...]]:
        """Return lambda and mu (count,), kPa, of a homogeneous body on about `CELLS` cubes to start from, and what it leaves, in words."""
        try:
            few = self.scanned.on_cubes(self.scanned.edge_mm(CELLS), (), exactly=True, each_cell=True)
            zones = stated.zones(few.mesh)
            lame, shear, told = homogeneous_moduli(few.mesh, few.load_cases, zones, law=law, bounds=bounds, progress=progress)
        except (ConvergenceError, InputError):  # of zones that so large cubes do not show
            return None, ()
        return (np.full(count, lame), np.full(count, shear)), (f"on {few.mesh.n_cells} larger cubes, {told}",)


def _told_noise(case: FieldLoadCase, factor: float) -> tuple[str, ...]:
    """Say by how much more than stated the noise is."""
    if np.isnan(factor):
        assert case.field.covariance is not None
        return (UNSTATED.format(case.name, float(np.sqrt(case.field.covariance[0, 0, 0]))),)
    return (UNDERSTATED.format(case.name, factor),) if factor > 1.0 else ()


def smaller_size(volume_mm3: float, mesh: Mesh, most: int) -> float | None:
    """Return the edge length, mm, of at most half as large cubes of which there are about `most`; None where that changes little."""
    size = (volume_mm3 / mesh.n_cells) ** (1.0 / 3.0)
    smaller = max(HALF, (mesh.n_cells / most) ** (1.0 / 3.0)) * size
    return smaller if smaller < WORTHWHILE * size else None


def identified_on_smaller_cubes(
    cubes: ObjectOnCubes,
    found: FieldEstimate,
    stated: KnownZones,
    *,
    most: int,
    law: LawName,
    bounds: Bounds,
    progress: Progress | None,
) -> tuple[ObjectOnCubes, FieldEstimate]:
    """Return the object on smaller cubes and its moduli there, where their size limits what is known and half of it helps; else the given.

    Parameters
    ----------
    cubes, found
        The object and its moduli.
    stated : KnownZones
        What is known.
    most : int
        Cells that are made at most.
    law, bounds, progress
        See `identify_field`.
    """
    scanned = cubes.scanned
    size = smaller_size(scanned.volume_mm3, cubes.mesh, most) if found.limited_by_mesh else None
    if size is None:
        return cubes, found
    smaller = scanned.on_cubes(size, (), exactly=True, each_cell=False)
    if thin := still_thin(cubes, smaller, found.zones.names):
        report_progress(
            progress,
            f"the size of cubes limits what is known of moduli, but {', '.join(thin)} would be one cube thick of {size:.2g} mm as well",
        )
        return cubes, found
    report_progress(progress, f"the size of cubes limits what is known of moduli: again with cubes of {size:.2g} mm")
    try:
        again = smaller.identified(stated, law=law, bounds=bounds, each_cell=False, progress=progress, coarser=found)
    except ConvergenceError as error:
        report_progress(progress, f"smaller cubes lead nowhere, and moduli are those on the larger ones: {error}")
        return cubes, found
    return smaller, again


def still_thin(cubes: ObjectOnCubes, smaller: ObjectOnCubes, sought: Collection[str]) -> tuple[str, ...]:
    """Return zones that are one cube thick on smaller cubes, if none of those that are sought ceased to be.

    Intervals reckon with such zones whatever the size of cubes, and become hardly narrower in several times the time.
    """
    before, after = (() if on.region_at is None else one_cell_thick(on.mesh) for on in (cubes, smaller))
    return () if set(sought) & (set(before) - set(after)) else after


def _start(found: FieldEstimate) -> tuple[FloatArray, FloatArray]:
    """Return lambda and mu (count,), kPa, from which a search on smaller cubes starts."""
    shear = found.young_modulus / (2.0 * (1.0 + found.poisson_ratio))
    poisson = np.minimum(found.poisson_ratio, COMPRESSIBLE)
    return 2.0 * shear * poisson / (1.0 - 2.0 * poisson), shear
