"""The soft fingertip of chapter 6 :cite:p:`hirai2008`: compression tests of Figs 6.9 to 6.12, and of the papers to 60 N."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.nonlinearity import SwitchedPress, switched_presses
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing, rotated_loads
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.sensing_chip.filters import first_order_filter
from naibu.core.arrays import FloatArray
from naibu.reproduction.chapter6 import fingertip_figures
from naibu.reproduction.chapter6.contact_comparison import theories_section
from naibu.viewer.chapters.chapter import Figure, Section
from naibu.viewer.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

TILTS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
SPEED = 3.0 / 60.0  # mm/s, of the rod
FULL_MN = 3000.0
LARGE_MN = 60_000.0
AZIMUTH_OF_90 = 180.0  # in the chip's frame, of the report's phi = 90 degrees, where M_y is positive
JIG_DEG = (0.0, 0.0, 0.0, -1.0, -1.5, 0.0, -2.0)  # assumed errors of the azimuth of the seven mounts
SHARE = 0.1


def fingertip_sections(chain: ReadingChain, seed: int, resolution: FingertipResolution | None = None) -> tuple[Section, ...]:
    """Return the sections on the fingertip.

    Parameters
    ----------
    chain : ReadingChain
        Of the assumed chip.
    seed : int
        Of the noise.
    resolution : FingertipResolution, optional
        Of the finite elements.
    """
    small = FingertipModel.of(Fingertip(), resolution)
    pressings = [small.pressed(Press(tilt, FULL_MN), keep_displacement=tilt == TILTS[4]) for tilt in TILTS]
    large = FingertipModel.of(Fingertip(diameter_mm=40.0), resolution)
    strong = [large.pressed(Press(tilt, LARGE_MN)) for tilt in (0.0, 20.0)]
    coarse = resolution or FingertipResolution(3, 2, 10)
    switched = switched_presses(Fingertip(), Press(20.0, FULL_MN), coarse)
    theories = theories_section(small.fingertip, [f"{tilt:g} degrees" for tilt in TILTS], pressings)
    return (_basic(small, pressings, chain, seed), _moments(pressings, chain, switched), _to_60_newtons(strong, chain), theories)


def _volts(pressing: Pressing, chain: ReadingChain, azimuth: float, forces: FloatArray) -> FloatArray:
    return chain.volts(rotated_loads(pressing.at_force(forces), azimuth))


def _basic(model: FingertipModel, pressings: Sequence[Pressing], chain: ReadingChain, seed: int) -> Section:
    full = np.array([FULL_MN])
    duration = [float(p.interpolated(p.depth_mm, full)[0]) / SPEED for p in pressings]
    volts = [_volts(p, chain, AZIMUTH_OF_90, full)[0] for p in pressings]
    jig = [_volts(p, chain, AZIMUTH_OF_90 + error, full)[0, 1] for p, error in zip(pressings, JIG_DEG, strict=True)]
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (tilt, seconds, *(round(float(v), 6) for v in v3), float(v3[0] / volts[0][0]), error, float(m_x))
        for tilt, seconds, v3, error, m_x in zip(TILTS, duration, volts, JIG_DEG, jig, strict=True)
    )
    table = Table(
        "Figures 6.9 and 6.11 at 3 N",
        ("θ, degrees", "time to 3 N, s", "F_z, V", "M_x, V", "M_y, V", "F_z over that at 0", "error of the jig's azimuth, degrees",
         "M_x with it, V"),
        rows, caption="φ = 90 degrees, 3 mm/min, gains 2000, 500 and 500.",
        note="The report prints curves, no numbers. The errors of the jig are assumed; they show what lifts M_x as in (c), (d), (f).",
    )  # fmt: skip
    drop = 100.0 * (1.0 - volts[-1][0] / volts[0][0])
    spread = 100.0 * (max(duration) / min(duration) - 1.0)
    text = (
        "A hemisphere of 20 mm, E = 220 kPa, with the assumed chip under an assumed package of 0.9 × 0.35 mm at its base; the "
        "rod's flat end is perpendicular to its axis, which points to the centre of the hemisphere; friction 0.5 (assumed).",
        f"Agrees: the load over time hardly depends on θ (the time to 3 N by {spread:.2g} %); M_y grows with θ, M_x does not, "
        "and the channels do not disturb each other. An error of the jig of 1 to 2 degrees lifts M_x as the report suspects.",
        f"Differs in part: F_z is called constant; here it falls by {drop:.2g} % from 0 to 30 degrees, "
        "more than the force along the base's normal does, 1 − cos 30 degrees = 13 %. That a central load gives the same F_z at every "
        "angle does not follow from its "
        "direction.",
        "Printed inconsistently: in chapter 6 a press at φ = 90 degrees gives M_y, in the papers one at 60 degrees from the x axis gives "
        "more M_x than M_y. A lateral force along y turns the chip about x; with the papers' angle chapter 6's φ counts from the y axis.",
    )
    return Section("Fingertip: basic compression tests (Figs 6.8 to 6.11)", text, (table,), _figures(model, pressings, chain, seed))


def _figures(model: FingertipModel, pressings: Sequence[Pressing], chain: ReadingChain, seed: int) -> tuple[Figure, ...]:
    names = [f"{tilt:g} degrees" for tilt in TILTS]
    forces = np.linspace(0.0, FULL_MN, 31)
    volts = [_volts(p, chain, AZIMUTH_OF_90, forces) for p in pressings]

    def force_over_time(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        for pressing, name in zip(pressings, names, strict=True):
            axes.plot(pressing.depth_mm / SPEED, 1e-3 * pressing.along_rod_mn, ".-", markersize=3, linewidth=1.0, label=name)
        axes.set(xlabel="time (s)", ylabel="load (N)")
        axes.legend(fontsize=7)

    def filtered(canvas: Canvas) -> None:
        pressing, rng = pressings[4], np.random.default_rng(seed)
        times = np.arange(0.0, pressing.depth_mm[-1] / SPEED, 1.0 / chain.readout.sample_rate_hz)
        loads = np.stack([np.interp(times * SPEED, pressing.depth_mm, column) for column in pressing.chip_loads.T], axis=1)
        read = chain.converted(rotated_loads(loads, AZIMUTH_OF_90), rng)
        for axes, values, title in zip(canvas.subplots(1, 2), (read, first_order_filter(read, SHARE)), ("read", "filtered"), strict=True):
            axes.plot(times, values, linewidth=0.5, label=[f"${name}$" for name in fingertip_figures.CHANNELS])
            axes.set(title=title, xlabel="time (s)", ylabel="reading (V)")
            axes.legend(fontsize=7)

    return (
        Figure("Figure 6.9", "Load over time at the rod's 3 mm/min.", force_over_time, (6.0, 3.6)),
        Figure("Figure 6.10", "Readings at 20 degrees, and after the filter with r = 0.1.", filtered, (9.0, 3.4)),
        Figure("Figure 6.11", "Readings over the load at φ = 90 degrees.",
               lambda canvas: fingertip_figures.readings_over_force(canvas, [1e-3 * forces] * len(names), volts, names), (11.0, 3.6)),
        Figure("Figure 6.8", "Section in the plane of the tilt at 20 degrees and 3 N.",
               lambda canvas: fingertip_figures.section(canvas, model, pressings[4]), (9.0, 5.0)),
    )  # fmt: skip


def _moments(pressings: Sequence[Pressing], chain: ReadingChain, switched: Sequence[SwitchedPress]) -> Section:
    forces = np.linspace(0.0, FULL_MN, 31)
    curves = {
        f"φ = {phi:g}, θ = {TILTS[k]:g}": _volts(pressings[k], chain, AZIMUTH_OF_90 + phi - 90.0 + JIG_DEG[k], forces)[:, 1:]
        for k in (2, 4, 6)
        for phi in (0.0, 90.0, 180.0, 270.0)
    }
    loads, matrix = pressings[4].at_force(forces[-1:])[0], chain.sensitivities
    crosstalk = 100.0 * abs(float(matrix[2, 0] * loads[0] / (matrix[2, 4] * loads[4])))
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (s.name, *(float(v) for v in s.chip_loads[-1, [0, 2, 4]]), *(100.0 * s.bow(k) for k in (0, 2, 4)), 100.0 * s.ratio_bow)
        for s in switched
    )
    table = Table(
        "Geometry, contact and law turned off in turn",
        ("what counts", "F_x, mN", "F_z, mN", "M_y, N µm", "bend of F_x over F, %", "of F_z, %", "of M_y, %", "of M_y over F_x, %"),
        rows, caption="20 degrees, 3 N. Bend: largest distance from proportion, over the largest value.",
        note="Another law: Saint Venant-Kirchhoff. Dead load: the rod's final traction, in proportion from 0. With nothing that bends, "
        "about "
        "1 % remains, as the elements average their change of volume, which is not linear in the displacement.",
    )  # fmt: skip
    text = (
        "Agrees: no crosstalk. By the symmetry of finger and chip M_x is 0 when the tilt is in the plane of x; a lateral force enters "
        "only the "
        f"moment of its own plane, by {crosstalk:.2g} % of it.",
        "Does not agree: the report sees a slight S in M_y over M_x and suspects the nonlinear geometry and material. In a finger and chip "
        "that are symmetric about their axis, neither can turn the moment out of the plane of the tilt, whatever the strain, contact "
        "or law: "
        "an error of the jig gives a straight line through 0. And in that plane the moments are nearly in proportion to the force: "
        "the table "
        "tells by how much geometry, contact and law bend them. An S needs an asymmetry that changes with the load: a rod whose edge "
        "or axis "
        "is off the centre, a groove or cable beside the package, or mounts whose errors differ.",
    )
    figure = Figure(
        "Figure 6.12",
        "M_y over M_x, with the assumed errors of the jig.",
        lambda canvas: fingertip_figures.moments(canvas, curves),
        (7.5, 4.2),
    )
    return Section("Fingertip: M_x against M_y (Fig. 6.12)", text, (table,), (figure,))


def _to_60_newtons(strong: Sequence[Pressing], chain: ReadingChain) -> Section:
    full = np.array([LARGE_MN])
    volts = [_volts(p, chain, 60.0, full)[0] for p in strong]
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (p.press.tilt_deg, float(p.interpolated(p.depth_mm, full)[0]), float(p.at_force(full)[0, 2]), *(float(v) for v in v3),
         ", ".join(name for name, v in zip(fingertip_figures.CHANNELS, v3, strict=True) if abs(v) > chain.readout.adc_limit) or "none")
        for p, v3 in zip(strong, volts, strict=True)
    )  # fmt: skip
    table = Table(
        "Papers, 40 mm fingertip to 60 N",
        ("θ, degrees", "depth, mm", "F_z on the chip, mN", "F_z, V", "M_x, V", "M_y, V", "beyond the converter"),
        rows, caption="Contact at 60 degrees from the x axis, gains 2000, 500, 500 (the papers: 3000 for all).",
    )  # fmt: skip
    text = (
        "Agrees: M_x is larger than M_y, as the lateral force at 60 degrees from x is rather along y.",
        "Does not agree: the papers read a larger F_z at 20 degrees than at 0; here it is about the same or smaller. They explain it "
        "with the "
        "minimum of elastic energy of a fingertip that is pressed towards its base; this rod presses towards the centre.",
        "At 60 N and these gains the assumed chip would exceed the converter, so that less of the force must have reached the chip of the "
        "papers. The slow return to 0 and beyond after the rod's fast retreat is viscoelastic; this model is elastic.",
    )
    return Section("Fingertip: compression to 60 N (papers, Figs 11 and 12)", text, (table,))
