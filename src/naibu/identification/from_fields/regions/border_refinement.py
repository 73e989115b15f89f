"""Borders of regions that run through cells, fitted together with the moduli: what the data say of the size of an inclusion, and what not.

A smaller stiffer inclusion and a larger softer one displace their surroundings nearly alike, so that moduli of regions made of whole cells
depend on which cells these are, by more than their standard errors. Moduli and moves of borders are found together, and the covariance of
the moduli holds what is not known of the borders.

Cells are a poor start where a region is only a few of them wide. Borders of compact regions therefore start as spheres as well, and the
better end counts. Few cells across make a stiff lump too stiff and too small; the fit is therefore corrected for what cells of half the
size change (defect correction, :cite:p:`stetter1978`); what half of their size would change once more is part of the doubt.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.forward.load_cases import KNOWN, Zones
from naibu.identification.from_fields.forward.loaded_components import ROUGH_TOLERANCE
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Point
from naibu.identification.from_fields.inversion.gauss_newton import Bounds, Objective, search
from naibu.identification.from_fields.inversion.regularization import ZoneGraph, cell_volumes
from naibu.identification.from_fields.mesh_error import DOUBT, DOUBT_OF_RATIO, KeptStates, changes_on_finer_mesh, refitted
from naibu.identification.from_fields.regions.borders import Borders, Mixing
from naibu.identification.from_fields.regions.compressibility import no_less_compressible
from naibu.identification.from_fields.regions.contrast_prior import BorderPrior, moderated
from naibu.identification.from_fields.regions.segmentation import Segmentation, areas_between, joined

MOST_REGIONS, CANDIDATES = 6, 3  # whose borders are refined; pairs that are tried as one
LONGEST = 0.5  # of a step: of logarithms, and of borders in cells
ITERATIONS, HALVINGS, ENOUGH = 12, 5, 0.02  # Gauss-Newton steps; halvings of one; fall of half of chi squared that is worth no further step
CORRECTIONS = 5  # of the defect
RELAXED = 0.7  # part of a correction that is taken: whole ones go too far by 40 %, as derivatives are those of larger cells
CORRECTED, WITHIN = 0.03, 0.25  # correction of a logarithm, as such and in standard deviations, that is worth no further one


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
    apart : ndarray, shape (2 regions, 2 regions)
        Mean square by which moduli of the pieces of a region, each by itself, differed from those that they share, besides.
    objective : float
        Half of chi squared and priors.
    parts : ndarray, shape (m, regions)
        Part of every cell in each region, without parts where moduli are known: logarithms of moduli are mixed by them.
    mixing : Mixing
        The moduli of all zones from those of the regions.
    """

    zones: Zones
    borders: Borders
    theta: FloatArray
    point: Point
    covariance: FloatArray
    at_these_borders: FloatArray
    apart: FloatArray
    objective: float
    parts: FloatArray
    mixing: Mixing

    def moduli_on(self, mesh: Mesh, zones: Zones) -> tuple[FloatArray, FloatArray]:
        """Return lambda and mu (m,), kPa, of the cells of another mesh of the body; `zones` tell which of them are known."""
        unknown = np.flatnonzero(zones.of_cell != KNOWN)
        edge = float(np.median(cell_volumes(mesh)) ** (1.0 / 3.0))
        share = Mixing.at(self.borders, mesh, unknown, edge).shares(self.borders.moves.ravel())
        shear, ratio = np.exp(share @ self.theta.reshape(2, -1).T).T
        lame, out = zones.known_lambda.copy(), zones.known_mu.copy()
        lame[unknown], out[unknown] = shear * (ratio - 2.0 / 3.0), shear
        return lame, out


