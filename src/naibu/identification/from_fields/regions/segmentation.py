"""Segmentation of a field of moduli into regions of one material each, refitted without the penalty.

Total variation locates interfaces but reduces their contrast. Zones with similar moduli are therefore gathered into clusters
(:cite:p:`ward1963`); clusters are merged as long as a Bayesian information criterion favours it; cells at interfaces change sides where
that lowers the objective; and the moduli of the remaining regions are fitted to the measurements alone.

The objective of a partition is half of chi squared, plus the weighted total variation of the partition (each jump counted up to a maximum),
plus, for each region, the logarithms of the number of measurements (its two moduli) and of cells (its location): BIC extended to sets of
candidates (:cite:p:`schwarz1978,chen2008`).
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.core.progress import Progress, report_progress
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.identification.from_fields.forward.loaded_components import ROUGH_TOLERANCE
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Point
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, Found, Objective, SearchSettings, first_point, search
from naibu.identification.from_fields.inversion.kept_hessian import KeptHessian
from naibu.identification.from_fields.inversion.regularization import BULK_WEIGHT, ZoneGraph
from naibu.identification.from_fields.regions.compressibility import no_less_compressible
from naibu.identification.from_fields.regions.contrast_prior import ContrastPrior, moderated
from naibu.identification.from_fields.regions.merging import CLEAR, jump_costs, merged

CLUSTERS = (20, 8)  # to begin with, one after the other: the better end counts
LIKE = 0.005  # difference of logarithms of moduli between neighbours that belong together at once
# half of chi squared that a face of a border costs: the number of closed surfaces of n faces on a cubic lattice grows about as 1.7^n
FACE = 0.55
# parts of the contrasts of regions about which zones are asked to change sides, until some do: a region of too few has too great a contrast
# for any other zone to join it
CONTRASTS = (1.0, 0.5)
ROUNDS, PAIRS = 12, 3  # of merging and fitting; pairs that are tried where the fit does not confirm a merger
ROUGHLY = SearchSettings(max_iterations=12, tolerance=1e-5)  # while the regions may still change
FAR = 0.5  # of a logarithm: whole cells may make an empty region of a soft one, about which derivatives say nothing of the one with borders
EXPLICIT = 500  # zones up to which a map is searched with the whole Hessian, and that may change sides between regions


@dataclass(frozen=True, slots=True, eq=False)
class Segmentation:
    """Regions and their moduli.

    Attributes
    ----------
    of_zone : ndarray, shape (count,), int64
        Region of every zone, numbered by falling volume.
    zones : Zones
        The regions as zones of the mesh.
    point : Point
        The fit of their moduli: to the measurements alone, or with the prior of contrasts where the former is far from it.
    clusters : int
        Number of clusters at the beginning.
    moved : int
        Zones that changed sides at borders.
    """

    of_zone: IntArray
    zones: Zones
    point: Point
    clusters: int
    moved: int


def joined(zones: Zones, of_zone: IntArray) -> Zones:
    """Return zones made of others: `of_zone` (count,) is the new number of each."""
    unknown = zones.of_cell != KNOWN
    of_cell = zones.of_cell.copy()
    of_cell[unknown] = of_zone[of_cell[unknown]]
    names = tuple(f"segment {i + 1}" for i in range(int(of_zone.max()) + 1))
    return replace(zones, of_cell=of_cell, names=names)


def weight_of_borders(graph: ZoneGraph) -> float:
    """Return the weight of total variation, 1/mm^2, at which clear borders cost what it takes to tell where they run."""
    return FACE / (CLEAR * float(graph.area.mean()))


def clusters(graph: ZoneGraph, theta: FloatArray, most: int) -> IntArray:
    """Gather touching zones of like moduli into at most `most` clusters (if the zones hang together), by Ward's criterion.

    Parameters
    ----------
    graph : ZoneGraph
        Zones and faces between them.
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu), of all zones.
    most : int
        Number of clusters.

    Returns
    -------
    ndarray, shape (count,), int64
        Cluster of every zone.
    """
    features = theta.reshape(2, -1).T * [1.0, BULK_WEIGHT]
    a, b = graph.pairs.T
    same = np.linalg.norm(features[a] - features[b], axis=1) < LIKE
    links = sp.coo_matrix((np.ones(int(same.sum())), (a[same], b[same])), shape=(graph.count, graph.count))
    _, label = connected_components(links, directed=False)
    volume = np.bincount(label, graph.volume).astype(float)
    means = np.stack([np.bincount(label, graph.volume * f) / volume for f in features.T], axis=1)
    pairs = np.unique(np.sort(label[graph.pairs], axis=1), axis=0)
    return np.asarray(_ward(pairs[pairs[:, 0] != pairs[:, 1]], means, volume, most)[label], dtype=np.int64)


def _ward(pairs: IntArray, means: FloatArray, volume: FloatArray, most: int) -> IntArray:
    """Merge the touching pair whose union varies least about its mean, again and again; returns the cluster of every item."""
    mean, weight = [tuple(m) for m in means], volume.tolist()
    near: list[set[int]] = [set() for _ in weight]
    for i, j in pairs.tolist():
        near[i].add(j)
        near[j].add(i)

    def cost(i: int, j: int) -> float:
        squared = sum((p - q) ** 2 for p, q in zip(mean[i], mean[j], strict=True))
        return float(weight[i] * weight[j] / (weight[i] + weight[j]) * squared)

    heap = [(cost(i, j), i, j, 0, 0) for i, j in pairs.tolist()]
    heapq.heapify(heap)
    version, owner, left = [0] * len(weight), list(range(len(weight))), len(weight)
    while left > most and heap:
        _, i, j, of_i, of_j = heapq.heappop(heap)
        if version[i] != of_i or version[j] != of_j:
            continue
        total = weight[i] + weight[j]
        mean[i] = tuple((weight[i] * p + weight[j] * q) / total for p, q in zip(mean[i], mean[j], strict=True))
        weight[i] = total
        version[i] += 1
        version[j] = -1
        owner[j] = i
        for k in near[j] - {i}:
            near[k].discard(j)
            near[k].add(i)
        near[i] = (near[i] | near[j]) - {i, j}
        for k in near[i]:
            heapq.heappush(heap, (cost(i, k), i, k, version[i], version[k]))
        left -= 1
    for i in range(len(owner)):
        while owner[i] != owner[owner[i]]:
            owner[i] = owner[owner[i]]
    return np.unique(owner, return_inverse=True)[1].astype(np.int64)


def areas_between(graph: ZoneGraph, labels: IntArray) -> FloatArray:
    """Return the area of the faces between regions (k, k), mm^2."""
    k = int(labels.max()) + 1
    out = np.zeros((k, k))
    np.add.at(out, tuple(labels[graph.pairs].T), graph.area)
    out = out + out.T
    out[np.arange(k), np.arange(k)] = 0.0
    return out


def border_moves(
    graph: ZoneGraph, labels: IntArray, theta: FloatArray, quadratic: Concentrated, weight: float, movable: IntArray | None = None
) -> tuple[IntArray, int]:
    """Let zones at borders change sides, one at a time, the one that lowers the objective most first.

    Parameters
    ----------
    graph : ZoneGraph
        Zones and faces between them.
    labels : ndarray, shape (count,), int64
        Region of every zone.
    theta : ndarray, shape (2 regions,)
        Logarithms of the regions' moduli, which stay.
    quadratic : Concentrated
        Half of chi squared in the logarithms of the movable zones, about these moduli.
    weight : float
        Of total variation, 1/mm^2.
    movable : ndarray, shape (m,), int64, optional
        Zones that may change sides; by default all.

    Returns
    -------
    labels : ndarray, shape (count,), int64
        Region of every zone.
    moves : int
        How many changed.
    """
    labels, movable = labels.copy(), np.arange(graph.count) if movable is None else movable
    values, m = theta.reshape(2, -1), len(movable)
    jumps = np.hypot(values[0][:, None] - values[0], BULK_WEIGHT * (values[1][:, None] - values[1]))
    hessian = quadratic.hessian.reshape(2, m, 2, m)
    own = hessian[:, np.arange(m), :, np.arange(m)]  # (m, 2, 2)
    gradient = quadratic.gradient.reshape(2, m).copy()
    half = sp.csr_matrix((graph.area, tuple(graph.pairs.T)), shape=(graph.count, graph.count))
    touching = (half + half.T).tocsr()[movable]
    for moves in range(4 * m):
        of_movable = labels[movable]
        step = values[:, None, :] - values[:, of_movable][:, :, None]  # (2, m, regions)
        of_data = np.einsum("in,inr->nr", gradient, step) + 0.5 * np.einsum("inr,nij,jnr->nr", step, own, step)
        beside = touching @ np.eye(values.shape[1])[labels]  # area that every zone shares with every region
        of_borders = beside @ jumps.T - np.take_along_axis(beside @ jumps.T, of_movable[:, None], axis=1)
        change = np.where(beside > 0.0, of_data + weight * of_borders, 0.0)
        zone, region = np.unravel_index(int(np.argmin(change)), change.shape)
        if not change[zone, region] < -1e-6:
            return labels, moves
        gradient += np.einsum("inj,j->in", hessian[:, :, :, zone], step[:, zone, region])
        labels[movable[zone]] = region
    return labels, 4 * m


def segment(
    model: FieldModel, graph: ZoneGraph, start: Point, weight: float, bounds: Bounds, progress: Progress | None = None
) -> Segmentation:
    """Find regions in a field of moduli that was found under total variation of some weight, and fit them without it.

    Parameters
    ----------
    model : FieldModel
        Load cases, and the zones whose moduli vary freely.
    graph : ZoneGraph
        Of these zones.
    start : Point
        Their moduli under total variation.
    weight : float
        Of total variation, 1/mm^2.
    bounds : Bounds
        Of the moduli.
    progress : callable, optional
        Gets a report after every number of clusters, and of every iteration of a search.

    Raises
    ------
    ConvergenceError
        With no number of clusters an equilibrium was found.
    """
    criterion, within = Criterion.of(model, graph, start, weight), no_less_compressible(model, start.theta, bounds)
    found: list[tuple[float, IntArray, Point, int]] = []
    for most in CLUSTERS:
        try:
            labels, point, moved = _from_clusters(model, criterion, start, within, most, progress)
        except ConvergenceError:
            if most == CLUSTERS[-1] and not found:
                raise
            continue
        found.append((criterion.value(labels, point), labels, point, moved))
        text = f"{most} clusters made {int(labels.max()) + 1} regions, misfit {point.misfit:.4g}"
        report_progress(progress, text, done=len(found), total=len(CLUSTERS), objective=point.misfit)
        alone = int(labels.max()) == 0 and 0.5 * (point.misfit - start.misfit) / criterion.scale < criterion.charge
        if alone or float(np.ptp(start.theta.reshape(2, -1), axis=1).max()) < LIKE:  # there is nothing to gather otherwise
            break
    _, labels, point, moved = min(found, key=lambda f: f[0])
    order = np.argsort(-np.bincount(labels, graph.volume), kind="stable")
    labels = np.argsort(order)[labels]
    zones = joined(model.zones, labels)
    regions = model.with_zones(zones)
    point = point_at(regions, point.theta.reshape(2, -1)[:, order].ravel(), point)
    return Segmentation(labels, zones, fitted_nearby(regions, point, bounds, progress), max(CLUSTERS), moved)


def fitted_nearby(regions: FieldModel, point: Point, bounds: Bounds, progress: Progress | None = None) -> Point:
    """Return the fit of regions to the measurements alone, or the given one where that is far from it, of which it knows little.

    A region of whole cells that is a little too small or too large fits best nearly empty, or rigid; the way there is long, and ends where
    the data say nothing any more.
    """
    found = search(regions, point, Objective(bounds=bounds), SearchSettings(furthest=FAR), progress=progress).point
    return regions.evaluate(point.theta, point.states) if np.abs(found.theta - point.theta).max() > FAR else found


@dataclass(frozen=True, slots=True, eq=False)
class Criterion:
    """What a partition costs.

    Attributes
    ----------
    graph : ZoneGraph
        The zones that are parted.
    weight : float
        Of total variation, 1/mm^2.
    charge : float
        Of every region.
    scale : float
        By how much the misfit under total variation is above that of noise alone: errors of the model, by which all misfits are divided.
    """

    graph: ZoneGraph
    weight: float
    charge: float
    scale: float

    @classmethod
    def of(cls, model: FieldModel, graph: ZoneGraph, start: Point, weight: float) -> Criterion:
        """Return the criterion for zones whose moduli under total variation are known."""
        scale = max(1.0, start.misfit / model.n_free)
        return cls(graph, weight / scale, float(np.log(model.n_free) + np.log(graph.count)), scale)

    def value(self, labels: IntArray, point: Point) -> float:
        """Return the cost of regions with fitted moduli."""
        area = areas_between(self.graph, labels)
        values = point.theta.reshape(2, -1)
        borders = float(np.sum(area * jump_costs(values[:, :, None] - values[:, None, :]))) / 2.0
        contrasts = self.prior(labels).value(point.theta)
        return float(0.5 * point.misfit / self.scale + self.weight * borders + contrasts + self.charge * len(area))

    def prior(self, labels: IntArray) -> ContrastPrior:
        """Return the prior of the moduli of regions."""
        return ContrastPrior(int(np.argmax(np.bincount(labels, self.graph.volume))))


def _from_clusters(
    model: FieldModel, criterion: Criterion, start: Point, bounds: Bounds, most: int, progress: Progress | None
) -> tuple[IntArray, Point, int]:
    """Merge clusters, fit regions and mend their borders until nothing changes; returns regions, their fit, and how many zones moved."""
    graph = criterion.graph
    labels = clusters(graph, start.theta, most)
    volume = np.bincount(labels, graph.volume)
    theta = np.concatenate([np.bincount(labels, graph.volume * t) / volume for t in start.theta.reshape(2, -1)])
    point, moved, near = point_at(model.with_zones(joined(model.zones, labels)), theta, start), 0, None
    for _ in range(ROUNDS):
        fitted = model.with_zones(joined(model.zones, labels))
        point = fitted.evaluate(point.theta, point.states)  # factors are those of what was tried last
        quadratic = fitted.linearised(point).concentrated(np.eye(len(point.theta)), ROUGH_TOLERANCE, near)
        before, changed = int(labels.max()), 0
        end = _with_less(model, criterion, (labels, point, quadratic), bounds, progress)
        if end is None:
            break
        labels, found = end
        point, near = found.point, found.response
        if int(labels.max()) > 0:
            labels, point, changed = _with_better_borders(model, criterion, labels, point, bounds, progress)
            near = None if changed else near
        moved += changed
        if not changed and before == int(labels.max()):
            break
    return labels, point, moved


def _with_less(
    model: FieldModel, criterion: Criterion, here: tuple[IntArray, Point, Concentrated], bounds: Bounds, progress: Progress | None
) -> tuple[IntArray, Found] | None:
    """Return regions of which up to half were merged, and their fit; None where all that was tried costs more than before.

    Merging goes by a quadratic approximation, which says nothing far away: that about a lump of too few cells, nearly empty, knows of no
    stiffer one. It counts only if the fit confirms it; otherwise fewer are merged, and pairs are tried, one at a time.
    """
    labels, point, quadratic = here
    scaled, area = _scaled(quadratic, criterion.scale), areas_between(criterion.graph, labels)
    below, apart = criterion.value(labels, point), np.zeros(area.shape, dtype=bool)
    for most in _numbers_of_mergers(len(area)):
        united, theta = merged(scaled, point.theta, area, criterion.weight, criterion.charge, most, apart)
        gather = np.asarray(np.kron(np.eye(2), np.eye(int(united.max()) + 1)[united]), dtype=float)
        start = _Start(theta, point, _gathered(quadratic, gather), float(np.abs(gather @ theta - point.theta).max()) > FAR)
        new, found = _refitted(model, criterion, united[labels], start, bounds, progress)
        if int(united.max()) + 1 == len(area) or criterion.value(new, found.point) < below:
            return new, found
        if most == 1:
            apart |= united[:, None] == united
    return None


def _numbers_of_mergers(regions: int) -> list[int]:
    """Return how many regions to merge at once, one number after the other while fits do not confirm it."""
    half = max(1, regions // 2)
    return [*(half >> k for k in range(half.bit_length() - 1)), *[1] * (PAIRS + (half == 1))]


def _gathered(quadratic: Concentrated, gather: FloatArray) -> Concentrated:
    """Return a quadratic in all moduli as one in those of merged regions, from which `gather` (2 before, 2 after) makes all."""
    return replace(
        quadratic,
        hessian=gather.T @ quadratic.hessian @ gather,
        gradient=gather.T @ quadratic.gradient,
        response=[x @ gather for x in quadratic.response],
    )


def point_at(model: FieldModel, theta: FloatArray, near: Point) -> Point:
    """Return the point at moduli, with the motion of the surface of a point before, or one that suits these moduli better.

    Where the noise of the measurement is a large part of the strain in a cell, the surface that was found with a cell of one modulus may
    turn it inside out with another.
    """
    try:
        return model.evaluate(theta, near.states)
    except ConvergenceError:
        return first_point(model, theta)


def _scaled(quadratic: Concentrated, scale: float) -> Concentrated:
    return replace(quadratic, hessian=quadratic.hessian / scale, gradient=quadratic.gradient / scale)


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Where a fit of regions begins: moduli (2 regions,), a point with the motion of the surface, and what derivatives are known.

    Those are of no use where they are from `far` away.
    """

    theta: FloatArray
    near: Point
    quadratic: Concentrated | None = None
    far: bool = False


