"""Chunks of the rows of a large matrix, worked on by the threads of a pool."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import Any

import numba
import numpy as np

CHUNKS = 4  # whatever the number of threads: results do not depend on it
LEAST_ROWS = 4_000  # of a matrix, below which its chunks are worked on in turn


class RowChunks:
    """Consecutive rows of a matrix, divided into chunks of about as many stored blocks.

    Parameters
    ----------
    indptr : ndarray, shape (n + 1,)
        Where the blocks of each row begin.
    """

    def __init__(self, indptr: np.ndarray[Any, Any]) -> None:
        n = len(indptr) - 1
        count = CHUNKS if n >= LEAST_ROWS else 1
        inner = np.searchsorted(indptr, indptr[-1] * np.arange(1, count) / count)
        self.bounds = [0, *(int(i) for i in inner), n]

    def run(self, kernel: Callable[..., Any], *arguments: Any, sizes: tuple[Any, ...]) -> None:
        """Call ``kernel(*arguments, start, stop, *sizes)`` for every chunk; the kernel releases the global interpreter lock."""
        pairs = list(zip(self.bounds[:-1], self.bounds[1:], strict=True))
        threads = min(numba.get_num_threads(), len(pairs))
        if threads == 1:
            for start, stop in pairs:
                kernel(*arguments, start, stop, *sizes)
            return
        pool = _pool(threads - 1)
        others = [pool.submit(_in_turn, kernel, arguments, pairs[k::threads], sizes) for k in range(1, threads)]
        try:
            _in_turn(kernel, arguments, pairs[::threads], sizes)
        finally:
            wait(others)
        for other in others:
            other.result()


def _in_turn(kernel: Callable[..., Any], arguments: tuple[Any, ...], pairs: list[tuple[int, int]], sizes: tuple[Any, ...]) -> None:
    for start, stop in pairs:
        kernel(*arguments, start, stop, *sizes)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rows of a matrix")
