"""The command line: ``naibu demo``, ``identify``, ``predict``, ``compare``, ``report``, ``import``, ``reproduce``, ``doctor``."""

from __future__ import annotations

import sys

from cyclopts import CycloptsError

from naibu.cli import experiments, imaging, studies  # noqa: F401  they bring their verbs
from naibu.cli.cold_start import first_run
from naibu.cli.console import BAD_INPUT, INTERRUPTED, NO_SOLUTION, app, errors, fail, print_table, progress_display, say
from naibu.cli.installation import doctor_rows, healthy
from naibu.cli.option_names import in_options
from naibu.core.errors import ConvergenceError, NaibuError


@app.command
def doctor(*, warm: bool = False) -> None:
    """List what is installed, what is missing, what it is needed for, and how to install it.

    Parameters
    ----------
    warm
        Compile the kernels of all verbs now, which takes some minutes once, so that no later run waits for them.
    """
    rows = doctor_rows()
    columns = ("component", "status", "found", "needed for", "remedy")
    print_table("naibu doctor", columns, [(r.name, r.status, r.found, r.purpose, r.remedy) for r in rows], left=True)
    if not healthy(rows):
        sys.exit(1)
    if warm:
        _warm_up()


def _warm_up() -> None:
    from naibu.workflows.warm_up import warm_up

    with progress_display() as progress:
        done = warm_up(progress)
    say(f"{done.kernels} kernels compiled in {done.seconds:.0f} s." if done.kernels else "All kernels were compiled already.")
    for trouble in done.failed:
        say(f"not warmed up: {trouble}")
    if done.failed:
        sys.exit(1)


def _verb() -> str:
    return next((word for word in sys.argv[1:] if not word.startswith("-")), "")


def main() -> None:
    """Run the command line; a user's mistake ends with one message and exit code 2."""
    try:
        with first_run(_verb(), errors):
            app(sys.argv[1:], exit_on_error=False, print_error=False)
    except CycloptsError as error:
        fail(f"{' '.join(str(error).split())} See naibu --help, or naibu VERB --help.", BAD_INPUT)
    except NaibuError as error:
        fail(in_options(str(error), app, sys.argv[1:]), NO_SOLUTION if isinstance(error, ConvergenceError) else BAD_INPUT)
    except KeyboardInterrupt:
        errors.print("Interrupted; every file written is complete. The same command resumes an identification.", soft_wrap=True)
        sys.exit(INTERRUPTED)
