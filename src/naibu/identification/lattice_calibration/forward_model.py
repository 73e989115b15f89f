"""Forward model of lattice calibration: pushing, holding and releasing by rigid faces :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.identification.lattice_calibration.captured.force_history import ForceHistory
from naibu.identification.lattice_calibration.captured.shape_distance import checked_points, closest_points
from naibu.mechanics.contact.triangle_tree import TriangleTree
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, require_positive
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.model.surface import surface_of
from naibu.mechanics.lattices.simulation.tangent_linear import Loads, ParameterChange, driven_steps, rest_change

PushMode = Literal["displacement", "force"]
SAMPLE_S = 2e-3  # of the force sensor
QUICK_S = 0.06  # after a change of motion, in which long steps would smear the response of the dashpots


@dataclass(frozen=True, slots=True)
class PushedFace:
    """A rigid face that touches the nodes in a box at rest, and moves with a constant velocity during the push.

    Attributes
    ----------
    low, high : tuple of float
        Opposite corners of the box, mm; flat boxes are faces.
    velocity : tuple of float
        While pushing, mm/s.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    velocity: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Pushing:
    """A loading history of push, hold and release; the lowest nodes, on the floor, are fixed.

    Attributes
    ----------
    name : str
        For messages and tables.
    faces : tuple of PushedFace
        One for each force sensor.
    push_s, keep_s, free_s : float
        How long the indenters move, stand still, and the object is watched after they left, s.
    capture_s : tuple of float
        When the shape is captured, s.
    """

    name: str
    faces: tuple[PushedFace, ...]
    push_s: float
    keep_s: float
    free_s: float
    capture_s: tuple[float, ...]

    @property
    def contact_s(self) -> float:
        """How long the indenters touch the object, s."""
        return self.push_s + self.keep_s

    def touched(self, lattice: Lattice) -> tuple[IntArray, ...]:
        """Return the nodes that every indenter touches.

        Raises
        ------
        InputError
            An indenter that touches none, or inside of the object.
        """
        slack = 1e-6 * lattice.spacing_mm
        found = []
        for k, indenter in enumerate(self.faces):
            inside = ((lattice.points >= np.array(indenter.low) - slack) & (lattice.points <= np.array(indenter.high) + slack)).all(axis=1)
            if not inside.any():
                raise InputError(
                    f"{self.name}: indenter {k} between {indenter.low} and {indenter.high} mm touches no node; its box must contain some"
                )
            if not lattice.surface_node[inside].all():
                raise InputError(f"{self.name}: indenter {k} starts inside of the object; move its box to the surface")
            found.append(np.flatnonzero(inside))
        return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Measurements of a loading: captured surface points and forces.

    Attributes
    ----------
    pushing : Pushing
        What was done.
    points : tuple of ndarray, shape (k, 3)
        Captured surface points at every capture, mm.
    force : ndarray, shape (samples, indenters, 3)
        Force of every indenter on the object, mN: the mean over each `SAMPLE_S` from the start of the contact to its end.
    point_sd_mm, force_sd_mn : float
        Standard deviations of a coordinate and of a component.
    """

    pushing: Pushing
    points: tuple[FloatArray, ...]
    force: FloatArray
    point_sd_mm: float
    force_sd_mn: float

    @classmethod
    def of(
        cls, pushing: Pushing, points: Sequence[ArrayLike], force: ArrayLike, lattice: Lattice, *, point_sd_mm: float, force_sd_mn: float
    ) -> Capture:
        """Return checked measurements of an object with this lattice.

        Raises
        ------
        InputError
            Captures or samples that do not fit the times of the pushing, NaN, points far away from the object, or no spread.
        """
        require_positive(point_sd_mm, "the standard deviation of points", "mm")
        require_positive(force_sd_mn, "the standard deviation of forces", "mN")
        if len(points) != len(pushing.capture_s):
            raise InputError(
                f"{pushing.name}: {len(points)} sets of points for {len(pushing.capture_s)} times of capture; give one for each"
            )
        hull, reach = surface_of(lattice), float(np.linalg.norm(np.ptp(lattice.points, axis=0)))
        seen = tuple(checked_points(p, f"points of capture {k} of {pushing.name}") for k, p in enumerate(points))
        for k, cloud in enumerate(seen):
            far = np.abs(closest_points(cloud, hull, lattice.points).signed)
            if len(far) and far.max() > reach:
                raise InputError(
                    f"{pushing.name}: {int((far > reach).sum())} of {len(cloud)} captured points at {pushing.capture_s[k]:g} s lie up to "
                    f"{far.max():.4g} mm from the object, which is {reach:.4g} mm long: check the unit (mm) and the axes, or leave them out"
                )
        sampled = np.array(force, dtype=float)
        expected = (round(pushing.contact_s / SAMPLE_S), len(pushing.faces), 3)
        if sampled.shape != expected:
            raise InputError(
                f"{pushing.name}: forces of shape {sampled.shape}, but {pushing.contact_s:g} s of contact are {expected[0]} samples of "
                f"{1e3 * SAMPLE_S:g} ms: (samples, indenters, 3) = {expected}; resample them to the same times"
            )
        lost = ~np.isfinite(sampled).all(axis=(1, 2))
        if lost.any():
            raise InputError(
                f"{pushing.name}: {int(lost.sum())} force samples hold NaN, the first at {SAMPLE_S * int(np.argmax(lost)):g} s; fill them"
            )
        return cls(pushing, seen, sampled, point_sd_mm, force_sd_mn)


@dataclass(frozen=True, slots=True, eq=False)
class Reproduced:
    """Computed response to a loading: positions and forces.

    Attributes
    ----------
    positions : ndarray, shape (captures, n, 3)
        Of the nodes at the times of capture, mm.
    force : ndarray, shape (samples, indenters, 3)
        Forces of the indenters while they touch, mN, mean over each `PushedLattice.long_step`.
    positions_change : ndarray, shape (p, captures, n, 3)
        Derivatives along p directions of the parameters.
    force_change : ndarray, shape (p, samples, indenters, 3)
        Likewise.
    history : ForceHistory, optional
        What the forces are means of.
    """

    positions: FloatArray
    force: FloatArray
    positions_change: FloatArray
    force_change: FloatArray
    history: ForceHistory | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PushedLattice:
    """A lattice prepared for one loading, for any parameters.

    Attributes
    ----------
    lattice : Lattice
        The object.
    hull : TriangleTree
        Its surface.
    pushing : Pushing
        What is done.
    mode : str
        ``"displacement"``: touched nodes follow the indenters; ``"force"``: they share the measured forces by the area around them.
    step : float
        s.
    long_step : float
        Step, s, from `QUICK_S` after every change of motion on; the same as `step`, or a multiple.
    """

    lattice: Lattice
    hull: TriangleTree
    pushing: Pushing
    mode: PushMode
    step: float
    long_step: float
    floor: ConstrainedNodes
    constrained: ConstrainedNodes
    loads: Loads
    force: FloatArray

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        pushing: Pushing,
        mode: PushMode = "displacement",
        *,
        step: float = SAMPLE_S,
        long_step: float | None = None,
        force: FloatArray | None = None,
    ) -> PushedLattice:
        """Prepare a lattice.

        Parameters
        ----------
        lattice, pushing, mode, step, long_step
            See the attributes; steps must be whole numbers of force samples that divide all times of the pushing.
        force : ndarray, shape (samples, indenters, 3)
            Measured forces, mN; needed to push by force.

        Raises
        ------
        InputError
            An indenter that touches nothing, a step that does not divide the times, or no measured force to push by.
        """
        touched = pushing.touched(lattice)
        longest = step if long_step is None else long_step
        times = (pushing.push_s, pushing.contact_s, pushing.contact_s + pushing.free_s, *pushing.capture_s, longest, step)
        for divisor, of in ((longest, times[:-2]), (step, times[:-1]), (SAMPLE_S, times)):
            uneven = [t for t in of if abs(t / divisor - round(t / divisor)) > 1e-6]
            if uneven:
                raise InputError(f"{pushing.name}: {uneven[0]:g} s is no whole number of steps of {divisor:g} s; choose another step")
        z = lattice.points[:, 2]
        ground = np.flatnonzero(z < z.min() + 1e-6 * lattice.spacing_mm)
        floor, constrained, loads = ConstrainedNodes.of(ground, len(touched)), ConstrainedNodes.none(), Loads.none()
        measured = np.zeros((0, len(touched), 3))
        if mode == "force":
            if force is None:
                raise InputError(f"{pushing.name}: pushing by force needs the measured forces")
            measured = averaged(np.asarray(force, dtype=float), round(step / SAMPLE_S))
            fractions = [tributary_fractions(lattice, nodes) for nodes in touched]
            body = np.repeat(np.arange(len(touched)), [len(n) for n in touched])
            loads = Loads(np.concatenate(touched), np.concatenate(fractions), body)
        elif mode == "displacement":
            for k, nodes in enumerate(touched):
                constrained = constrained + ConstrainedNodes.of(np.setdiff1d(nodes, ground), k)
        else:
            raise InputError(f"pushing is by 'displacement' or 'force', not {mode!r}")
        return cls(lattice, surface_of(lattice), pushing, mode, float(step), float(longest), floor, floor + constrained, loads, measured)

    def run(self, parameters: LatticeParameters, changes: Sequence[ParameterChange] = (), *, tolerance: float = 1e-2) -> Reproduced:
        """Return the motion with these parameters, and its derivatives along changes of them."""
        bodies, ends, captures = len(self.pushing.faces), self._ends(), [round(t / self.step) for t in self.pushing.capture_s]
        ratio = round(self.long_step / self.step)
        engines = {k: LatticeEngine.of(self.lattice, parameters, step=k * self.step, tolerance=tolerance) for k in {1, ratio}}
        state, change = engines[1].rest(), rest_change(engines[1], len(changes))
        kept, kept_change, forces, forces_change = {0: state.position}, {0: change.position}, [], []
        moving = np.array([face.velocity for face in self.pushing.faces] + [(0.0, 0.0, 0.0)])
        for begin, end, each in self._pieces():
            touching = end <= ends[1]
            pushed = bool(len(self.loads.node)) and touching
            count = (end - begin) // each
            force = np.concatenate([averaged(self.force[begin:end], each), np.zeros((count, 1, 3))], axis=1) if pushed else 0.0
            run = driven_steps(
                engines[each],
                state,
                count,
                self.constrained if touching else self.floor,
                moving if end <= ends[0] else np.zeros_like(moving),
                loads=self.loads if pushed else None,
                force=force,
                changes=changes,
                state_change=change,
            )
            state, change = run.state, run.state_change
            kept[end], kept_change[end] = state.position, change.position
            if touching:
                forces.append(averaged(run.reaction[:, :bodies], ratio // each))
                forces_change.append(averaged(run.reaction_change[:, :, :bodies].swapaxes(0, 1), ratio // each).swapaxes(0, 1))
        return Reproduced(
            np.stack([kept[c] for c in captures]), np.concatenate(forces),
            np.stack([kept_change[c] for c in captures], axis=1), np.concatenate(forces_change, axis=1),
        )  # fmt: skip

    def _ends(self) -> list[int]:
        """Return the steps at which pushing, keeping and the whole end."""
        done = self.pushing.contact_s
        return [round(t / self.step) for t in (self.pushing.push_s, done, done + self.pushing.free_s)]

    def _pieces(self) -> list[tuple[int, int, int]]:
        """Return first and last step of stretches between changes of motion and captures, and how many steps are taken at once in each."""
        ends, ratio = self._ends(), round(self.long_step / self.step)
        quick = ratio * int(np.ceil(QUICK_S / self.long_step - 1e-9)) if ratio > 1 else 0
        starts = [0, *ends[:2]]
        captures = [round(t / self.step) for t in self.pushing.capture_s]
        stops = sorted({*starts, ends[2], *captures, *(min(k + quick, ends[2]) for k in starts)})
        return [(a, b, 1 if any(k <= a < k + quick for k in starts) else ratio) for a, b in pairwise(stops)]


def tributary_fractions(lattice: Lattice, nodes: IntArray) -> FloatArray:
    """Return the fraction (k,) of a force that each of the nodes of a flat patch takes.

    Rigid points in the middle of every face of a voxel take equal forces and hand a quarter to each corner (bilinear weights).
    """
    faces = surface_of(lattice).triangles
    mine = np.isin(faces, nodes).all(axis=1)
    if not mine.any():
        return np.full(len(nodes), 1.0 / len(nodes))
    corners = faces[mine]
    edge = np.stack([lattice.points[corners[:, (k + 1) % 3]] - lattice.points[corners[:, (k + 2) % 3]] for k in range(3)], axis=1)
    length = np.linalg.norm(edge, axis=2)
    area = 0.5 * np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
    # a face is two triangles that share its diagonal: a corner off it gets half of its triangle, one on it a quarter of both
    part = np.where(length == length.max(axis=1, keepdims=True), 0.5, 0.25) * area[:, None]
    quarter = np.bincount(corners.ravel(), part.ravel(), minlength=lattice.n_nodes)
    fraction = quarter[nodes]
    return np.asarray(fraction / fraction.sum())


def averaged(samples: FloatArray, count: int) -> FloatArray:
    """Return the means of every `count` samples in a row."""
    return np.asarray(samples.reshape(len(samples) // count, count, *samples.shape[1:]).mean(axis=1))
