"""What a block of voxels contributes to the normal equations of a volume correlation, and to what is said about its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.imaging.large_volumes.block_frame import Block, BlockFrame
from naibu.imaging.large_volumes.fine_outline import inside_block
from naibu.imaging.large_volumes.noise_tiles import NoiseTiles, lags
from naibu.imaging.large_volumes.thinning import ThinnedValues
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.preprocessing.volume_pair import shifted_intensity
from naibu.imaging.volume_correlation.common_content import content_sums
from naibu.imaging.volume_correlation.gain_coupling import CoupledGain
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.image_level import ENOUGH, MARGIN, GainMap, ImageLevel
from naibu.imaging.volume_correlation.residual_noise import lagged_products
from naibu.imaging.volume_correlation.results.block_displacements import DRAWS, RIM, BlockSums, below_surface, sums_of_blocks
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid, separable
from naibu.imaging.volume_correlation.volume_changes import DRAWS as NOISE_DRAWS

Stage = Literal["noise", "step", "covariance"]
# absolute residuals, in residual SD, between which they are counted for their median: 900 classes, of 2 % each
CLASSES = np.geomspace(1e-5, 1e3, 901)
ENOUGH_IN_CELL = 500  # voxels of a cell with random residuals, where these are independent
SPARSE = 4  # every so many voxels the displacement of a block is evaluated, for the part of the deformed volume that it needs
SPARE = 2.0  # voxels by which that part is larger
LEAST_PART = 4  # voxels along an axis of a part of a volume that can be interpolated


@dataclass(frozen=True, slots=True, eq=False)
class FieldState:
    """Displacement and intensity model at which blocks are compared.

    Attributes
    ----------
    stage : str
        ``"noise"`` for residuals alone, ``"step"`` for a Gauss-Newton step, ``"covariance"`` also for what follows from the last one.
    coefficients : ndarray, shape (NZ, NY, NX, 3)
        Of the displacement, mm.
    gain : ndarray, shape (2 k,)
        Gain and offset at the points of their lattice.
    residual_sd : float
        Standard deviation of the residual.
    jitter_voxels : float
        Sub-voxel jitter SD.
    reliability : ndarray, shape (CZ, CY, CX, 3, 3), float32
        Matrices by which gradients are multiplied.
    draws : int
        Number of random loads.
    lagged : bool
        Whether products of residuals by distance are wanted.
    tiles : NoiseTiles, optional
        From which they are drawn, in a step some more than `draws`; without them residuals are independent.
    seed : int
        Of these.
    """

    stage: Stage
    coefficients: FloatArray
    gain: FloatArray
    residual_sd: float
    jitter_voxels: float
    reliability: Float32Array
    draws: int
    lagged: bool
    tiles: NoiseTiles | None
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class ComparedBlock:
    """Sums over the voxels of a block; k nodes and m cells of the spline grid.

    Attributes
    ----------
    seen, voxels : int
        Voxels in the deformed volume, and all of them.
    classes : ndarray
        Numbers of absolute residuals, in residual SD, in the classes `CLASSES`.
    jitter : float
        Square of the observed sub-voxel jitter, voxels^2, times the voxels that are seen; 0 but for a step.
    robust : tuple of float
        See `IntensityComparison.robust_sums`.
    moments : ndarray, shape (5,)
        Sums of weights, and of intensities f and g, of f^2 and g^2 times the weights, of some voxels.
    gain_matrix, gain_load : ndarray
        Normal equations of gain and offset.
    nodes : ndarray, shape (k, 3)
        z, y, x of the nodes in the spline grid.
    cells : ndarray, shape (m, 3)
        z, y, x of the cells.
    matrix, load, draws : ndarray, shape (k, 3, 1029), (k, 3) and (k, 3, s)
        Of the intensities alone: normal matrix, load, random loads.
    coupled : CoupledGain, optional
        What the gain shares with the displacement; of a step where gain is local.
    agreement, misfit, content : ndarray, shape (m, 12), (m, 3) and (m, 13)
        See `CorrelationFit.cell_agreement`, `CorrelationFit.cell_misfit` and `content_sums`.
    products, pairs : ndarray
        Sums of products of residuals, and their numbers, by distance.
    small : BlockSums, optional
        Of small blocks with independent errors.
    """

    seen: int
    voxels: int
    classes: IntArray
    jitter: float
    robust: tuple[float, float]
    moments: FloatArray
    gain_matrix: FloatArray
    gain_load: FloatArray
    nodes: IntArray
    cells: IntArray
    matrix: Float32Array
    load: Float32Array
    draws: Float32Array
    coupled: CoupledGain | None
    agreement: FloatArray
    misfit: FloatArray
    content: FloatArray
    products: AnyFloatArray
    pairs: AnyFloatArray
    small: BlockSums | None


def compared_block(
    reference: ChunkedVolume, deformed: ChunkedVolume, mask: ChunkedVolume | None, frame: BlockFrame, state: FieldState, block: Block
) -> ComparedBlock | None:
    """Read a block of both volumes and return its sums; None where it has no voxel of the object, or the deformed volume does not show it.

    Parameters
    ----------
    reference, deformed : ChunkedVolume
        Volumes, of which what the block needs is read.
    mask : ChunkedVolume, optional
        Not zero in the object, where that was given.
    frame, state, block
        What is compared.

    Raises
    ------
    InputError
        Voxels that are NaN or infinite in the field of view.
    """
    part = _Part.of(frame, block, (mask or reference).values)
    if part is None:
        return None
    k = frame.thinning
    sources = [v.values if k == 1 else ThinnedValues(v.values, k) for v in (reference, deformed)]
    fit = part.fit(sources[0], sources[1], state)
    if fit is None:
        return None
    grid = part.grid
    first = np.array([low for low, _ in block.cells])
    fit.compare(_local_coefficients(state.coefficients, block))
    soft, seen = ~part.rigid[part.mask], int(fit.seen.sum())
    jitter = fit.observed_jitter_voxels**2 * seen if state.stage == "step" else 0.0
    misfit = fit.cell_misfit()
    curvature = fit.curvature_share if state.stage == "step" else None
    if curvature is not None and not state.draws:  # random fields have loads of the weights themselves
        fit.products *= curvature[:, None]
    for values in (fit.products, fit.force, fit.gradient):
        values[~soft] = 0
    m = len(fit.system.cells)
    solving = state.stage != "noise"
    gain = fit.lattice.normal_equations(fit.value, fit.robust_weight) if solving else (np.zeros((0, 0)), np.zeros(0))
    none = np.zeros((m, 3)), np.zeros(m)
    load = fit.system.assembled(np.zeros((*grid.shape, 3)), fit.products, fit.force, *none) if solving else np.zeros((0, 3), np.float32)
    weighted = np.where(fit.seen, fit.residual * np.sqrt(fit.weight), 0) if state.lagged else None
    products, pairs = (np.zeros(0),) * 2 if weighted is None else (lags(v) for v in lagged_products(part.mask, weighted))
    at_end = state.stage == "covariance"
    return ComparedBlock(
        seen, len(fit.value), _classes(fit), jitter, fit.robust_sums, _moments(fit), *gain,
        np.stack(fit.system.nodes, axis=1) + first[::-1], fit.system.cells[:, 2:] + first[::-1],
        fit.system.matrix if solving else fit.system.matrix[:0], load, _random_loads(fit, part.mask, state, block),
        None if curvature is None or not fit.settings.gain_cell_mm else fit.coupled_gain(fit.lattice),
        fit.cell_agreement(), misfit, content_sums(fit, part.depth(fit.level)) if at_end else np.zeros((m, 0)),
        products, pairs,
        _small_blocks(fit, part, state.tiles, state.draws, soft) if at_end and state.tiles else None,
    )  # fmt: skip


class _BlockFit(CorrelationFit):
    """Comparison of a block at the intensity model of all blocks."""

    def __init__(self, level: ImageLevel, system: SplineSystem, frame: BlockFrame, state: FieldState, at: Box, corner: IntArray) -> None:
        super().__init__(level, system, frame.settings, noisy=True)
        self.jitter_voxels = state.jitter_voxels
        self.lattice, self.model = GainMap(level, 1.0), state
        # of coarse voxels, here in voxels from the corner of the part
        self.lattice.low = frame.gain_low * frame.factor + frame.offset - corner
        self.lattice.step, self.lattice.n = frame.gain_step * frame.factor, frame.gain_n
        z, y, x = system.cells[:, 2:].T
        self.reliability = np.ascontiguousarray(state.reliability[at][z, y, x])

    def match(self) -> None:
        """Take gain, offset and residual SD of all blocks."""
        self.gain, self.offset = self.lattice.values(self.model.gain)
        self.residual_sd = self.model.residual_sd
        self.weigh_robustly(self.differences(self.seen), self.seen)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """The voxels of the object in a block, in the box of those voxels."""

    frame: BlockFrame
    block: Block
    low: IntArray
    mask: BoolArray
    rigid: BoolArray
    outline: Any

    @classmethod
    def of(cls, frame: BlockFrame, block: Block, outline: Any) -> _Part | None:
        mask, rigid = inside_block(frame, block.low, block.high, outline)
        where = np.argwhere(mask)
        if not len(where):
            return None
        a, b = where.min(axis=0), where.max(axis=0) + 1
        box = tuple(slice(int(i), int(j)) for i, j in zip(a, b, strict=True))
        return cls(frame, block, np.array(block.low) + a, mask[box], rigid[box], outline)

    @property
    def grid(self) -> SplineGrid:
        """Spline grid of the block's cells, mm from the first voxel of the frame."""
        whole, first = self.frame.grid, np.array([low for low, _ in self.block.cells])
        return SplineGrid(whole.origin_mm + first * whole.step_mm, whole.step_mm, np.array([high - low for low, high in self.block.cells]))

    def fit(self, reference: Any, deformed: Any, state: FieldState) -> _BlockFit | None:
        """Return the comparison of the block; None where the deformed volume does not show it."""
        frame, high = self.frame, self.low + self.mask.shape
        near_low, near_high = _clipped(self.low - MARGIN, high + MARGIN, frame.views[0], frame.shape)
        least, most = self._reached(state)
        there_low, there_high = _clipped(least - MARGIN, most + MARGIN, frame.views[1], frame.shape)
        if (there_high - there_low < LEAST_PART).any():
            return None
        before = _read(reference, near_low, near_high, frame.shift, "reference")
        after = _read(deformed, there_low, there_high, frame.shift, "deformed")
        listed = np.zeros(before.shape, dtype=bool)
        listed[tuple(slice(int(a), int(a + n)) for a, n in zip(self.low - near_low, self.mask.shape, strict=True))] = self.mask
        level = ImageLevel(before, after, listed, frame.spacing, (1, 1, 1), frame.smoothing)
        level.first = (there_low - near_low)[::-1].astype(float)
        whole, corner = self.grid, near_low[::-1]
        local = SplineGrid(whole.origin_mm - frame.position(corner), whole.step_mm, whole.cells)
        at = tuple(slice(low, high) for low, high in self.block.cells[::-1])
        return _BlockFit(level, SplineSystem(level, local), frame, state, (at[0], at[1], at[2]), corner)

    def _reached(self, state: FieldState) -> tuple[IntArray, IntArray]:
        """Return the box (z, y, x) of the deformed volume in which the voxels of the block lie."""
        some = [np.unique(np.r_[np.arange(0, n, SPARSE), n - 1]) for n in self.mask.shape]
        c, grid = _local_coefficients(state.coefficients, self.block), self.grid
        every = np.stack(np.meshgrid(*(a + i for a, i in zip(self.low, some, strict=True)), indexing="ij"), axis=-1)[..., ::-1]
        axes = [self.frame.along(a, self.low[2 - a] + some[2 - a]) for a in range(3)]
        u = separable([grid.matrix(a, axes[a]) for a in range(3)], c)
        held = ndimage.maximum_filter(self.mask, 2 * SPARSE - 1)[np.ix_(*some)]
        at = (every + u / self.frame.spacing)[held][:, ::-1]
        return np.floor(at.min(axis=0) - SPARE).astype(int), np.ceil(at.max(axis=0) + SPARE).astype(int) + 1

    def depth(self, level: ImageLevel) -> Float32Array:
        """Return the depth (n,) of the listed voxels below the surface, mm."""
        coarse = self.frame.depth_mm[self.frame.coarse(tuple(self.low), tuple(self.low + self.mask.shape))]
        return np.asarray(coarse[self.mask], dtype=np.float32)

    def deep(self) -> BoolArray:
        """Return which listed voxels (n,) are not near the surface."""
        low, high = self.low - RIM, self.low + self.mask.shape + RIM
        a, b = np.maximum(low, 0), np.minimum(high, self.frame.shape)
        around = np.zeros(tuple(high - low), dtype=bool)
        box = tuple(slice(int(i), int(j)) for i, j in zip(a - low, b - low, strict=True))
        around[box] = inside_block(self.frame, tuple(int(i) for i in a), tuple(int(i) for i in b), self.outline)[0]
        return np.asarray(below_surface(around)[self.mask])


