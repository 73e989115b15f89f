"""Schema of the file of a lattice study (``naibu simulate STUDY.toml``), and the messages about mistakes in it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from naibu.core.errors import InputError
from naibu.io.experiment_folder.schema import Finite, Length, Mass, NotNegative, Position, Positive, between
from naibu.io.files.parsing import parsed_toml
from naibu.io.study_schemas.material_table import MaterialTable

# beyond these bounds the unit, or the number, is another; computations within them neither overflow nor vanish
Duration = Annotated[Positive, between(1e-9, 1e6)]
Large = Annotated[NotNegative, between(0.0, 1e9)]
Friction = Annotated[NotNegative, between(0.0, 1e3)]
Three = Annotated[list[Position], Field(min_length=3, max_length=3)]
ThreeLengths = Annotated[list[Length], Field(min_length=3, max_length=3)]
ThreeCells = Annotated[list[Annotated[int, Field(gt=0, le=100_000)]], Field(min_length=3, max_length=3)]
Quantity = Literal["displacement", "velocity", "stretch"]

_KEYS = ("short", "normal", "long", "core", "surface")
_LEAST, _MOST = 1e-9, 1e9  # stiffness and damping of an element, where it is neither 0 nor infinite; forces and velocities
_MOST_STEPS = 1e9
_SHOWN = 60  # letters of a value in a message
_HEAVIEST = 30.0  # g/cm^3; nothing soft is denser, so the unit must be another


def _by_class(zero: bool, infinite: bool) -> Any:
    """Return the check of a parameter: a number, or a table of numbers by class, by zone or by both."""

    def checked(value: Any) -> Any:
        if isinstance(value, Mapping):
            unknown = [key for key in value if key not in _KEYS]
            if unknown:
                raise ValueError(f"{unknown[0]!r} is neither a class (short, normal, long) nor a zone (core, surface) of elements")
            return {key: checked(inner) for key, inner in value.items()}
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError("must be a number, or a table such as {short = 60.0, normal = 40.0, long = 25.0}")
        try:
            number = float(value)
        except OverflowError:  # a whole number of more than 308 digits
            number = np.nan
        if np.isnan(number) or (np.isinf(number) and not infinite) or number < 0.0 or (number == 0.0 and not zero):
            raise ValueError("must be positive, or inf for none" if infinite else "must be finite and not negative")
        if number and np.isfinite(number) and not _LEAST <= number <= _MOST:
            raise ValueError(f"must lie between {_LEAST:g} and {_MOST:g}")
        return number

    return Annotated[Any, AfterValidator(checked)]


def _timed(columns: int, what: str) -> Any:
    """Return the check of a programme: rows of a time, s, and numbers, the times growing from 0 or later."""

    def checked(rows: list[list[float]]) -> list[list[float]]:
        for k, row in enumerate(rows):
            if len(row) != columns:
                raise ValueError(f"row {k + 1} has {len(row)} numbers; each row is {what}")
        times = [row[0] for row in rows]
        if not rows or times[0] < 0.0 or any(b <= a for a, b in pairwise(times)):
            raise ValueError(f"the times {', '.join(f'{t:g}' for t in times) or '(none)'} s must grow from 0 or later; each row is {what}")
        if max(abs(number) for row in rows for number in row) > _MOST:
            raise ValueError(f"holds a number beyond {_MOST:g}; each row is {what}")
        return rows

    return Annotated[list[list[Finite]], AfterValidator(checked)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ObjectTable(_Table):
    """``[object]``: shape and mass."""

    size_mm: ThreeLengths | None = None
    cells: ThreeCells | None = None
    labels: Annotated[str, Field(min_length=1)] | None = None
    label: Annotated[list[int], Field(min_length=1), BeforeValidator(lambda v: v if isinstance(v, list) else [v])] | None = None
    voxel_mm: ThreeLengths | None = None
    largest_piece: bool = False
    mass_g: Mass | None = None
    density_g_per_cm3: Annotated[Positive, between(1e-6, 1e9)] | None = None

    @model_validator(mode="after")
    def _one_of_each(self) -> ObjectTable:
        given = [name for name in ("size_mm", "cells", "labels") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"gives {' and '.join(given) or 'neither size_mm, cells nor labels'}; give the edges of a box (size_mm), its voxels "
                "(cells), or a volume of labels (labels), one of the three"
            )
        if self.labels is None and (self.label or self.voxel_mm or self.largest_piece):
            raise ValueError("label, voxel_mm and largest_piece belong to a volume of labels; give labels, or remove them")
        if (self.mass_g is None) == (self.density_g_per_cm3 is None):
            raise ValueError("give mass_g or density_g_per_cm3, one of the two")
        if self.density_g_per_cm3 is not None and self.density_g_per_cm3 > _HEAVIEST:
            raise ValueError(
                f"density_g_per_cm3 = {self.density_g_per_cm3:g}: no soft object is so dense; the unit is g/cm^3 (water: 1.0; 1000 kg/m^3 "
                "are 1.0 g/cm^3)"
            )
        return self


class LatticeTable(_Table):
    """``[lattice]``: nodes and elements."""

    kind: Literal["classic", "octree-0", "octree-1", "octree-2"] = "classic"
    spacing_mm: Length
    masses: Literal["volume", "equal"] = "volume"


class ParametersTable(_Table):
    """``[parameters]``: of the elements."""

    K: _by_class(True, False)  # type: ignore[valid-type]
    C1: _by_class(True, False)  # type: ignore[valid-type]
    C2: _by_class(False, True)  # type: ignore[valid-type]


class SimulationTable(_Table):
    """``[simulation]``: steps in time."""

    duration_s: Duration
    step_s: Duration = 0.002
    method: Literal["implicit", "euler", "symplectic_euler"] = "implicit"
    tolerance: Annotated[Positive, Field(lt=1), between(1e-12, 1.0)] = 1e-3
    gravity_mm_per_s2: Large = 0.0


class _Surface(_Table):
    static_friction: Friction = 0.0
    kinetic_friction: Friction | None = None
    pull_stiffness_mN_per_mm: Large = 0.0
    pull_damping_mN_s_per_mm: Large = 0.0
    pull_speed_mm_per_s: Large = 0.0

    @model_validator(mode="after")
    def _friction(self) -> _Surface:
        kinetic = self.kinetic_friction
        if kinetic is not None and kinetic > self.static_friction:
            raise ValueError(f"kinetic_friction = {kinetic:g} exceeds static_friction = {self.static_friction:g}; it cannot")
        return self


class FloorTable(_Surface):
    """``[floor]``: the plane under the object."""

    contact: Literal["sticking", "friction"] = "sticking"


class IndenterTable(_Surface):
    """``[[indenter]]``: a rigid body."""

    name: Annotated[str, Field(min_length=1)] | None = None
    shape: Literal["box", "cylinder", "sphere"]
    size_mm: ThreeLengths | None = None
    radius_mm: Length | None = None
    length_mm: Length | None = None
    axis: Three = [0.0, 0.0, 1.0]
    centre_mm: Three
    contact: Literal["friction", "tied", "points"] = "friction"
    points_mm: Length | None = None
    until_s: Annotated[NotNegative, between(0.0, 1e6)] | None = None
    path: _timed(4, "[time in s, displacement along x, y, z in mm]") | None = None  # type: ignore[valid-type]
    velocity: _timed(4, "[time in s, velocity along x, y, z in mm/s from then on]") | None = None  # type: ignore[valid-type]
    force: _timed(2, "[time in s, force in mN]") | None = None  # type: ignore[valid-type]
    direction: Three | None = None
    mass_g: Mass | None = None

    @model_validator(mode="after")
    def _complete(self) -> IndenterTable:
        wanted = {"box": ("size_mm",), "cylinder": ("radius_mm", "length_mm"), "sphere": ("radius_mm",)}[self.shape]
        missing = [name for name in wanted if getattr(self, name) is None]
        spare = [n for n in ("size_mm", "radius_mm", "length_mm") if n not in wanted and getattr(self, n) is not None]
        if missing or spare:
            raise ValueError(f"a {self.shape} has {' and '.join(wanted)}; {f'add {missing[0]}' if missing else f'remove {spare[0]}'}")
        if np.linalg.norm(self.axis) < _LEAST:
            raise ValueError("axis = [0, 0, 0] has no direction; give that of the cylinder")
        moved = [name for name in ("path", "velocity", "force") if getattr(self, name) is not None]
        if len(moved) > 1:
            raise ValueError(f"gives {' and '.join(moved)}; an indenter moves by one of them")
        if self.path and any(self.path[0][1:]):
            raise ValueError(
                f"path begins with the displacement {self.path[0][1:]}; it must begin with 0, 0, 0: set centre_mm to the start"
            )
        self._driven()
        if self.until_s is not None and self.contact == "friction":
            raise ValueError('until_s is the time at which a tied indenter lets go; write contact = "tied" or "points", or remove it')
        if self.contact == "points" and self.shape != "box":
            raise ValueError(f'contact = "points" needs a flat side: write shape = "box", not "{self.shape}", or contact = "tied"')
        if self.points_mm is not None and self.contact != "points":
            raise ValueError('points_mm is the distance of the points of contact = "points"; write that, or remove points_mm')
        return self

    def _driven(self) -> None:
        if self.force is None and (self.direction or self.mass_g):
            raise ValueError("direction and mass_g belong to an indenter that is moved by force; give force, or remove them")
        lacks_mass = self.mass_g is None and self.contact != "points"
        if self.force is not None and (self.direction is None or np.linalg.norm(self.direction) < _LEAST or lacks_mass):
            raise ValueError("an indenter that is moved by force needs direction = [x, y, z] and mass_g")
        if self.force is not None and self.contact == "tied":
            raise ValueError('a tied indenter cannot be moved by force; write contact = "friction", or "points"')
        if self.mass_g is not None and self.contact == "points":
            raise ValueError('mass_g: points of contact = "points" have no mass; remove it')


class OutputTable(_Table):
    """``[output]``: what is kept."""

    every_s: Duration = 0.05
    forces_every_s: Duration | None = None
    quantities: Annotated[list[Quantity], Field(min_length=1)] = ["displacement", "velocity", "stretch"]


class StudyFile(_Table):
    """The whole of a study."""

    title: str = ""
    object: ObjectTable
    lattice: LatticeTable
    parameters: ParametersTable | None = None
    material: MaterialTable | None = None
    simulation: SimulationTable
    floor: FloorTable | None = None
    indenter: list[IndenterTable] = []
    output: OutputTable = OutputTable()

    @property
    def sample_s(self) -> float:
        """Duration of the samples that forces are averaged over, s."""
        if self.output.forces_every_s is not None:
            return self.output.forces_every_s
        steps = round(self.output.every_s / self.simulation.step_s)
        return self.simulation.step_s * max(k for k in range(1, min(steps, 5) + 1) if steps % k == 0)

    @model_validator(mode="after")
    def _fitting(self) -> StudyFile:
        spacing = self.lattice.spacing_mm
        for edge in self.object.size_mm or ():
            if abs(edge / spacing - round(edge / spacing)) > 1e-6 or edge < 0.5 * spacing:
                raise ValueError(
                    f"[object] size_mm = {self.object.size_mm}: {edge:g} mm is no whole number of voxels of [lattice] spacing_mm = "
                    f"{spacing:g}; choose a spacing that divides all edges"
                )
        if self.parameters is None and self.material is None:
            raise ValueError(
                "[parameters] is missing; add a table [parameters] with K = 40.0, C1 = 20.0 and C2 = 60.0, or [material] with "
                "young_modulus_kPa of the solid"
            )
        if self.parameters is not None and self.material is not None:
            raise ValueError("[parameters] and [material] are both there; keep one of the two")
        self._material()
        if self.floor is None and not self.indenter:
            raise ValueError("there is neither a [floor] nor a [[indenter]]: nothing would touch the object; add one")
        self._times()
        self._contacts()
        return self

    def _material(self) -> None:
        if self.material is None:
            return
        if self.lattice.kind != "classic":
            raise ValueError(f'[material] does not go with [lattice] kind = "{self.lattice.kind}"; write kind = "classic", or [parameters]')
        if not isinstance(self.material.young_modulus_kPa, float) and self.object.labels is None:
            raise ValueError("[material] young_modulus_kPa by label or by voxel needs [object] labels; give one number for a box")

    def _times(self) -> None:
        simulation, output = self.simulation, self.output
        if (steps := simulation.duration_s / simulation.step_s) > _MOST_STEPS:
            raise ValueError(
                f"[simulation] duration_s = {simulation.duration_s:g} has {steps:.3g} steps of step_s = {simulation.step_s:g}; at most "
                f"{_MOST_STEPS:g} are computed"
            )
        if output.every_s < simulation.step_s:
            raise ValueError(f"[output] every_s = {output.every_s:g} is less than [simulation] step_s = {simulation.step_s:g}; give more")
        whole = [
            ("[output] every_s", output.every_s, "[simulation] step_s", simulation.step_s),
            ("[simulation] duration_s", simulation.duration_s, "[output] every_s", output.every_s),
            ("[output] forces_every_s", self.sample_s, "[simulation] step_s", simulation.step_s),
            ("[output] every_s", output.every_s, "[output] forces_every_s", self.sample_s),
            *(
                (f"{_number(k)} until_s", p.until_s, "[simulation] step_s", simulation.step_s)
                for k, p in enumerate(self.indenter)
                if p.until_s
            ),
        ]
        for name, value, of, part in whole:
            parts = value / part
            if not np.isfinite(parts) or abs(parts - round(parts)) > 1e-6 or round(parts) < 1:
                raise ValueError(f"{name} = {value:g} is no whole number of times {of} = {part:g}; choose numbers that divide")

    def _contacts(self) -> None:
        touching = [_number(k) for k, p in enumerate(self.indenter) if p.contact == "friction"]
        tied = [_number(k) for k, p in enumerate(self.indenter) if p.contact != "friction"]
        sticking = self.floor is not None and self.floor.contact == "sticking"
        if touching and tied:
            raise ValueError(
                f'{touching[0]} has contact = "friction" and {tied[0]} contact = "tied" or "points"; one study has one kind of contact'
            )
        if touching and sticking:
            raise ValueError(
                f'[floor] contact = "sticking" does not go with {touching[0]} in contact by friction; write contact = "friction" with '
                'static_friction and kinetic_friction for the floor, or contact = "tied" for the indenter'
            )
        if tied and self.floor is not None and not sticking:
            raise ValueError(f'[floor] contact = "friction" does not go with {tied[0]}, which is tied; write contact = "sticking"')
        rubbing = bool(touching) or (self.floor is not None and not sticking)
        if rubbing and self.simulation.method == "euler":
            raise ValueError('[simulation] method = "euler": contact by friction needs method = "implicit" or "symplectic_euler"')
        driven = [k for k, p in enumerate(self.indenter) if p.force is not None and p.contact == "friction"]
        if len(driven) > 1:
            raise ValueError(f"{_number(driven[1])} force: one indenter of a study can be moved by force; give the others a path")
        moving = [k for k, p in enumerate(self.indenter) if p.path or p.velocity]
        if driven and moving:
            raise ValueError(f"{_number(moving[0])} moves while {_number(driven[0])} is moved by force; then all others must stand still")


def _number(k: int) -> str:
    return f"[[indenter]] number {k + 1}"


_TABLES: dict[str, type[BaseModel]] = {
    "object": ObjectTable,
    "lattice": LatticeTable,
    "parameters": ParametersTable,
    "material": MaterialTable,
    "simulation": SimulationTable,
    "floor": FloorTable,
    "indenter": IndenterTable,
    "output": OutputTable,
}
_MENDS = {
    "object": "add a table [object] with size_mm = [100, 50, 70] and mass_g = 510",
    "lattice": "add a table [lattice] with spacing_mm = 10.0",
    "simulation": "add a table [simulation] with duration_s = 5.0",
    "young_modulus_kPa": "write a number, { 1 = 12.0, 2 = 40.0 } by label, or the file of a volume",
    "K": "stiffness of an element, mN/mm",
    "C1": "dashpot parallel to the spring, mN s/mm",
    "C2": "dashpot in series with the spring, mN s/mm",
    "size_mm": "write three positive lengths along x, y, z, for example size_mm = [100, 50, 70]",
    "spacing_mm": "write the edge of a voxel, for example spacing_mm = 10.0",
    "duration_s": "write how long is computed, for example duration_s = 5.0",
    "centre_mm": "write the position of its centre at the start, for example centre_mm = [50.0, 25.0, 95.0]",
    "shape": 'write shape = "box", "cylinder" or "sphere"',
}
_UNITS = ("_mm_per_s2", "_mN_s_per_mm", "_mN_per_mm", "_mm_per_s", "_g_per_cm3", "_mm", "_s", "_g")


def load_study(path: Path | str, content: bytes) -> StudyFile:
    """Parse and check the bytes of a study; `path` is only named in errors.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    return checked_study(path, parsed_toml(path, content))


