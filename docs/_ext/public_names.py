"""Cross-references to the modules that define public names lead to their public paths, which are the only ones documented."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import naibu

ROOT = Path(naibu.__file__).resolve().parent


def public_paths() -> dict[str, str]:
    """Return the public path of every public name by the path of its definition, as the stubs state them."""
    paths = {}
    for stub in (ROOT / "__init__.pyi", *sorted(ROOT.glob("*/__init__.pyi"))):
        package = "naibu" if stub.parent == ROOT else f"naibu.{stub.parent.name}"
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                paths |= {f"{package}.{node.module}.{alias.name}": f"{package}.{alias.name}" for alias in node.names}
    return paths


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.TextElement) -> nodes.Node | None:
    """Find what a reference to a private path, or to a bare name of another package, means."""
    if node.get("refdomain") != "py":
        return None
    paths: dict[str, str] = env.app.naibu_public_paths  # type: ignore[attr-defined]
    target = node["reftarget"].lstrip(".")
    owner, _, member = target.rpartition(".")
    found = paths.get(target) or (f"{paths[owner]}.{member}" if owner in paths else None)
    if found is None:
        by_name = Counter(path.rpartition(".")[2] for path in paths.values())
        head, dot, rest = target.partition(".")
        if by_name[head] != 1:
            return None
        found = next(path for path in paths.values() if path.rpartition(".")[2] == head) + dot + rest
    shown = text.deepcopy()
    if text.astext().removesuffix("()") == node["reftarget"] and target.startswith("naibu."):
        shown = nodes.literal("", found, classes=list(text["classes"]))
    return env.get_domain("py").resolve_xref(env, node["refdoc"], app.builder, "obj", found, node, shown)


def setup(app: Sphinx) -> dict[str, bool]:
    app.naibu_public_paths = public_paths()  # type: ignore[attr-defined]
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
