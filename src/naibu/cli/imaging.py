"""Verbs that take images: ``sense``, ``compare-methods``, ``track``, ``track-sequence``."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from naibu.cli.shell.console import WARNING, print_table, progress_display, say
from naibu.cli.shell.described import Flag, ObjectOptions, Out, Overwrite, PairOptions, Whole, WorkerOptions, require_left_out
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import MARKERS, SCANS, verb
from naibu.core.errors import InputError

if TYPE_CHECKING:
    from naibu.workflows.measurement.sense import SenseRun
    from naibu.workflows.measurement.sense_blocks import MemoryPlan

# other parts are imported where they are used: --help answers at once
Method = Literal["default", "features", "sad-blocks", "ssd-blocks", "ncc-blocks", "horn-schunck", "lucas-kanade", "hybrid", "rigid"]
Polarity = Literal["auto", "bright", "dark"]
Spacing = tuple[float, float, float]
Unit = Literal["mm", "cm", "m", "um", "inch"]


@verb(
    SCANS,
    "sense free.mha pressed.mha -o moved --open",
    "sense free.nii.gz pressed.nii.gz -m object.nii.gz   # the object is known",
    "sense dicom_before dicom_after --json > summary.json",
    "sense before.zarr after.zarr --memory-gb 6 --workers 2 -o moved   # larger than memory: block by block, --resume goes on",
)
def sense(
    reference: Path,
    deformed: Path,
    *,
    method: Method = "default",
    pair: PairOptions | None = None,
    out: Out = Path("naibu-sense"),
    multiscale: Flag = False,
    memory_gb: float | None = None,
    resume: Flag = False,
    where: WorkerOptions | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the displacement inside an object between two scans by digital volume correlation (DVC), with its uncertainty.

    Parameters
    ----------
    reference
        Scan of the reference configuration: MetaImage, NIfTI, NRRD, TIFF stack, HDF5, Zarr, or a folder with a DICOM series.
    deformed
        Scan of the deformed configuration; on another grid it is resampled to that of the reference, by the positions that both state.
    method
        Digital volume correlation regularised by mechanics (default), or a classic method.
    out
        Folder for displacement.mha, standard_deviation.mha, displacement.vtu, field.h5, mask.mha (the object), initial.csv and pressed.csv
        (positions as markers), sense.json and report.html.
    multiscale
        Also write scans, displacement and strain at several resolutions, as OME-Zarr for napari and neuroglancer (needs
        naibu[cluster]); block by block without the strain.
    memory_gb
        Memory that may be taken, GB; by default half of what is free. Scans in Zarr, OME-Zarr, HDF5 or TIFF stacks that would take more are
        measured block by block, on the workers, by the default method; all voxels are then written as Zarr, and the other files show coarse
        voxels.
    resume
        Go on with an interrupted measurement block by block.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    options, places = pair or PairOptions(), where or WorkerOptions()
    if method != "default":
        require_left_out("goes with the method default", memory_gb=memory_gb is not None)
    plan = _memory_plan(reference, options, places, memory_gb, resume) if method == "default" else None
    if plan is None:
        alone = {"resume": resume, "workers": places.workers != 1, "cluster": places.cluster is not None}
        require_left_out("goes with scans that are measured block by block", **alone)
        run, stores = _sense_in_memory((reference, deformed), method, options, out, multiscale, overwrite)
    else:
        run, stores = _sense_by_blocks((reference, deformed), plan, options, places, out, multiscale, overwrite, resume), ()
    print_table(f"{reference.name} -> {deformed.name}, {run.measured.method}", ("quantity", "value"), run.rows())
    for warning in run.measured.warnings:
        say(warning.replace("`mask`", "--mask"), WARNING)
    files = (*run.files, *stores)
    wrote(*files)
    say(f"{run.seconds:.1f} s. Page: {files[0]}   fields: {', '.join(str(p.name) for p in files[1:])}")
    if min(run.pair.reference.shape) > 1:
        say(
            f"Stiffness: naibu identify {quote(str(out / 'field.h5'))} --zones LABELS -k 'label 1=10 kPa', where LABELS is a volume of "
            "labels, one of them known",
            "dim",
        )


def _memory_plan(reference: Path, options: PairOptions, places: WorkerOptions, memory_gb: float | None, resume: bool) -> MemoryPlan | None:
    """Return the plan of a measurement block by block, or None where it is measured in memory."""
    from naibu.workflows.measurement.sense_blocks import MemoryPlan, stored_shape

    shape = stored_shape(reference, options.spacing_mm)
    if shape is None:
        require_left_out("goes with scans in Zarr, OME-Zarr, HDF5 or TIFF stacks; others are read whole", memory_gb=memory_gb is not None)
        return None
    plan = MemoryPlan.of(shape, memory_gb, max(1, places.workers))
    return plan if plan.by_blocks or resume else None


def _sense_in_memory(
    scans: tuple[Path, Path], method: Method, options: PairOptions, out: Path, multiscale: bool, overwrite: bool
) -> tuple[SenseRun, tuple[Path, ...]]:
    from naibu.workflows.measurement.multiscale_results import folder_for_multiscale, write_multiscale
    from naibu.workflows.measurement.sense import read_pair, sense_pair

    with progress_display() as progress:
        pair = read_pair(*scans, **options.arguments)
        folder = folder_for_multiscale(out, overwrite=overwrite) if multiscale else None
        run = sense_pair(pair, method=method, out=out, overwrite=overwrite, progress=progress)
        return run, () if folder is None else write_multiscale(pair, run, folder)


def _sense_by_blocks(
    scans: tuple[Path, Path], plan: MemoryPlan, options: PairOptions, places: WorkerOptions, out: Path, multiscale: bool, overwrite: bool,
    resume: bool,
) -> SenseRun:  # fmt: skip
    from naibu.workflows.measurement.sense_blocks import sense_blocks

    require_left_out("needs the scans in memory, and these are measured block by block", truth=options.truth is not None)
    say(plan.told())
    with progress_display() as progress:
        return sense_blocks(
            *scans, mask=options.mask, deformed_mask=options.deformed_mask, check_points=options.check_points,
            spacing_mm=options.spacing_mm, out=out, plan=plan, multiscale=multiscale, overwrite=overwrite, resume=resume,
            workers=places.workers, cluster=places.cluster, progress=progress,
        )  # fmt: skip


@verb(
    SCANS,
    "compare-methods free.mha pressed.mha",
    "compare-methods free.mha pressed.mha --method default --method ncc-blocks --truth true.mha",
)
def compare_methods(
    reference: Path,
    deformed: Path,
    *,
    method: list[Method] | None = None,
    pair: PairOptions | None = None,
    out: Out = Path("naibu-methods"),
    overwrite: Overwrite = False,
) -> None:
    """Measure the displacement between two scans by every method, and compare errors, times and images.

    Parameters
    ----------
    reference
        Scan of the reference configuration.
    deformed
        Scan of the deformed configuration; on another grid it is resampled to that of the reference, by the positions that both state.
    method
        Use only this method. May be repeated.
    out
        Folder for methods.html and methods.json.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.imaging.measure_displacement import METHODS
    from naibu.workflows.measurement.compare_methods import compare_methods as compared
    from naibu.workflows.measurement.sense import read_pair

    with progress_display() as progress:
        scans = read_pair(reference, deformed, **(pair or PairOptions()).arguments)
        result = compared(scans, method or METHODS, out=out, overwrite=overwrite, progress=progress, told=say)
    wrote(result.page, result.numbers)
    print_table(f"{reference.name} -> {deformed.name}", result.columns, result.rows)
    say(f"Page: {result.page}   numbers: {result.numbers}")


