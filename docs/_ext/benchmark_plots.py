"""The directive ``benchmark-plot``: a table of a record in ``benchmarks/results`` as curves on logarithmic axes, one for each series."""

from __future__ import annotations

import base64
import io
import json
from html import escape
from pathlib import Path
from typing import Any, ClassVar

import matplotlib as mpl
from docutils import nodes
from docutils.parsers.rst import Directive, directives
from matplotlib.figure import Figure
from sphinx.application import Sphinx

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"


class BenchmarkPlot(Directive):
    """Plot column `y` of a table against column `x`, a curve for each entry of the first column; with `points`, without lines."""

    required_arguments = 2
    option_spec: ClassVar = {"x": directives.nonnegative_int, "y": directives.nonnegative_int, "points": directives.flag}

    def run(self) -> list[nodes.Node]:
        path = RESULTS / f"{self.arguments[0]}.json"
        if not path.is_file():
            raise self.error(f"there is no record {path.name} in benchmarks/results")
        self.state.document.settings.record_dependencies.add(str(path))
        tables = {table["name"]: table for table in json.loads(path.read_text(encoding="utf-8"))["tables"]}
        if self.arguments[1] not in tables:
            raise self.error(f"{path.name} has no table {self.arguments[1]}; it has {', '.join(tables)}")
        table, x, y = tables[self.arguments[1]], self.options.get("x", 1), self.options.get("y", 2)
        picture = base64.b64encode(svg(table, x, y, points="points" in self.options)).decode()
        alt = escape(f"{table['columns'][y]} against {table['columns'][x]}", quote=True)
        return [nodes.raw("", f'<p><img alt="{alt}" src="data:image/svg+xml;base64,{picture}"></p>', format="html")]


def svg(table: dict[str, Any], x: int, y: int, *, points: bool) -> bytes:
    """Return the picture of a table."""
    names = list(dict.fromkeys(row[0] for row in table["rows"]))
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": table["name"]}):
        figure = Figure(figsize=(6.6, 3.4), layout="constrained")
        axes = figure.add_subplot()
        for name, marker in zip(names, "osD^vPX*<>"[: len(names)], strict=True):
            rows = sorted((row[x], row[y]) for row in table["rows"] if row[0] == name and row[y] != "")
            axes.plot(*zip(*rows, strict=True), marker=marker, linestyle="" if points else "-", label=name, markersize=5)
        axes.set(xscale="log", yscale="log", xlabel=table["columns"][x], ylabel=table["columns"][y])
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("benchmark-plot", BenchmarkPlot)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
