"""Springs of surfaces: closed forms, and cuts that open by what the tension held."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.meshing import SurfaceCutter, cut_surface
from naibu.simulation import CutSprings, opened, surface_springs

LENGTH, WIDTH, TENSION = 40.0, 20.0, 0.1


def strip():
    x, y = np.meshgrid(np.linspace(0, LENGTH, 9), np.linspace(0, WIDTH, 5), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    i = np.arange(45).reshape(9, 5)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def springs_of(cut):
    return surface_springs(cut.points, cut.triangles, membrane_modulus=50.0, area_density=1e-6)


def test_two_triangles_have_the_masses_and_springs_of_the_formulas():
    points = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0.0]])
    springs = surface_springs(points, np.array([[0, 1, 2], [0, 2, 3]]), membrane_modulus=50.0, area_density=2e-6)
    np.testing.assert_allclose(springs.mass, 2e-6 / 3 * np.array([12.0, 6.0, 12.0, 6.0]))
    stiffness = {tuple(e): k for e, k in zip(springs.edges.tolist(), springs.stiffness, strict=True)}
    assert stiffness == pytest.approx(
        {(0, 1): 50 * 6 / 16, (1, 2): 50 * 6 / 9, (0, 2): 50 * 12 / 25, (2, 3): 50 * 6 / 16, (0, 3): 50 * 6 / 9}
    )
    assert springs.damping[0] == pytest.approx(2 * np.sqrt(50 * 6 / 16 * 2e-6 / 3 * 18))


def test_a_strip_cut_through_opens_by_the_whole_stretch():
    points, triangles = strip()
    cut = cut_surface(points, triangles, [[19, -5, 0], [21, 25, 0]], 3.0)
    springs = springs_of(cut)
    assert springs.mass.sum() == pytest.approx(1e-6 * LENGTH * WIDTH)
    held = np.zeros((len(cut.points), 3), dtype=bool)
    ends = (cut.points[:, 0] < 1e-9) | (cut.points[:, 0] > LENGTH - 1e-9)
    held[ends, 0] = held[:, 2] = True
    moved = opened(cut, springs, TENSION, held)
    roots = cut.roots
    pairs = [(k, roots[k]) for k in np.flatnonzero(roots != np.arange(len(roots)))]
    apart = [abs(moved[a, 0] - moved[b, 0]) for a, b in pairs]
    assert len(pairs) > 5
    np.testing.assert_allclose(apart, TENSION * LENGTH, rtol=1e-3)  # each half is as long as its springs at rest


def test_a_cut_inside_opens_less_and_without_tension_not_at_all():
    points, triangles = strip()
    cut = cut_surface(points, triangles, [[20, 6, 0], [20.3, 14, 0]], 3.0)
    springs = springs_of(cut)
    held = np.zeros((len(cut.points), 3), dtype=bool)
    held[(cut.points[:, 0] < 1e-9) | (cut.points[:, 0] > LENGTH - 1e-9)] = held[:, 2] = True
    copies = np.flatnonzero(cut.roots != np.arange(len(cut.points)))
    gap = [
        np.linalg.norm((moved := opened(cut, springs, t, held))[copies] - moved[cut.roots[copies]], axis=1).max() for t in (0.0, 0.05, 0.1)
    ]
    assert gap[0] == 0.0
    assert 0.0 < gap[1] < gap[2] < TENSION * LENGTH


def test_pieces_that_nothing_holds_are_refused():
    points, triangles = strip()
    cut = cut_surface(points, triangles, [[20, -5, 0], [20.3, 25, 0]], 3.0)
    with pytest.raises(InputError, match="free to drift"):
        opened(cut, springs_of(cut), TENSION, cut.points[:, 0] < 1e-9)
    with pytest.raises(InputError, match="membrane_modulus"):
        surface_springs(points, triangles, membrane_modulus=0.0, area_density=1.0)


@pytest.mark.parametrize("damping", ["ratio", "printed"])
def test_springs_updated_during_a_cut_are_those_of_the_cut_surface(damping):
    points, triangles = strip()
    points[:, 2] = 2.0 * np.sin(0.2 * points[:, 0])
    material = {"membrane_modulus": 50.0, "area_density": 1e-6, "damping": damping, "damping_ratio": 0.7}
    kept = CutSprings(SurfaceCutter(points, triangles, 1.0), **material)
    for x in np.linspace(3.0, 42.0, 200):  # leaves over an edge
        kept.move([x, 10.0 + 5.0 * np.sin(0.3 * x), 2.0 * np.sin(0.2 * x)])
    kept.lift()
    for y in (-2.0, 22.0):  # crosses the first cut
        kept.move([20.0, y, 2.0 * np.sin(4.0)])
    cut = kept.cutter.result()
    kept.update()
    found, batch = kept.springs(), surface_springs(cut.points, cut.triangles, **material)
    order = np.lexsort(found.edges.T[::-1])
    assert len(cut.triangles) > 300
    np.testing.assert_array_equal(found.edges[order], batch.edges)
    for name in ("length", "stiffness", "damping"):
        np.testing.assert_allclose(getattr(found, name)[order], getattr(batch, name), rtol=1e-12)
    np.testing.assert_allclose(found.mass, batch.mass, rtol=1e-12)


def test_arrays_that_grow_during_a_cut_lose_nothing():
    points, triangles = strip()
    kept = CutSprings(SurfaceCutter(points, triangles, 0.04), membrane_modulus=50.0, area_density=1e-6)
    rows = len(kept.cutter.arrays.triangles)
    turn = np.linspace(0.0, 3.0 * np.pi, 40)
    for x, y in np.stack([20.0 + turn * np.cos(turn), 10.0 + turn * np.sin(turn)], axis=1):
        kept.move([x, y, 0.0])
    cut = kept.cutter.result()
    kept.update()
    assert len(cut.triangles) > rows
    assert cut.deviation_mm <= 0.02 and cut.missed_mm == 0.0
    assert cut.areas_mm2.sum() == pytest.approx(LENGTH * WIDTH, rel=1e-12)
    found, batch = kept.springs(), springs_of(cut)
    np.testing.assert_allclose(found.mass, batch.mass, rtol=1e-12)
    np.testing.assert_allclose(found.stiffness[np.lexsort(found.edges.T[::-1])], batch.stiffness, rtol=1e-9)
