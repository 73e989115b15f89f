"""Whether the free surface of a body lies elsewhere than the mask has it, or forces act on it.

A mask that ends within the object takes off material that carries stress, and has the surface free where it is not: fields then look like
those of another law, or reversed. The change of the displacement with the place of the free surface is found by moving its nodes outwards;
how far the field asks to go, and how much better it fits then, to first order, moduli and the motion of the loaded nodes following
(`naibu.identification.from_fields.assumptions.score_test`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.assumed_law import OF_LAW, blamed, told_shift
from naibu.identification.from_fields.assumptions.other_assumptions import changes_on
from naibu.identification.from_fields.assumptions.scaled_displacements import EXPLAINS
from naibu.identification.from_fields.assumptions.score_test import ScoreTest, most_asked
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel
from naibu.identification.from_fields.inversion.regularization import cell_volumes
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.surface import boundary_faces, face_normals

MOVED = 0.1  # of the edge of a cell, by which the surface is moved to find what that changes
FEWEST_FACES = 4
LEAST_PART = 0.1  # of what exceeds the noise, that is told of residuals that are more than noise
FREE_SURFACE = "the free surface of the object"


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePlace:
    """How far outside of its place in the mask fields ask for the free surface.

    Attributes
    ----------
    outwards_mm : float
        Negative where it lies within.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change, to first order.
    """

    outwards_mm: float
    fall: float
    theta: FloatArray


def asked_surface(test: ScoreTest, variance: float, stretch: FloatArray) -> SurfacePlace | None:
    """Return where fields ask for the free surface, None where chance or errors of elements give as much, or none is known to be free.

    Parameters
    ----------
    test : ScoreTest
        Of the best fit.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    stretch : ndarray, shape (2 count,)
        By how much changes of logarithms are larger at vanishing element size.
    """
    model = test.at.model
    if model.mesh.dimension != 3 or model.computed is not model.mesh or not test.errors.any():
        return None
    free = _free_faces(model)
    if len(free) < FEWEST_FACES:
        return None
    step = MOVED * float(cell_volumes(model.mesh).mean() ** (1.0 / 3.0))
    try:
        changes = changes_on(test.at, model.mesh.points + step * _outwards(model.mesh, free))
    except ConvergenceError:
        return None
    best = most_asked({FREE_SURFACE: test.of_residuals(changes)}, variance)
    return None if best is None else SurfacePlace(step * best[1].part, best[1].fall, best[1].shift(stretch))


def judged_surface(
    judged: Verdict, found: SurfacePlace | None, zones: Zones, theta: FloatArray, of_law: float, beyond_noise: float
) -> Verdict:
    """Return the verdict with another place of the free surface, where moduli would change by much or residuals are more than noise.

    Parameters
    ----------
    judged : Verdict
        On the residuals and other causes.
    found : SurfacePlace or None
    zones : Zones
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu).
    of_law, beyond_noise : float
        By how much chi squared falls with another law, and exceeds what noise leaves. The surface is the first reason where it explains
        more than another law and half of what exceeds the noise, or more than another law that is the first; that is none then.
    """
    if found is None:
        return judged
    changes = told_shift(zones, theta, found.theta)
    over_law = next(iter(judged.reasons), "").startswith(OF_LAW)
    first = found.fall > of_law and (over_law or found.fall > EXPLAINS * beyond_noise)
    if not changes and (judged.explanation is Explanation.EXPLAINED or not (first or found.fall > LEAST_PART * beyond_noise)):
        return judged
    would = f": with that, Young's modulus would be another one: {changes}" if changes else ""
    way = "outside" if found.outwards_mm > 0.0 else "inside"
    why = (
        f"the fields ask for {FREE_SURFACE} some {abs(found.outwards_mm):.2g} mm {way} of where mask or zones have it, or for forces on "
        f"sides that are not named as loaded: check both{would}"
    )
    return blamed(judged, why, first=first)


def _free_faces(model: FieldModel) -> IntArray:
    """Return the faces (f, k) of the surface at which no load case has a force."""
    faces = boundary_faces(model.mesh).faces
    loaded = np.any([o.load_case.loaded.any(axis=1) for o in model.observed], axis=0)
    return np.asarray(faces[~loaded[faces].all(axis=1)])


def _outwards(mesh: Mesh, faces: IntArray) -> FloatArray:
    """Return by which displacement (n, 3) of the nodes of faces (f, k) each of these moves outwards by 1, as nearly as nodes can."""
    normals = face_normals(mesh.points, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    squares, total = np.zeros((mesh.n_points, 3, 3)), np.zeros((mesh.n_points, 3))
    for corner in faces.T:
        np.add.at(squares, corner, normals[:, :, None] * normals[:, None, :])
        np.add.at(total, corner, normals)
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.pinv(squares, rcond=1e-2, hermitian=True), total))
