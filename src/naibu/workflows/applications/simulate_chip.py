"""Run a sensing chip from its file: page, numbers, and the deformed chip with its stress for ParaView."""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from naibu.applications.sensing_chip.analysis import ChipAnalysis, analysed_chip
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import ChipDesign
from naibu.applications.sensing_chip.design_study import DesignStudy, study_designs
from naibu.applications.sensing_chip.electronics import Readout
from naibu.applications.sensing_chip.fillets import FilletedEnd, filleted_end, require_bearable_at_fillets, require_fillet
from naibu.applications.sensing_chip.finite_elements import LOADS
from naibu.applications.sensing_chip.load_envelope import load_limits, require_bearable, surface_stress
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.io.files.parsing import parsed_toml
from naibu.io.files.reading import read_bytes
from naibu.io.study_schemas.sensing_chip_schema import ChipFile, LoadTable, StudyTable, load_chip
from naibu.io.vtk_files import write_vtu
from naibu.mechanics.small_strain.cubic_elasticity import miller_indices
from naibu.reproduction.chapter6 import chip_figures
from naibu.reproduction.chapter6.chip_sections import (
    crosstalk_tables,
    model_table,
    placement_figure,
    readout_section,
    sensitivity_table,
    study_section,
)
from naibu.reproduction.chapter6.fillet_section import fillet_figure, fillet_table
from naibu.viewer.cards import Card
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.chapters.chapter_page import write_chapter
from naibu.viewer.tables import Cell, Table
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

CHIP = "chip"  # name of the study that naibu brings along
CHIP_TITLE = "silicon chip that senses a force and two moments"
_MM = 1e-3  # um in mm
# arguments of a design by the keys of the file
_KEYS = {
    **{f"{name}_mm": f"[chip] {name}_um" for name in ("beam_length", "beam_width", "beam_thickness", "block_height", "pillar_width")},
    "fillet_mm": "[chip] fillet_um",
    "block_half_width_mm": "half of [chip] block_width_um",
    "force_resistor_mm": "[resistors] force_from_end_um",
    "moment_resistor_mm": "[resistors] moment_from_end_um",
    "lengths_mm": "[study] beam_length_um",
    "widths_mm": "[study] beam_width_um",
    "thicknesses_mm": "[study] beam_thickness_um",
}


@dataclass(frozen=True, slots=True, eq=False)
class PreparedChip:
    """A chip's file, read and checked.

    Attributes
    ----------
    name, title, source : str
        Of the files, heading, and what was asked for.
    digest : str
        SHA-256 of the file.
    settings : ChipFile
        Contents.
    design : ChipDesign
        The chip.
    readout : Readout
        Its electronics.
    study : DesignStudy, optional
        Other designs, where the file asks for them.
    """

    name: str
    title: str
    source: str
    digest: str
    settings: ChipFile
    design: ChipDesign
    readout: Readout
    study: DesignStudy | None


def chip_text() -> str:
    """Return the file of the study that comes with naibu, which explains every key."""
    return (files("naibu") / "datasets" / "studies" / "chip.toml").read_text(encoding="utf-8")


def describes_chip(source: str | os.PathLike[str]) -> bool:
    """Whether a study is a chip: by its name, or a file that has a table ``[chip]``."""
    if os.fspath(source) == CHIP:
        return True
    try:
        return "chip" in parsed_toml(source, read_bytes(Path(source)))
    except InputError:  # told by whoever reads it
        return False


def prepared_chip(source: str | os.PathLike[str]) -> PreparedChip:
    """Read and check a chip.

    Parameters
    ----------
    source : str or path-like
        ``"chip"``, or a file.

    Raises
    ------
    InputError
        No such file; a key or value that cannot be; dimensions that do not fit; an unknown crystal direction; a load beyond the envelope.
        The message names the file.
    """
    own = os.fspath(source) == CHIP
    content = chip_text().encode() if own else read_bytes(Path(source))
    settings = load_chip(f"{CHIP}.toml" if own else Path(source), content)
    try:
        design = _design(settings)
        readout = _readout(settings)
        if settings.chip.fillet_um is not None:
            require_fillet(design, _MM * settings.chip.fillet_um)
        for load in settings.load:
            require_bearable(design, load.force_z_mN, load.moment_x_Num, load.moment_y_Num)
        study = None if settings.study is None else _study(design, settings.study)
    except InputError as error:
        raise InputError(f"{os.fspath(source)}: {_in_keys(str(error))}") from error
    name = CHIP if own else Path(source).stem
    return PreparedChip(
        name, settings.title or name, os.fspath(source), hashlib.sha256(content).hexdigest(), settings, design, readout, study
    )


def _in_keys(message: str) -> str:
    """Return a message about arguments of `ChipDesign` as one about the keys of the file."""
    told = message
    for name, key in _KEYS.items():
        told = re.sub(rf"\b{name}\b", key, told)
    return told if told == message else f"{told} (this message is in mm)"


def _direction(key: str, text: str) -> tuple[int, int, int]:
    try:
        return miller_indices(text)
    except InputError as error:
        raise InputError(f"[silicon] {key}: {error}") from error


