"""Whether one zone slides along another, which a model whose zones are bonded cannot follow.

Where two zones slide, displacements along their border jump, in the direction in which the one drags the other. The model's traction at the
border, over a stiffness per area, is such a jump (:cite:t:`goodman1968`): to first order, moduli and the motion of the loaded nodes
following, the compliance of every border that fits best is found, and by how much it fits better
(`naibu.identification.from_fields.assumptions.score_test`). A border that lies elsewhere by a part of a cell looks alike, and a compliance
that is not more than that of a cell of the softer zone is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.assumed_law import blamed, told_shift
from naibu.identification.from_fields.assumptions.free_law import materials_of
from naibu.identification.from_fields.assumptions.score_test import Asked, ScoreTest, most_asked
from naibu.identification.from_fields.forward.forward_model import Observed, whitening
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, moduli_of
from naibu.identification.from_fields.inversion.regularization import cell_volumes
from naibu.identification.verdict import Explanation, Verdict
from naibu.meshing.point_location import locate, operator_of
from naibu.meshing.surface import face_normals, faces_of_cells, node_areas

MOST_BORDERS = 12  # that are tried: a solution of every load case each
FEWEST_FACES = 4  # of a border: of fewer no field tells a jump
SLIDES = "one slides along the other"


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """Where two materials meet.

    Attributes
    ----------
    names : tuple of str
        The two.
    side : ndarray, shape (m,), bool
        Cells of the second.
    softer_kpa : float
        Shear modulus of the softer of the two.
    faces : ndarray, shape (f, k), int64
        Outward faces of the second's cells that are faces of the first's as well.
    """

    names: tuple[str, str]
    side: BoolArray
    softer_kpa: float
    faces: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Sliding:
    """A border along which fields ask for a jump of displacements.

    Attributes
    ----------
    names : tuple of str
        The two zones.
    jump_mm : float
        Root mean square over the border.
    fall : float
        By how much chi squared falls with it.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones would change, to first order.
    """

    names: tuple[str, str]
    jump_mm: float
    fall: float
    theta: FloatArray


def asked_sliding(test: ScoreTest, variance: float, stretch: FloatArray) -> Sliding | None:
    """Return the border along which fields ask most for a jump, None where chance, errors of elements or its place give as much.

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
    borders = _borders(model, test.at.point.theta) if model.mesh.dimension == 3 and test.errors.any() else []
    if not 0 < len(borders) <= MOST_BORDERS:
        return None
    edge = float(cell_volumes(model.mesh).mean() ** (1.0 / 3.0))
    found = {border: _asked(test, border, edge) for border in borders}
    best = most_asked(found, variance)
    return None if best is None else Sliding(best[0].names, best[1].part, best[1].fall, best[1].shift(stretch))


def _asked(test: ScoreTest, border: Border, edge: float) -> Asked | None:
    """Return what fields say of jumps along a border, None where one that lies elsewhere by an edge of a cell, mm, gives as much."""
    jumps, compliance = _jumps(test.at, border)
    found = test.of_residuals(_changes(test.at, border, jumps)) if compliance > 0.0 else None
    return None if found is None or found.part * compliance * border.softer_kpa < edge else found


def judged_sliding(judged: Verdict, found: Sliding | None, zones: Zones, theta: FloatArray, explained: float) -> Verdict:
    """Return the verdict with a border along which zones slide, where moduli would change by much or residuals are more than noise.

    It is the first reason where chi squared falls with it by more than `explained`, and another law is none then; the last one otherwise.
    """
    if found is None:
        return judged
    changes = told_shift(zones, theta, found.theta)
    first = found.fall > explained
    if not changes and (judged.explanation is Explanation.EXPLAINED or not first):
        return judged
    one, other = found.names
    would = f": without that, Young's modulus would be another one: {changes}" if changes else ""
    why = (
        f"displacements jump by some {found.jump_mm:.2g} mm across the border of {one} and {other}, as where {SLIDES}, "
        f"or a thin soft layer lies between them{would}"
    )
    return blamed(judged, why, first=first)


