"""Supports that move and let go: nodes whose displacement is a given function of time while the support is active (spec M3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError

_FINE, _COARSE = 1e-5, 1e-3  # steps, s, of the differences that stand in for derivatives that are not given


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """How a rigid plate moves; `Path.through` and `Path.of` make one.

    Attributes
    ----------
    displacement : callable
        From a time, s, to the displacement (d,), mm.
    velocity : callable
        From a time and a side (-1 just before it, 1 just after it) to the velocity (d,), mm/s.
    acceleration : callable
        From a time to the acceleration (d,), mm/s^2, away from kinks.
    kinks : tuple of float
        Times, s, at which the velocity jumps: steps end there.
    """

    displacement: Callable[[float], FloatArray]
    velocity: Callable[[float, int], FloatArray]
    acceleration: Callable[[float], FloatArray]
    kinks: tuple[float, ...] = ()

    @classmethod
    def through(cls, times_s: ArrayLike, displacements_mm: ArrayLike) -> Path:
        """Return the path through displacements (k, d), mm, at times (k,), s: straight between them, at rest before and after.

        Raises
        ------
        InputError
            Times that do not increase, shapes that do not fit, or a value that is not finite.
        """
        t, g = np.array(times_s, dtype=float), np.array(displacements_mm, dtype=float)
        if t.ndim != 1 or g.ndim != 2 or len(t) != len(g) or len(t) == 0:
            raise InputError(f"a path needs times (k,) and displacements (k, d), not arrays of shape {t.shape} and {g.shape}")
        if not (np.isfinite(t).all() and np.isfinite(g).all() and (np.diff(t) > 0.0).all()):
            raise InputError("the times of a path must increase, and times and displacements be finite")
        slopes = np.vstack([np.zeros(g.shape[1]), np.diff(g, axis=0) / np.diff(t)[:, None], np.zeros(g.shape[1])])

        def displacement(time: float) -> FloatArray:
            return np.array([np.interp(time, t, column) for column in g.T])

        def velocity(time: float, side: int) -> FloatArray:
            return np.asarray(slopes[np.searchsorted(t, time, side="right" if side > 0 else "left")])

        return cls(displacement, velocity, lambda _: np.zeros(g.shape[1]), tuple(t.tolist()))

    @classmethod
    def of(
        cls,
        displacement: Callable[[float], ArrayLike],
        *,
        velocity: Callable[[float], ArrayLike] | None = None,
        acceleration: Callable[[float], ArrayLike] | None = None,
        kinks: Sequence[float] = (),
    ) -> Path:
        """Return the path of smooth functions of time (s) to (d,) mm, mm/s, mm/s^2; what is not given is taken by differences."""

        def place(time: float) -> FloatArray:
            return np.asarray(displacement(time), dtype=float)

        def speed(time: float, _: int) -> FloatArray:
            if velocity is not None:
                return np.asarray(velocity(time), dtype=float)
            return np.asarray((place(time + _FINE) - place(time - _FINE)) / (2.0 * _FINE))

        def second(time: float) -> FloatArray:
            if acceleration is not None:
                return np.asarray(acceleration(time), dtype=float)
            return np.asarray((speed(time + _COARSE, 1) - speed(time - _COARSE, -1)) / (2.0 * _COARSE))

        return cls(place, speed, second, tuple(kinks))


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """Nodes that follow a path from `start` until `end`.

    Attributes
    ----------
    name : str
        Under which its force is returned.
    nodes : ndarray, shape (k,), int64
        The nodes.
    axes : tuple of int, or None
        Which components are prescribed; None for all, a plate that sticks.
    path : Path or None
        Where they go; None holds them still.
    start_s, end_s : float
        When the support acts.
    relative : bool
        Whether the path counts from where the nodes are when the support begins to act, rather than from the free shape.
    """

    name: str
    nodes: IntArray
    axes: tuple[int, ...] | None = None
    path: Path | None = None
    start_s: float = -np.inf
    end_s: float = np.inf
    relative: bool = False

    def __post_init__(self) -> None:
        nodes = np.atleast_1d(np.asarray(self.nodes))
        if nodes.ndim != 1 or len(nodes) == 0 or nodes.dtype.kind not in "iu":
            raise InputError(f"support {self.name!r} needs a list of node numbers, not a {nodes.dtype} array of shape {nodes.shape}")
        object.__setattr__(self, "nodes", np.unique(nodes).astype(np.int64))
        if not self.start_s < self.end_s:
            raise InputError(f"support {self.name!r} acts from {self.start_s:g} s to {self.end_s:g} s: the end must come later")
        if self.axes is not None and (len(self.axes) == 0 or len(set(self.axes)) < len(self.axes)):
            raise InputError(f"support {self.name!r} names the axes {self.axes}: name each once, or give None for all")

    def acts_at(self, time: float) -> bool:
        """Whether it acts at this time, s."""
        return self.start_s <= time < self.end_s

    def events(self) -> list[float]:
        """Return the times, s, at which it takes hold, changes its speed or lets go."""
        inside = [t for t in (self.path.kinks if self.path is not None else ()) if self.start_s < t < self.end_s]
        return [t for t in (self.start_s, *inside, self.end_s) if np.isfinite(t)]


class Guide:
    """All supports that act at one time, over the nodes of a body.

    Parameters
    ----------
    supports : sequence of Support
        Those that act.
    shape : tuple of int
        Number of nodes and of components.
    offsets : dict
        What is added to the path of a relative support: arrays (k, d), mm, by name.

    Raises
    ------
    InputError
        Nodes or axes that the body lacks, or two supports that hold the same component.
    """

    def __init__(self, supports: Sequence[Support], shape: tuple[int, int], offsets: dict[str, FloatArray]) -> None:
        self.constrained = np.zeros(shape, dtype=bool)
        self._shape = shape
        self._parts: list[tuple[Support, tuple[IntArray, ...], FloatArray, list[int]]] = []
        for support in supports:
            axes = tuple(range(shape[1])) if support.axes is None else support.axes
            if support.nodes.min() < 0 or support.nodes.max() >= shape[0] or min(axes) < 0 or max(axes) >= shape[1]:
                raise InputError(f"support {support.name!r} names a node or an axis that a body of {shape[0]} nodes in {shape[1]} D lacks")
            where = support.nodes[:, None], np.array(axes)[None]
            if self.constrained[where].any():
                raise InputError(f"support {support.name!r} holds nodes that another support holds at the same time")
            self.constrained[where] = True
            self._parts.append((support, where, offsets.get(support.name, np.zeros((len(support.nodes), shape[1])))[:, axes], list(axes)))

    def displacement(self, time: float) -> FloatArray:
        """Return the displacement (n, d), mm, of the held components; zero elsewhere."""
        out = np.zeros(self._shape)
        for support, where, offset, axes in self._parts:
            out[where] = offset if support.path is None else offset + self._checked(support, support.path.displacement(time), time)[axes]
        return out

    def velocity(self, time: float, side: int) -> FloatArray:
        """Return their velocity (n, d), mm/s, just before (-1) or after (1) a time."""
        out = np.zeros(self._shape)
        for support, where, _, axes in self._parts:
            if support.path is not None:
                out[where] = self._checked(support, support.path.velocity(time, side), time)[axes]
        return out

    def acceleration(self, time: float) -> FloatArray:
        """Return their acceleration (n, d), mm/s^2."""
        out = np.zeros(self._shape)
        for support, where, _, axes in self._parts:
            if support.path is not None:
                out[where] = self._checked(support, support.path.acceleration(time), time)[axes]
        return out

    def _checked(self, support: Support, value: FloatArray, time: float) -> FloatArray:
        if value.shape != (self._shape[1],) or not np.isfinite(value).all():
            raise InputError(f"the path of support {support.name!r} is {value.tolist()} at {time:g} s, not {self._shape[1]} finite numbers")
        return value
