"""What noise in the sought motion of the surface does to information and to the correction for the size of elements, by drawing noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gel_on_a_pad import SD_MM, SIDE_MM, TRUTH, gel_on_a_pad

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.forward.load_cases import Zones
from naibu.identification.from_fields.forward.sensitivities import FieldModel, Linearised, moduli_of
from naibu.identification.from_fields.mesh_error import changes_of_motions, changes_on_finer_mesh, refitted
from naibu.identification.from_fields.surface.noise import CorrectedInformation, DrawnMotions
from naibu.identification.from_fields.uncertainty import intervals
from naibu.identification.from_fields.verdicts.verdict import FEW_POINTS

SOME, PAIRS = 300, 12


def test_the_covariance_is_that_of_a_corrected_score() -> None:
    rng = np.random.default_rng(0)
    root, other = rng.standard_normal((2, 4, 6))
    hessian = root @ root.T
    of_noise = 0.05 * other @ other.T
    found, left = CorrectedInformation.of(hessian, of_noise), np.linalg.inv(hessian - of_noise)
    np.testing.assert_allclose(np.linalg.inv(found.matrix), left @ hessian @ left, rtol=1e-8)
    np.testing.assert_allclose(found.step(np.arange(4.0)), left @ np.arange(4.0), rtol=1e-8)


def test_what_is_not_determined_stays_so() -> None:
    hessian = np.diag([4.0, 0.0])
    found = CorrectedInformation.of(hessian, np.diag([1.0, 0.0]))
    np.testing.assert_allclose(found.matrix, np.diag([4.0 * 0.75**2, 0.0]), atol=1e-12)
    np.testing.assert_allclose(found.step(np.array([3.0, 1.0])), [1.0, 0.0], atol=1e-12)


@pytest.fixture(scope="module")
def drawn() -> tuple[list[FloatArray], list[FloatArray], DrawnMotions, FloatArray, FloatArray]:
    """Return Hessians and gradients of what half the size changes, less those of exact data, under noise and its negative."""
    mesh, zones, exact = gel_on_a_pad()
    points, vectors, rng = exact.field.points[:SOME], exact.field.vectors[:SOME], np.random.default_rng(3)

    def fitted(noise: FloatArray) -> Linearised:
        case = replace(exact, field=DisplacementField.from_arrays(points, vectors + noise, sd_mm=0.5 * SD_MM))
        model = FieldModel(mesh, [case], zones)
        at = model.linearised(model.evaluate(TRUTH, [np.zeros_like(mesh.points)]))
        (moved,) = at.forward(None, [-b for b in at.loaded_solved([g[:, None] for g in at.gradient()[1]])])
        return model.linearised(model.evaluate(TRUTH, [at.point.states[0] + moved.reshape(-1, 3)]))

    def moduli_on(_: object, of: Zones) -> tuple[FloatArray, FloatArray]:
        return moduli_of(of, TRUTH)

    def measured(at: Linearised) -> tuple[FloatArray, FloatArray]:
        quadratic, changes = at.concentrated(np.eye(2)), changes_on_finer_mesh(at, "linear", moduli_on)
        assert changes is not None
        step = refitted(at, quadratic, changes[0]).theta - refitted(at, quadratic, [np.zeros_like(changes[0][0])]).theta
        return quadratic.hessian, -quadratic.hessian @ step

    noise = 0.5 * SD_MM * rng.standard_normal((PAIRS, *vectors.shape))
    hessians, gradients = zip(*[measured(fitted(side * n)) for n in noise for side in (1.0, -1.0)], strict=True)
    at = fitted(np.zeros_like(vectors))
    own = measured(at)
    motions, quadratic = DrawnMotions.of(at, 1.0), at.concentrated(np.eye(2))
    changes = changes_on_finer_mesh(at, "linear", moduli_on)
    assert changes is not None
    mean, each = motions.gradients_of_change(at, quadratic, changes[0], changes_of_motions(at, moduli_on, motions.moved))
    return [h - own[0] for h in hessians], [g - own[1] for g in gradients], motions, mean, each


def test_noise_looks_like_information(drawn: tuple[list[FloatArray], list[FloatArray], DrawnMotions, FloatArray, FloatArray]) -> None:
    hessians, _, motions, _, _ = drawn
    more = np.mean(hessians, axis=0)  # of each noise and its negative: what is linear in it cancels
    np.testing.assert_allclose(motions.information, more, atol=0.25 * np.abs(more).max())
    assert np.linalg.eigvalsh(more)[0] > 0.0


def test_noise_alters_what_half_the_size_changes(
    drawn: tuple[list[FloatArray], list[FloatArray], DrawnMotions, FloatArray, FloatArray],
) -> None:
    _, gradients, _, mean, each = drawn
    both = np.reshape(gradients, (PAIRS, 2, 2))
    square, linear = both.mean(axis=1), 0.5 * (both[:, 0] - both[:, 1])
    spread = square.std(axis=0) / np.sqrt(PAIRS)
    np.testing.assert_allclose(mean, square.mean(axis=0), atol=4.0 * float(spread.max()))
    scatter, told = (np.sqrt((x**2).mean(axis=0)) for x in (linear, each))
    np.testing.assert_allclose(told, scatter, rtol=0.6)  # of 12 and 16 draws
    assert (np.abs(mean) > 4.0 * spread).any()


@pytest.mark.parametrize(("points", "said"), [(500, "explained"), (180, "but"), (100, "but"), (25, "do not use")])
def test_too_few_points_for_the_cells_of_a_body_whose_surface_is_sought_are_told(points: int, said: str) -> None:
    """In Python nothing limits the number of cells: the motion of the surface then follows the noise, and tells nothing of the moduli."""
    mesh, zones, exact = gel_on_a_pad()  # 125 cells
    rng = np.random.default_rng(4)
    vectors = exact.field.vectors[:points] + 0.1 * SD_MM * rng.standard_normal((points, 3))
    field = DisplacementField.from_arrays(exact.field.points[:points], vectors, sd_mm=0.1 * SD_MM)
    found = identify_field(mesh, [replace(exact, field=field)], zones, elements="as_given")
    assert found.verdict is not None
    first = found.identifiability[0]
    assert said in first and (f"{points} points for 125 cells" in first) == (points < 250)
    assert found.verdict.ok == (points > 31)
    plates = exact.loaded & (np.isclose(mesh.points[:, 2:], 0.0) | np.isclose(mesh.points[:, 2:], SIDE_MM))
    known_free = identify_field(mesh, [replace(exact, field=field, loaded=plates)], zones, elements="as_given")
    assert "cells" not in known_free.identifiability[0]


@pytest.mark.parametrize(("points", "told"), [(100, True), (50, False)])
def test_fewer_points_than_half_the_cells_say_nothing_of_poissons_ratio(points: int, told: bool) -> None:
    """They leave the motion of the surface to its smoothness, which draws Poisson's ratio up by as much as its interval."""
    mesh, zones, exact = gel_on_a_pad()  # 125 cells
    vectors = exact.field.vectors[:points] + 0.1 * SD_MM * np.random.default_rng(4).standard_normal((points, 3))
    field = DisplacementField.from_arrays(exact.field.points[:points], vectors, sd_mm=0.1 * SD_MM)
    found = identify_field(mesh, [replace(exact, field=field)], zones, elements="as_given")
    assert found.uncertainty is not None
    young, poisson = intervals(found.theta, found.uncertainty)
    assert young[0, 0] < 5.0 < young[0, 1] < np.inf and poisson[0, 0] < 0.45 < poisson[0, 1]
    assert (FEW_POINTS not in found.identifiability) == told == (poisson[0, 0] > 0.0)
    assert found.verdict is not None and found.verdict.ok
