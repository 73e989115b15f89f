"""Moduli with the shape of the law sought as well: consider parameters of the law in a joint posterior with the moduli.

A hyperelastic law fixes how stress grows with strain. Where materials are strained differently, one that stiffens more than the law says
looks like one of another modulus. What other laws have in addition (`naibu.identification.from_fields.forward.shaped_law`) has a prior, and
fields of many points in a body that is strained unevenly tell much of it. Moduli, the motion of the loaded nodes and the shapes of every
material's law are found together, by Gauss-Newton from the best fit under the law that was assumed. What the data leave open of the shapes
is part of the covariance of the moduli there (consider parameters, :cite:p:`schmidt1966,tapley2004`). What elements of half the size change
in the residuals looks like another law as well; how large it is is sought with the shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import ConvergenceError
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import Concentrated, FieldModel, Linearised, Point, moduli_of
from naibu.identification.from_fields.forward.shaped_law import N_SHAPES, ShapedLaw
from naibu.identification.from_fields.inversion.told_combinations import bounded_covariance
from naibu.identification.from_fields.verdicts.verdict import inflation

SHAPE_SD = (0.5, 1.0, 1.0, 1.0)  # of c01, c20, c30 as in identification from markers; of the isochoric part, which is none or all
ELEMENTS_SD = 1.0  # of the error of elements in the residuals, over what half the size changes, which is expected
ELEMENTS_LEFT = 0.5  # the same of what is left when that size was sought: errors of another pattern
MOST_STEPS, HALVINGS = 6, 4
SETTLED = 0.15  # standard deviations of the posterior by which a last step moves moduli at most
LOST = 1e-10  # part of the largest eigenvalue of scaled information below which a combination is not told
OTHER_LAWS = {"mooney_rivlin": (0,), "yeoh": (1, 2), "neo_hookean_isochoric": (3,)}  # and the shapes that they have


@dataclass(frozen=True, slots=True, eq=False)
class FreeLaw:
    """Moduli with the shape of the law free.

    Attributes
    ----------
    materials : tuple of str
        Known regions (g), then zones.
    shift : ndarray, shape (2 count,)
        By how much ln mu, then ln(kappa / mu) of the zones differ from those under the law that was assumed.
    covariance : ndarray, shape (2 count, 2 count)
        What not knowing the shapes adds to theirs, and what errors of elements add that look like shapes.
    shapes, shapes_sd : ndarray, shape (g, 4)
        c01 fraction, c20 ratio, c30 ratio and isochoric part of every material, and their standard deviations.
    probabilities : dict of str to float
        Of so large a score by chance if the law that was assumed is right, by the name of the law that was tested against it; empty where
        that is small strain, which no law at finite strain has for a special case.
    settled : bool
        Whether the search ended where steps are short; otherwise the last step is part of the covariance.
    fall : float
        By how much chi squared falls with these shapes.
    """

    materials: tuple[str, ...]
    shift: FloatArray
    covariance: FloatArray
    shapes: FloatArray
    shapes_sd: FloatArray
    probabilities: dict[str, float]
    settled: bool
    fall: float = 0.0

    @property
    def found(self) -> bool:
        """Whether there was an equilibrium with the shape of the law free: otherwise there are no numbers."""
        return bool(np.isfinite(self.shift).all())

    @classmethod
    def lost(cls, materials: Sequence[str], size: int) -> FreeLaw:
        """Return what is left where there is no equilibrium, for theta of some size."""
        none = np.full((len(materials), N_SHAPES), np.nan)
        return cls(tuple(materials), np.full(size, np.nan), np.full((size, size), np.nan), none, none, {}, False)


def materials_of(zones: Zones) -> dict[str, BoolArray]:
    """Return the cells (m,) of every material: of known regions, then of zones."""
    known = {region.name: np.asarray(zones.region_of_cell == number) for number, region in enumerate(zones.known)}
    return known | {name: np.asarray(zones.of_cell == i) for i, name in enumerate(zones.names)}


def free_law(at: Linearised, of_elements: Sequence[FloatArray] | None, freedom: float) -> FreeLaw:
    """Find moduli and the shapes of laws together, from the best fit `at`.

    Parameters
    ----------
    at : Linearised
        At the best fit under the law that was assumed.
    of_elements : sequence of ndarray, shape (q,), or None
        What elements of half the size change in the whitened residuals of every load case, the moduli following; None where that is
        not known.
    freedom : float
        Degrees of freedom of the fit.
    """
    materials = materials_of(at.model.zones)
    search = _Search.of(at.model, np.stack(list(materials.values())), of_elements, freedom)
    try:
        start = here = search.evaluated(at.point.theta, search.centre, at.point.states)
        first = joint = search.linearised(here)
    except ConvergenceError:
        return FreeLaw.lost(tuple(materials), len(at.point.theta))
    settled = False
    for _ in range(MOST_STEPS):
        step = joint.step(search)
        settled = step.standard_deviations < SETTLED
        if settled:
            break
        further = _further(search, here, step, joint.variance)
        if further is None:
            break
        here = further
        joint = search.linearised(here)
    g, covariance = len(materials), joint.of_moduli(search) + joint.doubt_of_elements(search)
    if not settled:
        covariance = covariance + np.outer(step.theta, step.theta)
    sd = np.sqrt(np.diag(joint.posterior(search)))[: g * N_SHAPES]
    return FreeLaw(
        tuple(materials), here.point.theta - at.point.theta, covariance, here.added[: g * N_SHAPES].reshape(g, -1), sd.reshape(g, -1),
        {} if at.model.law.linear else {name: first.probability(search, kinds) for name, kinds in OTHER_LAWS.items()}, settled,
        max(0.0, sum(float(a @ a - b @ b) for a, b in zip(start.residuals, here.residuals, strict=True))),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A point of the search with what is added to theta there (p,): shapes, and sizes of the errors of elements; and its residuals."""

    model: FieldModel
    point: Point
    added: FloatArray
    residuals: list[FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    theta: FloatArray
    added: FloatArray
    motion: list[FloatArray]
    standard_deviations: float


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What is searched in: `cells` (g, m) of the materials, and what is known of added parameters (p,) beforehand."""

    model: FieldModel
    law: ShapedLaw
    cells: FloatArray
    of_elements: Sequence[FloatArray]
    centre: FloatArray
    precision: FloatArray
    freedom: float

    @classmethod
    def of(cls, model: FieldModel, cells: BoolArray, of_elements: Sequence[FloatArray] | None, freedom: float) -> _Search:
        g, errors = len(cells), list(of_elements or ())
        law = ShapedLaw(model.computed, np.zeros((N_SHAPES, cells.shape[1])), averaged=model.averaged)
        centre = np.concatenate([np.zeros(g * N_SHAPES), np.ones(len(errors))])
        sd = np.concatenate([np.tile(SHAPE_SD, g), np.full(len(errors), ELEMENTS_SD)])
        return cls(model, law, cells.astype(float), errors, centre, sd**-2.0, freedom)

    @property
    def n_shapes(self) -> int:
        return len(self.cells) * N_SHAPES

    def evaluated(self, theta: FloatArray, added: FloatArray, guesses: Sequence[FloatArray], near: _Place | None = None) -> _Place:
        """Find equilibrium with these moduli and shapes; preconditioners of a place near by serve there as well."""
        shapes = added[: self.n_shapes].reshape(-1, N_SHAPES).T @ self.cells
        model = self.model.under(self.law.with_shapes(shapes))
        model.boundary = (self if near is None else near).model.boundary.copied()
        point = model.evaluate(theta, guesses)
        residuals = [o.residual(u) for o, u in zip(model.observed, point.states, strict=True)]
        for t, error in enumerate(self.of_elements):
            residuals[t] = residuals[t] + added[self.n_shapes + t] * error
        return _Place(model, point, added, residuals)

    def objective(self, there: _Place, variance: float) -> float:
        """Half the misfit with the weak prior on the motion, in units of a variance, and the priors of what is added."""
        misfit = sum(float(r @ r) for r in there.residuals) + there.point.prior
        return 0.5 * misfit / variance + 0.5 * float(self.precision @ (there.added - self.centre) ** 2)

    def linearised(self, there: _Place) -> _Joint:
        """Return half the misfit as a quadratic in what is added, the moduli and the motion of the loaded nodes following."""
        at = there.model.linearised(there.point)
        quadratic = at.concentrated(np.eye(len(there.point.theta)))
        shaped = at.solved(self._forces(there))
        columns = []
        for t, (o, moved) in enumerate(zip(there.model.observed, shaped, strict=True)):
            errors = np.zeros((len(o.data), len(self.of_elements)))
            if len(self.of_elements):
                errors[:, t] = self.of_elements[t]
            columns.append(np.column_stack([there.residuals[t], np.asarray(o.operator @ moved), errors]))
        follow, motion, left = _eliminated(at, quadratic, columns)
        for moved, shape in zip(motion, shaped, strict=True):
            moved[:, 1 : 1 + self.n_shapes] += shape
        gram = np.asarray(sum(a.T @ b for a, b in zip(columns, left, strict=True)))
        gram = 0.5 * (gram + gram.T)
        gram[0, 1:] = gram[1:, 0] = sum(a[:, 1:].T @ b[:, 0] for a, b in zip(columns, left, strict=True))
        joint = _Joint(there, quadratic, follow, motion, left, gram, 1.0)
        everything = np.ones(len(self.centre), dtype=bool)
        return _Joint(there, quadratic, follow, motion, left, gram, joint.variance_left(self, joint.step(self).added, everything))

    def _forces(self, there: _Place) -> list[FloatArray]:
        """Return the nodal forces (n d, 4 g), mN, of a unit of every shape, with a minus sign, at the nodes that are free."""
        lame, shear = moduli_of(there.model.zones, there.point.theta)
        out = []
        for o, u in zip(there.model.observed, there.point.states, strict=True):
            force = np.empty((u.size, self.n_shapes))
            for j in range(self.n_shapes):
                change = np.zeros((N_SHAPES, self.cells.shape[1]))
                change[j % N_SHAPES] = self.cells[j // N_SHAPES]
                force[:, j] = -self.law.forces_of_shape(lame, shear, u, change).ravel()
            force[o.loaded] = 0.0
            out.append(force)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _Joint:
    """The quadratic of `_Search.linearised`; column 0 of what has 1 + p is the step with what is added as it is, the others go with it.

    Attributes
    ----------
    there : _Place
    quadratic : Concentrated
        Of the moduli.
    follow : ndarray, shape (2 count, 1 + p)
        Change of theta.
    motion : list of ndarray, shape (n d, 1 + p)
        Change of the displacement of every load case, mm.
    left : list of ndarray, shape (q, 1 + p)
        Whitened residuals, and their change.
    gram : ndarray, shape (1 + p, 1 + p)
        Gradient and information.
    variance : float
        Of residuals with all that is added free, over that stated, errors that neighbours share counted as in `verdict.inflation`.
    """

    there: _Place
    quadratic: Concentrated
    follow: FloatArray
    motion: list[FloatArray]
    left: list[FloatArray]
    gram: FloatArray
    variance: float

    def posterior(self, search: _Search) -> FloatArray:
        """Return the covariance (p, p) of what is added."""
        return np.asarray(np.linalg.inv(self.gram[1:, 1:] / self.variance + np.diag(search.precision)))

    def of_moduli(self, search: _Search) -> FloatArray:
        """Return what that adds to the covariance (2 count, 2 count) of theta."""
        n = search.n_shapes
        return np.asarray(self.follow[:, 1 : 1 + n] @ self.posterior(search)[:n, :n] @ self.follow[:, 1 : 1 + n].T)

    def doubt_of_elements(self, search: _Search) -> FloatArray:
        """Return the covariance (2 count, 2 count) of theta that errors of elements leave which look like shapes of a law.

        What is left of the error of elements after its size was found has another pattern, of which no more is known.
        """
        n, sought = search.n_shapes, slice(1, 1 + search.n_shapes)
        information = self.gram[sought, sought] / self.variance + np.diag(search.precision[:n])
        shapes = -np.linalg.solve(information, self.gram[sought, 1 + n :] / self.variance)
        moved = self.follow[:, 1 + n :] + self.follow[:, sought] @ shapes
        return np.asarray(ELEMENTS_LEFT**2 * moved @ moved.T)

    def step(self, search: _Search) -> _Step:
        """Return the Gauss-Newton step."""
        slope = self.gram[1:, 0] / self.variance + search.precision * (self.there.added - search.centre)
        added = -self.posterior(search) @ slope
        all_of_it = np.concatenate([[1.0], added])
        theta, motion = _within(self.there.point.theta, self.follow @ all_of_it), [m @ all_of_it for m in self.motion]
        sd = np.sqrt(np.diag(bounded_covariance(self.quadratic.hessian / self.variance) + self.of_moduli(search)))
        return _Step(theta, added, motion, float(np.max(np.abs(theta) / np.maximum(sd, 1e-300))))

    def probability(self, search: _Search, kinds: tuple[int, ...]) -> float:
        """Return that of so large a score of shapes of some kinds, all materials', by chance, the size of errors of elements free."""
        shapes, n = np.arange(search.n_shapes), len(search.centre)
        errors = np.arange(n) >= search.n_shapes
        tested = np.concatenate([np.isin(shapes % N_SHAPES, kinds), np.zeros(n - len(shapes), dtype=bool)])
        step, before = self._free(errors | tested), self._free(errors)
        gain = -float(self.gram[1:, 0] @ (step - before)) / self.variance_left(search, step, errors | tested)
        return float(chdtrc(int(tested.sum()), max(gain, 0.0)))

    def _free(self, kept: BoolArray) -> FloatArray:
        """Return the step (p,) of what is `kept` (p,) without priors."""
        out, information = np.zeros(len(kept)), self.gram[1:, 1:][np.ix_(kept, kept)]
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        inverse = np.linalg.pinv(information / np.outer(scale, scale), rcond=LOST, hermitian=True)
        out[kept] = -(inverse @ (self.gram[1:, 0][kept] / scale)) / scale
        return out

    def variance_left(self, search: _Search, step: FloatArray, kept: BoolArray) -> float:
        """Return the variance of residuals after a step (p,) of what is `kept`, over that stated, for parameters; at least 1."""
        residuals = [r[:, 0] + r[:, 1:] @ step for r in self.left]
        freedom = max(search.freedom - float(kept.sum()), 1.0)
        slopes = [r[:, 1:][:, kept] for r in self.left]
        information = sum(j.T @ j for j in slopes)
        shared = (
            inflation(self.there.model.observed, residuals, slopes, np.asarray(np.linalg.pinv(information), dtype=float), freedom)
            if kept.any()
            else 1.0
        )
        return max(1.0, sum(float(r @ r) for r in residuals) / freedom) * shared


def _within(theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return a step (2 count,) ending at the largest Poisson's ratio of searches: kappa / mu changes nothing there, it goes anywhere."""
    k = len(theta) // 2
    most = np.log(2.0 * (1.0 + MAX_POISSON_RATIO) / (3.0 * (1.0 - 2.0 * MAX_POISSON_RATIO)))
    return np.concatenate([step[:k], np.minimum(step[k:], np.maximum(most - theta[k:], 0.0))])


def _eliminated(
    at: Linearised, quadratic: Concentrated, columns: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
    """Let moduli and loaded nodes follow whitened residuals (q, r), in column 0 those that there are, in others changes.

    Returns the change of theta (2 count, r), that of the displacement (n d, r) of every load case, mm, and the residuals then.
    """
    observed = at.model.observed
    theta, loaded = at.adjoint([o.operator.T @ c for o, c in zip(observed, columns, strict=True)])
    for o, u, pull in zip(observed, at.point.states, loaded, strict=True):
        pull[:, 0] += o.prior @ o.sought(u)
    offset = at.loaded_solved(loaded)
    gradient = theta - sum(x.T @ b for x, b in zip(quadratic.response, loaded, strict=True))
    follow: FloatArray = -np.linalg.lstsq(quadratic.hessian, np.asarray(gradient), rcond=1e-12)[0].astype(np.float64)
    moved = at.forward(follow, [-(x @ follow) - b for x, b in zip(quadratic.response, offset, strict=True)])
    left = [c + np.asarray(o.operator @ u) for o, c, u in zip(observed, columns, moved, strict=True)]
    return follow, moved, left


def _further(search: _Search, here: _Place, step: _Step, variance: float) -> _Place | None:
    """Return the first place along the step, halved again and again, at which the objective falls; None where it never does."""
    value, part = search.objective(here, variance), 1.0
    for _ in range(HALVINGS):
        guesses = [u + part * m.reshape(u.shape) for u, m in zip(here.point.states, step.motion, strict=True)]
        try:
            there = search.evaluated(here.point.theta + part * step.theta, here.added + part * step.added, guesses, here)
        except ConvergenceError:  # shapes that a body cannot follow
            part *= 0.5
            continue
        if search.objective(there, variance) < value:
            return there
        part *= 0.5
    return None
