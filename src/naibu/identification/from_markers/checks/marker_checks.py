"""Can the markers belong together? Size, orientation, order and motion of marker clouds are compared before anything is solved.

What no loading can do to a body is refused: a mirror image, other units, labels without order
(`naibu.imaging.markers.linking.motion_coherence`), and what contradicts the loading. What is only unlikely is returned as doubts, which
the verdict on the result takes up. They are judged by the best affine map from the reference configuration to a loaded state: its
determinant is the ratio of volumes, its right stretch tensor tells along which axis the body was shortened (:cite:p:`bonet2008`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import polar

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, State
from naibu.core.rigid_transform import RigidTransform, registration
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.neighbours import neighbours
from naibu.imaging.markers.linking.motion_coherence import require_coherent

FEWEST = 8  # markers of which an affine map says something about the rest
COINCIDENT_MM = 1e-3
FLAT = 0.02  # a cloud is flat where its thickness is below this fraction of its extent: it determines no affine map
SMALLEST_SPAN, SMALL_SPAN = 0.2, 0.33  # of the markers over the size of the object; refused, doubtful
SMALLEST_SPAN_ALONG, THICK = 0.1, 0.2  # the same along the axis of loading alone, of a cloud that is no layer
HIGHEST = 1.05  # of a stated height over the height at which the indenter touches the object
UNLIKELY_VOLUME = 0.3, 1.35
GROWN = 1.02  # stretch along the axis of loading beyond which a body was not pressed there
MOVED_PERCENTILE, STILL = 90.0, 1.8  # of the distances from the rigid motion; below so many times the noise (noise alone: 1.44)
FLATTENED = 0.4  # of the stretch of the markers: a plate at a lower height would have flattened what they do not see to nothing
REVERSED = 3.0  # logarithm of the ratio of likelihoods from which on z is taken to be reversed
SHIFT_MM, TURNED_DEG = 1.0, 20.0  # least standard deviation of the shift between two scans; a turn by more is another frame
BELIEVED = 0.25  # of the stated compression must be seen in the markers, or else it is doubtful


@dataclass(frozen=True, slots=True)
class Doubt:
    """Something about the data that is unlikely, in words; a grave one alone makes the result unusable."""

    text: str
    grave: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Markers known in both states, mm, `free` in the frame of the reference scan; `matrix` and `at` of the best affine map."""

    label: str
    ids: IntArray
    free: FloatArray
    loaded: FloatArray
    matrix: FloatArray
    affine: FloatArray
    pose: RigidTransform


def check_markers(experiments: Sequence[Experiment], states: Mapping[str, Sequence[str]] | None = None) -> tuple[Doubt, ...]:
    """Refuse markers that cannot be those of the object in the states described, and return what is doubtful about the others.

    Parameters
    ----------
    experiments : sequence of Experiment
        Those that are not three-dimensional with z up are passed over: identification does not cover them.
    states : mapping, optional
        States to use, by experiment; all measured ones by default.

    Raises
    ------
    InputError
        Markers that coincide; a size or a stated height that the markers rule out; labels that do not correspond; a mirror image, other
        units, swapped states or axes; no motion although a height is stated.
    """
    doubts: list[Doubt] = []
    for e in experiments:
        if e.dimensions != 3 or e.up_axis != "z":
            continue
        _refuse_coincident(f"{e.name}/{e.states[0].name}", e.initial.ids[e.initial.trusted], e.initial.points[e.initial.trusted])
        doubts += _span_doubts(e)
        motions = []
        for name in (states or {}).get(e.name, [s.name for s in e.loaded_states]):
            state = e.state(name)
            if state.markers is None:
                continue
            _check_stated(e, state)
            _refuse_coincident(f"{e.name}/{name}", state.markers.ids[state.markers.trusted], state.markers.points[state.markers.trusted])
            if (motion := _motion(e, state)) is not None:
                require_coherent(motion.free, motion.loaded, f"{motion.label} against {e.states[0].name}")
                doubts += _motion_doubts(e, state, motion)
                motions.append(motion)
        doubts += _upside_down(e, motions)
    return tuple(doubts)


