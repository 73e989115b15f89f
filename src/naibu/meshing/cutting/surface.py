"""Cutting of triangulated surfaces along the path of a tool: refine near the tool, then separate along edges.

The report's method :cite:p:`hirai2008` (chapter 4.4): triangles around the vertex that the cut has reached are bisected by Rivara's
backward longest-edge algorithm :cite:p:`rivara1997`, the next vertex is the neighbour closest to the direction of the tool, also across the
longest edge of a triangle, which is swapped then, and the vertex behind is duplicated. Here a step must also stay within half of the given
distance of the tool's path; where no edge does, triangles are bisected further.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, as_points, as_vector, require_positive
from naibu.core.errors import InputError
from naibu.meshing.cutting import _surface_walk_kernels as walk
from naibu.meshing.cutting._surface_kernels import SurfaceArrays
from naibu.meshing.cutting.surface_input import linked_surface
from naibu.meshing.cutting.surface_result import SurfaceCut, cut_result

SAMPLES = 4  # of the tool's path in one distance
BESIDE = 1e-6  # of the distance: how far beside its boundary the tool has left the surface
MOST_TRIANGLES = 5_000_000
QUEUE = 4096


@dataclass(slots=True, eq=False)
class _Path:
    """The tool's path on the surface: points, lengths, tips, triangles beneath, and whether the tool is over the surface."""

    points: FloatArray
    length: FloatArray
    tips: FloatArray
    triangle: IntArray
    over: IntArray  # 1 over the surface, 2 on its boundary, 0 beside
    count: int = 0

    @classmethod
    def empty(cls, room: int = 1024) -> _Path:
        return cls(np.zeros((room, 3)), np.zeros(room), np.zeros((room, 3)), np.zeros(room, dtype=np.int64), np.zeros(room, dtype=np.int64))

    def append(self, point: FloatArray, tip: FloatArray, triangle: int, over: int) -> None:
        if self.count == len(self.length):
            for name in ("points", "length", "tips", "triangle", "over"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        k = self.count
        if k:
            step = float(np.linalg.norm(point - self.points[k - 1]))
            if step < 1e-9 * max(1.0, float(self.length[k - 1])):
                return
            self.length[k] = self.length[k - 1] + step
        self.points[k], self.tips[k], self.triangle[k], self.over[k] = point, tip, triangle, over
        self.count += 1


class SurfaceCutter:
    """A triangulated surface that a tool cuts while it moves.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        mm.
    triangles : array_like, shape (t, 3), int
        Point numbers. Equal points are merged, triangles without area or that occur twice left out, and triangles turned so that
        neighbours agree on the outside; the surface may be open, and is opened along edges that more than two triangles share. `repairs`
        says what was mended.
    distance_mm : float
        d: near the tool triangles are bisected until their longest edge is shorter, and the cut stays within half of it of the path.
    reach_mm : float, optional
        How far from the surface the tip still cuts, mm; by default two distances. A tip inside cuts a groove of its depth.
    refined : bool
        Without refinement the cut follows the edges that there are, and may stray from the path.

    Raises
    ------
    InputError
        Arrays of other shapes, NaN, no triangle with an area, or a distance that is not positive or is larger than the surface.
    """

    def __init__(
        self, points: ArrayLike, triangles: ArrayLike, distance_mm: float, *, reach_mm: float | None = None, refined: bool = True
    ) -> None:
        require_positive("distance_mm", distance_mm, "mm")
        start = linked_surface(points, triangles)
        extent = float(np.ptp(start.points, axis=0).max())
        if distance_mm > extent:
            raise InputError(f"distance_mm is {distance_mm:g} mm, larger than the surface of {extent:.4g} mm; choose a fraction of it")
        self.distance_mm, self.refined, self.repairs = float(distance_mm), refined, start.repairs
        self.reach_mm = 2.0 * self.distance_mm if reach_mm is None else require_positive("reach_mm", reach_mm, "mm")
        self._start = start
        self.arrays = _arrays(start.points, start.triangles, start.neighbours)
        self._path, self._paths = _Path.empty(), list[_Path]()
        self._queue = np.zeros(QUEUE, dtype=np.int64)
        self._now, self._at, self._began = np.array([-1, 0]), np.zeros(1), False
        self._edges: list[tuple[int, int]] = []
        self._last, self._left, self._height, self._closing = np.zeros(3), False, 0.0, np.inf
        self._searched: FloatArray | None = None

    @property
    def n_steps(self) -> int:
        """Number of edges that were cut."""
        return len(self._edges)

    def move(self, tip: ArrayLike) -> None:
        """Move the tip of the tool to a position (3,), mm, along a straight line; the cut follows about two distances behind.

        Raises
        ------
        InputError
            NaN, or a surface that has grown beyond 5 million triangles.
        """
        goal = as_vector("tip", tip)
        path = self._path
        if not path.count:
            self._sample(goal, None)
            return
        last = path.tips[path.count - 1].copy()
        pieces = max(1, int(np.ceil(SAMPLES * float(np.linalg.norm(goal - last)) / self.distance_mm)))
        for k in range(1, pieces + 1):
            self._sample(last + k / pieces * (goal - last), int(path.triangle[path.count - 1]) if path.count else None)
            self._walk(final=False)

    def lift(self) -> None:
        """Take the tool off: the cut is finished up to where it was."""
        if self._path.count > 1:
            self._close()
            self._walk(final=True)
            self._paths.append(self._path)
        self._path, self._began, self._left = _Path.empty(), False, False
        self._now[:] = (-1, 0)
        self._at[0], self._searched, self._closing = 0.0, None, np.inf

    def _close(self) -> None:
        """Where the path ends at its beginning, follow it a little further, so that the cut meets its own beginning."""
        path, d = self._path, self.distance_mm
        last = path.count - 1
        if path.length[last] < 4.0 * d or np.linalg.norm(path.points[last] - path.points[0]) > 0.5 * d:
            return
        self._closing = float(path.length[last]) - 2.0 * d
        for k in range(1, int(np.searchsorted(path.length[: last + 1], 2.0 * d))):
            path.append(path.points[k].copy(), path.tips[k].copy(), int(path.triangle[k]), int(path.over[k]))

    def result(self) -> SurfaceCut:
        """Return the surface as it is cut, with the tool lifted."""
        self.lift()
        paths = [(p.points[: p.count], p.tips[: p.count], p.over[: p.count] > 0) for p in self._paths]
        edges = np.array(self._edges, dtype=np.int64).reshape(-1, 2)
        return cut_result(self._start, self.arrays, edges, paths, self.distance_mm)

    def _sample(self, tip: FloatArray, near: int | None) -> None:
        """Append a position of the tip and the point of the surface beneath it."""
        s, point, radius = self.arrays, np.zeros(3), 2.0 * self.distance_mm + self._height
        found: tuple[int, float, float] = (0, 0.0, np.inf)
        for start in (near, None):  # far from where the tool was, the whole surface is searched
            if found[2] > self.reach_mm**2 and (start is not None or self._lost(tip)):
                first = int(walk.nearest_of_all(s, tip)) if start is None else start
                found = walk.nearest(s, first, tip, radius, True, self._queue, point)
        beside = found[1] > BESIDE * self.distance_mm or found[2] > self.reach_mm**2
        self._height = 0.0 if beside else float(np.sqrt(found[2]))
        at_edge = 2 if found[1] >= 0.0 else 1
        self._path.append(tip if beside else point, tip, found[0], 0 if beside else at_edge)

    def _lost(self, tip: FloatArray) -> bool:
        """Whether the whole surface is to be searched: not more often than every distance in which nothing was found."""
        path = self._path
        beyond = self._searched is None or float(np.linalg.norm(tip - self._searched)) >= self.distance_mm
        if beyond or not path.count:
            self._searched = tip.copy()
        return beyond or not path.count

    def _walk(self, *, final: bool) -> None:
        path = self._path
        if path.count < 2:
            return
        while self._now[0] >= 0 or self._enter(final):
            before = int(self._now[0])

            def step() -> int:
                s, free = self.arrays, not self.refined
                return int(walk.advance(s, self._now, self._at, path.points, path.length, path.count, self.distance_mm, final, free))

            code = self._with_room(step, walk.FULL)
            if code == walk.STEPPED:
                self._edges.append((before, int(self._now[0])))
            elif code in (walk.LEFT, walk.STUCK):
                self._last = self.arrays.position[self._now[0]].copy()
                self._at[0] += 0.25 * self.distance_mm if code == walk.STUCK else 0.0
                self._left = code == walk.LEFT
                self._now[0] = -1
                if self._at[0] >= self._closing:
                    return  # the loop is closed
            else:
                self._now[0] = -1 if code == walk.ENDED else self._now[0]
                return

    def _enter(self, final: bool) -> bool:
        """Find the vertex at which the cut begins, or goes on behind an edge or an earlier cut."""
        path, d = self._path, self.distance_mm
        over, length = path.over[: path.count] > 0, path.length[: path.count]
        while True:
            ahead = np.flatnonzero(over & (length >= (self._at[0] + 0.5 * d if self._began else 0.0)))
            if not len(ahead) or (not final and length[-1] - length[ahead[0]] < 2.0 * d):
                return False
            k, edge = int(ahead[0]), self._left or bool(path.over[ahead[0]] == 2)
            target = self._last if self._left else path.points[k]
            outside = np.flatnonzero(~over[:k] & (length[:k] >= self._at[0] - d))
            if len(outside):
                k, edge = int(outside[-1]) + 1, True
                target = self._crossing(k)
            low, high = max(float(self._at[0]), float(length[k]) - 2.0 * d), float(length[k]) + d
            found = self._begin(int(path.triangle[k]), target, low, high, edge)
            again, self._began = self._began, True
            least = float(self._at[0]) + 0.1 * d if again else 0.0  # it never goes on behind where it was, so that it comes to an end
            if found >= 0:
                self._now[:] = (found, 0)
                beside = walk.on_path(path.points, path.length, path.count, self.arrays.position[found], low, high)[1]
                self._at[0] = max(least, beside)
                return True
            self._at[0] = max(least, float(self._at[0]) + 0.1 * d, float(length[k]))
            self._left = False  # the next try begins inside

    def _begin(self, triangle: int, target: FloatArray, low: float, high: float, edge: bool) -> int:
        path, d = self._path, self.distance_mm

        def begin() -> int:
            found = walk.begin(
                self.arrays, triangle, target, path.points, path.length, path.count, low, high, d, edge, not self.refined, self._queue
            )
            return int(found)

        return self._with_room(begin, walk.NO_ROOM)

    def _crossing(self, k: int) -> FloatArray:
        """Where the path comes over the surface between its points k - 1 and k, by bisection."""
        path, point = self._path, np.zeros(3)
        outside, inside = path.points[k - 1].copy(), path.points[k].copy()
        for _ in range(20):
            middle = 0.5 * (outside + inside)
            _, beside, _ = walk.nearest(self.arrays, int(path.triangle[k]), middle, self.reach_mm, False, self._queue, point)
            if beside > BESIDE * self.distance_mm:
                outside = middle
            else:
                inside = middle
        return np.asarray(inside)

    def _with_room(self, attempt: Callable[[], int], full: int) -> int:
        while (code := attempt()) == full:
            if 2 * len(self.arrays.triangles) > MOST_TRIANGLES:
                raise InputError(
                    f"distance_mm is {self.distance_mm:g} mm, for which the surface would need more than {MOST_TRIANGLES} triangles; "
                    "choose a larger one"
                )
            room: list[Any] = [*(_grown(a, len(a)) for a in self.arrays[:-1]), self.arrays.n]
            self.arrays = SurfaceArrays(*room)
        return code


def cut_surface(
    points: ArrayLike,
    triangles: ArrayLike,
    path: ArrayLike,
    distance_mm: float,
    *,
    reach_mm: float | None = None,
    refined: bool = True,
) -> SurfaceCut:
    """Cut a triangulated surface along the path of a tool's tip.

    Parameters
    ----------
    points, triangles, distance_mm, reach_mm, refined
        See `SurfaceCutter`.
    path : array_like, shape (p, 3)
        Positions of the tip, mm, joined by straight lines. The cut may begin and end inside the surface, leave it over an edge and enter it
        again, cross itself, and cut pieces out.

    Raises
    ------
    InputError
        See `SurfaceCutter`; a path of fewer than two points or of no length, or that passes beside the surface.
    """
    tips = as_points("path", path, 3, least=2)
    if not np.ptp(tips, axis=0).any():
        raise InputError("path has no length: all of its points are the same; give at least two positions of the tip")
    cutter = SurfaceCutter(points, triangles, distance_mm, reach_mm=reach_mm, refined=refined)
    for tip in tips:
        cutter.move(tip)
    cut = cutter.result()
    if not cut.on_surface:
        low, high = cut.points.min(axis=0), cut.points.max(axis=0)
        reach = ", ".join(f"{axis} from {a:.4g} to {b:.4g} mm" for axis, a, b in zip("xyz", low, high, strict=True))
        raise InputError(
            f"the tip stays more than {cutter.reach_mm:g} mm away from the surface, which reaches {reach}; check the path and its unit (mm)"
        )
    return cut


def _grown(array: IntArray | FloatArray, more: int) -> Any:
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)])


def _arrays(points: FloatArray, triangles: IntArray, neighbours: IntArray) -> SurfaceArrays:
    n, t = len(points), len(triangles)
    at = np.zeros(n, dtype=np.int64)
    at[triangles.ravel()] = np.repeat(np.arange(t), 3)
    own, none = np.arange(n), np.full((n, 2), -1, dtype=np.int64)
    rows = [points, points, triangles, neighbours, at, own, none, own, np.arange(t), np.zeros(t, dtype=np.int64)]
    room: list[Any] = [_grown(np.ascontiguousarray(a), len(a) // 2 + 20_000) for a in rows]
    return SurfaceArrays(*[*room, np.array([n, t, 0])])
