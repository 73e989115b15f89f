"""What is kept of an identification while it runs: the best values so far, and the models of experiments left out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from naibu.core.errors import InputError
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.io.files.atomic import write_atomically

CHECKPOINT_FILE = "checkpoint.json"


@dataclass(slots=True, eq=False)
class SearchCheckpoint:
    """Best values and finished models of one identification, written to its folder whenever they change.

    Attributes
    ----------
    provenance : mapping
        Inputs and settings; what was kept of others is not used.
    values : mapping of str to float
        Best values so far; empty before there are any.
    models : mapping of str to CalibratedModel
        Models that have not seen an experiment, by its name.
    folder : Path or None
        Where it is kept; None keeps nothing.
    """

    provenance: Mapping[str, Any]
    values: Mapping[str, float] = field(default_factory=dict)
    models: Mapping[str, CalibratedModel] = field(default_factory=dict)
    folder: Path | None = None

    @classmethod
    def read(cls, folder: Path, provenance: Mapping[str, Any]) -> SearchCheckpoint:
        """Return what a folder holds of an interrupted search with the same inputs and settings; without a folder of its own."""
        try:
            data = json.loads((folder / CHECKPOINT_FILE).read_text(encoding="utf-8"))
            if data["provenance"] == json.loads(json.dumps(provenance)):
                values = {str(name): float(value) for name, value in data["values"].items()}
                models = {str(name): CalibratedModel.from_dict(model) for name, model in data["left_out"].items()}
                return cls(provenance, values, models)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, InputError):
            return cls(provenance)  # without a usable checkpoint the search begins anew
        return cls(provenance)

    def keep_values(self, values: Mapping[str, float]) -> None:
        """Keep the best values so far."""
        self.values = dict(values)
        self._write()

    def keep_model(self, left_out: str, model: CalibratedModel) -> None:
        """Keep the model that has not seen an experiment."""
        self.models = {**self.models, left_out: model}
        self._write()

    def remove(self) -> None:
        """Remove the file: the identification is finished."""
        if self.folder is not None:
            (self.folder / CHECKPOINT_FILE).unlink(missing_ok=True)

    def _write(self) -> None:
        if self.folder is not None:
            left_out = {name: model.to_dict() for name, model in self.models.items()}
            content = {"provenance": self.provenance, "values": self.values, "left_out": left_out}
            write_atomically(self.folder / CHECKPOINT_FILE, json.dumps(content))
