"""Schema of the file of a parameter sweep (``naibu simulate SWEEP.toml``)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from naibu.io.experiment_folder.schema import Finite
from naibu.io.files.checked_tables import CheckedTable, checked_file

MOST_RUNS = 100_000
Samples = Annotated[int, Field(ge=1, le=MOST_RUNS)]
Text = Annotated[str, Field(min_length=1, max_length=500)]


class SweepTable(CheckedTable):
    """``[sweep]``: which study is varied, and how."""

    study: Text
    method: Literal["grid", "latin_hypercube", "sobol"]
    samples: Samples | None = None
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0

    @model_validator(mode="after")
    def _fitting(self) -> SweepTable:
        if self.method == "grid" and self.samples is not None:
            raise ValueError("samples belongs to latin_hypercube and sobol; a grid has as many runs as its values have combinations")
        if self.method != "grid" and self.samples is None:
            raise ValueError(f'method = "{self.method}" needs samples, the number of runs')
        return self


class ParameterTable(CheckedTable):
    """``[[parameter]]``: a number of the study that is varied."""

    key: Text
    values: Annotated[list[Finite], Field(min_length=1, max_length=MOST_RUNS)] | None = None
    low: Finite | None = None
    high: Finite | None = None
    count: Annotated[int, Field(ge=2, le=MOST_RUNS)] | None = None
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _complete(self) -> ParameterTable:
        if self.values is not None:
            if any(given is not None for given in (self.low, self.high, self.count)):
                raise ValueError("gives values, and low, high or count; give one of them")
            if len(set(self.values)) < len(self.values):
                raise ValueError(f"values = {self.values} names a number twice")
            return self
        if self.low is None or self.high is None:
            raise ValueError("needs values, or low and high")
        if not self.low < self.high:
            raise ValueError(f"low = {self.low:g} must be less than high = {self.high:g}")
        if self.scale == "log" and self.low <= 0.0:
            raise ValueError(f'low = {self.low:g}: scale = "log" needs a positive number')
        return self


class SweepFile(CheckedTable):
    """The whole of a sweep."""

    title: str = ""
    sweep: SweepTable
    parameter: Annotated[list[ParameterTable], Field(min_length=1, max_length=50)] = []  # noqa: RUF012  as a default of pydantic, which copies it

    @model_validator(mode="after")
    def _fitting(self) -> SweepFile:
        if not self.parameter:
            raise ValueError("nothing is varied; add a table [[parameter]] with key, low and high")
        keys = [table.key for table in self.parameter]
        for k, table in enumerate(self.parameter):
            place = f"[[parameter]] number {k + 1}, {table.key}"
            if table.key in keys[:k]:
                raise ValueError(f"{place} is given twice; vary every key once")
            if self.sweep.method == "grid" and table.values is None and table.count is None:
                raise ValueError(f"{place} needs count, the number of its values from low to high, or values")
            if self.sweep.method != "grid" and (table.values is not None or table.count is not None):
                raise ValueError(f'{place} gives values or count, which belong to method = "grid"; give low and high')
        runs = 1
        for table in self.parameter:
            runs *= len(table.values) if table.values is not None else table.count or 1
        if runs > MOST_RUNS:
            raise ValueError(f"the grid has {runs} runs, more than {MOST_RUNS}; give fewer values, or use sobol with samples")
        return self


_TABLES: dict[str, type[CheckedTable]] = {"sweep": SweepTable, "parameter": ParameterTable}


def load_sweep(path: Path | str, content: bytes) -> SweepFile:
    """Parse and check the bytes of a sweep's file; `path` is only named in errors.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    return checked_file(path, content, SweepFile, _TABLES, "sweep")
