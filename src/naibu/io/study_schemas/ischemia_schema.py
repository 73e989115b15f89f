"""Schema of the file of a study of active ischemia (``naibu simulate SKIN.toml``)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from naibu.io.experiment_folder.schema import Positive, between
from naibu.io.files.checked_tables import CheckedTable, checked_file

Millimetres = Annotated[Positive, between(1e-3, 1e4)]
Modulus = Annotated[Positive, between(1e-6, 1e9)]
Viscosity = Annotated[Positive, between(1e-9, 1e12)]
Seconds = Annotated[Positive, between(1e-6, 1e7)]
Hertz = Annotated[Positive, between(1e-6, 1e6)]
Count = Annotated[int, Field(ge=2, le=200)]
Parameter = Literal["young_modulus", "voigt_viscosity", "series_viscosity"]


class SkinTable(CheckedTable):
    """``[skin]``: the patch."""

    geometry: Literal["plane_strain", "axisymmetric", "three_dimensional"] = "axisymmetric"
    width_mm: Millimetres
    depth_mm: Millimetres = 1.0
    sides: Literal["free", "fixed"] = "free"


class LayerTable(CheckedTable):
    """``[[layer]]``: from the base upwards."""

    name: str = ""
    thickness_mm: Millimetres
    young_modulus_kPa: Modulus
    voigt_viscosity_kPa_s: Annotated[float, Field(ge=0.0, le=1e12)] = 0.0
    series_viscosity_kPa_s: Viscosity | None = None
    poisson_ratio: Annotated[float, Field(ge=0.0, lt=0.4999)] = 0.49
    density_kg_m3: Annotated[Positive, between(1.0, 1e5)] = 1200.0
    known: list[Parameter] = Field(default=[])


class LoadTable(CheckedTable):
    """``[load]``: force, duration and the area it acts on."""

    force_mN: Annotated[Positive, between(1e-9, 1e9)]
    duration_s: Seconds
    radius_mm: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0


class PaleTable(CheckedTable):
    """``[pale]``: pressure above which capillaries are empty."""

    threshold_kPa: Annotated[Positive, between(1e-6, 1e6)] = 4.0


class TimeTable(CheckedTable):
    """``[time]``: end of the record."""

    end_s: Seconds


def _growing(values: list[float]) -> list[float]:
    if values[0] >= values[1]:
        raise ValueError(f"must grow; {values[0]:g} is not less than {values[1]:g}")
    return values


class FrequencyTable(CheckedTable):
    """``[frequency]``: range of the frequency response."""

    range_Hz: Annotated[list[Hertz], Field(min_length=2, max_length=2), AfterValidator(_growing)] = Field(default=[0.1, 100.0])
    count: Count = 31


class RecordTable(CheckedTable):
    """``[record]``: a measured indentation, from which the layers are identified."""

    file: Annotated[str, Field(min_length=1)]
    noise_mm: Annotated[Positive, between(1e-9, 1e3)]


class MeshTable(CheckedTable):
    """``[mesh]``: numbers of cells over half of the width, and over the height."""

    across: Count = 20
    upwards: Count = 14


class IschemiaFile(CheckedTable):
    """Contents of the file."""

    title: str = ""
    skin: SkinTable
    layer: Annotated[list[LayerTable], Field(min_length=1, max_length=2)] = Field(default=[])
    load: LoadTable
    pale: PaleTable = PaleTable()
    time: TimeTable
    frequency: FrequencyTable = FrequencyTable()
    record: RecordTable | None = None
    mesh: MeshTable = MeshTable()


_TABLES: dict[str, type[CheckedTable]] = {
    "skin": SkinTable,
    "layer": LayerTable,
    "load": LoadTable,
    "pale": PaleTable,
    "time": TimeTable,
    "frequency": FrequencyTable,
    "record": RecordTable,
    "mesh": MeshTable,
}


def load_ischemia(path: Path | str, content: bytes) -> IschemiaFile:
    """Parse and check the bytes of a study of active ischemia; `path` is only named in errors.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    return checked_file(path, content, IschemiaFile, _TABLES, "ischemia")
