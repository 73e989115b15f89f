"""Schema of the file of a fingertip (``naibu simulate FINGERTIP.toml``) and of a stored decoder of forces (``NAME-decoder.json``)."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationError

from naibu.core.errors import InputError
from naibu.io.experiment_folder.schema import Finite, Positive, between
from naibu.io.files.checked_tables import CheckedTable, checked_file
from naibu.io.files.reading import read_bytes

Millimetres = Annotated[Positive, between(1e-3, 1e3)]
Modulus = Annotated[Positive, between(1e-3, 1e9)]
Newtons = Annotated[Positive, between(1e-6, 1e6)]
Friction = Annotated[float, Field(ge=0.0, le=5.0)]
Tilt = Annotated[float, Field(ge=0.0, le=45.0)]
Error = Annotated[Finite, between(-20.0, 20.0)]
DECODER = "naibu fingertip decoder"


def _growing(values: list[float]) -> list[float]:
    for low, high in pairwise(values):
        if low >= high:
            raise ValueError(f"must grow; {low:g} is not less than {high:g}")
    return values


Growing = AfterValidator(_growing)


class FingertipTable(CheckedTable):
    """``[fingertip]``: gel and package."""

    diameter_mm: Millimetres
    young_modulus_kPa: Modulus
    poisson_ratio: Annotated[float, Field(ge=0.3, le=0.4999)] = 0.49
    law: str = "neo_hookean_isochoric"
    package_diameter_mm: Millimetres = 0.9
    package_height_mm: Millimetres = 0.35


class PressTable(CheckedTable):
    """``[[press]]``: a rod that presses, and may slide."""

    name: str = ""
    tilt_deg: Tilt
    azimuth_deg: Annotated[Finite, between(-360.0, 360.0)] = 0.0
    force_N: Newtons
    speed_mm_min: Annotated[Positive, between(1e-3, 1e5)] = 3.0
    friction: Friction = 0.5
    slide_mm: Annotated[Finite, between(-100.0, 100.0)] = 0.0


class JigTable(CheckedTable):
    """``[jig]``: errors with which the fingertip is mounted under the rod."""

    tilt_error_deg: Error = 0.0
    azimuth_error_deg: Error = 0.0


class ReadingsTable(CheckedTable):
    """``[readings]``: chip and filter."""

    chip_file: str = ""
    filter_share: Annotated[float, Field(ge=0.001, le=1.0)] = 0.1
    seed: Annotated[int, Field(ge=0, le=2**31)] = 0


class DecoderTable(CheckedTable):
    """``[decoder]``: the presses that it is trained on."""

    tilts_deg: Annotated[list[Tilt], Field(min_length=4, max_length=20), Growing] = Field(default=[0.0, 10.0, 20.0, 28.0, 35.0])
    frictions: Annotated[list[Friction], Field(min_length=1, max_length=6)] = Field(default=[0.2, 1.0])
    young_modulus_kPa: Annotated[list[Modulus], Field(min_length=2, max_length=2), Growing]
    force_N: Annotated[list[Newtons], Field(min_length=2, max_length=2), Growing]
    model_error: Annotated[float, Field(ge=0.0, le=0.5)] = 0.02


class MeshTable(CheckedTable):
    """``[mesh]``: numbers of cells."""

    around: Annotated[int, Field(ge=2, le=12)] = 4
    upwards: Annotated[int, Field(ge=1, le=12)] = 3
    shells: Annotated[int, Field(ge=4, le=60)] = 14


class FingertipFile(CheckedTable):
    """Contents of the file."""

    title: str = ""
    fingertip: FingertipTable
    press: list[PressTable] = Field(default=[])
    jig: JigTable = JigTable()
    readings: ReadingsTable = ReadingsTable()
    decoder: DecoderTable | None = None
    mesh: MeshTable = MeshTable()


_TABLES: dict[str, type[CheckedTable]] = {
    "fingertip": FingertipTable,
    "press": PressTable,
    "jig": JigTable,
    "readings": ReadingsTable,
    "decoder": DecoderTable,
    "mesh": MeshTable,
}


def load_fingertip(path: Path | str, content: bytes) -> FingertipFile:
    """Parse and check the bytes of a fingertip's file; `path` is only named in errors.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    return checked_file(path, content, FingertipFile, _TABLES, "fingertip")


Number = Annotated[float, Field(allow_inf_nan=False)]
Term = Annotated[float, Field(ge=-1e3, le=1e3)]  # of the logarithm of a force, or an angle over a ratio
Three = Annotated[list[Number], Field(min_length=3, max_length=3)]
Deviations = Annotated[list[Annotated[float, Field(ge=0.0, le=1e6)]], Field(min_length=3, max_length=3)]


class StoredSlip(CheckedTable):
    """How drag shows itself; units and meaning as in `naibu.applications.SlipDetector`."""

    coefficients: Annotated[list[Term], Field(min_length=9, max_length=9)]
    spread: Annotated[float, Field(ge=0.0, le=1e6)]
    sensitivity_mm: Annotated[Positive, between(1e-6, 1e3)]
    sensitivity_error: Annotated[float, Field(ge=0.0, le=1.0)]


class StoredDecoder(CheckedTable):
    """Contents of a stored decoder; units and meaning as in `naibu.applications.ForceDecoder`."""

    kind: str
    naibu: str
    study: str
    radius_mm: Millimetres
    volts_per_load: Three
    noise: Deviations
    coefficients: Annotated[list[Annotated[list[Term], Field(min_length=9, max_length=9)]], Field(min_length=3, max_length=3)]
    unit: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    spread: Deviations
    limits: Annotated[list[Positive], Field(min_length=3, max_length=3)]
    model_error: Annotated[float, Field(ge=0.0, le=0.5)]
    slip: StoredSlip


def load_decoder(path: Path) -> StoredDecoder:
    """Read and check a stored decoder.

    Raises
    ------
    InputError
        No such file, no decoder, or values that cannot be.
    """
    try:
        data = json.loads(read_bytes(path).decode("utf-8"))
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is no decoder of a fingertip ({error}); give the NAME-decoder.json that 'naibu simulate' writes"
        ) from error
    if not isinstance(data, dict) or data.get("kind") != DECODER:
        raise InputError(f"{path}: is no decoder of a fingertip; give the NAME-decoder.json that 'naibu simulate' writes")
    try:
        stored = StoredDecoder.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: {place} cannot be used ({first['msg']}); simulate the fingertip again") from error
    if 0.0 in stored.volts_per_load or 0.0 in stored.noise:
        raise InputError(f"{path}: volts_per_load or noise holds 0; simulate the fingertip again")
    if not stored.limits[0] < stored.limits[1]:
        raise InputError(f"{path}: limits are {stored.limits}: the first must be less than the second; simulate the fingertip again")
    return stored
