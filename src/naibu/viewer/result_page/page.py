"""Result page as one self-contained HTML file."""

from __future__ import annotations

import os
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.files.atomic import write_atomically
from naibu.viewer.result_page.document import document
from naibu.viewer.result_page.packing import thinned
from naibu.viewer.result_page.payload import Report

MAX_BYTES = 2_000_000


def report_html(report: Report, max_bytes: int = MAX_BYTES) -> str:
    """Return the page as text.

    Parameters
    ----------
    report : Report
        Content of the page; lengths in mm.
    max_bytes : int
        Largest size of the page, bytes. If it is exceeded, intermediate load steps of the 3-D view are dropped (the view interpolates).

    Raises
    ------
    InputError
        The page is too large even with the first and the last load step alone.
    """
    scenes = report.scenes
    while True:
        page = document(report, scenes)
        size = len(page.encode())
        if size <= max_bytes:
            return page
        if all(len(s.steps) <= 2 for s in scenes):
            raise InputError(
                f"the report would have {size / 1e6:.1f} MB, the limit is {max_bytes / 1e6:.1f} MB; "
                "show fewer scenes, or give them a surface of fewer triangles"
            )
        scenes = tuple(thinned(s) if len(s.steps) > 2 else s for s in scenes)


def write_report(path: str | os.PathLike[str], report: Report) -> Path:
    """Write the result page; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    path : path-like
        File to write, usually ``report.html``; its folder is created if needed.
    report : Report
        Content of the page; lengths in mm.

    Returns
    -------
    Path
        The file written.
    """
    return write_atomically(path, report_html(report))
