"""Displacement of an identified body under another loading, with its covariance.

Two loadings are known well enough without a force: sides of the body that are held and moved, all other surface free; and the displacement
of the surface, as a measured field shows it near there. In the second case the surface is estimated from these measurements with the moduli
held, by maximum likelihood as in the identification, and the prediction is for the inside. Errors of the moduli and of the surface reach
the prediction to first order, those of the surface by samples of the noise; what half the element size changes, and what the model left
unexplained where it was identified, are added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import registration
from naibu.identification.from_fields.forward.field_laws import field_law
from naibu.identification.from_fields.forward.forward_model import Solvers, equilibrium, loaded_from_rest
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.modulus_columns import modulus_columns
from naibu.identification.from_fields.forward.refinement import Refinement
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, Point
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_fields.identified.sides import nodes_of_side
from naibu.identification.from_fields.inversion.gauss_newton import first_point
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.meshing.point_location import interpolation_operator, locate
from naibu.meshing.surface import boundary_nodes

SAMPLES = 48  # of the measurement's noise: standard deviations are known to 10 %
EXTRAPOLATED = 1.4  # whole error of a displacement over its change to half the element size, as for moduli
LEAST_POINTS = 20  # near the surface
STEPS = 40  # Gauss-Newton steps for the displacement of the surface, at most
HALVED = 10  # times that a step is, at most
STILL = 1e-3  # of the largest displacement, and of misfit and prior: a step that changes either less is the last one


@dataclass(frozen=True, slots=True, eq=False)
class FieldPrediction:
    """Predicted displacement of the nodes of a body.

    Attributes
    ----------
    mesh : Mesh
        The body.
    displacement : ndarray, shape (n, 3)
        mm.
    factor : ndarray, shape (n, 3, r)
        Factor F of the covariance F F' of displacements, mm: of the moduli, of the surface, and of the elements.
    discrepancy_mm : float
        Standard deviation of a component, mm, that the model left unexplained where it was identified.
    strain : float
        Root mean square displacement that a rigid motion does not explain, as part of the extent of the body.
    """

    mesh: Mesh
    displacement: FloatArray
    factor: FloatArray
    discrepancy_mm: float
    strain: float

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return displacement (k, 3), mm, and covariance (k, 3, 3), mm^2, at points of the body (k, 3), mm."""
        operator = interpolation_operator(self.mesh, points, tolerance_mm=np.inf)
        n, _, r = self.factor.shape
        factor = np.asarray(operator @ self.factor.reshape(n, 3 * r)).reshape(-1, 3, r)
        covariance = np.einsum("kir,kjr->kij", factor, factor) + self.discrepancy_mm**2 * np.eye(3)
        return np.asarray(operator @ self.displacement), covariance

    @property
    def standard_deviation(self) -> FloatArray:
        """Standard deviation of the displacement of every node (n, 3), mm."""
        return np.asarray(np.sqrt((self.factor**2).sum(axis=2) + self.discrepancy_mm**2))


def predict_moved_sides(body: IdentifiedBody, moved: Mapping[str, tuple[float, float, float]]) -> FieldPrediction:
    """Predict the displacement of a body some sides of which are held or moved by plates to which they stick.

    Parameters
    ----------
    body : IdentifiedBody
        The model.
    moved : mapping
        Displacement, mm, of sides (see `nodes_of_side`); zero holds one. The remaining surface is free.

    Raises
    ------
    InputError
        Sides that do not exist or share nodes, or nothing that moves.
    ConvergenceError
        There is no equilibrium.
    """
    mask, values = _motion_of_sides(body, moved)
    u, factor = _solved(body, mask, values)
    zones = body.cell_zones
    law = field_law(body.mesh, body.law, averaged=True)
    lame, shear = body.lame_of_cells()
    right = -np.asarray(modulus_columns(law, zones, lame, shear, u) @ (body.mixing @ body.spread))
    right[mask.ravel()] = 0.0
    moving = factor.solve(right) if right.shape[1] else right
    coarse = _change_on_finer_mesh(body, mask, values)
    spread = np.concatenate([moving.reshape(*u.shape, -1), EXTRAPOLATED * _diagonal(coarse)], axis=2)
    return FieldPrediction(body.mesh, u, spread, body.discrepancy_mm, _strain(body.mesh, u))


