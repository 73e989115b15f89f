"""Run a study of active ischemia from its file: page, numbers, the motion for ParaView, and the layers of a measured record."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from naibu.applications.ischemia.layer_identification import WIDE, LayerEstimate, identify_layers
from naibu.applications.ischemia.layered_response import LayeredModes, SkinMotion, frequency_response, simulate_skin, skin_displacements
from naibu.applications.ischemia.response_times import ResponseTimes, response_times
from naibu.applications.ischemia.skin import SkinLayer, SkinPatch, SurfaceLoad, meshed
from naibu.core.arrays import ComplexArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.io.files.parsing import parsed_toml
from naibu.io.files.reading import file_beside, read_bytes
from naibu.io.study_schemas.ischemia_schema import IschemiaFile, RecordTable, load_ischemia
from naibu.io.tables.number_table import read_numbers
from naibu.io.vtk_files import write_vtkhdf_series
from naibu.mechanics.small_strain.rheology import Rheology, three_element
from naibu.reproduction.chapter5 import figures
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

ISCHEMIA = "ischemia"  # name of the study that naibu brings along
ISCHEMIA_TITLE = "skin that turns pale under an air jet"
_MOST_INDENTATION = 0.2  # of the height, beyond which strains are not small
FRAMES = 60
LONGEST_RECORD_S = 1e7
_SIGMAS = 6.0  # of the noise, that a skin which is pressed does not bulge
DEEPEST = 100.0  # times the thickness: linear models sink deeper than skin, but not so deep
_KEYS = {
    "radius_mm of the load": "[load] radius_mm",
    "indentation_mm has": "[record] file has",
    "indentation_mm lies within its noise, noise_mm": "[record] file lies within its noise, noise_mm",
    "state `known` ones": "state `known` ones in [[layer]]",
}


@dataclass(frozen=True, slots=True, eq=False)
class PreparedIschemia:
    """A study, read and checked.

    Attributes
    ----------
    name, title, source, digest : str
        Of the files, heading, what was asked for, and SHA-256 of the file.
    settings : IschemiaFile
        Contents.
    patch : SkinPatch
        The layers.
    load : SurfaceLoad
        The press.
    record : ndarray, shape (t, 2), optional
        Measured times, s, and indentations, mm.
    """

    name: str
    title: str
    source: str
    digest: str
    settings: IschemiaFile
    patch: SkinPatch
    load: SurfaceLoad
    record: FloatArray | None

    @property
    def materials(self) -> tuple[Rheology, ...]:
        """Materials from the base upwards."""
        return tuple(layer.material for layer in self.patch.layers)


def ischemia_text() -> str:
    """Return the file of the study that comes with naibu, which explains every key."""
    return (files("naibu") / "datasets" / "studies" / "ischemia.toml").read_text(encoding="utf-8")


def describes_ischemia(source: str | os.PathLike[str]) -> bool:
    """Whether a study is one of ischemia: by its name, or a file that has a table ``[skin]``."""
    if os.fspath(source) == ISCHEMIA:
        return True
    try:
        return "skin" in parsed_toml(source, read_bytes(Path(source)))
    except InputError:  # told by whoever reads it
        return False


def prepared_ischemia(source: str | os.PathLike[str]) -> PreparedIschemia:
    """Read and check a study.

    Parameters
    ----------
    source : str or path-like
        ``"ischemia"``, or a file.

    Raises
    ------
    InputError
        No such file; a key or value that cannot be; a record that cannot be read. The message names the file.
    """
    own = os.fspath(source) == ISCHEMIA
    content = ischemia_text().encode() if own else read_bytes(Path(source))
    settings = load_ischemia(f"{ISCHEMIA}.toml" if own else Path(source), content)
    if not settings.layer:
        raise InputError(f"{os.fspath(source)}: [[layer]] is missing; add one or two, from the base upwards")
    skin, load = settings.skin, settings.load
    layers = tuple(
        SkinLayer(
            la.thickness_mm,
            three_element(
                la.young_modulus_kPa,
                la.voigt_viscosity_kPa_s,
                np.inf if la.series_viscosity_kPa_s is None else la.series_viscosity_kPa_s,
                la.poisson_ratio,
            ),
            1e-9 * la.density_kg_m3,
        )
        for la in settings.layer
    )
    named = [la.name for la in settings.layer if la.name]
    if len(set(named)) < len(named):
        raise InputError(f"{os.fspath(source)}: [[layer]] name = {named[0]!r} stands twice; give each layer a name of its own")
    if settings.time.end_s <= load.duration_s:
        raise InputError(
            f"{os.fspath(source)}: [time] end_s = {settings.time.end_s:g} must come after the load, which lasts {load.duration_s:g} s"
        )
    patch = SkinPatch(layers, skin.width_mm, skin.geometry, skin.depth_mm, skin.sides)
    record = None if settings.record is None else _record(Path(source), settings.record, patch.height_mm, load.duration_s)
    name = ISCHEMIA if own else Path(source).stem
    return PreparedIschemia(
        name, settings.title or name, os.fspath(source), hashlib.sha256(content).hexdigest(), settings, patch,
        SurfaceLoad(load.force_mN, load.duration_s, load.radius_mm), record,
    )  # fmt: skip


@no_empty_folders()
def simulate_ischemia(
    source: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False, progress: Progress | None = None
) -> tuple[Path, ...]:
    """Compute a study; write ``NAME.html``, ``NAME.json`` and, for ParaView, ``NAME.vtkhdf``.

    Parameters
    ----------
    source : str or path-like
        ``"ischemia"``, or a file.
    out : path-like
        Folder of the files.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` before each part.

    Raises
    ------
    InputError
        A file that cannot be used, or a folder that cannot be written to or holds results.
    ConvergenceError
        The layers of a record were not found.
    """
    study = prepared_ischemia(source)
    folder = output_folder(out, [f"{study.name}.{ending}" for ending in ("html", "json", "vtkhdf")], overwrite=overwrite)
    parts = ("modes", "motion", "frequency response", "identification")

    def tell(part: int) -> None:
        report_progress(progress, f"simulate {study.name}: {parts[part]}", done=part, total=len(parts))

    tell(0)
    try:
        modes = LayeredModes.of(
            meshed(study.patch, study.load.radius_mm, across=study.settings.mesh.across, upwards=study.settings.mesh.upwards)
        )
        tell(1)
        estimate = None
        materials = study.materials
        if study.record is not None and study.settings.record is not None:
            tell(3)
            known = [(i, name) for i, layer in enumerate(study.settings.layer) for name in layer.known]
            estimate = identify_layers(
                modes, study.load, study.record[:, 0], study.record[:, 1], study.settings.record.noise_mm, known=known
            )
            materials = estimate.materials
    except InputError as error:
        raise InputError(f"{study.source}: {_in_keys(str(error))}") from error
    duration, end = study.load.duration_s, study.settings.time.end_s
    after = duration + np.concatenate([[0.0], np.geomspace(1e-3 * (end - duration), end - duration, 400)])
    motion = simulate_skin(modes, materials, study.load, np.unique(np.concatenate([np.linspace(0.0, duration, 400), after])))
    if motion.indentation.max() > DEEPEST * study.patch.height_mm:
        raise InputError(
            f"{study.source}: [load] force_mN is {study.load.force_mn:g}: skin of {study.patch.height_mm:g} mm would sink by "
            f"{motion.indentation.max():.3g} mm; check the force and the moduli, and their units"
        )
    tell(2)
    lowest, highest = study.settings.frequency.range_Hz
    frequencies = np.geomspace(lowest, highest, study.settings.frequency.count)
    response = frequency_response(modes.meshed, materials, frequencies)
    sections = [_motion_section(study, motion), _frequency_section(frequencies, response)]
    if estimate is not None:
        sections.insert(0, _layers_section(study, estimate))
    settings: dict[str, Cell] = {"study": study.source, "sha256": study.digest, "nodes": len(modes.meshed.grid.points)}
    page, numbers = write_chapter(Chapter(study.name, study.title, tuple(sections), settings, _cards(study, motion, estimate)), folder)
    series = folder / f"{study.name}.vtkhdf"
    times = np.linspace(0.0, min(end, 3.0 * duration), FRAMES)
    moved = skin_displacements(modes, materials, study.load, times)
    write_vtkhdf_series(series, _solid(modes), times, {"displacement_mm": _three_components(moved)})
    return page, numbers, series


def _record(source: Path, table: RecordTable, height_mm: float, duration_s: float) -> FloatArray:
    """Read a measured indentation (t, 2): times, s, and indentation, mm, which lies beside the study."""
    file = file_beside(source, table.file)
    record = read_numbers(file, ("time, s", "indentation, mm"))
    times, indentation = record.T
    if times.min() < 0.0 or times.max() > LONGEST_RECORD_S or np.ptp(times) == 0.0:
        raise InputError(
            f"{file}: has times from {times.min():g} to {times.max():g} s; give instants after the load began, at 0, in seconds"
        )
    deepest = indentation[np.abs(indentation).argmax()]
    if abs(deepest) > DEEPEST * height_mm:
        raise InputError(f"{file}: has an indentation of {deepest:g} mm in skin of {height_mm:g} mm; is it in mm?")
    if times.min() >= duration_s:
        raise InputError(
            f"{file}: begins at {times.min():g} s, when the load of {duration_s:g} s is over; give instants under the load, too, in seconds"
        )
    if deepest < -_SIGMAS * table.noise_mm:
        raise InputError(f"{file}: has an indentation of {deepest:g} mm, outwards; positive is into the skin")
    if np.ptp(indentation) <= table.noise_mm:
        raise InputError(
            f"{file}: its indentation changes by {np.ptp(indentation):g} mm, not more than [record] noise_mm = {table.noise_mm:g}; "
            "nothing can be identified from it"
        )
    return record


def _in_keys(message: str) -> str:
    """Return a message about arguments as one about the keys of the file."""
    for name, key in _KEYS.items():
        message = message.replace(name, key)
    return message


def _cards(study: PreparedIschemia, motion: SkinMotion, estimate: LayerEstimate | None) -> tuple[Card, ...]:
    area = motion.pale_area(study.settings.pale.threshold_kPa)
    white = motion.times[area > 0.0]
    deep = motion.indentation.max() > _MOST_INDENTATION * study.patch.height_mm
    cards = [
        Card(
            "Largest indentation",
            f"{motion.indentation.max():.3g} mm",
            f"{study.load.force_mn:g} mN for {study.load.duration_s:g} s" + ("; the linear model does not hold so far" if deep else ""),
        ),
        Card("Largest pale area", f"{area.max():.3g} mm²", f"pressure above {study.settings.pale.threshold_kPa:g} kPa"),
    ]
    if len(white) and white[-1] > study.load.duration_s:
        cards.append(Card("Pale after the release", f"{white[-1] - study.load.duration_s:.2g} s", "the blood that returns is not modelled"))
    if estimate is not None:
        cards.append(
            Card("Layers explain the record", "yes" if estimate.explained else "no", f"residuals {estimate.residual_mm:.2g} mm RMS")
        )
    return tuple(cards)


def _motion_section(study: PreparedIschemia, motion: SkinMotion) -> Section:
    threshold = study.settings.pale.threshold_kPa
    area = motion.pale_area(threshold)
    measured = {"indentation, mm": motion.indentation, "pale area, mm²": area}
    rows = tuple((name, *_row(response_times(motion.times, values, study.load.duration_s))) for name, values in measured.items())
    columns = (
        "quantity",
        "rise 10-90 %, s",
        "fall 10-90 %, s",
        "rise, time constant, s",
        "fall, time constant, s",
        "at release",
        "at the end",
    )
    table = Table(
        "Response", columns, rows, caption=f"{study.load.force_mn:g} mN for {study.load.duration_s:g} s.",
        note=f"The area is pale where the pressure in the tissue exceeds {threshold:g} kPa; the blood that returns is not "
        f"modelled. A dash: the quantity does not change, or more slowly than the record is long; 0: at once, between two instants.",
    )  # fmt: skip
    text: tuple[str, ...] = ()
    if motion.indentation.max() > _MOST_INDENTATION * study.patch.height_mm:
        text = (
            f"The indentation of {motion.indentation.max():.3g} mm is more than a fifth of the height of the skin, "
            f"{study.patch.height_mm:g} mm: the "
            "strains are not small, and the linear model does not hold in amplitude.",
        )
    draw = figures.response_curves(motion, area, study.load.duration_s, study.record)
    return Section("Motion and pale area", text, (table,), (Figure("Response", "Indentation and pale area over time.", draw, (10.0, 3.8)),))


def _row(found: ResponseTimes) -> tuple[Cell, ...]:
    return found.rise_s, found.fall_s, found.rise_constant_s, found.fall_constant_s, found.peak, found.residual


def _frequency_section(frequencies: FloatArray, response: ComplexArray) -> Section:
    rows = tuple((float(f), float(abs(v)), float(np.degrees(np.angle(v)))) for f, v in zip(frequencies, response, strict=True))
    table = Table("Frequency response", ("frequency, Hz", "amplitude, mm/mN", "phase, degrees"), rows[:: max(1, len(rows) // 8)])
    figure = Figure("Bode", "Indentation for an oscillating force.", figures.bode_diagram(frequencies, {"skin": response}, {}), (8.0, 5.0))
    return Section("Frequency response", (), (table,), (figure,))


def _layers_section(study: PreparedIschemia, estimate: LayerEstimate) -> Section:
    units = {"young_modulus": "kPa", "voigt_viscosity": "kPa s", "series_viscosity": "kPa s"}
    rows = tuple(
        (
            study.settings.layer[p.layer].name or f"layer {p.layer + 1}",
            f"{p.name}, {units[p.name]}",
            p.value,
            p.low,
            p.high,
            "yes" if p.determined else "no",
        )
        for p in estimate.parameters
    )
    verdict = (
        f"The layers explain the record: residuals of {estimate.residual_mm:.3g} mm RMS."
        if estimate.explained
        else f"Not explained: residuals of {estimate.residual_mm:.3g} mm RMS exceed the stated noise, or form a pattern in "
        f"time. Do not use the parameters."
    )
    table = Table(
        "Identified layers", ("layer", "parameter", "estimate", "95 % from", "to", "determined"), rows,
        caption="From the measured indentation.",
        note=f"Not determined: the interval spans more than a factor of {WIDE:g}, or ends where the search does, at a thousandth or a "
        "thousand times the first guess.",
    )  # fmt: skip
    return Section("Identified layers", (verdict,), (table,))


def _solid(modes: LayeredModes) -> Mesh:
    """Return the grid as triangles, or as hexahedra in three dimensions."""
    grid = modes.meshed.grid
    c = grid.cells
    regions, names = modes.meshed.layer, tuple(f"layer {i + 1}" for i in range(len(modes.meshed.patch.layers)))
    if grid.kinematics == "three_dimensional":
        return Mesh(grid.points, c[:, [0, 4, 6, 2, 1, 5, 7, 3]], "hexahedron", regions=regions, region_names=names)
    return Mesh(
        grid.points, np.concatenate([c[:, [0, 2, 3]], c[:, [0, 3, 1]]]), "triangle", regions=np.tile(regions, 2), region_names=names
    )


def _three_components(moved: FloatArray) -> FloatArray:
    return np.concatenate([moved, np.zeros((*moved.shape[:2], 3 - moved.shape[2]))], axis=2)