def _borders(model: FieldModel, theta: FloatArray) -> list[Border]:
    """Return where materials meet, on the mesh on which equilibrium is computed."""
    mesh, shear = model.computed, moduli_of(model.zones, theta)[1]
    materials, out = materials_of(model.zones), []
    outer = {name: faces_of_cells(mesh.cells[cells], mesh.cell_type).faces for name, cells in materials.items() if cells.any()}
    for one, other in combinations(outer, 2):
        there = {tuple(sorted(face)) for face in outer[one].tolist()}
        faces = outer[other][[tuple(sorted(face)) in there for face in outer[other].tolist()]]
        if len(faces) >= FEWEST_FACES:
            softer = min(float(shear[materials[name]].mean()) for name in (one, other))
            out.append(Border((one, other), materials[other], softer, faces))
    return out


def _jumps(at: Linearised, border: Border) -> tuple[list[FloatArray], float]:
    """Return jumps (n, 3), mm, of a root mean square of 1 mm by the tangential traction, and their compliance, mm/kPa; 0 without traction.

    At nodes where forces act from outside as well they are those of their neighbours on the border.
    """
    mesh = at.model.computed
    area = node_areas(mesh, border.faces)
    normal = np.zeros_like(mesh.points)
    for corner in border.faces.T:
        np.add.at(normal, corner, face_normals(mesh.points, border.faces))
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    lame, shear = (np.where(border.side, moduli, 0.0) for moduli in moduli_of(at.model.zones, at.point.theta))
    out = []
    for o, u in zip(at.model.observed, at.point.states, strict=True):
        inner = (area > 0.0) & ~o.load_case.loaded.any(axis=1)
        traction = np.where(inner[:, None], at.model.law.forces(lame, shear, u), 0.0) / np.where(inner, area, 1.0)[:, None]
        traction -= (traction * normal).sum(axis=1)[:, None] * normal
        out.append(_continued(-traction, inner, border.faces))
    square = sum(float(area @ (jump**2).sum(axis=1)) for jump in out) / max(float(area.sum()) * len(out), 1e-300)
    if not square > 0.0:
        return out, 0.0
    compliance = float(square**-0.5)
    return [compliance * jump for jump in out], compliance


def _continued(values: FloatArray, known: BoolArray, faces: IntArray) -> FloatArray:
    """Return values (n, 3) at the nodes of faces (f, k): where they are not known, the mean of those of the same faces."""
    total, count = np.zeros_like(values), np.zeros(len(values))
    of_faces, n_known = values[faces].sum(axis=1), known[faces].sum(axis=1)
    for corner in faces.T:
        np.add.at(total, corner, of_faces)
        np.add.at(count, corner, n_known)
    return np.where(known[:, None], values, total / np.maximum(count, 1.0)[:, None])


def _changes(at: Linearised, border: Border, jumps: Sequence[FloatArray]) -> list[FloatArray]:
    """Return what jumps (n, 3), mm, of the second zone at its border change of the whitened displacement (q,) of every load case."""
    model = at.model
    lame, shear = (np.where(border.side, moduli, 0.0) for moduli in moduli_of(model.zones, at.point.theta))
    right = []
    for o, u, jump in zip(model.observed, at.point.states, jumps, strict=True):
        force = -np.asarray(model.law.stiffness(lame, shear, u) @ jump.ravel())
        force[o.loaded] = 0.0
        right.append(force[:, None])
    pairs = zip(model.observed, at.solved(right), jumps, strict=True)
    return [np.asarray(o.operator @ moved[:, 0]) + _of_jump(model.computed, o, jump, border.side) for o, moved, jump in pairs]


def _of_jump(mesh: Mesh, o: Observed, jump: FloatArray, side: BoolArray) -> FloatArray:
    """Return the whitened jump (q,) within the cells of the second zone."""
    there = locate(mesh, o.points, tolerance_mm=np.inf)
    inside = np.where(side[there.cells][:, None], operator_of(mesh, there) @ jump, 0.0)
    return np.asarray(np.einsum("nij,nj->ni", whitening(o.load_case.field, o.load_case.name)[0], inside).ravel())