@verb(
    MARKERS,
    "track free.mha pressed.mha --diameter-mm 2.5 --size-mm 60 60 60 -l 'gel=0..60' -o my_gel",
    "track free.mha pressed.mha --diameter-mm 2.8 --thickness-mm 0.3   # washers; only the tables",
    "track free.csv pressed.csv --unit um -o moved   # particles that another program has found",
)
def track(
    scans: list[Path],
    *,
    diameter_mm: float | None = None,
    thickness_mm: float | None = None,
    polarity: Polarity = "auto",
    count: Whole | None = None,
    unit: Unit | None = None,
    variable: str | None = None,
    mask: Annotated[Path | None, Parameter(name=("--mask", "-m"))] = None,
    spacing_mm: Spacing | None = None,
    size_mm: tuple[float, float, float] | None = None,
    described: ObjectOptions | None = None,
    title: str = "Markers followed through scans",
    out: Out = Path("naibu-markers"),
    overwrite: Overwrite = False,
) -> None:
    """Match markers between states: of scans, in which they are detected, or two clouds of particles.

    Scans give an experiment folder for 'naibu identify'. Two files of positions (.csv, .tsv, .txt, .xlsx, .mat, .npy, .npz) give the
    displacement field with its standard deviations, which 'naibu identify' takes, and the strain.

    Parameters
    ----------
    scans
        Scans of the states, the unloaded one first, then in the order in which they were reached; or two files of positions.
    diameter_mm
        With scans: diameter of the markers.
    thickness_mm
        Thickness of washers or discs; omit it for beads.
    polarity
        Whether markers are brighter or darker than their surroundings; by default whichever has more contrast.
    count
        Number of markers, if known.
    unit
        With positions: their unit; by default that in the names of columns, else mm.
    variable
        With positions in .mat or .npz: name of the array.
    mask
        Volume on the grid of the scans, nonzero where markers may lie.
    spacing_mm
        Voxel spacing along x, y, z, mm, for files that do not state it, and for positions in voxels.
    size_mm
        Dimensions of the object along x, y and z, z being its height; without them only the tables of markers are written.
    title
        Title of the experiment.
    out
        Folder to make: the experiment, with tracking.html and tracking.json beside its tables; with positions field.h5, links.csv and
        mask.mha.
    overwrite
        Use the folder even if it is not empty, and replace files of the same names.
    """
    from naibu.workflows.measurement import track as tracking
    from naibu.workflows.measurement.track_clouds import is_point_file

    options = described or ObjectOptions()
    if any(is_point_file(scan) for scan in scans):
        require_left_out(
            "goes with scans, and these are positions", diameter_mm=diameter_mm is not None, thickness_mm=thickness_mm is not None,
            polarity=polarity != "auto", count=count is not None, mask=mask is not None, size_mm=size_mm is not None,
            layer=bool(options.layer), stated_mm=bool(options.stated_mm), shape=options.shape != "box", loading=options.loading != "plate",
            bar_width_mm=options.bar_width_mm is not None, vertical=options.vertical is not None,
        )  # fmt: skip
        _track_clouds(scans, unit=unit, spacing_mm=spacing_mm, variable=variable, out=out, overwrite=overwrite)
        return
    require_left_out("goes with positions, and these are scans", unit=unit is not None, variable=variable is not None)
    if diameter_mm is None:
        raise InputError("diameter_mm is needed, the diameter of the markers in the scans")
    description = None
    if size_mm is not None:
        description = tracking.ObjectDescription(**options.described(size_mm), title=title)
    elif options.layer or options.stated_mm or options.vertical:
        raise InputError("--layer, --stated-mm and --vertical describe an object: give its dimensions too, --size-mm X Y Z")
    with progress_display() as progress:
        run = tracking.track(
            scans, out=out, diameter_mm=diameter_mm, thickness_mm=thickness_mm, polarity=polarity, count=count, mask=mask,
            spacing_mm=spacing_mm, description=description, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    wrote(run.page, out)
    print_table("Markers", run.columns, run.rows)
    say(f"Wrote {out}. Page: {run.page}")
    for note in run.notes:
        say(f"Note: {note}")
    if description is None:
        say("Give --size-mm X Y Z, --layer and --stated-mm to make an experiment folder that 'naibu identify' takes.", "dim")
    else:
        before = "Run" if description.layers else "Describe layers and materials in its meta.toml, then run"
        say(f"{before}: naibu identify {quote(str(out))}")


def _track_clouds(
    clouds: list[Path], *, unit: Unit | None, spacing_mm: Spacing | None, variable: str | None, out: Path, overwrite: bool
) -> None:
    from naibu.workflows.measurement.track_clouds import is_point_file, track_clouds

    if len(clouds) != 2 or not all(map(is_point_file, clouds)):
        raise InputError(f"scans must be two files of positions, or all scans, not {', '.join(path.name for path in clouds)}")
    with progress_display() as progress:
        run = track_clouds(
            *clouds, out=out, unit=unit, spacing_mm=spacing_mm, variable=variable, overwrite=overwrite, progress=progress
        )  # fmt: skip
    wrote(run.page, *run.files)
    print_table(f"{clouds[0].name} -> {clouds[1].name}", ("quantity", "value"), run.rows)
    say(f"Page: {run.page}   field: {out / 'field.h5'}   links: {out / 'links.csv'}")
    identify = f"naibu identify {quote(str(out / 'field.h5'))}"
    say(f"With a volume of zones: {identify} --zones labels.nii.gz --known 'gel=12 kPa'", "dim")
    say(f"Without, moduli as multiples: {identify} --mask {quote(str(out / 'mask.mha'))} --map", "dim")


@verb(MARKERS, "track-sequence ultrasound.tif --pixel-mm 0.1 --diameter-mm 1 --frame-rate-hz 30")
def track_sequence(
    frames: Path,
    *,
    pixel_mm: float,
    diameter_mm: float,
    frame_rate_hz: float = 1.0,
    region_mm: tuple[float, float, float, float] | None = None,
    count: Whole | None = None,
    polarity: Literal["bright", "dark"] = "bright",
    out: Out = Path("naibu-tracks"),
    overwrite: Overwrite = False,
) -> None:
    """Track markers through a sequence of images, such as B-mode ultrasound.

    Parameters
    ----------
    frames
        Stack of images (TIFF, MetaImage, NRRD, ...), with time along its third axis.
    pixel_mm
        Pixel size.
    diameter_mm
        Apparent diameter of the markers.
    frame_rate_hz
        Frames per second.
    region_mm
        Smallest x, largest x, smallest y and largest y of the region in which markers may lie.
    count
        Number of markers, if known.
    polarity
        Whether markers are brighter or darker than their surroundings.
    out
        Folder for tracks.csv, tracks.html and tracks.json.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.workflows.measurement.track_sequence import track_sequence_file

    with progress_display() as progress:
        run = track_sequence_file(
            frames, out=out, pixel_mm=pixel_mm, diameter_mm=diameter_mm, frame_rate_hz=frame_rate_hz, region_mm=region_mm, count=count,
            polarity=polarity, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    wrote(run.page, run.table)
    print_table("Markers", run.columns, run.rows)
    say(f"Table: {run.table}   page: {run.page}")
