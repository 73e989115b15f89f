"""HTML of the live page; the script of the bundle builds what is inside."""

from __future__ import annotations

from html import escape

from naibu.viewer.live.scene import LiveScene
from naibu.viewer.page_frame import page_html


def live_html(scene: LiveScene) -> str:
    """Return the page of a scene, which it fetches from the server that it came from."""
    lead = "".join(f"<p>{escape(s)}</p>" for s in scene.sentences)
    main = (
        '<section class="live"><div id="naibu-live"></div>'
        '<noscript><p class="no-3d">The live page needs JavaScript.</p></noscript></section>'
    )
    footer = "Lengths in mm, forces in N. The simulation runs on this computer; this page talks to it and to nothing else."
    return page_html(scene.title, lead, main, footer, script="live.js", connects=True)