def _refuse_coincident(label: str, ids: IntArray, points: FloatArray) -> None:
    """Refuse two labels at one point."""
    whole = np.isfinite(points).all(axis=1)
    ids, points = ids[whole], points[whole]
    if len(points) < 2:
        return
    if np.ptp(points, axis=0).max() < COINCIDENT_MM:
        at = ", ".join(f"{v:g}" for v in points[0])
        raise InputError(f"{label}: all {len(points)} markers lie at one point ({at} mm); check the columns of its table")
    distance, nearest = neighbours(points, 1)
    if (same := np.flatnonzero(distance[:, 0] < COINCIDENT_MM)).size:
        first, second = sorted((int(ids[same[0]]), int(ids[nearest[same[0], 0]])))
        at = ", ".join(f"{v:g}" for v in points[same[0]])
        more = f" ({same.size} markers coincide with another)" if same.size > 2 else ""
        raise InputError(
            f"{label}: markers {first} and {second} lie at the same point ({at} mm){more}; correct one, or set its status to suspect"
        )


def _loading_axis(e: Experiment) -> int:
    return "xyz".index(e.loading.bar_axis) if e.loading.kind == "side_plates" else 2


def _span_doubts(e: Experiment) -> list[Doubt]:
    """Compare the extent of the markers with the size of the object."""
    points = e.initial.points[e.initial.trusted] * [e.xy_scale, e.xy_scale, 1.0]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 2:
        return []
    span, size = np.ptp(points, axis=0), np.array(e.shape.size_mm)
    part, axis = span / size, _loading_axis(e)
    spans, sizes = (" x ".join(f"{v:.3g}" for v in values) for values in (span, size))
    if part.max() < SMALLEST_SPAN:
        raise InputError(
            f"{e.name}: the markers span {spans} mm, but size_mm says that the object has {sizes} mm, "
            f"{1.0 / part.max():.0f} times as much; check the unit of size_mm and of the coordinates (both must be mm)"
        )
    if part[axis] < SMALLEST_SPAN_ALONG and span[axis] > THICK * span.max():
        raise InputError(
            f"{e.name}: the markers span {span[axis]:.3g} mm along {'xyz'[axis]}, the direction of loading, but size_mm says "
            f"{size[axis]:g} mm; check size_mm and the order of the axes"
        )
    if part[axis] < SMALL_SPAN:
        return [Doubt(f"the markers of {e.name} span only {100 * part[axis]:.0f} % of its size along {'xyz'[axis]}")]
    return []


def _check_stated(e: Experiment, state: State) -> None:
    """Refuse heights that lie above the object."""
    what = "width" if e.loading.kind == "side_plates" else "height"
    full = e.full_platen_position_mm
    for name, value in ((f"{what}_stated_mm", state.stated_mm), (f"{what}_est_mm", state.estimated_mm)):
        if value is not None and value > HIGHEST * full:
            raise InputError(
                f"{e.name}/{state.name}: {name} = {value:g} mm, but the undeformed object has {full:g} mm there and is not touched; "
                f"check {name} and size_mm (both in mm)"
            )


def _motion(e: Experiment, state: State) -> _Motion | None:
    """Return the markers known in both states and the affine map between them; None where they determine none."""
    scale = np.array([e.xy_scale, e.xy_scale, 1.0])
    ids = e.initial.ids
    free = e.initial.aligned(ids) * scale
    loaded = state.markers.aligned(ids) * scale if state.markers is not None else np.full_like(free, np.nan)
    whole = np.isfinite(free).all(axis=1) & np.isfinite(loaded).all(axis=1)
    ids, free, loaded = ids[whole], free[whole], loaded[whole]
    if len(free) < FEWEST:
        return None
    thickness = np.linalg.svd(free - free.mean(axis=0), compute_uv=False)
    if thickness[2] < FLAT * thickness[0]:
        return None
    matrix, affine = robust_affine(free, loaded)
    return _Motion(f"{e.name}/{state.name}", ids, free, loaded, matrix, affine, registration(free, loaded))


