"""Verdict on moduli from a displacement field: whether the model explains the measurements, and noise that neighbours share.

The verdict weighs the residuals in units of the stated noise, what they leave unexplained of the deformation, and the part of them that
neighbours share (noise of independent points is not shared; compare Moran's I). Errors that neighbours share, of the
measurement or of the model, weigh more than independent ones; the covariance of the moduli is then taken from the scatter of the scores of
spatial blocks, the cluster-robust estimator of :cite:t:`liang1986`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.rigid_transform import registration
from naibu.identification.from_fields.forward.forward_model import Observed
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.verdict import Explanation, Verdict, shared_part

WITHIN_NOISE = 1.25  # residuals over the noise that need no explanation even if neighbours share them
NOISE_UNDERSTATED = 2.0  # residuals over the stated noise that may still be noise, if neighbours do not share them
SMALL, LARGE = 0.02, 0.25  # of the deformation: so little needs no explanation, so much must not be left
SHARED = 0.15
OUTLIERS, OF_MISFIT = 0.1, 0.75  # fewer points that hold so much of the misfit are named; of normal errors half of them do
# for every cell of a body whose surface is sought: fewer limit what is known, and fewer tell nothing (with 0.4 intervals still held)
POINTS_OF_CELL, LEAST_POINTS = 2, 0.25
POINTS_FOR_POISSON = 0.5  # for every cell: with 0.4 Poisson's ratios of 0.45 came out as 0.476, two standard deviations above
FEW_POINTS = (
    "There are fewer points than elements: they leave the motion of the surface to the assumption that it is smooth, which draws Poisson's "
    "ratio towards 0.5. Nothing is said of Poisson's ratio; measure more points to know more."
)
BLOCKS, POINTS_PER_BLOCK, FEWEST_BLOCKS = 64, 6, 16


def verdict(observed: Sequence[Observed], residuals: Sequence[FloatArray], degrees_of_freedom: float) -> Verdict:
    """Return the verdict on whitened residuals (q,) of the load cases."""
    misfit = sum(float(r @ r) for r in residuals)
    factor = float(np.sqrt(misfit / max(degrees_of_freedom, 1.0)))
    noise_stated = not any(o.exact for o in observed)
    left = deformed = 0.0
    for o, r in zip(observed, residuals, strict=True):
        beyond = max(float(r @ r) - (len(r) if noise_stated else 0.0), 0.0) * o.noise_mm**2
        left, deformed = left + beyond, deformed + _deformation(o)
    unexplained = float(np.sqrt(left / max(deformed, 1e-300)))
    shared = shared_part([(o.points, r.reshape(len(o.points), -1)) for o, r in zip(observed, residuals, strict=True)]).correlation
    how = _explanation(factor, unexplained, shared, noise_stated=noise_stated)
    noise = f"residuals are {factor:.2g} times the noise, " if noise_stated else ""
    lead = f"{noise}{100 * unexplained:.2g} % of the deformation is left unexplained"
    reasons: tuple[str, ...] = ()
    if how is not Explanation.EXPLAINED:
        alike = ", and neighbouring points share it" * (shared > SHARED)
        few = _told_outliers(
            np.concatenate([(r.reshape(len(o.points), -1) ** 2).sum(axis=1) for o, r in zip(observed, residuals, strict=True)])
        )
        reasons = (f"{lead}{alike}{few}" + ": question law, zones and known values" * (how is Explanation.IN_PART),)
    return Verdict(how, reasons, lead, factor, unexplained, shared)


def with_enough_points(judged: Verdict, model: FieldModel) -> Verdict:
    """Return the verdict with what is said where the motion of a whole surface is sought from too few points for the number of cells.

    The surface then follows nearly any measurement, whatever the moduli, and residuals as small as the noise say nothing for them.
    """
    points, cells = max(len(o.points) for o in model.observed), model.mesh.n_cells
    if not model.surface_sought or cells * POINTS_OF_CELL <= points:
        return judged
    few = told_points(points, cells)
    if cells * LEAST_POINTS <= points:
        return replace(judged, limits="; ".join(filter(None, (few, judged.limits))))
    return replace(judged, explanation=Explanation.NOT_EXPLAINED, reasons=(few, *judged.reasons))


def tells_poisson(model: FieldModel) -> bool:
    """Whether there are enough points for Poisson's ratio to be told where the motion of a whole surface is sought."""
    return not model.surface_sought or max(len(o.points) for o in model.observed) >= POINTS_FOR_POISSON * model.mesh.n_cells


