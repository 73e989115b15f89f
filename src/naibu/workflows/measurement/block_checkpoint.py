"""What a measurement block by block has computed so far, in a folder: an interrupted run goes on from there, and workers share it.

Nothing that is read from it is executed (see `naibu.io.files.object_archive`).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from naibu._version import __version__
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.imaging import large_volumes
from naibu.io.files.atomic import write_atomically
from naibu.io.files.object_archive import packed, unpacked
from naibu.io.images import can_be_opened, open_volume, read_volume
from naibu.workflows.parallel.run_tasks import outcomes_in_order
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.parallel.worker_pool import WorkerPool

T = TypeVar("T")
_HEAD = "measurement.json"


@dataclass(frozen=True, slots=True)
class StoredVolume:
    """A volume in a file, which every process opens for itself.

    Attributes
    ----------
    path : str
        File or folder.
    spacing_mm : tuple of float, optional
        Voxel spacing along x, y, z, mm, for files without it.
    """

    path: str
    spacing_mm: tuple[float, ...] | None = None

    def opened(self) -> ChunkedVolume:
        """Open the volume; one of a format that cannot be read in parts is read whole."""
        return _opened(self)


@lru_cache(maxsize=4)
def _opened(volume: StoredVolume) -> ChunkedVolume:
    if can_be_opened(volume.path):
        return open_volume(volume.path, spacing_mm=volume.spacing_mm)
    return ChunkedVolume.of(read_volume(volume.path, spacing_mm=volume.spacing_mm))


Stored = tuple[StoredVolume, StoredVolume, StoredVolume | None]


class BlockCheckpoint:
    """Computes blocks on workers, and keeps every block and stage in a folder until the measurement is done.

    Parameters
    ----------
    folder : Path
        Where; on a cluster all workers reach it by this path.
    pair : tuple of StoredVolume
        Reference and deformed volume, and the mask or None.
    workers : Workers
        Where blocks are computed.
    pool : WorkerPool
        Processes that stay from one pass through the volumes to the next.
    memory_mb : float
        Memory that one block takes, MB.
    progress : callable, optional
        Progress over the blocks of a stage.
    """

    def __init__(self, folder: Path, pair: Stored, workers: Workers, pool: WorkerPool, memory_mb: float, progress: Progress | None) -> None:
        self.folder, self._pair, self._workers, self._pool = folder, pair, workers, pool
        self._memory_mb, self._progress = memory_mb, progress

    def begin(self, of: dict[str, Any], plan: dict[str, Any], *, resume: bool, overwrite: bool) -> dict[str, Any]:
        """Make the folder, or check that it is that of the same measurement, and return the plan of that.

        Parameters
        ----------
        of, plan : dict
            What the measurement depends on, and how it is divided, which may be otherwise when it is resumed.
        resume, overwrite : bool
            Whether an interrupted measurement goes on, or is begun anew.

        Raises
        ------
        InputError
            Nothing to resume, something that could be, or another measurement.
        """
        head = self.folder / _HEAD
        told = {"naibu": __version__, "code": _digest_of_code()} | of
        whole = json.dumps({"of": told, "plan": plan}, indent=1) + "\n"
        if resume:
            if not head.is_file():
                raise InputError(f"{self.folder}: does not exist, so there is nothing to resume; run without `resume`")
            try:
                there = json.loads(head.read_text(encoding="utf-8"))
            except ValueError:
                there = {}
            if there.get("of") != json.loads(whole)["of"]:
                raise InputError(
                    f"{self.folder}: was kept with other settings, inputs or another version of naibu; put them back, or run without "
                    "`resume`, and with `overwrite`"
                )
            return dict(there["plan"])
        if self.folder.exists() and not overwrite:
            raise InputError(
                f"{self.folder}: is what an interrupted measurement can be resumed from; continue it with `resume`, begin anew with "
                "`overwrite`, or choose another folder as `out`"
            )
        shutil.rmtree(self.folder, ignore_errors=True)
        write_atomically(head, whole)
        return plan

    def with_deformed(self, deformed: StoredVolume) -> BlockCheckpoint:
        """Return the same, with blocks of another deformed volume."""
        pair = self._pair[0], deformed, self._pair[2]
        return BlockCheckpoint(self.folder, pair, self._workers, self._pool, self._memory_mb, self._progress)

    def kept(self, name: str, compute: Callable[[], T]) -> T:
        """Return what was kept under a name, or compute it and keep it; the blocks of that name are then no longer needed."""
        path = self.folder / f"{name}.npz"
        if path.is_file():
            return _loaded(path)  # type: ignore[no-any-return]
        value = compute()
        write_atomically(path, packed(value))
        shutil.rmtree(self.folder / name, ignore_errors=True)
        return value

    def each(self, name: str, function: Callable[..., T], shared: Sequence[Any], items: Sequence[Any]) -> Iterator[T]:
        """Yield ``function(reference, deformed, mask, *shared, item)`` for all items, in their order, while workers compute later ones.

        What was kept of an interrupted run is not computed again.
        """
        place = self.folder / name
        common = place / "shared.npz"
        if not common.is_file():
            write_atomically(common, packed(tuple(shared)))
        paths = [place / f"{k:06d}.npz" for k in range(len(items))]
        there = {path for path in paths if path.is_file()}
        tasks = [
            Task(
                f"{name}, block {k + 1}",
                kept_block,
                {"pair": self._pair, "function": function, "common": common, "item": item, "path": path},
            )
            for k, (item, path) in enumerate(zip(items, paths, strict=True))
            if path not in there
        ]
        outcomes = outcomes_in_order(
            tasks, self._workers, memory_mb=self._memory_mb, stage=name, finished=_raise_what_failed, progress=self._progress,
            pool=self._pool,
        )  # fmt: skip
        with closing(outcomes):
            for path in paths:
                if path not in there:
                    next(outcomes)
                yield _loaded(path)
            next(outcomes, None)  # they end by themselves, and the processes of the pool stay

    def forget(self, first: str) -> None:
        """Remove the folder of a measurement that was refused before what is kept as `first` was computed: nothing is worth resuming."""
        if not (self.folder / f"{first}.npz").is_file():
            self.remove()

    def remove(self) -> None:
        """Remove the folder: the measurement is done."""
        shutil.rmtree(self.folder, ignore_errors=True)


def kept_block(
    *,
    pair: Stored,
    function: Callable[..., Any],
    common: Path,
    item: Any,
    path: Path,
    progress: Progress | None,
) -> None:
    """Compute what a function makes of a block of both volumes, and write it to a file."""
    shared = _shared(common, os.stat(common).st_mtime_ns)
    write_atomically(path, packed(function(*(None if v is None else v.opened() for v in pair), *shared, item)))


def _raise_what_failed(_: int, outcome: Outcome) -> None:
    """Stop at the first block that cannot be computed."""
    outcome.value()


@lru_cache(maxsize=1)
def _digest_of_code() -> str:
    """Return a digest of the modules that compute blocks: sums of another code must not be added to those of this one."""
    imaging = Path(large_volumes.__file__).parent.parent
    files = sorted(file for room in ("large_volumes", "volume_correlation", "preprocessing") for file in (imaging / room).rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


@lru_cache(maxsize=1)
def _shared(common: Path, changed: int) -> tuple[Any, ...]:
    return tuple(_loaded(common))


def _loaded(path: Path) -> Any:
    try:
        return unpacked(path)
    except InputError as error:
        raise InputError(f"{error}; run without `resume`, and with `overwrite`") from error
