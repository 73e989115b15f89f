"""Error indicators and adaptive statics: known errors, rates, and corners."""

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters, material
from naibu.mechanics.finite_elements.linear_simplices import simplices
from naibu.meshing.primitives import box
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.structured_2d import rectangle
from naibu.simulation.adaptive.conditions import Conditions, face_force, weight
from naibu.simulation.adaptive.error_criterion import StressError
from naibu.simulation.adaptive.error_estimator import recovery_indicators, residual_indicators
from naibu.simulation.adaptive.statics import hyperelastic_static, linear_static, solve_adaptively

E_KPA, NU = 10.0, 0.3
LAME, MU = lame_parameters(E_KPA, NU)


def bent(points, curvature=0.01):
    """Displacement of a bar in pure bending, an exact solution with a linear stress."""
    x, y, z = points.T
    return curvature * np.stack([x * z, -NU * y * z, -0.5 * (x**2 - NU * y**2 + NU * z**2)], axis=1)


def stresses(mesh, displacement):
    gradient = simplices(mesh).displacement_gradients(displacement)
    strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    return 2 * MU * strain + LAME * np.einsum("mii->m", strain)[:, None, None] * np.eye(mesh.dimension)


def true_errors(mesh, stress, curvature=0.01):
    """Exact errors of the cells in the norm of the indicators; the error is linear in every cell."""
    gap = -stress[:, None].repeat(4, axis=1)
    gap[:, :, 0, 0] += E_KPA * curvature * mesh.points[mesh.cells][:, :, 2]
    gap = gap.reshape(len(stress), 4, 9)
    squares = (gap**2).sum(axis=(1, 2)) + (gap.sum(axis=1) ** 2).sum(axis=1)
    return np.sqrt(simplices(mesh).measures * squares / 20 / (2 * MU))


def test_indicators_know_the_true_error_and_its_rate():
    forest = BisectionForest.of(box((4, 2, 2), (4, 2, 2), cell_type="tetra"))
    totals = []
    for _ in range(3):
        mesh = forest.leaf_mesh().mesh
        stress = stresses(mesh, bent(mesh.points))
        errors = [true_errors(mesh, stress), recovery_indicators(mesh, stress, MU), residual_indicators(mesh, stress, MU)]
        totals.append([np.linalg.norm(e) for e in errors])
        for _ in range(3):
            forest.refine(forest.leaves())
    true, recovered, residual = np.array(totals).T
    assert (recovered / true > 0.6).all() and (recovered / true < 1.3).all()
    assert true[1:] / true[:-1] == pytest.approx(0.5, abs=0.02)
    assert recovered[1:] / recovered[:-1] == pytest.approx(0.5, abs=0.1)
    assert residual[1:] / residual[:-1] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("mesh", [box((2, 1, 1), (2, 2, 2), cell_type="tetra"), rectangle((2, 1), (3, 2))], ids=["solid", "plane"])
def test_constant_stress_has_no_error(mesh):
    stress = stresses(mesh, mesh.points @ np.random.default_rng(0).normal(size=(mesh.dimension,) * 2))
    for indicators in (recovery_indicators, residual_indicators):
        assert indicators(mesh, stress, MU) == pytest.approx(0.0, abs=1e-9)
    assert residual_indicators(mesh, stress, MU, 1.0).min() > 0
    with pytest.raises(InputError, match="shape"):
        recovery_indicators(mesh, stress[1:], MU)
    with pytest.raises(InputError, match="positive"):
        recovery_indicators(mesh, stress, -1.0)


