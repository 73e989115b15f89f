"""Parsing of TOML and JSON files; messages name the file and the line."""

from __future__ import annotations

import json
import os
import re
import tomllib
from pathlib import Path
from typing import Any

from naibu.core.errors import InputError
from naibu.io.files.reading import guarded_reading, read_bytes


def parsed_toml(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """Return the tables of TOML text; `path` is only used in messages.

    Raises
    ------
    InputError
        The text is not UTF-8, not TOML (the line is shown), or nested too deeply.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a TOML file: byte {error.start} is not UTF-8 text; give a text file in UTF-8") from error
    with guarded_reading(path, "TOML"):
        try:
            return tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(_syntax_message(path, text, error)) from error


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises
    ------
    InputError
        The file cannot be read, or is not JSON.
    """
    content = read_bytes(path)
    with guarded_reading(path, "JSON"):
        try:
            return json.loads(content)
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: is not JSON (byte {error.start} is no text)") from error
        except json.JSONDecodeError as error:
            raise InputError(f"{path}: is not JSON ({error})") from error


def _syntax_message(path: str | os.PathLike[str], text: str, error: tomllib.TOMLDecodeError) -> str:
    found = re.search(r"at line (\d+)", str(error))
    lines = text.splitlines()
    number = int(found[1]) if found else len(lines)
    shown = lines[number - 1].strip()[:100] if 0 < number <= len(lines) else ""
    return f"{path}: line {number} is not valid TOML: {shown!r} ({error}); correct this line: one key = value, text in quotes"
