"""Maps of moduli where none is known: multiples of the modulus of the largest region.

Displacements determine moduli up to a factor. One cell in the middle of the body is taken as known while the map is made, and the factor is
free: that cell agrees with its neighbours at the factor that the data ask for. What is found is then divided by the modulus of the largest
region, so that how poorly a single cell tells the factor cancels, and the cell joins its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress
from naibu.identification.from_fields.assumptions.assumed_law import hangs_on_law
from naibu.identification.from_fields.assumptions.other_assumptions import Assumption
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.field_laws import LawName
from naibu.identification.from_fields.forward.load_cases import (
    KNOWN,
    POISSON_RATIO,
    POISSON_RATIO_SD,
    FieldLoadCase,
    KnownRegion,
    Zones,
    is_surface_sought,
)
from naibu.identification.from_fields.forward.sensitivities import young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Bounds
from naibu.identification.from_fields.inversion.regularization import cell_volumes, inner_faces
from naibu.identification.from_fields.mesh_error import TOO_COARSE
from naibu.identification.from_fields.uncertainty import LawPart, Uncertainty, intervals, young_and_poisson_slopes
from naibu.identification.from_fields.verdicts.statement import statement
from naibu.identification.from_fields.verdicts.verdict import FEW_POINTS, told_points
from naibu.identification.from_fields.verdicts.within_cells import told_alike, with_limits
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters

ONE_MATERIAL = (
    "One material explains the measurement: no difference of stiffness can be told from its noise, which does not mean that there is none."
)
REFERENCE = "one element in the middle, taken for known"


def identify_relative_map(
    mesh: Mesh,
    load_cases: Sequence[FieldLoadCase],
    *,
    law: LawName = "neo_hookean",
    bounds: Bounds | None = None,
    progress: Progress | None = None,
) -> FieldEstimate:
    """Map moduli cell by cell as multiples of Young's modulus of the largest region, where no modulus is known.

    Parameters
    ----------
    mesh, load_cases, law, bounds, progress
        See `naibu.identification.identify_field`; the regions of the mesh do not matter.

    Returns
    -------
    FieldEstimate
        Moduli without unit. If the measurements are explained by regions, those are its zones, and Young's modulus of the largest is 1 by
        definition; otherwise 1 is the median of the map, by volume.

    Raises
    ------
    InputError, ConvergenceError
        See `naibu.identification.identify_field`.
    """
    cell = middle_cell(mesh)
    lame, shear = lame_parameters(1.0, POISSON_RATIO)
    start = np.full(mesh.n_cells - 1, lame), np.full(mesh.n_cells - 1, shear)
    found = identify_field(mesh, load_cases, zones_beside(mesh, cell), law=law, bounds=bounds, start=start, progress=progress)
    points = max(int(case.field.valid.sum()) for case in load_cases)
    few = told_points(points, mesh.n_cells) if points < mesh.n_cells and is_surface_sought(mesh, load_cases) else ""
    return _without_reference(_relative(found, few), cell)


def middle_cell(mesh: Mesh) -> int:
    """Return the number of the cell nearest to the centre of the body that has neighbours on all sides, if one has."""
    pairs, _ = inner_faces(mesh)
    beside = np.bincount(pairs.ravel(), minlength=mesh.n_cells)
    middles = mesh.points[mesh.cells].mean(axis=1)
    distance = np.linalg.norm(middles - np.average(middles, axis=0, weights=cell_volumes(mesh)), axis=1)
    return int(np.argmin(np.where(beside == beside.max(), distance, np.inf)))


def zones_beside(mesh: Mesh, cell: int) -> Zones:
    """Return every cell but one as a zone of its own, and that one as known, with Young's modulus 1."""
    of_cell = np.arange(mesh.n_cells) - (np.arange(mesh.n_cells) > cell)
    there = of_cell.copy()
    there[cell] = KNOWN
    lame, shear = np.full(mesh.n_cells, np.nan), np.full(mesh.n_cells, np.nan)
    lame[cell], shear[cell] = lame_parameters(1.0, POISSON_RATIO)
    names = tuple(f"cell {c}" for c in range(mesh.n_cells) if c != cell)
    reference = KnownRegion(REFERENCE, 1.0, POISSON_RATIO, poisson_ratio_sd=POISSON_RATIO_SD, is_unit=True)
    return Zones(there, names, lame, shear, (reference,), np.where(there == KNOWN, 0, KNOWN))


def relative_to(found: Uncertainty, theta: FloatArray, zone: int) -> Uncertainty:
    """Return the uncertainty of moduli as multiples of Young's modulus of a zone, which then has none."""
    k = len(found.covariance) // 2
    of_shear = np.concatenate([np.ones(k), np.zeros(k)])
    change = np.eye(2 * k)
    of_young, _ = young_and_poisson_slopes(theta)
    for slope, column in zip(of_young[:, zone], (zone, k + zone), strict=True):
        change[:, column] -= slope * of_shear
    lost = ~np.isfinite(np.diag(found.covariance))
    covariance = change @ np.where(lost | lost[:, None], 0.0, found.covariance) @ change.T
    lost = lost | (lost[zone] & (of_shear > 0.0))
    lost[zone] = False
    covariance[lost, lost] = np.inf
    along = found.information @ of_shear
    free = found.information - np.outer(along, along) / max(float(of_shear @ along), 1e-300)  # the common factor is not known
    free[zone, zone] += float(np.diag(found.information).max())
    law = found.law and LawPart(change @ found.law.shift, change @ found.law.covariance @ change.T)
    return Uncertainty(free, covariance, found.stretch, law=law)


