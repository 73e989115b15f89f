"""Schema of the file of a study of an indentation (``naibu simulate INDENTATION.toml``)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from naibu.io.experiment_folder.schema import Length, NotNegative, Position, Positive, between
from naibu.io.files.checked_tables import CheckedTable, checked_file

Three = Annotated[list[Position], Field(min_length=3, max_length=3)]
ThreeLengths = Annotated[list[Length], Field(min_length=3, max_length=3)]
Modulus = Annotated[Positive, between(1e-6, 1e9)]
Shape = Literal["sphere", "plate", "bar"]
_SIZES = {"sphere": ("radius_mm",), "plate": ("size_mm",), "bar": ("radius_mm", "length_mm")}


class SolidTable(CheckedTable):
    """``[solid]``: the body at rest, and where it is held."""

    size_mm: ThreeLengths | None = None
    mesh: Annotated[str, Field(min_length=1)] | None = None
    element_mm: Length | None = None
    held_below_mm: NotNegative | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> SolidTable:
        if (self.size_mm is None) == (self.mesh is None):
            raise ValueError("give size_mm, the edges of a block, or mesh, a file of tetrahedra or hexahedra: one of the two")
        if self.mesh is not None and self.element_mm is not None:
            raise ValueError("element_mm is of a block; a mesh has the elements of its file: remove element_mm")
        return self


class MaterialTable(CheckedTable):
    """``[[material]]``: one for all, or one for every region of the mesh."""

    region: Annotated[str, Field(min_length=1)] | None = None
    law: Literal["neo_hookean", "linear_elastic"] = "neo_hookean"
    young_modulus_kPa: Modulus
    poisson_ratio: Annotated[float, Field(ge=0.0, le=0.499)] = 0.45


class PressTable(CheckedTable):
    """``[[indenter]]``: a rigid body, its start and its way."""

    name: Annotated[str, Field(min_length=1)] | None = None
    shape: Shape
    size_mm: ThreeLengths | None = None
    radius_mm: Length | None = None
    length_mm: Length | None = None
    axis: Three = Field(default=[0.0, 1.0, 0.0])
    centre_mm: Three
    travel_mm: Three
    friction: Annotated[NotNegative, between(0.0, 1e3)] = 0.0

    @model_validator(mode="after")
    def _complete(self) -> PressTable:
        wanted = _SIZES[self.shape]
        missing = [name for name in wanted if getattr(self, name) is None]
        spare = [n for n in ("size_mm", "radius_mm", "length_mm") if n not in wanted and getattr(self, n) is not None]
        if missing or spare:
            raise ValueError(f"a {self.shape} has {' and '.join(wanted)}; {f'add {missing[0]}' if missing else f'remove {spare[0]}'}")
        if np.linalg.norm(self.axis) < 1e-9:
            raise ValueError("axis = [0, 0, 0] has no direction; give that of the bar")
        return self


class RefinementTable(CheckedTable):
    """``[refinement]``: where the mesh is refined, and until when."""

    goal: Literal["force", "energy", "none"] = "force"
    tolerance: Annotated[Positive, between(1e-4, 1.0)] = 0.05
    max_unknowns: Annotated[int, Field(ge=100, le=2_000_000)] = 20_000
    fraction: Annotated[float, Field(ge=0.01, le=1.0)] = 0.6


class StepsTable(CheckedTable):
    """``[output]``: states along the way."""

    steps: Annotated[int, Field(ge=1, le=1000)] = 10


class IndentationFile(CheckedTable):
    """Contents of the file."""

    title: str = ""
    solid: SolidTable
    material: Annotated[list[MaterialTable], Field(min_length=1)] = Field(default=[])
    indenter: Annotated[list[PressTable], Field(min_length=1, max_length=20)] = Field(default=[])
    refinement: RefinementTable = RefinementTable()
    output: StepsTable = StepsTable()


_TABLES: dict[str, type[CheckedTable]] = {
    "solid": SolidTable,
    "material": MaterialTable,
    "indenter": PressTable,
    "refinement": RefinementTable,
    "output": StepsTable,
}


def load_indentation(path: Path | str, content: bytes) -> IndentationFile:
    """Parse and check the bytes of a study of an indentation; `path` is only named in errors.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    return checked_file(path, content, IndentationFile, _TABLES, "indentation")
