"""Checkpoint of the simulation of a lattice: the state after a frame, and the file that holds the frames until then."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from naibu.core.errors import InputError
from naibu.io.files.atomic import write_atomically, writer_of
from naibu.mechanics.lattices.model.contact_state import ContactState
from naibu.mechanics.lattices.model.state import LatticeState
from naibu.mechanics.lattices.simulation.loading_history import StudyState
from naibu.workflows.studies.checkpoint_file import CheckpointFile
from naibu.workflows.studies.lattice_study import PreparedStudy

CONTACT_ARRAYS = tuple(field.name for field in fields(ContactState))


class Checkpoint(CheckpointFile):
    """The file ``NAME.checkpoint.npz`` of a study of a lattice."""

    @classmethod
    def of(cls, folder: Path, prepared: PreparedStudy) -> Checkpoint:
        """Return the checkpoint of a study in a folder, where it is or will be."""
        return cls(folder / f"{prepared.name}.checkpoint.npz", prepared.source, prepared.fingerprint)

    def write(self, state: StudyState, series: str) -> None:
        """Keep a state, and the name of the file that holds the frames until then.

        Raises
        ------
        InputError
            The file cannot be written.
        """
        write_atomically(self.path, _packed(state, self.fingerprint, series))

    def needed(self) -> tuple[str, ...]:
        """Return the name of the unfinished file that the checkpoint goes with, nothing where there is none."""
        try:
            with np.load(self.path, allow_pickle=False) as file:
                name = str(file["series"])
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return ()
        return (name, f"{name.removesuffix('.part')}.undo") if name.endswith(".part") and name == Path(name).name else ()

    def read(self) -> StudyState:
        """Return the state to go on from.

        Raises
        ------
        InputError
            There is none, it is damaged, of another study, or of a run that is still going on.
        """
        self.require_present()
        try:
            with np.load(self.path, allow_pickle=False) as file:
                data = {name: file[name] for name in file.files}
            fingerprint = str(data["fingerprint"])
            state = _unpacked(data)
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise self.damaged(error) from error
        self.require_same(fingerprint)
        for name in self.needed():
            if (process := writer_of(self.path.parent / name)) is not None:
                raise InputError(f"{self.path}: belongs to a run that is still going on (process {process}); wait for its end, or end it")
        return state


def _packed(state: StudyState, fingerprint: str, series: str) -> bytes:
    """Return a state as an .npz file."""
    lattice, contact = state.lattice, state.lattice.contact
    arrays: dict[str, Any] = {
        "fingerprint": np.array(fingerprint),
        "series": np.array(series),
        "frame": np.array(state.frame),
        "position": lattice.position,
        "velocity": lattice.velocity,
        "extension": lattice.extension,
        "positions": state.positions,
        "work": state.work,
        "numbers": np.array([state.speed, state.external_work, float(state.unsettled)]),
    }
    if lattice.length is not None:
        arrays["length"] = lattice.length
    if contact is not None:
        arrays |= {f"contact_{name}": getattr(contact, name) for name in CONTACT_ARRAYS}
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _unpacked(data: dict[str, Any]) -> StudyState:
    contact = None
    if "contact_mode" in data:
        data.setdefault("contact_covered", np.zeros_like(data["contact_multiplier"]))  # files of earlier versions lack it
        contact = ContactState(*(data[f"contact_{name}"] for name in CONTACT_ARRAYS))
    lattice = LatticeState(data["position"], data["velocity"], data["extension"], data.get("length"), contact)
    speed, external_work, unsettled = data["numbers"].tolist()
    return StudyState(int(data["frame"]), lattice, speed, data["positions"], data["work"], external_work, int(unsettled))
