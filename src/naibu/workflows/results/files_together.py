"""Files of one run take their places together: a folder never holds some of this run and some of an earlier one."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Collection, Iterable
from pathlib import Path

from naibu.core.errors import InputError
from naibu.io.files.atomic import new_folder_aside


def written_together(folder: Path, names: Collection[str], write: Callable[[Path], Iterable[Path] | None]) -> tuple[Path, ...]:
    """Write files where no reader looks, and then move all of them to a folder.

    Where one of them cannot be written (a full disk), all those of an earlier run stay as they were. Where there was no earlier run, the
    files that were finished are kept.

    Parameters
    ----------
    folder : Path
        Where the files belong; it exists.
    names : collection of str
        Names of the files of a run.
    write : callable
        Writes them to the folder that it is given, and may return their paths, in the order in which they are told.

    Returns
    -------
    tuple of Path
        The files in their places.

    Raises
    ------
    InputError
        One of them cannot be written.
    """
    earlier = any(os.path.lexists(folder / name) for name in names)
    aside = new_folder_aside(folder)
    try:
        told = list(write(aside) or ())
        _moved(aside, folder)
    except InputError as error:
        kept = f"; the earlier results in {folder} are as they were" if earlier else ""
        raise InputError(str(error).replace(str(aside), str(folder)) + kept) from error
    finally:
        if not earlier:
            with contextlib.suppress(InputError):  # what failed is told above
                _moved(aside, folder)
        shutil.rmtree(aside, ignore_errors=True)
    return tuple(folder / path.relative_to(aside) for path in told)


def _moved(aside: Path, folder: Path) -> None:
    for path in sorted(aside.iterdir()):
        try:
            path.replace(folder / path.name)
        except OSError as error:
            raise InputError(f"{folder / path.name}: cannot be written ({error.strerror or error}); choose another folder") from error
