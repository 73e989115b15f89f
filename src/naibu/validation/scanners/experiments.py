"""Virtual scans of whole experiments: of virtual specimens, and of the measured marker states of the report."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment, State
from naibu.core.volume import Volume
from naibu.validation.scanners.ct_mr import STEEL_WASHER, MarkerKind, VirtualObject, VirtualScan, empty_grid, scan
from naibu.validation.scanners.imaging_artifacts import CTDevice, Device
from naibu.validation.scanners.motions import MatchedMotion, MeshMotion, Motion, PosedMotion, Still
from naibu.validation.scanners.textures import Intensity, Texture, layered_block
from naibu.validation.specimens.marker_phantoms import Scanner, VirtualSpecimen


def rescanned(
    experiment: Experiment,
    *,
    spacing_mm: ArrayLike = (0.58, 0.58, 1.0),
    kind: MarkerKind = STEEL_WASHER,
    device: Device | None = None,
    reach_mm: float = 9.0,
    seed: int = 0,
) -> Mapping[str, VirtualScan]:
    """Scan the measured marker states of an experiment with a virtual scanner.

    The body is all within `reach_mm` of a marker of the reference state; between the markers its texture follows a thin-plate spline. Each
    state is a scan of its own, with its own noise; markers that are missing or not trusted in a state are not in its scan.

    Parameters
    ----------
    experiment : Experiment
        Measured in three dimensions.
    spacing_mm : array_like, shape (3,)
        Spacing of the voxels along x, y, z, mm.
    kind : MarkerKind
        Shape and intensity of the markers.
    device : Device, optional
        `CTDevice` by default.
    reach_mm, seed : float, int
        Thickness of gel around the outermost markers, mm; seed of texture and noise.

    Returns
    -------
    mapping of str to VirtualScan
        By name of the state, for every state with positions.

    Raises
    ------
    InputError
        Fewer than five markers are complete in a state and in the reference state.
    """
    scans: dict[str, VirtualScan] = {}
    free = experiment.states[0]
    rest, _ = _complete(free)
    texture, near = Texture.drawn(4.0, seed=seed), cKDTree(rest)

    def intensity(material: FloatArray) -> FloatArray:
        return np.where(near.query(material)[0] < reach_mm, 1040.0 + 7.0 * texture(material), 0.0)

    for number, state in enumerate(s for s in experiment.states if s.markers is not None):
        points, ids = _complete(state)
        known = experiment.initial.aligned(ids)
        both = np.isfinite(known).all(axis=1)
        motion: Motion = Still() if state is free else MatchedMotion(known[both], points[both])
        shown = VirtualObject.of(intensity, points, kind, ids=ids)
        grid = empty_grid(points.min(axis=0) - reach_mm - 2.0, points.max(axis=0) + reach_mm + 2.0, spacing_mm)
        scans[state.name] = scan(shown, _Elsewhere(motion, grid), grid, device or CTDevice(), seed=seed + 100 * number, samples=1)
    return scans


def scanned_states(
    specimen: VirtualSpecimen,
    *,
    intensity: Intensity | None = None,
    spacing_mm: ArrayLike = (0.58, 0.58, 1.0),
    kind: MarkerKind = STEEL_WASHER,
    device: Device | None = None,
    poses: Scanner | None = None,
    margin_mm: float = 3.0,
    samples: int = 1,
    seed: int = 0,
) -> dict[str, VirtualScan]:
    """Scan every state of a virtual specimen, each in a pose of its own.

    Parameters
    ----------
    specimen : VirtualSpecimen
        With the solutions of its loaded states (`naibu.validation.specimens.marker_phantoms.virtual_specimen`).
    intensity : callable, optional
        Intensity (n,) at points (n, 3), mm, of the reference configuration; by default a gel with a little texture and brighter layers
        higher up.
    spacing_mm : array_like, shape (3,)
        Spacing of the voxels along x, y, z, mm.
    kind : MarkerKind
        Shape and intensity of the markers.
    device : Device, optional
        `CTDevice` by default.
    poses : Scanner, optional
        Random translation, rotation and tilt of the object from scan to scan; by default 5 mm, 5 and 0.5 degrees.
    margin_mm : float
        Air around the object, mm.
    samples, seed : int
        See `naibu.validation.scanners.ct_mr.scan`; poses and noise are drawn anew for every state.

    Returns
    -------
    dict of str to VirtualScan
        By name of the state, the reference state first.
    """
    experiment, nodes = specimen.experiment, specimen.model.mesh.points
    shown = intensity or layered_block(
        experiment.shape.size_mm, [(1040.0 + 30.0 * n, at.to_base_mm) for n, at in enumerate(experiment.layers)], seed=seed
    )
    body = VirtualObject.of(shown, specimen.free, kind, ids=experiment.initial.ids)
    placed, rng = poses or Scanner(shift_mm=5.0, tilt_deg=0.5), np.random.default_rng([seed, 17])
    scans: dict[str, VirtualScan] = {}
    for number, state in enumerate(experiment.states):
        loaded = specimen.solutions.get(state.name)
        motion: Motion = Still() if loaded is None else MeshMotion(specimen.model.mesh, loaded.displacement)
        pose = placed.pose(rng, upright=number == 0)
        around = pose.applied(motion.to_space(nodes))
        grid = empty_grid(around.min(axis=0) - margin_mm, around.max(axis=0) + margin_mm, spacing_mm)
        scans[state.name] = scan(body, PosedMotion(motion, pose), grid, device or CTDevice(), seed=seed + 100 * number, samples=samples)
    return scans


class _Elsewhere:
    """Texture after a slow motion, tabulated every few voxels; markers are not moved."""

    def __init__(self, motion: Motion, grid: Volume, every_mm: float = 3.0) -> None:
        size = grid.spacing_mm * (np.array(grid.shape[::-1]) - 1)
        self._step, self._origin = every_mm, grid.origin_mm
        counts = np.ceil(size / every_mm).astype(int) + 2
        knots = np.stack(np.meshgrid(*[every_mm * np.arange(n) for n in counts], indexing="ij"), axis=3).reshape(-1, 3) + grid.origin_mm
        self._table = (motion.to_material(knots) - knots).reshape(*counts, 3)

    def to_space(self, material: FloatArray) -> FloatArray:
        return material

    def to_material(self, positions: FloatArray) -> FloatArray:
        at = ((positions - self._origin) / self._step).T
        moved = [ndimage.map_coordinates(self._table[..., a], at, order=1, mode="nearest") for a in range(3)]
        return np.asarray(positions + np.stack(moved, axis=1))


def _complete(state: State) -> tuple[FloatArray, IntArray]:
    """Return positions (k, 3) and labels of the complete, trusted markers of a state."""
    markers = state.markers
    good = np.zeros(0, dtype=bool) if markers is None else markers.trusted & np.isfinite(markers.points).all(axis=1)
    if markers is None or good.sum() < 5:
        raise InputError(
            f"state {state.name!r} has {int(good.sum())} complete markers; at least 5 are needed to draw the object around them"
        )
    return markers.points[good], markers.ids[good]
