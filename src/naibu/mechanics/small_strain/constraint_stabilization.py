"""Baumgarte constraint stabilisation: supports as differential equations whose multipliers are the contact forces :cite:p:`baumgarte1972`.

Instead of ``A^T u = g(t)`` the system obeys ``A^T u'' + 2 w A^T u' + w^2 A^T u = g'' + 2 w g' + w^2 g``: the gap ``A^T u - g`` decays like
a critically damped oscillator of angular frequency w. The equations of motion ``M u'' = f + A l`` then hold together with::

    [ M    -A ] [ u'' ]   [ f                                        ]
    [ -A^T    ] [ l   ] = [ 2 w (A^T u' - g') + w^2 (A^T u - g) - g'' ]

which is equation (9) of :cite:t:`hirai2008` (chapter 2) for a plate at rest, g = 0. (Equation (3.9) there prints ``M u`` for
``w^2 u`` and loses signs.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from naibu.core.arrays import FloatArray, require_positive, require_shape
from naibu.core.errors import ConvergenceError, InputError


@dataclass(frozen=True, slots=True)
class Stabilization:
    """Rate at which the gap of a support closes.

    Attributes
    ----------
    frequency : float
        w, 1/s, positive; the gap decays like ``(1 + w t) exp(-w t)``.
    """

    frequency: float

    def __post_init__(self) -> None:
        require_positive("stabilization", self.frequency, "1/s")

    def acceleration(self, gap: FloatArray, gap_rate: FloatArray, path_acceleration: FloatArray) -> FloatArray:
        """Return u'' of constrained components for a gap ``u - g``, mm, its rate ``u' - g'``, mm/s, and g'', mm/s^2."""
        w = self.frequency
        return path_acceleration - 2.0 * w * gap_rate - w**2 * gap

    def stage_velocity(
        self, start: tuple[FloatArray, FloatArray], step_s: float, path: tuple[FloatArray, FloatArray, FloatArray]
    ) -> FloatArray:
        """Return the velocity at the end of a backward-Euler stage from ``start = (u, u')`` with the path ``(g, g', g'')`` at its end."""
        w, (u, v), (g, speed, second) = self.frequency, start, path
        driven = v / step_s + second + 2.0 * w * speed + w**2 * (g - u)
        return np.asarray(driven / (1.0 / step_s + 2.0 * w + w**2 * step_s))


def stabilized_accelerations(
    mass: sp.spmatrix,
    constraint: sp.spmatrix,
    force: FloatArray,
    state: tuple[FloatArray, FloatArray],
    frequency: float,
    path: tuple[FloatArray, FloatArray, FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Solve the stabilised equations of motion for any linear constraint.

    Parameters
    ----------
    mass : sparse matrix, shape (N, N)
        M, kg, over all displacement components.
    constraint : sparse matrix, shape (N, c)
        A, without unit; a column for each constraint.
    force : ndarray, shape (N,)
        f, external less internal forces, mN.
    state : tuple of ndarray, shape (N,)
        u, mm, and u', mm/s.
    frequency : float
        w, 1/s.
    path : tuple of ndarray, shape (c,), optional
        g, mm, g', mm/s, and g'', mm/s^2; a plate at rest by default.

    Returns
    -------
    tuple of ndarray, shape (N,) and (c,)
        u'', mm/s^2, and the multipliers: the forces of the constraints, mN.

    Raises
    ------
    InputError
        Shapes that do not fit.
    ConvergenceError
        Linearly dependent constraints.
    """
    a = sp.csc_matrix(constraint)
    n, c = a.shape
    if mass.shape != (n, n):
        raise InputError(f"mass must have shape {(n, n)} for a constraint of {n} components, not {mass.shape}")
    for name, array in (("force", force), ("state[0]", state[0]), ("state[1]", state[1])):
        require_shape(name, array, (n,))
    g, speed, second = path if path is not None else (np.zeros(c),) * 3
    rule = Stabilization(frequency).acceleration(a.T @ state[0] - g, a.T @ state[1] - speed, second)
    try:
        upper, lower = sp.hstack([sp.csc_matrix(mass), -a]), sp.hstack([-a.T, sp.csc_matrix((c, c))])
        found = spla.splu(sp.csc_matrix(sp.vstack([upper, lower]))).solve(np.concatenate([force, -rule]))
    except RuntimeError as error:
        raise ConvergenceError(f"the constraints are linearly dependent ({error}): leave the redundant ones out") from error
    return found[:n], found[n:]
