"""What cells of half the size change: at finite strain, whatever the surface of the coarse ones does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from naibu.core.arrays import FloatArray as Array
from naibu.core.displacement_field import DisplacementField
from naibu.core.mesh import Mesh
from naibu.identification.from_fields import size_correction
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.forward import forward_model
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, logarithms, moduli_of
from naibu.identification.from_fields.mesh_error import DOUBT, KeptStates, at_least_to, carried_over, changes_on_finer_mesh, doubt_in_all
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters, material
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.primitives import box
from naibu.reproduction.chapter3.bodies import LAYERS, cube
from naibu.validation.specimens.quadratic_body import QuadraticBody

SIDE_MM, CELLS = 40.0, 5
MODULI = {"bone": (150_000.0, 0.3), "muscle": (11.0, 0.45), "skin": (24.0, 0.45)}


def limb(cells: int) -> Mesh:
    """Return a limb with a bone along y, in a skin of 8 mm, of cubes."""
    mesh = box([SIDE_MM] * 3, [cells] * 3, centred=False)
    x, _, z = mesh.points[mesh.cells].mean(axis=1).T - SIDE_MM / 2
    regions = np.where(np.maximum(np.abs(x), np.abs(z)) > 12.0, 2, np.where(np.maximum(np.abs(x), np.abs(z)) < 4.0, 0, 1))
    return Mesh.from_arrays(mesh.points, mesh.cells, "hexahedron", regions=regions, region_names=tuple(MODULI))


def rough_limb(push_mm: float, rough_mm: float) -> tuple[Linearised, Array, Array]:
    """Return a limb of large cells with its surface pushed in and rough, in equilibrium, the logarithms of its moduli, and the surface."""
    mesh = limb(CELLS)
    x, y, z = mesh.points.T
    surface = (np.isclose(mesh.points, 0.0) | np.isclose(mesh.points, SIDE_MM)).any(axis=1)
    moved = rough_mm * np.random.default_rng(0).standard_normal(mesh.points.shape)
    moved[:, 2] -= push_mm * np.exp(-((x - 20.0) ** 2 + (y - 20.0) ** 2) / 128.0) * (z / SIDE_MM) ** 2
    loaded = np.repeat(surface[:, None], 3, axis=1)
    points = np.random.default_rng(1).uniform(1.0, SIDE_MM - 1.0, (300, 3))
    field = DisplacementField.from_arrays(points, np.ones_like(points), sd_mm=0.1)
    zones = Zones.of(mesh, known={"bone": MODULI["bone"]})
    theta = logarithms(*(np.array(v) for v in zip(*(lame_parameters(*MODULI[name]) for name in zones.names), strict=True)))
    model = FieldModel(mesh, [FieldLoadCase.of("push", field, mesh, loaded=loaded)], zones, "neo_hookean", "accurate")
    (start,) = model.from_rest(theta, [moved])
    return model.linearised(model.evaluate(theta, [np.where(loaded, moved, start)])), theta, moved


@pytest.mark.parametrize(("push_mm", "rough_mm"), [(10.0, 0.0), (14.0, 0.3), (17.0, 0.3)])
def test_what_half_the_size_changes_is_that_of_an_equilibrium_reached_from_rest(push_mm: float, rough_mm: float) -> None:
    """From the state of large cells, Newton's method on small ones needs patience with the second surface, and fails with the third."""
    at, theta, moved = rough_limb(push_mm, rough_mm)
    found = changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, theta))
    assert found is not None and found[1] == "neo_hookean"

    mesh, fine, points, state = at.model.mesh, limb(2 * CELLS), at.model.observed[0].points, at.point.states[0]
    materials = [material("neo_hookean", young_modulus=e, poisson_ratio=nu) for e, nu in MODULI.values()]
    body = Assembler.from_materials(elements(fine, "mean_dilatation"), fine.regions, materials)
    outside = (np.isclose(fine.points, 0.0) | np.isclose(fine.points, SIDE_MM)).any(axis=1)
    values = np.where(outside[:, None], interpolation_operator(mesh, fine.points) @ moved, 0.0)
    held = PrescribedDisplacement(np.repeat(outside[:, None], 3, axis=1), values)
    problem = Problem(fine.points, body, (), held, np.zeros_like(fine.points))
    there = solve(problem, settings=SolverSettings(first_step=0.05, largest_step=0.1, tolerance=1e-8)).displacement
    expected = (interpolation_operator(fine, points) @ there - interpolation_operator(mesh, points) @ state) / 0.1
    np.testing.assert_allclose(found[0][0].reshape(-1, 3), expected, atol=1e-3 * np.abs(expected).max())


def test_states_that_are_kept_spare_most_of_the_way_and_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    at, theta, _ = rough_limb(10.0, 0.0)
    softer = theta - np.array([0.05, 0.1, 0.0, 0.0])
    made, factorized = [0], forward_model.Solvers.factorized

    def counted(self: forward_model.Solvers, *arguments: Any) -> Factorization:
        made[0] += 1
        return factorized(self, *arguments)

    monkeypatch.setattr(forward_model.Solvers, "factorized", counted)
    anew = changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, softer))
    of_new, kept = made[0], KeptStates()
    assert changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, theta), kept) is not None
    made[0] = 0
    found = changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, softer), kept)
    assert anew is not None and found is not None and made[0] <= 0.6 * of_new
    np.testing.assert_allclose(found[0][0], anew[0][0], atol=1e-5 * np.abs(anew[0][0]).max())
    kept.added = {key: 1e3 * added for key, added in kept.added.items()}  # no equilibrium is near that
    found = changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, softer), kept)
    assert found is not None and found[1] == "neo_hookean"
    np.testing.assert_allclose(found[0][0], anew[0][0], atol=1e-5 * np.abs(anew[0][0]).max())


