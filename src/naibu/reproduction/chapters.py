"""The chapters that can be reproduced, by name."""

from __future__ import annotations

from collections.abc import Callable

from naibu.reproduction.chapter import Chapter

CHAPTERS: dict[str, Callable[[int], Chapter]] = {}
