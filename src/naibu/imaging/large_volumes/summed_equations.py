"""Normal equations of a volume correlation summed over blocks, and what is solved with them: displacement, weights, covariance."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.large_volumes.block_frame import BlockFrame
from naibu.imaging.large_volumes.block_sums import CLASSES, ComparedBlock, FieldState, Stage
from naibu.imaging.large_volumes.fine_outline import BAND
from naibu.imaging.large_volumes.noise_tiles import NoiseTiles
from naibu.imaging.large_volumes.pass_schedule import Schedule
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.preprocessing.morphology import dilated
from naibu.imaging.preprocessing.object_mask import object_threshold
from naibu.imaging.volume_correlation.common_content import content_of, require_convergence, require_overlap
from naibu.imaging.volume_correlation.correlate import ADAPTATION_SAMPLES, ADAPTATIONS, UNSETTLED, Correlation
from naibu.imaging.volume_correlation.gain_coupling import CoupledGain, GainCoupling
from naibu.imaging.volume_correlation.gauss_newton import (
    COVARIANCE_TOLERANCE,
    REGULAR,
    SAMPLE_TOLERANCE,
    SAMPLES_AT_ONCE,
    STEP_TOLERANCE,
    STILL,
)
from naibu.imaging.volume_correlation.image_level import GAIN_RANGE, GainMap, most_probable_gain
from naibu.imaging.volume_correlation.intensity_comparison import MAD, ROUNDING
from naibu.imaging.volume_correlation.mixed_steps import MixedSteps
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise, lost_to_robustness
from naibu.imaging.volume_correlation.resolution_levels import LEVELS
from naibu.imaging.volume_correlation.results.block_displacements import BlockSums, block_edge, blocks_alike, displacement_of_blocks
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult, collected
from naibu.imaging.volume_correlation.results.hidden_dilatation import loaded_trial_parts
from naibu.imaging.volume_correlation.splines._spline_kernels import product
from naibu.imaging.volume_correlation.volume_changes import LATE_DRAWS


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """What passes through the volumes change: displacement, weights of penalties, intensity model.

    Attributes
    ----------
    coefficients : ndarray, shape (NZ, NY, NX, 3)
        Of the displacement, mm.
    bending, dilatation : ndarray, shape (m, 3) and (m,)
        Weights of the penalties.
    gain, residual_sd, jitter_voxels, reliability
        See `FieldState`; the reliability is that of the m cells.
    products, pairs : ndarray, optional
        Sums of products of residuals, and their numbers, by distance.
    passes : int
        How many there were.
    settled : bool
        Whether the last step was short.
    steps : MixedSteps
        Those before, at these voxels and weights.
    ratio : float
        See `SplineSystem`.
    """

    coefficients: FloatArray
    bending: FloatArray
    dilatation: FloatArray
    gain: FloatArray
    residual_sd: float
    jitter_voxels: float
    reliability: Float32Array
    products: AnyFloatArray | None = None
    pairs: AnyFloatArray | None = None
    passes: int = 0
    settled: bool = False
    steps: MixedSteps = field(default_factory=MixedSteps)
    ratio: float = 1.0


class SummedEquations:
    """The correlation of the coarse volume, whose normal equations are replaced by those of all voxels.

    Parameters
    ----------
    coarse : Correlation
        After `follow_inclusions`.
    volume : ChunkedVolume
        Reference.
    factor : int
        Voxels along the edge of a coarse voxel.
    """

    def __init__(self, coarse: Correlation, volume: ChunkedVolume, factor: int) -> None:
        fit = coarse.fit
        self.coarse, self.fit, self.system, self.volume = coarse, fit, fit.system, volume
        self.lattice = GainMap(fit.level, fit.settings.gain_cell_mm or float(fit.level.spacing.max()) * max(fit.level.mask.shape))
        self.frame = self._frame(factor)
        self.schedule = Schedule.of(factor)
        # coarse voxels are in a given mask, too, where little of them is: no error is stated where the object hardly is
        within = ndimage.binary_erosion(coarse.mask, border_value=1) if factor > 1 else coarse.mask
        fit.within = within[tuple(fit.level.index.astype(int).T[::-1])]
        everywhere = self.lattice.everywhere(fit.value, fit.robust_weight)
        matrix, load = self.lattice.normal_equations(fit.value, fit.robust_weight)
        reliability = fit.reliability_of(fit.cell_agreement())
        self.model = Model(
            coarse.c, coarse.bending, coarse.dilatation, self._gain(matrix, load, fit.residual_sd, everywhere), fit.residual_sd,
            coarse.settings.jitter_sd_voxels, reliability, ratio=self.system.ratio,
        )  # fmt: skip

    def _frame(self, factor: int) -> BlockFrame:
        coarse, level, s = self.coarse, self.fit.level, self.coarse.settings
        cells = np.zeros(tuple(int(n) for n in self.system.grid.cells[::-1]), dtype=bool)
        cells[tuple(self.system.cells[:, 2:].T)] = True
        rigid, depth = np.zeros(coarse.mask.shape, dtype=bool), np.zeros(coarse.mask.shape, np.float32)
        z, y, x = level.index.astype(int).T[::-1]
        depth[z, y, x] = level.depth_mm(coarse.mask)
        for inclusion in coarse.inclusions:
            rigid[z[inclusion.voxels], y[inclusion.voxels], x[inclusion.voxels]] = True
        views = tuple(_fine(v, factor, coarse.mask.shape, self.volume.shape) for v in coarse.views)
        inside = coarse.views[0]
        shift = float(np.mean(np.asarray(coarse.volume.values)[inside], dtype=float) - np.mean(coarse.reference[inside], dtype=float))
        # one that was found has a margin of a coarse voxel, of which one voxel is kept
        object_ = coarse.mask if coarse.mask_given or factor == 1 else ndimage.binary_erosion(coarse.mask, border_value=1)
        zone = np.ones(object_.shape, np.int8)
        zone[ndimage.binary_erosion(object_, iterations=BAND, border_value=1)] = 2
        zone[~dilated(object_, BAND)] = 0
        shown = Volume.from_array(np.asarray(coarse.volume.values)[inside], spacing_mm=coarse.spacing)
        threshold = None if coarse.mask_given else object_threshold(shown)
        edge = block_edge(int(coarse.mask.sum()) * factor**3)
        lattice = self.lattice.low, self.lattice.step, self.lattice.n
        return BlockFrame(
            self.volume.shape, self.volume.spacing_mm, factor, self.system.grid, cells, object_, rigid, zone, threshold, depth,
            (views[0], views[1]), shift, *lattice, coarse.comparison(len(LEVELS) - 1), s.smoothing_voxels, edge,
        )  # fmt: skip

    @property
    def frames(self) -> list[BlockFrame]:
        """The frames of the passes."""
        plan = self.schedule
        rough = [self.frame.thinned(2)] if plan.rough else []
        return rough * plan.rough + [self.frame] * (plan.most - plan.rough)

    def state(self, stage: Stage, edges: tuple[int, ...]) -> FieldState:
        """Return at what blocks with these edges are compared."""
        model, seed = self.model, self.coarse.settings.seed
        plan, number = self.schedule, model.passes + 1
        adapted = self.adapting and number == plan.adapted
        dense = np.zeros((*self.frame.cells.shape, 3, 3), np.float32)
        dense[tuple(self.system.cells[:, 2:].T)] = model.reliability
        draws = {"noise": 0, "step": ADAPTATION_SAMPLES if adapted else 0, "covariance": self.coarse.settings.samples}[stage]
        tiles = None
        if (stage == "covariance" or adapted) and model.products is not None and model.pairs is not None:
            tiles = NoiseTiles.for_blocks(edges, seed, model.products, model.pairs)
        lagged = stage == "step" and (number >= plan.least or (self.adapting and number == plan.adapted - 1))
        return FieldState(
            stage, model.coefficients, model.gain, model.residual_sd, model.jitter_voxels, dense, draws, lagged, tiles, seed + model.passes
        )

    @property
    def adapting(self) -> bool:
        """Whether the weights of the penalties follow from the data."""
        return self.coarse.settings.adaptive_weight

    def with_noise_of(self, blocks: Iterable[ComparedBlock | None]) -> Model:
        """Return the model with the residual SD of blocks."""
        classes = np.zeros(len(CLASSES) + 1, np.int64)
        for block in blocks:
            classes += 0 if block is None else block.classes
        return replace(self.model, residual_sd=self._residual_sd(classes))

    def stepped(self, blocks: Iterable[ComparedBlock | None]) -> Model:
        """Return the model after a Gauss-Newton step with the sums of all blocks, and weights adapted to them."""
        sums, coarse = self._added(blocks), self.coarse
        before, passes, plan = self.model.coefficients, self.model.passes + 1, self.schedule
        found = self._with_intensities(sums)
        self._couple(sums, found.gain)
        coarse.c, coarse.bending, coarse.dilatation = before.copy(), self.model.bending, self.model.dilatation
        self.system.ratio = self.model.ratio  # of an interrupted run, too
        self._settle(sums, before)
        if self.adapting and passes == plan.adapted:
            self._adapt(sums, before)
        self._settle(sums, before)
        if sums.coupled is not None:
            followed = sums.coupled.followed((coarse.c - before)[self.system.active].astype(np.float32))
            found = replace(found, gain=self.model.gain + sums.coupled.gain_step + followed)
        steps = MixedSteps() if plan.is_first_of_its_kind(passes) else deepcopy(self.model.steps)
        found = replace(found, gain=self._mixed(sums, steps, before, found.gain))
        self._take_step(before)
        jitter = self.model.jitter_voxels
        if self.adapting and passes in (plan.adapted - 1, plan.adapted + 1):  # and once more nearer to the end
            jitter = self.fit.bounded_jitter(float(np.sqrt(sums.jitter / sums.seen)))
        return replace(
            found, jitter_voxels=jitter, coefficients=coarse.c, bending=coarse.bending,
            dilatation=coarse.dilatation, passes=passes, steps=steps, ratio=self.system.ratio,
            settled=passes >= plan.least and self.fit.moving_fraction <= UNSETTLED, products=sums.products, pairs=sums.pairs,
        )  # fmt: skip

    def result(self, blocks: Iterable[ComparedBlock | None]) -> CorrelationResult:
        """Return the result at the voxels of the coarse volume, after the last step, from sums of the stage of the covariance.

        Raises
        ------
        InputError
            Volumes that do not show the same object.
        """
        sums, coarse, fit = self._added(blocks), self.coarse, self.fit
        before = self.model.coefficients
        coarse.c, coarse.bending, coarse.dilatation = before.copy(), self.model.bending, self.model.dilatation
        self.system.ratio = self.model.ratio  # of an interrupted run, too
        require_overlap(sums.seen / max(sums.voxels, 1))
        content = content_of(fit, sums.content)
        content.refuse_chance(self.system.inner)
        self._settle(sums, before, 2)
        self._take_step(before)
        require_convergence(fit.moving_fraction)
        self._assembled(sums, before)
        scale = lost_to_robustness(*sums.robust)
        noise = np.ascontiguousarray(np.float32(scale) * sums.draws[:, :, :LATE_DRAWS])
        hidden = coarse.hidden(loaded_trial_parts(self.system, sums.matrix), self.system.solved_many(noise, SAMPLE_TOLERANCE)[0], scale)
        samples = self._samples(np.float32(scale) * sums.draws, seed=coarse.settings.seed + 1)
        self.system.warped(coarse.c, fit.value, fit.reference_gradient, fit.gradient, fit.displacement)
        model = self._with_intensities(sums)
        fit.gain, fit.offset = self.lattice.values(model.gain)
        fit.residual_sd = model.residual_sd
        weights = coarse.bending, coarse.dilatation
        found = collected(coarse.volume, fit, coarse.c, samples, *weights, content, sums.misfit, hidden)
        return replace(found, blocks=self._small_blocks(sums.small, scale, content.unlike) if sums.small else None)

    def _small_blocks(self, parts: list[BlockSums], scale: float, unlike: BoolArray) -> DisplacementField:
        every, frame = BlockSums.joined(parts), self.frame
        middle_mm = np.stack([frame.along(a, every.middle[:, a]) for a in range(3)], axis=1)
        joined = blocks_alike(self.system, every, middle_mm, unlike)
        # tiles are drawn without the factor that forces lose by robustness
        scaled = replace(joined, drawn=scale * joined.drawn)
        return displacement_of_blocks(self.volume.grid, scaled, self.frame.spacing, scale)

    def _adapt(self, sums: _Sums, before: FloatArray) -> None:
        """Choose the weights of the penalties as in memory."""
        coarse, drawn = self.coarse, np.float32(lost_to_robustness(*sums.robust)) * sums.draws[:, :, ADAPTATION_SAMPLES:]
        self._assembled(sums, before)
        self.fit.residual_sd = self.model.residual_sd
        if drawn.shape[2]:
            coarse.release(
                sums.misfit,
                lambda: self.system.solved_many(drawn, SAMPLE_TOLERANCE)[0],
                lambda: self._settle(sums, before, 2),
            )
        for _ in range(ADAPTATIONS):
            # the energies of the field, to which those of the samples are compared
            self._assembled(sums, before)
            settled = coarse.reweigh(self._samples(sums.draws[:, :, :ADAPTATION_SAMPLES]))
            self._settle(sums, before, 2)
            if settled:
                break

    def _mixed(self, sums: _Sums, steps: MixedSteps, before: FloatArray, gain: FloatArray) -> FloatArray:
        """Mix the step from coefficients `before`, and that to a `gain`, with earlier ones; return the gain.

        Either is weighed by what it changes of the intensities.
        """
        active, last = self.system.active, self.model.gain
        step = (self.coarse.c - before)[active].astype(np.float32)
        steep = np.sqrt(sums.misfit[:, 1].sum() / max(3 * len(sums.misfit), 1))
        root = np.linalg.cholesky(sums.gain_matrix + REGULAR * np.trace(sums.gain_matrix) * np.eye(len(last)))
        seen = np.concatenate([steep * self.system.at_middles(step).ravel(), root.T @ (gain - last)])
        taken = steps.mixed(np.concatenate([step.ravel(), gain - last]), seen)
        self.coarse.c = before.copy()
        self.coarse.c[active] += taken[: step.size].reshape(step.shape)
        return last + taken[step.size :]

    def _couple(self, sums: _Sums, gain: FloatArray) -> None:
        """Let the sums solve for displacement and local gain together, given the gain of robust regression."""
        if len(sums.shared):
            regression, at = (sums.gain_matrix, self.model.residual_sd**2, self._everywhere(sums)), self.system.middles_mm
            shared = CoupledGain(sums.shared, sums.newton_gain)
            sums.coupled = GainCoupling(self.system, shared, at / self.coarse.spacing, self.lattice, regression, gain - self.model.gain)

    def _take_step(self, before: FloatArray) -> None:
        """Let the fit judge which cells still move: a tenth of a voxel of the volume, not of the coarse one."""
        self.fit.last_step = (self.coarse.c - before)[self.system.active].astype(np.float32)
        self.fit.still_mm = STILL * float(np.prod(self.frame.spacing) ** (1.0 / 3.0))

    def _with_intensities(self, sums: _Sums) -> Model:
        everywhere = self._everywhere(sums)
        sd = self._residual_sd(sums.classes)
        reliability = self.fit.reliability_of(sums.agreement)
        found = self._gain(sums.gain_matrix, sums.gain_load, self.model.residual_sd, everywhere)
        return replace(self.model, gain=found, residual_sd=sd, reliability=reliability)

    def _everywhere(self, sums: _Sums) -> tuple[float, float, float]:
        """Return one gain and offset for all voxels, and the SD of the intensities."""
        w, f, g, ff, gg = sums.moments
        mean_f, mean_g = f / max(w, 1e-30), g / max(w, 1e-30)
        spread, wanted = gg - w * mean_g**2, ff - w * mean_f**2
        gain = float(np.clip(np.sqrt(max(wanted, 0.0) / max(spread, 1e-30)), *GAIN_RANGE))
        return gain, mean_f - gain * mean_g, float(np.sqrt(max(spread, 0.0) / max(w, 1e-30)))

    def _gain(self, matrix: FloatArray, load: FloatArray, sd: float, everywhere: tuple[float, float, float]) -> FloatArray:
        if not self.fit.settings.gain_cell_mm:
            return np.tile(everywhere[:2], len(load))
        return most_probable_gain(matrix, load, sd**2, everywhere)

    def _residual_sd(self, classes: IntArray) -> float:
        """Return the residual SD from the median of the absolute residuals, which are counted in residual SD of the model."""
        total = np.cumsum(classes)
        if not total[-1]:
            raise InputError("the deformed volume does not show the object: no voxel of it was found there after its motion")
        median = np.interp(0.5 * total[-1], total, np.r_[CLASSES[0], CLASSES])
        return max(MAD * float(median) * self.model.residual_sd, ROUNDING * float(np.ptp(self.fit.level.intensity)))

    def _assembled(self, sums: _Sums, about: FloatArray) -> Float32Array:
        """Assemble the matrix at the present coefficients; return the right side, that of the intensities being linear about others."""
        coarse, fit, system = self.coarse, self.fit, self.system
        fit.products[:], fit.force[:] = 0, 0
        if coarse.inclusions:
            system.warped(coarse.c, fit.value, fit.reference_gradient, fit.gradient, fit.displacement)
        for inclusion in coarse.inclusions:
            inclusion.hold(fit)
        dilatation = coarse.dilatation * system.gauss_volume
        own = bool(coarse.inclusions)  # all other voxels are in the sums
        right = system.assembled(coarse.c, fit.products, fit.force, coarse.bending, dilatation, sums.matrix, voxels=own)
        gone = np.zeros((system.n + 1, 3), np.float32)
        gone[:-1] = (coarse.c - about)[system.active]
        back = np.empty((system.n, 3), np.float32)
        product(sums.matrix, system.neighbours, gone, back)
        if sums.coupled is not None:
            back += sums.coupled.load(sums.coupled.gain_step) - sums.coupled.lost(gone[:-1])
        return np.asarray(right + sums.load - back)

    def _settle(self, sums: _Sums, about: FloatArray, steps: int = 1) -> None:
        """Solve for the coefficients with the present weights; each step leaves a seventh of what the one before left."""
        for _ in range(steps):
            lost = None if sums.coupled is None else sums.coupled.lost
            step, _ = self.system.solved(self._assembled(sums, about), STEP_TOLERANCE, lost=lost)
            self.coarse.c = self.coarse.c.copy()
            self.coarse.c[self.system.active] += step

    def _samples(self, draws: Float32Array, seed: int | None = None) -> Float32Array:
        """Return random coefficients (n, 3, s) from the random loads of all blocks, those of the covariance with a seed of their own."""
        coarse, system = self.coarse, self.system
        out, dilatation = np.empty_like(draws), coarse.dilatation * system.gauss_volume
        rng = np.random.default_rng((coarse.settings.seed if seed is None else seed, self.model.passes))
        noise = self._inclusion_noise() if coarse.inclusions else None
        for first in range(0, draws.shape[2], SAMPLES_AT_ONCE):
            some = slice(first, first + SAMPLES_AT_ONCE)
            loads = draws[:, :, some].copy()
            if noise is not None:
                randoms = (noise.draw(rng) for _ in range(loads.shape[2]))
                loads += self.fit.inclusion_loads([[inclusion.perturbed(r, rng) for inclusion in coarse.inclusions] for r in randoms])
            system.add_penalty_noise(loads, coarse.c, coarse.bending, dilatation, rng)
            out[:, :, some] = system.solved_many(loads, SAMPLE_TOLERANCE if seed is None else COVARIANCE_TOLERANCE)[0]
        return out

    def _inclusion_noise(self) -> ResidualNoise:
        fit = self.fit
        for inclusion in self.coarse.inclusions:
            inclusion.draws.clear()
        return ResidualNoise(fit.level.mask, fit.residual * np.sqrt(fit.weight), lost_to_robustness(*fit.robust_sums))

    def _added(self, blocks: Iterable[ComparedBlock | None]) -> _Sums:
        """Return the sums of all blocks, in their order."""
        sums, m = _Sums(self.system.n, len(self.system.cells)), self.system.cells
        number = np.full(self.frame.cells.shape, -1, np.int64)
        number[tuple(m[:, 2:].T)] = np.arange(len(m))
        for block in blocks:
            if block is not None:
                sums.add(block, self.system.slot[tuple(block.nodes.T)], number[tuple(block.cells.T)])
        if not sums.seen:
            raise InputError("the deformed volume does not show the object: no voxel of it was found there after its motion")
        return sums


class _Sums:
    """Sums over blocks: see `ComparedBlock`."""

    def __init__(self, nodes: int, cells: int) -> None:
        self.seen, self.voxels, self.jitter, self.robust = 0, 0, 0.0, np.zeros(2)
        self.matrix, self.load = np.zeros((nodes, 3, 1029), np.float32), np.zeros((nodes, 3), np.float32)
        self.classes, self.moments = np.zeros(len(CLASSES) + 1, np.int64), np.zeros(5)
        self.agreement, self.misfit, self.cells = np.zeros((cells, 12)), np.zeros((cells, 3)), cells
        self.draws, self.content = np.zeros((nodes, 3, 0), np.float32), np.zeros((cells, 0))
        self.gain_matrix, self.gain_load, self.products, self.pairs = (np.zeros(()) for _ in range(4))
        self.small: list[BlockSums] = []
        self.coupled: GainCoupling | None = None
        self.shared, self.newton_gain = np.zeros((0, 64, 3, 2), np.float32), np.zeros(())

    def add(self, block: ComparedBlock, nodes: IntArray, cells: IntArray) -> None:
        """Add a block whose nodes and cells have these numbers."""
        if self.draws.shape[2] != block.draws.shape[2]:
            self.draws = np.zeros((*self.draws.shape[:2], block.draws.shape[2]), np.float32)
        if self.content.shape[1] != block.content.shape[1]:
            self.content = np.zeros((self.cells, block.content.shape[1]))
        self.seen, self.voxels = self.seen + block.seen, self.voxels + block.voxels
        self.jitter += block.jitter
        self.robust, self.moments = self.robust + block.robust, self.moments + block.moments
        self.classes += block.classes
        self.gain_matrix, self.gain_load = self.gain_matrix + block.gain_matrix, self.gain_load + block.gain_load
        self.products, self.pairs = self.products + block.products, self.pairs + block.pairs
        # nodes and cells of one block differ
        self.matrix[nodes] += block.matrix
        self.load[nodes] += block.load
        self.draws[nodes] += block.draws
        if block.coupled is not None:
            if not len(self.shared):
                self.shared = np.zeros((self.cells, *block.coupled.loads.shape[1:]), np.float32)
            self.shared[cells] += block.coupled.loads
            self.newton_gain = self.newton_gain + block.coupled.matrix
        self.agreement[cells] += block.agreement
        self.misfit[cells] += block.misfit
        self.content[cells] += block.content
        self.small += [] if block.small is None else [block.small]


def _fine(view: Box, factor: int, coarse: tuple[int, ...], fine: tuple[int, ...]) -> Box:
    """Return the box of voxels of a field of view of coarse ones; an end that is not padded is that of the volume."""
    out = []
    for s, n, whole in zip(view, coarse, fine, strict=True):
        low, high, _ = s.indices(n)
        out.append(slice(low * factor, whole if high == n else high * factor))
    return out[0], out[1], out[2]
