"""Elastic and viscous parameters from motions that were computed on a finer mesh with shorter steps, and what displacements cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.identification.from_motion.rheology import MotionLoadCase, _Problem, identify_motion, rheology_parameters
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain.dynamics import simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.mass_matrix import mass_of
from naibu.mechanics.small_strain.rheology import per_region, three_element
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.point_location import interpolation_operator
from naibu.meshing.structured_2d import rectangle

SIZE = (60.0, 30.0)
TRUTH = three_element(10.0, 6.0, 60.0, 0.4)
TIMES = np.arange(0.0, 6.0, 1.0 / 8.0)
POINTS = np.array([[x, y] for x in (-20.0, -7.0, 0.0, 7.0, 20.0) for y in (8.0, 16.0, 24.0)])
PUSH = PrescribedMotion.through([0.0, 1.0, 3.0], [(0.0, 0.0), (0.0, -5.0), (0.0, -5.0)])
DENSITY, GRAVITY = 1e-6, 9810.0
SD_MM, SD_MN = 0.05, 20.0


def body_of(cells: tuple[int, int]):
    mesh = rectangle(SIZE, cells)
    x, y = mesh.points.T
    top = np.flatnonzero((y > SIZE[1] - 1e-9) & (np.abs(x) <= 10.0 + 1e-9))
    return mesh, [Support("floor", np.flatnonzero(y < 1e-9)), Support("plate", top, motion=PUSH, end_s=3.0)]


def weight(mesh) -> np.ndarray:
    body = LinearBody.of(mesh, thickness_mm=20.0)
    down = np.zeros_like(mesh.points)
    down[:, 1] = -GRAVITY
    return mass_of(body, DENSITY, "lumped").apply(down)


def measured(*, heavy: bool = False, force: bool = False, seed: int = 0) -> MotionLoadCase:
    """Simulate on 36 x 18 cells with steps of 1/64 s, add noise, and give it a model of 24 x 12 cells."""
    rng = np.random.default_rng(seed)
    fine, supports = body_of((36, 18))
    body = LinearBody.of(fine, thickness_mm=20.0)
    load = weight(fine) if heavy else None
    series = simulate_motion(body, per_region(fine, {"body": TRUTH}), DENSITY, supports, TIMES, step=1.0 / 64.0, load=load)
    operator = interpolation_operator(fine, POINTS)
    u = np.stack([operator @ state for state in series.displacement])
    u += SD_MM * rng.standard_normal(u.shape)
    pressed = series.force("plate") + SD_MN * rng.standard_normal((len(TIMES), 2))
    coarse, own = body_of((24, 12))
    return MotionLoadCase.of(
        "push", coarse, own, TIMES, POINTS, u, sd_mm=SD_MM, thickness_mm=20.0, density=DENSITY, load=weight(coarse) if heavy else None,
        force={"plate": pressed} if force else None, force_sd_mn=SD_MN if force else np.nan, step_s=1.0 / 16.0,
    )  # fmt: skip


START = {"body": three_element(20.0, 2.0, 150.0, 0.3)}


def test_a_measured_force_gives_all_four() -> None:
    found = identify_motion([measured(force=True)], rheology_parameters(START))
    values = found.parameters.values()
    assert found.undetermined == ()
    assert 0.8 < found.noise_factor < 1.3
    for kind, truth in (("young_modulus", 10.0), ("voigt_viscosity", 6.0), ("series_viscosity", 60.0)):
        assert values[f"body: {kind}"] == pytest.approx(truth, rel=0.08), kind
    assert values["body: poisson_ratio"] == pytest.approx(0.4, abs=0.01)


def test_displacements_alone_tell_ratios_and_say_so() -> None:
    found = identify_motion([measured()], rheology_parameters(START))
    values = found.parameters.values()
    assert any("common factor of body: young_modulus, body: voigt_viscosity, body: series_viscosity" in line for line in found.undetermined)
    assert values["body: voigt_viscosity"] / values["body: young_modulus"] == pytest.approx(0.6, rel=0.1)
    assert values["body: series_viscosity"] / values["body: young_modulus"] == pytest.approx(6.0, rel=0.1)
    low, high = found.interval("body: young_modulus")
    assert high / low > 100.0
    given = identify_motion([measured()], rheology_parameters({"body": TRUTH}, known=["body: young_modulus"]))
    assert given.undetermined == ()
    assert given.parameters.values()["body: series_viscosity"] == pytest.approx(60.0, rel=0.1)


def test_its_weight_gives_the_scale() -> None:
    found = identify_motion([measured(heavy=True)], rheology_parameters(START))
    assert found.undetermined == ()
    low, high = found.interval("body: young_modulus")
    assert high / low < 1.2
    assert found.parameters.values()["body: young_modulus"] == pytest.approx(10.0, rel=0.1)  # the coarser mesh alone makes 5 %


def test_bad_input_is_named() -> None:
    trial = measured()
    with pytest.raises(InputError, match="does not exist"):
        rheology_parameters(START, known=["body: hardness"])
    with pytest.raises(InputError, match="no parameters"):
        identify_motion([trial], rheology_parameters({"other": TRUTH}))
    with pytest.raises(InputError, match="all parameters are known"):
        identify_motion([trial], rheology_parameters(START, known=["body"]))
    with pytest.raises(InputError, match="force_sd_mn"):
        MotionLoadCase.of(
            "a", trial.mesh, trial.supports, TIMES, POINTS, trial.displacement, sd_mm=0.1, force={"plate": np.zeros((len(TIMES), 2))}
        )
    with pytest.raises(InputError, match="times, points, axes"):
        MotionLoadCase.of("a", trial.mesh, trial.supports, TIMES, POINTS, trial.displacement[1:], sd_mm=0.1)


def test_derivatives_against_differences_of_motions() -> None:
    trial = measured(heavy=True, force=True)
    parameters = rheology_parameters(START)
    problem = _Problem((trial,), parameters, None)
    inner = parameters.start()
    exact = problem.jacobian(inner)
    for k, step in enumerate(1e-4 * np.eye(len(inner))):
        difference = (problem.residuals(inner + step) - problem.residuals(inner - step)) / 2e-4
        assert exact[:, k] == pytest.approx(difference, abs=1e-5 * np.abs(difference).max())
