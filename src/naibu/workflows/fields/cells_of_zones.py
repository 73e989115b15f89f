"""How many cubes an object of uniform zones has: as many as measurements can tell from the motion of its surface, up to a usual number."""

from __future__ import annotations

from naibu.workflows.fields.block_mesh import CELLS
from naibu.workflows.fields.known_zones import KnownZones
from naibu.workflows.fields.object_on_cubes import ObjectOnCubes, ScannedObject

POINTS_OF_CELL, LEAST_CELLS = 2, 64  # cells with fewer points leave to the motion of the surface what zones of uniform moduli would tell


def cubes_of_zones(scanned: ScannedObject, points: int, element_size_mm: float, stated: KnownZones) -> tuple[ObjectOnCubes, KnownZones]:
    """Return an object without its thin coverings on cubes, and what is known of the rest.

    Parameters
    ----------
    scanned : ScannedObject
        The object.
    points : int
        Measurements in the field that has most.
    element_size_mm : float
        Edge length of the cubes; 0 chooses it.
    stated : KnownZones
        Moduli that are known.
    """
    exactly, names = element_size_mm > 0.0, set(scanned.names.values())
    number = max(min(CELLS, points // POINTS_OF_CELL), LEAST_CELLS)
    size, sought = element_size_mm or scanned.edge_mm(number), names - set(stated.values)
    kept = scanned.without_thin_coverings(size, sought, exactly=exactly, known=stated.not_rigid)
    left = set(kept.names.values())
    size = element_size_mm or kept.edge_mm(number)
    return kept.on_cubes(size, sought & left, exactly=exactly, each_cell=False), stated.without(names - left)
