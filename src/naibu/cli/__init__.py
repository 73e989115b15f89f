"""The command line: verbs grouped by task, and what ends them."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import Annotated

from cyclopts import CycloptsError, Group, Parameter

from naibu.cli import (  # noqa: F401  they bring their verbs
    applications,
    calibrating,
    design,
    experiments,
    imaging,
    new,
    predicting,
    studies,
    touching,
)
from naibu.cli.installation import doctor_rows, healthy
from naibu.cli.shell.cold_start import first_run
from naibu.cli.shell.console import (
    BAD_INPUT,
    COMMANDS,
    FAILED,
    INTERRUPTED,
    app,
    errors,
    fail,
    print_table,
    progress_display,
    say,
    told_warnings,
)
from naibu.cli.shell.described import Flag
from naibu.cli.shell.failures import (
    OutputLostError,
    flush_output,
    leave_quietly,
    occupy_closed_streams,
    out_of_memory,
    output_lost,
    require_room,
    unexpected,
)
from naibu.cli.shell.option_names import in_options, usage_error
from naibu.cli.shell.run_record import RunRecord, current_run, recorded_run
from naibu.cli.shell.verbs import START, verb
from naibu.core.errors import ConvergenceError, NaibuError, WorkerLostError
from naibu.core.memory import is_out_of_memory
from naibu.workflows.results.output_folder import no_empty_folders

OUTPUT = Group("Output of every verb", sort_key=50)


@verb(START, "doctor", "doctor --self-test   # small cases whose answers are known", "doctor --warm        # compile everything now")
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


@app.meta.default
def launch(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    quiet: Annotated[Flag, Parameter(name=("--quiet", "-q"), group=OUTPUT)] = False,
    as_json: Annotated[Flag, Parameter(name="--json", group=OUTPUT)] = False,
    log: Annotated[Path | None, Parameter(group=OUTPUT)] = None,
    open_page: Annotated[Flag, Parameter(name="--open", group=OUTPUT)] = False,
) -> None:
    """Run a verb.

    Parameters
    ----------
    quiet
        Show only warnings and errors.
    as_json
        Print one JSON document to standard output (results, tables, files, exit code), and everything else to standard error.
    log
        Append every line, with its time, to this file.
    open_page
        Open the page of the results in the browser when it is written.
    """
    run = current_run()
    run.quiet, run.as_json, run.verb = quiet, as_json, tokens
    if log is not None:
        run.log_to(log)
    try:
        app(tokens, exit_on_error=False, print_error=False)
    finally:
        if open_page and (page := run.page()) is not None:
            webbrowser.open(page.resolve().as_uri())


app.meta.group_commands = COMMANDS
app.register_install_completion_command(name="--install-completion", group=COMMANDS)


def _verb() -> str:
    return next((word for word in sys.argv[1:] if not word.startswith("-")), "")


def _run() -> None:
    """Run the verb, and see that what it printed was taken."""
    with first_run(_verb(), errors):
        app.meta(sys.argv[1:], exit_on_error=False, print_error=False)


def main() -> None:
    """Run the command line; a user's mistake ends with one message and exit code 2, any other error with one message and code 1."""
    occupy_closed_streams()
    with recorded_run(sys.argv[1:]) as run, told_warnings():
        try:
            _ended()
            _finish(run, 0)
        except SystemExit as end:
            _finish(run, end.code if isinstance(end.code, int) else int(bool(end.code)))
            raise


def _finish(run: RunRecord, code: int) -> None:
    """Print the summary where it is wanted, and see that standard output took everything."""
    run.logged(f"exit code {code}")
    try:
        if run.as_json and sys.stdout is not None:
            sys.stdout.write(run.summary(code))
        if not code:
            flush_output()
    except OutputLostError as error:
        leave_quietly(str(error))
    except OSError as error:
        leave_quietly(f"standard output cannot be written ({error}); results in files are complete")


def _ended() -> None:
    """Run the verb; every error ends with its message and exit code."""
    try:
        with no_empty_folders():
            require_room(_verb())
            _run()
    except CycloptsError as error:
        fail(usage_error(" ".join(str(error).split()), app, current_run().verb), BAD_INPUT)
    except NaibuError as error:
        fail(
            in_options(str(error), app, current_run().verb), FAILED if isinstance(error, ConvergenceError | WorkerLostError) else BAD_INPUT
        )
    except KeyboardInterrupt:
        errors.print("Interrupted; every file written is complete. The same command resumes an identification.", soft_wrap=True)
        sys.exit(INTERRUPTED)
    except Exception as error:
        if is_out_of_memory(error):
            fail(out_of_memory(error, _verb()), FAILED)
        if output_lost(error):
            leave_quietly(f"standard output cannot be written ({error}); results in files are complete")
        fail(unexpected(error, _verb()), FAILED)
