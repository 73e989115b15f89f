"""Displacement of blocks of voxels against the exact one of a virtual ball: no bias, errors as stated and independent of each other."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.validation.specimens.textured_sphere import squeezed_ball


def test_errors_of_blocks_are_as_stated_and_independent() -> None:
    ball = squeezed_ball(seed=4, noise=6.0)
    found = correlate_volumes(ball.before, ball.after, mask=ball.mask)
    blocks = found.blocks
    assert blocks is not None and blocks.covariance is not None and blocks.valid.all() and len(blocks.points) > 500
    at = ball.before.to_index(blocks.points)[:, ::-1].T
    truth = np.stack([map_coordinates(ball.displacement[..., a], at, order=1) for a in range(3)], axis=1)
    values, vectors = np.linalg.eigh(blocks.covariance)
    error = np.einsum("nik,ni->nk", vectors, blocks.vectors - truth) / np.sqrt(values)
    assert 0.6 < np.median(np.abs(error)) / 0.6745 < 1.3
    assert np.abs(error.mean(axis=0)).max() < 0.15
    plain = (blocks.vectors - truth) / np.sqrt(np.einsum("nii->ni", blocks.covariance))
    pairs = cKDTree(blocks.points).query_pairs(1.5 * float(np.cbrt(ball.mask.sum() * 4.5 / len(blocks.points))), output_type="ndarray")
    trimmed = np.clip(plain, -4.0, 4.0)
    assert abs(float((trimmed[pairs[:, 0]] * trimmed[pairs[:, 1]]).mean())) < 0.25 * float((trimmed**2).mean())
