"""What noise does to moduli through the sought motion of loaded nodes, beyond the bias of the best fit.

The motion ``b = b_0 + e`` of the surface follows the noise, with errors e of covariance ``G^-1 A' A G^-1`` (see `bias`). What is
bilinear in the motion does not average out:

- The derivatives of the residuals by the moduli are linear in the motion, so that the Gauss-Newton Hessian holds the squares of those of e.
  That part looks like information on the moduli and is none. With H the Hessian and Q that part, the corrected score has the slope
  ``H - Q`` and the variance H, and its root the covariance ``(H - Q)^-1 H (H - Q)^-1``: the sandwich of :cite:t:`nakamura1990`.
- What elements of half the size change in the moduli is the product of these derivatives with a change of the residuals that is linear in
  the motion as well. Its mean over e is added to the correction for the size of elements, and its scatter is an error of that correction
  which its own size does not tell: it may be small by chance.

Both are means over motions of the surface that are drawn from their errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.from_fields.forward.load_cases import KNOWN
from naibu.identification.from_fields.forward.modulus_columns import modulus_columns
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised, moduli_of
from naibu.identification.from_fields.inversion.told_combinations import told

DRAWS = 16  # of motions
SMALL_STRAIN = 1e-4  # of the derivative of the tangent
MOST = 0.8  # of the information, in any combination of moduli, that may be that of noise: what is left determines too little to be scaled
UNKNOWN_BELOW = 1e-12  # fraction of the largest eigenvalue of the scaled information below which a combination is not determined
Motions = list[FloatArray]  # displacements (n d, k), mm, of every load case


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedInformation:
    """Information on k logarithms of moduli without that of noise.

    Attributes
    ----------
    root : ndarray, shape (k, r)
        Columns w with ``H = root root'`` in which also the part of noise is diagonal.
    parts : ndarray, shape (r,)
        That part of the information along each, from 0 to `MOST`.
    """

    root: FloatArray
    parts: FloatArray

    @classmethod
    def of(cls, hessian: FloatArray, of_noise: FloatArray) -> CorrectedInformation:
        """Divide the information (k, k) by how much of it is that of noise (k, k)."""
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
        values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
        kept = values > UNKNOWN_BELOW * max(float(values[-1]), 1e-300)
        inverse = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
        parts, turned = np.linalg.eigh(inverse.T @ of_noise @ inverse)
        root = (scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])) @ turned
        return cls(root, np.clip(parts, 0.0, MOST))

    @property
    def matrix(self) -> FloatArray:
        """Inverse of the covariance of the moduli (k, k), for noise as stated."""
        return np.asarray(self.root * (1.0 - self.parts) ** 2 @ self.root.T)

    def step(self, gradient: FloatArray) -> FloatArray:
        """Return the change (k,) of the logarithms that a gradient (k,) of the objective makes, with a minus sign.

        Combinations of logarithms that have no bounds (see `told`) are left where they are.
        """
        inverse, kept = np.linalg.pinv(self.root, rcond=1e-9), told(self.matrix)[1]
        return np.asarray(kept @ (kept.T @ (inverse.T @ ((inverse @ gradient) / (1.0 - self.parts)))))


@dataclass(frozen=True, slots=True, eq=False)
class DrawnMotions:
    """Errors of the sought motion, drawn, and how the derivatives by 2 count moduli change with them.

    Attributes
    ----------
    moved : list of ndarray, shape (n d, k)
        Errors of the displacement of every load case, mm.
    changed : list of (list of ndarray, shape (n d, 2 count))
        For every draw: change of the derivatives of the displacement by the moduli.
    followed : list of (list of ndarray, shape (n_b, 2 count))
        For every draw: by how much the loaded components follow, with a minus sign.
    information : ndarray, shape (2 count, 2 count)
        What they add to the information on the moduli, in the mean.
    """

    moved: Motions
    changed: list[Motions]
    followed: list[list[FloatArray]]
    information: FloatArray

    @classmethod
    def of(cls, at: Linearised, variance: float, draws: int = DRAWS) -> DrawnMotions:
        """Draw them for noise of a variance (over that stated) at a point of the search."""
        observed, rng, size = at.model.observed, np.random.default_rng(1), 2 * at.model.zones.count
        noise = [np.sqrt(variance) * rng.choice([-1.0, 1.0], size=(len(o.data), draws)) for o in observed]
        pulled = at.adjoint([o.operator.T @ z for o, z in zip(observed, noise, strict=True)])[1]
        moved = at.forward(None, at.loaded_solved(pulled))
        all_changed, all_followed, total = [], [], np.zeros((size, size))
        for k in range(draws):
            changed = _changed_derivatives(at, [u[:, k] for u in moved])
            pulls = [o.information @ u for o, u in zip(observed, changed, strict=True)]
            cross = at.adjoint(pulls)[1]
            followed = at.loaded_solved(cross)
            total += sum(u.T @ p - c.T @ x for u, p, c, x in zip(changed, pulls, cross, followed, strict=True))
            all_changed.append(changed)
            all_followed.append(followed)
        return cls(moved, all_changed, all_followed, np.asarray(0.5 * (total + total.T) / draws))

    def gradients_of_change(
        self, at: Linearised, quadratic: Concentrated, change: list[FloatArray], changes: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return what these errors add to the gradient (2 count,) of a change of the residuals: the mean, and by draw (draws, 2 count).

        Parameters
        ----------
        at, quadratic
            The best fit, and the quadratic there.
        change : list of ndarray, shape (q,)
            Change of the whitened residuals at the best fit.
        changes : list of ndarray, shape (q, draws)
            What the errors add to it.
        """
        pull = at.adjoint([(o.operator.T @ c)[:, None] for o, c in zip(at.model.observed, change, strict=True)])[1]
        pulls = [o.operator.T @ c for o, c in zip(at.model.observed, changes, strict=True)]
        theta, loaded = at.adjoint(pulls)
        along = theta - sum(x.T @ g for x, g in zip(quadratic.response, loaded, strict=True))  # with the derivatives of the best fit
        whole = [o.operator.T @ c for o, c in zip(at.model.observed, change, strict=True)]
        linear, square = [], []
        for k, (changed, followed) in enumerate(zip(self.changed, self.followed, strict=True)):
            other = sum(u.T @ p - x.T @ g[:, 0] for u, p, x, g in zip(changed, whole, followed, pull, strict=True))
            linear.append(along[:, k] + other)
            square.append(sum(u.T @ p[:, k] - x.T @ g[:, k] for u, p, x, g in zip(changed, pulls, followed, loaded, strict=True)))
        return np.mean(square, axis=0), np.asarray(linear)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceNoise:
    """What noise in the sought motion does to moduli.

    Attributes
    ----------
    information : CorrectedInformation
        On the moduli.
    drawn : DrawnMotions
        From which it was found.
    """

    information: CorrectedInformation
    drawn: DrawnMotions

    @classmethod
    def of(cls, at: Linearised, quadratic: Concentrated, variance: float) -> SurfaceNoise:
        """Find it at the best fit, whose residuals have a `variance` over that stated; beyond 1 it may be that of errors of the model."""
        drawn = DrawnMotions.of(at, min(variance, 1.0))
        return cls(CorrectedInformation.of(quadratic.hessian, drawn.information), drawn)

    def of_change(
        self, at: Linearised, quadratic: Concentrated, change: list[FloatArray], on_finer: Callable[[Motions], list[FloatArray]]
    ) -> tuple[FloatArray, FloatArray]:
        """Return what noise added to the step (2 count,) that a change of the residuals makes, and the covariance of that step.

        Parameters
        ----------
        at, quadratic
            The best fit, and the quadratic there.
        change : list of ndarray, shape (q,)
            Change of the whitened residuals on the finer mesh.
        on_finer : callable
            Gives this change (q, k) for small motions.
        """
        mean, each = self.drawn.gradients_of_change(at, quadratic, change, on_finer(self.drawn.moved))
        steps = np.stack([self.information.step(g) for g in each])
        return -self.information.step(mean), np.asarray(steps.T @ steps / len(steps))


