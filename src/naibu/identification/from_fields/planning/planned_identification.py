"""What a planned experiment will tell: an identification from the displacement that a simulation expects, with the noise to come.

Data are simulated on a mesh of half the element size, without noise, and identified with the covariance that the measurement will have. The
result has the standard deviations, intervals and systematic errors of the identification to come: those of noise are the Cramer-Rao bound
at the expected moduli (:cite:p:`kay1993`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.identified.field_prediction import displacement_under_moved_sides
from naibu.identification.from_fields.identified.identified_body import IdentifiedBody
from naibu.identification.from_fields.identified.sides import loaded_nodes
from naibu.identification.from_fields.inversion.regularization import cell_volumes
from naibu.identification.from_fields.uncertainty import Uncertainty
from naibu.meshing.point_location import interpolation_operator


def planned_identification(
    truth: IdentifiedBody,
    zones: Zones,
    pushes: Mapping[str, Mapping[str, tuple[float, float, float]]],
    *,
    points: int,
    noise_mm: float,
    plates_only: bool = False,
    seed: int = 0,
) -> FieldEstimate:
    """Return the identification of a planned experiment, with fields or with markers.

    Markers between plates whose contact and friction are modelled say at least as much as the same points with loaded plates.

    Parameters
    ----------
    truth : IdentifiedBody
        The body with the moduli that are expected.
    zones : Zones
        What is known of its mesh, and what is sought.
    pushes : mapping
        Load cases by name: displacement, mm, of the sides of the body that are held and moved (see `predict_moved_sides`).
    points : int
        Number of points, drawn evenly over the body, whose displacement is measured under every push.
    noise_mm : float
        Standard deviation of a component of a measured displacement, mm.
    plates_only : bool
        Whether the identification knows that forces act at these sides only; by default they may act on the whole surface.
    seed : int
        Of the positions of the points.

    Raises
    ------
    InputError
        Sides that cannot be moved so.
    ConvergenceError
        There is no equilibrium, or the measurements do not determine how the surface moves.
    """
    fine, at = truth.refined(), points_inside(truth, points, seed)
    operator = interpolation_operator(fine.mesh, at, tolerance_mm=np.inf)
    cases = []
    for name, moved in pushes.items():
        loaded = loaded_nodes(truth.mesh, truth.axes, list(moved) if plates_only else ())
        measured = np.asarray(operator @ displacement_under_moved_sides(fine, moved))
        cases.append(FieldLoadCase.of(name, DisplacementField.from_arrays(at, measured, sd_mm=noise_mm), truth.mesh, loaded=loaded))
    shear, ratio = np.exp(truth.theta.reshape(2, -1))
    found = identify_field(truth.mesh, cases, zones, law=truth.law, start=(shear * (ratio - 2.0 / 3.0), shear))
    return _without_shared_errors(found)


def _without_shared_errors(found: FieldEstimate) -> FieldEstimate:
    """Take off what raised the variance because neighbours share residuals: without noise they always do, as only elements leave any."""
    uncertainty, budget = found.uncertainty, found.budget
    if uncertainty is None or budget is None:
        return found
    raised, plain = Uncertainty.of(uncertainty.information), Uncertainty.of(uncertainty.information * budget.shared)
    total = uncertainty.with_added(plain.covariance - raised.covariance)
    return replace(found, uncertainty=total, budget=replace(budget, noise=plain.standard_deviations(), shared=1.0))


def points_inside(body: IdentifiedBody, count: int, seed: int = 0) -> FloatArray:
    """Return points (count, 3), mm, drawn evenly over a body of parallelepipeds."""
    rng, mesh = np.random.default_rng(seed), body.mesh
    volume = cell_volumes(mesh)
    corners = mesh.points[mesh.cells[rng.choice(mesh.n_cells, count, p=volume / volume.sum())]]
    axes = corners[:, [1, 3, 4]] - corners[:, :1]
    return np.asarray(corners[:, 0] + np.einsum("ki,kij->kj", rng.uniform(0.0, 1.0, (count, 3)), axes))