def robust_affine(points: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return matrix (3, 3) and images (k, 3) of the affine map of least absolute distance, by iteratively reweighted least squares."""
    design = np.column_stack([points - points.mean(axis=0), np.ones(len(points))])
    weight, smallest = np.ones(len(points)), 1e-3 * float(np.linalg.norm(design[:, :3], axis=1).mean())
    for _ in range(30):
        found = np.linalg.lstsq(design * weight[:, None], measured * weight[:, None], rcond=None)[0]
        weight = 1.0 / np.sqrt(np.maximum(np.linalg.norm(measured - design @ found, axis=1), smallest))
    return np.asarray(found[:3].T), np.asarray(design @ found)


def _motion_doubts(e: Experiment, state: State, m: _Motion) -> list[Doubt]:
    """Compare the stretches with the loading; refuse what contradicts it."""
    stretch = polar(m.matrix)[1]
    axis, full = _loading_axis(e), e.full_platen_position_mm
    expected = state.estimated_mm or state.stated_mm
    along, name = float(stretch[axis, axis]), "xyz"[axis]
    noise = float(np.sqrt(2.0) * np.linalg.norm(NoiseModel().of_experiment(e)))
    # a bar may move few of the markers, and an outlier is no motion
    deformation = float(np.percentile(np.linalg.norm(m.loaded - m.pose.applied(m.free), axis=1), MOVED_PERCENTILE))
    if deformation < STILL * noise:
        if expected is not None and full - expected > 5.0 * noise:
            raise InputError(
                f"{m.label}: the markers did not move against each other (by {deformation:.2f} mm; the noise is {noise:.2f} mm), although "
                f"the stated {expected:g} mm means a compression by {full - expected:.3g} mm; check its table, or set loaded = false"
            )
        return [Doubt(f"{m.label} shows no deformation beyond the noise ({deformation:.2f} mm)", grave=True)]
    if along > GROWN:
        _refuse_growth(m, stretch, name, along)
    if e.loading.kind != "bar" and expected is not None and expected < FLATTENED * along * full:
        raise InputError(
            f"{m.label}: a height or width of {expected:g} mm would leave {100 * expected / full:.0f} % of the object's {full:g} mm, but "
            f"the distances of its markers along {name} are {100 * along:.0f} % of what they were; check the unit of the stated height (mm)"
        )
    doubts = []
    volume = float(np.linalg.det(m.matrix))
    if not UNLIKELY_VOLUME[0] < volume < UNLIKELY_VOLUME[1]:
        doubts.append(Doubt(f"the markers of {m.label} enclose {volume:.2f} times the volume that they had"))
    if expected is not None and not BELIEVED * (full - expected) - noise < (1.0 - along) * full < (full - expected) / BELIEVED + noise:
        doubts.append(
            Doubt(
                f"the markers of {m.label} are shortened along {name} by {100 * (1.0 - along):.0f} %, "
                f"but {expected:g} mm of {full:g} mm mean {100 * (1.0 - expected / full):.0f} %"
            )
        )
    return doubts


def _refuse_growth(m: _Motion, stretch: FloatArray, name: str, along: float) -> None:
    shortest = int(np.argmin(np.diag(stretch)))
    least = float(stretch[shortest, shortest])
    if least < 2.0 - along:
        why = f"it is shortened along {'xyz'[shortest]} (to {least:.2f}): are the axes exchanged, or is the loading another one?"
    else:
        why = "are the reference configuration and the loaded state exchanged?"
    raise InputError(f"{m.label}: the object is pressed along {name}, but its markers are stretched there (to {along:.2f} times); {why}")


def _upside_down(e: Experiment, motions: Sequence[_Motion]) -> list[Doubt]:
    """Doubt the direction of z where the highest markers stay and the lowest rise, as if the base were on top.

    How well scans share a frame is told by the shifts sideways, which loading does not cause. With their standard deviation, the shifts of
    the lowest layer (which stays if z points up) and of the highest (which stays if z points down) give the ratio of the likelihoods.
    """
    if e.loading.kind == "side_plates":
        return []
    evidence, told = 0.0, ""
    for m in motions:
        shift, z, rise = m.loaded.mean(axis=0) - m.free.mean(axis=0), m.free[:, 2], m.loaded[:, 2] - m.free[:, 2]
        band = 0.2 * float(np.ptp(z))
        low, high = float(rise[z < z.min() + band].mean()), float(rise[z > z.max() - band].mean())
        if m.pose.angle_deg < TURNED_DEG:
            evidence += (low**2 - high**2) / (2.0 * max(0.5 * float(shift[0] ** 2 + shift[1] ** 2), SHIFT_MM**2))
            told = told or f"in {m.label} the lowest markers rise by {low:.1f} mm, the highest by {high:.1f} mm"
    if evidence < REVERSED:
        return []
    text = f"{told}: z seems to point towards the base (if the base moved and not the indenter, subtract its motion from z)"
    return [Doubt(text, grave=len(e.layers) > 1)]
