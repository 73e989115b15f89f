"""The directive ``benchmark-results``: tables of a record in ``benchmarks/results``, with command, date, version and machine below."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import Directive, directives
from sphinx.application import Sphinx

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"


class BenchmarkResults(Directive):
    """Show the tables of a record, or those named."""

    required_arguments = 1
    option_spec: ClassVar = {"tables": directives.unchanged}

    def run(self) -> list[nodes.Node]:
        path = RESULTS / f"{self.arguments[0]}.json"
        if not path.is_file():
            raise self.error(f"there is no record {path.name} in benchmarks/results")
        self.state.document.settings.record_dependencies.add(str(path))
        record = json.loads(path.read_text(encoding="utf-8"))
        wanted = self.options.get("tables", "").split() or [table["name"] for table in record["tables"]]
        found = {table["name"]: table for table in record["tables"]}
        if missing := [name for name in wanted if name not in found]:
            raise self.error(f"{path.name} has no table {', '.join(missing)}; it has {', '.join(found)}")
        when = datetime.date.fromisoformat(record["date"])
        words = nodes.paragraph("", "", nodes.literal(text=record["command"]))
        words += nodes.Text(f", {when.day} {when:%B %Y}, naibu {record['version']}, {record['machine']}.")
        return [*(table_of(found[name]) for name in wanted), words]


def table_of(table: dict[str, Any]) -> nodes.table:
    """Return a table as a node of the page."""
    columns, rows = table["columns"], table["rows"]
    group = nodes.tgroup(cols=len(columns))
    for k in range(len(columns)):
        group += nodes.colspec(colwidth=max(len(str(row[k])) for row in [columns, *rows]))
    group += nodes.thead("", row_of(columns))
    group += nodes.tbody("", *(row_of(row) for row in rows))
    return nodes.table("", group)


def row_of(cells: list[Any]) -> nodes.row:
    """Return a row of a table as a node."""
    return nodes.row("", *(nodes.entry("", nodes.paragraph(text=f"{c:.4g}" if isinstance(c, float) else str(c))) for c in cells))


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("benchmark-results", BenchmarkResults)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
