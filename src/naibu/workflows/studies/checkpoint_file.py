"""A file that keeps what an unfinished run of a study has computed, and when it may be resumed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from naibu.core.errors import InputError


@dataclass(frozen=True, slots=True)
class CheckpointFile:
    """The checkpoint of a study.

    Attributes
    ----------
    path : Path
        The file.
    source : str
        File or name of the study, for messages.
    fingerprint : str
        Of the study; a checkpoint of another one is refused.
    """

    path: Path
    source: str
    fingerprint: str

    def require_present(self) -> None:
        """Raise an InputError where there is no file."""
        if not self.path.is_file():
            raise InputError(f"{self.path}: does not exist, so there is nothing to resume; run without `resume`")

    def damaged(self, error: Exception) -> InputError:
        """Return the exception for a file that cannot be read."""
        return InputError(f"{self.path}: is damaged ({error}); run without `resume`, and with `overwrite`")

    def require_same(self, fingerprint: str) -> None:
        """Raise an InputError if the fingerprint in the file is not that of the study."""
        if fingerprint != self.fingerprint:
            raise InputError(
                f"{self.path}: was kept with other settings, inputs or another version of naibu than {self.source} now; put them back, or "
                "run without `resume`, and with `overwrite`"
            )

    def remove(self) -> None:
        """Remove the file, where it is."""
        self.path.unlink(missing_ok=True)
