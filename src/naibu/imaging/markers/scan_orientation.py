"""Orientation of an object in its scan, from its markers: the directions of their lattice, and that in which the object is compressed.

The direction of compression is the principal direction of least stretch of the affine motion that fits the markers best, by the polar
decomposition of its gradient: rigid motion between the scans does not change it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError

GROUPS = 10  # of the jackknife
LATTICE_DEG = 15.0  # median angle between neighbours and axes of a lattice, at most; directions at random are 30 degrees away
NEAR = 0.25  # neighbours of a lattice lie within this fraction of its spacing
FEWEST_PAIRS = 12
SEEDS, ROUNDS = 30, 8
UNCERTAIN_DEG = 4.0  # standard error of a direction of compression from which on it is not believed
APART_DEG = 30.0  # between the direction of compression and the nearest axis of a lattice, at most
ACROSS_DEG = 75.0  # angle to the scan's z from which on it is not known which end is up
FEWEST = 8
TURN_STEP_DEG, WITHIN = 0.25, 1.01
# candidates for the horizontal axes of a lattice: quarter turns about the vertical
_QUARTERS = np.array([[[c, -s, 0], [s, c, 0], [0, 0, 1]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))], dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class ScanOrientation:
    """Rotation from the axes of a scan to those of the object.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        ``x = rotation @ X``: its last row is the vertical of the object, away from the base, in the axes of the scan.
    source : str
        What it follows from, in words.
    sd_deg : float
        Standard error of the direction of the vertical, degrees, by the jackknife; 0 where it was stated.
    """

    rotation: FloatArray
    source: str
    sd_deg: float = 0.0

    @property
    def vertical(self) -> FloatArray:
        """Unit vector (3,) away from the base, in the axes of the scan."""
        return np.asarray(self.rotation[2])

    @property
    def tilt_deg(self) -> float:
        """Angle between the vertical and the z axis of the scan, degrees."""
        return float(np.degrees(np.arccos(np.clip(self.vertical[2], -1.0, 1.0))))


def stated_orientation(vertical: Sequence[float]) -> ScanOrientation:
    """Return the smallest rotation that turns a direction of the scan into the vertical of the object.

    Parameters
    ----------
    vertical : sequence of float, shape (3,)
        Direction away from the base, in the axes of the scan; its length does not matter.

    Raises
    ------
    InputError
        Not three finite numbers, or all zero.
    """
    v = np.asarray(vertical, dtype=np.float64)
    if v.shape != (3,) or not np.isfinite(v).all() or not np.linalg.norm(v) > 0.0:
        raise InputError(f"vertical = {list(vertical)} must be three numbers, a direction in the axes of the scan such as (0, 0.5, 1)")
    return ScanOrientation(_least_rotation(v / np.linalg.norm(v)), "as stated")


def found_orientation(initial: FloatArray, loaded: Sequence[FloatArray], spacing_mm: float | None = None) -> ScanOrientation:
    """Find the orientation of an object in the scan of its reference state that is compressed along its vertical.

    Parameters
    ----------
    initial : ndarray, shape (n, 3)
        Markers of the unloaded object, mm.
    loaded : sequence of ndarray, shape (n, 3)
        The same markers in the loaded states, mm; NaN where they are missing.
    spacing_mm : float, optional
        Spacing of a regular lattice of markers; where the markers lie in one, its directions are taken, which are more accurate.

    Returns
    -------
    ScanOrientation
        The vertical is the one of the two ends that lies nearer to the scan's z axis.

    Raises
    ------
    InputError
        Too few markers, a compression without a clear direction, or one across the scan's z axis, of which either end may be up.
    """
    whole = np.isfinite(initial).all(axis=1)
    first, states = initial[whole], [state[whole] for state in loaded]
    pressed = _jackknifed(lambda kept: _compression(first[kept], [state[kept] for state in states]), len(first))
    lattice = None if spacing_mm is None else _lattice(first, spacing_mm)
    if lattice is None:
        if pressed is None or pressed[1] > UNCERTAIN_DEG:
            why = "too few markers" if pressed is None else f"its standard error is {pressed[1]:.0f} degrees"
            raise InputError(
                f"the direction of compression cannot be found from the markers ({why}); state `vertical`, the direction away from the "
                "base, or give spacing_mm where the markers lie in a regular lattice"
            )
        direction, sd = pressed
        return ScanOrientation(_least_rotation(_upward(direction)), "direction of compression", sd)
    axes, sd = lattice
    guess = np.array([0.0, 0.0, 1.0]) if pressed is None or pressed[1] > APART_DEG / 2 else pressed[0]
    nearest = int(np.argmax(np.abs(axes @ guess)))
    apart = float(np.degrees(np.arccos(min(1.0, abs(axes[nearest] @ guess)))))
    if apart > APART_DEG:
        raise InputError(
            f"no axis of the marker lattice lies near the direction of compression ({apart:.0f} degrees off); state `vertical`, the "
            "direction away from the base, and check spacing_mm"
        )
    return ScanOrientation(_turned_least(_upward(axes[nearest]), np.delete(axes, nearest, axis=0)), "marker lattice", sd)


def turned_to_fit(orientation: ScanOrientation, initial: FloatArray, size_mm: Sequence[float]) -> ScanOrientation:
    """Turn an orientation about its vertical as little as is needed for the markers to fit into a box.

    Parameters
    ----------
    orientation : ScanOrientation
        Orientation whose turn about the vertical is open.
    initial : ndarray, shape (n, 3)
        Markers of the unloaded object in the axes of the scan, mm.
    size_mm : sequence of float, shape (3,)
        Size of the object along its own x, y, z, mm.

    Returns
    -------
    ScanOrientation
        The given one where the markers fit, or where no turn makes them fit.
    """
    points = initial[np.isfinite(initial).all(axis=1)] @ orientation.rotation.T
    for turn in sorted(np.arange(-90.0, 90.0 + TURN_STEP_DEG, TURN_STEP_DEG), key=abs):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if len(points) and (np.ptp(points @ about.T, axis=0)[:2] <= WITHIN * np.asarray(size_mm[:2])).all():
            source = orientation.source + (f", turned by {turn:g} degrees about the vertical to fit" if turn else "")
            return ScanOrientation(about @ orientation.rotation, source, orientation.sd_deg)
    return orientation


def _compression(first: FloatArray, states: Sequence[FloatArray]) -> FloatArray | None:
    """Unit vector (3,) of the least principal stretch, the mean over the states; None where too few markers are known."""
    total = np.zeros((3, 3))
    for state in states:
        known = np.isfinite(state).all(axis=1)
        if known.sum() < FEWEST:
            continue
        before, after = first[known] - first[known].mean(axis=0), state[known] - state[known].mean(axis=0)
        gradient, _, rank, _ = np.linalg.lstsq(before, after, rcond=1e-6)
        if rank < 3:
            continue
        total += gradient @ gradient.T  # C = F^T F, with F the transpose of `gradient`
    return None if not total.any() else np.asarray(np.linalg.eigh(total)[1][:, 0])


def _lattice(points: FloatArray, spacing: float) -> tuple[FloatArray, float] | None:
    """Orthonormal axes (3, 3), as rows, of a lattice and the standard error of the most uncertain, degrees; None where there is none."""
    axes = _lattice_axes(_steps(points, spacing))
    if axes is None:
        return None
    errors = []
    for k in range(3):
        found = _jackknifed(partial(_lattice_axis, axes, points, spacing, k), len(points))
        errors += [] if found is None else [found[1]]
    return (axes, max(errors)) if len(errors) == 3 else None


def _lattice_axes(steps: FloatArray) -> FloatArray | None:
    """Axes of a lattice, from steps between neighbours (m, 3), the best of several starts; None where the steps keep to no axes."""
    best, least = None, LATTICE_DEG
    if len(steps) < FEWEST_PAIRS:
        return None
    for first in steps[np.linspace(0, len(steps) - 1, SEEDS).astype(int)]:
        second = steps[np.argmin(np.abs(steps @ first))]
        start = np.linalg.qr(np.array([first, second, np.cross(first, second)]).T)[0].T
        found = _fitted(start, steps)
        angle = float(np.degrees(np.median(np.arccos(np.clip(np.abs(steps @ found.T).max(axis=1), 0.0, 1.0)))))
        if angle < least:
            best, least = found, angle
    return best


def _lattice_axis(start: FloatArray, points: FloatArray, spacing: float, k: int, kept: IntArray) -> FloatArray | None:
    """Axis k (3,) of the lattice of some of the points."""
    steps = _steps(points[kept], spacing)
    return None if len(steps) < FEWEST_PAIRS else np.asarray(_fitted(start, steps)[k])


def _steps(points: FloatArray, spacing: float) -> FloatArray:
    """Unit vectors (m, 3) between neighbours of a lattice."""
    i, j = np.triu_indices(len(points), 1)
    step = points[j] - points[i]
    length = np.linalg.norm(step, axis=1)
    near = np.abs(length - spacing) < NEAR * spacing
    return np.asarray(step[near] / length[near, None])


def _fitted(axes: FloatArray, steps: FloatArray) -> FloatArray:
    """Orthonormal axes, as rows, to which the steps are nearest, from a start: assignment and orthogonal Procrustes in turn."""
    for _ in range(ROUNDS):
        along = steps @ axes.T
        which = np.abs(along).argmax(axis=1)
        sign = np.sign(along[np.arange(len(steps)), which])
        target = np.zeros_like(steps)
        target[np.arange(len(steps)), which] = sign
        u, _, vt = np.linalg.svd(target.T @ steps)
        axes = u @ vt
    return np.asarray(axes)


def _jackknifed(direction: Callable[[IntArray], FloatArray | None], n: int) -> tuple[FloatArray, float] | None:
    """Direction (3,) without sign and its standard error, degrees, by leaving out every tenth of the markers in turn."""
    everything = np.arange(n)
    whole = direction(everything)
    parts = [direction(everything[everything % GROUPS != k]) for k in range(GROUPS)]
    if whole is None or any(part is None for part in parts):
        return None
    angles = [np.arccos(min(1.0, abs(float(whole @ part)))) for part in parts if part is not None]
    return whole, float(np.degrees(np.sqrt((GROUPS - 1) / GROUPS * np.sum(np.square(angles)))))


def _upward(direction: FloatArray) -> FloatArray:
    """Return the end of a direction that lies nearer to the scan's z axis."""
    up = direction if direction[2] >= 0.0 else -direction
    if np.degrees(np.arccos(min(1.0, up[2]))) > ACROSS_DEG:
        shown = ", ".join(f"{value:.3f}" for value in up)
        raise InputError(
            f"the vertical lies across the z axis of the scan, along ({shown}), and either end may be up; state `vertical`, the direction "
            "away from the base: these numbers, or those with the opposite signs"
        )
    return up


def _least_rotation(up: FloatArray) -> FloatArray:
    """Smallest rotation (3, 3) that turns a unit vector into z."""
    if up[2] <= -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = up
    return np.array([[1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), -x], [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), -y], [x, y, z]])


def _turned_least(up: FloatArray, others: FloatArray) -> FloatArray:
    """Rotation (3, 3) whose rows are `up` as z and the two other axes of a lattice as x and y, the one with the least angle."""
    frame = np.array([others[0], np.cross(up, others[0]), up])
    candidates = _QUARTERS @ frame
    return np.asarray(candidates[np.argmax(np.trace(candidates, axis1=1, axis2=2))])