def _local_coefficients(c: FloatArray, block: Block) -> FloatArray:
    x, y, z = (slice(low, high + 3) for low, high in block.cells)
    return np.ascontiguousarray(c[z, y, x])


def _clipped(low: IntArray, high: IntArray, view: Box, shape: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    first = np.array([s.start or 0 for s in view])
    last = np.array([n if s.stop is None else s.stop for s, n in zip(view, shape, strict=True)])
    return np.clip(low, first, last), np.clip(high, first, last)


def _read(source: Any, low: IntArray, high: IntArray, shift: float, name: str) -> Float32Array:
    values = np.asarray(source[tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))])
    shifted = shifted_intensity(values.astype(np.float32) if values.dtype.kind != "f" else values, shift, name)
    if np.isnan(shifted).any():
        bad = tuple(int(i + a) for i, a in zip(np.argwhere(np.isnan(shifted))[0], low, strict=True))
        raise InputError(
            f"voxel {bad} (z, y, x) of the {name} volume is NaN; crop the volumes, or fill unknown voxels with the intensity of air"
        )
    return shifted


def _classes(fit: CorrelationFit) -> IntArray:
    relative = np.abs(fit.residual[fit.seen]) / np.float32(fit.residual_sd)
    # the classes are equal in the logarithm
    first, step = np.float32(np.log(CLASSES[0])), np.float32(np.log(CLASSES[1] / CLASSES[0]))
    number = np.ceil((np.log(np.maximum(relative, np.float32(CLASSES[0] / 2.0))) - first) / step)
    return np.bincount(np.clip(number, 0, len(CLASSES)).astype(np.int32), minlength=len(CLASSES) + 1).astype(np.int64)