def test_jumps_of_stress_between_regions_are_no_error():
    plain = box((2, 2, 2), (2, 2, 2), cell_type="tetra")
    regions = (plain.points[plain.cells].mean(axis=1)[:, 2] > plain.points[:, 2].mean()).astype(int)
    mesh = Mesh.from_arrays(plain.points, plain.cells, "tetra", regions=regions, region_names=("soft", "stiff"))
    stress = np.where(regions[:, None, None] == 1, 5.0, 1.0) * np.diag([1.0, 0.0, 0.0])  # side by side under the same stretch
    assert recovery_indicators(mesh, stress, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert residual_indicators(mesh, stress, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert recovery_indicators(plain, stress, 1.0).max() > 0.1


def test_bodies_in_motion_are_refined_by_the_error_of_their_stress():
    forest = BisectionForest.of(box((4, 2, 2), (4, 2, 2), cell_type="tetra"))
    leaf = forest.leaf_mesh()
    points = leaf.mesh.points
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    criterion = StressError(E_KPA, NU, 0.02, 0.01, least=0.02)
    assert criterion.marks(forest, leaf, points @ (turn * np.linalg.det(turn)).T - points).coarsen.all()
    one, two = (criterion.marks(forest, leaf, bent(points, curvature)) for curvature in (1e-4, 1e-2))
    assert one.coarsen.all() and two.refine.sum() > 10 and not (two.refine & two.coarsen).any()
    small = StressError(E_KPA, NU, 0.02, 0.01).marks(forest, leaf, bent(points, 1e-4))
    assert (small.refine != two.refine).sum() <= 2  # without a least norm errors are relative
    with pytest.raises(InputError, match="coarsen_below"):
        StressError(E_KPA, NU, 0.01, 0.02)


def corner():
    """Return an L-shaped plate with its inner corner at the origin."""
    plate = rectangle((4, 4), (4, 4))
    points = plate.points - plate.points.mean(axis=0)
    centre = points[plate.cells].mean(axis=1)
    cells = plate.cells[~((centre[:, 0] > 0) & (centre[:, 1] > 0))]
    used, number = np.unique(cells, return_inverse=True)
    return Mesh.from_arrays(points[used], number.reshape(cells.shape), "triangle")


def test_a_corner_is_resolved_with_fewer_unknowns_than_by_uniform_refinement():
    conditions = Conditions(lambda p: p[:, 0] < -2 + 1e-9, loads=(weight((0.0, -100.0)),))
    solve_on = linear_static(conditions, young_modulus=E_KPA, poisson_ratio=NU, density=1e-3)
    adaptive = solve_adaptively(corner(), solve_on, tolerance=0.0, max_unknowns=6000)
    uniform = solve_adaptively(corner(), solve_on, tolerance=0.0, max_unknowns=6000, fraction=1.0, bisections=2)
    fine = solve_adaptively(corner(), solve_on, tolerance=0.0, max_unknowns=40_000, fraction=0.4).result.energy
    errors = [np.sqrt(fine - np.array([r.energy for r in s.rounds])) for s in (adaptive, uniform)]
    assert (np.diff([r.energy for r in uniform.rounds]) > 0).all()  # nested spaces
    rate = np.log(errors[0][-1] / errors[0][4]) / np.log(adaptive.unknowns[-1] / adaptive.unknowns[4])
    assert rate == pytest.approx(-0.5, abs=0.1)  # optimal for linear elements
    equal = np.interp(np.log(uniform.unknowns[-1]), np.log(adaptive.unknowns), errors[0])
    assert equal < 0.7 * errors[1][-1]
    centre = adaptive.leaf.mesh.points[adaptive.leaf.mesh.cells].mean(axis=1)
    finest = adaptive.forest.levels[adaptive.leaf.cells].argmax()
    assert min(np.linalg.norm(centre[finest] - at) for at in ([0, 0], [-2, 2], [-2, -2])) < 0.2
    # the estimate is within a factor of two of the error of the energy norm
    estimated = adaptive.result.relative_error
    assert 0.5 < estimated / (errors[0][-1] / np.sqrt(fine)) < 2.0


def test_tolerance_and_levels_end_the_refinement():
    conditions = Conditions(lambda p: p[:, 0] < -2 + 1e-9, loads=(weight((0.0, -100.0)),))
    solve_on = linear_static(conditions, young_modulus=E_KPA, poisson_ratio=NU, density=1e-3)
    found = solve_adaptively(corner(), solve_on, tolerance=0.3)
    assert found.result.relative_error <= 0.3 < found.rounds[-2].relative_error
    shallow = solve_adaptively(corner(), solve_on, tolerance=0.0, fraction=1.0, max_level=1)
    assert set(shallow.forest.levels[shallow.leaf.cells]) == {1}
    with pytest.raises(InputError, match="tolerance"):
        solve_adaptively(corner(), solve_on, tolerance=-1.0)


def test_hyperelastic_statics_agree_with_linear_ones_at_small_strain():
    start = box((20, 10, 10), (2, 1, 1), cell_type="tetra", centred=False)
    pull = face_force(lambda p: p[:, 0] > 20 - 1e-9, (0.0, 0.0, -0.2))
    conditions = Conditions(lambda p: p[:, 0] < 1e-9, loads=(pull,))
    linear = solve_adaptively(start, linear_static(conditions, young_modulus=E_KPA, poisson_ratio=NU), tolerance=0.0, max_unknowns=100)
    law = material("neo_hookean", young_modulus=E_KPA, poisson_ratio=NU)
    bent_block = solve_adaptively(start, hyperelastic_static(conditions, [law]), tolerance=0.0, max_unknowns=100)
    assert bent_block.unknowns == linear.unknowns
    assert bent_block.result.displacement == pytest.approx(linear.result.displacement, abs=0.01 * np.abs(linear.result.displacement).max())
    assert bent_block.result.energy == pytest.approx(linear.result.energy, rel=0.01)
    assert bent_block.result.relative_error == pytest.approx(linear.result.relative_error, rel=0.05)
