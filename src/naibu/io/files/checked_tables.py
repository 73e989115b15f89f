"""Check of a TOML file against a schema, with messages that name table, key, value and the mend."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from naibu.core.errors import InputError
from naibu.io.files.parsing import parsed_toml


class CheckedTable(BaseModel):
    """A table whose keys are all known, and whose values have the right types."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


Contents = TypeVar("Contents", bound=CheckedTable)


def checked_file(
    path: Path | str, content: bytes, contents: type[Contents], tables: Mapping[str, type[CheckedTable]], study: str
) -> Contents:
    """Parse and check the bytes of a file.

    Parameters
    ----------
    path : path-like
        Only named in errors.
    content : bytes
        The file.
    contents : type
        Schema of the whole file.
    tables : mapping
        Schemas of its tables by name; a table that is a list is written ``[[name]]``.
    study : str
        Name of the study whose example shows every key.

    Raises
    ------
    InputError
        The text is not UTF-8 or not TOML (the line is shown), or a key is unknown, missing or holds a value that cannot be.
    """
    data = parsed_toml(path, content)
    try:
        return contents.model_validate(data)
    except ValidationError as error:
        faults = [f"{path}: {_told(dict(fault), contents, tables, study)}" for fault in error.errors(include_url=False)]
        raise InputError("\n".join(dict.fromkeys(faults))) from error


def _told(fault: dict[str, Any], contents: type[CheckedTable], tables: Mapping[str, type[CheckedTable]], study: str) -> str:
    """One fault of the check, in words that name the field, its value and the mend."""
    loc = [part for part in fault["loc"] if not isinstance(part, int)]
    if not loc:  # a check of the whole file
        return str(fault["msg"]).removeprefix("Value error, ")
    name, key = str(loc[0]), str(loc[-1])
    listed = isinstance(contents.model_fields[name].default, list) if name in contents.model_fields else False
    number = next((f" number {part + 1}" for part in fault["loc"][1:2] if isinstance(part, int) and listed), "")
    place = f"[[{name}]]{number}" if listed else f"[{name}]" if name in tables else name
    place = f"{place} {key}" if len(loc) > 1 else place
    if fault["type"] == "extra_forbidden":
        known = list((tables[name] if len(loc) > 1 and name in tables else contents).model_fields)
        close = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
        return f"{place} is not a known key; " + (
            f"did you mean {close[0]!r}?" if close else f"remove it, or use one of {', '.join(known)}"
        )
    if fault["type"] == "missing":
        return f"{place} is missing; add it; the example of the study {study!r} shows every key"
    message = str(fault["msg"]).removeprefix("Value error, ").replace("Input should", "must")
    return f"{place} = {repr(fault['input'])[:60]}: {message[:1].lower()}{message[1:]}; correct it in this file"
