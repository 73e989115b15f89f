"""Reader of experiment folders: `meta.toml` and one marker table per state."""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Axis, Experiment, Layer, Shape, ShapeKind, State
from naibu.core.markers import Markers
from naibu.io.experiment_folder.indenter_description import read_joints, read_loading, read_up_axis
from naibu.io.experiment_folder.schema import CoordinatesTable, LoadingTable, Meta, StateTable, load_meta
from naibu.io.experiment_folder.state_csv import COORDINATES, parse_state_csv
from naibu.io.files.paths import require_usable_path
from naibu.io.files.reading import file_beside, guarded_reading, read_bytes

META_FILE = "meta.toml"
_SHAPES: dict[str, ShapeKind] = {
    "box": "box",
    "block": "box",
    "cube": "box",
    "half ellipsoid": "half_ellipsoid",
    "half_ellipsoid": "half_ellipsoid",
    "cylinder": "cylinder",
    "hemisphere": "hemisphere",
}
_MIN_COMMON = 4
_OUTSIDE_MM = 2.0


def read_experiment(folder: str | os.PathLike[str]) -> Experiment:
    """Read and check an experiment folder.

    Parameters
    ----------
    folder : path-like
        Folder with `meta.toml` and, for each state, its marker table (`file` of the state, else ``<name>.csv``).

    Returns
    -------
    Experiment
        Coordinates as stored in the files, mm. Values taken from free text are recorded in `loading.assumed`.

    Raises
    ------
    InputError
        A file is missing, unreadable or contains an impossible value; the message names file, field, value and correction.
    """
    root = require_usable_path(folder)
    with guarded_reading(root):
        return _read(root)


def _read(root: Path) -> Experiment:
    hashes: dict[str, str] = {}
    meta = load_meta(root / META_FILE, _content(root, META_FILE, hashes, f"an experiment is a folder with a {META_FILE} in it"))
    experiment = _experiment(root, meta, hashes)
    _check_positions(root, meta, experiment)
    return experiment


def _experiment(root: Path, meta: Meta, hashes: dict[str, str]) -> Experiment:
    path, scan, lattice = root / META_FILE, meta.coordinates, meta.markers
    assumed: list[str] = []
    up = read_up_axis(meta, assumed)
    shape = _shape(path, meta, up, assumed)
    height = shape.size_mm["xyz".index(up)]
    states = _states(root, meta, hashes, assumed)
    joints = _joints(path, meta, height, assumed)
    loading = read_loading(path, meta, up)
    return Experiment(
        name=root.resolve().name,
        title=meta.title,
        source=meta.source,
        shape=shape,
        layers=_layers(path, meta, height),
        loading=replace(loading, assumed=(*loading.assumed, *assumed)),
        states=_with_heights(path, meta.loading, loading.kind == "side_plates", states, meta.state),
        joined_at_mm=joints,
        nominal_spacing_mm=lattice.nominal_spacing_mm,
        nominal_margin_mm=lattice.nominal_margin_mm,
        nominal_heights_mm=tuple(lattice.nominal_height_above_base_mm),
        base_z_mm=scan.z_base_est_mm,
        xy_scale=scan.xy_scale_probable,
        xy_step_mm=scan.pixel_mm or scan.xy_step_mm or scan.step_mm or 0.0,
        z_step_mm=scan.z_step_mm or scan.step_mm or 0.0,
        sd_mm=_stated_sd(path, scan),
        up_axis=up,
        dimensions=meta.dimensions,
        known_problems=tuple(meta.known_problems),
        scanner=meta.scanner.model_dump(exclude_none=True),
        input_hashes=hashes,
    )


def _stated_sd(path: Path, scan: CoordinatesTable) -> tuple[float, float, float] | None:
    """Return the standard deviation of a coordinate along x, y, z, mm, where the file states it."""
    if (scan.xy_sd_mm is None) != (scan.z_sd_mm is None):
        raise InputError(f"{path}: [coordinates] states xy_sd_mm or z_sd_mm alone; write both, or neither")
    return None if scan.xy_sd_mm is None or scan.z_sd_mm is None else (scan.xy_sd_mm, scan.xy_sd_mm, scan.z_sd_mm)


def _content(root: Path, file: str, hashes: dict[str, str], mend: str) -> bytes:
    path = root / file
    try:
        content = read_bytes(path)
    except InputError as error:
        raise InputError(f"{path}: there is no such file; {mend}" if not path.exists() else f"{error}; {mend}") from error
    hashes[file] = hashlib.sha256(content).hexdigest()
    return content


