"""Borders of regions that run through cells, fitted together with the moduli: what the data say of the size of an inclusion, and what not.

A smaller stiffer inclusion and a larger softer one displace their surroundings nearly alike, so that moduli of regions made of whole cells
depend on which cells these are, by more than their standard errors. The border of every region but the largest is therefore moved along its
normal by polynomials of degree two in the direction from its middle, a low-order level set :cite:p:`osher1988`; cells on borders are mixed
in logarithms of moduli. Moduli and moves are found together, and the covariance of the moduli holds what is not known of the borders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Point
from naibu.identification.from_fields.gauss_newton import Bounds, Objective
from naibu.identification.from_fields.regularization import ZoneGraph, cell_volumes
from naibu.identification.from_fields.segmentation import Segmentation, areas_between, joined

MOST_REGIONS, CANDIDATES = 6, 3  # whose borders are refined; pairs that are tried as one
WINDOW = 0.8  # standard deviation, in cells, of the window in which cells are smoothed
REACH, NEIGHBOURS = 3.0, 64  # of that window, in standard deviations, and cells in it at most
INWARDS = 0.42  # way from a corner to the middle of a cell at which borders are evaluated, about that of Gauss points
SHARPNESS = 0.25  # standard deviation, in cells, over which a border is spread when cells are mixed
LONGEST = 0.5  # of a step: of logarithms, and of borders in cells
BISECTIONS = 30  # for the move of a border that keeps the volume
ITERATIONS, HALVINGS, ENOUGH = 12, 5, 0.02  # Gauss-Newton steps; halvings of one; fall of half of chi squared that is worth no further step


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Regions with borders that run through cells.

    Attributes
    ----------
    middles : ndarray, shape (m, 3)
        Middles of the cells, mm.
    volumes : ndarray, shape (m,)
        Their volumes, mm^3.
    region_of_cell : ndarray, shape (m,), int64
        Region of every cell, -1 where the moduli are known; 0 is the largest.
    moves : ndarray, shape (regions - 1, 10)
        How far the borders of the other regions move outwards, mm: coefficients of 1, x, y, z, xx, xy, xz, yy, yz, zz of the direction from
        the middle of the region.
    edge_mm : float
        Edge length of the cells.
    """

    middles: FloatArray
    volumes: FloatArray
    region_of_cell: IntArray
    moves: FloatArray
    edge_mm: float
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.middles))

    @classmethod
    def of(cls, mesh: Mesh, zones: Zones) -> Borders:
        """Return the borders of regions made of whole cells."""
        volumes = cell_volumes(mesh)
        edge = float(np.median(volumes) ** (1.0 / 3.0))
        return cls(mesh.points[mesh.cells].mean(axis=1), volumes, zones.of_cell, np.zeros((zones.count - 1, 10)), edge)

    def distances(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how deep points (n, 3) lie in each region but the largest (n, regions - 1), mm, and derivatives with respect to moves."""
        wide = WINDOW * self.edge_mm
        distance, near = self._tree.query(points, k=min(NEIGHBOURS, len(self.middles)), distance_upper_bound=REACH * wide)
        there = np.isfinite(distance)
        near = np.where(there, near, 0)
        weight = np.where(there, self.volumes[near] * np.exp(-0.5 * (np.where(there, distance, 0.0) / wide) ** 2), 0.0)
        total = np.maximum(weight.sum(axis=1), 1e-300)
        deep, modes = [], []
        for region, moves in enumerate(self.moves, start=1):
            own = self.region_of_cell == region
            part = np.where(own[near], weight, 0.0).sum(axis=1) / total
            # the mean of a half-space in a Gaussian window is the normal distribution of the distance from its border
            plain = wide * np.clip(ndtri(np.clip(part, 1e-9, 1.0 - 1e-9)), -REACH, REACH)
            mode = _modes(points - np.average(self.middles[own], weights=self.volumes[own], axis=0))
            deep.append(plain + mode @ moves)
            modes.append(mode)
        return np.stack(deep, axis=1), np.stack(modes, axis=1)

    def with_moves(self, moves: FloatArray) -> Borders:
        """Return the borders where moves (regions - 1, 10) put them."""
        return replace(self, moves=moves.reshape(self.moves.shape))

    def region_at(self, points: ArrayLike, otherwise: ArrayLike) -> IntArray:
        """Return the region of points (n, 3), mm, in cells of the regions `otherwise` (n,); known ones, -1, stay known."""
        given = np.asarray(otherwise, dtype=np.int64)
        deep, _ = self.distances(np.asarray(points, dtype=float))
        best = deep.argmax(axis=1)
        return np.where(given == KNOWN, KNOWN, np.where(deep[np.arange(len(deep)), best] > 0.0, best + 1, 0))


def _modes(away: FloatArray) -> FloatArray:
    """Return 1, x, y, z, xx, xy, xz, yy, yz, zz of directions (n, 3) as columns (n, 10); the diagonal squares less their mean."""
    x, y, z = (away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)).T
    third = 1.0 / 3.0
    return np.stack([np.ones_like(x), x, y, z, x * x - third, x * y, x * z, y * y - third, y * z, z * z - third], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedRegions:
    """Regions with fitted borders.

    Attributes
    ----------
    zones : Zones
        Regions of whole cells, those whose larger part lies within the borders.
    borders : Borders
        Where they are.
    theta : ndarray, shape (2 regions,)
        Logarithms of the moduli.
    point : Point
        The fit, cell by cell.
    covariance, at_these_borders : ndarray, shape (2 regions, 2 regions)
        Of theta, for independent noise: with the borders unknown, and as if they were known.
    objective : float
        Half of chi squared and priors.
    parts : ndarray, shape (m, regions)
        Part of every cell in each region, without parts where moduli are known: logarithms of moduli are mixed by them.
    """

    zones: Zones
    borders: Borders
    theta: FloatArray
    point: Point
    covariance: FloatArray
    at_these_borders: FloatArray
    objective: float
    parts: FloatArray


def refined_regions(model: FieldModel, regions: Segmentation, graph: ZoneGraph, bounds: Bounds) -> RefinedRegions:
    """Fit the borders of regions, and join regions that only stood for cells on borders.

    Parameters
    ----------
    model : FieldModel
        Load cases, and zones of one cell each.
    regions : Segmentation
        Regions of whole cells.
    graph : ZoneGraph
        Of the zones.
    bounds : Bounds
        Of the moduli.

    Raises
    ------
    ConvergenceError
        The data do not determine moduli and borders together.
    """
    charge = float(np.log(model.n_free) + np.log(graph.count))
    labels, best = regions.of_zone, refined_borders(model, regions.zones, regions.point, bounds)
    while best.zones.count > 2:
        trials = []
        touching = np.argwhere(np.triu(areas_between(graph, labels), 1) > 0.0)
        jumps = np.abs(best.theta[touching[:, 0]] - best.theta[touching[:, 1]])
        for a, b in touching[np.argsort(jumps)[:CANDIDATES]]:
            new = np.unique(np.where(labels == b, a, labels), return_inverse=True)[1].ravel()
            order = np.argsort(-np.bincount(new, graph.volume), kind="stable")
            new = np.argsort(order)[new].astype(np.int64)
            mean = np.bincount(new, graph.volume * best.theta[labels]) / np.bincount(new, graph.volume)
            ratio = np.bincount(new, graph.volume * best.theta[best.zones.count :][labels]) / np.bincount(new, graph.volume)
            zones = joined(model.zones, new)
            start = replace(regions.point, theta=np.concatenate([mean, ratio]))
            trials.append((new, refined_borders(model, zones, start, bounds)))
        new, trial = min(trials, key=lambda t: t[1].objective)
        if trial.objective > best.objective + charge:
            break
        labels, best = new, trial
    return best


def refined_borders(model: FieldModel, zones: Zones, start: Point, bounds: Bounds) -> RefinedRegions:
    """Fit the borders of regions and their moduli.

    Parameters
    ----------
    model : FieldModel
        Load cases, and the zones that were made into regions.
    zones : Zones
        The regions.
    start : Point
        The fit of regions of whole cells.
    bounds : Bounds
        Of the moduli.

    Raises
    ------
    ConvergenceError
        The data do not determine moduli and borders together.
    """
    mixing = _Mixing.of(model, zones)
    first = mixing.borders.moves.ravel()
    here = _Trial.at(model, mixing, start.theta, first, start.states)
    for _ in range(ITERATIONS):
        better = _stepped(model, mixing, here, bounds)
        if better is None:
            break
        gain, here = here.value - better.value, better
        if gain < ENOUGH:
            break
    return _with_covariance(model, mixing, here)


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """Moduli (2 regions,), moves of borders (10 (regions - 1),) and states that go with them, and the objective there."""

    theta: FloatArray
    moves: FloatArray
    point: Point
    value: float

    @classmethod
    def at(cls, model: FieldModel, mixing: _Mixing, theta: FloatArray, moves: FloatArray, states: Sequence[FloatArray]) -> _Trial:
        point = model.evaluate(mixing.moduli(theta, moves)[0], list(states))
        away = (moves - mixing.borders.moves.ravel()) / mixing.borders.edge_mm
        return cls(theta, moves, point, 0.5 * (point.misfit + point.prior + float(away @ away)))


def _stepped(model: FieldModel, mixing: _Mixing, here: _Trial, bounds: Bounds) -> _Trial | None:
    """Return where a Gauss-Newton step leads, halved until the objective falls; None where it never does."""
    n, edge, objective = len(here.theta), mixing.borders.edge_mm, Objective(bounds=bounds)
    slopes = mixing.moduli(here.theta, here.moves)[1]
    at = model.linearised(model.evaluate(here.point.theta, here.point.states))
    quadratic = at.concentrated(slopes)
    hessian, gradient = quadratic.hessian.copy(), quadratic.gradient.copy()
    hessian[n:, n:] += np.eye(len(here.moves)) / edge**2
    gradient[n:] += (here.moves - mixing.borders.moves.ravel()) / edge**2
    step = -np.asarray(np.linalg.solve(hessian, gradient), dtype=float)
    step *= min(1.0, LONGEST / max(np.abs(step[:n]).max(), np.abs(step[n:]).max() / edge, 1e-300))
    moved = at.forward((slopes @ step)[:, None], [b[:, None] for b in quadratic.loaded(step)])
    for halvings in range(HALVINGS):
        fraction = 0.5**halvings
        guesses = [u + fraction * du.reshape(u.shape) for u, du in zip(here.point.states, moved, strict=True)]
        try:
            trial = _Trial.at(model, mixing, objective.clipped(here.theta + fraction * step[:n]), here.moves + fraction * step[n:], guesses)
        except ConvergenceError:
            continue
        if trial.value < here.value:
            return trial
    return None


def _with_covariance(model: FieldModel, mixing: _Mixing, found: _Trial) -> RefinedRegions:
    """Return what was found as regions, with the covariance of the moduli."""
    theta, moves, n = found.theta, found.moves, len(found.theta)
    point = model.evaluate(found.point.theta, found.point.states)
    hessian = model.linearised(point).concentrated(mixing.moduli(theta, moves)[1]).hessian.copy()
    hessian[n:, n:] += np.eye(len(moves)) / mixing.borders.edge_mm**2
    try:
        whole, part = (np.asarray(np.linalg.inv(h)[:n, :n], dtype=float) for h in (hessian, hessian[:n, :n]))
    except np.linalg.LinAlgError as error:
        raise ConvergenceError("the data do not determine the moduli of regions and their borders together") from error
    borders, of_cell = mixing.borders.with_moves(moves), model.zones.of_cell.copy()
    unknown = of_cell != KNOWN
    share = mixing.fractions(moves)[0]
    of_zone = np.where(share.sum(axis=1) > 0.5, share.argmax(axis=1) + 1, 0)
    for region in range(1, share.shape[1] + 1):  # what is smaller than half a cell keeps the cell in which most of it lies
        if not (of_zone == region).any():
            of_zone[share[:, region - 1].argmax()] = region
    of_cell[unknown] = of_zone[of_cell[unknown]]
    zones = replace(joined(model.zones, of_zone), of_cell=of_cell)
    parts = np.zeros((len(of_cell), share.shape[1] + 1))
    parts[unknown] = np.column_stack([1.0 - share.sum(axis=1), share])[model.zones.of_cell[unknown]]
    return RefinedRegions(zones, borders, theta, point, whole, part, found.value, parts)


@dataclass(frozen=True, slots=True, eq=False)
class _Mixing:
    """Moduli of zones from those of regions with moved borders."""

    borders: Borders
    deep: FloatArray  # (zones, points, regions - 1), without moves
    modes: FloatArray  # (zones, points, regions - 1, 10)

    @classmethod
    def of(cls, model: FieldModel, zones: Zones) -> _Mixing:
        """Return it for every zone of the model, each a single cell."""
        mesh, borders = model.mesh, Borders.of(model.mesh, zones)
        cells = np.flatnonzero(model.zones.of_cell != KNOWN)
        cells = cells[np.argsort(model.zones.of_cell[cells], kind="stable")]
        corners = mesh.points[mesh.cells[cells]]
        points = corners + INWARDS * (corners.mean(axis=1, keepdims=True) - corners)
        deep, modes = borders.distances(points.reshape(-1, 3))
        shape = points.shape[:2]
        made = cls(borders, deep.reshape(*shape, -1), modes.reshape(*shape, *modes.shape[1:]))
        volume = borders.volumes[cells]
        whole = np.array([volume[zones.of_cell[cells] == region].sum() for region in range(1, zones.count)])
        low, high = (np.full(len(whole), sign * REACH * borders.edge_mm) for sign in (-1.0, 1.0))
        for _ in range(BISECTIONS):
            moves = np.zeros_like(borders.moves)
            moves[:, 0] = 0.5 * (low + high)
            less = volume @ made.fractions(moves.ravel())[0] < whole
            low, high = np.where(less, moves[:, 0], low), np.where(less, high, moves[:, 0])
        return replace(made, borders=borders.with_moves(moves))

    def moduli(self, theta: FloatArray, moves: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta of the zones (2 zones,) and its derivatives (2 zones, 2 regions + moves)."""
        part, slope = self.fractions(moves)
        fractions = np.column_stack([1.0 - part.sum(axis=1), part])
        values = theta.reshape(2, -1)
        jumps = values[:, 1:] - values[:, :1]
        of_moves = np.concatenate([(slope * jump[:, None]).reshape(len(slope), -1) for jump in jumps])
        return (fractions @ values.T).T.ravel(), np.column_stack([np.kron(np.eye(2), fractions), of_moves])

    def fractions(self, moves: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the part of every zone in each region but the largest (zones, regions - 1), and its derivatives (..., 10)."""
        wide = SHARPNESS * self.borders.edge_mm
        deep = self.deep + np.einsum("zpra,ra->zpr", self.modes, moves.reshape(self.borders.moves.shape))
        share = ndtr(deep / wide)
        density = np.exp(-0.5 * (deep / wide) ** 2) / (wide * np.sqrt(2.0 * np.pi))
        crowd = np.maximum(share.sum(axis=2, keepdims=True), 1.0)  # regions never fill more than the whole
        part = (share / crowd).mean(axis=1)
        return part, np.einsum("zpr,zpra->zra", density / crowd, self.modes) / deep.shape[1]
