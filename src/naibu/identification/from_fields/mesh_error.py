"""Discretisation error of identified moduli: the same load cases on a mesh of half the element size, and extrapolation from the two.

The state on the finer mesh, under the same moduli and the same displacement of the loaded nodes, changes the residuals; the moduli that fit
best then change by a Gauss-Newton step. Elements near incompressibility are too compressible by an amount of mu / kappa that hardly depends
on its value; so it is mu / kappa that is extrapolated, not its logarithm, which would never reach 0. Corners, edges and interfaces make
solutions singular, so that the order of convergence lies between 1 and 2 whatever the elements; on bodies like those of the benchmark it is
about 1.8. What extrapolation adds is doubted accordingly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import FieldLaw, LawName, computed_mesh, field_law
from naibu.identification.from_fields.forward.forward_model import Observed, Solvers, equilibrium, settled
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.loaded_components import ROUGH_TOLERANCE
from naibu.identification.from_fields.forward.refinement import Refinement
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Linearised, Point, moduli_of
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.surface import CELL_FACES

EXTRAPOLATED = 1.4  # whole error over the change to half the element size: 1 / (1 - 2^-1.8)
DOUBT = (
    0.4  # standard deviation of that error over the change: orders from 1 to 2.5 give 2 to 1.2 for it; also what is left on the finer mesh
)
DOUBT_OF_RATIO = 0.9  # the same of mu / kappa: it feels most what flat faces cost a curved body, which half the size does not show
COARSE = 0.25  # change of a logarithm from which extrapolation is not trusted: then every modulus gets the doubt of the worst
COMPRESSIBLE = 3.0 / 29.0  # mu / kappa at a Poisson's ratio of 0.45, over which its changes are judged where it is less
THIN = 0.5  # as large a change is reckoned with where a zone is one cell thick, which the change to half the size does not tell
ITSELF = 3.0  # times as much for the moduli of that zone: skins of virtual legs came out several times too soft
ONE_CELL = 0.25  # part of the cells of a zone that lie between others on opposite sides, from which it is called one cell thick
MOST_UNKNOWNS = 600_000  # of the finer mesh
TOO_COARSE = "The elements are too coarse for extrapolation to be trusted, and intervals are wide: use smaller ones, and points for them."
ONE_CELL_THICK = "One element thick in a large part: {}. Moduli may be wrong by a third, theirs several times: see intervals."
ModuliOn = Callable[[Mesh, Zones], tuple[FloatArray, FloatArray]]  # lambda and mu, kPa, of the cells of a mesh


@dataclass(frozen=True, slots=True, eq=False)
class Refit:
    """Best fit after a change of the model, by one Gauss-Newton step.

    Attributes
    ----------
    theta : ndarray, shape (2 count,)
        Change of the logarithms of the moduli.
    residuals : tuple of ndarray, shape (q,)
        Whitened residuals of every load case.
    moved : tuple of ndarray, shape (n, d)
        Change of the displacement of every load case, mm.
    """

    theta: FloatArray
    residuals: tuple[FloatArray, ...]
    moved: tuple[FloatArray, ...]

    @property
    def misfit(self) -> float:
        """Sum of squares of the residuals."""
        return sum(float(r @ r) for r in self.residuals)


def extrapolated(fitted: FloatArray, change: FloatArray) -> FloatArray:
    """Return logarithms (2 count,) at vanishing element size, from those on a mesh and their change by a Gauss-Newton step on a finer one.

    ln mu is extrapolated as it is, and mu / kappa instead of its logarithm; where that is negative, ln(kappa / mu) is infinite.
    """
    k, out = len(fitted) // 2, fitted + EXTRAPOLATED * change
    with np.errstate(divide="ignore"):
        out[k:] = fitted[k:] - np.log(np.maximum(1.0 - EXTRAPOLATED * change[k:], 0.0))
    return out


def stretch_of(shift: FloatArray) -> FloatArray:
    """Return by how much equal errors of mu / kappa weigh more in its logarithm after that changed by `shift` (2 count,), 1 for ln mu."""
    k = len(shift) // 2
    return np.concatenate([np.ones(k), np.exp(shift[k:])])


def relative_change(shift: FloatArray) -> FloatArray:
    """Return the change of ln mu, then how much of mu / kappa went, of logarithms (2 count,) that changed by `shift`."""
    k = len(shift) // 2
    return np.concatenate([shift[:k], -np.expm1(-shift[k:])])


def weight_of_change(fitted: FloatArray) -> FloatArray:
    """Return how much of the relative changes of ln mu and mu / kappa (2 count,) tells of too large elements, 1 of ln mu.

    Elements are too compressible by an amount of mu / kappa that hardly depends on its value. Near incompressibility that is all of it,
    however small the elements, and says nothing of other moduli; so a change of mu / kappa weighs as much as in a material of a Poisson's
    ratio of 0.45. `fitted` (2 count,) are the logarithms on the mesh.
    """
    k = len(fitted) // 2
    return np.concatenate([np.ones(k), np.minimum(np.exp(-fitted[k:]) / COMPRESSIBLE, 1.0)])


def one_cell_thick(mesh: Mesh) -> tuple[str, ...]:
    """Return the names of regions that are one hexahedron thick in a large part, from one side or another.

    The displacement in them is linear from border to border; a layer under a surface with unknown forces then bends and shears otherwise
    than it does, and half the size, with the surface as on the mesh, hardly shows it. The steps of a round region are no layer: a cell
    counts where most of those of the region beside it are as thin, or where there are none.
    """
    number = _numbered_faces(mesh)
    region = np.repeat(mesh.regions, 6)
    total, squares = np.bincount(number, region), np.bincount(number, region.astype(float) ** 2)
    count = np.bincount(number)
    between = (count == 1) | (squares * count != total**2)  # at the surface, or of two regions
    along = between[number].reshape(-1, 3, 2).all(axis=2)
    sides, as_thin = np.zeros(mesh.n_cells, dtype=np.int64), np.zeros(mesh.n_cells, dtype=np.int64)
    for here, there in _shared_faces(number, ~between):
        both = [along[f // 6] & (np.arange(3) != (f % 6 // 2)[:, None]) for f in (here, there)]  # thin across the face that they share
        np.add.at(sides, here // 6, 1)
        np.add.at(as_thin, here // 6, both[0].any(axis=1) & both[1].any(axis=1))
    alone = along.any(axis=1) & ((2 * as_thin > sides) | (sides == 0))
    k = len(mesh.region_names)
    share = np.bincount(mesh.regions, alone, k) / np.maximum(np.bincount(mesh.regions, minlength=k), 1)
    return tuple(name for name, part in zip(mesh.region_names, share, strict=True) if part > ONE_CELL)


def _numbered_faces(mesh: Mesh) -> IntArray:
    """Return the number of every face (6 m,) of hexahedra, opposite ones in pairs, cells that share a face the same."""
    faces = mesh.cells[:, CELL_FACES["hexahedron"]]
    return np.asarray(np.unique(np.sort(faces.reshape(-1, 4), axis=1), axis=0, return_inverse=True)[1].ravel())


def _shared_faces(number: IntArray, which: BoolArray) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray]]:
    """Return the places (k,) in `number` (6 m,) of faces of two cells that `which` holds for, of the one and the other cell, both ways."""
    order = np.argsort(number, kind="stable")
    first = np.flatnonzero((number[order][1:] == number[order][:-1]) & which[number[order][1:]])
    one, other = order[first], order[first + 1]
    return (one, other), (other, one)


def told_of_elements(coarse: bool, thin: Sequence[str]) -> tuple[str, ...]:
    """Say that elements are too coarse, where they are, and which zones are one element thick."""
    return (TOO_COARSE, *[ONE_CELL_THICK.format(", ".join(thin))] * bool(thin)) if coarse else ()


def doubt_of(
    shift: FloatArray,
    *,
    mixed: bool = False,
    thin: BoolArray | None = None,
    sure: BoolArray | None = None,
    weight: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return standard deviations (2 count,) and covariance (2 count, 2 count) of extrapolated logarithms that changed by `shift`.

    Those of ln(kappa / mu) are relative to mu / kappa on the mesh (see `relative_change` and `stretch_of`).
    The error of all moduli has one cause and one sign, unless elements are so coarse that changes say little of what is left. Where zones
    end inside of cells or are regions of a map, the change is that of another law, or the motion of the whole surface is sought, which
    elements of half the size would find otherwise (`mixed`), it has no order of convergence: what is left may be as large as the change to
    half the size. If regions are one cell thick, no change is taken for less than `THIN`, and of the zones `thin` (count,) that are, for
    less than `ITSELF` times as much. Logarithms that the measurement does not determine move at no cost to the fit, and tell nothing of
    others: only those that are `sure` (2 count,) count as the worst, by `weight` (2 count,) of `weight_of_change`, and each gets at least
    the doubt of its own change.
    """
    told = np.abs(shift if weight is None else weight * shift)[slice(None) if sure is None else sure]
    worst = max(float(told.max(initial=0.0)), 0.0 if thin is None else THIN)
    part = 1.0 if mixed else DOUBT
    if worst > COARSE:
        sd = part / EXTRAPOLATED * np.maximum(worst, np.abs(shift))
        if thin is not None:
            sd = np.maximum(sd, part / EXTRAPOLATED * THIN * np.tile(np.where(thin, ITSELF, 1.0), 2))
        return sd, np.diag(sd**2)
    signed = np.repeat([part, max(part, DOUBT_OF_RATIO)], len(shift) // 2) / EXTRAPOLATED * shift
    return np.abs(signed), np.diag(signed**2) if mixed else np.outer(signed, signed)


def carried_over(covariance: FloatArray, information: FloatArray, apart: BoolArray) -> FloatArray:
    """Return the covariance (k, k) of logarithms when those `apart` (k,) err as stated and all others are refitted to them.

    `information` (k, k) is that of the data, which says by how much the others follow.
    """
    follow = np.eye(len(apart))
    rest = np.flatnonzero(~apart)
    if len(rest):
        response = np.linalg.lstsq(information[np.ix_(rest, rest)], information[np.ix_(rest, np.flatnonzero(apart))], rcond=1e-12)[0]
        follow[np.ix_(rest, np.flatnonzero(apart))] = -response
    return np.asarray(follow @ covariance @ follow.T)


def doubt_in_all(
    relative: FloatArray,
    sure: BoolArray,
    information: FloatArray,
    apart: BoolArray,
    *,
    mixed: bool,
    thin: BoolArray | None,
    weight: FloatArray | None = None,
) -> FloatArray:
    """Return the covariance (2 count, 2 count) of `doubt_of`, that of zones set `apart` (count,) carried over to all others.

    The change of zones set apart says nothing of how wrong others are but by that way, and does not count as the worst.
    """
    both = np.tile(apart, 2)
    _, covariance = doubt_of(relative, mixed=mixed, thin=thin, sure=sure & ~both, weight=weight)
    return carried_over(covariance, information, both) if apart.any() else covariance


def at_least_to(other: FloatArray | None, theta: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (2 count, 2 count) raised so that one standard deviation reaches logarithms found on another mesh, if any."""
    if other is None:
        return covariance
    apart = relative_change(other - theta) ** 2
    return np.asarray(covariance + np.diag(np.maximum(apart - np.diag(covariance), 0.0)))


def refitted(
    at: Linearised, quadratic: Concentrated, changes: list[FloatArray], basis: FloatArray | None = None, pull: FloatArray | float = 0.0
) -> Refit:
    """Return the best fit when the whitened residuals of the load cases change by `changes` (q,).

    `quadratic` is in the columns of `basis` (2 count, k), by default in all of theta; `pull` (k,) is the gradient of half of a prior, whose
    Hessian is part of that of `quadratic`.
    """
    observed = at.model.observed
    residuals = [o.residual(u) + c for o, u, c in zip(observed, at.point.states, changes, strict=True)]
    theta, loaded = at.gradient_of(residuals)
    offset = at.loaded_solved([g[:, None] for g in loaded])
    along = theta if basis is None else basis.T @ theta
    gradient = along + pull - sum(x.T @ g for x, g in zip(quadratic.response, loaded, strict=True))
    step: FloatArray = -np.linalg.lstsq(quadratic.hessian, np.asarray(gradient), rcond=1e-12)[0].astype(np.float64)
    of_theta = step if basis is None else basis @ step
    moved = at.forward(of_theta[:, None], [-(x @ step)[:, None] - b for x, b in zip(quadratic.response, offset, strict=True)])
    left = tuple(r + (o.operator @ u)[:, 0] for o, r, u in zip(observed, residuals, moved, strict=True))
    return Refit(step, left, tuple(u.reshape(state.shape) for u, state in zip(moved, at.point.states, strict=True)))


def misfit_on_finer_mesh(model: FieldModel, point: Point, law: LawName) -> float | None:
    """Return chi squared of a fit moved to cells of half the size by a Gauss-Newton step; None where there are no such cells."""
    at = model.linearised(model.evaluate(point.theta, point.states))
    finer = changes_on_finer_mesh(at, law, lambda _, zones: moduli_of(zones, at.point.theta))
    if finer is None:
        return None
    return refitted(at, at.concentrated(np.eye(len(point.theta)), ROUGH_TOLERANCE), finer[0]).misfit


def change_of_fit(at: Linearised, quadratic: Concentrated, changes: list[FloatArray]) -> FloatArray:
    """Return by how much the best logarithms (2 count,) change with the whitened residuals (q,), also where `at` is not the best fit."""
    back = np.linalg.lstsq(quadratic.hessian, quadratic.gradient, rcond=1e-12)[0]
    return np.asarray(refitted(at, quadratic, changes).theta + back)


@dataclass(slots=True, eq=False)
class KeptStates:
    """What equilibrium on the finer mesh added to displacements (n_fine, d), mm, that larger cells lend, by load case and law."""

    added: dict[tuple[int, LawName], FloatArray] = field(default_factory=dict)


def changes_on_finer_mesh(
    at: Linearised, law: LawName, moduli_on: ModuliOn, kept: KeptStates | None = None
) -> tuple[list[FloatArray], LawName] | None:
    """Return by how much the whitened residuals (q,) of every load case change on a mesh of half the element size, and under which law.

    `moduli_on` gives the moduli of its cells, which are not those of the coarse ones where borders run through these. Where a search comes
    back with moduli and a surface near by, states that are `kept` spare most of the way to equilibrium.
    Where no equilibrium at finite strain is found on it, because the displacement of the loaded nodes is too rough for small cells or the
    path there from rest too long, the change is that of small strain. Its error for shear moduli of virtual legs was as large as itself.
    None where the elements are used as given, or the finer mesh is too large.
    """
    model = at.model
    if not model.averaged or 8 * model.points.size > MOST_UNKNOWNS:
        return None
    names: tuple[LawName, ...] = ("linear",) if law == "linear" else (law, "linear")
    for name in names:
        try:
            return _changes(at, name, at.point.states if name == law else _small_strain(at), moduli_on, kept or KeptStates()), name
        except ConvergenceError:
            continue
    return None


def changes_of_motions(at: Linearised, moduli_on: ModuliOn, motions: list[FloatArray]) -> list[FloatArray]:
    """Return by how much the whitened measurements (q, k) of small motions change on a mesh of half the element size, at small strain.

    Parameters
    ----------
    at, moduli_on
        See `changes_on_finer_mesh`.
    motions : list of ndarray, shape (n d, k)
        Of every load case, mm; those of the loaded nodes count, the others follow.
    """
    model, finer = at.model, _Finer.of(at, moduli_on)
    body = field_law(finer.computed, "linear", averaged=finer.averaged)
    coarse = field_law(model.computed, "linear", averaged=model.averaged)
    solvers, of_coarse = Solvers(body, finer.computed.points, iterative=True), Solvers(coarse, model.points)
    lame, shear = moduli_of(model.zones, at.point.theta)
    out = []
    for o, moved in zip(model.observed, motions, strict=True):
        on = finer.observed(o)
        guesses = [finer.guess(on, u.reshape(model.points.shape)) for u in moved.T]
        fine = _at_small_strain(body, solvers, finer.lame, finer.shear, on, guesses)
        here = _at_small_strain(coarse, of_coarse, lame, shear, o, [u.reshape(model.points.shape) for u in moved.T])
        out.append(np.asarray(on.operator @ fine - o.operator @ here))
    return out


def _at_small_strain(
    law: FieldLaw, solvers: Solvers, lame: FloatArray, shear: FloatArray, o: Observed, guesses: list[FloatArray]
) -> FloatArray:
    """Return displacements (n d, k), mm, in equilibrium without external forces, loaded nodes as in `guesses` (n, d)."""
    constrained = o.load_case.loaded
    factor = solvers.factorized(lame, shear, np.zeros_like(guesses[0]), constrained)
    right = np.stack([np.where(constrained, 0.0, law.forces(lame, shear, u)).ravel() for u in guesses], axis=1)
    step = np.where(constrained.ravel()[:, None], 0.0, factor.solve(right))
    return np.stack([u.ravel() for u in guesses], axis=1) - step


def _small_strain(at: Linearised) -> tuple[FloatArray, ...]:
    """Return the states (n, d), mm, of small strain with the same moduli and the same displacement of the loaded nodes."""
    model, law = at.model, field_law(at.model.computed, "linear", averaged=at.model.averaged)
    lame, shear = moduli_of(model.zones, at.point.theta)
    solvers = Solvers(law, model.points)
    pairs = zip(model.observed, at.point.states, strict=True)
    return tuple(equilibrium(law, solvers, lame, shear, o.load_case, u, b"")[0] for o, u in pairs)


def _changes(at: Linearised, law: LawName, states: tuple[FloatArray, ...], moduli_on: ModuliOn, kept: KeptStates) -> list[FloatArray]:
    finer = _Finer.of(at, moduli_on)
    body = field_law(finer.computed, law, averaged=finer.averaged)
    solvers, out = Solvers(body, finer.computed.points, iterative=True), []
    for t, (o, u) in enumerate(zip(at.model.observed, states, strict=True)):
        on = finer.observed(o)
        lent = finer.guess(on, u)
        state = _settled_near(finer, body, solvers, on, lent, kept.added.get((t, law)))
        kept.added[t, law] = state - lent
        out.append(on.residual(state) - o.residual(u))
    return out


def _settled_near(finer: _Finer, body: FieldLaw, solvers: Solvers, on: Observed, lent: FloatArray, added: FloatArray | None) -> FloatArray:
    """Return the displacement (n_fine, d), mm, in equilibrium, sought from one `lent` by larger cells with what was `added` before."""
    if added is not None:
        try:
            return equilibrium(body, solvers, finer.lame, finer.shear, on.load_case, lent + added, b"")[0]
        except ConvergenceError:  # it does not suit these moduli, or this surface
            pass
    return settled(body, solvers, finer.computed.points, finer.lame, finer.shear, on.load_case, lent)


@dataclass(frozen=True, slots=True, eq=False)
class _Finer:
    """A body on cells of half the size.

    Attributes
    ----------
    refinement : Refinement
        Of its mesh.
    computed : Mesh
        On which equilibrium is computed.
    averaged : bool
        Whether with mean dilatation.
    lame, shear : ndarray, shape (8 m,)
        Moduli, kPa.
    between : csr_array, shape (n_fine, n)
        Interpolation from the nodes on which the coarse equilibrium is computed.
    """

    refinement: Refinement
    computed: Mesh
    averaged: bool
    lame: FloatArray
    shear: FloatArray
    between: sp.csr_array

    @classmethod
    def of(cls, at: Linearised, moduli_on: ModuliOn) -> _Finer:
        """Halve the cells of a body."""
        refinement = Refinement.of(at.model.mesh)
        computed, averaged = computed_mesh(refinement.mesh, "accurate")
        lame, shear = moduli_on(refinement.mesh, refinement.zones(at.model.zones))
        between = interpolation_operator(at.model.computed, computed.points)
        return cls(refinement, computed, averaged, lame, shear, between)

    def observed(self, o: Observed) -> Observed:
        """Return the measurements of a load case on it."""
        mesh = self.refinement.mesh
        of_nodes = o.load_case if mesh.n_points == len(o.load_case.loaded) else self.refinement.load_case(o.load_case)
        return Observed.of(mesh, self.computed, of_nodes)

    def guess(self, on: Observed, u: FloatArray) -> FloatArray:
        """Return the displacement (n_fine, d), mm, interpolated from the coarse one (n, d), with the loaded components as sought."""
        guess = np.asarray(self.between @ u)
        nodes = guess[: self.refinement.mesh.n_points].ravel()
        guess.ravel()[on.loaded] = on.basis @ nodes[on.unknown]
        return guess