def _shape(path: Path, meta: Meta, up: Axis, assumed: list[str]) -> Shape:
    words, size, axes = meta.object.shape, meta.object.size_mm, meta.object.size_axes
    kind = _SHAPES.get(words) or next((k for name, k in _SHAPES.items() if words.startswith(f"{name},")), None)
    if kind is None:
        close = difflib.get_close_matches(words, _SHAPES, n=1)
        mend = f"did you mean {close[0]!r}?" if close else f"use one of {', '.join(_SHAPES)}"
        raise InputError(f"{path}: [object] shape = {words!r} is not known; {mend}")
    if axes is None and meta.dimensions == 2 and up == "y":
        # plane data give width, depth, height; the depth is the direction that was not measured
        axes = ["x", "z", "y"]
        assumed.append(f"size_mm = {size} is taken as width (x), depth (z), height (y), as the markers lie in one vertical plane.")
    axes = axes or ["x", "y", "z"]
    if len(set(axes)) != 3:
        raise InputError(f'{path}: [object] size_axes = {axes} names an axis twice; write each once, for example ["x", "y", "z"]')
    along = dict(zip(axes, size, strict=True))
    base = meta.object.straight_base_mm
    if base is not None and kind != "half_ellipsoid":
        raise InputError(f"{path}: [object] straight_base_mm is the straight-sided part below a half ellipsoid; leave it out for a {words}")
    return Shape(kind, (along["x"], along["y"], along["z"]), base)


def _joints(path: Path, meta: Meta, height: float, assumed: list[str]) -> tuple[float, ...]:
    joints = read_joints(meta, assumed)
    for joint in joints:
        if not 0 < joint < height:
            raise InputError(f"{path}: [object] joined_at_mm = {joint:g} must lie between 0 and {height:g} mm, the height of the object")
    return joints


def _layers(path: Path, meta: Meta, height: float) -> tuple[Layer, ...]:
    if not meta.layer:
        return (Layer(meta.object.material, 0.0, height),)
    mend = f"layers must follow each other from 0 to {height:g} mm, the object's height"
    below = 0.0
    for number, layer in enumerate(meta.layer, start=1):
        low, high = layer.from_base_mm
        where = f"{path}: [[layer]] number {number} from_base_mm = [{low:g}, {high:g}]"
        if high <= low:
            raise InputError(f"{where}: the upper height must be greater than the lower; {mend}")
        if abs(low - below) > 1e-6:
            kind = "leaves a gap above" if low > below else "overlaps what ends at"
            raise InputError(f"{where} {kind} {below:g} mm; {mend}")
        below = high
    if abs(below - height) > 1e-6:
        raise InputError(f"{path}: [[layer]] number {len(meta.layer)} from_base_mm ends at {below:g} mm; {mend}")
    return tuple(Layer(layer.material, layer.from_base_mm[0], layer.from_base_mm[1], layer.batch) for layer in meta.layer)


def _states(root: Path, meta: Meta, hashes: dict[str, str], assumed: list[str]) -> list[State]:
    names = [table.name for table in meta.state]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{root / META_FILE}: [[state]] name = {name!r} is given {names.count(name)} times; every state needs its own")
    states: list[State] = []
    for table in meta.state:
        file = table.file or f"{table.name}.csv"
        if table.file:
            file_beside(root / META_FILE, table.file)
        first = not states
        held_out = table.held_out and not first and not (root / file).exists()
        mend = "add it" + ("" if first else f", or set held_out = true in [[state]] {table.name!r} of {META_FILE}")
        markers = None if held_out else parse_state_csv(root / file, _content(root, file, hashes, mend), meta.dimensions)
        states.append(State(table.name, markers, what=table.what, loaded=not first and _is_loaded(table, assumed)))
    return states


def _is_loaded(table: StateTable, assumed: list[str]) -> bool:
    if table.loaded is not None:
        return table.loaded
    if re.search(r"^(free|no load)$|\bbefore loading\b|\blifted\b", table.what):
        assumed.append(f"State {table.name!r} is taken as not loaded, because it is described as {table.what!r}.")
        return False
    return True


def _with_heights(path: Path, loading: LoadingTable, sideways: bool, states: list[State], tables: list[StateTable]) -> tuple[State, ...]:
    """Add to every loaded state its stated and estimated height, or distance between the side plates."""
    used, other = ("width", "height") if sideways else ("height", "width")
    for source in (loading, *tables):
        for key in (f"{other}_stated_mm", f"{other}_est_mm"):
            if getattr(source, key) is not None:
                raise InputError(
                    f"{path}: {key} = {getattr(source, key)} does not fit this kind of loading; use {key.replace(other, used)}"
                )
    loaded = [state.name for state in states if state.loaded]
    stated = _one_per_state(path, f"{used}_stated_mm", getattr(loading, f"{used}_stated_mm"), loaded, whole=True)
    estimated = _one_per_state(path, f"{used}_est_mm", getattr(loading, f"{used}_est_mm"), loaded, whole=False)
    return tuple(
        replace(
            state,
            stated_mm=getattr(table, f"{used}_stated_mm") or stated.get(state.name),
            estimated_mm=getattr(table, f"{used}_est_mm") or estimated.get(state.name),
        )
        for state, table in zip(states, tables, strict=True)
    )


