"""The command line: ``naibu demo``, ``identify``, ``predict``, ``compare``, ``report``, ``import``, ``reproduce``, ``doctor``."""

from __future__ import annotations

import sys

from cyclopts import CycloptsError

from naibu.cli import applications, experiments, imaging, studies, touching  # noqa: F401  they bring their verbs
from naibu.cli.cold_start import first_run
from naibu.cli.console import BAD_INPUT, FAILED, INTERRUPTED, app, errors, fail, print_table, progress_display, say
from naibu.cli.described import Flag
from naibu.cli.failures import (
    OutputLostError,
    flush_output,
    leave_quietly,
    occupy_closed_streams,
    out_of_memory,
    output_lost,
    require_room,
    unexpected,
)
from naibu.cli.installation import doctor_rows, healthy
from naibu.cli.option_names import in_options, usage_error
from naibu.core.errors import ConvergenceError, NaibuError
from naibu.core.memory import is_out_of_memory


@app.command
def doctor(*, warm: Flag = False, self_test: Flag = False) -> None:
    """List what is installed, what is missing, what it is needed for, and how to install it.

    Parameters
    ----------
    warm
        Compile the kernels of all verbs now, which takes some minutes once, so that no later run waits for them.
    self_test
        Run small cases whose answers are known, from files to results, in about a minute; exit code 1 if one is wrong.
    """
    rows = doctor_rows()
    columns = ("component", "status", "found", "needed for", "remedy")
    print_table("naibu doctor", columns, [(r.name, r.status, r.found, r.purpose, r.remedy) for r in rows], left=True)
    if not healthy(rows):
        sys.exit(1)
    if warm:
        _warm_up()
    if self_test:
        _self_test()


def _warm_up() -> None:
    from naibu.workflows.installation.warm_up import warm_up

    with progress_display() as progress:
        done = warm_up(progress)
    say(f"{done.kernels} kernels compiled in {done.seconds:.0f} s." if done.kernels else "All kernels were compiled already.")
    for trouble in done.failed:
        say(f"not warmed up: {trouble}")
    if done.failed:
        sys.exit(1)


def _self_test() -> None:
    from naibu.workflows.installation import self_test

    with progress_display() as progress:
        checks = self_test.self_test(progress)
    columns = ("case", "found", "from", "to", "verdict")
    rows = [(c.name, f"{c.found:.4g}", f"{c.low:g}", f"{c.high:g}", "pass" if c.passed else "FAIL") for c in checks]
    print_table("Self-test", columns, rows)
    for check in checks:
        if check.trouble:
            say(f"{check.name}: {check.trouble}")
    failed = sum(not check.passed for check in checks)
    say(f"{failed} of {len(checks)} checks failed." if failed else f"All {len(checks)} checks passed.")
    if failed:
        sys.exit(FAILED)


def _verb() -> str:
    return next((word for word in sys.argv[1:] if not word.startswith("-")), "")


def _run() -> None:
    """Run the verb, and see that what it printed was taken."""
    try:
        with first_run(_verb(), errors):
            app(sys.argv[1:], exit_on_error=False, print_error=False)
    except SystemExit as ended:
        if not ended.code:
            flush_output()
        raise
    flush_output()


def main() -> None:
    """Run the command line; a user's mistake ends with one message and exit code 2, any other error with one message and code 1."""
    occupy_closed_streams()
    try:
        require_room(_verb())
        _run()
    except CycloptsError as error:
        fail(usage_error(" ".join(str(error).split()), app, sys.argv[1:]), BAD_INPUT)
    except NaibuError as error:
        fail(in_options(str(error), app, sys.argv[1:]), FAILED if isinstance(error, ConvergenceError) else BAD_INPUT)
    except KeyboardInterrupt:
        errors.print("Interrupted; every file written is complete. The same command resumes an identification.", soft_wrap=True)
        sys.exit(INTERRUPTED)
    except OutputLostError as error:
        leave_quietly(str(error))
    except Exception as error:
        if is_out_of_memory(error):
            fail(out_of_memory(error, _verb()), FAILED)
        if output_lost(error):
            leave_quietly(f"standard output cannot be written ({error}); results in files are complete")
        fail(unexpected(error, _verb()), FAILED)
