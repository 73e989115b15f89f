"""Schema of the file of a sensing chip (``naibu simulate CHIP.toml``), and the messages about mistakes in it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from naibu.io.experiment_folder.schema import Finite, Positive, between
from naibu.io.files.checked_tables import CheckedTable, checked_file

Micrometres = Annotated[Positive, between(1e-2, 1e5)]
Shift = Annotated[Finite, between(-100.0, 100.0)]
Count = Annotated[int, Field(ge=1, le=100)]
Three = Annotated[list[Annotated[Positive, between(1e-9, 1e9)]], Field(min_length=3, max_length=3)]
Load = Annotated[Finite, between(-1e9, 1e9)]


def _growing(values: list[float]) -> list[float]:
    if values[0] >= values[1]:
        raise ValueError(f"must grow; {values[0]:g} is not less than {values[1]:g}")
    return values


Span = Annotated[list[Micrometres], Field(min_length=2, max_length=2), AfterValidator(_growing)]


class ChipTable(CheckedTable):
    """``[chip]``: dimensions."""

    beam_length_um: Micrometres
    beam_width_um: Micrometres
    beam_thickness_um: Micrometres
    block_width_um: Micrometres
    block_height_um: Micrometres = 400.0
    frame_width_um: Micrometres = 500.0
    pillar_width_um: Micrometres
    fillet_um: Micrometres | None = None
    pillar_mass_mg: Annotated[Positive, between(1e-6, 1e6)] = 0.1


class SiliconTable(CheckedTable):
    """``[silicon]``: orientation, strength and doping."""

    beam_direction: str = "110"
    wafer_normal: str = "001"
    strength_MPa: Annotated[Positive, between(1.0, 1e5)] = 2000.0
    doping_per_cm3: Annotated[Positive, between(1e14, 1e21)] | None = None


class ResistorsTable(CheckedTable):
    """``[resistors]``: places of the piezoresistors."""

    force_from_end_um: Micrometres
    moment_from_end_um: Micrometres
    length_um: Micrometres = 20.0
    mask_shift_um: Annotated[list[Shift], Field(min_length=2, max_length=2)] = Field(default=[2.0, 2.0])


class ReadoutTable(CheckedTable):
    """``[readout]``: supply, amplifiers, converter and filter."""

    supply_V: Annotated[Positive, between(1e-3, 1e3)] = 5.0
    gains: Three = Field(default=[2000.0, 500.0, 500.0])
    noise_width_V: Three = Field(default=[0.37, 0.1, 0.1])
    adc_bits: Annotated[int, Field(ge=1, le=32)] = 12
    adc_limit_V: Annotated[Positive, between(1e-3, 1e4)] = 10.0
    sample_rate_Hz: Annotated[Positive, between(1e-3, 1e9)] = 100.0
    filter_share: Annotated[float, Field(ge=0.001, le=1.0)] = 0.1


class LoadTable(CheckedTable):
    """``[[load]]``: a load on the block."""

    name: str = ""
    force_z_mN: Load = 0.0
    moment_x_Num: Load = 0.0
    moment_y_Num: Load = 0.0


class StudyTable(CheckedTable):
    """``[study]``: smallest and largest sizes of the beams of other designs."""

    beam_length_um: Span
    beam_width_um: Span
    beam_thickness_um: Span
    steps: Annotated[int, Field(ge=2, le=60)] = 21


class MeshTable(CheckedTable):
    """``[mesh]``: numbers of cells."""

    along: Count = 10
    across: Count = 2
    through: Count = 3
    below: Count = 3
    frame: Count = 4


class ChipFile(CheckedTable):
    """Contents of the file."""

    title: str = ""
    chip: ChipTable
    silicon: SiliconTable = SiliconTable()
    resistors: ResistorsTable
    readout: ReadoutTable = ReadoutTable()
    load: list[LoadTable] = Field(default=[])
    study: StudyTable | None = None
    mesh: MeshTable = MeshTable()


_TABLES: dict[str, type[CheckedTable]] = {
    "chip": ChipTable,
    "silicon": SiliconTable,
    "resistors": ResistorsTable,
    "readout": ReadoutTable,
    "load": LoadTable,
    "study": StudyTable,
    "mesh": MeshTable,
}


def load_chip(path: Path | str, content: bytes) -> ChipFile:
    """Parse and check the bytes of a chip's file; `path` is only named in errors.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    return checked_file(path, content, ChipFile, _TABLES, "chip")
