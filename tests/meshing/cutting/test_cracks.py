"""Cuts open as linear elastic fracture mechanics and beam theory say (plane strain; Poisson's ratio 0 unless told)."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics import LinearBody, PrescribedDisplacement
from naibu.meshing import box_from_coordinates, cut_volume, node_areas, nodes_on_plane, swept_blade
from naibu.meshing.surface import boundary_faces

E = 100.0  # kPa


def solved(mesh: Mesh, held: np.ndarray, force: FloatArray, ratio: float = 0.0) -> FloatArray:
    """Displacement without any motion along y; `held` (n, 3) are further constraints."""
    constrained = held | np.array([False, True, False])
    zero = np.zeros(mesh.points.shape)
    prescribed = PrescribedDisplacement(constrained, zero, zero)
    shear = 0.5 * E / (1.0 + ratio)
    return LinearBody.of(mesh).solve(2.0 * ratio / (1.0 - 2.0 * ratio) * shear, shear, prescribed, force)


def straight_cut(mesh: Mesh, x: tuple[float, float], z: float) -> Mesh:
    """Cut a plate of the x-z plane along a line of its mesh."""
    edges = np.stack([[[v, -5.0, z], [v, 5.0, z]] for v in np.linspace(*x, 4)])
    cut = cut_volume(mesh, swept_blade(edges), 0.4)
    assert cut.deviation_mm < 1e-9
    assert cut.n_pieces == 1
    return cut.mesh


HALF_WIDTH, HALF_CRACK, STRESS = 20.0, 8.0, 1.0


def crack_opening(plate: Mesh) -> FloatArray:
    """Displacement of a strip under tension of its ends at z = +-60 mm."""
    force = np.zeros(plate.points.shape)
    for sign in (-1.0, 1.0):
        ends = nodes_on_plane(plate, (0.0, 0.0, sign * 60.0), (0.0, 0.0, 1.0))
        faces = boundary_faces(plate).faces
        force[:, 2] += sign * STRESS * node_areas(plate, faces[np.isin(faces, ends).all(axis=1)])
    held = np.zeros(plate.points.shape, dtype=bool)
    corner = np.argmin(np.abs(plate.points - [-HALF_WIDTH, 0.0, -60.0]).sum(axis=1))
    other = np.argmin(np.abs(plate.points - [HALF_WIDTH, 0.0, -60.0]).sum(axis=1))
    held[corner, [0, 2]] = held[other, 2] = True
    return solved(plate, held, force)


def expected_opening() -> float:
    """Opening in the middle of a crack in a strip of finite width (Tada, Paris, Irwin)."""
    ratio = HALF_CRACK / HALF_WIDTH
    width = -0.071 - 0.535 * ratio + 0.169 * ratio**2 + 0.020 * ratio**3 - 1.071 / ratio * np.log(1.0 - ratio)
    return float(4.0 * STRESS * HALF_CRACK / E * width)


def test_a_centre_crack_in_a_strip_under_tension_opens_as_fracture_mechanics_says() -> None:
    half = np.concatenate([np.arange(0.0, 2.01, 0.25), np.geomspace(2.4, 60.0, 16)])
    across = np.concatenate([np.arange(0.0, 5.0, 1.0), np.arange(5.0, 10.51, 0.25), np.arange(11.0, 20.1, 0.75)])
    heights, widths = (np.concatenate([-values[:0:-1], values]) for values in (half, across))
    plate = straight_cut(box_from_coordinates(widths, [-0.5, 0.5], heights, cell_type="tetra"), (-HALF_CRACK, HALF_CRACK), 0.0)
    middle = np.flatnonzero(np.abs(plate.points[:, [0, 2]]).max(axis=1) < 1e-9)
    assert len(middle) == 4  # two nodes across y, on each side of the crack
    assert np.ptp(crack_opening(plate)[middle, 2]) == pytest.approx(expected_opening(), rel=0.03)


@pytest.mark.parametrize(("angle", "irregular"), [(0.0, 0.0), (0.5, 0.1), (1.2, 0.1)])
def test_so_does_a_crack_that_the_blade_cuts_through_cells(angle: float, irregular: float) -> None:
    """Whatever the direction of the blade, and on a mesh whose nodes are moved at random by a fifth of an edge."""
    widths = np.arange(-HALF_WIDTH, HALF_WIDTH + 0.01, 0.5)
    far = np.geomspace(9.0, 60.0, 10)
    mesh = box_from_coordinates(widths, [-0.5, 0.5], np.concatenate([-far[::-1], np.arange(-8.0, 8.01, 0.5), far]), cell_type="tetra")
    inner = (np.abs(mesh.points) < [HALF_WIDTH - 0.1, 0.0, 59.9]) * irregular  # not along y
    moved = mesh.points.copy()
    half = len(widths) * (len(far) * 2 + 33)  # nodes of each side along y, moved alike
    for side in (-0.5, 0.5):
        on = np.flatnonzero(mesh.points[:, 1] == side)
        assert len(on) == half
        moved[on] += inner[on] * np.random.default_rng(5).uniform(-1.0, 1.0, (half, 3))
    turn = rotation_matrix(np.array([0.0, angle, 0.0]))
    edges = np.stack([[[x, -5.0, 0.185], [x, 5.0, 0.185]] for x in np.linspace(-HALF_CRACK, HALF_CRACK, 4)])
    cut = cut_volume(Mesh.from_arrays(moved @ turn.T, mesh.cells, "tetra"), swept_blade(edges @ turn.T), 0.125)
    assert cut.forest.n_cells > mesh.n_cells and cut.n_pieces == 1
    first, second = np.flatnonzero(np.bincount(cut.source)[cut.source] == 2).reshape(2, -1)  # copies follow, in the order of their nodes
    second = second[np.argsort(cut.source[second])]
    np.testing.assert_array_equal(cut.source[first], cut.source[second])
    back = cut.mesh.points @ turn
    u = crack_opening(Mesh.from_arrays(back, cut.mesh.cells, "tetra"))
    opening = np.abs(u[first, 2] - u[second, 2])
    assert opening[np.abs(back[first, 0]) < 1.0].max() == pytest.approx(expected_opening(), rel=0.03)


@pytest.mark.parametrize(
    ("length", "arm", "ratio", "offset", "irregular", "angle", "distance"),
    [
        (25.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.4),
        (40.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.4),
        (60.0, 4.0, 0.0, 0.0, 0.25, 0.7, 0.25),
        (40.0, 2.5, 0.0, 0.0, 0.25, -1.2, 0.2),
        (25.0, 4.0, 0.0, 0.13, 0.25, 0.0, 0.3),
        (60.0, 4.0, 0.0, 0.13, 0.25, 0.4, 0.15),
        (40.0, 4.0, 0.0, -1.0, 0.25, -0.4, 0.25),
        (30.0, 4.0, 0.3, 0.0, 0.0, 0.0, 0.25),
        (40.0, 2.5, 0.3, -0.6, 0.25, 0.7, 0.2),
    ],
)
def test_the_compliance_of_a_double_cantilever_beam_grows_with_its_crack(
    length: float, arm: float, ratio: float, offset: float, irregular: float, angle: float, distance: float
) -> None:
    """Of arms that are alike or not, along faces of the mesh or through its cells, on cells moved at random, in any direction."""
    mesh = beam_mesh(length + 10.0 * arm, arm, arm / 16.0, irregular)
    turn = rotation_matrix(np.array([0.0, angle, 0.0]))
    edges = np.stack([[[x, -5.0, offset], [x, 5.0, offset]] for x in np.linspace(-1.0, length, 4)])
    cut = cut_volume(Mesh.from_arrays(mesh.points @ turn.T, mesh.cells, "tetra"), swept_blade(edges @ turn.T), distance)
    assert cut.n_pieces == 1 and cut.deviation_mm <= 0.5 * distance
    beam = Mesh.from_arrays(cut.mesh.points @ turn, cut.mesh.cells, "tetra")
    force = np.zeros(beam.points.shape)
    for sign in (-1.0, 1.0):
        tip = np.flatnonzero((beam.points[:, 0] < 1e-9) & (np.abs(beam.points[:, 2] - sign * arm) < 1e-9))
        force[tip, 2] = sign / len(tip)
    held = np.zeros(beam.points.shape, dtype=bool)
    held[nodes_on_plane(beam, (length + 10.0 * arm, 0.0, 0.0), (1.0, 0.0, 0.0))[:, None], [0, 2]] = True
    u = solved(beam, held, force, ratio)
    opening = 2.0 * np.abs(u[force[:, 2] != 0.0, 2]).mean()
    assert opening == pytest.approx(sum(compliance(length, a, ratio) for a in (arm - offset, arm + offset)), rel=0.03)


def beam_mesh(length: float, arm: float, edge: float, irregular: float) -> Mesh:
    """Return a beam of cells of an edge, whose inner nodes are moved at random by a part of it, alike on both sides."""
    x, z = np.linspace(0.0, length, round(0.8 * length / edge) + 1), np.linspace(-arm, arm, 2 * round(arm / edge) + 1)
    mesh = box_from_coordinates(x, [-0.5, 0.5], z, cell_type="tetra")
    points = mesh.points.copy()
    inner = (points[:, 0] > 1e-9) & (points[:, 0] < length - 1e-9) & (np.abs(points[:, 2]) < arm - 1e-9)
    for side in (-0.5, 0.5):
        on = np.flatnonzero(mesh.points[:, 1] == side)
        moved = irregular * edge * np.random.default_rng(5).uniform(-1.0, 1.0, (len(on), 3)) * [1.0, 0.0, 1.0]
        points[on] += moved * inner[on, None]
    return Mesh.from_arrays(points, mesh.cells, "tetra")


def compliance(length: float, arm: float, ratio: float) -> float:
    """Deflection of an arm of unit width by a unit force in plane strain: a cantilever that is longer by its root's rotation and shear.

    This is the corrected beam theory of Williams (1989) and of ISO 15024.
    """
    plane, shear = E / (1.0 - ratio**2), E / (2.0 * (1.0 + ratio))
    gamma = 1.18 * plane / shear
    chi = np.sqrt(plane / (11.0 * shear) * (3.0 - 2.0 * (gamma / (1.0 + gamma)) ** 2))
    return float(4.0 * (length + chi * arm) ** 3 / (plane * arm**3))