def refined_regions(model: FieldModel, regions: Segmentation, graph: ZoneGraph, bounds: Bounds) -> RefinedRegions:
    """Fit the borders of regions, and join regions that only stood for cells on borders, or are of one material.

    Moduli of whole cells depend on how many of these a lump happened to get, so that two lumps of one material look different; only with
    free borders do the data tell. Regions are joined as one piece, which spares two moduli and a location, or as pieces with a border each
    that share their moduli, which spares the moduli: whichever lowers the criterion of the segmentation more. What the criterion does not
    tell apart may still differ by several standard deviations of precise data: `RefinedRegions.apart` holds by how much.

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
    of_moduli, of_location = float(np.log(model.n_free)), float(np.log(graph.count))
    labels = pieces = regions.of_zone
    within = no_less_compressible(model, regions.point.theta, bounds)
    best = refined_borders(model, regions.zones, regions.point, within)
    while best.zones.count > 2:
        trials: list[tuple[float, IntArray, IntArray, RefinedRegions]] = []
        for a, b, one in _of_one_material(model, best, within):
            as_one = np.where(labels == b, a, labels)
            trials.append((one.objective - of_moduli, as_one - (as_one > b), pieces, one))
        for new, of_pieces, one in _within_one_border(model, graph, regions.point, (labels, pieces), best, within):
            trials.append((one.objective - of_moduli - of_location, new, of_pieces, one))
        if not trials:
            break
        chosen = min(trials, key=lambda t: t[0])
        if chosen[0] > best.objective:
            break
        _, labels, pieces, best = chosen
    return best if within == bounds else _released(model, best, bounds)


def _released(model: FieldModel, found: RefinedRegions, bounds: Bounds) -> RefinedRegions:
    """Return the fit of regions and borders within other bounds: errors are those about a best fit."""
    start = _Trial(found.theta, found.borders.moves.ravel(), found.point, found.objective)
    return replace(_with_covariance(model, found.mixing, _descended(model, found.mixing, start, bounds)), apart=found.apart)


def _of_one_material(model: FieldModel, found: RefinedRegions, bounds: Bounds) -> list[tuple[int, int, RefinedRegions]]:
    """Return the two regions, apart from the largest, whose moduli differ least for their joint covariance, as one of several pieces.

    Their borders stay what they are: whether two lumps are of one material is asked of their moduli, not of their shapes. An empty list
    where there are no two, or no equilibrium with the same moduli in both.
    """
    k = found.zones.count
    precision = np.linalg.inv(found.covariance)
    ends = []
    for a, b in combinations(range(1, k), 2):
        gather = _gathered(np.where(np.arange(k) == b, a, np.arange(k)) - (np.arange(k) > b))
        theta = np.asarray(np.linalg.solve(gather.T @ precision @ gather, gather.T @ precision @ found.theta), dtype=float)
        away = found.theta - gather @ theta
        ends.append((float(away @ precision @ away), a, b, theta, gather))
    if not ends:
        return []
    _, a, b, theta, gather = min(ends, key=lambda e: e[0])
    region = gather[:k, : k - 1].argmax(axis=1)
    borders = replace(found.mixing.borders, region_of_piece=region[found.mixing.borders.region_of_piece])
    mixing = replace(found.mixing, borders=borders)
    try:
        start = _Trial.at(model, mixing, Objective(bounds=bounds).clipped(theta), found.borders.moves.ravel(), found.point.states)
        one = _with_covariance(model, mixing, _descended(model, mixing, start, bounds))
    except ConvergenceError:
        return []
    away = found.theta - gather @ one.theta
    pieces = [away * np.tile(np.arange(k) == piece, 2) for piece in (a, b)]
    apart = np.mean([np.outer(gather.T @ piece, gather.T @ piece) for piece in pieces], axis=0)
    return [(a, b, replace(one, apart=gather.T @ found.apart @ gather + apart))]


def _gathered(region: IntArray) -> FloatArray:
    """Return the matrix (2 before, 2 after) that gives both moduli of every region before from those of the `region` that it became."""
    return np.asarray(np.kron(np.eye(2), np.eye(int(region.max()) + 1)[region]))


def _within_one_border(
    model: FieldModel, graph: ZoneGraph, near: Point, parting: tuple[IntArray, IntArray], found: RefinedRegions, bounds: Bounds
) -> Iterator[tuple[IntArray, IntArray, RefinedRegions]]:
    """Give regions that touch and whose shear moduli are most alike as one piece: labels and pieces of all zones, and the fit."""
    labels, pieces = parting
    touching = np.argwhere(np.triu(areas_between(graph, labels), 1) > 0.0)
    jumps = np.abs(found.theta[touching[:, 0]] - found.theta[touching[:, 1]])
    for a, b in touching[np.argsort(jumps)[:CANDIDATES]]:
        new = np.unique(np.where(labels == b, a, labels), return_inverse=True)[1].ravel()
        order = np.argsort(-np.bincount(new, graph.volume), kind="stable")
        new = np.argsort(order)[new].astype(np.int64)
        mean = np.bincount(new, graph.volume * found.theta[labels]) / np.bincount(new, graph.volume)
        ratio = np.bincount(new, graph.volume * found.theta[found.zones.count :][labels]) / np.bincount(new, graph.volume)
        both = (labels == a) | (labels == b)
        of_pieces = np.where(new == 0, -1, np.where(both, pieces[both].min(), pieces))
        of_pieces = np.unique(of_pieces, return_inverse=True)[1].ravel().astype(np.int64)
        start = replace(near, theta=np.concatenate([mean, ratio]))
        with contextlib.suppress(ConvergenceError):  # regions that are too different to be one; others may be joined
            one = refined_borders(model, joined(model.zones, new), start, bounds, joined(model.zones, of_pieces))
            became = np.zeros(found.zones.count, dtype=np.int64)
            became[labels] = new
            gather = _gathered(became)
            yield new, of_pieces, replace(one, apart=gather.T @ found.apart @ gather)


def refined_borders(model: FieldModel, zones: Zones, start: Point, bounds: Bounds, pieces: Zones | None = None) -> RefinedRegions:
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
    pieces : Zones, optional
        Pieces of the regions, numbered as in `Borders`; by default every region is one.

    Raises
    ------
    ConvergenceError
        The data do not determine moduli and borders together.
    """
    cells = Borders.of(model.mesh, zones, pieces)
    start = replace(start, theta=moderated(start.theta, 0))
    starts = [cells] + [ball for ball in [cells.rounded()] if ball.round.any()]
    ends: list[tuple[Mixing, _Trial]] = []
    for last, borders in enumerate(starts, 1 - len(starts)):
        try:
            ends.append(_searched(model, Mixing.of(model, borders), start, bounds))
        except ConvergenceError:  # of one start; the other may lead somewhere
            if last == 0 and not ends:
                raise
    return _with_covariance(model, *min(ends, key=lambda e: e[1].value))


