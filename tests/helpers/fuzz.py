"""Damage valid files at random and read them: ``python tests/helpers/fuzz.py [--seed 1] [--count 200] [--kind ply]``.

Every reader must return, or raise one of naibu's own errors, within five seconds and with little memory. Prints how often which happened
for each kind of file, and every foreign exception once with the line that raised it; the exit status is 1 where there was one.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import logging
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent)]

from damaged_files import mutated  # noqa: E402  they stand beside the tests
from valid_files import ValidFile, valid_files  # noqa: E402

from naibu.core.errors import NaibuError  # noqa: E402

LONGEST_S = 5.0
MOST_MEMORY = 6 << 30  # bytes of address space: what a file merely announces must not be allocated


class TooSlowError(BaseException):
    """A reader took longer than `LONGEST_S`."""


def outcome(file: ValidFile, content: bytes) -> str:
    """Read a file with other content; return "read", "refused", or what went wrong and where."""
    before = file.target.read_bytes()
    file.target.write_bytes(content)
    try:
        with time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            file.read()
    except NaibuError as error:
        return "refused" if str(error).strip() else "refused without a word"
    except (Exception, TooSlowError) as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "naibu" in frame.filename and "helpers" not in frame.filename]
        at = ours[-1] if ours else frames[-1]
        return f"{type(error).__name__} at {at.filename.rpartition('naibu/')[2]}:{at.lineno}: {str(error)[:80]}"
    finally:
        file.target.write_bytes(before)
    return "read"


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TooSlowError(f"more than {LONGEST_S:g} s")

    earlier = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, earlier)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200, help="mutations of each file")
    parser.add_argument("--kind", default="", help="only kinds whose name contains this")
    arguments = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    logging.disable()  # libraries tell there what they also raise
    foreign: collections.Counter[str] = collections.Counter()
    total = 0
    with tempfile.TemporaryDirectory() as folder:
        for number, file in enumerate(valid_files(Path(folder))):
            if arguments.kind not in file.kind:
                continue
            file.read()  # what is not damaged is read
            rng = np.random.default_rng([arguments.seed, number])
            content = file.target.read_bytes()
            found = collections.Counter(outcome(file, mutated(content, rng)) for _ in range(arguments.count))
            total += arguments.count
            bad = {what: n for what, n in found.items() if what not in ("read", "refused")}
            foreign.update({f"{file.kind}: {what}": n for what, n in bad.items()})
            print(f"{file.kind:44s} read {found['read']:5d}  refused {found['refused']:5d}  other {sum(bad.values()):5d}", flush=True)
    print(f"{total} mutations, {sum(foreign.values())} foreign exceptions or hangs")
    for what, n in foreign.most_common():
        print(f"{n:6d}  {what}")
    sys.exit(bool(foreign))


if __name__ == "__main__":
    main()
