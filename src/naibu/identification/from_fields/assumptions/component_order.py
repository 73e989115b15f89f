"""Whether signs and order of the components of measured displacements are those of the positions, judged by a homogeneous body.

Programs differ in which way axes point (LPS, RAS, y upwards) and in which order they write components (x, y, z or z, y, x). Displacements
in another frame than their positions are no deformation of an elastic body: a search for moduli goes on for long, and ends anywhere. In
linear elasticity the motion of the loaded nodes that suits a field best, and what is left, are found with the same factors for every
arrangement of components. The measure is what a homogeneous body leaves, at the Poisson's ratio at which it leaves least: of a true field
inclusions and layers leave much as well, but of no other arrangement much less. Where forces may act on the whole surface, nothing is
decided: its motion then follows any arrangement, and layers may leave several times as much of the true one as of another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.identification.from_fields.forward.forward_model import Observed, whitening
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones, is_surface_sought
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import rigid_body_modes

POISSON_RATIOS = (0.45, 0.49, 0.3, 0.498, 0.0)  # of the homogeneous body, the most usual first
LEAST_SHARE = 0.15  # of the deformation, by root mean square, that errors of elements and of small strain may leave as well
LEAST_SD = 2.0  # standard deviations of the measurement
DECISIVE = 3.0  # times the misfit, empirical: bodies with layers, inclusions and plates leave less than 1.5 times that of another order
MOST_SHARE = 0.3  # of the deformation, that the likeliest may leave: where forces act at sides that are called free, none explains much
ALIKE = 1.5  # times the least misfit: arrangements within it are as likely


@dataclass(frozen=True, slots=True, eq=False)
class LikelierOrder:
    """Arrangements of the components of a field that suit an elastic body far better than the given one.

    Attributes
    ----------
    unexplained, least : float
        Part of the deformation that a homogeneous body leaves of the field as it is, and of the likeliest arrangement, root mean square.
    arrangements : tuple of ndarray, shape (d, d)
        Likely ones, the likeliest first: matrices of a 1 or -1 in every row, times which vectors are likely right. Whether a matrix or its
        negative is right is not known: linear elasticity holds for both.
    """

    unexplained: float
    least: float
    arrangements: tuple[FloatArray, ...]


def likelier_order(mesh: Mesh, load_cases: Sequence[FieldLoadCase], progress: Progress | None = None) -> LikelierOrder | None:
    """Return arrangements of the components of all fields that suit a homogeneous body far better than the given one; None if none does.

    Parameters
    ----------
    mesh : Mesh
        The body, of cells as coarse as show its shape.
    load_cases : sequence of FieldLoadCase
        What was measured; external forces are not reckoned with.
    progress : callable, optional
        Gets reports.
    """
    if is_surface_sought(mesh, load_cases):
        return None
    report_progress(progress, "comparing signs and order of the components of displacements")
    model = FieldModel(mesh, load_cases, Zones.of(mesh, known={}).of_one_material())
    tried = _arrangements(mesh.dimension)
    data = [np.stack([_whitened(o, matrix) for matrix in tried], axis=1) for o in model.observed]
    modes = rigid_body_modes(model.points)
    deformation = sum((o.beyond(modes, d) ** 2).sum(axis=0) for o, d in zip(model.observed, data, strict=True))
    least = np.full(len(tried), np.inf)
    for poisson in POISSON_RATIOS:
        least = np.minimum(least, _misfits(model, poisson, data))
        if np.sqrt(least[0] / deformation[0]) < LEAST_SHARE or least[0] < LEAST_SD**2 * model.n_data:
            return None
    order = np.argsort(least)
    best = least[order[0]]
    share = np.sqrt(least / deformation)
    if least[0] < DECISIVE * best or share[order[0]] > MOST_SHARE:
        return None
    likely = tuple(tried[k] for k in order if least[k] <= ALIKE * best)
    return LikelierOrder(float(share[0]), float(share[order[0]]), likely)


def _arrangements(dimension: int) -> list[FloatArray]:
    """Return all matrices of a 1 or -1 in every row and column, one of each and its negative: first that which changes nothing."""
    unit = np.eye(dimension)
    signs = [np.array([1.0, *rest]) for rest in product((1.0, -1.0), repeat=dimension - 1)]
    return [s[:, None] * unit[list(axes)] for axes in permutations(range(dimension)) for s in signs]


def _whitened(o: Observed, matrix: FloatArray) -> FloatArray:
    """Return whitened data (q,) with the displacements of a load case multiplied by a matrix (d, d)."""
    field = o.load_case.field
    whiten = whitening(field, o.load_case.name)[0]
    return np.asarray(np.einsum("nij,nj->ni", whiten, field.vectors[field.valid] @ matrix.T).ravel())


def _misfits(model: FieldModel, poisson: float, data: list[FloatArray]) -> FloatArray:
    """Return the least misfits (r,) of data (q, r) of every load case, over all motions of the loaded nodes of a homogeneous body."""
    theta = np.log([1.0, 2.0 * (1.0 + poisson) / (3.0 * (1.0 - 2.0 * poisson))])
    at = model.linearised(model.evaluate(theta, [np.zeros_like(model.points)] * len(data)))
    right = at.adjoint([np.asarray(o.operator.T @ d) for o, d in zip(model.observed, data, strict=True)])[1]
    moved = at.forward(None, at.loaded_solved(right))
    left = [o.operator @ u - d for o, u, d in zip(model.observed, moved, data, strict=True)]
    return np.asarray(sum((r**2).sum(axis=0) for r in left))
