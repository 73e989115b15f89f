"""Gain and offset between volumes: normal equations by the matrix of trilinear hat functions, written out."""

from __future__ import annotations

import numpy as np

from naibu.imaging.volume_correlation.image_level import GainMap, ImageLevel

SPACING = np.array([0.8, 1.0, 1.3])


def test_normal_equations_are_those_of_least_squares() -> None:
    """Hat functions are linear interpolations of unit vectors; the object has a hole, and some voxels are not seen or count nothing."""
    rng, shape = np.random.default_rng(0), (9, 11, 14)
    mask = np.zeros(shape, dtype=bool)
    mask[1:-1, 2:-1, 1:-2] = True
    mask[4, 4:7] = False
    images = rng.standard_normal((2, *shape)).astype(np.float32)
    level = ImageLevel(images[0], images[1], mask, SPACING, (1, 1, 1), 0.0)
    lattice = GainMap(level, 4.0)
    n = len(level.intensity)
    value, weight = rng.standard_normal(n).astype(np.float32), rng.random(n).astype(np.float32)
    value[rng.random(n) < 0.1] = -1e30
    weight[rng.random(n) < 0.1] = 0.0
    assert lattice.n.min() > 2 and lattice.n.prod() < n
    lines = [
        np.stack([np.interp((level.index[:, a] - lattice.low[a]) / lattice.step[a], np.arange(k), unit) for unit in np.eye(k)], axis=1)
        for a, k in enumerate(lattice.n)
    ]
    hats = np.einsum("nz,ny,nx->nzyx", *lines[::-1]).reshape(n, -1)
    seen = (value > -1e29) * weight.astype(float)
    both = np.stack([hats * np.where(seen > 0.0, value, 0.0)[:, None], hats], axis=2).reshape(n, -1)
    matrix, load = lattice.normal_equations(value, weight)
    np.testing.assert_allclose(matrix, both.T @ (seen[:, None] * both), atol=1e-5)
    intensity = level.intensity.astype(float)
    products = np.stack([np.where(seen > 0.0, value, 0.0) * intensity, intensity, intensity**2], axis=1)
    np.testing.assert_allclose(load, hats.T @ (seen[:, None] * products), atol=1e-5)
