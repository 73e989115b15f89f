"""What people do on the live page, at random but repeatable: messages of the page, also out of order, and frames between them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.simulation import InteractiveSimulation

FRAME = ""  # instead of a message: the next frame
JUNK = (
    "", "{", "[]", "null", '{"type": "explode"}', '{"type": "move"}', '{"type": "move", "at": [1, 2]}',
    '{"type": "move", "at": [NaN, 0, 0]}', '{"type": "move", "at": [Infinity, 0, 0]}', '{"type": "pull", "at": [0, 0, 1e300]}',
    '{"type": "turn", "by": [9, 0, 0]}', '{"type": "grip", "node": -1}', '{"type": "grip", "node": true}',
    '{"type": "grip", "node": 2147483647}', '{"type": "tool", "name": "axe"}', '{"type": "cut", "edges": []}',
    '{"type": "cut", "edges": [[[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]]}',
    '{"type": "cut", "edges": [[[0, 0, 0], [9, 0, 0]], [[0, 0, 0], [NaN, 0, 0]]]}', '{"type": "pause", "on": 1}', "[" * 5000,
)  # fmt: skip


@dataclass(slots=True)
class RestlessHands:
    """A person at the page, drawn at random.

    Attributes
    ----------
    simulation : InteractiveSimulation
        What is on the page.
    rng : numpy.random.Generator
        Draws what is done.
    cuts : bool
        Whether blades are used.
    """

    simulation: InteractiveSimulation
    rng: np.random.Generator
    cuts: bool = True
    _last_cut: list[Any] = field(init=False, default_factory=list)

    def messages(self) -> Iterator[str]:
        """Yield messages as the page sends them, and `FRAME` where it waits for the next frame; without end."""
        habits: list[tuple[float, Callable[[], Iterator[str]]]] = [
            (5.0, self.press), (1.5, self.rush), (1.0, self.plunge), (2.0, self.pull), (1.0, self.change_tool),
            (0.7, self.turn_while_pressing), (1.0, self.undo), (0.4, self.reset), (0.5, self.pause), (0.5, self.record),
            (0.7, self.junk), (1.0, self.wait),
            (2.0 if self.cuts else 0.0, self.cut),
        ]  # fmt: skip
        weights = np.array([weight for weight, _ in habits])
        while True:
            yield from habits[self.rng.choice(len(habits), p=weights / weights.sum())][1]()

    def press(self) -> Iterator[str]:
        """Bring a tool to the surface from outside, press, hold or slide, and go back, jump away or stay."""
        if not self.simulation.last.tool or self.rng.random() < 0.3:
            yield from self.change_tool()
        at, outwards = self._place_on_the_surface()
        start, depth = at + outwards * self._length(0.3, 0.6), self._length(0.05, 0.6)
        if self.rng.random() < 0.1:
            depth = self._length(0.6, 1.6)
        end = at - outwards * depth
        yield from self._led(self._position(), start, 12)
        yield from self._led(start, end, int(self.rng.integers(3, 50)))
        yield from self._frames(int(self.rng.integers(0, 20)))
        what = self.rng.random()
        if what < 0.3:
            aside = end + np.cross(outwards, self._direction()) * self._length(0.1, 0.8)
            yield from self._led(end, aside, int(self.rng.integers(5, 40)))
        elif what < 0.6:
            yield from self._led(end, start, int(self.rng.integers(2, 30)))
        elif what < 0.8:
            yield _said("move", at=self._anywhere())
            yield from self._frames(10)

    def rush(self) -> Iterator[str]:
        """Lead the tool from place to place faster than it may move."""
        for _ in range(self.rng.integers(1, 6)):
            yield _said("move", at=self._anywhere())
            yield from self._frames(int(self.rng.integers(0, 12)))

    def plunge(self) -> Iterator[str]:
        """Lead the tool into the middle of the body."""
        yield _said("move", at=self.simulation.last.positions.mean(axis=0))
        yield from self._frames(int(self.rng.integers(5, 40)))

    def pull(self) -> Iterator[str]:
        """Grip a point, pull it, shake it, and mostly let go."""
        node = int(self.rng.choice(self.simulation.last.surface))
        yield _said("grip", node=node)
        at = self.simulation.last.positions[node]
        for _ in range(self.rng.integers(1, 4)):
            goal = at + self._direction() * self._length(0.02, 1.2 if self.rng.random() < 0.3 else 0.4)
            yield from self._led(at, goal, int(self.rng.integers(1, 40)), "pull")
            at = goal
        if self.rng.random() < 0.85:
            yield _said("release")
        yield from self._frames(int(self.rng.integers(0, 15)))

    def change_tool(self) -> Iterator[str]:
        """Take another tool, or put it away."""
        yield _said("tool", name=str(self.rng.choice([*self.simulation.tools, *self.simulation.tools, ""])))
        yield from self._frames(int(self.rng.integers(0, 6)))

    def turn_while_pressing(self) -> Iterator[str]:
        """Turn the tool where it is."""
        for _ in range(self.rng.integers(1, 8)):
            yield _said("turn", by=self._direction() * self.rng.uniform(0.0, 1.0))
            yield from self._frames(int(self.rng.integers(0, 8)))

    def undo(self) -> Iterator[str]:
        """Take back once or several times, some frames apart."""
        for _ in range(self.rng.integers(1, 4)):
            yield _said("undo")
            yield from self._frames(int(self.rng.integers(0, 4)))

    def reset(self) -> Iterator[str]:
        """Begin anew."""
        yield _said("reset")
        yield FRAME

    def pause(self) -> Iterator[str]:
        """Pause, do something meanwhile, and go on."""
        yield _said("pause", on=True)
        yield _said("move", at=self._anywhere())
        yield from self._frames(2)
        if self.rng.random() < 0.3:
            yield _said("undo")
        yield _said("pause", on=False)

    def record(self) -> Iterator[str]:
        """Record what comes, or stop and show it."""
        yield _said("record", on=bool(self.rng.random() < 0.5))
        if self.rng.random() < 0.3:
            yield _said("replay")
        yield FRAME

    def junk(self) -> Iterator[str]:
        """Send what no page sends, and what is out of order."""
        yield str(self.rng.choice(JUNK))
        yield _said(str(self.rng.choice(["release", "undo", "replay"])))
        yield _said("pull", at=self._anywhere())
        yield _said("colour", name="strain")

    def wait(self) -> Iterator[str]:
        """Look at it."""
        yield from self._frames(int(self.rng.integers(1, 40)))

    def cut(self) -> Iterator[str]:
        """Draw the path of a blade on the screen: across, to the middle, around a piece, in waves, or once more where it was."""
        if not self._last_cut or self.rng.random() < 0.85:
            self._last_cut = self._blade()
        yield _said("cut", edges=self._last_cut)
        yield from self._frames(int(self.rng.integers(0, 25)))

    def _blade(self) -> list[Any]:
        points, extent = self.simulation.last.positions, self.simulation.extent_mm
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0)) + self.rng.normal(size=3) * 0.12 * extent
        away = self._direction()
        right = _unit(np.cross(away, self._direction()))
        up, drawn = np.cross(away, right), int(self.rng.integers(2, 25))
        along = np.linspace(-1.0, 1.0, drawn)
        path = np.stack([along, np.zeros(drawn)], axis=1) * extent
        match self.rng.choice(["across", "partly", "around", "waves", "scribble"]):
            case "partly":
                path[:, 0] = np.linspace(-extent, self.rng.uniform(-0.3, 0.3) * extent, drawn)
            case "around":
                angle = np.linspace(0.0, 2.0 * math.pi, max(drawn, 8))
                path = np.stack([np.cos(angle), np.sin(angle)], axis=1) * extent * self.rng.uniform(0.15, 0.5)
            case "waves":
                path[:, 1] = 0.1 * extent * np.sin(self.rng.uniform(1.0, 8.0) * along)
            case "scribble":
                path = np.cumsum(self.rng.normal(size=(drawn, 2)), axis=0) * 0.15 * extent
        places = middle + path[:, :1] * right + path[:, 1:] * up
        deep = 1.5 * extent if self.rng.random() < 0.8 else self._length(0.05, 0.4)  # as the page has it, or a short blade
        return [[(place - deep * away).tolist(), (place + deep * away).tolist()] for place in places]

    def _led(self, start: FloatArray, end: FloatArray, frames: int, kind: str = "move") -> Iterator[str]:
        for k in range(1, frames + 1):
            yield _said(kind, at=start + (end - start) * (k / frames))
            yield FRAME

    def _frames(self, count: int) -> Iterator[str]:
        for _ in range(count):
            yield FRAME

    def _position(self) -> FloatArray:
        return self.simulation.last.tool_centre

    def _place_on_the_surface(self) -> tuple[FloatArray, FloatArray]:
        faces: IntArray = self.simulation.body.faces
        a, b, c = self.simulation.last.positions[faces[self.rng.integers(len(faces))]]
        return np.asarray((a + b + c) / 3.0), _unit(np.cross(b - a, c - a))

    def _anywhere(self) -> FloatArray:
        return self.simulation.body.points.mean(axis=0) + self.rng.uniform(-1.5, 1.5, 3) * self.simulation.extent_mm

    def _direction(self) -> FloatArray:
        return _unit(self.rng.normal(size=3))

    def _length(self, least: float, most: float) -> float:
        return float(self.rng.uniform(least, most)) * self.simulation.extent_mm


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-30))


def _said(kind: str, **values: Any) -> str:
    plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
    return json.dumps({"type": kind, **plain})
