"""The sidebar shows the branch of the page that is open, and of all others the first level.

The theme asks for the whole tree on each page: of the hundreds of pages of the API that was the most of the time of a build, and of the
size of a page.
"""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx

BEFORE_THE_THEME = 100  # which asks for the tree with the usual priority, 500


def collapsed(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Let the theme get a tree of which only the branch of this page is open."""
    whole = context.get("toctree")
    if whole is not None:
        context["toctree"] = lambda **options: whole(**{**options, "collapse": True})


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("html-page-context", collapsed, priority=BEFORE_THE_THEME)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
