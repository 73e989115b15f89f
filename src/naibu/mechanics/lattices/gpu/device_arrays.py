"""Arrays of a lattice on a device of Warp: lists of neighbours, coefficients, constrained nodes, and sums that always come out alike."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import AnyArray, FloatArray, Int32Array, IntArray
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.mechanics.lattices.gpu.warp_types import WarpArray
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes

_PART = 64  # entries of constrained nodes that one thread adds up
_CODES = 256  # different elements that a byte can number


def warp_package() -> ModuleType:
    """Return Warp, configured to print warnings only.

    Raises
    ------
    MissingDependencyError
        It is not installed.
    """
    wp: ModuleType = optional_package("warp", "moving lattices on a GPU", "naibu[gpu]")
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    return wp


def compiled(name: str) -> ModuleType:
    """Return a module of kernels beside this one, which can be loaded only where Warp is."""
    warp_package()
    return importlib.import_module(f"naibu.mechanics.lattices.gpu.{name}")


def chosen_device(device: str | None) -> object:
    """Return a device of Warp: the one named, else the current CUDA device, else the processor.

    Raises
    ------
    InputError
        There is no device of this name; the message names those that there are.
    """
    wp = warp_package()
    try:
        return wp.get_preferred_device() if device is None else wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        raise InputError(
            f"there is no device {device!r}; Warp knows {known}, and CUDA devices need an NVIDIA GPU and its driver"
        ) from error


def recorded(launches: Callable[[], None], device: object) -> Callable[[], None]:
    """Record launches of kernels, which do nothing yet, and return a function that gives them all to the device at once."""
    wp = warp_package()
    for name in ("_explicit_kernels", "_implicit_kernels", "_coarse_kernels"):
        wp.load_module(compiled(name), device=device)  # not while recording: older drivers cannot
    with wp.ScopedCapture(device=device) as capture:
        launches()
    return partial(wp.capture_launch, capture.graph)


@dataclass(frozen=True, slots=True, eq=False)
class NeighbourLists:
    """Neighbours of all nodes on a device, those of `SLICE` nodes side by side.

    Attributes
    ----------
    start : warp array (slices,), int32
        Where the lists of a slice begin; the s-th neighbour of node i stands at ``start[i // SLICE] + SLICE s + i % SLICE``.
    degree : warp array (n,), int32
        Number of elements at a node.
    neighbour : warp array (entries,), int32
        Nodes at the other ends.
    places : ndarray, shape (m, 2), int32
        Where an element stands in the lists of its two nodes.
    """

    start: WarpArray
    degree: WarpArray
    neighbour: WarpArray
    places: Int32Array

    @classmethod
    def of(cls, lattice: Lattice, device: object) -> NeighbourLists:
        """Put the elements of a lattice on a device.

        Raises
        ------
        InputError
            There are too many elements for numbers of 32 bits.
        """
        wp, width = warp_package(), compiled("_explicit_kernels").SLICE
        degree = np.bincount(lattice.elements.ravel(), minlength=lattice.n_nodes)
        widest = np.maximum.reduceat(degree, np.arange(0, len(degree), width))
        ends = np.cumsum(width * widest)
        if ends[-1] > np.iinfo(np.int32).max:
            raise InputError(f"the lattice has {lattice.n_elements} elements; the GPU takes about a thousand million: split the lattice")
        start = ends - width * widest
        neighbour, places = np.zeros(ends[-1], dtype=np.int32), np.empty((lattice.n_elements, 2), dtype=np.int32)
        _fill(lattice.elements, start, width, neighbour, places, np.zeros(lattice.n_nodes, dtype=np.int32))
        kept = [wp.array(values.astype(np.int32), dtype=wp.int32, device=device) for values in (start, degree, neighbour)]
        return cls(kept[0], kept[1], kept[2], places)

    def at_both_ends(self, values: AnyArray, dtype: type[np.generic]) -> AnyArray:
        """Return values of the elements (m,) as the lists hold them, zero where there is none."""
        result = np.zeros(self.neighbour.shape[0], dtype=dtype)
        result[self.places[:, 0]] = values
        result[self.places[:, 1]] = values
        return result

    def of_elements(self, listed: WarpArray) -> FloatArray:
        """Return the values (m,) of the elements from an array of the lists."""
        return np.asarray(listed.numpy()[self.places[:, 0]], dtype=np.float64)


@njit(cache=True)
def _fill(elements, start, width, neighbour, places, filled):  # type: ignore[no-untyped-def]  # pragma: no cover
    for e in range(len(elements)):
        for end in range(2):
            i = elements[e, end]
            place = start[i // width] + width * filled[i] + i % width
            neighbour[place] = elements[e, 1 - end]
            places[e, end] = place
            filled[i] += 1


def alike_elements(parameters: LatticeParameters) -> tuple[AnyArray, LatticeParameters]:
    """Return the number of every element's row of parameters (m,), one byte where there are few, and the rows that differ."""
    k, c1, c2 = parameters.stiffness, parameters.voigt_damping, parameters.series_damping
    codes, chosen = np.zeros(len(k), dtype=np.uint8), np.zeros(_CODES, dtype=np.int64)
    count = _numbered(k, c1, c2, codes, chosen)
    if count < 0:
        return np.arange(len(k), dtype=np.int32), parameters
    kept = chosen[: max(count, 1)] if len(k) else chosen[:0]
    return codes, LatticeParameters(k[kept], c1[kept], c2[kept], parameters.voigt_fraction[kept])


@njit(cache=True)
def _numbered(k, c1, c2, codes, chosen):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Number equal rows in the order of their first places, kept in `chosen`; return how many there are, -1 if more than fit."""
    count, last = 0, 0
    for e in range(len(k)):
        found = -1
        for t in range(count):  # most rows equal the one before
            c = (last + t) % count
            r = chosen[c]
            if k[e] == k[r] and c1[e] == c1[r] and c2[e] == c2[r]:
                found = c
                break
        if found < 0:
            if count == len(chosen):
                return -1
            chosen[count] = e
            found = count
            count += 1
        codes[e] = found
        last = found
    return count


@dataclass(frozen=True, slots=True, eq=False)
class ConstrainedArrays:
    """Constrained components on a device, in the order of their nodes.

    Attributes
    ----------
    count : int
        Number of components.
    bodies : int
        Number of bodies.
    first : warp array (nodes + 1,), int32
        Where the components of every constrained node begin.
    node, direction, weight, body : warp array (count,)
        As in `ConstrainedNodes`.
    push : warp array (count,), vec3d
        What the bodies exert, mN.
    entry, part : warp array
        Components in the order of their bodies, and where each part of at most 64 that a thread adds up begins.
    part_body : ndarray, shape (parts,)
        Body of every part.
    """

    count: int
    bodies: int
    first: WarpArray
    node: WarpArray
    direction: WarpArray
    weight: WarpArray
    body: WarpArray
    push: WarpArray
    entry: WarpArray
    part: WarpArray
    part_body: IntArray

    @classmethod
    def of(cls, constrained: ConstrainedNodes, device: object) -> ConstrainedArrays:
        """Put constrained components on a device."""
        wp = warp_package()
        order = np.argsort(constrained.node, kind="stable")
        node, body = constrained.node[order], constrained.body[order]
        first = np.append(np.flatnonzero(np.diff(node, prepend=-1)), len(node))
        entry = np.argsort(body, kind="stable")
        sizes = np.bincount(body)
        begins = [np.arange(end - size, end, _PART) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        part = np.append(np.concatenate([np.zeros(0, np.int64), *begins]), len(node))

        def numbers(values: IntArray) -> WarpArray:
            made: WarpArray = wp.array(values.astype(np.int32), dtype=wp.int32, device=device)
            return made

        return cls(
            len(node),
            len(sizes),
            numbers(first),
            numbers(node),
            wp.array(constrained.direction[order].astype(float).reshape(-1, 3), dtype=wp.vec3d, device=device),
            wp.array(constrained.weight[order].astype(float), dtype=wp.float64, device=device),
            numbers(body),
            wp.zeros(len(node), dtype=wp.vec3d, device=device),
            numbers(entry),
            numbers(part),
            body[entry][part[:-1]] if len(node) else np.zeros(0, np.int64),
        )

    @property
    def masses(self) -> int:
        """Number of constrained nodes."""
        return int(self.first.shape[0]) - 1

    def reactions(self, parts: FloatArray, bodies: int) -> FloatArray:
        """Return the forces of the bodies (steps, bodies, 3), mN, from those of the parts (steps, parts, 3)."""
        result = np.zeros((len(parts), bodies, 3))
        for body in np.unique(self.part_body):
            result[:, body] = parts[:, self.part_body == body].sum(axis=1)
        return result
