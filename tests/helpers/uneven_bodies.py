"""Uneven bodies of quadratic hexahedra, and their displacements at points that are no nodes, with noise."""

from __future__ import annotations

from functools import cache

import numpy as np

from naibu.core.mesh import Mesh
from naibu.validation.specimens.quadratic_body import Inclusion, QuadraticBody

NOISE = 0.01  # of the largest displacement
TWO = (Inclusion((10.0, 20.0, 20.0), 8.0, 100.0, 0.3), Inclusion((30.0, 22.0, 18.0), 9.0, 0.5, 0.49))
BODIES = {
    "alike": QuadraticBody("cube", (10.0, 0.47), (10.0, 0.47)),
    "layers": QuadraticBody("cube", (5.0, 0.3), (500.0, 0.3)),
    "soft below": QuadraticBody("cube", (1.0, 0.499), (100.0, 0.3)),
    "stiff lump": QuadraticBody("cube", (10.0, 0.45), (10.0, 0.45), (Inclusion((18.0, 22.0, 19.0), 11.0, 1000.0, 0.3),)),
    "soft lump": QuadraticBody("cube", (10.0, 0.3), (10.0, 0.3), (Inclusion((18.0, 22.0, 19.0), 11.0, 0.5, 0.3),)),
    "lumps": QuadraticBody("cube", (10.0, 0.499), (20.0, 0.4), TWO),
    "sponge": QuadraticBody("cube", (10.0, 0.05), (10.0, 0.05)),
    "barrel": QuadraticBody("barrel", (5.0, 0.45), (10.0, 0.4)),
    "tapered": QuadraticBody("tapered", (5.0, 0.49), (100.0, 0.4)),
}


@cache
def field_of(name: str, push: tuple[float, float, float], count: int = 1000) -> tuple[Mesh, np.ndarray, np.ndarray, np.ndarray]:
    """A coarse mesh, which of its nodes are loaded, and measured points with displacements."""
    mesh, loaded = BODIES[name].model(6, "hexahedron")
    rng = np.random.default_rng(7)
    points, u = BODIES[name].solved(push, divisions=4).at(rng.uniform(0.02, 0.98, (count, 3)))
    return mesh, loaded, points, u + NOISE * np.abs(u).max() * rng.standard_normal(u.shape)
