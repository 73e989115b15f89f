"""Two open questions of the 2008 report :cite:p:`hirai2008` (chapter 3.7): stiffness of the known object, density of mesh and markers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.sensitivities import FieldModel, logarithms, young_and_poisson
from naibu.identification.from_fields.inversion.gauss_newton import Objective, first_point, search
from naibu.identification.from_fields.planning.experiment_design import Accuracy, expected_accuracy
from naibu.meshing.point_location import interpolation_operator
from naibu.reproduction.chapter3.bodies import PushedBody, cube
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

LAYERS = {"lower layer": (0.25, 0.43), "upper layer": (0.5, 0.38)}  # of Fig. 3.16, kPa
SIDE_MM, PUSH = 40.0, (0.0, 0.0, -10.0)
NOISE_MM = 0.1  # one per cent of the push
RATIOS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 40.0)
CHECKED = (0.1, 0.8, 12.8)
MARKERS_A_SIDE, CELLS_A_SIDE, TRUTH_CELLS = (5, 6, 8, 10), (4, 8, 12), 20


@dataclass(frozen=True, slots=True, eq=False)
class MonteCarloErrors:
    """Root mean square errors of identifications with noise (Monte Carlo): of ln E and of Poisson's ratio, (2,) each."""

    young_modulus: FloatArray
    poisson_ratio: FloatArray


def cube_with_known(ratio: float, divisions: int = 4) -> PushedBody:
    """Return the cube of two unknown layers below a known half that is `ratio` times as stiff as their mean."""
    mean = float(np.mean([young for young, _ in LAYERS.values()]))
    return cube(LAYERS, known=(ratio * mean, 0.43), divisions=divisions)


def planned_trials(body: PushedBody, points: FloatArray, vectors: FloatArray) -> list[FieldLoadCase]:
    """Return the load case as it is measured at given points, without noise."""
    field = DisplacementField.from_arrays(points, vectors, sd_mm=NOISE_MM)
    return [FieldLoadCase.of("indentation", field, body.mesh, loaded=body.constrained)]


def known_stiffness(ratio: float) -> Accuracy:
    """Return the expected accuracy if all nodes of the report's mesh are measured, for a stiffness ratio of the known half."""
    body = cube_with_known(ratio)
    young, poisson = np.array(list(LAYERS.values())).T
    trials = planned_trials(body, body.mesh.points, body.displacement(PUSH))
    return expected_accuracy(body.mesh, trials, body.zones(), young_modulus=young, poisson_ratio=poisson, elements="as_given")


def density(cells: int, markers: int, truth: PushedBody, displacement: FloatArray) -> Accuracy:
    """Return the expected accuracy on a model of `cells` per edge with `markers` per edge, for a body solved on a finer mesh."""
    at = (np.arange(markers) + 0.5) / markers * SIDE_MM
    points = np.array(np.meshgrid(at, at, at, indexing="ij")).reshape(3, -1).T
    body = cube_with_known(1.0, cells)
    young, poisson = np.array(list(LAYERS.values())).T
    trials = planned_trials(body, points, interpolation_operator(truth.mesh, points) @ displacement)
    return expected_accuracy(body.mesh, trials, body.zones(), young_modulus=young, poisson_ratio=poisson, elements="as_given")


def monte_carlo_errors(ratio: float, draws: int, seed: int) -> MonteCarloErrors:
    """Return the errors of repeated identifications of the two layers from noisy data, to verify the expected accuracy."""
    body = cube_with_known(ratio)
    lame, shear = (values[[np.flatnonzero(body.mesh.regions == k)[0] for k in range(2)]] for values in body.moduli)
    young, poisson = np.array(list(LAYERS.values())).T
    truth = logarithms(lame, shear)
    exact, rng = body.displacement(PUSH), np.random.default_rng(seed)
    errors = []
    for _ in range(draws):
        noisy = planned_trials(body, body.mesh.points, exact + NOISE_MM * rng.standard_normal(exact.shape))
        model = FieldModel(body.mesh, noisy, body.zones(), elements="as_given")
        e, nu = young_and_poisson(search(model, first_point(model, truth), Objective()).point.theta)
        errors.append([np.log(e / young), nu - poisson])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    return MonteCarloErrors(rms[0], rms[1])


