"""Schema of the `meta.toml` of an experiment folder, and the error messages for mistakes in it."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from naibu.core.errors import InputError
from naibu.core.experiment import Axis
from naibu.io.files.parsing import parsed_toml


def between(low: float, high: float) -> AfterValidator:
    """Return the check that a number lies between two bounds."""

    def checked(value: float) -> float:
        if not low <= value <= high:
            raise ValueError(f"must lie between {low:g} and {high:g}")
        return value

    return AfterValidator(checked)


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# beyond these the unit, or the number, is another: lengths from a nanometre to 100 m, pixel sizes that are wrong by at most a factor of two
Length = Annotated[Positive, between(1e-6, 1e5)]
Mass = Annotated[Positive, between(1e-9, 1e9)]
Height = Annotated[NotNegative, between(0.0, 1e5)]
Position = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Scale = Annotated[float, Field(ge=0.5, le=2.0, allow_inf_nan=False)]
Celsius = Annotated[float, Field(ge=-273.15, le=1000.0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0, le=10**7)]
# a single number is accepted as a list of one
LengthOrList = Annotated[list[Length], BeforeValidator(lambda v: v if isinstance(v, list) else [v])]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def _gathered(data: Any, pattern: str, into: str) -> Any:
    """Move the keys that match `pattern` into the sub-table `into`: families of keys such as ``rows_layer_1``."""
    if not isinstance(data, dict):
        return data
    family = {k: v for k, v in data.items() if re.fullmatch(pattern, k)}
    return {k: v for k, v in data.items() if k not in family} | {into: family}


class CoordinatesTable(_Table):
    """``[coordinates]``: axes, resolution, and height of the base."""

    axes: str = ""
    up_axis: Axis | None = None
    pixel_mm: Length | None = None
    xy_step_mm: Length | None = None
    step_mm: Length | None = None
    z_step_mm: Length | None = None
    xy_sd_mm: Length | None = None
    z_sd_mm: Length | None = None
    z_base_est_mm: Position | None = None
    xy_scale_probable: Scale = 1.0
    printed_values: str = ""


class ObjectTable(_Table):
    """``[object]``: the undeformed body."""

    shape: str
    size_mm: Annotated[list[Length], Field(min_length=3, max_length=3)]
    size_axes: Annotated[list[Axis], Field(min_length=3, max_length=3)] | None = None
    joined_at_mm: list[Length] | None = None
    straight_base_mm: Height | None = None
    material: str = "gel"
    mass_g: Mass | None = None
    temperature_C: Celsius | None = None


class MarkersTable(_Table):
    """``[markers]``: type and nominal positions of the markers."""

    kind: str = ""
    placing: str = ""
    numbering: str = ""
    count: Count | None = None
    nominal_spacing_mm: Length | None = None
    nominal_margin_mm: Height | None = None
    nominal_height_above_base_mm: list[Length] = []
    depth_below_top_mm: Length | None = None
    layer_z_mm: list[Position] = []
    rows_of_layers: dict[str, list[int]] = {}

    @model_validator(mode="before")
    @classmethod
    def _rows(cls, data: Any) -> Any:
        return _gathered(data, r"rows_layer_\d+", "rows_of_layers")


class LayerTable(_Table):
    """``[[layer]]``: a slab of one material."""

    material: Annotated[str, Field(min_length=1)]
    from_base_mm: Annotated[list[Height], Field(min_length=2, max_length=2)]
    markers: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    batch: str = ""


class LoadingTable(_Table):
    """``[loading]``: loading of the object, as keys or as free text."""

    kind: Literal["plate", "bar", "side_plates", "cylinder"] | None = None
    bar_width_mm: Length | None = None
    bar_axis: Axis | None = None
    counter_material: str = "acrylic"
    base_material: str = "table"
    indenter: str = ""
    contact: str = ""
    height_stated_mm: LengthOrList | None = None
    height_est_mm: LengthOrList | None = None
    width_stated_mm: LengthOrList | None = None
    width_est_mm: LengthOrList | None = None
    width_initial_mm: Length | None = None
    surface_displacement_mm: Position | None = None
    deformed_after_s: NotNegative | None = None


class ScannerTable(_Table):
    """``[scanner]``: the instrument; stored with the experiment unchanged."""

    instrument: str | None = None
    slice_area_mm: Length | None = None
    slice_thickness_mm: Length | None = None
    slice_pitch_mm: Length | None = None
    slices: Count | None = None
    coil_inner_diameter_mm: Length | None = None
    frequency_MHz: Positive | None = None
    frame_rate_Hz: Positive | None = None
    image_px: Annotated[list[Count], Field(min_length=2, max_length=3)] | None = None
    sound_speed_m_per_s: Positive | None = None


class GelTable(_Table):
    """``[gel]``: prior knowledge of the material."""

    product: str = ""
    nu_note: str = ""
    values: dict[str, str | float] = {}

    @model_validator(mode="before")
    @classmethod
    def _values(cls, data: Any) -> Any:
        return _gathered(data, r"(E_\w+_Pa|hardness_\w+)", "values")


class StateTable(_Table):
    """``[[state]]``: one measured state; the first is the reference configuration."""

    name: Annotated[str, Field(pattern=r"^[\w.-]+$")]
    what: str = ""
    loaded: bool | None = None
    file: Annotated[str, Field(min_length=1)] | None = None
    held_out: bool = False
    height_stated_mm: Length | None = None
    height_est_mm: Length | None = None
    width_stated_mm: Length | None = None
    width_est_mm: Length | None = None
    printed_heading: str = ""
    seed_lines: str = ""
    count: dict[str, int] = {}
    residual_from_smooth_field_mm: dict[str, Height] = {}


class Meta(_Table):
    """The whole of `meta.toml`."""

    title: str
    source: str = ""
    dimensions: Literal[2, 3] = 3
    units: Literal["mm"]
    known_problems: list[str] = []
    coordinates: CoordinatesTable = CoordinatesTable()
    object: ObjectTable
    markers: MarkersTable = MarkersTable()
    layer: list[LayerTable] = []
    loading: LoadingTable
    scanner: ScannerTable = ScannerTable()
    gel: GelTable = GelTable()
    state: Annotated[list[StateTable], Field(min_length=1)]


_TABLES: dict[str, type[_Table]] = {
    "coordinates": CoordinatesTable,
    "object": ObjectTable,
    "markers": MarkersTable,
    "layer": LayerTable,
    "loading": LoadingTable,
    "scanner": ScannerTable,
    "gel": GelTable,
    "state": StateTable,
}
_LISTED = ("layer", "state")
_MENDS = {
    "title": 'add a line such as title = "Gel cube under a plate"',
    "units": 'naibu reads millimetres: convert the coordinates and write units = "mm"',
    "dimensions": "write dimensions = 3, or 2 for markers seen in one plane",
    "object": 'add a table [object] with shape = "cube" and size_mm = [60, 60, 60]',
    "shape": 'write, for example, shape = "cube"',
    "size_mm": "write three positive lengths along x, y, z, for example size_mm = [60, 60, 60]",
    "size_axes": 'write each of the three axes once, for example size_axes = ["x", "y", "z"]',
    "from_base_mm": "write the slab's lower and upper height, for example from_base_mm = [0, 30]",
    "loading": 'add a table [loading] with kind = "plate", "bar", "side_plates" or "cylinder"',
    "kind": 'write kind = "plate", "bar", "side_plates" or "cylinder"',
    "bar_axis": 'write bar_axis = "x", "y" or "z"',
    "up_axis": 'write up_axis = "x", "y" or "z"',
    "xy_scale_probable": "write the true size of a pixel divided by that of the file, 1 where nothing is known",
    "state": 'add a [[state]] table with name = "initial" for the unloaded state, and one for each loaded state',
    "name": 'give every state a name of letters, digits, "_", "-" and ".", for example name = "initial"',
}


def load_meta(path: Path, content: bytes) -> Meta:
    """Parse and check the content of `meta.toml`; `path` is only used in messages.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or has an invalid value.
    """
    data = parsed_toml(path, content)
    try:
        return Meta.model_validate(data)
    except ValidationError as error:
        faults = [f"{path}: {_told(dict(fault))}" for fault in error.errors(include_url=False)]
        raise InputError("\n".join(dict.fromkeys(faults))) from error


def _told(fault: dict[str, Any]) -> str:
    """Return the message for one validation error: the field, its value and the correction."""
    field, key = _field(fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"{field} is not a known key; {_known_instead(fault['loc'], key)}"
    mend = _MENDS.get(key, "correct it in this file")
    if fault["type"] == "missing":
        return f"{field} is missing; {_MENDS.get(key, 'add it')}"
    what = (
        "must be a finite number"
        if fault["type"] == "finite_number"
        else str(fault["msg"]).removeprefix("Value error, ").replace("Input should", "must")
    )
    return f"{field} = {fault['input']!r}: {what[:1].lower()}{what[1:]}; {mend}"


def _field(loc: tuple[int | str, ...]) -> tuple[str, str]:
    """Return the faulty field as written in the file, and its key."""
    parts = list(loc)
    table = ""
    if parts[0] in _TABLES and len(parts) > 1:
        name = str(parts.pop(0))
        table = f"[[{name}]] number {int(parts.pop(0)) + 1} " if name in _LISTED and isinstance(parts[0], int) else f"[{name}] "
    if not parts:
        return table.strip(), str(loc[0])
    key = str(parts[0])
    entry = next((f", entry {p + 1}" for p in parts[1:] if isinstance(p, int)), "")
    return f"{table}{key}{entry}", key


def _known_instead(loc: tuple[int | str, ...], key: str) -> str:
    model = _TABLES[str(loc[0])] if loc[0] in _TABLES else Meta
    known = [name for name in model.model_fields if name not in ("rows_of_layers", "values")]
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"remove it, or use one of {', '.join(known)}"
