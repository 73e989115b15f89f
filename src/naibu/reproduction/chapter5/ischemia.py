"""Active ischemia: Figures 5.8 and 5.9 of the 2008 report :cite:p:`hirai2008` (chapter 5.3), and what its numbers imply."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.applications.ischemia.layer_identification import LayerEstimate, identify_layers
from naibu.applications.ischemia.layered_response import LayeredModes, SkinMotion, frequency_response, simulate_skin
from naibu.applications.ischemia.response_times import ResponseTimes, response_times
from naibu.applications.ischemia.skin import SkinLayer, SkinPatch, SurfaceLoad, from_planes, meshed
from naibu.core.arrays import ComplexArray, FloatArray
from naibu.mechanics.finite_elements.linear_simplices import lumped_mass
from naibu.mechanics.small_strain.averaged_dilatation import Kinematics
from naibu.mechanics.small_strain.dynamics import simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import Rheology, per_region, three_element
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.structured_2d import rectangle

FORCE_MN, DURATION_S, POISSON_RATIO, DENSITY = 50.0, 0.47, 0.49, 1.2e-6
WIDTH_MM, HEIGHT_MM, DEPTH_MM = 4.0, 1.0, 1.0
GRID = (4, 10)
JET_RADIUS_MM = 0.5
THRESHOLD_KPA = 4.0  # pressure of capillaries, 30 mmHg
SAME = {"C1 = 30 Pa s": three_element(3.8, 0.03, 30.0, POISSON_RATIO), "C1 = 80 Pa s": three_element(3.8, 0.08, 30.0, POISSON_RATIO)}
UPPER = SAME["C1 = 30 Pa s"]
LOWER = {f"model {i + 1}, lower C1 = {1e3 * c:g} Pa s": three_element(0.5, c, 30.0, POISSON_RATIO) for i, c in enumerate((0.5, 1.0, 2.0))}
TIMES = np.unique(
    np.concatenate([np.linspace(0.0, DURATION_S, 320), DURATION_S + np.concatenate([[0.0], np.geomspace(1e-3, 2.53, 360)]), [1.0, 3.0]])
)
ASSUMED = {
    "grid": "4 cells of 1 mm across and 10 of 0.1 mm upwards; '4 x 10' does not say which",
    "layers": "half of the height each; not printed",
    "base and sides": "fixed and free; not printed",
    "jet": "even pressure on a radius of 0.5 mm on converged meshes; the report has a force on one node",
    "capillaries": "empty above 4 kPa (30 mmHg); the report has no pressure",
    "elements": "plane strain as in the report, 1 mm deep",
}


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A simulated response: its name, motion and times of indentation and of pale area."""

    name: str
    times: FloatArray
    indentation: FloatArray
    measured: ResponseTimes
    motion: SkinMotion | None = None


def patch(lower: Rheology, upper: Rheology, kinematics: Kinematics = "plane_strain") -> SkinPatch:
    """Return the patch of the report."""
    half = 0.5 * HEIGHT_MM
    return SkinPatch((SkinLayer(half, lower, DENSITY), SkinLayer(half, upper, DENSITY)), WIDTH_MM, kinematics, DEPTH_MM)


def modes_of(kinematics: Kinematics, radius_mm: float, *, across: int = 20, upwards: int = 14) -> LayeredModes:
    """Return the modes of a converged mesh."""
    return LayeredModes.of(meshed(patch(UPPER, UPPER, kinematics), radius_mm, across=across, upwards=upwards))


def printed_grid_modes() -> LayeredModes:
    """Return the modes of bricks on the printed grid, with the force on one node."""
    planes = tuple(np.linspace(*span, n + 1) for span, n in zip(((-0.5 * WIDTH_MM, 0.5 * WIDTH_MM), (0.0, HEIGHT_MM)), GRID, strict=True))
    return LayeredModes.of(from_planes(patch(UPPER, UPPER), planes, 0.0))


def response(
    name: str, modes: LayeredModes, lower: Rheology, upper: Rheology, radius_mm: float, duration_s: float = DURATION_S
) -> Response:
    """Simulate a press and its release, without inertia."""
    times = (
        TIMES if duration_s == DURATION_S else np.unique(np.concatenate([TIMES * duration_s / DURATION_S, TIMES - DURATION_S + duration_s]))
    )
    times = times[times >= 0.0]
    motion = simulate_skin(modes, (lower, upper), SurfaceLoad(FORCE_MN, duration_s, radius_mm), times)
    return Response(name, times, motion.indentation, response_times(times, motion.indentation, duration_s), motion)


