"""Cutting of triangulated surfaces along the path of a tool: refine near the tool, then separate along edges.

The report's method :cite:p:`hirai2008` (chapter 4.4): triangles around the vertex that the cut has reached are bisected by Rivara's
backward longest-edge algorithm :cite:p:`rivara1997`, the next vertex is the neighbour closest to the direction of the tool, also across the
longest edge of a triangle, which is swapped then, and the vertex behind is duplicated. Here a step must also stay within half of the given
distance of the tool's path; where no edge does, triangles are bisected further.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.intrinsics.packed_tuples import packed_items
from naibu.core.arrays import FloatArray, IntArray, as_points, as_vector, require_positive
from naibu.core.errors import InputError
from naibu.meshing.cutting.surfaces import _tool_kernels as tool_kernels
from naibu.meshing.cutting.surfaces import _walk_kernels as walk
from naibu.meshing.cutting.surfaces._grid_kernels import grid_of
from naibu.meshing.cutting.surfaces._surface_kernels import MOST_AROUND, SurfaceArrays, number_edges
from naibu.meshing.cutting.surfaces._walk_kernels import ToolArrays
from naibu.meshing.cutting.surfaces.surface_input import LinkedSurface, linked_surface
from naibu.meshing.cutting.surfaces.surface_result import SurfaceCut, ToolPath, cut_result

MOST_TRIANGLES = 5_000_000
QUEUE, ROOM = 4096, 4096


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
        self.arrays = _arrays(start)
        size = float(np.linalg.norm(np.diff(start.points[start.triangles], axis=1), axis=2).mean())
        self._grid = grid_of(start.points, start.triangles, max(size, self.reach_mm))
        self._tool = _tool(self.distance_mm, self.reach_mm, refined)
        self._pack()
        self._paths: list[ToolPath] = []
        self._closed: list[bool] = []

    @property
    def n_steps(self) -> int:
        """Number of edges that were cut."""
        return int(self._tool.whole[walk.EDGES])

    def move(self, tip: ArrayLike) -> None:
        """Move the tip of the tool to a position (3,), mm, along a straight line; the cut follows about two distances behind.

        Raises
        ------
        InputError
            NaN, or a surface that has grown beyond 5 million triangles.
        """
        goal = as_vector("tip", tip)
        if tool_kernels.follow(*self._packed, goal, False) == walk.FULL:
            self._with_room(lambda: int(tool_kernels.follow(*self._packed, goal, True)))

    def lift(self) -> None:
        """Take the tool off: the cut is finished up to where it was."""
        whole, count = self._tool.whole, int(self._tool.whole[walk.COUNT])
        if count > 1:
            self._grow_tool(2 * count)
            tool_kernels.close(self._packed[1])
            self._with_room(lambda: int(tool_kernels.walk(*self._packed[:2], True)))
            k, count = self._tool, int(whole[walk.COUNT])
            self._closed.append(bool(np.isfinite(k.real[walk.CLOSING])))
            self._paths.append((k.points[:count].copy(), k.tips[:count].copy(), k.over[:count] > 0))
        _put_down(self._tool)

    def result(self) -> SurfaceCut:
        """Return the surface as it is cut, with the tool lifted."""
        self.lift()
        edges = self._tool.edges[: self.n_steps].copy()
        return cut_result(self._start, self.arrays, edges, self._paths, self._closed, self.distance_mm)

    def _with_room(self, attempt: Callable[[], int]) -> None:
        """Repeat what stopped because the arrays are full, with longer ones."""
        while attempt() == walk.FULL:
            if 2 * len(self.arrays.triangles) > MOST_TRIANGLES:
                raise InputError(
                    f"distance_mm is {self.distance_mm:g} mm, for which the surface would need more than {MOST_TRIANGLES} triangles; "
                    "choose a larger one"
                )
            s, k = self.arrays, self._tool
            full = min(len(s.at) - int(s.n[0]), len(s.parent) - int(s.n[1])) < ROOM
            if full:
                self.arrays = SurfaceArrays(*[*(_grown(a, len(a)) for a in s[:-1]), s.n])
            self._grow_tool(int(k.whole[walk.COUNT]) + tool_kernels.MOST_OF_SAMPLE)
            if not full and self._tool.edges is k.edges and self._tool.length is k.length:
                raise InputError(f"the surface has a vertex with more than {MOST_AROUND} triangles; remesh it")

    def _grow_tool(self, points: int) -> None:
        """Make room for so many points of the path, and for further edges."""
        k = self._tool
        more = max(0, points - len(k.length), len(k.length) if points > len(k.length) else 0)
        path: list[Any] = [_grown(a, more) if more else a for a in k[:7]]
        edges = _grown(k.edges, len(k.edges)) if 2 * self.n_steps > len(k.edges) else k.edges
        self._tool = ToolArrays(*[*path, edges, *k[8:]])
        self._pack()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what the kernels get, which holds addresses: those of a copy are others."""
        return {name: value for name, value in self.__dict__.items() if name != "_packed"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Hand over the arrays of the copy."""
        self.__dict__.update(state)
        self._pack()

    def _pack(self) -> None:
        """Hand over other arrays to the kernels from now on."""
        self._packed = packed_items(self.arrays), packed_items(self._tool), packed_items(self._grid)


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
            f"the tip stays more than {cutter.reach_mm:.4g} mm away from the surface, which reaches {reach}; check the path and its unit "
            "(mm), or state a larger reach_mm"
        )
    return cut


def _grown(array: IntArray | FloatArray, more: int) -> Any:
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)])


def _tool(distance_mm: float, reach_mm: float, refined: bool) -> ToolArrays:
    def whole(*shape: int) -> IntArray:
        return np.zeros(shape, dtype=np.int64)

    numbers, real = whole(walk.SAMPLED + 1), np.zeros(walk.ENTERED + 1)
    numbers[walk.FREE], real[walk.DISTANCE], real[walk.REACH] = not refined, distance_mm, reach_mm
    tool = ToolArrays(
        np.zeros((ROOM, 3)), np.zeros(ROOM), np.zeros((ROOM, 3)), whole(ROOM), whole(ROOM), np.zeros((ROOM, 3)), whole(ROOM),
        whole(ROOM, 2),
        whole(QUEUE), whole(MOST_AROUND), numbers, real, np.zeros((walk.ROWS, 3)),
    )  # fmt: skip
    _put_down(tool)
    return tool


def _put_down(tool: ToolArrays) -> None:
    """Set the state of a tool that begins another cut."""
    tool.whole[[walk.COUNT, walk.AT_BOUNDARY, walk.BEGAN, walk.LEFT_BEFORE]] = 0
    tool.whole[walk.NOW], tool.real[[walk.AT, walk.ENTERED]], tool.real[walk.CLOSING] = -1, 0.0, np.inf


def _arrays(start: LinkedSurface) -> SurfaceArrays:
    points, triangles, neighbours, _ = start
    n, t = len(points), len(triangles)
    at, sides = np.zeros(n, dtype=np.int64), np.full((t, 3), -1, dtype=np.int64)
    at[triangles.ravel()] = np.repeat(np.arange(t), 3)
    own, none, zero = np.arange(n), np.full((n, 2), -1, dtype=np.int64), np.zeros(t, dtype=np.int64)
    edges = int(number_edges(neighbours, sides))
    rows = [points, points, triangles, neighbours, at, own, none, np.zeros(n), own, np.arange(t), zero - 1, sides, zero, zero, zero]
    room: list[Any] = [_grown(np.ascontiguousarray(a), len(a) // 2 + 20_000) for a in rows]
    return SurfaceArrays(*[*room, np.array([n, t, 0, edges, 0])])
