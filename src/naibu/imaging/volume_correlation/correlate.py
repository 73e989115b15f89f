"""The displacement between two scans by volume correlation that mechanics hold together: the default way of sensing (spec S7, S8).

The displacement is a field of cubic B-splines on a grid about the object. It minimises::

    sum_voxels rho((f - a g(x + u) - b) / s) + sum_cells lambda_c |grad grad u|^2 / 2 + kappa (det(I + grad u) - 1)^2 / 2

where f and g are the scans, a and b a smooth gain and offset, s the scatter of the residual, and rho bounds what a voxel that does not
belong can do. The weights lambda, one a cell and component, and kappa are the most probable ones given the data. Stiff bodies move
rigidly. Coarse to fine, Gauss-Newton, from a rigid start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.object_mask import object_mask
from naibu.imaging.preprocessing.resampling import require_mask
from naibu.imaging.preprocessing.volume_pair import grey_pair
from naibu.imaging.volume_correlation.gauss_newton import Comparison, Correlation, Iterations, chosen_weights
from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise
from naibu.imaging.volume_correlation.result import CorrelationResult, collected
from naibu.imaging.volume_correlation.rigid_inclusions import StiffBody, enclosed_bodies, rigid_among
from naibu.imaging.volume_correlation.rigid_initialization import RigidStart, correlated_shift
from naibu.imaging.volume_correlation.spline_grid import SplineGrid

Progress = Callable[[str], None]
SLOPE_SHARE = {"reference": 1.0, "mean": 0.5, "deformed": 0.0}
# cells along the cube root of the object's volume, and voxels along a cell at least
CELLS_ALONG, LEAST_VOXELS = 12.5, 3.5
LEAST_VOXELS_ALONG = 2.5
LEAST_SIZE = 4
LEAST_OVERLAP = 0.05
# stretch of the outline from which an affine start is tried, and by how much better it must correlate
LEAST_STRETCH, STRETCHED = 0.15, 0.05
FIRST = 0.1
SQUEEZED = 0.02  # such an object also changes its volume: of SWELLING
LOOSER = (3.0, 2.0, 1.0, 1.0)
ROUGH = 1  # levels, from the coarsest, where the scatter is that of all residuals
COARSE_PLACE = 0.15
COARSE_SHARE = 0.5  # far from register the mean of both scans' slopes reaches furthest
# weights of bending, mm^-1 per mm of cell, and of change of volume, per cell, before the data have their say
BENDING, SWELLING = 64.0, 5000.0
PARTS = (2, 2, 4)
STIFFER = (20.0, 1.0, 1.0, 1.0)  # bending of coarse grids, in units of BENDING
STEPS = (8, 8, 3, 4)
CONSTRAINED = (0.05, 0.01, 0.0, 0.0)
SMOOTHING = 0.5  # standard deviation, voxels of a level
BODY_SMOOTHING = 0.8
WINDOW = 1.9  # cells in which a weight is shared
AGREE = 0.5  # cells over which the slopes of both scans are compared
GAIN_CELL = 5.5  # cells of the grid in one of the gain
ADAPT_SAMPLES, ROUNDS, SEED = 12, 4, 20080301


@dataclass(frozen=True, slots=True)
class CorrelationSettings:
    """What may be chosen; every default suits scans of soft objects, and nothing has to be tuned.

    Attributes
    ----------
    node_spacing_mm : float, optional
        Size of the cells of the spline grid, mm; by default about a twelfth of the object, and 3.5 voxels or more.
    robust : float
        Multiple of the residual's scatter where a voxel counts a quarter; inf for plain least squares.
    local_gain : bool
        Whether gain and offset between the scans vary in space; else there is one of each.
    volume_term : bool
        Whether change of volume is held back, as much as the data allow.
    adaptive_weight : bool
        Whether bending is weighed by the data, cell by cell; else by one number.
    slopes : {"reference", "mean", "deformed"}
        Which scan's slopes of grey values are used.
    stiff_bodies : bool
        Whether bodies that move rigidly are looked for and taken as rigid.
    samples : int
        Random fields from which the covariance is taken.
    place_voxels : float
        Standard deviation of where in its voxel a grey value belongs, voxels.
    """

    node_spacing_mm: float | None = None
    robust: float = 3.0
    local_gain: bool = True
    volume_term: bool = True
    adaptive_weight: bool = True
    slopes: Literal["reference", "mean", "deformed"] = "reference"
    stiff_bodies: bool = True
    samples: int = 32
    place_voxels: float = 0.15


DEFAULT = CorrelationSettings()


def correlate_volumes(
    reference: Volume,
    deformed: Volume,
    *,
    mask: ArrayLike | None = None,
    stiff_mask: ArrayLike | None = None,
    settings: CorrelationSettings = DEFAULT,
    progress: Progress | None = None,
) -> CorrelationResult:
    """Return the displacement of an object between two scans, with its covariance and gradient.

    Parameters
    ----------
    reference, deformed : Volume
        Before and after, on one grid, without unknown voxels.
    mask : array_like, shape (nz, ny, nx), optional
        The object in the reference; by default the largest body that is brighter than the air about it, and one voxel more.
    stiff_mask : array_like, shape (nz, ny, nx), bool or int, optional
        Bodies that are rigid, numbered from 1, or true and told apart by where they touch; by default looked for.
    settings : CorrelationSettings
        Choices.
    progress : callable, optional
        ``progress(text)`` is told every step.

    Returns
    -------
    CorrelationResult
        Valid in the mask, where it lies in the deformed scan after its motion.

    Raises
    ------
    InputError
        Scans on different grids, of few slices, constant or with unknown voxels; an empty mask; scans that do not overlap.
    """
    _check(settings)
    work = _Work(reference, deformed, mask, settings, progress or _silent)
    work.start()
    work.refine()
    work.find_bodies(stiff_mask)
    work.adapt()
    return work.result()


class _Work:
    """The steps of a correlation and what they pass on."""

    def __init__(self, reference: Volume, deformed: Volume, mask: ArrayLike | None, settings: CorrelationSettings, say: Progress) -> None:
        self.volume, self.settings, self.say = reference, settings, say
        self.reference, self.deformed = _checked_pair(reference, deformed)
        self.mask = object_mask(reference, margin=1) if mask is None else require_mask(mask, reference)
        self.deformed_volume = deformed
        where = np.argwhere(self.mask)
        if not len(where):
            raise InputError("the mask is empty: no voxel of the object to follow")
        low, high = where.min(axis=0)[::-1], where.max(axis=0)[::-1]
        if ((high - low + 1) < LEAST_SIZE).any():
            raise InputError(f"the object has {(high - low + 1).tolist()} voxels along x, y, z; {LEAST_SIZE} or more are needed")
        self.spacing = reference.spacing_mm
        self.step = _step(settings, self.mask, self.spacing)
        margin = 1.5 * self.spacing
        self.grid = SplineGrid.around(low * self.spacing - margin, high * self.spacing + margin, self.step, halvings=2)
        self.strides = _strides(self.step, self.spacing)
        self.levels: dict[tuple[int, ...], ImageLevel] = {}
        self.bodies: list[StiffBody] = []
        self.ratio, self.swells = 1.0, 1.0

    def level(self, stride: tuple[int, ...], smoothing: float = SMOOTHING) -> ImageLevel:
        return ImageLevel(self.reference, self.deformed, self.mask, self.spacing, stride, smoothing)

    def how(self, level: int) -> Comparison:
        s = self.settings
        # on the coarsest level a local gain would explain what has moved
        cell = GAIN_CELL * float(self.step.mean()) if s.local_gain and level else 0.0
        reliable = AGREE * float(self.step.mean()) if level > 1 else 0.0
        return Comparison(
            s.robust * LOOSER[level],
            s.place_voxels if level > 1 else COARSE_PLACE,
            SLOPE_SHARE[s.slopes] if level > 1 else COARSE_SHARE,
            cell,
            reliable_mm=reliable,
            rough=level < ROUGH,
        )

    def weights(self, system: SplineSystem, stiffer: float) -> tuple[FloatArray, float]:
        # less at first: of a field that is held back too much nobody can tell how much its volume changes
        first = FIRST if self.settings.adaptive_weight else 1.0
        h = system.grid.step_mm
        bending = np.full((len(system.cells), 3), stiffer * BENDING / float(np.prod(h) ** (1 / 3)))
        return bending, first * self.swells * SWELLING / float(np.prod(h)) if self.settings.volume_term else 0.0

    def start(self) -> None:
        """Find the rigid motion and put it on the coarsest grid."""
        stride = _stride(self.step, self.spacing, 1)
        level = self.level(stride)
        thin = tuple(slice(None, None, s) for s in stride[::-1])
        shifts = [np.zeros(3), correlated_shift(self.reference[thin] * self.mask[thin], self.deformed[thin], level.spacing)]
        after = np.argwhere(object_mask(self.deformed_volume))[:, ::-1] * self.spacing
        before = np.argwhere(self.mask)[:, ::-1] * self.spacing
        shifts.append(after.mean(axis=0) - before.mean(axis=0))
        start = RigidStart(level)
        linear, shift, likeness = start.found(shifts)
        kind = "rigid"
        # an object that is squeezed as a whole looks like itself only after it is stretched as its outline is
        outline = np.diag(after.std(axis=0) / before.std(axis=0))
        if np.abs(np.diag(outline) - 1).max() > LEAST_STRETCH:
            guesses = (outline @ linear, outline)
            ends = [start.stretched(a, a @ (start.middle - before.mean(axis=0)) + after.mean(axis=0) - start.middle) for a in guesses]
            affine = max(ends, key=lambda end: end[2])
            if affine[2] > likeness + STRETCHED and np.linalg.det(affine[0]) > 0.1:
                linear, shift, likeness = affine
                kind, self.ratio, self.swells = "affine", float(np.linalg.det(linear)), SQUEEZED
        nodes = self.grid.nodes_mm
        self.c = nodes @ linear.T + shift - nodes
        moved = np.linalg.norm(before @ linear.T + shift - before, axis=1)
        self.say(f"{kind} start: correlation {likeness:.2f}, displacements of {moved.mean():.2f} mm on average, {moved.max():.2f} at most")

    def refine(self) -> None:
        """Fit from coarse to fine with weights that do not depend on the data."""
        for k, stride in enumerate(self.strides):
            if 0 < k < 3:
                self.c, self.grid = self.grid.refined(self.c), self.grid.halved()
            if k == 0 or stride != self.strides[k - 1]:
                level = self.level(stride)
            system = SplineSystem(level, self.grid, self.ratio)
            self.fit = Correlation(level, system, self.how(k))
            self.bending, self.swelling = self.weights(system, STIFFER[k])
            self.c = self.fit.iterate(
                self.c, self.bending, self.swelling * system.watched, Iterations(STEPS[k], constrained=CONSTRAINED[k])
            )
            self.say(
                f"cells of {self.grid.step_mm.mean():.1f} mm, voxels of {level.spacing.mean():.1f} mm: residual {self.fit.scatter:.4g}"
            )

    def find_bodies(self, stiff_mask: ArrayLike | None) -> None:
        """Find bodies that are rigid and let them be so."""
        if not self.settings.stiff_bodies:
            return
        size = float(self.step.mean())
        found = enclosed_bodies(self.volume, self.mask, size) if stiff_mask is None else _numbered(stiff_mask, self.volume)
        labels = np.where(self.mask, found, 0).astype(np.int32)
        if not labels.any():
            return
        level = self.level((1, 1, 1), BODY_SMOOTHING)
        self.bodies = rigid_among(self.fit, labels, level, asked=stiff_mask is not None, least_mm3=3.0 * size**3, say=self.say)
        self.fit.bodies = self.bodies

    def adapt(self) -> None:
        """Choose the weights by the data and fit once more."""
        fit, system = self.fit, self.fit.system
        if self.bodies:
            self.c = fit.iterate(self.c, self.bending, self.swelling * system.watched, Iterations(3))
        if not self.settings.adaptive_weight:
            return
        kinds, width = _kinds(fit, self.bodies), WINDOW * float(self.step.mean())
        most = self.swelling / (FIRST * self.swells)
        for _ in range(ROUNDS):
            samples = fit.samples(self.c, self.bending, self.swelling * system.watched, ADAPT_SAMPLES, None, SEED)
            self.bending, swelling = chosen_weights(fit, samples, self.c, self.bending, self.swelling, width, kinds)
            before = self.swelling
            if self.settings.volume_term:
                # never more than assumed: what little volume changes may not be noise alone
                self.swelling = float(np.clip(swelling, 1e-3 * before, most))
            self.say(f"weights: bending {np.median(self.bending):.3g} (median), volume {self.swelling:.3g}")
            self.c = fit.iterate(self.c, self.bending, self.swelling * system.watched, Iterations(5))
            # a field that was held back too much shows only in part how much volume changes
            if self.swelling > 0.5 * before:
                break

    def result(self) -> CorrelationResult:
        """Draw the covariance and put everything together."""
        fit, system = self.fit, self.fit.system
        volume = self.swelling * system.watched
        fit.compare(self.c)
        fit.system.assembled(self.c, fit.products, fit.force, self.bending, volume)
        if fit.seen.mean() < LEAST_OVERLAP:
            raise InputError(
                f"only {fit.seen.mean():.1%} of the object lies in the deformed volume after its motion: the scans do not overlap, or are "
                "not of one object"
            )
        for body in self.bodies:
            body.draws.clear()
        noise = ResidualNoise(fit.level.mask, fit.residual * np.sqrt(fit.weight), _lost_to_robustness(fit))
        samples = fit.samples(self.c, self.bending, volume, self.settings.samples, noise, SEED + 1)
        return collected(self.volume, self.mask, fit, self.c, samples, self.bending, self.swelling)


def _silent(_: str) -> None:
    pass


def _check(settings: CorrelationSettings) -> None:
    s = settings
    if s.slopes not in SLOPE_SHARE:
        raise InputError(f"slopes must be one of {', '.join(SLOPE_SHARE)}, not {s.slopes!r}")
    if s.node_spacing_mm is not None and not (np.isfinite(s.node_spacing_mm) and s.node_spacing_mm > 0.0):
        raise InputError(f"node_spacing_mm must be positive, not {s.node_spacing_mm}")
    if not s.robust > 0.0:
        raise InputError(f"robust must be positive, a multiple of the scatter, not {s.robust}")
    if s.samples < 8:
        raise InputError(f"a covariance needs 8 samples or more, not {s.samples}")
    if not s.place_voxels >= 0.0:
        raise InputError(f"place_voxels must be 0 or more, not {s.place_voxels}")


def _checked_pair(reference: Volume, deformed: Volume) -> tuple[Float32Array, Float32Array]:
    for name, volume in (("reference", reference), ("deformed", deformed)):
        if min(volume.shape) < LEAST_SIZE:
            raise InputError(
                f"the {name} volume has {' x '.join(map(str, volume.shape[::-1]))} voxels; volume correlation needs {LEAST_SIZE} or more "
                "along every axis. For an image or a few slices use naibu.imaging.dense_matching.optical_flow.lucas_kanade"
            )
    before, after = grey_pair(*(v.with_values(np.asarray(v.values, dtype=np.float32)) for v in (reference, deformed)))
    for name, values in (("reference", before), ("deformed", after)):
        if np.isnan(values).any():
            bad = tuple(int(i) for i in np.argwhere(np.isnan(values))[0])
            raise InputError(f"voxel {bad} (z, y, x) of the {name} volume is NaN; crop the volumes, or fill what is unknown with air")
    return before, after


def _step(settings: CorrelationSettings, mask: BoolArray, spacing: FloatArray) -> FloatArray:
    """Return the size of the finest cells along x, y, z, mm."""
    if settings.node_spacing_mm is not None:
        return np.full(3, float(settings.node_spacing_mm))
    voxel = float(np.prod(spacing))
    h = max((float(mask.sum()) * voxel) ** (1 / 3) / CELLS_ALONG, LEAST_VOXELS * voxel ** (1 / 3))
    return np.asarray(np.maximum(h, LEAST_VOXELS_ALONG * spacing))


def _stride(step: FloatArray, spacing: FloatArray, part: int) -> tuple[int, ...]:
    """Return how many voxels along x, y, z to go so that `part` of those taken lie along a cell."""
    return tuple(int(n) for n in np.maximum(np.round(step / part / spacing), 1))


def _strides(step: FloatArray, spacing: FloatArray) -> list[tuple[int, ...]]:
    """Return the strides of all levels, the last of which takes every voxel."""
    fine = [_stride(step, spacing, part) for part in PARTS]
    return fine if max(fine[-1]) == 1 else [*fine, (1, 1, 1)]


def _numbered(stiff_mask: ArrayLike, volume: Volume) -> Int32Array:
    given = np.asarray(stiff_mask)
    require_mask(given, volume)
    if given.dtype.kind == "b":
        return np.asarray(ndimage.label(given)[0], dtype=np.int32)
    if given.dtype.kind not in "iu":
        raise InputError(f"stiff_mask must be boolean or hold numbers of bodies, not {given.dtype}")
    return given.astype(np.int32)


def _kinds(fit: Correlation, bodies: list[StiffBody]) -> IntArray:
    """Return 0 for soft cells, 1 for those next to a body, 2 for those inside one: they differ too much to share a weight."""
    system, level = fit.system, fit.level
    if not bodies:
        return np.zeros(len(system.cells), np.int64)
    stiff = np.zeros(len(level.grey))
    for body in bodies:
        stiff[body.voxels] = 1
    where = (level.index.astype(np.int64) - level.low[::-1]).T
    at = tuple(system.cell_of[a][where[a]] for a in (2, 1, 0))
    shape = tuple(int(n) for n in system.grid.cells[::-1])
    flat = np.ravel_multi_index(at, shape)
    count = np.bincount(flat, minlength=int(np.prod(shape)))
    share = (np.bincount(flat, stiff, minlength=len(count)) / np.maximum(count, 1)).reshape(shape)
    near = ndimage.binary_dilation(share > 0, np.ones((3, 3, 3), dtype=bool))
    return np.asarray(np.where(share > 0.95, 2, np.where(near, 1, 0))[tuple(system.cells[:, 2:].T)], dtype=np.int64)


def _lost_to_robustness(fit: Correlation) -> float:
    """Return the ratio of the mean weight to the mean derivative of the robust force: by what the normal matrix is too large."""
    w = fit.weight.astype(float)
    # with q = sqrt(w / w at r = 0): the derivative of r q^2 is q^2 (4 q - 3)
    q = 1 / (1 + (fit.residual.astype(float) / (fit.how.robust * fit.scatter)) ** 2)
    return float(w.sum() / max(float((w * (4 * q - 3)).sum()), 0.2 * float(w.sum())))
