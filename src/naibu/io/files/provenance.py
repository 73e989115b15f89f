"""Provenance of results: names and hashes of the input files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from naibu.core.errors import InputError

PART = 2**24  # bytes that are read at a time: volumes may be larger than memory


def sha256(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file, or of the files of a folder in order of their names, as hexadecimal digits.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    source, digest = Path(path), hashlib.sha256()
    try:
        for file in sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]:
            with file.open("rb") as stream:
                while part := stream.read(PART):
                    digest.update(part)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def input_record(files: Mapping[str, str | os.PathLike[str] | None]) -> dict[str, str]:
    """Return names and hashes of files by their role, such as ``"reference": "scan.mha, SHA-256 ..."``; None is skipped."""
    return {role: f"{Path(path).name}, SHA-256 {sha256(path)}" for role, path in files.items() if path is not None}