def displacement_under_moved_sides(body: IdentifiedBody, moved: Mapping[str, tuple[float, float, float]]) -> FloatArray:
    """Return the displacement (n, 3), mm, of a body as `predict_moved_sides` finds it, without its covariance.

    Raises
    ------
    InputError
        See `predict_moved_sides`.
    ConvergenceError
        There is no equilibrium.
    """
    return _solved(body, *_motion_of_sides(body, moved))[0]


def _motion_of_sides(body: IdentifiedBody, moved: Mapping[str, tuple[float, float, float]]) -> tuple[BoolArray, FloatArray]:
    """Return which components (n, 3) are held or moved, and their displacement (n, 3), mm."""
    fixed, values = np.zeros(body.mesh.n_points, dtype=bool), np.zeros_like(body.mesh.points)
    for side, motion in moved.items():
        nodes = nodes_of_side(body.mesh, body.axes, side)
        if (nodes & fixed).any() and not np.allclose(values[nodes & fixed], motion):
            raise InputError(f"side {side} shares nodes with another side that moves otherwise; move opposite sides")
        fixed |= nodes
        values[nodes] = motion
    if not np.ptp(values[fixed], axis=0).any():
        raise InputError("no side moves against another, so that nothing deforms; hold one side and move another")
    return np.repeat(fixed[:, None], 3, axis=1), values


def predict_inside(body: IdentifiedBody, field: DisplacementField) -> tuple[FieldPrediction, BoolArray]:
    """Predict the displacement inside of a body from that near its surface.

    Parameters
    ----------
    body : IdentifiedBody
        The model.
    field : DisplacementField
        Measured displacement, of which only what lies in cells at the surface is used.

    Returns
    -------
    FieldPrediction
        Of all nodes.
    ndarray, shape (k,), bool
        Which of the field's points lie inside of the body and were not used.

    Raises
    ------
    InputError
        Too few measurements near the surface, or none inside of the body.
    ConvergenceError
        They do not fix how the surface moves, or there is no equilibrium.
    """
    outer, inner = parted(body.mesh, field)
    if int(outer.sum()) < LEAST_POINTS:
        raise InputError(
            f"{int(outer.sum())} measurements of the field lie in cells at the surface of the body; are field and model from one reference "
            "scan?"
        )
    covariance = None if field.covariance is None else field.covariance[outer]
    surface = DisplacementField.from_arrays(field.points[outer], field.vectors[outer], covariance=covariance)
    loaded = np.zeros(body.mesh.n_points, dtype=bool)
    loaded[boundary_nodes(body.mesh)] = True
    load_case = FieldLoadCase.of("prediction", surface, body.mesh, loaded=loaded)
    model = FieldModel(body.mesh, [load_case], body.cell_zones, body.law)
    at = _fitted_surface(model, body.theta_of_cells)
    u, mixing = at.point.states[0], body.mixing.toarray() @ body.spread
    right = at.adjoint([_pulled(at, x) for x in at.forward(mixing, None)])[1] if mixing.shape[1] else []
    follow = at.forward(mixing, [-b for b in at.loaded_solved(right)])[0] if mixing.shape[1] else np.zeros((u.size, 0))
    residual = model.observed[0].residual(u)
    inflation = max(1.0, float(np.sqrt(np.mean(residual**2))))
    noise = inflation * at.forward(None, at.loaded_solved([_noise(at)]))[0] / np.sqrt(SAMPLES)
    coarse = _change_on_finer_mesh(body, np.repeat(loaded[:, None], 3, axis=1), u)
    spread = np.concatenate([x.reshape(*u.shape, -1) for x in (follow, noise)] + [EXTRAPOLATED * _diagonal(coarse)], axis=2)
    return FieldPrediction(body.mesh, u, spread, body.discrepancy_mm, _strain(body.mesh, u)), inner


def parted(mesh: Mesh, field: DisplacementField) -> tuple[BoolArray, BoolArray]:
    """Return which points of a field (k,) lie in cells at the surface of a mesh, and which in other cells."""
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    near = np.flatnonzero(field.valid & ((field.points >= low) & (field.points <= high)).all(axis=1))
    outer, inner = np.zeros(len(field.points), dtype=bool), np.zeros(len(field.points), dtype=bool)
    if not len(near):
        return outer, inner
    found = locate(mesh, field.points[near], tolerance_mm=np.inf)
    there = found.distance_mm <= 1e-6
    at_surface = np.asarray(np.isin(mesh.cells, boundary_nodes(mesh)).any(axis=1))[found.cells]
    outer[near[there & at_surface]], inner[near[there & ~at_surface]] = True, True
    return outer, inner


