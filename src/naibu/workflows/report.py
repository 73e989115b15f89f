"""Write the pages of an identification or a prediction anew from their folder."""

from __future__ import annotations

import os
from pathlib import Path

from naibu.workflows.results.result_folder import rewrite_reports


def report(folder: str | os.PathLike[str]) -> list[Path]:
    """Write the pages of an identification or a prediction anew from what is stored in its folder; nothing is solved.

    Returns
    -------
    list of Path
        ``report.html``, ``predicted.html``, or both, whichever results the folder holds.

    Raises
    ------
    InputError
        No results in the folder, or damaged ones.
    """
    return rewrite_reports(Path(folder))