def without_poisson(found: Uncertainty) -> Uncertainty:
    """Return the uncertainty of moduli where nothing is known of kappa / mu."""
    k = len(found.covariance) // 2
    covariance = found.covariance.copy()
    covariance[k:, :] = covariance[:, k:] = 0.0
    bulk = np.arange(k, 2 * k)
    covariance[bulk, bulk] = np.inf
    return Uncertainty(found.information, covariance, found.stretch, law=found.law)


def _relative(found: FieldEstimate, few: str = "") -> FieldEstimate:
    """Divide moduli by that of the largest zone, or by the median of a map without zones that have intervals.

    Where points are too `few`, which is said in words, nothing is said of Poisson's ratio.
    """
    volume = _volumes(found)
    logarithm = np.log(found.young_modulus)
    if found.uncertainty is None:
        order = np.argsort(logarithm)
        unit = float(logarithm[order][np.searchsorted(np.cumsum(volume[order]), 0.5 * volume.sum())])
        theta = _divided(found.theta, unit)
        poisson = young_and_poisson(theta)[1]
        words = (*found.identifiability[:1], "Moduli are multiples of the median of the map.", *found.identifiability[1:])
        return replace(found, theta=theta, regularized=(np.exp(logarithm - unit), poisson), identifiability=words)
    zone = int(np.argmax(volume))
    unit = float(logarithm[zone])
    theta, uncertainty = _divided(found.theta, unit), relative_to(found.uncertainty, found.theta, zone)
    uncertainty = without_poisson(uncertainty) if few else uncertainty
    others = tuple(replace(one, theta=_divided(one.theta, _of_unit(one, found.theta, zone))) for one in found.assumptions)
    regularized = found.regularized and (found.regularized[0] / np.exp(unit), found.regularized[1])
    assert found.verdict is not None  # of regions that were fitted without a penalty
    of_law = hangs_on_law(found.verdict, found.free_law, uncertainty, theta)
    limits = "; ".join(filter(None, (few, told_alike(found.zones.names, theta, uncertainty, zone))))
    bounds = intervals(theta, uncertainty)[0]
    judged = with_limits(replace(found.verdict, limits=limits), found.zones.names, None, bounds, "", of_law=of_law)
    found = replace(found, verdict=judged)
    return replace(
        found, theta=theta, uncertainty=uncertainty, assumptions=others, regularized=regularized, budget=None,
        identifiability=(*_in_words(found, theta, uncertainty, others), *(FEW_POINTS,) * bool(few)),
    )  # fmt: skip


def _of_unit(other: Assumption, theta: FloatArray, zone: int) -> float:
    """Return by how much another assumption changes the logarithm of Young's modulus of a zone.

    Of logarithms alone: where one cell is all that is known, to first order the factor that it tells may change beyond all numbers.
    """
    k = len(theta) // 2
    after, before = (np.log(young_and_poisson(np.array([0.0, t[k + zone]]))[0][0]) for t in (other.applied(theta), theta))
    return float(other.theta[zone] + after - before)


def _divided(theta: FloatArray, unit: float) -> FloatArray:
    k = len(theta) // 2
    return np.concatenate([theta[:k] - unit, theta[k:]])


def _in_words(found: FieldEstimate, theta: FloatArray, uncertainty: Uncertainty, others: tuple[Assumption, ...]) -> tuple[str, ...]:
    """Return verdict, how well multiples are determined, and what other assumptions would do."""
    assert found.verdict is not None  # of regions that were fitted without a penalty
    limits = tuple(line for line in found.identifiability if line == TOO_COARSE)
    measure = f"Moduli are multiples of that of {found.zones.names[int(np.argmax(_volumes(found)))]}, the largest region."
    alone = (ONE_MATERIAL,) * (found.zones.count == 1)
    return statement(found.verdict, found.zones, theta, uncertainty, others, limits=limits, measure=(*alone, measure))


def _volumes(found: FieldEstimate) -> FloatArray:
    """Return the volume of every zone (k,), mm^3."""
    volume, unknown = cell_volumes(found.mesh), found.zones.of_cell != KNOWN
    if found.parts is not None:
        return np.asarray(volume @ found.parts)
    return np.asarray(np.bincount(found.zones.of_cell[unknown], volume[unknown], minlength=found.zones.count))


def _without_reference(found: FieldEstimate, cell: int) -> FieldEstimate:
    """Give the cell that was taken as known to the zone of most of its neighbours."""
    pairs, area = inner_faces(found.mesh)
    at = (pairs == cell).any(axis=1)
    beside = pairs[at].sum(axis=1) - cell
    zone = int(np.argmax(np.bincount(found.zones.of_cell[beside], area[at])))
    of_cell = found.zones.of_cell.copy()
    of_cell[cell] = zone
    nothing = np.full(found.mesh.n_cells, np.nan)
    zones = replace(found.zones, of_cell=of_cell, known_lambda=nothing, known_mu=nothing.copy(), known=(), region_of_cell=None)
    parts = found.parts
    if parts is not None:
        parts = parts.copy()
        parts[cell] = np.eye(found.zones.count)[zone]
    return replace(found, zones=zones, parts=parts)