def _searched(model: FieldModel, mixing: Mixing, start: Point, bounds: Bounds) -> tuple[Mixing, _Trial]:
    """Return where Gauss-Newton steps lead from borders that keep the volume."""
    return mixing, _descended(model, mixing, _Trial.at(model, mixing, start.theta, mixing.borders.moves.ravel(), start.states), bounds)


def _descended(model: FieldModel, mixing: Mixing, here: _Trial, bounds: Bounds) -> _Trial:
    for _ in range(ITERATIONS):
        better = _stepped(model, mixing, here, bounds)
        if better is None:
            break
        gain, here = here.value - better.value, better
        if gain < ENOUGH:
            break
    return here


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedRegions:
    """Regions as cells of half the size would fit them.

    Attributes
    ----------
    refined : RefinedRegions
        Moduli and borders.
    residuals : tuple of ndarray, shape (q,)
        Whitened residuals of every load case on the small cells.
    shift : ndarray, shape (2 regions,)
        By how much the small cells changed the logarithms of the moduli.
    converged : bool
        Whether the last correction changed them by next to nothing.
    of_law : bool
        Whether the small cells had the law of the identification each time, rather than small strain.
    undone : ndarray, shape (2 regions,)
        A last change of the logarithms that was taken back, as with it small cells left larger residuals.
    """

    refined: RefinedRegions
    residuals: tuple[FloatArray, ...]
    shift: FloatArray
    converged: bool
    of_law: bool
    undone: FloatArray

    @property
    def doubt(self) -> FloatArray:
        """Covariance (2 regions, 2 regions) of what still smaller cells would change.

        Regions share their borders: none is surer than the one that changed most. The ratio of bulk to shear modulus feels flat faces of a
        curved body as it does without a correction. What small strain changed is doubted whole, and so is a change that was taken back.
        """
        parts = (DOUBT, DOUBT_OF_RATIO) if self.of_law else (1.0, 1.0)
        taken, undone = (float(np.abs(change).max(initial=0.0)) for change in (self.shift, self.undone))
        return np.diag((np.repeat(parts, len(self.shift) // 2) * taken) ** 2 + undone**2)


def on_finer_cells(model: FieldModel, law: LawName, found: RefinedRegions, bounds: Bounds) -> CorrectedRegions | None:
    """Fit moduli and borders so that the residuals on cells of half the size are least, with derivatives of the given cells.

    None where there is no finer mesh, see `naibu.identification.from_fields.mesh_error.changes_on_finer_mesh`.

    Raises
    ------
    ConvergenceError
        There is no equilibrium on the way.
    """
    mixing, n, edge = found.mixing, len(found.theta), found.mixing.borders.edge_mm
    here, now, objective = _Trial(found.theta, found.borders.moves.ravel(), found.point, found.objective), found, Objective(bounds=bounds)
    prior = _prior(mixing)
    residuals, of_before = tuple[FloatArray, ...](), tuple[FloatArray, ...]()
    converged, before, least, of_law = False, here, np.inf, True
    undone, kept = np.zeros(n), KeptStates()
    for _ in range(CORRECTIONS):
        at = model.linearised(model.evaluate(here.point.theta, here.point.states))
        finer = changes_on_finer_mesh(at, law if of_law else "linear", now.moduli_on, kept)  # no equilibrium once, none later
        if finer is None:
            return None
        changes, of_law = finer[0], finer[1] == law
        there = tuple(o.residual(u) + c for o, u, c in zip(model.observed, at.point.states, changes, strict=True))
        left = sum(float(r @ r) for r in there)
        if left > least:  # surfaces that follow precise data move differently among smaller cells: no more can be said
            undone, here, residuals = here.theta - before.theta, before, of_before  # not those that the step promised
            break
        before, least, of_before = here, left, there
        slopes = mixing.moduli(here.theta, here.moves)[1]
        quadratic = at.concentrated(slopes, ROUGH_TOLERANCE)
        hessian = quadratic.hessian + prior.hessian(here.theta)
        pull = prior.gradient(here.theta, here.moves)
        fit = refitted(at, replace(quadratic, hessian=hessian), changes, slopes, pull)
        scale = min(RELAXED, LONGEST / max(np.abs(fit.theta[:n]).max(), np.abs(fit.theta[n:]).max() / edge, 1e-300))
        theta, moves = objective.clipped(here.theta + scale * fit.theta[:n]), here.moves + scale * fit.theta[n:]
        guesses = [u + scale * du for u, du in zip(here.point.states, fit.moved, strict=True)]
        here, residuals = _Trial.at(model, mixing, theta, moves, guesses), fit.residuals
        now = replace(found, theta=theta, borders=found.borders.with_moves(moves))
        sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(hessian))[:n]))
        converged = bool((np.abs(fit.theta[:n]) < np.maximum(CORRECTED, WITHIN * sd)).all())
        if converged:
            break
    return CorrectedRegions(_with_covariance(model, mixing, here), residuals, here.theta - found.theta, converged, of_law, undone)