def _design(settings: ChipFile) -> ChipDesign:
    chip, silicon, resistors = settings.chip, settings.silicon, settings.resistors
    return ChipDesign(
        beam_length_mm=_MM * chip.beam_length_um,
        beam_width_mm=_MM * chip.beam_width_um,
        beam_thickness_mm=_MM * chip.beam_thickness_um,
        block_half_width_mm=0.5 * _MM * chip.block_width_um,
        block_height_mm=_MM * chip.block_height_um,
        frame_width_mm=_MM * chip.frame_width_um,
        pillar_width_mm=_MM * chip.pillar_width_um,
        pillar_mass_kg=1e-6 * chip.pillar_mass_mg,
        force_resistor_mm=_MM * resistors.force_from_end_um,
        moment_resistor_mm=_MM * resistors.moment_from_end_um,
        resistor_length_mm=_MM * resistors.length_um,
        supply_voltage=settings.readout.supply_V,
        strength_kpa=1e3 * silicon.strength_MPa,
        doping_per_cm3=silicon.doping_per_cm3,
        beam_direction=_direction("beam_direction", silicon.beam_direction),
        wafer_normal=_direction("wafer_normal", silicon.wafer_normal),
    )


def _readout(settings: ChipFile) -> Readout:
    r = settings.readout
    gains, widths = (float(g) for g in r.gains), (float(w) for w in r.noise_width_V)
    return Readout(
        (next(gains), next(gains), next(gains)), (next(widths), next(widths), next(widths)), r.adc_bits, r.adc_limit_V, r.sample_rate_Hz
    )


def _study(design: ChipDesign, table: StudyTable) -> DesignStudy:
    spans = (table.beam_length_um, table.beam_width_um, table.beam_thickness_um)
    return study_designs(design, *(_MM * np.geomspace(low, high, table.steps) for low, high in spans))


@no_empty_folders()
def simulate_chip(
    source: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False, progress: Progress | None = None
) -> tuple[Path, ...]:
    """Compute a chip; write ``NAME.html``, ``NAME.json`` and, for ParaView, ``NAME.vtu``.

    Parameters
    ----------
    source : str or path-like
        ``"chip"``, or a file.
    out : path-like
        Folder of the files.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` before each solution.

    Raises
    ------
    InputError
        A file that cannot be used, a load beyond the envelope, or a folder that cannot be written to or holds results.
    """
    chip = prepared_chip(source)
    folder = output_folder(out, [f"{chip.name}.{ending}" for ending in ("html", "json", "vtu")], overwrite=overwrite)
    mesh, shift = chip.settings.mesh, chip.settings.resistors.mask_shift_um
    resolution = ChipResolution(mesh.along, mesh.across, mesh.through, mesh.below, mesh.frame)
    analysis = analysed_chip(chip.design, resolution, shift_mm=(_MM * shift[0], _MM * shift[1]), progress=progress)
    end = _filleted(chip, analysis)
    settings: dict[str, Cell] = {"study": chip.source, "sha256": chip.digest, "nodes": analysis.whole.chip.mesh.n_points}
    chapter = Chapter(chip.name, chip.title, _sections(chip, analysis, end), settings, _cards(chip, analysis, end))
    page, numbers = write_chapter(chapter, folder)
    solution = folder / f"{chip.name}.vtu"
    values: dict[str, FloatArray] = {}
    for name, load in _shown_loads(chip).items():
        displacement, stress = analysis.whole.of(load)
        values |= {f"displacement_mm {name}": displacement, f"stress_kPa {name}": stress}
    write_vtu(solution, analysis.whole.chip.mesh, values)
    return page, numbers, solution


def _filleted(chip: PreparedChip, analysis: ChipAnalysis) -> FilletedEnd | None:
    """Solve the rounded corners, where the file has any, and refuse loads that these do not bear."""
    radius = chip.settings.chip.fillet_um
    if radius is None:
        return None
    end = filleted_end(chip.design, _MM * radius)
    for k, load in enumerate(chip.settings.load):
        try:
            require_bearable_at_fillets(end, analysis.beams, _six(load))
        except InputError as error:
            raise InputError(f"{chip.source}: [[load]] {_named(load, k)}: {error}") from error
    return end


def _shown_loads(chip: PreparedChip) -> dict[str, FloatArray]:
    """Return the loads (6,) that the file for ParaView holds: those of the file, or units of each."""
    if not chip.settings.load:
        return {name: np.eye(6)[k] for k, name in enumerate(LOADS[2:5], start=2)}
    return {_named(load, k): _six(load) for k, load in enumerate(chip.settings.load)}


def _named(load: LoadTable, k: int) -> str:
    return load.name or f"load {k + 1}"


def _six(load: LoadTable) -> FloatArray:
    return np.array([0.0, 0.0, load.force_z_mN, load.moment_x_Num, load.moment_y_Num, 0.0])


