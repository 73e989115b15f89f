"""Damage to files: the mutations that transfers, editors, other programs and attackers make."""

from __future__ import annotations

import re

import numpy as np

NUMBERS = (
    b"0",
    b"-1",
    b"nan",
    b"inf",
    b"1e308",
    b"-1e-308",
    b"1099511627776",
    b"9" * 30,
    b"",
    b"0.5",
    b"abc",
    b"7 7",
    b"1e-300",
    b"2147483648",
)
WORDS = (b"", b"LIST", b"true", b"../../etc/hosts", b"<!--<script>", b"\xff\xfe", b"%03d", b"\0\0\0\0", b"[[[[[[[[", b"{" * 40)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{3,}")


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return content with one to three kinds of damage, never the same bytes."""
    damaged = content
    for _ in range(int(rng.integers(1, 4))):
        damaged = MUTATIONS[int(rng.integers(len(MUTATIONS)))](damaged, rng)
    return damaged if damaged != content else content[: len(content) // 2]


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: int(rng.integers(len(content) + 1))]


def _flipped(content: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        if damaged:
            damaged[int(rng.integers(len(damaged)))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def _overwritten(content: bytes, rng: np.random.Generator) -> bytes:
    """Put a run of equal or random bytes somewhere."""
    at, n = int(rng.integers(len(content) + 1)), int(rng.integers(1, 17))
    run = rng.bytes(n) if rng.random() < 0.5 else bytes([int(rng.choice([0, 255, 127, 128]))]) * n
    return content[:at] + run + content[at + n :]


def _inserted(content: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(content) + 1))
    return content[:at] + rng.bytes(int(rng.integers(1, 33))) + content[at:]


def _removed(content: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(content) + 1))
    return content[:at] + content[at + int(rng.integers(1, 65)) :]


def _doubled(content: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(content) + 1))
    return content[:at] + content[max(at - int(rng.integers(1, 129)), 0) : at] + content[at:]


def _number_replaced(content: bytes, rng: np.random.Generator) -> bytes:
    return _one_replaced(_NUMBER, NUMBERS, content, rng)


def _word_replaced(content: bytes, rng: np.random.Generator) -> bytes:
    return _one_replaced(_WORD, WORDS, content, rng)


def _line_removed(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    del lines[int(rng.integers(len(lines)))]
    return b"\n".join(lines)


def _line_repeated(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    at = int(rng.integers(len(lines)))
    return b"\n".join([*lines[:at], lines[at], *lines[at:]])


def _one_replaced(pattern: re.Pattern[bytes], choices: tuple[bytes, ...], content: bytes, rng: np.random.Generator) -> bytes:
    found = list(pattern.finditer(content[:100_000]))
    if not found:
        return _flipped(content, rng)
    match = found[int(rng.integers(len(found)))]
    return content[: match.start()] + choices[int(rng.integers(len(choices)))] + content[match.end() :]


MUTATIONS = (
    _cut, _flipped, _overwritten, _inserted, _removed, _doubled, _number_replaced, _number_replaced, _number_replaced,
    _word_replaced, _line_removed, _line_repeated,
)  # fmt: skip