def checked_study(path: Path | str, data: Mapping[str, Any]) -> StudyFile:
    """Check the tables of a study; `path` is only named in errors.

    Raises
    ------
    InputError
        A key is unknown, missing or holds a value that cannot be.
    """
    source = Path(path)
    try:
        return StudyFile.model_validate(data)
    except ValidationError as error:
        faults = [f"{source}: {_told(dict(fault))}" for fault in error.errors(include_url=False)]
        raise InputError("\n".join(dict.fromkeys(faults))) from error


def _told(fault: dict[str, Any]) -> str:
    """One fault of the check, in words that name the field, its value and the mend."""
    loc = tuple(fault["loc"])
    message = str(fault["msg"]).removeprefix("Value error, ")
    if not loc:
        return message
    place, key, whole = _place(loc)
    if fault["type"] == "extra_forbidden":
        value = "" if isinstance(fault["input"], dict | list) else f" = {fault['input']!r}"
        return f"{place}{value} is not a known key; {_known_instead(loc, key)}"
    if fault["type"] == "missing":
        return f"{place} is missing; {_MENDS.get(key, 'add it')}"
    if whole:
        return f"{place} {message}"
    what = "must be a finite number" if fault["type"] == "finite_number" else message.replace("Input should", "must")
    value = repr(fault["input"])
    shown = value if len(value) <= _SHOWN else f"{value[:_SHOWN]}..."
    return f"{place} = {shown}: {what[:1].lower()}{what[1:]}; {_MENDS.get(key, 'correct it in this file')}"


def _place(loc: tuple[int | str, ...]) -> tuple[str, str, bool]:
    """Return the place of a fault as the user sees it in the file, the key at fault, and whether that is a whole table."""
    parts = list(loc)
    table = ""
    if parts[0] in _TABLES:
        name = str(parts.pop(0))
        listed = bool(parts) and isinstance(parts[0], int)
        table = f"[[{name}]] number {int(parts.pop(0)) + 1}" if listed else f"[{name}]"
    if not parts:
        return table, str(loc[0]), True
    entry = next((f", entry {p + 1}" for p in parts[1:] if isinstance(p, int)), "")
    return f"{table} {parts[0]}{entry}".strip(), str(parts[0]), False


def _known_instead(loc: tuple[int | str, ...], key: str) -> str:
    model = _TABLES[str(loc[0])] if loc[0] in _TABLES and len(loc) > 1 else StudyFile
    known = list(model.model_fields)
    stem = key.split("_")[0].lower()
    same = [name for name in known if name.split("_")[0].lower() == stem and name.endswith(_UNITS)]
    if same:
        return f"convert the value to the unit of {same[0]!r} and write that"
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    return f"did you mean {close[0]!r}?" if close else f"remove it, or use one of {', '.join(known)}"