def tangent_columns(at: Linearised, t: int, direction: FloatArray) -> FloatArray:
    """Return what a relative change of every modulus adds to the forces (n d, 2 count) of a small displacement (n d,) about the state."""
    model, state = at.model, at.point.states[t]
    lame, shear = moduli_of(model.zones, at.point.theta)
    extent = float(np.ptp(model.points, axis=0).max())
    step = SMALL_STRAIN * extent / max(float(np.abs(direction).max()), 1e-300) * direction.reshape(state.shape)
    ahead, behind = (modulus_columns(model.law, model.zones, lame, shear, state + side * step) for side in (1.0, -1.0))
    scale = float(np.abs(step).max()) / max(float(np.abs(direction).max()), 1e-300)
    return np.asarray((ahead - behind).toarray() / (2.0 * scale))


def works_of_moduli(at: Linearised, t: int, along: FloatArray, against: FloatArray) -> FloatArray:
    """Return the sum (2 count,) of the products of `tangent_columns` of small displacements with others (both n d, r), column by column."""
    zones = at.model.zones
    unknown = zones.of_cell != KNOWN
    lame, shear = moduli_of(zones, at.point.theta)
    of_lame, of_shear = at.model.law.unit_works(at.point.states[t], along, against)
    of_cells = (lame * of_lame + shear * of_shear, (lame + 2.0 / 3.0 * shear) * of_lame)
    return np.concatenate([np.bincount(zones.of_cell[unknown], work[unknown], minlength=zones.count) for work in of_cells])


def _changed_derivatives(at: Linearised, moved: Motions) -> Motions:
    """Return how the derivatives of the displacement (n d, 2 count) of every load case by the moduli change with it (n d,)."""
    forces = [-tangent_columns(at, t, u) for t, u in enumerate(moved)]
    for o, f in zip(at.model.observed, forces, strict=True):
        f[o.loaded] = 0.0
    changed = at.solved(forces)
    for o, u in zip(at.model.observed, changed, strict=True):
        u[o.loaded] = 0.0
    return changed