def design_section(*, draws: int = 40, seed: int = 0) -> Section:
    """Return both studies as tables and figures.

    Parameters
    ----------
    draws : int
        Noisy identifications for each Monte Carlo verification.
    seed : int
        Seed of the noise.
    """
    expected = [known_stiffness(ratio) for ratio in RATIOS]
    checked = {ratio: monte_carlo_errors(ratio, draws, seed) for ratio in CHECKED}
    truth = cube_with_known(1.0, TRUTH_CELLS)
    displacement = truth.displacement(PUSH)
    lattices = {(n, k): density(n, k, truth, displacement) for n in CELLS_A_SIDE for k in MARKERS_A_SIDE}
    worse = np.array([a.young_modulus_sd.max() for a in expected])
    good = [ratio for ratio, sd in zip(RATIOS, worse, strict=True) if sd < 1.5 * worse.min()]
    text = (
        "The report asks how stiff the known object should be, and how the mesh affects the accuracy. Both are answered before any "
        "identification, by the covariance of displacement matching: the Cramer-Rao bound, with the unknown displacement of the floor and "
        f"the top estimated as well. Cube of {SIDE_MM:g} mm, two unknown layers below a known half, one indentation of 10 mm, noise SD "
        f"{NOISE_MM:g} mm.",
        f"Among the ratios tried, the less accurate of the two moduli is best with a known half {RATIOS[int(worse.argmin())]:g} times as "
        f"stiff as the unknown layers; from {good[0]:g} to {good[-1]:g} its error is below 1.5 times the smallest. A soft known "
        "object takes all the deformation; a stiff one hardly deforms, and its forces are lost in the noise.",
        "The error due to noise decreases with the number of markers, the discretisation error with the number of cells: on a mesh as "
        "coarse as that of the report the latter dominates, however many markers there are.",
    )
    tables = (_stiffness_table(expected, checked, draws), _density_table(lattices))
    figures = (
        Figure(
            "Stiffness of the known object",
            f"Expected standard deviation (lines) and root mean square error of {draws} identifications with noise (dots).",
            lambda canvas: _draw_stiffness(canvas, expected, checked),
            (8.0, 3.4),
        ),
        Figure(
            "Mesh and marker density",
            "Expected root mean square relative error of Young's modulus, both layers together: noise (dashed), noise and discretisation "
            f"(solid). The truth is computed on a mesh of {TRUTH_CELLS} cells per edge.",
            lambda canvas: _draw_density(canvas, lattices),
            (6.0, 3.6),
        ),
    )
    return Section("Stiffness of the known object, density of mesh and markers", text, tables, figures)


def _stiffness_table(expected: list[Accuracy], checked: dict[float, MonteCarloErrors], draws: int) -> Table:
    names = tuple(LAYERS)
    columns: tuple[str, ...] = ("known / unknown stiffness",)
    columns += tuple(f"E of {name}: expected SD, %" for name in names) + tuple(f"E of {name}: {draws} draws, %" for name in names)
    columns += tuple(f"nu of {name}: expected SD" for name in names) + tuple(f"nu of {name}: {draws} draws" for name in names)
    rows = []
    for ratio, a in zip(RATIOS, expected, strict=True):
        found = checked.get(ratio)
        e = [None, None] if found is None else (100.0 * found.young_modulus).tolist()
        nu = [None, None] if found is None else found.poisson_ratio.tolist()
        rows.append((ratio, *(100.0 * a.young_modulus_sd).tolist(), *e, *a.poisson_ratio_sd.tolist(), *nu))
    return Table("Known object", columns, tuple(rows), caption="Accuracy against the stiffness of the known half")


def _density_table(lattices: dict[tuple[int, int], Accuracy]) -> Table:
    columns = ("cells per edge", "markers per edge", "E: SD by noise, %", "E: mesh error, %", "nu: SD by noise", "nu: mesh error")
    rows = tuple(
        (n, k, 100.0 * _rms(a.young_modulus_sd), 100.0 * _rms(a.young_modulus_bias), _rms(a.poisson_ratio_sd), _rms(a.poisson_ratio_bias))
        for (n, k), a in lattices.items()
    )
    return Table("Density", columns, rows, caption="Accuracy against mesh and markers, root mean square over both layers")


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _draw_stiffness(canvas: Canvas, expected: list[Accuracy], checked: dict[float, MonteCarloErrors]) -> None:
    left, right = canvas.subplots(1, 2)
    for k, (name, colour) in enumerate(zip(LAYERS, ("#414487", "#22a884"), strict=True)):
        left.loglog(RATIOS, [100.0 * a.young_modulus_sd[k] for a in expected], color=colour, label=name)
        left.loglog(list(checked), [100.0 * c.young_modulus[k] for c in checked.values()], "o", color=colour)
        right.loglog(RATIOS, [a.poisson_ratio_sd[k] for a in expected], color=colour, label=name)
        right.loglog(list(checked), [c.poisson_ratio[k] for c in checked.values()], "o", color=colour)
    for axes, label in ((left, "error of Young's modulus, %"), (right, "error of Poisson's ratio")):
        axes.set_xlabel("stiffness of the known half / mean of the unknown")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3, which="both")
    left.legend(frameon=False)


def _draw_density(canvas: Canvas, lattices: dict[tuple[int, int], Accuracy]) -> None:
    axes = canvas.subplots()
    for n, colour in zip(CELLS_A_SIDE, ("#440154", "#21918c", "#b5b81c"), strict=True):
        own = [lattices[n, k] for k in MARKERS_A_SIDE]
        axes.semilogy(MARKERS_A_SIDE, [100.0 * _rms(a.young_modulus_error) for a in own], "o-", color=colour, label=f"{n} cells per edge")
        axes.semilogy(MARKERS_A_SIDE, [100.0 * _rms(a.young_modulus_sd) for a in own], "--", color=colour)
    axes.set_xlabel("markers per edge")
    axes.set_ylabel("error of Young's modulus, %")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
