"""Identification of the agar from five ultrasound markers, and what they leave undetermined :cite:p:`hirai2008` (chapter 2.4)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from naibu.core.arrays import FloatArray
from naibu.core.parameters import MAX_POISSON_RATIO
from naibu.identification.from_motion.rheology import MotionLoadCase, identify_motion, rheology_parameters
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain.rheology import elastic
from naibu.mechanics.small_strain.supports import Support
from naibu.reproduction.chapter2.simulations import AGAR, AGAR_PUSH_MM, AGAR_SIZE_MM, WEIGHT_MM, agar_block_3d
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.tables import Cell, Table

STEP_MM = 0.5  # resolution of the printed coordinates
ECHO_SD_MM = 0.3  # of the centre of a blurred echo
SD_MM = float(np.hypot(ECHO_SD_MM, STEP_MM / np.sqrt(6.0)))  # of a displacement: two readings, each rounded
WEIGHT_N, DURATION_S = 4.9, 6.0
START = np.array([np.log(0.5 - 0.4), 0.0, AGAR_PUSH_MM])
SPAN = np.array([1.5, 10.0, 4.0])  # standard deviations of the prior: ln(0.5 - nu), shift, depth
REFERENCE_KPA = 10.0
SYMBOLS = {"young_modulus": "E", "voigt_viscosity": "C1", "series_viscosity": "C2", "poisson_ratio": "Poisson's ratio"}


@dataclass(frozen=True, slots=True, eq=False)
class AgarFit:
    """Estimates (3,) and limits of the 95 % intervals (3,) of Poisson's ratio, shift of the weight and depth (mm), and residual RMS."""

    estimate: FloatArray
    low: FloatArray
    high: FloatArray
    rms_mm: float
    young_modulus: float


def agar_section(trials: Mapping[str, tuple[FloatArray, FloatArray]], *, cell_mm: float = 5.0) -> Section:
    """Return the identification of the agar from initial positions and displacements (5, 2), mm, of each trial; cells of `cell_mm`."""
    fits = {name: fit_trial(*readings, cell_mm) for name, readings in trials.items()}
    rows: list[tuple[Cell, ...]] = []
    for k, (what, unit) in enumerate((("Poisson's ratio", ""), ("shift of the weight to the left", "mm"), ("indentation depth", "mm"))):
        cells = [v for fit in fits.values() for v in (float(fit.estimate[k]), f"{fit.low[k]:.3g} to {fit.high[k]:.3g}")]
        rows.append((f"{what}, {unit}" if unit else what, *cells))
    rows.append(("Young's modulus 6 s after loading, kPa", *[v for fit in fits.values() for v in (fit.young_modulus, None)]))
    rows.append(("residual RMS of a coordinate, mm", *[v for fit in fits.values() for v in (fit.rms_mm, None)]))
    columns = ("quantity", *[text for name in fits for text in (f"{name}: estimate", f"{name}: 95 %")])
    name = next(iter(trials))
    sentences = undetermined_combinations(trials[name], fits[name], cell_mm)
    text = (
        f"Three-dimensional block under a round weight, cells of {cell_mm:g} mm, small strain. Poisson's ratio, the position of the weight "
        f"relative to the markers and the indentation depth are estimated together; the SD of a displacement is {SD_MM:.2f} mm. The weight "
        f"of {WEIGHT_N:g} N then gives the relaxed modulus of the agar at the end, whatever the viscoelastic law.",
        "What the two states of a trial determine of E, C1 and C2, with the weight as the only known force: " + " ".join(sentences),
        "A time series of the markers after unloading would determine C1 / E and C2 / E, and with the weight all three: "
        "see naibu.identification.from_motion.rheology.",
    )
    note = "At strains of 25 % the error of the linear law exceeds that of the readings: the intervals are conditional on the model."
    table = Table("Agar", columns, tuple(rows), caption="Identified from the markers of Table 2.1.", note=note)
    return Section("What the ultrasound markers determine of the agar", text, (table,))