def _cards(chip: PreparedChip, analysis: ChipAnalysis, end: FilletedEnd | None) -> tuple[Card, ...]:
    found = analysis.sensitivities
    limits = load_limits(chip.design) if end is None else end.load_limits(analysis.beams)
    where = "nominal stress; sharp corners bear less" if end is None else f"with fillets of {1e3 * end.fillet_mm:g} µm"
    measurable, noise = chip.readout.measurable(found), chip.readout.load_noise(found)
    return (
        Card("Sensitivity to F_z", f"{found[0]:.3g} mV/mN", "finite elements of the whole chip"),
        Card("Sensitivity to M_x, M_y", f"{found[1]:.3g}, {found[2]:.3g} mV/(N µm)", "finite elements of the whole chip"),
        Card("Largest force, moment borne", f"{1e-3 * limits[0]:.3g} N, {limits[1]:.3g} N µm", f"each alone, {where}"),
        Card(
            "Force that is read",
            f"{noise[0]:.2g} to {measurable[0]:.3g} mN",
            "from the standard deviation of the noise to the converter's end",
        ),
        Card("Lowest resonance", f"{1e-3 * float(np.min(analysis.whole.resonances_hz)):.3g} kHz", "upper bound of finite elements"),
    )


def _sections(chip: PreparedChip, analysis: ChipAnalysis, end: FilletedEnd | None) -> tuple[Section, ...]:
    design, limits = chip.design, load_limits(chip.design)
    text = (
        f"Each load alone is borne up to {1e-3 * limits[0]:.3g} N, or {limits[1]:.4g} N µm. The stresses are nominal; the strength of "
        f"{1e-6 * design.strength_kpa:g} GPa is that of the file.",
    )
    points = [(abs(v.force_z_mN), float(np.hypot(v.moment_x_Num, v.moment_y_Num))) for v in chip.settings.load]
    safe = Figure(
        "Safe loads", "Largest force and moment together.", lambda canvas: chip_figures.envelope(canvas, design, points), (7.0, 4.2)
    )
    corners: tuple[tuple[Table, ...], tuple[Figure, ...]] = ((), ())
    if end is not None:
        corners = (fillet_table(analysis, (end,)),), (fillet_figure(analysis, (end,), points),)
    along = Figure(
        "Stress", "Along beam A; shaded: resistors.", lambda canvas: chip_figures.stress_along_beam(canvas, analysis), (10.0, 3.8)
    )
    full_scale = (limits[0], limits[0], limits[0], limits[1], limits[1], limits[1])
    rounded = tuple(float(f"{v:.3g}") for v in full_scale)
    loads = _loads_tables(chip, analysis, end) if chip.settings.load else ()
    sections = [
        Section("Sensitivity and stiffness", (), (sensitivity_table(analysis), model_table(analysis)), (along, placement_figure(analysis))),
        Section("Crosstalk", (), crosstalk_tables(analysis, rounded)),
        Section("Loads", text, (*loads, *corners[0]), (safe, *corners[1])),
        readout_section(analysis, chip.readout, chip.settings.readout.filter_share, seed=0),
    ]
    if chip.study is not None:
        sections.append(study_section(design, chip.study))
    return tuple(sections)


def _loads_tables(chip: PreparedChip, analysis: ChipAnalysis, end: FilletedEnd | None) -> tuple[Table, ...]:
    rows: list[tuple[Cell, ...]] = []
    outputs: list[tuple[Cell, ...]] = []
    for k, load in enumerate(chip.settings.load):
        used = require_bearable(chip.design, load.force_z_mN, load.moment_x_Num, load.moment_y_Num)
        corner = 100.0 * float(surface_stress(analysis.whole, _six(load)).max()) / chip.design.strength_kpa
        bridge = analysis.of_whole @ _six(load)
        volts = 1e-3 * np.array(chip.readout.gains) * bridge
        over = [name for name, v in zip(("F_z", "M_x", "M_y"), volts, strict=True) if abs(v) > chip.readout.adc_limit]
        fillet = () if end is None else (100.0 * require_bearable_at_fillets(end, analysis.beams, _six(load)),)
        rows.append((_named(load, k), load.force_z_mN, load.moment_x_Num, load.moment_y_Num, 100.0 * used, corner, *fillet))
        outputs.append((_named(load, k), *(float(v) for v in bridge), *(float(v) for v in volts), ", ".join(over) or "none"))
    columns: tuple[str, ...] = ("load", "F_z, mN", "M_x, N µm", "M_y, N µm", "nominal, % of strength", "near corners, % of strength")
    note = (
        "Near corners: largest tension of finite elements up to a quarter of the thickness from the beams' ends. In a sharp corner itself "
        "it has no bound; fillet_um rounds it, and what the rounded corner bears is told then."
    )
    if end is not None:
        columns, note = (*columns, "in the fillets, % of strength"), note.split(" In a sharp")[0]
    names = [f"{what} {name}, {unit}" for what, unit in (("bridge", "mV"), ("amplified", "V")) for name in ("F_z", "M_x", "M_y")]
    caption = "By finite elements of the whole chip, without offset and noise."
    return (
        Table("Loads", columns, tuple(rows), note=note),
        Table("Outputs", ("load", *names, "saturated"), tuple(outputs), caption=caption),
    )
