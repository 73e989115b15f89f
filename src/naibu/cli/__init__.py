"""The command line: ``naibu demo``, ``identify``, ``predict``, ``compare``, ``report``, ``import``, ``reproduce``, ``doctor``."""

from __future__ import annotations

import sys

from cyclopts import CycloptsError

from naibu.cli import experiments, imaging, studies  # noqa: F401  they bring their verbs
from naibu.cli.console import BAD_INPUT, INTERRUPTED, NO_SOLUTION, app, errors, fail, print_table
from naibu.cli.installation import doctor_rows, healthy
from naibu.cli.option_names import in_options
from naibu.core.errors import ConvergenceError, NaibuError


@app.command
def doctor() -> None:
    """List what is installed, what is missing, what it is needed for, and how to install it."""
    rows = doctor_rows()
    columns = ("component", "status", "found", "needed for", "remedy")
    print_table("naibu doctor", columns, [(r.name, r.status, r.found, r.purpose, r.remedy) for r in rows], left=True)
    if not healthy(rows):
        sys.exit(1)


def main() -> None:
    """Run the command line; a user's mistake ends with one message and exit code 2."""
    try:
        app(sys.argv[1:], exit_on_error=False, print_error=False)
    except CycloptsError as error:
        fail(f"{' '.join(str(error).split())} See naibu --help, or naibu VERB --help.", BAD_INPUT)
    except NaibuError as error:
        fail(in_options(str(error), app, sys.argv[1:]), NO_SOLUTION if isinstance(error, ConvergenceError) else BAD_INPUT)
    except KeyboardInterrupt:
        errors.print("Interrupted; every file written is complete. The same command resumes an identification.", soft_wrap=True)
        sys.exit(INTERRUPTED)
