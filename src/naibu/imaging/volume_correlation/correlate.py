"""Global digital volume correlation (DVC) on cubic B-splines, regularised by mechanics: the default method of measuring displacement.

The displacement is a field of cubic B-splines :cite:p:`unser1999,rueckert1999` on a grid about the object. It minimises::

    sum_voxels rho((f - a g(x + u) - b) / s) + sum_cells lambda_c |grad grad u|^2 / 2 + kappa (det(I + grad u) - 1)^2 / 2

where f and g are the intensities of the reference and the deformed volume, a and b a gain and an offset that vary slowly in space, s the
residual standard deviation, and rho the bounded function of :cite:t:`geman1987`. Global correlation with finite elements is due to
:cite:t:`besnard2006`, in volumes to :cite:t:`roux2008`; mechanical regularisation makes a resolution of one voxel possible
:cite:p:`leclerc2011`. The penalty of bending is that of :cite:t:`rueckert1999`; changes of volume are penalised as by
:cite:t:`rohlfing2003`, but by their square. The weights lambda, one for each cell and component, and kappa are the most probable ones given
the data :cite:p:`mackay1992`. Rigid inclusions have a rigid motion each. Coarse to fine, Gauss-Newton, from a rigid initialization.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from naibu.core.errors import InputError
from naibu.core.memory import return_freed_memory
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.field_of_view import fields_of_view, in_box
from naibu.imaging.preprocessing.intensity_parts import intensity_parts
from naibu.imaging.preprocessing.object_mask import mask_in_view
from naibu.imaging.preprocessing.resampling import require_mask
from naibu.imaging.volume_correlation.common_content import (
    LEAST_MATCHED,
    common_content,
    refuse_unrelated,
    require_convergence,
    require_overlap,
)
from naibu.imaging.volume_correlation.gauss_newton import (
    INSIDE_INCLUSION,
    SAMPLE_TOLERANCE,
    CorrelationFit,
    Iterations,
    cell_kinds,
    chosen_weights,
)
from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.intensity_comparison import ComparisonSettings
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise, lost_to_robustness
from naibu.imaging.volume_correlation.resolution_levels import HALVINGS, LEVELS, voxel_stride, voxel_strides
from naibu.imaging.volume_correlation.results.block_displacements import block_displacements
from naibu.imaging.volume_correlation.results.cell_errors import misplacement_variance
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult, collected
from naibu.imaging.volume_correlation.results.hidden_dilatation import TrialParts, hidden_dilatation, loaded_trial_parts
from naibu.imaging.volume_correlation.results.weight_contrasts import WeightContrast, weight_contrasts
from naibu.imaging.volume_correlation.rigid_parts.inclusion_candidates import LEAST_VOLUME, inclusion_candidates
from naibu.imaging.volume_correlation.rigid_parts.rigid_inclusions import RigidInclusion, rigid_inclusions_among
from naibu.imaging.volume_correlation.rigid_parts.rigid_initialization import RigidInitialization, correlated_shift
from naibu.imaging.volume_correlation.settings import REFERENCE_FRACTION, CorrelationSettings
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid
from naibu.imaging.volume_correlation.volume_changes import (
    DEMANDED,
    DRAWS,
    LATE_DRAWS,
    demanded_dilatation,
    may_swell,
    ratio_of_all,
    released_weights,
    squared_dilatation,
)
from naibu.imaging.volume_correlation.volumes_and_masks import LEAST_SIZE, check_shape, filled_pair, labelled

# No derivation stands behind the numbers below: they are empirical, and benchmarks/sense_volumes.py shows the effect of a change.
# an affine motion is tried where the outline is stretched by so much, and taken if its correlation is higher by so much
LEAST_STRETCH, LEAST_GAIN = 0.15, 0.05
FIRST_DILATATION = 0.1  # of the dilatation weight, before it is adapted: a field that is penalised too much does not show its dilatation
AFFINE_DILATATION = 0.02  # of the dilatation weight, for an object that is compressed as a whole: it also changes its volume
COARSE_JITTER = 0.15  # sub-voxel jitter SD on coarse grids, voxels
COARSE_FRACTION = 0.5  # of the reference's gradient on coarse grids: far from registered, the mean of both gradients reaches furthest
INCLUSION_SMOOTHING = 0.8  # of both volumes, for rigid inclusions, voxels
WEIGHT_WINDOW = 1.9  # cells: standard deviation of the window in which cells share a weight
ADAPTATION_SAMPLES, ADAPTATIONS = 12, 4  # random fields of a round, and rounds, in which the weights are adapted
INCLUSION_STEPS, ADAPTED_STEPS = 3, 5  # Gauss-Newton steps with rigid inclusions, and after each adaptation
SEARCHES, RELEASED_STEPS = 2, 2  # for parts that swell, and Gauss-Newton steps after each
UNSETTLED = 0.05  # fraction of the cells that still move, above which these steps go on: large strains of small volumes need more
MOST_STIFFER = 2.0  # median factor on the weights of bending, above which they are adapted once more
MOST_BENDING = 3e3  # times the first weights: a motion that is rigid would have any, and single precision loses the data beside larger ones
# the last steps are solved more exactly: what is left of a step is an error like any other
POLISH = Iterations(6, stop_voxels=0.002, tolerance=0.03, mixed=True)
LEAST_WEIGHT = 1e-3  # of the dilatation weight of the round before
DEFAULT = CorrelationSettings()


def correlate_volumes(
    reference: Volume,
    deformed: Volume,
    *,
    mask: ArrayLike | None = None,
    deformed_mask: ArrayLike | None = None,
    rigid_mask: ArrayLike | None = None,
    settings: CorrelationSettings = DEFAULT,
    least_matched: float = LEAST_MATCHED,
    progress: Progress | None = None,
) -> CorrelationResult:
    """Measure the displacement field of an object by global digital volume correlation (DVC), with covariance and gradient.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes of the object before and after the deformation, on one grid and without NaN.
    mask : array_like, shape (nz, ny, nx), optional
        Voxels of the object in the reference; by default `naibu.imaging.object_mask`, dilated by a voxel.
    deformed_mask : array_like, shape (nz, ny, nx), optional
        Voxels of the object in the deformed volume, from whose position and outline the search starts; by default they are found likewise.
    rigid_mask : array_like, shape (nz, ny, nx), bool or int, optional
        Rigid inclusions: labels from 1, or true in each connected inclusion; by default they are found.
    settings : CorrelationSettings
        Grid, penalties, robustness, covariance.
    least_matched : float
        Share of the object that has to match, unless noise explains the rest; lower it where it is known that both show the same object.
    progress : Progress, optional
        Called for every resolution level, inclusion and adaptation of the weights.

    Returns
    -------
    CorrelationResult
        Valid in the mask, where it lies in the deformed volume after its motion, and where both volumes show the same texture.

    Raises
    ------
    InputError
        Volumes on different grids, of few slices, constant or with NaN in their field of view; an empty mask; volumes that do not overlap,
        or have no content in common, or not enough to be sure that they show the same object.

    Notes
    -----
    Where the inside of the object has no texture that both volumes share the displacement is not answered: a smooth field would be an
    extrapolation from the surface, which does not show how it moves along itself.

    Outer planes of NaN or of one intensity are padding: they are excluded from the comparison, and the displacement of what they hide is
    not answered (see `naibu.imaging.preprocessing.field_of_view`).
    """
    with threadpool_limits(1, user_api="blas"):  # threads of small matrices wait for one another where cores are busy
        correlation = Correlation(reference, deformed, (mask, deformed_mask), settings, progress)
        correlation.initialize()
        correlation.refine()
        correlation.find_inclusions(rigid_mask)
        correlation.adapt()
        return correlation.result(least_matched)


class Correlation:
    """State of a correlation that its steps hand on: `initialize`, `refine`, `find_inclusions`, `adapt`, `result`."""

    def __init__(
        self,
        reference: Volume,
        deformed: Volume,
        masks: tuple[ArrayLike | None, ArrayLike | None],
        settings: CorrelationSettings,
        progress: Progress | None,
    ) -> None:
        mask, deformed_mask = masks
        self.mask_given = mask is not None
        self.volume, self.settings, self.progress = reference, settings, progress
        check_shape(reference, deformed)
        self.views = fields_of_view(reference, deformed)
        if any(max(a.start, b.start) >= min(a.stop, b.stop) for a, b in zip(*self.views, strict=True)):
            raise InputError("reference and deformed do not overlap: no voxel is known in both; check the transform that registered them")
        self.reference, self.deformed = filled_pair(reference, deformed, self.views)
        self.deformed_volume = deformed
        with ThreadPoolExecutor(2) as pool:
            first, second = pool.submit(self._found, reference, mask, 0, 1), pool.submit(self._found, deformed, deformed_mask, 1, 0)
        self.mask, self.deformed_mask = first.result() & in_box(self.views[0], reference.shape), second.result()
        where = np.argwhere(self.mask)
        if not len(where):
            raise InputError("mask is empty: it holds no voxel of the object")
        low, high = where.min(axis=0)[::-1], where.max(axis=0)[::-1]
        if ((high - low + 1) < LEAST_SIZE).any():
            raise InputError(f"mask spans {(high - low + 1).tolist()} voxels along x, y, z; {LEAST_SIZE} or more are needed")
        self.spacing = reference.spacing_mm
        self.step = settings.cell_size_mm(float(self.mask.sum()), self.spacing)
        margin = 1.5 * self.spacing
        self.grid = SplineGrid.around(low * self.spacing - margin, high * self.spacing + margin, self.step, halvings=HALVINGS)
        self.strides = voxel_strides(self.step, self.spacing)
        self.inclusions: list[RigidInclusion] = []
        self.ratio, self.dilatation_factor = 1.0, 1.0
        self.c = np.zeros_like(self.grid.nodes_mm)
        self.starts = [self.c]

    def _found(self, volume: Volume, mask: ArrayLike | None, number: int, margin: int) -> BoolArray:
        """Return the object in the first or the second volume, by a mask where one is given."""
        if mask is None:
            return mask_in_view(volume, self.views[number], margin=margin)
        return require_mask(mask, volume, name=("mask", "deformed_mask")[number])

    def level(self, stride: tuple[int, ...], smoothing: float) -> ImageLevel:
        """Return the voxels at a resolution."""
        return ImageLevel(self.reference, self.deformed, self.mask, self.spacing, stride, smoothing, self.views)

    def comparison(self, level: int) -> ComparisonSettings:
        """Return how intensities are compared on a level."""
        s, fine = self.settings, level > 1
        # on the coarsest level a local gain would explain what has moved
        cell = s.gain_cell * float(self.step.mean()) if s.local_gain and level else 0.0
        return ComparisonSettings(
            s.robust * LEVELS[level].robust,
            s.jitter_sd_voxels if fine else COARSE_JITTER,
            REFERENCE_FRACTION[s.gradients] if fine else COARSE_FRACTION,
            cell,
            far=level == 0,
        )

    def weights(self, system: SplineSystem, factor: float) -> tuple[FloatArray, FloatArray]:
        """Return the weights of bending (m, 3) and dilatation (m,) that do not depend on the data."""
        s = self.settings
        first = FIRST_DILATATION if s.adaptive_weight else 1.0
        h = system.grid.step_mm
        bending = np.full((len(system.cells), 3), factor * s.bending_weight / float(np.prod(h) ** (1 / 3)))
        dilatation = first * self.dilatation_factor * s.dilatation_weight / float(np.prod(h)) if s.dilatation_penalty else 0.0
        return bending, np.full(len(system.cells), dilatation)

    def initialize(self) -> None:
        """Find the rigid motion, and put it on the coarsest grid."""
        report_progress(self.progress, "rigid initialization")
        stride = voxel_stride(self.step, self.spacing, 1)
        level = self.level(stride, self.settings.smoothing_voxels)
        thin = tuple(slice(None, None, s) for s in stride[::-1])
        # only what both scans can show is compared: else the part that one of them lacks would shift the object and stretch its outline
        both = in_box(self.views[0], self.mask.shape) & in_box(self.views[1], self.mask.shape)
        if not (self.mask & both).any():
            both[:] = True
        scene = np.where(both[thin], self.deformed[thin], self.deformed[both].mean())
        shifts = [np.zeros(3), correlated_shift(self.reference[thin] * (self.mask & both)[thin], scene, level.spacing)]
        shown = self.deformed_mask, self.mask
        after, before = (np.argwhere(m & both if (m & both).any() else m)[:, ::-1] * self.spacing for m in shown)
        shifts.append(after.mean(axis=0) - before.mean(axis=0))
        start = RigidInitialization(level)
        motions = start.found(shifts)
        linear, _, correlation = motions[0]
        # an object that is compressed as a whole correlates only after it is stretched as its outline is
        outline = np.diag(after.std(axis=0) / before.std(axis=0))
        if np.abs(np.diag(outline) - 1).max() > LEAST_STRETCH:
            guesses = (outline @ linear, outline)
            ends = [start.stretched(a, a @ (start.middle - before.mean(axis=0)) + after.mean(axis=0) - start.middle) for a in guesses]
            affine = max(ends, key=lambda end: end[2])
            if affine[2] > correlation + LEAST_GAIN and np.linalg.det(affine[0]) > 0.1:
                motions = [affine]
                self.ratio, self.dilatation_factor = float(np.linalg.det(affine[0])), AFFINE_DILATATION
        nodes = self.grid.nodes_mm
        self.starts = [nodes @ a.T + t - nodes for a, t, _ in motions]

    def refine(self) -> None:
        """Fit from coarse to fine with weights that do not depend on the data."""
        for k, stride in enumerate(self.strides):
            if 0 < k <= HALVINGS:
                self.c, self.grid = self.grid.refined(self.c), self.grid.halved()
            if k == 0 or stride != self.strides[k - 1]:
                return_freed_memory()
                level = self.level(stride, self.settings.smoothing_voxels)
            system = SplineSystem(level, self.grid, self.ratio)
            self.bending, self.dilatation = self.weights(system, LEVELS[k].bending)
            iterations = Iterations(LEVELS[k].steps, anchoring=LEVELS[k].anchoring, unsettled=UNSETTLED if k >= HALVINGS else 1.0)
            tried = []
            # the rigid motion that correlates best may rotate a body whose surface is dented: what deforms from it tells
            for c in self.starts if k == 0 else [self.c]:
                fit = CorrelationFit(level, system, self.comparison(k), noisy=k > 1)
                end = fit.iterate(c, self.bending, self.dilatation * system.gauss_volume, iterations)
                tried.append((fit.gradient_correlation * float(fit.seen.mean()), end, fit))
            _, self.c, self.fit = max(tried, key=lambda t: t[0])
            report_progress(
                self.progress, "coarse-to-fine correlation", done=k + 1, total=len(self.strides), objective=self.fit.residual_sd
            )
        refuse_unrelated(self.fit)

    def find_inclusions(self, rigid_mask: ArrayLike | None) -> None:
        """Find the inclusions that move rigidly, and give each a rigid motion."""
        if not self.settings.rigid_inclusions:
            return
        size = float(self.step.mean())
        found = self._candidates(size) if rigid_mask is None else labelled(rigid_mask, self.volume)
        labels = np.where(self.mask, found, 0).astype(np.int32)
        if not labels.any():
            return
        level, given = self.level((1, 1, 1), INCLUSION_SMOOTHING), rigid_mask is not None
        least = LEAST_VOLUME * size**3
        self.inclusions = rigid_inclusions_among(self.fit, labels, level, given=given, least_mm3=least, progress=self.progress)
        self.fit.inclusions = self.inclusions

    def _candidates(self, size: float) -> Int32Array:
        """Return labels (nz, ny, nx) of candidates for rigid inclusions in the field of view of the reference."""
        view, labels = self.views[0], np.zeros(self.mask.shape, np.int32)
        shown = Volume.from_array(self.reference[view], spacing_mm=self.spacing)
        labels[view] = inclusion_candidates(shown, self.mask[view], size)
        return labels

    def follow_inclusions(self) -> None:
        """Fit with the rigid inclusions, and tell cells near them from others."""
        fit = self.fit
        if self.inclusions:
            self.c = fit.iterate(self.c, self.bending, self.dilatation * fit.system.gauss_volume, Iterations(INCLUSION_STEPS))
        self.kinds = cell_kinds(fit)
        # of cells whose volume changes no more than elsewhere
        self.common_dilatation = float(self.dilatation[0])
        self.most_dilatation = self.common_dilatation / (FIRST_DILATATION * self.dilatation_factor)
        self.dilating = np.zeros(len(fit.system.cells), dtype=bool)  # cells with weights of their own

    def adapt(self) -> None:
        """Choose the weights of the penalties by the data, and fit once more."""
        fit, system, s = self.fit, self.fit.system, self.settings
        return_freed_memory()  # of coarser levels
        self.follow_inclusions()
        if not s.adaptive_weight:
            return
        fit.jitter_voxels = fit.bounded_jitter(fit.observed_jitter_voxels)
        self.release(fit.cell_misfit(), lambda: fit.noise_samples(DRAWS, self.noise(), s.seed), self.settle_released)
        for k in range(ADAPTATIONS):
            report_progress(self.progress, "weights of the penalties", done=k, total=ADAPTATIONS)
            weights = self.bending, self.dilatation * system.gauss_volume
            if k:  # the matrix of mixed steps has the curvature of robust weights, which random fields do not
                fit.assemble(self.c, *weights)
            settled = self.reweigh(fit.samples(self.c, *weights, ADAPTATION_SAMPLES, None, s.seed, SAMPLE_TOLERANCE))
            steps = Iterations(ADAPTED_STEPS, unsettled=UNSETTLED, mixed=True)
            self.c = fit.iterate(self.c, self.bending, self.dilatation * system.gauss_volume, steps)
            if settled:
                break
        self.c = fit.iterate(self.c, self.bending, self.dilatation * system.gauss_volume, POLISH)

    def noise(self) -> ResidualNoise:
        """Return noise like the present residuals."""
        fit = self.fit
        return ResidualNoise(fit.level.mask, fit.residual * np.sqrt(fit.weight), lost_to_robustness(*fit.robust_sums))

    def settle_released(self) -> None:
        """Fit with the weights of parts that swell."""
        self.c = self.fit.iterate(self.c, self.bending, self.dilatation * self.fit.system.gauss_volume, Iterations(RELEASED_STEPS))

    def release(self, misfit: FloatArray, noise: Callable[[], Float32Array], settle: Callable[[], None]) -> None:
        """Find the cells in which the data demand that volume changes by more than elsewhere, and let it.

        `misfit` (m, 3) is that of `CorrelationFit.cell_misfit`. `noise` draws coefficients (n, 3, s) of noise alone, and `settle` fits at
        the weights that were lowered: what large parts took from their surroundings hid smaller ones.
        """
        fit, most = self.fit, self.most_dilatation
        # jumps where structures slide, or are not in both volumes, are none
        some = (fit.system.gauss_volume > 0.0) & (self.kinds < INSIDE_INCLUSION) & (misplacement_variance(fit, misfit) == 0.0)
        for _ in range(SEARCHES):
            if most == 0.0 or not some.any() or squared_dilatation(fit)[some].max() < 1.0 / most:
                return
            demand = demanded_dilatation(fit, noise(), self.c)
            more = may_swell(fit, some, most) & (demand > DEMANDED) & ~self.dilating
            if not more.any():
                return
            self.dilating |= more
            self.dilatation = np.where(more, released_weights(fit, self.common_dilatation, demand), self.dilatation)
            settle()

    def reweigh(self, samples: Float32Array) -> bool:
        """Choose the weights of the penalties given random coefficients (n, 3, s), and return whether another round changes little."""
        fit, common, bent, before = self.fit, self.common_dilatation, self.bending, self.dilatation
        width = WEIGHT_WINDOW * float(self.step.mean())
        self.bending, dilatation = chosen_weights(fit, samples, self.c, bent, common, width, self.kinds, self.dilating)
        # what swells bends about it, more than what it shares its weight with
        first = self.weights(fit.system, 1.0)[0]
        self.bending = np.minimum(self.bending, np.where(self.dilating[:, None], 1.0, MOST_BENDING) * first)
        if self.settings.dilatation_penalty:
            # an object that swells as a whole would be held back by all of its cells
            fit.system.ratio = ratio_of_all(fit, self.c, self.most_dilatation)
            # never more than assumed: what little volume changes may not be noise alone
            self.common_dilatation = float(np.clip(dilatation, LEAST_WEIGHT * common, self.most_dilatation))
            self.dilatation = np.where(self.dilating, np.minimum(before, self.common_dilatation), self.common_dilatation)
        # a field that was penalised too much shows only in part how much volume changes, and one penalised too little has noise that bends
        stiffer = float(np.median(self.bending[fit.system.inner] / bent[fit.system.inner]))
        return self.common_dilatation > 0.5 * common and stiffer < MOST_STIFFER

    def hidden(self, tried: tuple[TrialParts, Float32Array], noise: Float32Array, robust: float) -> tuple[FloatArray, FloatArray]:
        """Return the variances (m,) of `hidden_dilatation`; the equations are assembled at the present weights.

        `tried` is what `loaded_trial_parts` returned, `noise` (n, 3, s) are coefficients of noise alone, and `robust` is that of
        `hidden_dilatation`.
        """
        system = self.fit.system
        some = (system.gauss_volume > 0.0) & (self.kinds < INSIDE_INCLUSION) & (self.dilatation > 0.0)
        penalties = system.bending_load(self.c, self.bending) + system.dilatation_load(self.c, self.dilatation * system.gauss_volume)
        return hidden_dilatation(self.fit, self.c, *tried, noise, some, -penalties, robust)

    def contrasts(self, noise: ResidualNoise, drawn: Float32Array, bias: Float32Array) -> tuple[WeightContrast, ...]:
        """Return the contrasts of weights, given noise, what `CorrelationFit.noise_samples` drew of it for `hidden`, and the bias."""
        fit, shown = self.fit, Volume.from_array(self.reference, spacing_mm=self.spacing)
        parts = [fit.level.listed(part) for part in intensity_parts(shown, self.mask)]
        penalties = self.bending, self.dilatation * fit.system.gauss_volume
        return weight_contrasts(fit, self.c, penalties, parts, noise, self.settings.seed + 3, drawn, bias)

    def result(self, least_matched: float) -> CorrelationResult:
        """Draw the covariance, and return the result, unless less than a share of the object matches."""
        report_progress(self.progress, "covariance")
        fit, system = self.fit, self.fit.system
        fit.reliability = None
        fit.compare(self.c)
        system.sum_intensities(fit.products)
        tried, dilatation = loaded_trial_parts(system, system.matrix), self.dilatation * system.gauss_volume
        system.assembled(self.c, fit.products, fit.force, self.bending, dilatation, system.matrix, voxels=False)  # of the intensities
        require_overlap(float(fit.seen.mean()))
        refuse_unrelated(fit)
        return_freed_memory()  # of the steps
        content = common_content(fit, fit.level.depth_mm(self.mask))
        content.refuse_chance(system.inner, least_matched)
        require_convergence(fit.moving_fraction)
        for inclusion in self.inclusions:
            inclusion.draws.clear()
        misfit = fit.cell_misfit()
        fit.agreement = fit.agreement[:0].copy()  # the draws need its memory
        return_freed_memory()
        noise = self.noise()
        drawn = fit.noise_samples(LATE_DRAWS, noise, self.settings.seed + 3)
        hidden = self.hidden(tried, drawn, noise.scale)
        samples = fit.samples(self.c, self.bending, dilatation, self.settings.samples, noise, self.settings.seed + 1)
        blocks = block_displacements(self.volume, fit, noise, self.settings.seed + 2, content.unlike)
        contrasts = partial(self.contrasts, noise, drawn)
        found = collected(self.volume, fit, self.c, samples, self.bending, self.dilatation, content, misfit, hidden, contrasts)
        return replace(found, blocks=blocks)
