"""The 3-D view of markers in two configurations as a part of any page, with the words that it uses."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from html import escape

from naibu.viewer.result_page.packing import packed_scenes
from naibu.viewer.result_page.payload import Scene

SCRIPT = "report.js"  # asset that draws the view


@dataclass(frozen=True, slots=True, eq=False)
class MarkerView:
    """Scenes to choose from.

    Attributes
    ----------
    scenes : tuple of Scene
        What is shown: balls are the positions `Scene.measured`, cages those of the last step, arrows lead from the former to the latter.
    words : dict of str to str or list of str
        Labels that differ from those of the result page: ``choice``, ``measured``, ``predicted``, ``arrow``, ``difference`` (a noun),
        ``bar`` (above the colours), ``part`` (while the load is not full), ``none`` (no arrow at all), ``lacking`` (of a marker without
        arrow), ``missing`` (after the number of such markers), ``groups`` (names of `Scene.layer`), ``load`` (the slider), ``from`` and
        ``to`` (its ends).
    """

    scenes: tuple[Scene, ...]
    words: dict[str, str | list[str]] = field(default_factory=dict)

    def html(self) -> str:
        """Return the element that the script fills."""
        words = f' data-words="{escape(json.dumps(self.words), quote=True)}"' if self.words else ""
        return (
            f'<div id="naibu-viewer"{words}></div>'
            '<noscript><p class="no-3d">The 3-D view needs JavaScript; everything else on this page is complete without it.</p></noscript>'
        )

    def data(self) -> str:
        """Return the element that holds the scenes."""
        return f'<script type="application/gzip+base64" id="naibu-scenes">{packed_scenes(self.scenes)}</script>'
