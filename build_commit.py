"""Build hook: a wheel records the commit that it was built from, which ``naibu --version`` shows."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class RecordedCommit(BuildHookInterface):  # type: ignore[type-arg, misc]  # hatchling is there only while a wheel is built
    """Adds ``naibu/_commit.txt`` where the sources are a git repository."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the file aside, and have it included."""
        try:
            found = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], cwd=self.root, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return
        file = Path(tempfile.mkdtemp()) / "_commit.txt"
        file.write_text(found.stdout, encoding="utf-8")
        build_data["force_include"][str(file)] = "naibu/_commit.txt"