def without_errors_of_cells(
    model: FieldModel, regions: Segmentation, graph: ZoneGraph, corrected: CorrectedRegions, bounds: Bounds
) -> Segmentation | None:
    """Return regions, with a piece each, without those for which cells of half the size leave no reason; None where all have one.

    Cells of a map err most where displacements change fastest, as at the edges of plates, and a region of other moduli may stand for that.
    On cells of half the size its moduli are those of the largest region, but for what it costs to be one.
    """
    found, k = corrected.refined, corrected.refined.zones.count
    charge, kept = float(np.log(model.n_free) + np.log(graph.count)), np.ones(k, dtype=bool)
    for region in range(1, k):
        jump = np.kron(np.eye(2), np.eye(k)[region] - np.eye(k)[0])
        away = jump @ found.theta
        kept[region] = 0.5 * away @ np.linalg.solve(jump @ found.at_these_borders @ jump.T, away) > charge
    if kept.all():
        return None
    unknown, piece = model.zones.of_cell != KNOWN, found.borders.piece_of_cell
    of_zone = np.empty(graph.count, dtype=np.int64)
    of_zone[model.zones.of_cell[unknown]] = np.where(kept[found.borders.region_of_piece[piece]], piece, 0)[unknown]
    of_zone = np.unique(of_zone, return_inverse=True)[1].ravel().astype(np.int64)
    zones, volume = joined(model.zones, of_zone), np.bincount(of_zone, graph.volume)
    theta = np.concatenate([np.bincount(of_zone, graph.volume * t) / volume for t in found.point.theta.reshape(2, -1)])
    fewer = model.with_zones(zones)
    return replace(
        regions,
        of_zone=of_zone,
        zones=zones,
        point=search(fewer, fewer.evaluate(theta, found.point.states), Objective(bounds=bounds)).point,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """Moduli (2 regions,), moves of borders (10 (regions - 1),) and states that go with them, and the objective there.

    The `response` is how loaded components follow them at a point near by, as in `Concentrated`, where that is known.
    """

    theta: FloatArray
    moves: FloatArray
    point: Point
    value: float
    response: list[FloatArray] | None = None

    @classmethod
    def at(cls, model: FieldModel, mixing: Mixing, theta: FloatArray, moves: FloatArray, states: Sequence[FloatArray]) -> _Trial:
        point = model.evaluate(mixing.moduli(theta, moves)[0], list(states))
        return cls(theta, moves, point, 0.5 * (point.misfit + point.prior) + _prior(mixing).value(theta, moves))


def _prior(mixing: Mixing) -> BorderPrior:
    return BorderPrior(mixing.borders.moves.ravel(), mixing.borders.edge_mm)


def _stepped(model: FieldModel, mixing: Mixing, here: _Trial, bounds: Bounds) -> _Trial | None:
    """Return where a Gauss-Newton step leads, halved until the objective falls; None where it never does."""
    n, edge, objective, prior = len(here.theta), mixing.borders.edge_mm, Objective(bounds=bounds), _prior(mixing)
    slopes = mixing.moduli(here.theta, here.moves)[1]
    at = model.linearised(model.evaluate(here.point.theta, here.point.states))
    quadratic = at.concentrated(slopes, ROUGH_TOLERANCE, here.response)
    hessian, gradient = quadratic.hessian + prior.hessian(here.theta), quadratic.gradient + prior.gradient(here.theta, here.moves)
    free = np.concatenate([objective.free(here.theta, gradient[:n]), np.ones(len(gradient) - n, dtype=bool)])
    step = np.zeros_like(gradient)
    step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
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
            return replace(trial, response=quadratic.response)
    return None


def _with_covariance(model: FieldModel, mixing: Mixing, found: _Trial) -> RefinedRegions:
    """Return what was found as regions, with the covariance of the moduli."""
    theta, moves, n = found.theta, found.moves, len(found.theta)
    point = model.evaluate(found.point.theta, found.point.states)
    slopes = mixing.moduli(theta, moves)[1]
    hessian = model.linearised(point).concentrated(slopes, ROUGH_TOLERANCE, found.response).hessian + _prior(mixing).hessian(theta)
    try:
        whole, part = (np.asarray(np.linalg.inv(h)[:n, :n], dtype=float) for h in (hessian, hessian[:n, :n]))
    except np.linalg.LinAlgError as error:
        raise ConvergenceError("the data do not determine the moduli of regions and their borders together") from error
    borders, of_cell = mixing.borders.with_moves(moves), model.zones.of_cell.copy()
    unknown = of_cell != KNOWN
    share = mixing.shares(moves)
    of_zone = np.where(share[:, 0] < 0.5, share[:, 1:].argmax(axis=1) + 1, 0)
    for region in range(1, share.shape[1]):  # what is smaller than half a cell keeps the cell in which most of it lies
        if not (of_zone == region).any():
            of_zone[share[:, region].argmax()] = region
    of_cell[unknown] = of_zone[of_cell[unknown]]
    zones = replace(joined(model.zones, of_zone), of_cell=of_cell)
    parts = np.zeros((len(of_cell), share.shape[1]))
    parts[unknown] = share[model.zones.of_cell[unknown]]
    return RefinedRegions(zones, borders, theta, point, whole, part, np.zeros_like(whole), found.value, parts, mixing)