def told_points(points: int, cells: int) -> str:
    """Say that there are too few points for the number of cells."""
    # no word of larger cells: where these are too coarse already, that would contradict what is said of them
    return f"{points} points for {cells} cells leave to the motion of the surface what would tell moduli: measure more of them"


def _told_outliers(misfit: FloatArray) -> str:
    """Say which part of the points holds nearly all of the misfit (n,), where it is small."""
    worst = np.cumsum(np.sort(misfit)[::-1])
    part = float(np.searchsorted(worst, OF_MISFIT * worst[-1]) + 1) / len(misfit)
    return f", {100 * OF_MISFIT:.0f} % of the misfit is that of {100 * part:.2g} % of the points, which may be wrong" * (part < OUTLIERS)


def _explanation(factor: float, unexplained: float, shared: float, *, noise_stated: bool) -> Explanation:
    if unexplained > LARGE and (factor > NOISE_UNDERSTATED or not noise_stated):
        return Explanation.NOT_EXPLAINED
    if not noise_stated:
        return Explanation.EXPLAINED if unexplained <= SMALL else Explanation.IN_PART
    unshared = factor <= NOISE_UNDERSTATED and shared <= SHARED
    explained = unexplained <= LARGE and (factor <= WITHIN_NOISE or unshared)
    return Explanation.EXPLAINED if explained else Explanation.IN_PART


def _deformation(o: Observed) -> float:
    """Return the sum of squares (mm^2) of the measured displacement less its best rigid motion."""
    points, vectors = o.points, o.load_case.field.vectors[o.load_case.field.valid]
    if points.shape[1] < 3 or len(points) < 4:
        return float(((vectors - vectors.mean(axis=0)) ** 2).sum())
    return float(((points + vectors - registration(points, points + vectors).applied(points)) ** 2).sum())


def inflation(
    observed: Sequence[Observed], residuals: Sequence[FloatArray], jacobians: Sequence[FloatArray], covariance: FloatArray, freedom: float
) -> float:
    """Return by how much errors that neighbours share raise the variance of the moduli, 1 where they do not by more than chance.

    Parameters
    ----------
    observed : sequence of Observed
        Load cases.
    residuals : sequence of ndarray, shape (q,)
        Whitened residuals.
    jacobians : sequence of ndarray, shape (q, 2 count)
        Their derivatives, loaded components following.
    covariance : ndarray, shape (2 count, 2 count)
        Of theta, for independent errors.
    freedom : float
        Degrees of freedom.
    """
    points = np.concatenate([o.points for o in observed])
    blocks = _blocks(points, min(BLOCKS, len(points) // POINTS_PER_BLOCK))
    count, size = int(blocks.max()) + 1, covariance.shape[0]
    if count < FEWEST_BLOCKS or not np.isfinite(covariance).all() or freedom <= 0.0:
        return 1.0
    misfit = sum(float(r @ r) for r in residuals)
    scores = np.concatenate(
        [(r[:, None] * j).reshape(-1, points.shape[1], size).sum(axis=1) for r, j in zip(residuals, jacobians, strict=True)]
    )
    of_blocks = np.stack([np.bincount(blocks, s, minlength=count) for s in scores.T], axis=1)
    information = sum(j.T @ j for j in jacobians)
    bread = np.linalg.pinv(information)
    robust = bread @ (of_blocks.T @ of_blocks) @ bread * count / (count - 1.0) * sum(len(r) for r in residuals) / freedom
    independent = bread * misfit / freedom
    ratio = float(np.max(np.diag(robust) / np.maximum(np.diag(independent), 1e-300)))
    return ratio if ratio > 1.0 + 2.5 * np.sqrt(2.0 / count) else 1.0


def _blocks(points: FloatArray, most: int) -> IntArray:
    """Return the spatial block (n,) of every point: halves of halves along the longest axis, as many of like numbers as a power of two."""
    label = np.zeros(len(points), dtype=np.int64)
    for level in range(int(np.log2(max(most, 1)))):
        for block in range(2**level):
            inside = np.flatnonzero(label == block)
            axis = int(np.argmax(np.ptp(points[inside], axis=0)))
            order = np.argsort(points[inside, axis], kind="stable")
            label[inside[order[len(order) // 2 :]]] = block + 2**level
    return label