def _fitted_surface(model: FieldModel, theta: FloatArray) -> Linearised:
    """Return the displacement that suits the measurements best at given moduli, linearised there."""
    point = first_point(model, theta)
    for _ in range(STEPS):
        at = model.linearised(model.evaluate(theta, point.states))
        step = at.loaded_solved([-g[:, None] for g in at.gradient()[1]])
        moved = at.forward(None, step)[0].reshape(point.states[0].shape)
        still = float(np.abs(moved).max()) <= STILL * float(np.abs(point.states[0]).max())
        point = _downhill(at, moved)
        if still or _objective(point) >= (1.0 - STILL) * _objective(at.point) or model.law.linear:
            break
    return model.linearised(model.evaluate(theta, point.states))


def _downhill(at: Linearised, moved: FloatArray) -> Point:
    """Return the point after a displacement (n, 3), mm, or a part of it, that suits the measurements no worse; that before, if none does.

    The whole of a Gauss-Newton step may turn cells inside out where the surface moves far.
    """
    for halved in range(HALVED):
        try:
            point = at.model.evaluate(at.point.theta, [at.point.states[0] + 0.5**halved * moved])
        except ConvergenceError:
            continue
        if _objective(point) <= (1.0 + STILL) * _objective(at.point):
            return point
    return at.point


def _objective(point: Point) -> float:
    return point.misfit + point.prior


def _pulled(at: Linearised, u: FloatArray) -> FloatArray:
    operator = at.model.observed[0].operator
    return np.asarray(operator.T @ (operator @ u))


def _noise(at: Linearised) -> FloatArray:
    """Return samples (n_b, SAMPLES) of the gradient of half of misfit and prior, whose covariance is their Hessian."""
    rng, observed = np.random.default_rng(0), at.model.observed[0]
    data = rng.standard_normal((len(observed.data), SAMPLES))
    edges = sp.triu(observed.prior, 1).tocoo()  # the prior is a sum over edges of squares of differences
    strain = np.sqrt(np.maximum(-edges.data, 0.0))[:, None] * rng.standard_normal((edges.nnz, SAMPLES))
    out = at.adjoint([np.asarray(observed.operator.T @ data)])[1][0].copy()
    np.add.at(out, edges.row, strain)
    np.add.at(out, edges.col, -strain)
    return out


def _solved(body: IdentifiedBody, fixed: BoolArray, values: FloatArray) -> tuple[FloatArray, Factorization]:
    """Return the displacement (n, 3), mm, in equilibrium where some components (n, 3) have these values, and the factorized tangent."""
    mesh, law = body.mesh, field_law(body.mesh, body.law, averaged=True)
    lame, shear = body.lame_of_cells()
    case = FieldLoadCase("prediction", _NOWHERE, fixed, np.zeros_like(values))
    start = loaded_from_rest(law, mesh.points, lame, shear, case, values)
    return equilibrium(law, Solvers(law, mesh.points), lame, shear, case, np.where(fixed, values, start), b"")


def _change_on_finer_mesh(body: IdentifiedBody, fixed: BoolArray, values: FloatArray) -> FloatArray:
    """Return by how much half the element size changes the displacement of the nodes (n, 3), mm, at small strain."""
    fine = Refinement.of(body.mesh)
    case = FieldLoadCase("prediction", _NOWHERE, fixed, np.zeros_like(values))
    out = []
    for on, one, moved in ((body, case, values), (body.refined(), fine.load_case(case), fine.displacement(values))):
        law = field_law(on.mesh, "linear", averaged=True)
        start = np.where(one.loaded, moved, 0.0)
        out.append(equilibrium(law, Solvers(law, on.mesh.points, iterative=True), *on.lame_of_cells(), one, start, b"")[0])
    return np.asarray(out[1][: body.mesh.n_points] - out[0])


def _diagonal(u: FloatArray) -> FloatArray:
    """Return a factor (n, 3, 3) of a covariance whose components are independent, with standard deviations |u| (n, 3)."""
    return np.asarray(np.abs(u)[:, :, None] * np.eye(3))


def _strain(mesh: Mesh, u: FloatArray) -> float:
    left = u - registration(mesh.points, mesh.points + u).displacement(mesh.points)
    extent = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    return float(np.sqrt((left**2).sum(axis=1).mean())) / extent


_NOWHERE = DisplacementField.from_arrays(np.zeros((1, 3)), np.zeros((1, 3)))