def _one_per_state(path: Path, key: str, values: list[float] | None, loaded: list[str], *, whole: bool) -> dict[str, float]:
    if values is None:
        return {}
    if len(values) > len(loaded) or (whole and len(values) != len(loaded)):
        raise InputError(
            f"{path}: [loading] {key} = {values} has {len(values)} values for {len(loaded)} loaded states ({', '.join(loaded)}); "
            "write a list with one number for each, in their order"
        )
    return dict(zip(loaded, values, strict=False))


def _check_positions(root: Path, meta: Meta, experiment: Experiment) -> None:
    """Raise an error for positions that cannot belong to one object: too far apart, too close, or without common markers."""
    scale = np.array([experiment.xy_scale, experiment.xy_scale, 1.0])
    size = np.array(experiment.shape.size_mm)
    measures = " x ".join(f"{length:g}" for length in size)
    files = [table.file or f"{table.name}.csv" for table in meta.state]
    _refuse_outside(root / files[0], experiment.initial, scale, size + _OUTSIDE_MM, f"the object is {measures} mm (+ {_OUTSIDE_MM:g} mm)")
    _refuse_too_close(root / files[0], experiment)
    _refuse_upside_down(root, meta, experiment)
    seen = slice(0, experiment.dimensions)
    for file, state in zip(files[1:], experiment.states[1:], strict=True):
        if state.markers is None:
            continue
        both = experiment.initial.aligned(state.markers.ids)[:, seen] + state.markers.aligned(state.markers.ids)[:, seen]
        common = int(np.isfinite(both).all(axis=1).sum())
        if common < _MIN_COMMON:
            raise InputError(
                f"{root / file}: only {common} markers are complete and trusted both here and in {files[0]}, {_MIN_COMMON} are needed; "
                "the same marker must have the same number in every state"
            )
        # a flattened body spreads, but not to twice its longest side
        limit = np.full(3, 2 * size.max() + _OUTSIDE_MM)
        _refuse_outside(root / file, state.markers, scale, limit, f"the undeformed object is {measures} mm")


def _refuse_outside(path: Path, markers: Markers, scale: FloatArray, limit: FloatArray, why: str) -> None:
    ids, points = markers.ids[markers.trusted], markers.points[markers.trusted] * scale
    for axis, name in enumerate(COORDINATES):
        values = points[:, axis]
        if not np.isfinite(values).any() or np.nanmax(values) - np.nanmin(values) <= limit[axis]:
            continue
        worst = int(np.nanargmax(np.abs(values - np.nanmedian(values))))
        raise InputError(
            f"{path}: {name} spans {np.nanmax(values) - np.nanmin(values):.1f} mm, but {why}; farthest off is marker {ids[worst]} "
            f"with {name} = {markers.points[markers.trusted][worst, axis]:g}. Check that value, the unit (mm) and size_mm in {META_FILE}"
        )


def _refuse_upside_down(root: Path, meta: Meta, experiment: Experiment) -> None:
    """Raise an error if the markers of a layer lie below those of the layer under it."""
    axis, below = "xyz".index(experiment.up_axis), None
    for number, layer in enumerate(meta.layer, start=1):
        if layer.markers is None:
            continue
        first, last = layer.markers
        known = experiment.initial.points[(experiment.initial.ids >= first) & (experiment.initial.ids <= last) & experiment.initial.trusted]
        heights = known[np.isfinite(known[:, axis]), axis]
        if len(heights) == 0:
            continue
        height = float(np.median(heights))
        if below is not None and height < below:
            raise InputError(
                f"{root / META_FILE}: [[layer]] number {number} has markers {first} to {last}, which lie lower than those of the layer "
                f"under it ({height:.1f} and {below:.1f} mm, medians of {experiment.up_axis}); in every table {experiment.up_axis} must "
                "point away from the base, and layers follow each other from the base up"
            )
        below = height


def _refuse_too_close(path: Path, experiment: Experiment) -> None:
    """Raise an error if neighbouring markers are closer than half the stated spacing: centimetres or metres labelled mm."""
    nominal, dimensions = experiment.nominal_spacing_mm, experiment.dimensions
    points = experiment.initial.points[:, :dimensions]
    points = points[np.isfinite(points).all(axis=1)]
    if nominal is None or len(points) < _MIN_COMMON:
        return
    squared = ((points[:, None, :] - points[None, :, :]) ** 2).sum(axis=2)
    np.fill_diagonal(squared, np.inf)
    spacing = float(np.median(np.sqrt(squared.min(axis=1))))
    if spacing < 0.5 * nominal:
        raise InputError(
            f"{path}: neighbouring markers are {spacing:.3g} mm apart, but {META_FILE} says nominal_spacing_mm = {nominal:g}; "
            "check the unit of the coordinates (they must be mm) and nominal_spacing_mm"
        )
