"""The directive ``naibu-help``: what ``naibu VERB --help`` prints, taken from the program when the pages are built."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx


class NaibuHelp(Directive):
    """Show the help of a verb, or of the whole program where none is named."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        arguments = [*self.arguments, "--help"]
        if importlib.util.find_spec("naibu.cli") is None:
            return [nodes.paragraph(text="The command line is not part of this version.")]
        command = [sys.executable, "-c", "import sys; from naibu.cli import main; sys.argv[0] = 'naibu'; main()", *arguments]
        environment = os.environ | {"COLUMNS": "86", "NO_COLOR": "1", "TERM": "dumb"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise self.error(f"naibu {' '.join(arguments)} ended with code {done.returncode}: {done.stderr.strip()}")
        text = f"$ naibu {' '.join(arguments)}\n{done.stdout.rstrip()}"
        return [nodes.literal_block(text, text, language="none")]


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("naibu-help", NaibuHelp)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
