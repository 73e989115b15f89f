"""Opening of cuts under tension: linear elasticity of a crack, and what it means to be joined, supported and loose."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.meshing import cut_surface
from naibu.simulation import opened, opening, surface_springs


def equilateral(size: float):
    """Return a hexagonal sheet of equilateral triangles of edge 1, the edges of one direction along x."""
    n = round(size)
    i, j = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij")
    keep = np.abs(i + j) <= n
    number = np.where(keep, np.cumsum(keep).reshape(keep.shape) - 1, -1)
    points = np.stack([(i + 0.5 * j)[keep], (np.sqrt(0.75) * j)[keep], np.zeros(keep.sum())], axis=1)
    up = np.stack([number[:-1, :-1], number[1:, :-1], number[:-1, 1:]], axis=-1).reshape(-1, 3)
    down = np.stack([number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 3)
    triangles = np.concatenate([up, down])
    return points, triangles[(triangles >= 0).all(axis=1)]


def test_a_crack_opens_as_linear_elasticity_says():
    # the springs of the formula make a sheet of modulus E and Poisson's ratio 1/3, in which strain t is stress 1.5 E t;
    # in an infinite sheet a crack of length 2 a opens by 4 a stress / E in its middle
    points, triangles = equilateral(82.0)
    half, tension = 12.0, 1e-3
    cut = cut_surface(points, triangles, [[-half, 0, 0], [half, 0, 0]], 2.1)
    assert cut.deviation_mm < 1e-9 and len(cut.triangles) == len(triangles)
    springs = surface_springs(cut.points, cut.triangles, membrane_modulus=50.0, area_density=1e-6)
    copies = np.flatnonzero(cut.source != np.arange(len(cut.points)))
    assert len(copies) == 2 * half - 1
    gaps = []
    for radius in (35.0, 70.0):
        held = np.linalg.norm(cut.points, axis=1) > radius
        moved = opened(cut, springs, tension, held, normals=np.tile([0.0, 0.0, 1.0], (len(held), 1)))
        gaps.append(np.abs(moved[copies, 1] - moved[cut.source[copies], 1]))
    infinite = gaps[1] + (gaps[1] - gaps[0]) / 3.0  # the effect of the hold falls with the square of its radius
    ellipse = 6.0 * tension * np.sqrt(half**2 - cut.points[copies, 0] ** 2)
    assert infinite.max() == pytest.approx(ellipse.max(), rel=0.04)
    np.testing.assert_allclose(infinite, ellipse, atol=0.075 * ellipse.max())


def test_the_cut_opens_behind_the_tool_and_ends_as_it_rests():
    points, triangles = equilateral(20.0)
    cut = cut_surface(points, triangles, [[-6, 0, 0], [6, 0, 0]], 2.1)
    states = list(opening(cut, 0.05, frames=4))
    copies = np.flatnonzero(cut.source != np.arange(len(cut.points)))
    gap = np.array([np.linalg.norm(u[copies] - u[cut.source[copies]], axis=1) for u in states])
    assert len(states) == 5
    np.testing.assert_allclose(states[0], 0.0, atol=1e-6)  # before the cut the sheet is in balance
    at = cut.points[copies, 0]
    half = gap[2]
    assert half[at < -1.0].min() > 0.0 and half[at > 1.0].max() == 0.0
    assert (np.diff(gap.max(axis=1)) > 0.0).all()
    far = np.linalg.norm(cut.points, axis=1) > 19.0
    assert not states[-1][far].any()


def test_a_supported_sheet_moves_as_one_whose_heights_are_held():
    points, triangles = equilateral(8.0)
    cut = cut_surface(points, triangles, [[-3, 0, 0], [3, 0, 0]], 2.1)
    springs = surface_springs(cut.points, cut.triangles, membrane_modulus=50.0, area_density=1e-6)
    rim = np.linalg.norm(cut.points, axis=1) > 6.5
    flat = np.repeat(rim[:, None], 3, axis=1)
    flat[:, 2] = True
    supported = opened(cut, springs, 0.1, rim, normals=cut.normals)
    np.testing.assert_allclose(supported, opened(cut, springs, 0.1, flat), atol=1e-6)
    with pytest.raises(InputError, match="hold all coordinates"):
        opened(cut, springs, 0.1, flat, normals=cut.normals)
    with pytest.raises(InputError, match="one row for each"):
        opened(cut, springs, 0.1, rim, joined=[0, 1])


def test_a_piece_that_falls_out_contracts_to_its_length_at_rest():
    points, triangles = equilateral(20.0)
    a = np.linspace(0.0, 2.0 * np.pi, 25)
    cut = cut_surface(points, triangles, np.stack([5 * np.cos(a), 5 * np.sin(a), 0 * a], axis=1), 1.5)
    assert cut.n_pieces == 2
    last = list(opening(cut, 0.1, frames=2))[-1]
    inner = np.unique(cut.triangles[cut.piece == 1])
    np.testing.assert_allclose(
        last[inner] - last[inner].mean(axis=0), -0.1 * (cut.points - cut.points[inner].mean(axis=0))[inner], atol=1e-9
    )
    with pytest.raises(InputError, match="tension"):
        next(opening(cut, 0.95))
    with pytest.raises(InputError, match="free_mm"):
        next(opening(cut, 0.1, free_mm=0.0))
