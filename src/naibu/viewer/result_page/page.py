"""One self-contained HTML page for a result: readable without a network, without naibu, and on a phone."""

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
        What the page shows; lengths in mm.
    max_bytes : int
        Limit of the page's size. If it is exceeded, intermediate load steps of the 3-D view are left out (the view interpolates).

    Raises
    ------
    InputError
        The page is too large even with the free and the fully loaded step alone.
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
    """Write the page of a result; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    path : path-like
        File to write, usually ``report.html``; its folder is made when it is not there.
    report : Report
        What the page shows; lengths in mm.

    Returns
    -------
    Path
        The file written.
    """
    return write_atomically(path, report_html(report))
