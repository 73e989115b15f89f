"""What pages lack for readers who use no mouse: levels of the headings in the sidebar, and code blocks that the keyboard can scroll."""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx

AFTER_THE_THEME = 900  # which puts the sidebar into the context with the usual priority, 500


def completed(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Complete the sidebar's captions, which Sphinx gives the role of a heading without a level, and let code blocks take the focus."""
    tree = context.get("furo_navigation_tree", "")
    context["furo_navigation_tree"] = tree.replace('class="caption" role="heading"', 'class="caption" role="heading" aria-level="2"')
    if "body" in context:
        context["body"] = context["body"].replace("<pre>", '<pre tabindex="0">')


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("html-page-context", completed, priority=AFTER_THE_THEME)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
