"""Response of layered skin against the time integration, closed forms of creep, and the frequency domain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from naibu.applications.ischemia.layered_response import LayeredModes, SkinMotion, frequency_response, laplace_modulus, simulate_skin
from naibu.applications.ischemia.skin import SkinLayer, SkinPatch, SurfaceLoad, from_planes, graded, meshed
from naibu.core.errors import InputError
from naibu.mechanics.small_strain.dynamics import simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import per_region, three_element, voigt
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.structured_2d import rectangle

UPPER, LOWER = three_element(3.8, 0.03, 30.0, 0.49), three_element(0.5, 1.0, 30.0, 0.49)
PATCH = SkinPatch((SkinLayer(0.5, LOWER), SkinLayer(0.5, UPPER)), 4.0)
TIMES = np.array([0.002, 0.01, 0.03, 0.1, 0.3, 0.47, 0.48, 0.5, 0.6, 1.0, 2.0])


@pytest.fixture(scope="module")
def modes() -> LayeredModes:
    return LayeredModes.of(meshed(PATCH, 0.5, across=8, upwards=6))


def test_a_uniform_column_creeps_as_the_closed_form_says() -> None:
    # a bar whose sides are free, loaded over its whole width but for its last column, by superposition of elastic solutions:
    # the response of one material is its elastic response times its creep function
    material = three_element(2.0, 0.5, 40.0, 0.3)
    one = LayeredModes.of(meshed(SkinPatch((SkinLayer(1.0, material),), 2.0), 0.4, across=6, upwards=6))
    load = SurfaceLoad(3.0, 0.5, 0.4)
    creeping = simulate_skin(one, (material,), load, TIMES).indentation
    elastic = simulate_skin(one, (three_element(2.0, 0.0, np.inf, 0.3),), load, [0.1]).indentation[0]

    def creep(t: np.ndarray) -> np.ndarray:
        return np.where(t > 0.0, 1.0 - np.exp(-np.maximum(t, 0.0) * 2.0 / 0.5) + 2.0 * t / 40.0, 0.0)

    assert_allclose(creeping, elastic * (creep(TIMES) - creep(TIMES - 0.5)), rtol=1e-9)


def test_two_layers_in_a_column_creep_in_series() -> None:
    # without lateral strain (a Poisson ratio of 0, a load on the whole surface) layers are three elements one above the other
    lower, upper = three_element(0.5, 1.0, 30.0, 0.0), three_element(3.8, 0.03, 20.0, 0.0)
    heights, width, force, end = (0.4, 0.6), 1.0, 2.0, 0.47
    patch = SkinPatch((SkinLayer(heights[0], lower), SkinLayer(heights[1], upper)), width)
    mesh = meshed(patch, 0.4999, across=6, upwards=6)
    found = simulate_skin(LayeredModes.of(mesh), (lower, upper), SurfaceLoad(force, end, 0.4999), TIMES)

    def crept(t: np.ndarray) -> np.ndarray:
        after = np.maximum(t, 0.0)
        layers = zip(heights, ((0.5, 1.0, 30.0), (3.8, 0.03, 20.0)), strict=True)
        return np.asarray(force / width * sum(h * ((1.0 - np.exp(-after * e / c1)) / e + after / c2) for h, (e, c1, c2) in layers))

    assert_allclose(found.indentation, crept(TIMES) - crept(TIMES - end), rtol=2e-3)
    s = 2j * np.pi * np.array([0.1, 1.0, 10.0, 100.0])
    compliance = 0.4 * (1.0 / (0.5 + 1.0 * s) + 1.0 / (30.0 * s)) + 0.6 * (1.0 / (3.8 + 0.03 * s) + 1.0 / (20.0 * s))
    assert_allclose(frequency_response(mesh, (lower, upper), s.imag / (2.0 * np.pi), inertia=False), compliance / width, rtol=2e-3)


def test_a_round_pressure_on_a_deep_layer_is_that_of_boussinesq() -> None:
    # a half space under an even pressure p on a circle of radius a sinks by 2 p a (1 - nu^2) / E in the middle, below which the
    # pressure is p 2 (1 + nu) / 3 (1 - z / sqrt(a^2 + z^2)) at the depth z
    young, poisson, radius, force = 3.8, 0.45, 0.5, 2.0
    material = voigt(young, 0.0, poisson)
    mesh = meshed(SkinPatch((SkinLayer(12.0, material),), 24.0, kinematics="axisymmetric"), radius, across=24, upwards=48)
    planes = mesh.grid.planes[0], 12.0 - graded(12.0, radius, 24)[::-1]
    mesh = from_planes(mesh.patch, planes, radius)
    motion = simulate_skin(LayeredModes.of(mesh), (material,), SurfaceLoad(force, 1.0, radius), [0.9])
    pressure = force / (np.pi * radius**2)
    sunk = 2.0 * pressure * radius * (1.0 - poisson**2) / young
    assert motion.indentation[0] == pytest.approx(sunk * (1.0 - 0.5 * radius / 12.0), rel=0.03)  # the base is not infinitely deep
    z = 0.5 * (planes[1][-1] - planes[1][-2])  # the pressure is that of the uppermost cells
    below = pressure * 2.0 * (1.0 + poisson) / 3.0 * (1.0 - z / np.hypot(radius, z))
    assert motion.pressure[0, 0] == pytest.approx(below, rel=0.02)
    cell = radius / 12.0
    assert abs(np.sqrt(motion.pale_area(0.3 * pressure)[0] / np.pi) - radius) < cell  # it jumps there


def test_two_layers_move_as_the_time_integration_of_triangles_says() -> None:
    mesh = rectangle((4.0, 1.0), (48, 16))
    upper = mesh.points[mesh.cells][..., 1].mean(axis=1) > 0.5
    mesh = replace(mesh, regions=upper.astype(np.int64), region_names=("lower", "upper"))
    soft = three_element(0.5, 1.0, 30.0, 0.3), three_element(3.8, 0.03, 30.0, 0.3)
    x = mesh.points[:, 0] - mesh.points[:, 0].mean()
    top = mesh.points[:, 1] == mesh.points[:, 1].max()
    share = np.where(np.isclose(np.abs(x), 0.5), 0.5, np.abs(x) < 0.5) * top
    force = np.zeros(mesh.points.shape)
    force[:, 1] = -50.0 * share / share.sum()
    base = Support("base", np.flatnonzero(mesh.points[:, 1] == mesh.points[:, 1].min()))
    motion = simulate_motion(
        LinearBody.of(mesh), per_region(mesh, {"lower": soft[0], "upper": soft[1]}), None, [base], [0.0, 0.1, 0.47, 0.8], step=0.005,
        load=lambda t: force if t < 0.47 else 0.0 * force, breaks=[0.47],
    )  # fmt: skip
    middle = int(np.flatnonzero(top & np.isclose(x, 0.0))[0])
    patch = SkinPatch((SkinLayer(0.5, soft[0]), SkinLayer(0.5, soft[1])), 4.0)
    found = simulate_skin(LayeredModes.of(meshed(patch, 0.5, across=20, upwards=14)), soft, SurfaceLoad(50.0, 0.47, 0.5), [0.1, 0.47, 0.8])
    assert_allclose(found.indentation, -motion.displacement[1:, middle, 1], rtol=0.02)


def test_the_frequency_response_is_the_transform_of_the_step_response(modes: LayeredModes) -> None:
    # load for half a period, repeatedly: its first harmonic against the direct solution
    hertz, cycles = 2.0, 40
    count = 400
    times = (cycles + np.arange(count) / count) / hertz
    period = 1.0 / hertz
    single = [
        simulate_skin(modes, (LOWER, UPPER), SurfaceLoad(1.0, 0.5 * period, 0.5), times - k * period).indentation for k in range(cycles + 1)
    ]
    total = np.sum(single, axis=0)
    flow = (
        np.linspace(0.0, 1.0, count, endpoint=False)
        * (simulate_skin(modes, (LOWER, UPPER), SurfaceLoad(1.0, 0.5 * period, 0.5), [1e4]).indentation[0])
    )
    wave = np.exp(-2j * np.pi * hertz * times)
    square = np.where((times * hertz) % 1.0 < 0.5, 1.0, 0.0)
    found = ((total - flow) * wave).mean() / ((square - 0.5) * wave).mean()
    direct = frequency_response(modes.meshed, (LOWER, UPPER), [hertz], inertia=False)[0]
    assert abs(found / direct - 1.0) < 0.02


def test_inertia_is_negligible_in_skin_and_makes_an_elastic_column_resonate(modes: LayeredModes) -> None:
    with_mass, without = (np.abs(frequency_response(modes.meshed, (LOWER, UPPER), [1.0, 100.0], inertia=i)) for i in (True, False))
    assert_allclose(with_mass, without, rtol=0.02)
    spring = three_element(3.8, 0.0, np.inf, 0.0)
    column = meshed(SkinPatch((SkinLayer(1.0, spring),), 0.1), 0.049, across=4, upwards=24)
    first = np.sqrt(3.8 / 1.2e-6) / 4.0  # Hz: a quarter of a wavelength in a height of 1 mm
    below, above = frequency_response(column, (spring,), [0.99 * first, 1.01 * first]).real
    assert below > 0.0 > above


@pytest.mark.parametrize("kinematics", ["plane_strain", "axisymmetric", "three_dimensional"])
def test_pressure_below_the_load_carries_it(kinematics: str) -> None:
    material = voigt(3.8, 0.03, 0.49)
    size = {"across": 5, "upwards": 4} if kinematics == "three_dimensional" else {"across": 12, "upwards": 10}
    mesh = meshed(SkinPatch((SkinLayer(1.0, material),), 4.0, kinematics=kinematics), 0.8, **size)  # type: ignore[arg-type]
    assert mesh.load[:, -1].sum() == pytest.approx(-1.0)
    motion = simulate_skin(LayeredModes.of(mesh), (material,), SurfaceLoad(10.0, 1.0, 0.8), [0.999])
    loaded = 1.6 if kinematics == "plane_strain" else np.pi * 0.64
    # nearly incompressible: under a wide load the pressure in the surface is about that on it, and none is far from it
    under = motion.pressure[0].max()
    assert 0.6 * 10.0 / loaded < under < 1.7 * 10.0 / loaded
    area = motion.pale_area(0.3 * 10.0 / loaded)[0]
    assert 0.6 * loaded < area < 1.9 * loaded
    assert motion.pale_area(100.0)[0] == 0.0


def test_the_edge_of_a_pale_area_moves_evenly() -> None:
    # a pressure that falls in proportion to the radius, as a cone, is above p in a circle of area pi (1 - p / 8)^2
    radius = np.linspace(0.0, 1.5, 16)
    cone = 8.0 * (1.0 - 0.5 * (radius[1:] + radius[:-1]))[None]
    change = np.full_like(cone, -8.0 * (radius[1] - radius[0]))
    motion = SkinMotion(
        np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.int64), np.zeros((1, 1, 2)), cone, change, np.pi * np.diff(radius**2)
    )
    levels = np.linspace(0.5, 7.0, 40)
    areas = np.array([motion.pale_area(p)[0] for p in levels])
    assert_allclose(areas, np.pi * (1.0 - levels / 8.0) ** 2, atol=0.01)
    assert np.all(np.diff(areas) < 0.0)


def test_a_pressure_that_jumps_is_that_under_the_load_when_the_load_is_removed(modes: LayeredModes) -> None:
    pressure = simulate_skin(modes, (LOWER, UPPER), SurfaceLoad(50.0, 0.47, 0.5), [0.469, 0.47, 0.471]).pressure.max(axis=1)
    assert pressure[1] == pytest.approx(pressure[0], rel=0.01) and pressure[2] < 0.9 * pressure[0]


def test_moduli_have_the_limits_of_springs_and_dashpots() -> None:
    numerator, denominator = laplace_modulus(three_element(2.0, 0.5, 40.0, 0.3))
    slow, fast = 1e-9, 1e9
    assert np.polyval(numerator[::-1], slow) / np.polyval(denominator[::-1], slow) == pytest.approx(40.0 * slow)
    assert np.polyval(numerator[::-1], fast) / np.polyval(denominator[::-1], fast) == pytest.approx(0.5 * 40.0 / 40.5 * fast)


def test_the_printed_grid_can_be_taken() -> None:
    patch = SkinPatch((SkinLayer(0.5, LOWER), SkinLayer(0.5, UPPER)), 4.0)
    mesh = from_planes(patch, (np.linspace(-2.0, 2.0, 5), np.linspace(0.0, 1.0, 11)), 0.0)
    assert len(mesh.grid.cells) == 40 and mesh.grid.points[mesh.middle].tolist() == [0.0, 1.0]
    assert mesh.load[mesh.middle, 1] == -1.0 and np.count_nonzero(mesh.load) == 1


@pytest.mark.parametrize(
    ("what", "make"),
    [
        ("layers must be one or two", lambda m: SkinPatch((), 4.0)),
        ("one Poisson ratio, not 0.49, 0.3", lambda m: SkinLayer(1.0, three_element(1.0, 1.0, 1.0, 0.49, voigt_poisson_ratio=0.3))),
        ("thickness_mm must be positive", lambda m: SkinLayer(-1.0, UPPER)),
        ("force_mn must be positive", lambda m: SurfaceLoad(0.0, 1.0)),
        ("radius_mm must be zero", lambda m: SurfaceLoad(1.0, 1.0, np.nan)),
        ("smaller than half of the width of the patch, 2 mm, not 3", lambda m: meshed(PATCH, 3.0)),
        ("for the 2 layers of the patch, not 1", lambda m: simulate_skin(m, (UPPER,), SurfaceLoad(1.0, 1.0), [1.0])),
        ("Poisson ratio of 0.3; the modes", lambda m: simulate_skin(m, (voigt(1.0, 1.0, 0.3), UPPER), SurfaceLoad(1.0, 1.0), [1.0])),
        ("times must be finite", lambda m: simulate_skin(m, (LOWER, UPPER), SurfaceLoad(1.0, 1.0), [np.inf])),
        ("frequencies_hz must be positive", lambda m: frequency_response(m.meshed, (LOWER, UPPER), [0.0])),
        ("use fewer cells", lambda m: LayeredModes.of(meshed(replace(PATCH, kinematics="three_dimensional"), 0.5, across=12))),
    ],
)
def test_bad_input_is_named(what: str, make: object, modes: LayeredModes) -> None:
    with pytest.raises(InputError, match=what):
        make(modes)  # type: ignore[operator]


def test_a_threshold_must_be_positive(modes: LayeredModes) -> None:
    motion = simulate_skin(modes, (LOWER, UPPER), SurfaceLoad(1.0, 1.0, 0.5), [0.5])
    with pytest.raises(InputError, match="threshold_kpa must be positive"):
        motion.pale_area(-1.0)
