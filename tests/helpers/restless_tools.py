"""What hands do with the tool of a surface cutter, at random but repeatable."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.meshing import SurfaceCutter


@dataclass(slots=True)
class RestlessTool:
    """A tool in restless hands.

    Attributes
    ----------
    cutter : SurfaceCutter
        What it cuts; replaced by a copy now and then.
    points, triangles : ndarray, shapes (n, 3) and (t, 3)
        The surface as it was, mm: the tool stays near it, or leaves it on purpose.
    rng : numpy.random.Generator
        Draws what is done.
    strokes : list of list of ndarray
        Positions of the tip (3,), mm, in each contact so far.
    """

    cutter: SurfaceCutter
    points: FloatArray
    triangles: IntArray
    rng: np.random.Generator
    strokes: list[list[FloatArray]] = field(init=False, default_factory=lambda: [[]])

    def use(self, habits: int) -> None:
        """Do this many things one after another."""
        known: list[tuple[float, Callable[[], None]]] = [
            (4.0, self.stroke), (1.0, self.wave), (1.0, self.circle), (1.5, self.scribble), (1.0, self.again), (0.7, self.rest),
            (0.7, self.hover), (1.5, self.lift), (0.5, self.jump), (0.3, self.nonsense), (0.5, self.copy), (0.5, self.look),
        ]  # fmt: skip
        weights = np.array([weight for weight, _ in known])
        for _ in range(habits):
            known[self.rng.choice(len(known), p=weights / weights.sum())][1]()

    def stroke(self) -> None:
        """Go straight from one place to another, in steps of any length."""
        self._led(self._line(self._near(), self._near(), int(self.rng.integers(1, 40))))

    def wave(self) -> None:
        """Go from one place to another in waves."""
        way = self._line(self._near(), self._near(), int(self.rng.integers(10, 80)))
        across, size = np.cross(way[-1] - way[0], self.rng.normal(size=3)), self.rng.uniform(0.2, 4.0) * self.cutter.distance_mm
        across /= max(float(np.linalg.norm(across)), 1e-300)
        self._led(way + size * np.sin(np.linspace(0.0, self.rng.uniform(3.0, 30.0), len(way)))[:, None] * across)

    def circle(self) -> None:
        """Cut around a place of the surface, once or more, or not quite."""
        _, normal = middle = self._place()
        right = np.cross(normal, self.rng.normal(size=3))
        right /= max(float(np.linalg.norm(right)), 1e-300)
        up, radius = np.cross(normal, right), self.rng.uniform(0.5, 8.0) * self.cutter.distance_mm
        angle = np.linspace(0.0, 2.0 * np.pi * self.rng.choice([0.9, 1.0, 1.0, 1.1, 2.0]), int(self.rng.integers(6, 60)))[:, None]
        self._led(middle[0] + radius * (np.cos(angle) * right + np.sin(angle) * up))

    def scribble(self) -> None:
        """Go to and fro at random, in small steps."""
        steps = self.rng.normal(size=(int(self.rng.integers(2, 40)), 3)) * self.rng.uniform(0.05, 1.5) * self.cutter.distance_mm
        self._led(self._at() + np.cumsum(steps, axis=0))

    def again(self) -> None:
        """Go where the tool has been, forwards or back."""
        known = [stroke for stroke in self.strokes if len(stroke) > 1]
        if known:
            stroke = known[self.rng.integers(len(known))]
            self._led(np.array(stroke[:: self.rng.choice([-1, 1])]))

    def rest(self) -> None:
        """Stay where it is."""
        self._led(np.repeat(self._at()[None], int(self.rng.integers(1, 5)), axis=0))

    def hover(self) -> None:
        """Leave the surface, on its outside, and come back elsewhere."""
        above = self.points.mean(axis=0) + 3.0 * np.ptp(self.points, axis=0).max() * self._direction()
        self._led(np.stack([above, self._near()]))

    def lift(self) -> None:
        """Take the tool off, also twice."""
        for _ in range(self.rng.integers(1, 3)):
            self.cutter.lift()
        self.strokes.append([])

    def jump(self) -> None:
        """Go on somewhere else, in one step."""
        self._led(self._near()[None])

    def nonsense(self) -> None:
        """Ask for what no tool can do, which is refused and changes nothing."""
        for tip in ([np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0]):
            try:
                self.cutter.move(tip)
            except InputError:
                continue
            raise AssertionError(f"{tip} was taken for a position")

    def copy(self) -> None:
        """Go on with a copy, and let the first one be cut to pieces."""
        first, self.cutter = self.cutter, deepcopy(self.cutter)
        for _ in range(3):
            first.move(self._near())

    def look(self) -> None:
        """Ask for the surface in between, which takes the tool off."""
        self.cutter.result()
        self.strokes.append([])

    def _led(self, way: FloatArray) -> None:
        for tip in way:
            self.cutter.move(tip)
            self.strokes[-1].append(np.array(tip))

    def _line(self, start: FloatArray, end: FloatArray, steps: int) -> FloatArray:
        return np.asarray(start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start))

    def _at(self) -> FloatArray:
        known = [tip for stroke in self.strokes for tip in stroke]
        return known[-1] if known else self._near()

    def _near(self) -> FloatArray:
        """Return a place on the surface, above or below it within reach of the tip, beyond its border, or beside it."""
        place, normal = self._place()
        what = self.rng.random()
        if what < 0.5:
            return place
        if what < 0.8:
            return np.asarray(place + self.rng.uniform(-1.2, 1.2) * self.cutter.reach_mm * normal)
        middle = self.points.mean(axis=0)
        return np.asarray(middle + self.rng.uniform(1.0, 1.5) * (place - middle))

    def _place(self) -> tuple[FloatArray, FloatArray]:
        """Return a place on the surface, also exactly in a vertex or on an edge, and its normal."""
        a, b, c = self.points[self.triangles[self.rng.integers(len(self.triangles))]]
        shares = self.rng.dirichlet([1.0, 1.0, 1.0])
        if self.rng.random() < 0.2:
            shares = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.3, 0.7]])[self.rng.integers(3)]
        normal = np.cross(b - a, c - a)
        return np.asarray(shares @ [a, b, c]), np.asarray(normal / max(float(np.linalg.norm(normal)), 1e-300))

    def _direction(self) -> FloatArray:
        vector = self.rng.normal(size=3)
        return np.asarray(vector / np.linalg.norm(vector))