def fit_trial(start: FloatArray, displacement: FloatArray, cell_mm: float) -> AgarFit:
    """Fit one trial by least squares with the wide prior `SPAN`."""

    def residuals(x: FloatArray) -> FloatArray:
        return np.concatenate([((_modelled(x, start, cell_mm)[0] - displacement) / SD_MM).ravel(), (x - START) / SPAN])

    lowest = np.log(0.5 - MAX_POISSON_RATIO)
    found = least_squares(residuals, START, x_scale=SPAN, bounds=([lowest, -15.0, 0.5], [np.log(0.5), 15.0, 15.0]))
    data, slopes = found.fun[: displacement.size], np.asarray(found.jac)
    excess = max(1.0, float(np.sqrt(data @ data / (displacement.size - 3))))
    jacobian = np.vstack([slopes[: displacement.size] / excess, slopes[displacement.size :]])
    half = 1.96 * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    ends = np.sort([_physical(found.x - half), _physical(found.x + half)], axis=0)
    force = _modelled(found.x, start, cell_mm)[1]
    return AgarFit(
        _physical(found.x), ends[0], ends[1], float(SD_MM * np.sqrt(data @ data / displacement.size)), REFERENCE_KPA * WEIGHT_N / force
    )


def undetermined_combinations(readings: tuple[FloatArray, FloatArray], fit: AgarFit, cell_mm: float) -> tuple[str, ...]:
    """Return in sentences which combinations of E, C1, C2 and Poisson's ratio the initial and the final state leave undetermined."""
    start, displacement = readings
    _, shift, depth = fit.estimate
    study = agar_block_3d(cell_mm=cell_mm, push_s=1.0, duration_s=DURATION_S)
    top = study.mesh.points
    under = np.flatnonzero((top[:, 2] > AGAR_SIZE_MM[2] - 1e-9) & (np.hypot(top[:, 0], top[:, 1]) <= 0.5 * WEIGHT_MM + 1e-9))
    path = PrescribedMotion.through([0.0, 1.0], [(0.0, 0.0, 0.0), (0.0, 0.0, -float(depth))])
    supports = [Support("floor", np.flatnonzero(top[:, 2] < 1e-9)), Support("weight", under, motion=path)]
    u = np.full((2, len(start), 3), np.nan)
    u[0], u[1, :, 0], u[1, :, 2] = 0.0, displacement[:, 0], displacement[:, 1]
    force = np.full((2, 3), np.nan)
    force[1, 2] = -1e3 * WEIGHT_N
    points = _in_block(start, float(shift))
    trial = MotionLoadCase.of(
        "agar", study.mesh, supports, [0.0, DURATION_S], points, u, sd_mm=SD_MM, force={"weight": force}, force_sd_mn=50.0, step_s=1.0
    )
    told = identify_motion([trial], rheology_parameters({"body": AGAR})).undetermined
    return tuple(re.sub(r"body: (\w+)", lambda found: SYMBOLS[found[1]], sentence) for sentence in told)


def _modelled(x: FloatArray, start: FloatArray, cell_mm: float) -> tuple[FloatArray, float]:
    """Return the displacement (k, 2), mm, at points of the section y = 0, and the force on the weight, N, for 10 kPa, elastic."""
    nu, shift, depth = _physical(x)
    study = agar_block_3d(material=elastic(REFERENCE_KPA, float(nu)), cell_mm=cell_mm, duration_s=2.0)
    points = _in_block(start, float(shift))
    factor = depth / AGAR_PUSH_MM
    moved = factor * study.displacement_at(points, 2.0)[:, [0, 2]]
    return moved, -float(factor * study.series.force("weight")[-1, 2]) * 1e-3


def _in_block(start: FloatArray, shift: float) -> FloatArray:
    """Return markers (k, 3), mm, in the axes of the block centred under the weight; the report has the middle marker at x = 0."""
    return np.column_stack([start[:, 0] + shift, np.zeros(len(start)), start[:, 1]])


def _physical(x: FloatArray) -> FloatArray:
    return np.array([0.5 - np.exp(x[0]), x[1], x[2]])