def _moments(fit: CorrelationFit) -> FloatArray:
    some = slice(None, None, max(1, len(fit.value) // ENOUGH))
    seen = fit.seen[some]
    f, g, w = (np.asarray(v[some][seen], dtype=float) for v in (fit.level.intensity, fit.value, fit.robust_weight))
    return np.array([w.sum(), w @ f, w @ g, w @ f**2, w @ g**2]) * len(fit.value) / max(len(seen), 1)


def _random_loads(fit: CorrelationFit, mask: BoolArray, state: FieldState, block: Block) -> Float32Array:
    """Return loads (k, 3, s) of random residuals: independent ones, or those of tiles; in a step of both, one after the other."""
    loads = [_independent_loads(fit, mask, state, block)] if state.tiles is None or state.stage == "step" else []
    if state.tiles is not None:
        tiles, count = state.tiles, NOISE_DRAWS if state.stage == "step" else state.draws
        random = (tiles.window(mask, block.number, k) for k in range(count))
        loads.append(fit.system.random_loads(fit.gradient * np.sqrt(fit.weight)[:, None], random))
    return np.concatenate(loads, axis=2)


def _independent_loads(fit: CorrelationFit, mask: BoolArray, state: FieldState, block: Block) -> Float32Array:
    rng, level = np.random.default_rng((state.seed, block.number)), fit.level
    # some hundred voxels of a cell have loads distributed as those of all
    share = min(1.0, ENOUGH_IN_CELL / float(np.prod(fit.system.grid.step_mm / level.spacing)))
    some = rng.random(len(fit.weight)) < share if share < 1.0 else np.ones(len(fit.weight), dtype=bool)
    number = np.full(mask.shape, -1, np.int32)
    number[tuple(a[some] for a in np.nonzero(mask))] = np.arange(int(some.sum()))
    sensitivity = fit.gradient[some] * np.sqrt(fit.weight[some] / np.float32(share))[:, None]
    random = (rng.standard_normal(len(sensitivity), dtype=np.float32) for _ in range(state.draws))
    return fit.system.random_loads(sensitivity, random, number)


def _small_blocks(fit: CorrelationFit, part: _Part, tiles: NoiseTiles, draws_before: int, soft: BoolArray) -> BlockSums:
    draws = (tiles.window(part.mask, part.block.number, draws_before + k) for k in range(DRAWS))
    sums = sums_of_blocks(fit, part.deep() & fit.seen & soft, part.frame.edge, draws)
    # from indices in the part that was read to those in the volume
    sums.middle[:] += part.low[::-1] - fit.level.low[::-1]
    return sums