def _refitted(
    model: FieldModel, criterion: Criterion, labels: IntArray, start: _Start, bounds: Bounds, progress: Progress | None
) -> tuple[IntArray, Found]:
    """Fit the moduli of regions to the measurements and the prior of contrasts; regions that have no zone any more are left out."""
    kept, labels = np.unique(labels, return_inverse=True)
    regions = model.with_zones(joined(model.zones, labels))
    objective = Objective(criterion.prior(labels), criterion.scale, bounds)
    theta = objective.clipped(start.theta.reshape(2, -1)[:, kept].ravel())
    known = start.quadratic is not None and len(start.quadratic.hessian) == len(theta)
    rule = KeptHessian(theta, start.quadratic) if known and not start.far else KeptHessian()
    response = start.quadratic.response if known and start.quadratic is not None else None
    found = search(regions, point_at(regions, theta, start.near), objective, ROUGHLY, rule=rule, near=response, progress=progress)
    return labels.astype(np.int64), found


def _with_better_borders(
    model: FieldModel, criterion: Criterion, labels: IntArray, point: Point, bounds: Bounds, progress: Progress | None
) -> tuple[IntArray, Point, int]:
    """Let zones change sides, in larger maps those at borders, if the fit confirms it; returns regions, fit, and how many did."""
    graph = criterion.graph
    movable = np.arange(graph.count)
    if graph.count > EXPLICIT:
        movable = np.unique(graph.pairs[labels[graph.pairs[:, 0]] != labels[graph.pairs[:, 1]]])
    if len(movable) > EXPLICIT:
        return labels, point, 0
    largest = criterion.prior(labels).largest
    for part in CONTRASTS:
        theta = moderated(point.theta, largest, part)
        everywhere = point_at(model, theta.reshape(2, -1)[:, labels].ravel(), point)
        slopes = np.asarray(np.kron(np.eye(2), np.eye(graph.count)[:, movable]), dtype=float)
        quadratic = _scaled(model.linearised(everywhere).concentrated(slopes, ROUGH_TOLERANCE), criterion.scale)
        found, moves = border_moves(graph, labels, theta, quadratic, criterion.weight, movable)
        if not moves:
            continue
        new, refitted = _refitted(model, criterion, found, _Start(theta, point), bounds, progress)
        if criterion.value(new, refitted.point) < criterion.value(labels, point):  # the approximation says nothing far away
            return new, refitted.point, moves
    return labels, point, 0