def printed_grid(name: str, lower: Rheology, upper: Rheology, *, step_s: float = 5e-4) -> Response:
    """Integrate the triangles of the printed grid in time, with inertia, as the report does."""
    mesh = rectangle((WIDTH_MM, HEIGHT_MM), GRID)
    above = mesh.points[mesh.cells][..., 1].mean(axis=1) > 0.5 * HEIGHT_MM
    mesh = replace(mesh, regions=above.astype(np.int64), region_names=("lower", "upper"))
    body = LinearBody.of(mesh, thickness_mm=DEPTH_MM)
    top = np.flatnonzero(mesh.points[:, 1] == mesh.points[:, 1].max())
    middle = int(top[np.argmin(np.abs(mesh.points[top, 0] - mesh.points[top, 0].mean()))])
    force = np.zeros(mesh.points.shape)
    force[middle, 1] = -FORCE_MN
    base = Support("base", np.flatnonzero(mesh.points[:, 1] == mesh.points[:, 1].min()))
    motion = simulate_motion(
        body, per_region(mesh, {"lower": lower, "upper": upper}), DENSITY, [base], np.linspace(0.0, 3.0, 601), step=step_s,
        load=lambda t: force if t < DURATION_S else 0.0 * force, breaks=[DURATION_S],
    )  # fmt: skip
    indentation = -motion.displacement[:, middle, 1]
    return Response(name, motion.times, indentation, response_times(motion.times, indentation, DURATION_S))


def patch_mass_kg() -> float:
    """Return the mass of the printed patch, kg."""
    return float(lumped_mass(LinearBody.of(rectangle((WIDTH_MM, HEIGHT_MM), GRID), thickness_mm=DEPTH_MM).simplices, DENSITY).sum())


def parameter_study(modes: LayeredModes) -> list[tuple[str, str, Response]]:
    """Change one thing at a time in the uniform skin with C1 = 30 Pa s: what changes, its value, and the response."""
    found = []
    for c1 in (0.01, 0.03, 0.08, 0.2):
        found.append(("C1, Pa s", f"{1e3 * c1:g}", three_element(3.8, c1, 30.0, POISSON_RATIO), DURATION_S))
    for e in (1.9, 7.6):
        found.append(("E, kPa", f"{e:g}", three_element(e, 0.03, 30.0, POISSON_RATIO), DURATION_S))
    for c2 in (10.0, 100.0):
        found.append(("C2, kPa s", f"{c2:g}", three_element(3.8, 0.03, c2, POISSON_RATIO), DURATION_S))
    for duration in (0.1, 1.0, 4.0):
        found.append(("duration, s", f"{duration:g}", UPPER, duration))
    return [(what, value, response(what, modes, m, m, JET_RADIUS_MM, duration)) for what, value, m, duration in found]


def bode(modes: LayeredModes, lower: Rheology, upper: Rheology, frequencies_hz: FloatArray) -> ComplexArray:
    """Return the indentation for an oscillating force, with inertia, mm/mN."""
    return frequency_response(modes.meshed, (lower, upper), frequencies_hz)


def frequency_from_time(modes: LayeredModes, material: Rheology, hertz: float) -> complex:
    """Return the response of uniform skin at one frequency from the time domain: the transform of its response to a short pulse."""
    width = 1e-4 / hertz
    rate = material.young_modulus / material.voigt_viscosity
    times = np.concatenate([np.linspace(0.0, width, 40), width + np.geomspace(1e-3 / rate, 40.0 / rate, 4000)])
    pulse = simulate_skin(modes, (material, material), SurfaceLoad(1.0, width, JET_RADIUS_MM), times).indentation
    end = pulse[-1]  # the flow that remains: a step, whose transform is known
    wave = np.exp(-2j * np.pi * hertz * times)
    transform = np.trapezoid((pulse - end) * wave, times) + end / (2j * np.pi * hertz)
    load = (1.0 - np.exp(-2j * np.pi * hertz * width)) / (2j * np.pi * hertz)
    return complex(transform / load)


def identified(lower: Rheology, noise_mm: float, seed: int) -> LayerEstimate:
    """Identify both layers from the record of a finer mesh, with noise."""
    times = np.concatenate([np.linspace(0.005, DURATION_S, 60), np.linspace(DURATION_S + 0.005, 3.0, 60)])
    load = SurfaceLoad(FORCE_MN, DURATION_S, JET_RADIUS_MM)
    record = simulate_skin(modes_of("plane_strain", JET_RADIUS_MM), (lower, UPPER), load, times).indentation
    measured = record + noise_mm * np.random.default_rng(seed).standard_normal(len(times))
    start = (three_element(1.0, 0.5, 50.0, POISSON_RATIO), three_element(2.0, 0.08, 50.0, POISSON_RATIO))
    coarse = modes_of("plane_strain", JET_RADIUS_MM, across=10, upwards=8)
    return identify_layers(coarse, load, times, measured, noise_mm, start=start)
