"""Write the file of a lattice study from its settings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from naibu.io.study_schemas.lattice_study_schema import StudyFile


def study_document(settings: StudyFile, comment: str = "") -> str:
    """Return the text of a study file that reads as these settings.

    Parameters
    ----------
    settings : StudyFile
        What the file says; keys that have their default are left out.
    comment : str
        Lines above it, without ``#``.
    """
    given = settings.model_dump(mode="python", exclude_defaults=True, exclude_none=True)
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += [f"{key} = {_value(value)}" for key, value in given.items() if not isinstance(value, dict | list)]
    for key, value in given.items():
        for table, head in [(value, f"[{key}]")] if isinstance(value, dict) else [(t, f"[[{key}]]") for t in _tables(value)]:
            lines += ["", head, *(f"{name} = {_value(inner)}" for name, inner in table.items())]
    if settings.floor is not None and "floor" not in given:
        lines += ["", "[floor]"]
    return "\n".join(lines) + "\n"


def _tables(value: Any) -> list[dict[str, Any]]:
    return value if isinstance(value, list) else []


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else "inf"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)
