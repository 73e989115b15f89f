"""Motions of virtual objects, from material points to positions and back: from a formula, a solved model, or matched points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RBFInterpolator

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import RigidTransform
from naibu.meshing.point_location import interpolation_operator, locate, operator_of

# Newton's method for the material point at a position: iterations at most, step of the differences and accuracy, mm
_MOST_ITERATIONS, _STEP, _ACCURACY = 40, 1e-3, 1e-7


class Motion(Protocol):
    """Maps material points (n, 3), mm, to their positions in a scan, and back; NaN where there is no material."""

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return positions (n, 3), mm, of material points (n, 3), mm."""
        ...

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return material points (n, 3), mm, at positions (n, 3), mm; NaN where there are none."""
        ...


@dataclass(frozen=True, slots=True)
class Still:
    """No motion: the reference configuration."""

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return the points."""
        return material

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return the points."""
        return positions


@dataclass(frozen=True, slots=True, eq=False)
class FormulaMotion:
    """A motion given by a formula; without a formula for its inverse, that is found by Newton's method.

    Attributes
    ----------
    forward : callable
        Positions (n, 3), mm, of material points (n, 3), mm.
    backward : callable, optional
        Material points (n, 3), mm, of positions (n, 3), mm.
    """

    forward: Callable[[FloatArray], FloatArray]
    backward: Callable[[FloatArray], FloatArray] | None = None

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return positions (n, 3), mm, of material points (n, 3), mm."""
        return np.asarray(self.forward(material))

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return material points (n, 3), mm, of positions (n, 3), mm.

        Raises
        ------
        ConvergenceError
            The formula cannot be inverted somewhere (it folds there).
        """
        if self.backward is not None:
            return np.asarray(self.backward(positions))
        found = positions.copy()
        active = np.arange(len(positions))
        for _ in range(_MOST_ITERATIONS):
            away = positions[active] - self.to_space(found[active])
            moving = ~(np.abs(away).max(axis=1, initial=0.0) < _ACCURACY)
            active, away = active[moving], away[moving]
            if not len(active):
                return found
            found[active] += _newton_step(self.to_space, found[active], away)
        raise ConvergenceError(
            f"the motion cannot be inverted at {len(active)} positions, the first at {positions[active[0]].round(3).tolist()} mm; "
            "it may fold there"
        )


def _newton_step(forward: Callable[[FloatArray], FloatArray], at: FloatArray, away: FloatArray) -> FloatArray:
    slopes = [(forward(at + _STEP * e) - forward(at - _STEP * e)) / (2.0 * _STEP) for e in np.eye(3)]
    gradient = np.stack(slopes, axis=2)
    determinant = np.linalg.det(gradient)
    gradient[~(np.abs(determinant) > 1e-3)] = np.eye(3)
    step = np.linalg.solve(gradient, away[:, :, None])[:, :, 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    most = 2.0 * np.linalg.norm(away, axis=1, keepdims=True) + 1.0  # far from the solution a step may overshoot
    return np.asarray(step * np.minimum(1.0, most / np.maximum(length, 1e-300)))


@dataclass(frozen=True, slots=True, eq=False)
class MeshMotion:
    """The motion of a solved model: displacement of the nodes of a mesh, interpolated with its shape functions.

    Attributes
    ----------
    mesh : Mesh
        The reference configuration, solid cells.
    displacement : ndarray, shape (n, 3)
        Displacement of its nodes, mm.
    """

    mesh: Mesh
    displacement: FloatArray
    _moved: Mesh = field(init=False, repr=False)

    def __post_init__(self) -> None:
        u = np.asarray(self.displacement, dtype=float)
        if u.shape != self.mesh.points.shape or not np.isfinite(u).all():
            raise InputError(f"displacement must be finite and have the shape {self.mesh.points.shape} of the nodes, not {u.shape}")
        moved = Mesh(self.mesh.points + u, self.mesh.cells, self.mesh.cell_type, self.mesh.regions, self.mesh.region_names)
        object.__setattr__(self, "_moved", moved)

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return positions (n, 3), mm, of material points (n, 3), mm, which must lie in or near the mesh."""
        return np.asarray(material + interpolation_operator(self.mesh, material) @ self.displacement)

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return material points (n, 3), mm, at positions (n, 3), mm; NaN outside the body."""
        out = np.full(positions.shape, np.nan)
        near = np.flatnonzero(((positions >= self._moved.points.min(axis=0)) & (positions <= self._moved.points.max(axis=0))).all(axis=1))
        if len(near):
            location = locate(self._moved, positions[near], tolerance_mm=np.inf)
            inside = location.distance_mm <= 1e-9
            out[near[inside]] = (operator_of(self.mesh, location) @ self.mesh.points)[inside]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class PosedMotion:
    """A motion in another pose of the object in the scanner.

    Attributes
    ----------
    motion : Motion
        In the frame of the object.
    pose : RigidTransform
        Of that frame in the scan.
    """

    motion: Motion
    pose: RigidTransform

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return positions (n, 3), mm, of material points (n, 3), mm."""
        return self.pose.applied(self.motion.to_space(material))

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return material points (n, 3), mm, at positions (n, 3), mm; NaN where there are none."""
        return self.motion.to_material(self.pose.inverse().applied(positions))


class MatchedMotion:
    """The smooth motion through measured markers: thin-plate splines :cite:p:`bookstein1989` both ways, exact at the markers.

    The two splines are not exact inverses of each other between the markers, where the motion is plausible, not a ground truth.

    Parameters
    ----------
    material, positions : array_like, shape (n, 3)
        Markers in the two states, mm.

    Raises
    ------
    InputError
        Fewer than five markers, shapes that do not match, or coordinates that are not finite.
    """

    def __init__(self, material: ArrayLike, positions: ArrayLike) -> None:
        a, b = np.asarray(material, dtype=float), np.asarray(positions, dtype=float)
        if a.ndim != 2 or a.shape[1] != 3 or a.shape != b.shape or len(a) < 5 or not (np.isfinite(a).all() and np.isfinite(b).all()):
            raise InputError(f"matched markers must be two arrays (n, 3) of at least 5 finite points, not {a.shape} and {b.shape}")
        self._forward = RBFInterpolator(a, b - a, kernel="thin_plate_spline", smoothing=0.0)
        self._backward = RBFInterpolator(b, a - b, kernel="thin_plate_spline", smoothing=0.0)

    def to_space(self, material: FloatArray) -> FloatArray:
        """Return positions (n, 3), mm, of material points (n, 3), mm."""
        return np.asarray(material + self._forward(material))

    def to_material(self, positions: FloatArray) -> FloatArray:
        """Return material points (n, 3), mm, at positions (n, 3), mm."""
        return np.asarray(positions + self._backward(positions))
