"""Whether displacements are averages over a neighbourhood, as windows of correlation and smoothed fields give, and what follows.

Averages over a neighbourhood blunt how strain changes from one zone to the next, so that small zones come out too much like what lies
around them. The noise is averaged in the same way, and neighbouring points then share it: noise of independent points that a Gaussian
kernel of standard deviation s averages has the correlation ``exp(-d^2 / 4 s^2)`` at a distance d. From that of the residuals s is found.
Errors of a model are shared by neighbours, too: how much of such averages the field asks for is found by a score test
(`naibu.identification.from_fields.assumptions.score_test`), of points whose kernels lie inside of the body: how averages were made at its
surface is not known. What moduli would be is found by fits of the averaged displacement of the model; a fit follows some of what neighbours
share, so that s is too small, and longer kernels are tried as well: that of the least misfit counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.assumed_law import told_shift
from naibu.identification.from_fields.assumptions.score_test import ScoreTest
from naibu.identification.from_fields.forward.forward_model import Observed, Solvers, whitening
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Linearised
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, fitted_near
from naibu.identification.from_fields.verdicts.verdict import WITHIN_NOISE
from naibu.identification.neighbours import neighbours
from naibu.identification.verdict import Verdict
from naibu.meshing.point_location import locate, operator_of

NEIGHBOURS = 124  # those of a point of a grid within two steps along each axis
AVERAGED = 0.5  # of the square of the residuals, that must be shared as averages share it: errors of a model that fits are less
SHORTEST, LONGEST, LENGTHS = 0.25, 3.0, 40  # standard deviations of kernels that are tried, in distances to the nearest point
FEWEST_POINTS = 100
ALLOWED, LEAST = 2.0, 0.25  # standard errors beyond what the field asks for, and what of averages it must allow then
LONGER, TRIED = 1.25, 4  # each kernel that is tried over the one before, and how many are
WITHIN = 1e-6  # mm
NODE = np.sqrt(3.0)  # distance of the nodes of a cubature of the third degree from its centre, standard deviations of a normal density
WEIGHT = 1.0 / 6.0  # of each of them
AVERAGES = "neighbouring points share what is left, as where displacements are averages over a neighbourhood"


@dataclass(frozen=True, slots=True)
class Kernel:
    """A Gaussian kernel of averages: its standard deviation, mm, and over how many points' noise it makes one of independent noise."""

    length_mm: float
    points: float


@dataclass(frozen=True, slots=True, eq=False)
class Averaging:
    """That displacements look like averages.

    Attributes
    ----------
    length_mm : float
        Standard deviation of the kernel; the largest of the load cases.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change if the model's displacement were averaged as well.
    """

    length_mm: float
    theta: FloatArray


def averaging(test: ScoreTest, residuals: Sequence[FloatArray], stretch: FloatArray, bounds: Bounds) -> Averaging | None:
    """Return what averages would mean for the moduli; None where residuals do not look like that.

    Parameters
    ----------
    test : ScoreTest
        Of the best fit.
    residuals : sequence of ndarray, shape (q,)
        The best whitened residuals that are known.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    bounds : Bounds
        Of the moduli.
    """
    at, model = test.at, test.at.model
    if model.mesh.dimension != 3:
        return None
    kernels = [kernel(o.points, r.reshape(len(o.points), -1)) for o, r in zip(model.observed, residuals, strict=True)]
    if not any(one.length_mm for one in kernels):
        return None
    pairs = zip(model.observed, at.point.states, kernels, strict=True)
    changes, inside = zip(*(_blunted(model.computed, o, u, one.length_mm) for o, u, one in pairs), strict=True)
    asked = test.along(list(changes), inside)
    if asked is None:
        return None
    square = max(one.points * float((r**2).mean()) for one, r in zip(kernels, residuals, strict=True))
    if asked.part + ALLOWED * float(np.sqrt(square / asked.size)) < LEAST:
        return None
    left = np.concatenate(residuals)
    as_noise = float(np.sqrt((left**2).mean())) <= WITHIN_NOISE  # averages leave less than the noise; what leaves more is not only they
    times, theta = _fitted(at, [one.length_mm for one in kernels], bounds) if as_noise else (1.0, None)
    return Averaging(times * max(one.length_mm for one in kernels), stretch * (asked.theta if theta is None else theta))


