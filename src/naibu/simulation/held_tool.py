"""What holds a tool back from where a hand leads it: rigid fixtures, and cells that are crushed.

The place to which a hand leads the tool and the one where it is simulated are two, as in the god-object method :cite:p:`zilles1995`: the
tool does not enter a plane, however far the hand does, and slides along it. Springs of a lattice that are compressed to nothing no longer
resist, and elements that are turned inside out have no balance: the tool would pass through the surface as if there were none. So it
advances against the body the more slowly the less is left of a cell's thickness, rests before that is used up, and goes back as ever.
Between two looks at all cells it is foretold what is left of them, and the velocity does not leap: viscous bodies feel that at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, length_of
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.simulation.crushed_cells import CrushedCells
from naibu.simulation.interactive_bodies import InteractiveBody

CRUSHED = 0.1  # least principal stretch at which a tool advances no farther
WATCHED = 0.6  # from which on it is slowed
SHARE = 0.5  # of the way that is left, in the time in which all cells are looked at
FADE = 0.9  # of the rate of crushing, from one look at all cells to the next
AT_FIRST = 2.0  # rate of crushing before one was seen, over the extent of the body
LEAST_ADVANCE = 1e-3  # of the extent of the body, from which on an advance shows a rate
QUICK = 2.0  # of the changes of velocity of a tool that is held back, over the time in which all cells are looked at
MOST_CELLS = 10_000  # looked at in a frame
BACK = 0.5  # cosine of the angle to the force of the body from which on a tool goes back, and freely
HELD_BELOW = 0.5  # of the way that is wanted: a tool that goes less is said to be held back


def outside_planes(fixtures: Sequence[RigidIndenter], tool: RigidIndenter, centre: FloatArray) -> FloatArray:
    """Return the place (3,), mm, nearest to a centre of a tool at which the tool is in none of the fixtures that are planes.

    Parameters
    ----------
    fixtures : sequence of RigidIndenter
        Of which the planes are kept to.
    tool : RigidIndenter
        Turned as it is to be; one that has no end is not kept out.
    centre : ndarray, shape (3,)
        Where it is led, mm.
    """
    for fixture in fixtures:
        if fixture.geometry.flat:
            normal = fixture.geometry.normal
            reach = tool.geometry.reach(-normal)
            depth = reach - float((centre - fixture.centre) @ normal)
            if np.isfinite(reach) and depth > 0.0:
                centre = centre + depth * normal
    return centre


@dataclass(slots=True, eq=False)
class HeldTool:
    """How far a tool may go on against a body.

    Attributes
    ----------
    cells : CrushedCells
        Of the body.
    extent_mm : float
        Of the body.
    smoothing : float
        Share of a change that the velocity at which the tool is held back, and the direction of the force, take in a frame.
    held : bool
        Whether the tool was held back in the last frame.
    """

    cells: CrushedCells
    extent_mm: float
    smoothing: float = 1.0
    held: bool = field(init=False, default=False)
    _least: float = field(init=False, default=WATCHED)  # stretch of any cell
    _before: float = field(init=False, default=WATCHED)  # when all cells had been looked at last
    _place: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))  # of the cell with the least, mm
    _next_place: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))
    _seen: float = field(init=False, default=np.inf)  # in the parts that were looked at since
    _part: int = field(init=False, default=0)
    _advanced: float = field(init=False, default=0.0)  # against the body since all cells were looked at, mm
    _since: float = field(init=False, default=0.0)  # the same since the least stretch was seen, mm
    _pace: float = field(init=False, default=np.inf)  # advance in a frame at which it is held back, mm
    _force: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))  # of the tool on the body, smoothed, mN
    _rate: float = field(init=False, default=0.0)  # stretch that an advance costs, 1/mm

    @classmethod
    def by(cls, body: InteractiveBody, frame_s: float, look_s: float) -> HeldTool:
        """Return what holds a tool back from a body of which all cells are looked at in a time, s, or in more where there are many."""
        parts = max(round(look_s / frame_s), -(-len(body.cells) // MOST_CELLS), 1)
        extent = float(np.ptp(body.points, axis=0).max())
        cells = CrushedCells.of(body.points, body.cells, parts)
        cells.least_stretch(body.points, 0, WATCHED)  # compiled before the first contact
        return cls(cells, extent, min(1.0, QUICK * frame_s / look_s))

    @property
    def crushed(self) -> bool:
        """Whether a cell has nothing left to be compressed."""
        return self._least <= CRUSHED

    def limited(self, centre: FloatArray, way: FloatArray) -> FloatArray:
        """Return how far a tool goes in a frame (3,), mm.

        Parameters
        ----------
        centre : ndarray, shape (3,)
            Where it is, mm.
        way : ndarray, shape (3,)
            That is wanted, mm.
        """
        self.held = False
        advance = self._advance(centre, way)
        if advance <= 0.0 or self._least >= WATCHED:
            self._pace = max(advance, 0.0)
            return way
        stretch = self._least - self._rate * self._since
        left = SHARE * max(stretch - CRUSHED, 0.0) / max(self._rate, AT_FIRST / self.extent_mm) / len(self.cells.cells)
        self._pace += self.smoothing * (left - self._pace)
        self.held = self._pace < HELD_BELOW * advance
        return way if advance <= self._pace else np.asarray(way * (self._pace / advance))

    def observe(self, positions: FloatArray, centre: FloatArray, way: FloatArray, force: FloatArray) -> None:
        """Take note of a frame: nodes (n, 3), mm, and the tool's centre (3,), mm, at its end, its way and its force on the body."""
        if not force.any():
            self._least, self._before, self._seen, self._part, self._advanced, self._rate = WATCHED, WATCHED, np.inf, 0, 0.0, 0.0
            self._since, self._force = 0.0, np.zeros(3)
            return
        self._force = self._force + (self.smoothing if self._force.any() else 1.0) * (force - self._force)
        advanced = max(self._advance(centre - way, way), 0.0)
        self._advanced += advanced
        self._since += advanced
        found, place = self.cells.least_stretch(positions, self._part, WATCHED)
        if found < self._seen:
            self._seen, self._next_place = found, place
        self._part += 1
        if self._seen < self._least:
            self._least, self._place, self._since = self._seen, self._next_place, 0.0
        if self._part == len(self.cells.cells):
            self._look_again()

    def _look_again(self) -> None:
        """Take note of what all parts have shown, and begin with the first one again."""
        now = min(self._seen, WATCHED)
        self._rate *= FADE
        if self._advanced > LEAST_ADVANCE * self.extent_mm:
            self._rate = max(self._rate, (self._before - now) / self._advanced)
        self._least, self._before, self._place = now, now, self._next_place
        self._seen, self._part, self._advanced, self._since = np.inf, 0, 0.0, 0.0

    def _advance(self, centre: FloatArray, way: FloatArray) -> float:
        """Return how far a way leads against the body, mm: along the force on it, or to the cell that is crushed most."""
        size, to_cell = length_of(self._force), self._place - centre
        if size == 0.0:
            return 0.0
        along = float(way @ self._force) / size
        if along < -BACK * length_of(way):
            return 0.0
        return max(along, float(way @ to_cell) / max(length_of(to_cell), 1e-9))
