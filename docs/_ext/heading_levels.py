"""Captions of the sidebar as headings of a level: Sphinx gives them the role of a heading, which is incomplete without one."""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx

AFTER_THE_THEME = 900  # which puts the sidebar into the context with the usual priority, 500


def with_levels(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Complete the captions in the sidebar of a page."""
    tree = context.get("furo_navigation_tree", "")
    context["furo_navigation_tree"] = tree.replace('class="caption" role="heading"', 'class="caption" role="heading" aria-level="2"')


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("html-page-context", with_levels, priority=AFTER_THE_THEME)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
