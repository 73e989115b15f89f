"""Docstrings as help texts: paragraphs on one line each, which the width of the terminal breaks, not that of the source."""

from __future__ import annotations

import inspect
from typing import TypeVar

Documented = TypeVar("Documented")


def flowing(documented: Documented) -> Documented:
    """Join the lines of the paragraphs of a docstring, of function or class, and return that."""
    documented.__doc__ = joined_lines(documented.__doc__ or "")
    return documented


def joined_lines(text: str) -> str:
    """Return a numpydoc docstring whose paragraphs, in its head and in the descriptions of parameters, are a line each."""
    lines = inspect.cleandoc(text).splitlines()
    head = lines.index("Parameters") if "Parameters" in lines else len(lines)
    out: list[str] = []
    for number, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        goes_on = bool(out and line.strip() and out[-1].strip()) and indent == len(out[-1]) - len(out[-1].lstrip())
        if goes_on and (number < head or indent > 0):
            out[-1] += f" {line.strip()}"
        else:
            out.append(line)
    return "\n".join(out)