def test_a_large_body_does_not_go_the_long_way_from_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small strain then tells what half the size changes, with an error less than this. The control is found from rest."""
    at, theta, _ = rough_limb(17.0, 0.3)
    exact = changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, theta))
    monkeypatch.setattr(forward_model, "LONG_WAY", 0)
    found = changes_on_finer_mesh(at, "neo_hookean", lambda _, of: moduli_of(of, theta))
    assert exact is not None and found is not None and (exact[1], found[1]) == ("neo_hookean", "linear")
    assert np.linalg.norm(found[0][0] - exact[0][0]) < np.linalg.norm(exact[0][0])


def test_a_change_of_small_strain_is_doubted_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its error may be as large as itself, as on the limb above; two fifths of a change under the identified law are doubted."""
    body = cube(LAYERS, pushes=((0.0, 0.0, -4.0),), law="neo_hookean")
    rng = np.random.default_rng(0)
    (u,) = (body.displacement(p) for p in body.pushes)
    field = DisplacementField.from_arrays(body.mesh.points, u + 0.01 * rng.standard_normal(u.shape), sd_mm=0.01)
    cases, doubts = [FieldLoadCase.of("push", field, body.mesh, loaded=body.constrained)], []
    made = size_correction.changes_on_finer_mesh
    for law in ("neo_hookean", "linear"):
        monkeypatch.setattr(size_correction, "changes_on_finer_mesh", lambda *a, law=law: (made(*a)[0], law))
        found = identify_field(body.mesh, cases, body.zones(), law="neo_hookean")
        assert found.budget is not None and any("from small strain" in step for step in found.steps) == (law == "linear")
        doubts.append(found.budget.mesh[: found.zones.count])
    np.testing.assert_allclose(doubts[1], doubts[0] / DOUBT, rtol=1e-9)


def test_the_others_follow_a_modulus_that_is_wrong_as_the_least_squares_fit_does() -> None:
    """One column of a regression with a wrong coefficient: the others change by the regression of that column on theirs."""
    columns = np.random.default_rng(0).normal(size=(50, 3)) @ np.array([[1.0, 0.6, 0.2], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    apart = np.array([False, True, False])
    covariance = carried_over(np.diag([0.0, 0.3**2, 0.0]), columns.T @ columns, apart)
    follow = -0.3 * np.linalg.lstsq(columns[:, ~apart], columns[:, 1], rcond=None)[0]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.abs([follow[0], 0.3, follow[1]]), rtol=1e-10)
    assert np.sign(covariance[0, 1]) == np.sign(follow[0])


def test_what_a_zone_set_apart_changes_is_no_doubt_of_others_but_by_what_the_data_tie_them() -> None:
    """A skin whose ln mu changes by 1 on half the size, and a muscle that is not tied to it: its doubt of 0.5 for thin layers stays."""
    relative, sure, thin = np.array([0.05, 1.0, 0.02, 0.1]), np.ones(4, dtype=bool), np.array([False, True])
    tied = np.diag([4e4, 400.0, 100.0, 1.0])
    alone = doubt_in_all(relative, sure, tied, thin, mixed=True, thin=thin)
    np.testing.assert_allclose(np.sqrt(np.diag(alone))[[0, 2]], 0.5 / 1.4)
    tied[0, 1] = tied[1, 0] = 2000.0  # ln mu of the muscle falls by a twentieth of what that of the skin is too high
    both = doubt_in_all(relative, sure, tied, thin, mixed=True, thin=thin)
    np.testing.assert_allclose(both[0, 0], alone[0, 0] + 0.05**2 * alone[1, 1])
    worst = doubt_in_all(relative, sure, tied, np.zeros(2, dtype=bool), mixed=True, thin=thin)
    assert np.sqrt(worst[0, 0]) == pytest.approx(1.0 / 1.4)


def test_one_standard_deviation_of_elements_reaches_what_another_mesh_gives() -> None:
    """Of ln mu, and of mu / kappa, in which errors are normal: a fifth where it is larger by a fifth elsewhere."""
    theta, other = np.array([1.0, 2.0]), np.array([1.3, 2.0 - np.log(1.2)])
    raised = at_least_to(other, theta, np.diag([0.1**2, 0.5**2]))
    np.testing.assert_allclose(np.sqrt(np.diag(raised)), [0.3, 0.5])
    assert at_least_to(None, theta, raised) is raised
    np.testing.assert_allclose(np.sqrt(np.diag(at_least_to(other, theta, np.zeros((2, 2))))), [0.3, 0.2])


@pytest.mark.parametrize("shape", ["cube", "barrel"])
def test_a_nearly_incompressible_gel_is_told_as_well_as_another(shape: str) -> None:
    """What cells change of mu / kappa is most of it at a ratio of 0.495, and no error of Young's modulus: intervals of factor 2 held 5."""
    body = QuadraticBody(shape, unknown=(5.0, 0.495))
    mesh, loaded = body.model(6, "hexahedron")
    rng = np.random.default_rng(0)
    points, u = body.solved((0.0, 0.0, -4.0), divisions=6).at(rng.uniform(0.02, 0.98, (400, 3)))
    field = DisplacementField.from_arrays(points, u + 0.04 * rng.standard_normal(u.shape), sd_mm=0.04)
    found = identify_field(mesh, [FieldLoadCase.of("push", field, mesh, loaded=loaded)], Zones.of(mesh, known={"known": body.known}))
    (low, high), (least, most) = (bounds[0] for bounds in found.intervals())
    assert low < 5.0 < high < 1.12 * low
    assert least < 0.495 < most
    assert found.poisson_ratio[0] > 0.49
