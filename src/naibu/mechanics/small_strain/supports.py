"""Supports: nodes with a prescribed motion (a Dirichlet condition) during an interval of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.prescribed_motion import PrescribedMotion


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """Nodes with one prescribed motion while the support is active.

    Attributes
    ----------
    name : str
        Name under which the reaction force is returned.
    nodes : ndarray, shape (k,), int64
        Node numbers.
    axes : tuple of int, or None
        Constrained components; None for all of them, as under a plate that sticks.
    motion : PrescribedMotion or None
        Displacement of the nodes; None fixes them.
    start_s, end_s : float
        Interval of time in which the support is active, s.
    relative : bool
        Whether displacements are relative to the nodes' positions when the support becomes active, rather than to the reference
        configuration.

    Raises
    ------
    InputError
        No nodes, an interval that ends before it starts, or axes named twice.
    """

    name: str
    nodes: IntArray
    axes: tuple[int, ...] | None = None
    motion: PrescribedMotion | None = None
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
        """Return whether the support is active at a time, s."""
        return self.start_s <= time < self.end_s

    def events(self) -> list[float]:
        """Return the times, s, at which the support becomes active or inactive, or its velocity jumps."""
        inside = [t for t in (self.motion.kinks if self.motion is not None else ()) if self.start_s < t < self.end_s]
        return [t for t in (self.start_s, *inside, self.end_s) if np.isfinite(t)]


class ActiveSupports:
    """All supports that are active at one time, as prescribed components of all nodes.

    Parameters
    ----------
    supports : sequence of Support
        The active supports.
    shape : tuple of int
        Number of nodes and of components, (n, d).
    offsets : dict
        Displacements (k, d), mm, that are added to the motion of a relative support, by its name.

    Attributes
    ----------
    constrained : ndarray, shape (n, d), bool
        Components that a support prescribes.

    Raises
    ------
    InputError
        Nodes or axes that the body does not have, or two supports that constrain the same component.
    """

    def __init__(self, supports: Sequence[Support], shape: tuple[int, int], offsets: dict[str, FloatArray]) -> None:
        self.constrained = np.zeros(shape, dtype=bool)
        self._shape = shape
        self._parts: list[tuple[Support, tuple[IntArray, ...], FloatArray, list[int]]] = []
        for support in supports:
            axes = tuple(range(shape[1])) if support.axes is None else support.axes
            if support.nodes.min() < 0 or support.nodes.max() >= shape[0] or min(axes) < 0 or max(axes) >= shape[1]:
                raise InputError(f"support {support.name!r} names a node or an axis outside a body of {shape[0]} nodes in {shape[1]} D")
            where = support.nodes[:, None], np.array(axes)[None]
            if self.constrained[where].any():
                raise InputError(f"support {support.name!r} constrains nodes that another support constrains at the same time")
            self.constrained[where] = True
            self._parts.append((support, where, offsets.get(support.name, np.zeros((len(support.nodes), shape[1])))[:, axes], list(axes)))

    def displacement(self, time: float) -> FloatArray:
        """Return the displacement (n, d), mm, of the constrained components; zero elsewhere."""
        out = np.zeros(self._shape)
        for support, where, offset, axes in self._parts:
            moved = 0.0 if support.motion is None else self._checked(support, support.motion.displacement(time), time)[axes]
            out[where] = offset + moved
        return out

    def velocity(self, time: float, side: int) -> FloatArray:
        """Return the velocity (n, d), mm/s, of the constrained components just before (-1) or after (1) a time."""
        out = np.zeros(self._shape)
        for support, where, _, axes in self._parts:
            if support.motion is not None:
                out[where] = self._checked(support, support.motion.velocity(time, side), time)[axes]
        return out

    def acceleration(self, time: float) -> FloatArray:
        """Return the acceleration (n, d), mm/s^2, of the constrained components."""
        out = np.zeros(self._shape)
        for support, where, _, axes in self._parts:
            if support.motion is not None:
                out[where] = self._checked(support, support.motion.acceleration(time), time)[axes]
        return out

    def _checked(self, support: Support, value: FloatArray, time: float) -> FloatArray:
        if value.shape != (self._shape[1],) or not np.isfinite(value).all():
            name, d = support.name, self._shape[1]
            raise InputError(f"the motion of support {name!r} is {value.tolist()} at {time:g} s, not {d} finite numbers")
        return value
