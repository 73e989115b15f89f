"""Presses of a fingertip that are already computed, kept in a file so that an interrupted run can be resumed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.applications.fingertip.pressing import Press, Pressing
from naibu.io.files.atomic import write_atomically
from naibu.io.files.reading import read_bytes
from naibu.workflows.studies.checkpoint_file import CheckpointFile

_ARRAYS = {"depth_mm": 1, "slide_mm": 1, "force_mn": 2, "chip_mn": 2, "chip_mn_mm": 2, "contact_mm": 2, "contact_radius_mm": 1}


class FingertipCheckpoint(CheckpointFile):
    """The file ``NAME.checkpoint.json`` of a study of a fingertip."""

    @classmethod
    def of(cls, folder: Path, name: str, source: str, digest: str) -> FingertipCheckpoint:
        """Return the checkpoint of a study in a folder, where it is or will be."""
        return cls(folder / f"{name}.checkpoint.json", source, f"{__version__} {digest}")

    def write(self, done: list[Pressing]) -> None:
        """Keep presses.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        kept = [{"young_modulus_kpa": p.young_modulus_kpa, **{k: getattr(p, k).tolist() for k in _ARRAYS}} for p in done]
        write_atomically(self.path, json.dumps({"fingerprint": self.fingerprint, "presses": kept}))

    def read(self, presses: tuple[Press, ...]) -> list[Pressing]:
        """Return what was kept of the first of `presses`.

        Raises
        ------
        InputError
            There is none, or it is damaged or of another study.
        """
        self.require_present()
        try:
            data = json.loads(read_bytes(self.path))
            fingerprint = str(data["fingerprint"])
            found = [_pressing(press, kept) for press, kept in zip(presses, data["presses"], strict=False)]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise self.damaged(error) from error
        self.require_same(fingerprint)
        return found


def _pressing(press: Press, kept: dict[str, Any]) -> Pressing:
    arrays = {name: np.array(kept[name], dtype=float) for name in _ARRAYS}
    count = len(arrays["depth_mm"])
    for name, dimension in _ARRAYS.items():
        if arrays[name].shape != (count, 3)[:dimension]:
            raise ValueError(f"{name} has the shape {arrays[name].shape}")
    return Pressing(press, float(kept["young_modulus_kpa"]), **arrays, displacement_mm=np.zeros((count, 0, 3)))
