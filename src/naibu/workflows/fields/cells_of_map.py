"""How many cubes a map of moduli has: as many as points, or fewer, where noise would strain smaller ones more than the body is strained.

The surface of the model follows the measurement, and its noise with it. Where that strains a cube by a large part of what loads do, cubes
tell nothing of moduli one by one, and those at the surface of a nearly incompressible body find no equilibrium: searches then advance by
small parts of a step, for hours. Of n points in a cube of edge h whose displacements have a standard deviation s, the gradient has one of
``sqrt(12 / n) s / h`` along an axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from naibu.core.mesh import Mesh
from naibu.identification.from_fields.assumptions.assumed_law import equivalent_strain
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.representation_error import nearest_interpolated
from naibu.workflows.fields.object_on_cubes import ObjectOnCubes, ScannedObject

CELLS_OF_MAP = 2500  # of the model by default, where points are as many: finer cells than these are apart show nothing more
LEAST_OF_MAP = 700  # cells, since maps of some hundred are searched with the whole Hessian, which takes longer
FEWEST = 64  # cells whatever the noise; and those in which the strain of the body is found, as noise hardly strains so large ones
NOISE_OF_STRAIN = 0.5  # largest standard deviation of strain in a cell, of its root mean square in the body
WORTHWHILE = 0.85  # of the number of cells: fewer by less change nothing
COARSER = (
    "The map has {} elements of {:.3g} mm instead of {}: noise of {:.2g} mm would strain smaller ones by more than half of what the loads "
    "do. More points or less noise would show more of the body."
)


def cubes_of_map(scanned: ScannedObject, points: int, edge_mm: float = 0.0) -> tuple[ObjectOnCubes, tuple[str, ...]]:
    """Return the object on the cubes of a map, and in words where noise makes those that it has by default larger.

    Parameters
    ----------
    scanned : ScannedObject
        The object.
    points : int
        Measurements in the field that has most.
    edge_mm : float
        Of the cubes; 0 chooses it.
    """
    if edge_mm:
        return scanned.on_cubes(edge_mm, (), exactly=True, each_cell=True), ()
    usual = min(CELLS_OF_MAP, max(LEAST_OF_MAP, points))
    cubes = scanned.on_cubes(scanned.edge_mm(usual), (), exactly=False, each_cell=True)
    whole = replace(scanned, labels=(scanned.inside.values != 0).astype(np.int64), names={1: "body"})
    fewer, large = (whole.on_cubes(scanned.edge_mm(n), (), exactly=True, each_cell=True) for n in (LEAST_OF_MAP, FEWEST))
    edges = [edge_of_noise(*cases, large.mesh, scanned.volume_mm3) for cases in zip(fewer.load_cases, large.load_cases, strict=True)]
    clearest = int(np.argmin(edges))
    edge = max(edges[clearest], 1e-300)
    if scanned.volume_mm3 / edge**3 > WORTHWHILE * cubes.mesh.n_cells:
        return cubes, ()
    size = min(edge, scanned.edge_mm(FEWEST))
    larger = scanned.on_cubes(size, (), exactly=False, each_cell=True)
    return larger, (COARSER.format(larger.mesh.n_cells, size, cubes.mesh.n_cells, noise_mm(fewer.load_cases[clearest])),)


def noise_mm(case: FieldLoadCase) -> float:
    """Return the root mean square standard deviation of a component of the measurements, mm; 0 where none is known."""
    field = case.field
    return 0.0 if field.covariance is None else float(np.sqrt(np.trace(field.covariance[field.valid], axis1=1, axis2=2).mean() / 3.0))


def edge_of_noise(case: FieldLoadCase, on_large: FieldLoadCase, large: Mesh, volume_mm3: float) -> float:
    """Return the edge, mm, of cells in which noise strains by `NOISE_OF_STRAIN` of what loads do.

    Parameters
    ----------
    case : FieldLoadCase
        Measurements with the noise that counts, also where none is stated: found in cells of several points.
    on_large : FieldLoadCase
        The same for a mesh of so large cells that noise hardly strains them.
    large : Mesh
        That mesh.
    volume_mm3 : float
        Of the body.
    """
    strain = equivalent_strain(large, nearest_interpolated(large, on_large.field))
    of_edge = np.sqrt(12.0 * volume_mm3 / max(int(case.field.valid.sum()), 1)) * noise_mm(case)
    return float((of_edge / max(NOISE_OF_STRAIN * strain, 1e-300)) ** 0.4)
