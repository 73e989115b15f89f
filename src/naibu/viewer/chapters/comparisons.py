"""What a source says beside what was found: whether they agree, and why not; the table with which a page opens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from naibu.viewer.cards import Card
from naibu.viewer.tables import Table

Verdict = Literal["agrees", "differs", "cannot be compared"]
_WORDS: dict[Verdict, str] = {"agrees": "Agree", "differs": "Differ", "cannot be compared": "Cannot be compared"}


@dataclass(frozen=True, slots=True)
class Comparison:
    """One statement of a source beside ours.

    Attributes
    ----------
    what : str
        The quantity or statement, and where it is printed.
    paper, ours : str
        Both, with units.
    verdict : {"agrees", "differs", "cannot be compared"}
        Whether they agree.
    why : str
        Why they differ, or under what assumption they agree.
    """

    what: str
    paper: str
    ours: str
    verdict: Verdict
    why: str = ""


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """Return the statements as a table."""
    rows = tuple((c.what, c.verdict, c.paper, c.ours, c.why) for c in comparisons)
    return Table("Paper and ours", ("what", "verdict", "paper", "ours", "why"), rows)


def comparison_cards(comparisons: Sequence[Comparison]) -> tuple[Card, ...]:
    """Return how many statements agree, differ, and cannot be compared."""
    counts = {verdict: sum(c.verdict == verdict for c in comparisons) for verdict in _WORDS}
    return tuple(Card(_WORDS[v], f"{n} of {len(comparisons)}", "statements of the paper") for v, n in counts.items() if n)
