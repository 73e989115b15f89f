"""Tables of markers whose axes are tilted against the object: the orientation is found or stated, and all states are turned alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Loading, Shape
from naibu.core.markers import Markers
from naibu.imaging.markers.scan_orientation import ScanOrientation, found_orientation, stated_orientation, turned_to_fit

Vertical = Sequence[float] | Literal["found"] | None

PRESSED_FROM_ABOVE = ("plate", "bar", "cylinder")
# a tilt is told from so many degrees on, and so many standard errors; compression may be oblique, a lattice is built upright
TILTED_LATTICE_DEG, OBLIQUE_DEG, SURE = 3.0, 8.0, 4.0
SLACK = 1.05  # markers that span more than the object times this


@dataclass(frozen=True, slots=True, eq=False)
class UprightTables:
    """Tables whose z axis is the vertical of the object.

    Attributes
    ----------
    tables : mapping of str to Markers
        All states, in the axes of the object.
    orientation : ScanOrientation, optional
        The rotation; none where the tables are as they were.
    told : str
        How they were turned; empty where they were not.
    notes : tuple of str
        Warnings: markers that could not be turned, or tables that should be.
    """

    tables: Mapping[str, Markers]
    orientation: ScanOrientation | None
    told: str
    notes: tuple[str, ...]

    def turned_lengths(self, along_xy: float, along_z: float) -> tuple[float, float]:
        """Return the resolution, or the standard deviation, along x and y, and along z of the object: variances are added, mm."""
        if self.orientation is None:
            return along_xy, along_z
        x, y, z = np.sqrt(self.orientation.rotation**2 @ np.square([along_xy, along_xy, along_z]))
        return float(np.round(np.sqrt(0.5 * (x * x + y * y)), 6)), float(np.round(z, 6))


def upright_tables(
    tables: Mapping[str, Markers], vertical: Vertical, *, shape: Shape, loading: Loading, spacing_mm: float | None = None
) -> UprightTables:
    """Turn tables of markers into the axes of the object, all states alike.

    Parameters
    ----------
    tables : mapping of str to Markers
        All states, the unloaded one first.
    vertical : sequence of float or "found", optional
        Direction away from the base in the axes of the tables, or that it is found; by default the tables stay as they are.
    shape, loading, spacing_mm
        As of `naibu.io.write_experiment_folder`.

    Returns
    -------
    UprightTables
        A marker of which a coordinate is missing has none after it was turned.

    Raises
    ------
    InputError
        Markers in one plane, an object that is not pressed from above, a direction that cannot be found, or one that is none; without
        `vertical`, unloaded markers that span more than the object, and do not once the tilt of the scan is undone.
    """
    if vertical is None:
        return UprightTables(tables, None, "", _notes_on_tilt(tables, shape, loading, spacing_mm))
    orientation = _orientation(tables, vertical, shape, loading, spacing_mm)
    turned = {name: Markers(m.ids, np.round(m.points @ orientation.rotation.T, 6), m.trusted) for name, m in tables.items()}
    return UprightTables(turned, orientation, f"turned, {_told(orientation)}", _incomplete_markers(tables))


def _orientation(
    tables: Mapping[str, Markers], vertical: Vertical, shape: Shape, loading: Loading, spacing_mm: float | None
) -> ScanOrientation:
    first, *loaded = tables.values()
    if np.isnan(first.points[:, 2]).all():
        raise InputError("`vertical` cannot be given for markers in one plane: their y axis is the vertical")
    points = first.aligned(first.ids)
    if isinstance(vertical, str):
        if vertical != "found":
            raise InputError(f'vertical = {vertical!r} must be "found", or three numbers, a direction in the axes of the tables')
        if loading.kind not in PRESSED_FROM_ABOVE:
            raise InputError(
                "`vertical` cannot be found where side plates press: the direction of compression is horizontal; state three numbers, the "
                "direction away from the base in the axes of the tables"
            )
        orientation = found_orientation(points, [state.aligned(first.ids) for state in loaded], spacing_mm)
    else:
        orientation = stated_orientation(() if vertical is None else vertical)
    return turned_to_fit(orientation, points, shape.size_mm)


def _told(orientation: ScanOrientation) -> str:
    """Return the orientation in words."""
    direction = ", ".join(f"{value:.3f}" for value in orientation.vertical)
    error = f", standard error {orientation.sd_deg:.1f} degrees" if orientation.sd_deg else ""
    return f"vertical along ({direction}) of the tables, {orientation.tilt_deg:.1f} degrees from z ({orientation.source}{error})"


def _incomplete_markers(tables: Mapping[str, Markers]) -> tuple[str, ...]:
    """Return notes about markers that cannot be turned, because a coordinate is missing."""
    notes = []
    for name, markers in tables.items():
        known = np.isfinite(markers.points)
        if lost := int((known.any(axis=1) & ~known.all(axis=1)).sum()):
            notes.append(f"{name}: {lost} markers have a missing coordinate and cannot be turned; they count as missing")
    return tuple(notes)


def _notes_on_tilt(tables: Mapping[str, Markers], shape: Shape, loading: Loading, spacing_mm: float | None) -> tuple[str, ...]:
    """Refuse tables that fit into the object only once they are turned; return a note on a tilt that does not show in their span."""
    first = next(iter(tables.values()))
    points = first.aligned(first.ids)
    try:
        found = _orientation(tables, "found", shape, loading, spacing_mm)
    except InputError:
        return ()  # nothing can be said about a tilt
    spans, size = _spans(points), np.asarray(shape.size_mm, dtype=float)
    if (spans > SLACK * size).any() and (_spans(points @ found.rotation.T) <= SLACK * size).all():
        shown, measures = (" x ".join(f"{edge:.3g}" for edge in edges) for edges in (spans, size))
        raise InputError(
            f"the unloaded markers span {shown} mm, the object is {measures} mm: it stands tilted in the scan, {_told(found)}; it fits "
            "once the tables are turned. Give `vertical` as found, or state the direction away from the base"
        )
    least = TILTED_LATTICE_DEG if found.source.startswith("marker lattice") else OBLIQUE_DEG
    if found.tilt_deg > max(least, SURE * found.sd_deg):
        return (f"the object seems to stand tilted in the scan: {_told(found)}; vertical 'found' turns the tables",)
    return ()


def _spans(points: FloatArray) -> FloatArray:
    """Extent (3,) of points (n, 3), mm."""
    known = points[np.isfinite(points).all(axis=1)]
    return np.asarray(np.ptp(known, axis=0)) if len(known) else np.zeros(3)