def kernel(points: FloatArray, residual: FloatArray) -> Kernel:
    """Return the Gaussian kernel by which residuals (k, d) at points (k, d) look averaged, of no length if they do not."""
    if len(points) < FEWEST_POINTS:
        return Kernel(0.0, 1.0)
    distance, index = neighbours(points, NEIGHBOURS)
    spacing = float(np.median(distance[:, 0]))
    shared = (residual[:, None] * residual[index]).sum(axis=2) / max(float((residual**2).sum(axis=1).mean()), 1e-300)
    best, found, part = np.inf, 0.0, 0.0
    for length in np.geomspace(SHORTEST, LONGEST, LENGTHS) * spacing:
        expected = np.exp(-((distance / (2.0 * length)) ** 2))
        of_it = min(max(float((shared * expected).sum() / max(float((expected**2).sum()), 1e-300)), 0.0), 1.0)
        left = float(((shared - of_it * expected) ** 2).sum())
        if left < best:
            best, found, part = left, float(length), of_it
    if part < AVERAGED:
        return Kernel(0.0, 1.0)
    return Kernel(found, 1.0 + float(np.exp(-((distance / (2.0 * found)) ** 2)).sum(axis=1).mean()))


def judged_averages(judged: Verdict, found: Averaging | None, zones: Zones, theta: FloatArray) -> Verdict:
    """Return the verdict with what averages would change, where that is much; last where residuals are more than noise."""
    if found is None:
        return judged
    changes = told_shift(zones, theta, found.theta)
    if not changes:
        return judged
    why = (
        f"{AVERAGES} (smoothed, interpolated, or from large windows; a standard deviation of some {found.length_mm:.2g} mm): "
        f"if they are, Young's modulus would be another one: {changes}"
    )
    return judged.in_part(why, first=judged.noise_factor <= WITHIN_NOISE)


def _fitted(at: Linearised, lengths: Sequence[float], bounds: Bounds) -> tuple[float, FloatArray | None]:
    """Return how many times as long kernels of averages fit best, and the change (2 count,) of theta then, None without equilibrium.

    Lengths are standard deviations for every load case, mm, 0 for none.
    """
    model, least, solvers = at.model, np.inf, Solvers(at.model.law, at.model.points)  # those of the best fit hold its factors
    best: tuple[float, FloatArray | None] = (1.0, None)
    for times in LONGER ** np.arange(TRIED):
        averaged = copy(model)
        averaged.observed = tuple(_averaged(model.computed, o, times * s) for o, s in zip(model.observed, lengths, strict=True))
        averaged.boundary, averaged.solvers = model.boundary.copied(), solvers
        found = fitted_near(averaged, at.point.theta, at.point.states, bounds)
        if found is not None and found.misfit < least:
            best, least = (float(times), found.theta - at.point.theta), found.misfit
    return best


def _averaged(mesh: Mesh, o: Observed, length: float) -> Observed:
    """Return measurements that are averages of the model's displacement over a kernel."""
    if length == 0.0:
        return o
    average = sp.csr_array((len(o.points), mesh.n_points))
    for step in _steps(length):
        average = average + WEIGHT * operator_of(mesh, locate(mesh, o.points + step, tolerance_mm=np.inf))
    whiten, d = whitening(o.load_case.field, o.load_case.name)[0], o.points.shape[1]
    blocks = np.arange(len(whiten) + 1)
    operator = (sp.bsr_matrix((whiten, blocks[:-1], blocks)).tocsr() @ sp.kron(average, sp.identity(d), format="csr")).tocsr()
    return replace(o, operator=operator, information=(operator.T @ operator).tocsr())


def _steps(length: float) -> FloatArray:
    """Return the nodes (6, 3), mm, of the cubature of the third degree for a normal density of a standard deviation, mm."""
    return np.asarray(NODE * length * np.concatenate([np.eye(3), -np.eye(3)]))


def _blunted(mesh: Mesh, o: Observed, u: FloatArray, length: float) -> tuple[FloatArray, BoolArray]:
    """Return what averages over a kernel change of the whitened displacement (q,) of a state (n, d), mm, and where kernels lie inside (q,).

    By the cubature of the third degree :cite:p:`stroud1971`; of its nodes outside of the body the nearest points of the body.
    """
    points = o.points
    change, inside = np.zeros_like(points), np.full(len(points), length > 0.0)
    if length > 0.0:
        own = operator_of(mesh, locate(mesh, points, tolerance_mm=np.inf)) @ u
        for step in _steps(length):
            there = locate(mesh, points + step, tolerance_mm=np.inf)
            change += WEIGHT * (operator_of(mesh, there) @ u - own)
            inside &= there.distance_mm <= WITHIN
    whiten = whitening(o.load_case.field, o.load_case.name)[0]
    return np.einsum("nij,nj->ni", whiten, change).ravel(), np.repeat(inside, points.shape[1])
